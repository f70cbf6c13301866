"""A synthetic recording in which a fish moves as one animal: it scoots, glides, turns, rises, dives and rests."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.recordings.fish import FishHabits, bend_profile, clearance, hung
from liex_lab.recordings.paths import smoothed, wander
from liex_lab.recordings.postures import root_rotation
from liex_lab.recordings.sensors import RAYTRIX_R5_SENSOR, Sensor
from liex_lab.recordings.stage import Stage
from liex_lab.recordings.synthetic import SyntheticSession, assemble

Array = NDArray[np.float64]

_NEAREST_MM = 180.0  # to the camera
_BOUT_S, _REST_S = (0.15, 0.6), (0.1, 1.2)  # of beating, and of gliding or hanging still between
_GLIDE_S = 0.35  # a glide has slowed down by a factor e after this long
_LENGTHS_S = (1.0, 5.0)  # speed that a bout reaches
_BEAT_HZ = (4.0, 9.0)
_TURN_SHARE, _TURN_RAD_S = 0.35, (4.0, 16.0)  # of the bouts begin with a turn, which lasts _TURN_S
_TURN_S = 0.14
_BEND_PER_TURN = 0.55  # degrees a joint for each rad/s of turning
_CLIMB_RAD = np.radians(25.0)


def swimming_session(
    seed: int | list[int],
    n_frames: int,
    *,
    sensor: Sensor = RAYTRIX_R5_SENSOR,
    family: str = "train",
    noise: float = 1.0,
    erosion_px: int = 0,
    thing_share: float = 0.0,
    spine_mm: float | None = None,
    habits: FishHabits | None = None,
    name: str = "swimming",
) -> SyntheticSession:
    """n_frames of one fish at 50 frames/s, drawn from the seed; arguments as in `SyntheticSession.draw`."""
    rng = np.random.default_rng(seed)
    habits = FishHabits() if habits is None else habits
    skeleton = habits.skeleton
    length = skeleton.length * float(rng.uniform(*habits.sizes)) if spine_mm is None else float(spine_mm)
    stage = Stage.draw(rng, sensor.camera, length, habits.setting)
    shape = habits.shapes(rng, family, 1)
    step_s = habits.frame_ns * 1e-9
    speed, turning, amplitude, beat = _script(rng, n_frames, step_s)
    middle = np.full(n_frames, 0.47)
    # a turn begins in front and leaves the body at the tail; the wave runs from head to tail
    hind = np.concatenate([np.zeros(2), turning[:-2]]) if n_frames > 2 else turning
    yaw = bend_profile(
        skeleton, _BEND_PER_TURN * turning, 1.3 * _BEND_PER_TURN * hind, amplitude, beat, np.ones(n_frames), middle,
        smoothed(rng.normal(0.0, 0.8, (n_frames, 4)), 6.0),
    )  # fmt: skip
    size = np.full(n_frames, length / skeleton.length)
    pitch = _CLIMB_RAD * np.tanh(smoothed(rng.normal(0.0, 6.0, (n_frames, 1)), 25.0)[:, 0])
    roll = np.radians(smoothed(rng.normal(0.0, 12.0, (n_frames, 1)), 8.0)[:, 0])
    level = hung(skeleton, yaw, root_rotation(np.zeros(n_frames), pitch, roll), size)
    low, high = clearance(skeleton, level, shape[0].broadcast(n_frames), size)
    top = max(float(stage.T_arena_camera.translation[2]) - _NEAREST_MM - float(high.max()), float(low.max()) + 2.0)
    position, heading = wander(rng, stage, length, speed, turning, pitch, (float(low.max()) + 0.5, top), step_s)
    pose = hung(skeleton, yaw, root_rotation(heading, pitch, roll), size)
    pose.root.translation[:] += position
    cast = assemble(rng, stage, sensor, habits, length, shape, pose, size, noise, erosion_px, thing_share, False)
    return SyntheticSession(name, stage, cast, np.arange(n_frames, dtype=np.int64) * habits.frame_ns)


def _script(rng: np.random.Generator, n: int, step_s: float) -> tuple[Array, Array, Array, Array]:
    """Speed (n,) in lengths/s, turning (n,) rad/s, amplitude (n,) degrees a joint and phase (n,) rad of the tail."""
    speed, turning, amplitude, rate = np.zeros((4, n))
    at, pace = 0, 0.0
    while at < n:
        reached, beats = rng.uniform(*_LENGTHS_S), rng.uniform(*_BEAT_HZ)
        beating, resting = (max(2, int(rng.uniform(*span) / step_s)) for span in (_BOUT_S, _REST_S))
        stop = min(at + beating, n)
        pace = max(reached, pace)
        speed[at:stop] = pace
        amplitude[at:stop], rate[at:stop] = rng.uniform(1.5, 5.0) * np.sqrt(pace / _LENGTHS_S[1]), beats
        if rng.random() < _TURN_SHARE:
            brief = min(at + max(2, int(_TURN_S / step_s)), n)
            turning[at:brief] = rng.choice([-1.0, 1.0]) * rng.uniform(*_TURN_RAD_S)
        glide = np.arange(max(0, min(resting, n - stop)))
        speed[stop : stop + resting] = pace * np.exp(-(glide + 1) * step_s / _GLIDE_S)
        pace *= float(np.exp(-resting * step_s / _GLIDE_S))
        at = stop + resting
    turning = smoothed(turning[:, None], 1.2)[:, 0] + smoothed(rng.normal(0.0, 3.0, (n, 1)), 12.0)[:, 0]
    amplitude = smoothed(amplitude[:, None], 2.0)[:, 0]
    return smoothed(speed[:, None], 1.5)[:, 0], turning, amplitude, 2 * np.pi * np.cumsum(rate) * step_s
