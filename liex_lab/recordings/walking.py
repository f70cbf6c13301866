"""A synthetic recording in which the mouse moves as one animal: it walks, turns, pauses, rears, hunches and curls."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.shape import BodyShape
from liex_lab.body.skeleton import Skeleton
from liex_lab.recordings.habits import MouseHabits
from liex_lab.recordings.postures import KINDS, Posture, draw_postures, stand
from liex_lab.recordings.sensors import KINECT_V2_SENSOR, Sensor
from liex_lab.recordings.stage import Stage, floor_point
from liex_lab.recordings.synthetic import SyntheticSession, assemble

Array = NDArray[np.float64]

_RATE_HZ = 30.0
# the stretches of a walk: how many in a shuffled deck, shortest and longest duration in s, speed in spines a second
_WALK, _CURL, _REAR, _HUNCH, _REACH = range(len(KINDS))
_STRETCHES = {
    _WALK: (4, 0.7, 3.0, (0.6, 2.8)),
    _CURL: (1, 0.5, 1.5, (0.0, 0.6)),
    _REAR: (2, 0.7, 2.0, (0.0, 0.0)),
    _HUNCH: (1, 1.0, 3.0, (0.0, 0.0)),
    _REACH: (2, 0.4, 1.2, (0.0, 0.4)),
}
_BLEND_S = 0.12  # postures flow into one another over about this long
_STRIDE_HZ_PER_SPINE = 1.6


def walking_session(
    seed: int | list[int],
    n_frames: int,
    *,
    sensor: Sensor = KINECT_V2_SENSOR,
    family: str = "train",
    noise: float = 1.0,
    erosion_px: int = 0,
    thing_share: float = 0.0,
    spine_mm: float | None = None,
    habits: MouseHabits | None = None,
    name: str = "walking",
) -> SyntheticSession:
    """n_frames of one animal at 30 frames/s, drawn from the seed; arguments as in `SyntheticSession.draw`."""
    rng = np.random.default_rng(seed)
    habits = MouseHabits() if habits is None else habits
    skeleton = habits.skeleton
    spine = skeleton.length * float(rng.uniform(*habits.sizes)) if spine_mm is None else float(spine_mm)
    stage = Stage.draw(rng, sensor.camera, spine)
    shape = habits.shapes(rng, family, 1)
    kinds, spines_per_s = _script(rng, n_frames)
    posture = _flow(rng, skeleton, shape[0].broadcast(n_frames), kinds)
    position, heading = _path(rng, stage, spine, spines_per_s * spine)
    # the trunk sways with the stride
    phase = 2 * np.pi * np.cumsum(np.sqrt(spines_per_s) * _STRIDE_HZ_PER_SPINE) / _RATE_HZ
    posture.turn[:, 1:-1] += (0.06 * np.minimum(spines_per_s, 1.0) * np.sin(phase))[:, None] * [1.0, -0.5, -0.5]
    pose, girth = stand(
        skeleton, posture, heading, np.full(n_frames, spine / skeleton.length), shape[0].broadcast(n_frames),
        _smooth(rng.uniform(0.0, 3.0, n_frames)[:, None])[:, 0],
    )  # fmt: skip
    middle = pose.joints(skeleton)[..., :2].mean(axis=1)
    pose.root.translation[:, :2] += position - middle
    cast = assemble(rng, stage, sensor, habits, spine, shape, pose, girth, noise, erosion_px, thing_share, False)
    assert cast.bends is not None  # mice have tails
    cast.bends[:] = cast.bends[:1] + 4.0 * _smooth(rng.normal(0.0, 0.05, cast.bends.shape))
    return SyntheticSession(name, stage, cast)


def _script(rng: np.random.Generator, n: int) -> tuple[NDArray[np.int64], Array]:
    """What the animal does in each frame (n,), and how fast it goes (n,) spines/s."""
    kinds, speed = np.empty(n, np.int64), np.empty(n)
    deck: list[int] = []
    at = 0
    while at < n:
        if not deck:  # dealt out before it is shuffled again, so that nothing is long absent
            deck = [int(k) for k in rng.permutation(np.repeat(range(len(KINDS)), [_STRETCHES[k][0] for k in range(5)]))]
        kind = deck.pop()
        _, shortest, longest, (slow, fast) = _STRETCHES[kind]
        stop = at + int(_RATE_HZ * rng.uniform(shortest, longest))
        kinds[at:stop], speed[at:stop] = kind, rng.uniform(slow, fast)
        at = stop
    return kinds, np.maximum(_smooth(speed[:, None])[:, 0], 0.0)


def _flow(rng: np.random.Generator, skeleton: Skeleton, shape: BodyShape, kinds: NDArray[np.int64]) -> Posture:
    """One posture a stretch, held with slow changes within it, and blended where the next begins."""
    drawn = draw_postures(rng, skeleton, kinds, shape)
    n = len(kinds)
    change = np.concatenate([[True], (kinds[1:] != kinds[:-1]) | (rng.random(n - 1) < 0.04)])
    keep = np.maximum.accumulate(np.where(change, np.arange(n), 0))
    rows = [drawn.elevation, drawn.turn, drawn.roll[:, None], drawn.stretch[:, None]]
    elevation, turn, roll, stretch = (_smooth(row[keep]) for row in rows)
    return Posture(elevation, turn, roll[:, 0], stretch[:, 0])


def _smooth(rows: Array) -> Array:
    """Columns of (n, k) passed through a bell of _BLEND_S, ends held."""
    reach = int(4 * _BLEND_S * _RATE_HZ)
    bell = np.exp(-0.5 * (np.arange(-reach, reach + 1) / (_BLEND_S * _RATE_HZ)) ** 2)
    padded = np.pad(rows, ((reach, reach), (0, 0)), mode="edge")
    return np.stack([np.convolve(column, bell / bell.sum(), mode="valid") for column in padded.T], axis=-1)


def _path(rng: np.random.Generator, stage: Stage, spine_mm: float, speed: Array) -> tuple[Array, Array]:
    """Positions (n, 2) mm of the body's middle and headings (n,) rad: it wanders, and turns back before a wall."""
    n, camera = len(speed), stage.camera
    middle = floor_point(camera, stage.T_arena_camera, np.array([(camera.width - 1) / 2.0, (camera.height - 1) / 2.0]))
    home = stage.centre if stage.freedom(stage.centre) > stage.freedom(middle) else middle
    margin = min(0.85 * spine_mm, 0.7 * stage.freedom(home))
    position, heading = np.empty((n, 2)), np.empty(n)
    at, way, rate = home + rng.normal(0.0, 0.2 * margin, 2), rng.uniform(-np.pi, np.pi), 0.0
    for i in range(n):
        rate = 0.93 * rate + rng.normal(0.0, 0.25)
        back = np.arctan2(home[1] - at[1], home[0] - at[0])
        away = (back - way + np.pi) % (2 * np.pi) - np.pi
        close = np.clip(1.0 - (stage.freedom(at) - margin) / (0.8 * spine_mm), 0.0, 1.0)
        # it turns back faster the faster it goes, and stays within a mouse's turning rate
        pull = 6.0 * close * np.clip(away, -1.0, 1.0) * min(speed[i] / spine_mm, 1.0)
        way += np.clip(rate * (0.2 + min(speed[i] / spine_mm, 1.0)) + pull, -7.0, 7.0) / _RATE_HZ
        step = speed[i] / _RATE_HZ * np.array([np.cos(way), np.sin(way)])
        if stage.freedom(at + step) > margin or stage.freedom(at + step) > stage.freedom(at):
            at = at + step
        position[i], heading[i] = at, way
    return position, heading
