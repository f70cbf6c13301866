"""Kinematic definitions of twelve mouse actions and of unnamed movements, as control channels.

Thresholds of speed, height and turning are those of Live Mouse Tracker and the literature; speeds
are mm/s of a mouse of home size. A posture is one elevation for each of the four bones, a turn at
each of the three inner joints, and the stretch of the body. `agents.agent` filters and concatenates
the actions, `mouse_poses` places the postures on the floor.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape
from liex_lab.body.skeleton import Skeleton
from liex_lab.simulation.agents.agent import (
    SPEED,
    STEP_S,
    TURN,
    UNLABELLED,
    ActedMotion,
    BehaviourSequence,
    Individual,
    bump,
    clock,
    slow_noise,
)
from liex_lab.simulation.pose_prior import Posture, resting_heights, stand
from liex_lab.simulation.species import MouseSpecies

ACTIONS = (
    "walk",
    "run",
    "turn_left",
    "turn_right",
    "rear_supported",
    "rear_unsupported",
    "groom",
    "pause",
    "freeze",
    "sniff",
    "dart",
    "stretch_attend",
)
# elevations of the bones, turns at the inner joints, rad
_RISE = slice(3, 7)
_BEND = slice(7, 10)
_STRETCH = 10
_ROLL = 11
_CHANNELS = 12
_SHARES = {
    "walk": 5.0,
    "run": 2.5,
    "turn_left": 1.2,
    "turn_right": 1.2,
    "rear_supported": 2.0,
    "rear_unsupported": 2.0,
    "groom": 1.2,
    "pause": 4.0,
    "freeze": 1.5,
    "sniff": 2.2,
    "dart": 2.5,
    "stretch_attend": 1.5,
}
_WALL_MM = 50.0  # nose-to-wall distance for a supported rear


@dataclass(frozen=True)
class MouseActor:
    """A mouse that acts in a box around the origin.

    Attributes:
        mouse: its traits.
        spine_mm: its length, mm.
        half: (2,) half sides x and y of the box, mm.
        rest: (4,) elevations of its bones when standing, rad.
    """

    mouse: Individual
    spine_mm: float
    half: Array
    rest: Array

    @staticmethod
    def of(mouse: Individual, skeleton: Skeleton, shape: BodyShape, half: Array) -> "MouseActor":
        """An actor with a given body.

        Args:
            mouse: its traits.
            skeleton: of the mouse, with four bones.
            shape: its body, a batch of which the first is used.
            half: (2,) half sides x and y of its box, mm.

        Returns:
            The actor.
        """
        height = resting_heights(skeleton, shape)[0] + np.array([0.5, 1.5, 2.5, 3.0, 3.5])
        height[-1] = 9.0
        rest = np.arcsin(
            np.clip(np.diff(height) / np.linalg.norm(skeleton.offsets[1:], axis=1), -0.9, 0.9)
        )
        return MouseActor(mouse, mouse.size * skeleton.length, half, rest)

    def fits(self, position: Array, heading: Array) -> bool:
        """Whether the body, including nose and rump, stays inside the box.

        Args:
            position: (m, 3) of the body's centre, mm.
            heading: (m,) rad.

        Returns:
            True if it does in all m steps.
        """
        ahead = 0.55 * self.spine_mm * np.stack([np.cos(heading), np.sin(heading)], axis=1)
        middle = position[:, :2]
        reach = np.maximum(np.abs(middle + ahead), np.abs(middle - 0.8 * ahead))
        return bool((reach < self.half).all())

    def uncut(self, rng: np.random.Generator, seconds: float) -> ActedMotion:
        """A recording: actions in random order, some of them separated by unnamed movements.

        Args:
            rng: random number generator.
            seconds: minimum length, s.

        Returns:
            The motion on the 5 ms clock.
        """
        rest = np.zeros(_CHANNELS)
        rest[_RISE] = self.rest
        rest[_STRETCH] = 1.0
        start = np.array([*(rng.uniform(-0.5, 0.5, 2) * self.half), 0.0])
        sequence = BehaviourSequence(rest, 0.035, start, rng.uniform(-np.pi, np.pi), self.fits)
        for word in sequence.words(rng, _SHARES, seconds):
            if word == "rear_supported":
                self._to_wall(rng, sequence)
            done = self._possible(sequence, word) and sequence.play(
                word, partial(self.act, rng, word), 6
            )
            if not done and word in ("walk", "run", "dart"):  # no room ahead
                self._turn_home(rng, sequence)
                sequence.play(word, partial(self.act, rng, word), 8)
            # some actions are followed by an unnamed movement
            elif rng.random() < 0.3 and not sequence.play(
                UNLABELLED, lambda: self._between(rng), 4
            ):
                self._turn_home(rng, sequence)
        return sequence.motion()

    def _possible(self, sequence: BehaviourSequence, word: str) -> bool:
        """Whether a rear is possible here: supported near a wall ahead, else away from walls."""
        ahead, around = self._room(sequence)
        near = {"rear_supported": ahead < _WALL_MM, "rear_unsupported": around > 1.4 * _WALL_MM}
        return near.get(word, True)

    def _room(self, sequence: BehaviourSequence) -> tuple[float, float]:
        """Distance from the nose to the wall ahead, and to the nearest wall, mm."""
        way = np.array([np.cos(sequence.heading), np.sin(sequence.heading)])
        nose = sequence.position[:2] + 0.5 * self.spine_mm * way
        along = (self.half - np.sign(way) * nose) / np.maximum(np.abs(way), 1e-9)
        ahead = np.where(np.abs(way) > 0.3, along, np.inf)
        return float(ahead.min()), float((self.half - np.abs(nose)).min())

    def _to_wall(self, rng: np.random.Generator, sequence: BehaviourSequence) -> None:
        """Turn to the nearest wall and walk up to it."""
        axis = int(np.argmin(self.half - np.abs(sequence.position[:2])))
        toward = np.zeros(2)
        toward[axis] = np.sign(sequence.position[axis]) or 1.0
        self._turn_by(rng, sequence, np.arctan2(toward[1], toward[0]) + rng.normal(0.0, 0.25))
        for _ in range(3):
            clearance, _ = self._room(sequence)
            if clearance < 0.8 * _WALL_MM or not np.isfinite(clearance):
                return
            speed = self.mouse.vigour * self.mouse.size * rng.uniform(90.0, 240.0)
            seconds = max(0.3, (clearance - 0.3 * _WALL_MM) / speed)
            sequence.play("walk", partial(self._stride, rng, seconds, speed), 2)

    def _turn_home(self, rng: np.random.Generator, sequence: BehaviourSequence) -> None:
        """Turn towards the centre of the box, in place if there is no room."""
        self._turn_by(
            rng,
            sequence,
            np.arctan2(-sequence.position[1], -sequence.position[0]) + rng.normal(0.0, 0.3),
        )

    def _turn_by(
        self, rng: np.random.Generator, sequence: BehaviourSequence, heading: float
    ) -> None:
        away = (heading - sequence.heading + np.pi) % (2 * np.pi) - np.pi
        if abs(away) < np.radians(32.0):
            return
        word = "turn_left" if away > 0 else "turn_right"
        if not sequence.play(word, lambda: self._turning(rng, away, rng.uniform(0.0, 40.0)), 3):
            limit = self.half - 0.58 * self.spine_mm
            sequence.nudge(np.array([*np.clip(sequence.position[:2], -limit, limit), 0.0]))
            sequence.play(word, lambda: self._turning(rng, away, 0.0), 3)

    def act(self, rng: np.random.Generator, word: str) -> Array:
        """Control channels of one action.

        Args:
            rng: random number generator.
            word: one of `ACTIONS`.

        Returns:
            (m, 12): speed mm/s, turning rad/s, climb rad, elevations of four bones rad, turns of
            three joints rad, stretch, roll rad.
        """
        pace = self.mouse.vigour * self.mouse.size
        return {
            "walk": lambda: self._stride(
                rng, self._seconds(rng, 0.4, 2.8), pace * rng.uniform(60.0, 290.0)
            ),
            "run": lambda: self._stride(
                rng, self._seconds(rng, 0.5, 1.3), pace * rng.uniform(300.0, 540.0)
            ),
            "dart": lambda: self._dart(rng),
            "turn_left": lambda: self._turning(
                rng, np.radians(rng.uniform(34.0, 150.0)), rng.uniform(0.0, 130.0)
            ),
            "turn_right": lambda: self._turning(
                rng, -np.radians(rng.uniform(34.0, 150.0)), rng.uniform(0.0, 130.0)
            ),
            "rear_supported": lambda: self._rear(rng, True),
            "rear_unsupported": lambda: self._rear(rng, False),
            "groom": lambda: self._groom(rng),
            "pause": lambda: self._pause(rng),
            "freeze": lambda: self._freeze(rng),
            "sniff": lambda: self._sniff(rng),
            "stretch_attend": lambda: self._stretch(rng),
        }[word]()

    def _seconds(self, rng: np.random.Generator, shortest: float, longest: float) -> float:
        return self.mouse.duration(rng, shortest, longest, 0.25)

    def _blank(
        self, rng: np.random.Generator, seconds: float, unrest: float = 1.0
    ) -> tuple[Array, Array]:
        """The clock and the channels of a standing, slightly restless mouse."""
        t = clock(seconds)
        c = np.zeros((len(t), _CHANNELS))
        c[:, _RISE] = self.rest + np.radians(rng.normal(0.0, 3.0, 4))
        c[:, _RISE.stop - 1] += np.radians(rng.normal(0.0, 7.0))
        c[:, _STRETCH] = rng.normal(1.0, 0.015)
        c[:, _BEND] = np.radians(rng.normal(0.0, 4.0, 3))
        amount = unrest * (0.6 + 0.8 * self.mouse.restless)
        c[:, _BEND] += amount * np.radians([1.5, 2.0, 6.0]) * slow_noise(rng, len(t), 0.5, 3)
        c[:, _RISE] += amount * np.radians([0.8, 1.0, 2.0, 5.0]) * slow_noise(rng, len(t), 0.5, 4)
        return t, c

    def _moving(
        self, c: Array, speed: Array | float, turn: Array | float = 0.0, gait: bool = False
    ) -> Array:
        """The channels with a speed, a turning rate and the sway of the trunk with the stride."""
        c[:, SPEED] = speed
        c[:, TURN] = turn
        if gait:
            spines = np.abs(c[:, SPEED]) / self.spine_mm
            strides = np.sqrt(spines) * 1.6 * self.mouse.tempo
            sway = 0.06 * np.minimum(spines, 1.0) * np.sin(2 * np.pi * np.cumsum(strides) * STEP_S)
            c[:, _BEND] += sway[:, None] * [1.0, -0.5, -0.5]
        return c

    def _stride(self, rng: np.random.Generator, seconds: float, speed: float) -> Array:
        t, c = self._blank(rng, seconds, 0.7)
        c[:, _STRETCH] += 0.02
        return self._moving(
            c,
            speed * np.clip(1.0 + 0.13 * slow_noise(rng, len(t), 0.5)[:, 0], 0.5, 1.5),
            np.radians(rng.normal(0.0, 10.0))
            + np.radians(11.0) * slow_noise(rng, len(t), 0.5)[:, 0],
            gait=True,
        )

    def _dart(self, rng: np.random.Generator) -> Array:
        t, c = self._blank(rng, 0.15 + self._seconds(rng, 0.4, 0.9), 0.5)
        peak = max(245.0, self.mouse.vigour * rng.uniform(260.0, 520.0)) * self.mouse.size
        burst = t[-1] - 0.15  # it starts and ends at rest
        c[:, _STRETCH] += 0.03
        speed = peak * bump(t - 0.05, burst, rng.uniform(0.2, 0.35)) ** 0.7
        return self._moving(c, speed, np.radians(rng.normal(0.0, 25.0)), gait=True)

    def _turning(self, rng: np.random.Generator, angle: float, speed: float) -> Array:
        rate = rng.uniform(1.6, 4.2) * self.mouse.tempo
        t, c = self._blank(rng, float(np.clip(abs(angle) / rate, 0.3, 1.3)), 0.7)
        shape = bump(t, t[-1]) ** 0.6
        curl = np.sign(angle) * self.mouse.bend * np.radians(rng.uniform(8.0, 30.0))
        c[:, _BEND] += curl * shape[:, None] * [0.6, 0.8, 0.9]
        turn = angle * shape / (shape.sum() * STEP_S)
        return self._moving(c, speed * self.mouse.size, turn, gait=True)

    def _rear(self, rng: np.random.Generator, supported: bool) -> Array:
        t, c = self._blank(rng, 0.35 + self._seconds(rng, 0.6, 3.0), 1.0 if not supported else 0.6)
        rise, fall = rng.uniform(0.2, 0.4, 2)
        up = np.clip(np.minimum(t / rise, (t[-1] - t) / fall), 0.0, 1.0)[:, None] ** 1.3
        steep = rng.uniform(50.0, 80.0) if supported else rng.uniform(38.0, 76.0)
        tower = np.radians(
            steep + rng.normal(0.0, 7.0, 4) + [8.0, 4.0, 0.0, -25.0 + rng.normal(0.0, 12.0)]
        )
        if not supported:
            tower = tower + np.radians(4.0) * slow_noise(rng, len(t), 0.35)
        c[:, _RISE] = c[:, _RISE] * (1.0 - up) + (tower + 0.5 * (c[:, _RISE] - self.rest)) * up
        return self._moving(c, rng.uniform(0.0, 12.0))

    def _hunch(self, rng: np.random.Generator) -> Array:
        """Elevations (4,) of an arched back."""
        return self.rest + np.radians(np.array([30.0, 12.0, -22.0, -38.0]) * rng.uniform(0.4, 1.05))

    def _groom(self, rng: np.random.Generator) -> Array:
        t, c = self._blank(rng, 0.4 + self._seconds(rng, 0.8, 5.0), 0.5)
        c[:, _RISE] += self._hunch(rng) - self.rest
        rate = (
            self.mouse.tempo
            * rng.uniform(3.0, 6.0)
            * (1.0 + 0.1 * slow_noise(rng, len(t), 0.7)[:, 0])
        )
        phase = 2 * np.pi * np.cumsum(rate) * STEP_S
        strength = 0.7 + 0.3 * slow_noise(rng, len(t), 0.6)[:, 0]
        lick = np.radians(rng.uniform(-30.0, 30.0)) * np.clip(
            slow_noise(rng, len(t), 1.2)[:, 0], 0.0, 1.0
        )
        c[:, 6] += np.radians(rng.uniform(4.0, 10.0)) * strength * np.sin(phase)
        c[:, 9] += (
            np.radians(rng.uniform(2.0, 11.0))
            * strength
            * np.sin(phase * rng.choice([0.5, 1.0]) + 1.0)
            + lick
        )
        c[:, 8] += 0.7 * lick
        return self._moving(c, rng.uniform(0.0, 12.0))

    def _pause(self, rng: np.random.Generator) -> Array:
        t, c = self._blank(rng, self._seconds(rng, 0.4, 2.4), 1.6)
        speed = np.abs(rng.uniform(0.0, 32.0) + 10.0 * slow_noise(rng, len(t), 0.4)[:, 0])
        return self._moving(c, speed, np.radians(9.0) * slow_noise(rng, len(t), 0.5)[:, 0])

    def _freeze(self, rng: np.random.Generator) -> Array:
        _, c = self._blank(rng, self._seconds(rng, 1.2, 5.0), 0.0)
        c[:, SPEED] = rng.uniform(0.0, 4.0)
        c[:, _RISE] -= np.radians(rng.uniform(0.0, 4.0))
        return c

    def _sniff(self, rng: np.random.Generator) -> Array:
        t, c = self._blank(rng, self._seconds(rng, 0.5, 2.4), 0.6)
        c[:, 6] += np.radians(-rng.uniform(10.0, 24.0))
        c[:, 5] += np.radians(-rng.uniform(2.0, 9.0))
        sweep = 2 * np.pi * self.mouse.tempo * rng.uniform(1.3, 2.8) * t
        c[:, 9] += np.radians(rng.uniform(9.0, 24.0)) * np.sin(sweep + rng.uniform(0, 6))
        c[:, 6] += np.radians(rng.uniform(1.0, 3.0)) * np.sin(
            2 * np.pi * rng.uniform(7.0, 10.0) * t
        )
        speed = rng.uniform(0.0, 90.0)
        turn = np.radians(10.0) * slow_noise(rng, len(t), 0.5)[:, 0]
        return self._moving(c, speed, turn, gait=True)

    def _stretch(self, rng: np.random.Generator) -> Array:
        t, c = self._blank(rng, self._seconds(rng, 0.7, 2.4), 0.3)
        up = np.minimum(1.0, np.minimum(t, t[-1] - t) / 0.2)
        c[:, _STRETCH] += rng.uniform(0.055, 0.12) * up
        c[:, _RISE] = self.rest * (1.0 - 0.5 * up[:, None]) + 0.5 * (c[:, _RISE] - self.rest)
        c[:, _BEND] *= 0.5
        return self._moving(c, rng.uniform(3.0, 48.0))

    def _between(self, rng: np.random.Generator) -> Array:
        """Unnamed movements: nose half up, sitting hunched, backing, bending far to one side."""
        kind = rng.choice(4, p=[0.25, 0.25, 0.25, 0.25])
        t, c = self._blank(rng, self._seconds(rng, 0.4, 1.6))
        shape = bump(t, t[-1])
        if kind == 0:
            c[:, _RISE] += (
                np.radians(rng.uniform(9.0, 20.0)) * shape[:, None] ** 0.6 * [0.5, 0.7, 1.0, 1.4]
            )
            c[:, SPEED] = rng.uniform(0.0, 50.0)
        elif kind == 1:
            deep = rng.uniform(0.7, 1.0) * (self._hunch(rng) - self.rest)
            c[:, _RISE] += deep * np.minimum(1.0, 3.0 * shape[:, None])
        elif kind == 2:
            c[:, SPEED] = -rng.uniform(25.0, 90.0)
            c[:, TURN] = np.radians(rng.normal(0.0, 20.0))
        else:
            flank = self.mouse.turn_side(rng) * np.radians(rng.uniform(16.0, 34.0))
            c[:, _BEND] += flank * shape[:, None] ** 0.6 * [0.7, 1.0, 1.4]
            c[:, SPEED] = rng.uniform(0.0, 25.0)
        return c


def mouse_poses(
    rng: np.random.Generator,
    species: MouseSpecies,
    motion: ActedMotion,
    rows: NDArray[np.int64],
    size: float,
    shape: BodyShape,
) -> tuple[Pose, Array]:
    """Poses of a mouse at some steps of its motion, and its girths.

    Args:
        rng: random number generator for the gap under the trunk (up to 2 mm).
        species: the species.
        motion: its motion.
        rows: (n,) int64 steps of the motion.
        size: of the mouse over home size.
        shape: its body, a batch of which the first is used.

    Returns:
        Poses (n) in the arena frame and girths (n,).
    """
    c = motion.channels[rows]
    n = len(rows)
    skeleton = species.skeleton
    turn = np.zeros((n, skeleton.n_joints))
    turn[:, 1:-1] = c[:, _BEND]
    # a bent body's heading is between its ends
    posture = Posture(c[:, _RISE].copy(), turn, c[:, _ROLL].copy(), c[:, _STRETCH].copy())
    heading = motion.heading[rows] - 0.5 * c[:, _BEND].sum(axis=1)
    gap = np.full(n, rng.uniform(0.0, 2.0))
    body, middle = shape[0].broadcast(n), motion.position[rows, :2]
    return stand(skeleton, posture, heading, np.full(n, size), body, gap, middle, 4)
