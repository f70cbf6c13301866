"""Kinematic definitions of nine zebrafish actions and of unnamed movements, as control channels.

Ranges follow the definitions of the literature if there are any (bends of scoots and turns, speeds,
durations) and overlap as those do: strong routine turns are weak C-turns, and J-turns bend no more
than scoots, but in another part of the body. Bends are degrees per joint of 20 bones; speeds body
lengths per second. `agents.agent` filters and concatenates the actions, `fish_poses` bends the
body.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape
from liex_lab.simulation.agents.agent import (
    CLIMB,
    STEP_S,
    UNLABELLED,
    ActedMotion,
    BehaviourSequence,
    Individual,
    bump,
    clock,
    slow_noise,
)
from liex_lab.simulation.pose_prior import bend_profile, hung, root_rotation
from liex_lab.simulation.species import FishSpecies

ACTIONS = ("scoot", "j_turn", "c_turn", "r_turn", "surface", "dive", "zigzag", "thrash", "freeze")
_ROLL, _FRONT, _HIND, _WAVE, _BEAT = range(3, 8)
_CHANNELS = 8
# relative frequencies in an uncut recording; other movements are unnamed
_SHARES = {
    "scoot": 5.0,
    "j_turn": 2.5,
    "c_turn": 2.0,
    "r_turn": 3.0,
    "surface": 1.6,
    "dive": 1.6,
    "zigzag": 1.4,
    "thrash": 1.4,
    "freeze": 1.4,
}


@dataclass(frozen=True)
class FishActor:
    """A fish that acts in view of a camera.

    Attributes:
        fish: its traits.
        length_mm: its length, mm.
        water: lowest and highest position of its centre, mm above the floor.
        camera_mm: height of the camera above the floor, mm; the fish stays in view.
    """

    fish: Individual
    length_mm: float
    water: tuple[float, float]
    camera_mm: float

    def fits(self, position: Array, heading: Array) -> bool:
        """Whether all positions are in the water and in view.

        Args:
            position: (m, 3) of the body's centre, mm.
            heading: (m,) rad, not used.

        Returns:
            True if all m are.
        """
        low, high = self.water
        visible = np.abs(position[:, :2]).max(axis=1) < self._half(position[:, 2])
        return bool((visible & (position[:, 2] > low) & (position[:, 2] < high)).all())

    def _half(self, z: Array | float) -> Array | float:
        """Half the side of the view, mm, at a height."""
        return 0.32 * (self.camera_mm - z) - 0.6 * self.length_mm

    def begin(self, rng: np.random.Generator, word: str = UNLABELLED) -> BehaviourSequence:
        """Begin a sequence at a random position near the centre, at a height that suits the action.

        Args:
            rng: random number generator.
            word: the next action; 'surface' begins low, 'dive' high.

        Returns:
            The empty sequence.
        """
        low, high = self.water
        level = {"surface": rng.uniform(0.0, 0.4), "dive": rng.uniform(0.6, 1.0)}.get(
            word, rng.uniform(0.1, 0.9)
        )
        z = low + level * (high - low)
        place = [*(rng.uniform(-0.6, 0.6, 2) * self._half(z)), z]
        return BehaviourSequence(
            np.zeros(_CHANNELS), 0.008, np.array(place), rng.uniform(-np.pi, np.pi), self.fits
        )

    def cut(self, rng: np.random.Generator, word: str) -> ActedMotion:
        """One action between two quarter-second unnamed movements.

        Args:
            rng: random number generator.
            word: one of `ACTIONS`; the label of its steps.

        Returns:
            The motion on the 5 ms clock.

        Raises:
            AssertionError: none of 50 tries leaves space for the action.
        """
        for _ in range(50):
            sequence = self.begin(rng, word)
            before = sequence.play(UNLABELLED, lambda: self._between(rng, 0.25))
            done = before and sequence.play(word, lambda: self.act(rng, word))
            if done and sequence.play(UNLABELLED, lambda: self._between(rng, 0.25)):
                return sequence.motion()
        raise AssertionError(f"no room for {word}")

    def uncut(self, rng: np.random.Generator, seconds: float) -> ActedMotion:
        """A recording: actions in random order, most of them separated by unnamed movements.

        Args:
            rng: random number generator.
            seconds: minimum length, s.

        Returns:
            The motion on the 5 ms clock.
        """
        sequence = self.begin(rng)
        for word in sequence.words(rng, _SHARES, seconds):
            # most actions are followed by an unnamed movement
            if sequence.play(word, partial(self.act, rng, word), 6) and rng.random() > 0.75:
                continue
            if not sequence.play(UNLABELLED, lambda: self._between(rng, None)):
                self._go_home(rng, sequence)
        return sequence.motion()

    def _go_home(self, rng: np.random.Generator, sequence: BehaviourSequence) -> None:
        """An unnamed slow turn towards the centre, or, if cornered, a turn without translation."""
        x, y, z = sequence.position
        low, high = self.water
        away = (np.arctan2(-y, -x) - sequence.heading + np.pi) % (2 * np.pi) - np.pi
        level = 0.3 * np.clip(((low + high) / 2 - z) / (high - low), -1, 1)

        def home(pace: float) -> Array:
            t, roll = self._begin(rng, rng.uniform(1.2, 1.6))
            turn = away / t[-1] * 2.0 * bump(t, t[-1])
            return self._channels(
                t, roll, speed=pace, turn=turn, climb=level, front=0.25 * turn, hind=0.4 * turn
            )

        if not sequence.play(UNLABELLED, lambda: home(0.5)):
            inside = np.clip(z, low + 2.0, high - 2.0)
            half = self._half(inside) - 2.0
            sequence.nudge(np.array([*np.clip([x, y], -half, half), inside]))
            sequence.play(UNLABELLED, lambda: home(0.0))

    def _begin(self, rng: np.random.Generator, seconds: float) -> tuple[Array, Array]:
        """The clock of an action and the roll of a fish, rad."""
        t = clock(seconds)
        return t, np.radians(4.0) * slow_noise(rng, len(t), 1.5)[:, 0]

    def _channels(
        self,
        t: Array,
        roll: Array | float,
        *,
        speed: Array | float,
        turn: Array | float = 0.0,
        climb: Array | float = 0.0,
        front: Array | float = 0.0,
        hind: Array | float = 0.0,
        wave: Array | float = 0.0,
        beat: Array | float = 0.0,
    ) -> Array:
        """Control channels of one action; its speed is given in lengths per second."""
        columns = (speed * self.length_mm, turn, climb, roll, front, hind, wave, beat)
        return np.stack(np.broadcast_arrays(*columns, t)[:-1], axis=1).astype(float)

    def act(self, rng: np.random.Generator, word: str) -> Array:
        """Control channels of one action.

        Args:
            rng: random number generator.
            word: one of `ACTIONS`.

        Returns:
            (m, 8): speed mm/s, turning rad/s, climb rad, roll rad, bend of the front and of the
            hind half and amplitude of the wave in degrees per joint, beat Hz.
        """
        actions: dict[str, Callable[[np.random.Generator], Array]] = {
            "scoot": self._scoot,
            "j_turn": self._j_turn,
            "c_turn": self._c_turn,
            "r_turn": self._r_turn,
            "surface": partial(self._climb, side=1.0),
            "dive": partial(self._climb, side=-1.0),
            "zigzag": self._zigzag,
            "thrash": self._thrash,
            "freeze": self._freeze,
        }
        return actions[word](rng)

    def _seconds(self, rng: np.random.Generator, shortest: float, longest: float) -> float:
        return self.fish.duration(rng, shortest, longest, 0.15)

    def _wave(self, rng: np.random.Generator, pace: float) -> dict[str, float]:
        """Amplitude `wave` and rate `beat` of the body wave for a speed."""
        return {
            "wave": self.fish.bend * rng.uniform(0.9, 2.1) * np.sqrt(max(pace, 0.05)),
            "beat": self.fish.tempo * (2.5 + 1.1 * pace) * rng.uniform(0.85, 1.2),
        }

    def _scoot(self, rng: np.random.Generator) -> Array:
        t, roll = self._begin(rng, self._seconds(rng, 0.25, 1.6))
        pace = self.fish.vigour * rng.uniform(0.7, 3.6)
        swing = self._wave(rng, pace)
        beating = t < rng.uniform(0.55, 1.0) * t[-1]
        bend = rng.normal(0.0, 0.5)
        return self._channels(
            t,
            roll,
            speed=pace * np.where(beating, 1.0, np.exp(-(t - t[beating][-1]) / 0.35)),
            wave=swing["wave"] * np.where(beating, 1.0, 0.15),
            beat=swing["beat"],
            turn=np.radians(rng.normal(0.0, 14.0))
            + np.radians(10.0) * slow_noise(rng, len(t), 0.4)[:, 0],
            front=bend,
            hind=1.5 * bend,
            climb=np.radians(rng.normal(0.0, 5.0)),
        )

    def _j_turn(self, rng: np.random.Generator) -> Array:
        t, roll = self._begin(rng, self._seconds(rng, 0.3, 1.4))
        side = self.fish.turn_side(rng)
        rate = self.fish.tempo * rng.uniform(2.2, 5.0)
        beats = 0.5 - 0.5 * np.cos(2 * np.pi * np.minimum(rate, 2.0 / t[-1] + rate) * t)
        hind = side * self.fish.bend * rng.uniform(1.9, 4.6) * (0.25 + 0.75 * beats)
        return self._channels(
            t,
            roll,
            hind=hind,
            front=0.12 * hind + rng.normal(0.0, 0.2),
            turn=side * np.radians(rng.uniform(8.0, 42.0)) / t[-1] * (0.3 + 1.4 * beats),
            speed=self.fish.vigour * rng.uniform(0.1, 1.1),
            wave=rng.uniform(0.1, 0.7),
            beat=rate,
            climb=np.radians(rng.normal(0.0, 5.0)),
        )

    def _bent(
        self, rng: np.random.Generator, shape: Array, total_deg: float, lag_s: float
    ) -> tuple[Array, Array]:
        """Bends, in front and behind, that sum to total_deg at the shape's peak; the tail lags."""
        hind = rng.uniform(0.52, 0.64)
        lag = max(1, round(lag_s / STEP_S))
        late = np.concatenate([np.zeros(lag), shape])[: len(shape)]
        return total_deg * (1.0 - hind) / 9.0 * shape, total_deg * hind / 10.0 * late

    def _r_turn(self, rng: np.random.Generator) -> Array:
        t, roll = self._begin(rng, self._seconds(rng, 0.25, 0.95))
        side = self.fish.turn_side(rng)
        total = float(np.clip(self.fish.bend * rng.normal(72.0, 17.0), 44.0, 112.0))
        shape = bump(t, t[-1] * rng.uniform(0.75, 1.0), rng.uniform(0.3, 0.5))
        front, hind = self._bent(rng, side * shape, total, 0.02)
        turn = side * np.radians(total * rng.uniform(0.5, 1.1)) * shape / (shape.sum() * STEP_S)
        pace = self.fish.vigour * rng.uniform(0.3, 2.8)
        return self._channels(
            t,
            roll,
            speed=pace * (0.5 + 0.5 * t / t[-1]),
            turn=turn,
            front=front,
            hind=hind,
            **self._wave(rng, 0.4 * pace),
            climb=np.radians(rng.normal(0.0, 6.0)),
        )

    def _c_turn(self, rng: np.random.Generator) -> Array:
        t, roll = self._begin(rng, self._seconds(rng, 0.16, 0.7))
        side = self.fish.turn_side(rng)
        total = float(np.clip(self.fish.bend * rng.normal(132.0, 22.0), 88.0, 178.0))
        first = rng.uniform(0.05, 0.10)
        back = rng.uniform(0.06, 0.11)
        bend = bump(t, first + back, first / (first + back))
        counter = bump(t - first - 0.6 * back, 1.6 * back) * (t > first + 0.6 * back)
        bends = side * (bend - rng.uniform(0.15, 0.45) * counter)
        front, hind = self._bent(rng, bends, total, 0.012)
        shape = bump(t, 1.4 * first + 0.5 * back)
        turn = side * np.radians(total * rng.uniform(0.55, 1.0)) * shape / (shape.sum() * STEP_S)
        pace = self.fish.vigour * rng.uniform(2.5, 9.0)
        glide = np.exp(-np.maximum(t - first - 0.1, 0.0) / rng.uniform(0.2, 0.5))
        swing = self._wave(rng, 0.5 * pace)
        return self._channels(
            t,
            roll,
            speed=pace * np.where(t < first, 0.15, glide),
            turn=turn,
            climb=np.radians(rng.normal(0.0, 9.0)),
            front=front,
            hind=hind,
            wave=swing["wave"] * np.clip((t - first) / 0.08, 0.0, 1.0),
            beat=swing["beat"],
        )

    def _climb(self, rng: np.random.Generator, side: float) -> Array:
        t, roll = self._begin(rng, self._seconds(rng, 0.5, 2.6))
        pace = self.fish.vigour * rng.uniform(0.6, 2.6)
        climb = side * np.radians(rng.uniform(15.0, 45.0)) * np.minimum(1.0, (t + 0.1) / 0.3)
        return self._channels(
            t,
            roll,
            speed=pace,
            climb=climb,
            **self._wave(rng, pace),
            turn=np.radians(rng.normal(0.0, 12.0))
            + np.radians(9.0) * slow_noise(rng, len(t), 0.5)[:, 0],
            front=rng.normal(0.0, 0.4),
        )

    def _zigzag(self, rng: np.random.Generator) -> Array:
        t, roll = self._begin(rng, self._seconds(rng, 0.8, 2.6))
        turn, bends = np.zeros(len(t)), np.zeros((2, len(t)))
        at = 0.0
        side = self.fish.turn_side(rng)
        while at < t[-1]:
            length = rng.uniform(0.16, 0.36) / self.fish.tempo
            shape = bump(t - at, length, 0.4) * (t >= at)
            angle = np.radians(rng.uniform(65.0, 140.0))
            turn += side * angle * shape / max(shape.sum() * STEP_S, 0.5 * length)
            bends += self._bent(rng, side * shape, self.fish.bend * rng.uniform(40.0, 105.0), 0.02)
            at = at + length * rng.uniform(0.8, 1.3)
            side = -side
        pace = self.fish.vigour * rng.uniform(1.2, 4.5)
        speed = pace * (0.8 + 0.25 * slow_noise(rng, len(t), 0.25)[:, 0])
        return self._channels(
            t,
            roll,
            speed=speed,
            turn=turn,
            front=bends[0],
            hind=bends[1],
            **self._wave(rng, 0.5 * pace),
            climb=np.radians(7.0) * slow_noise(rng, len(t), 0.5)[:, 0],
        )

    def _thrash(self, rng: np.random.Generator) -> Array:
        t, roll = self._begin(rng, self._seconds(rng, 0.4, 2.4))
        beat = self.fish.tempo * rng.uniform(3.5, 7.5)
        return self._channels(
            t,
            2.0 * roll,
            wave=self.fish.bend * rng.uniform(3.4, 7.5),
            beat=beat,
            turn=rng.uniform(1.0, 5.0) * np.sin(2 * np.pi * beat * t + rng.uniform(0, 6))
            + rng.normal(0.0, 0.4),
            speed=self.fish.vigour
            * np.abs(rng.uniform(0.0, 0.6) + 0.25 * slow_noise(rng, len(t), 0.3)[:, 0]),
            climb=np.radians(rng.normal(0.0, 10.0)),
        )

    def _freeze(self, rng: np.random.Generator) -> Array:
        t, roll = self._begin(rng, self._seconds(rng, 0.9, 2.7))
        speed, bend = rng.uniform(0.0, 0.08), rng.normal(0.0, 0.5)
        climb = np.radians(rng.normal(0.0, 7.0))
        return self._channels(t, roll[0], speed=speed, climb=climb, front=bend, hind=1.5 * bend)

    def _between(self, rng: np.random.Generator, seconds: float | None) -> Array:
        """Unnamed movements: gliding, hovering, weak turns and climbs, swimming backwards."""
        kind = rng.choice(5, p=[0.34, 0.28, 0.2, 0.1, 0.08])
        spans = [(0.2, 1.0), (0.3, 2.0), (0.35, 0.9), (0.5, 1.2), (0.3, 0.8)]
        t, roll = self._begin(rng, seconds or self._seconds(rng, *spans[kind]))
        vigour = self.fish.vigour
        climb = np.radians(rng.normal(0.0, 5.0))
        turn = np.radians(12.0) * slow_noise(rng, len(t), 0.5)[:, 0]
        own: dict[str, Array | float] = {"turn": turn, "climb": climb, "beat": 3.0}
        if kind == 0:  # gliding
            pace = vigour * rng.uniform(0.3, 2.2) * np.exp(-t / 0.45)
            own |= {"speed": pace, "wave": rng.uniform(0.0, 0.4)}
        elif kind == 1:  # hovering
            own |= {
                "speed": vigour * (0.3 + 0.15 * slow_noise(rng, len(t), 0.4)[:, 0]),
                "wave": rng.uniform(0.2, 0.9),
                "beat": self.fish.tempo * rng.uniform(1.5, 3.5),
                "hind": 0.6 * slow_noise(rng, len(t), 0.4)[:, 0],
            }
        elif kind == 2:  # a weak turn
            side = self.fish.turn_side(rng)
            total = rng.uniform(10.0, 40.0)
            shape = bump(t, t[-1])
            front, hind = self._bent(rng, side * shape, total, 0.03)
            angle = side * np.radians(total * rng.uniform(0.6, 1.0))
            own |= {
                "front": front,
                "hind": hind,
                "turn": turn + angle * shape / (shape.sum() * STEP_S),
                "speed": vigour * rng.uniform(0.2, 1.2),
                "wave": rng.uniform(0.1, 0.5),
            }
        elif kind == 3:  # a weak climb
            own |= {
                "climb": np.radians(rng.uniform(6.0, 13.0)) * rng.choice([-1.0, 1.0]),
                "speed": vigour * rng.uniform(0.2, 0.8),
                "wave": rng.uniform(0.3, 0.8),
            }
        else:  # backing
            own |= {
                "speed": -vigour * rng.uniform(0.1, 0.5),
                "wave": rng.uniform(0.3, 1.0),
                "beat": 3.5,
            }
        return self._channels(t, roll, **own)


