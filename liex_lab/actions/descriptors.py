"""The descriptors of the paper: a cut-out sequence, resampled to 32 frames, as one row of numbers
(Lie-X section 6).

Per frame, tangent vectors: of the base, the twist from this frame to the next, in its own frame
(6); of the front half and of the hind half of the chain, the rotation of a joint against the one
before it and its change to the next frame, averaged over the half's joints (3 + 3 each). The paper
states 252 = 7 x 2 x 18 and three sub-vectors of equal length; that each half holds three rotation
numbers of either kind is our reading, as bones are rigid and a joint's twist has no other. Joint
positions: all joints in the arena frame (63 for the fish), and the base's mean position and
orientation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.labels import some_rows
from liex_lab.geometry import SE3, so3
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]

N_FRAMES = 32
_PYRAMID = (4, 2, 1)  # equal parts, each described by its mean and standard deviation


def tangent_descriptor(track: Track) -> Array:
    """(252,) of a sequence: the temporal pyramid over its tangent vectors. Frames without a pose
    are left out.
    """
    root, angles = _resampled(track)
    now, following = (
        SE3(root.rotation[part], root.translation[part])
        for part in (slice(None, -1), slice(1, None))
    )
    step = (now.inverse() @ following).log()
    base = np.concatenate([step, step[-1:]])
    change = np.diff(angles, axis=0)
    change = np.concatenate([change, change[-1:]])
    middle = 1 + (track.skeleton.n_joints - 1) // 2  # joints 1-10 of the fish, the rest after them
    halves = [
        rows[:, part].mean(axis=1)
        for part in (slice(1, middle), slice(middle, -1))
        for rows in (angles, change)
    ]
    return pyramid(np.concatenate([base, *halves], axis=1))


def position_descriptor(track: Track) -> Array:
    """(888,) of a fish's sequence: the temporal pyramid over its joint positions, and the base's
    mean place.
    """
    seen = track.observed
    if seen.sum() < 2:
        return np.zeros(14 * 3 * track.skeleton.n_joints + 6)
    joints = _lerp(track.joints_mm[seen], _places(seen.sum()))
    root = some_rows(track, seen).root
    place = np.concatenate([root.translation.mean(axis=0), so3.log(so3.mean(root.rotation))])
    return np.concatenate([pyramid(joints.reshape(N_FRAMES, -1)), place])


def pyramid(rows: Array) -> Array:
    """Mean and standard deviation of rows (32, k) over quarters, halves and the whole: (14 k,)."""
    parts = [part for n in _PYRAMID for part in np.split(rows, n)]
    return np.concatenate([np.concatenate([part.mean(axis=0), part.std(axis=0)]) for part in parts])


def _resampled(track: Track) -> tuple[SE3, Array]:
    """Base T_arena_root (32) along geodesics and joint angles (32, J, 3) of the frames that have a
    pose.
    """
    seen = track.observed
    n = int(seen.sum())
    if n < 2:
        return SE3.identity(N_FRAMES), np.zeros((N_FRAMES, track.skeleton.n_joints, 3))
    kept = some_rows(track, seen)
    at = _places(n)
    low = np.minimum(at.astype(int), n - 2)
    before, after = (SE3(kept.root_rotation[rows], kept.root_mm[rows]) for rows in (low, low + 1))
    return before.geodesic(after, at - low), _lerp(kept.angles_rad, at)


def _places(n: int) -> Array:
    """Where (32,) among n frames the resampled ones lie."""
    return np.linspace(0.0, n - 1.0, N_FRAMES)


def _lerp(values: Array, at: Array) -> Array:
    """Rows of values (n, ...) at fractional places (32,)."""
    low = np.minimum(at.astype(int), len(values) - 2)
    share = (at - low).reshape(-1, *([1] * (values.ndim - 1)))
    return values[low] * (1.0 - share) + values[low + 1] * share
