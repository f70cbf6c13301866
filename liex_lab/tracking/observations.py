"""What the single frames say: for each of them a few hypotheses of the pose, in the arena frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.estimator import Estimates
from liex_lab.geometry import SE3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Observations:
    """Hypotheses (n, H) of n frames, NaN where there is none; the first is the single frame's own answer.

    times_ns (n,); rotation (n, H, 3, 3), root_mm (n, H, 3), angles (n, H, J, 3) and scale (n, H) of the poses; joints
    (n, H, J, 3) mm; error_mm (n, H): expected mean joint error; score (n, H): what the metric says of the candidates
    behind it, mm at home size.
    """

    times_ns: NDArray[np.int64]
    rotation: Array
    root_mm: Array
    angles: Array
    scale: Array
    joints: Array
    error_mm: Array
    score: Array

    @staticmethod
    def of(estimates: Sequence[Estimates], T_arena_camera: SE3, skeleton: Skeleton, times_ns: NDArray[np.int64]
           ) -> Observations:  # fmt: skip
        """From the estimator's hypotheses."""
        poses = [e.chosen.pose.moved(T_arena_camera) for e in estimates]
        return Observations(
            np.asarray(times_ns, np.int64),
            np.stack([p.root.rotation for p in poses], axis=1), np.stack([p.root.translation for p in poses], axis=1),
            np.stack([p.angles for p in poses], axis=1), np.stack([p.scale for p in poses], axis=1),
            np.stack([p.joints(skeleton) for p in poses], axis=1),
            np.stack([e.chosen.error_mm for e in estimates], axis=1),
            np.stack([e.chosen.score for e in estimates], axis=1),
        )  # fmt: skip

    @staticmethod
    def join(parts: Sequence[Observations]) -> Observations:
        """Those of consecutive frames."""
        return Observations(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Observations)))

    def __getitem__(self, frames: slice) -> Observations:
        return Observations(*(getattr(self, f.name)[frames] for f in fields(self)))

    def __len__(self) -> int:
        return len(self.times_ns)

    @property
    def seconds(self) -> Array:
        """(n,) since the first frame."""
        return np.asarray((self.times_ns - self.times_ns[:1]) * 1e-9)

    @property
    def known(self) -> NDArray[np.bool_]:
        """(n, H) where there is a hypothesis."""
        return np.isfinite(self.score)

    def pose(self, path: NDArray[np.int64]) -> Pose:
        """The poses (n) of the hypotheses `path` (n,); NaN where it is negative."""
        rows, chosen = np.arange(len(path)), np.maximum(path, 0)
        gone = path < 0
        taken = [values[rows, chosen].copy() for values in (self.rotation, self.root_mm, self.angles, self.scale)]
        for values in taken:
            values[gone] = np.nan
        return Pose(SE3(taken[0], taken[1]), taken[2], taken[3])

    def along(self, values: Array, path: NDArray[np.int64]) -> Array:
        """Some of the hypotheses' values (n, H, ...) along a path (n,); NaN where it is negative."""
        taken = values[np.arange(len(path)), np.maximum(path, 0)].astype(float)
        taken[path < 0] = np.nan
        return taken
