"""Random forest on temporal-pyramid descriptors of cut-out sequences (Lie-X section 4.3).

The paper's recogniser: 50 trees of depth 20 (Breiman 2001, by scikit-learn) whose averaged leaf
histograms give the class. Used to reproduce the paper's evaluation (section 5.4); uncut recordings
use `timeline`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.labels import some_rows
from liex_lab.geometry import SE3, so3
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]

N_FRAMES = 32


def tangent_descriptor(track: Track) -> Array:
    """The temporal pyramid over a sequence's tangent vectors.

    Frames without a measured pose are left out; a sequence with fewer than two poses has no
    movement. The end-effector has no rotation and is left out of the hind half.

    Args:
        track: the sequence, of a skeleton that is one chain.

    Returns:
        (252,), rad and mm.
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
    # for the fish, joints 2 to 10 and 11 to the last in the paper's count from the base
    middle = max(2, (track.skeleton.n_joints - 1) // 2)
    halves = [
        rows[:, part].mean(axis=1)
        for part in (slice(1, middle), slice(middle, -1))
        for rows in (angles, change)
    ]
    return pyramid(np.concatenate([base, *halves], axis=1))


def position_descriptor(track: Track) -> Array:
    """The temporal pyramid over a sequence's joint positions, and the base's mean pose.

    Args:
        track: the sequence.

    Returns:
        (42 J + 6,), 888 for a fish's 21 joints: mm, arena frame, then the base's mean position, mm,
            and mean rotation vector, rad; zeros if fewer than two poses were measured.
    """
    observed = track.observed
    if observed.sum() < 2:
        return np.zeros(14 * 3 * track.skeleton.n_joints + 6)
    joints = _lerp(track.joints_mm[observed], _places(observed.sum()))
    root = some_rows(track, observed).root
    base = np.concatenate([root.translation.mean(axis=0), so3.log(so3.mean(root.rotation))])
    return np.concatenate([pyramid(joints.reshape(N_FRAMES, -1)), base])


def pyramid(rows: Array) -> Array:
    """Mean and standard deviation over quarters, halves and the whole.

    Args:
        rows: (32, k) features of each frame.

    Returns:
        (14 k,) for each of the 7 parts, k means and k standard deviations.
    """
    # equal parts, each described by its mean and standard deviation
    parts = [part for n in (4, 2, 1) for part in np.split(rows, n)]
    return np.concatenate([np.concatenate([part.mean(axis=0), part.std(axis=0)]) for part in parts])


def _resampled(track: Track) -> tuple[SE3, Array]:
    """Base T_arena_root (32) along geodesics and joint angles (32, J, 3) of the observed frames."""
    observed = track.observed
    n = int(observed.sum())
    if n < 2:
        return SE3.identity(N_FRAMES), np.zeros((N_FRAMES, track.skeleton.n_joints, 3))
    kept = some_rows(track, observed)
    at = _places(n)
    low = np.minimum(at.astype(int), n - 2)
    before, after = (SE3(kept.root_rotation[rows], kept.root_mm[rows]) for rows in (low, low + 1))
    return before.geodesic(after, at - low), _lerp(kept.angles_rad, at)


def _places(n: int) -> Array:
    """Fractional indices (32,) of the resampled frames among n frames."""
    return np.linspace(0.0, n - 1.0, N_FRAMES)


def _lerp(values: Array, at: Array) -> Array:
    """Rows of values (n, ...) at fractional indices (32,)."""
    low = np.minimum(at.astype(int), len(values) - 2)
    share = (at - low).reshape(-1, *([1] * (values.ndim - 1)))
    return values[low] * (1.0 - share) + values[low + 1] * share


DESCRIPTORS: dict[str, Callable[[Track], Array]] = {
    "tangent": tangent_descriptor,
    "joints": position_descriptor,
}


@dataclass(frozen=True)
class SequenceForest:
    """A forest of 50 trees, 20 deep, on one of the `DESCRIPTORS`.

    Attributes:
        descriptor: 'tangent' or 'joints'.
        forest: the fitted `RandomForestClassifier`.
    """

    descriptor: str
    forest: Any

    @staticmethod
    def learn(descriptor: str, rows: Array, words: Sequence[str], seed: int) -> SequenceForest:
        """A forest from the descriptors of sequences and their words.

        Args:
            descriptor: which of the `DESCRIPTORS` the rows are.
            rows: (n, D) descriptors.
            words: (n) word of each sequence.
            seed: of the forest.
        """
        from sklearn.ensemble import RandomForestClassifier

        forest = RandomForestClassifier(50, max_depth=20, random_state=seed)
        return SequenceForest(descriptor, forest.fit(rows, list(words)))

    def name(self, rows: Array) -> list[str]:
        """The words of n sequences: the largest class of the averaged leaves.

        Args:
            rows: (n, D) descriptors.
        """
        return [str(word) for word in self.forest.predict(rows)]


def describe(descriptor: str, tracks: Sequence[Track]) -> Array:
    """The descriptors (n, D) of n sequences, at least one.

    Args:
        descriptor: one of the `DESCRIPTORS`.
        tracks: the sequences.
    """
    return np.stack([DESCRIPTORS[descriptor](track) for track in tracks])
