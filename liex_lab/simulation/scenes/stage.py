"""The animals of a scene: body, path and presence of each.

Body, posture and path of an animal are drawn from the seed alone, not from the scene, so that the
animal behaves the same in every scene of a seed, as far as the arena permits.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body.shape import Surface
from liex_lab.simulation.locomotion import Path, free_path, smoothed, waver
from liex_lab.simulation.recording import Actor, Take
from liex_lab.simulation.scene import SimulatedScene
from liex_lab.simulation.species import Species

_RATE_HZ = 30.0
_TRIES = 60


def draw_animal(
    seed: int,
    which: int,
    species: Species,
    arena: SimulatedScene,
    take: Take,
    timing: tuple[NDArray[np.int64], NDArray[np.bool_]],
    script: Callable[..., Any] | None = None,
    path: Path | None = None,
) -> Actor:
    """An animal that moves in an arena.

    Args:
        seed: of the recording.
        which: number of the animal.
        species: the animal's.
        arena: the arena.
        take: its length and the family of its body's shape.
        timing: index of the moment of its walk in each frame (n,), and its presence (n,).
        script: its activity, see `locomotion.walk` and `locomotion.swim`.
        path: its path, likewise.
    """
    moments, present = timing
    body = np.random.default_rng([seed, which, 1])
    drawn = body.uniform(55.0, 75.0)
    spine = float(drawn if take.spine_mm is None else take.spine_mm)
    shape = species.shapes(body, take.family, 1)
    n_moments = int(moments.max()) + 1
    motion, tail = (np.random.default_rng([seed, which, part]) for part in (2, 3))
    pose, girth = species.locomotion(
        motion, arena, species.skeleton, shape, spine, n_moments, script, path
    )
    bends = species.bends(tail, 1)
    if bends is not None:
        bends = (bends + waver(tail, (n_moments, bends.shape[1])))[moments]
    asleep = np.diff(moments, prepend=moments[0] - 1) == 0
    # share of the girth; breaths per frame
    breath = 1.0 + 0.012 * np.sin(2 * np.pi * 2.5 * np.arange(len(moments)) / _RATE_HZ)
    girth = girth[moments] * np.where(asleep, breath, 1.0)
    surface = Surface.of(species.skeleton)
    return Actor(surface, spine, shape, pose[moments], girth, bends, present)


def timing_of(presence: str, n_frames: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Presence and timing of an animal.

    Args:
        presence: 'always'; 'asleep', motionless for 78 % of the recording; 'still', for all of it;
            'late', from two thirds on; 'leaves', for the first 45 %; or 'never'.
        n_frames: length of the recording.

    Returns:
        Index of the moment of its walk in each frame (n,), and its presence (n,).
    """
    frame = np.arange(n_frames)
    always = np.ones(n_frames, np.bool_)
    falls, wakes, comes = (int(share * n_frames) for share in (0.12, 0.90, 2.0 / 3.0))
    slept = np.where(frame < falls, frame, np.maximum(falls, frame - (wakes - falls)))
    return {
        "always": (frame, always),
        "asleep": (slept, always),
        "still": (np.zeros(n_frames, np.int64), always),
        "late": (np.maximum(frame - comes, 0), frame >= comes),
        "leaves": (frame, frame < max(1, int(0.45 * n_frames))),
        "never": (frame, ~always),
    }[presence]


def calm_script(rng: np.random.Generator, n: int) -> tuple[NDArray[np.int64], Array]:
    """A mouse that walks without rearing, with pauses.

    Returns:
        Kinds of posture (n,) and speeds (n,), spines/s, see `locomotion.walk_script`.
    """
    speed = np.empty(n)
    at = 0
    while at < n:
        stop = at + int(_RATE_HZ * rng.uniform(0.8, 2.5))
        speed[at:stop] = rng.uniform(1.0, 2.4)
        pause = stop + int(_RATE_HZ * rng.uniform(0.1, 0.8))
        speed[stop:pause] = 0.0
        at = pause
    return np.zeros(n, np.int64), np.maximum(smoothed(speed, 3.6), 0.0)


def visiting(door: Array, inside: Array, spans: tuple[tuple[float, float], ...]) -> Path:
    """A path that starts in front of a house, and enters it at given times.

    Args:
        door: (2,) in front of the house, mm, arena frame.
        inside: (2,) inside it.
        spans: start and end of the times inside, as shares of the recording.

    Returns:
        A path for `locomotion.walk`.
    """

    def path(
        rng: np.random.Generator, scene: SimulatedScene, spine_mm: float, speed: Array
    ) -> tuple[Array, Array]:
        n = len(speed)
        position, heading = np.empty((n, 2)), np.empty(n)
        goals = [free_spot(rng, scene, 0.8 * spine_mm) for _ in range(40)]
        at = door + 0.6 * (door - inside)
        way = rng.uniform(-np.pi, np.pi)
        passing = False  # inside, or on the way through the door
        for i in range(n):
            invited = any(low <= i / n < high for low, high in spans)
            at_door = bool(np.linalg.norm(at - door) < 25.0)
            passing = passing or at_door if invited else passing and not at_door
            goal = inside if invited and passing else goals[(i // 45) % len(goals)]
            if invited != passing:
                goal = door
            gap = goal - at
            # not there yet
            if np.linalg.norm(gap) > 6.0:
                errand = invited or passing
                ahead = np.arctan2(gap[1], gap[0])
                # up to 5 rad/s, twice as fast on an errand
                most = (2.0 if errand else 1.0) * 5.0 / _RATE_HZ
                way += np.clip((ahead - way + np.pi) % (2 * np.pi) - np.pi, -most, most)
                # at least 1.8 spines per second on an errand
                run = max(speed[i], 1.8 * spine_mm * errand) / _RATE_HZ
                facing = max(float(np.cos(ahead - way)), 0.1)
                step = run * facing * np.array([np.cos(way), np.sin(way)])
                if errand or scene.freedom(at + step) > 0.4 * spine_mm:
                    at = at + step
            position[i], heading[i] = at, way
        return position, heading

    return path


def free_spot(rng: np.random.Generator, scene: SimulatedScene, margin_mm: float) -> Array:
    """A random position in an arena, away from walls and clutter.

    Args:
        rng: random number generator.
        scene: the arena.
        margin_mm: minimum distance from them, mm.

    Returns:
        (2,) mm, arena frame; of some random positions the first free one, else the best.
    """
    spots = scene.centre + rng.uniform(-1.0, 1.0, (_TRIES, 2)) * scene.half
    room = np.array([scene.freedom(spot) for spot in spots])
    free = room > margin_mm
    return np.asarray(spots[int(np.argmax(free)) if free.any() else int(np.argmax(room))])


def keeping_apart(other: Array, spine_mm: float) -> Path:
    """A path that avoids another animal's path.

    Args:
        other: (n, 2) positions of the other, mm, arena frame.
        spine_mm: its length, mm.

    Returns:
        A path for `locomotion.walk`: the first of some free paths that stays clear, else the best.
    """

    def path(
        rng: np.random.Generator, scene: SimulatedScene, own_mm: float, speed: Array
    ) -> tuple[Array, Array]:
        tried: list[tuple[Array, Array]] = []
        gaps: list[float] = []
        while len(tried) < _TRIES and (not gaps or gaps[-1] <= 0.95 * 0.5 * (spine_mm + own_mm)):
            tried.append(free_path(rng, scene, own_mm, speed))
            gaps.append(np.linalg.norm(tried[-1][0] - other[: len(speed)], axis=1).min())
        return tried[int(np.argmax(gaps))]

    return path