def fish_poses(
    rng: np.random.Generator,
    species: FishSpecies,
    motion: ActedMotion,
    rows: NDArray[np.int64],
    size: float,
) -> Pose:
    """Poses of a fish at some steps of its motion.

    Args:
        rng: random number generator for small standing waves and the length of the travelling one.
        species: the species.
        motion: its motion.
        rows: (n,) int64 steps of the motion.
        size: of the fish over home size.

    Returns:
        Poses (n) in the arena frame.
    """
    m = len(motion.heading)
    n = len(rows)
    phase = 2 * np.pi * np.cumsum(motion.channels[:, _BEAT]) * STEP_S
    own = 0.5 * slow_noise(rng, m, 0.25, 4)[rows]
    length = rng.uniform(0.9, 1.1)
    c = motion.channels[rows]
    yaw = bend_profile(
        species.skeleton,
        c[:, _FRONT],
        c[:, _HIND],
        c[:, _WAVE],
        phase[rows],
        np.full(n, length),
        np.full(n, 0.47),
        own * (0.2 + np.minimum(c[:, _WAVE], 1.0))[:, None],
    )
    rotation = root_rotation(motion.heading[rows], c[:, CLIMB], c[:, _ROLL])
    pose = hung(species.skeleton, yaw, rotation, np.full(n, size))
    pose.root.translation[:] += motion.position[rows]
    return pose


def depth_of_water(
    species: FishSpecies, shape: BodyShape, size: float, camera_mm: float
) -> tuple[float, float]:
    """Lowest and highest position of a fish's centre for which its body stays in the water.

    Args:
        species: the species.
        shape: its body.
        size: over home size.
        camera_mm: height of the camera above the floor, mm; no part is nearer to it than 185 mm.

    Returns:
        Lowest and highest, mm above the floor.
    """
    reach = size * (float(np.max(shape.half_height)) + 0.36 * species.skeleton.length)
    return reach, camera_mm - 185.0 - reach
