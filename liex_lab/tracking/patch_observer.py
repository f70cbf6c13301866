"""What windows of depth around an animal say, as whole pictures do: for rendered motion in bulk."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.foreground.height_maps import Crops, Windows
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.offline import Subject
from liex_lab.tracking.tracker import BRIDGE_S

Array = NDArray[np.float64]

_SIZE_PASSES = 4
_SURE = 0.5  # of the frames measure the size: those of which the model is surest


@dataclass(frozen=True)
class WindowTracker:
    """Measures windows one by one."""

    estimator: PoseEstimator

    def find_size(self, windows: Windows) -> float:
        """The animal's length over the home length, measured in some windows as over a recording's
        sample.
        """
        model = self.estimator.model
        size = 1.0
        uncorrected = replace(
            self, estimator=replace(self.estimator, model=replace(model, corrector=None))
        )
        for _ in range(_SIZE_PASSES if model.method.session_size else 0):
            best = uncorrected.estimator.best_of(*uncorrected._cut(windows, size), size)
            seen = np.flatnonzero(best.found)
            if not len(seen):
                return 1.0
            sure = seen[np.argsort(-best.chosen.told_trust[seen])[: max(8, int(_SURE * len(seen)))]]
            size = float(np.median(best.chosen.told_scale[sure]))
        return size

    def observe(
        self, parts: Iterable[Windows], times_ns: NDArray[np.int64], size: float
    ) -> Observations:
        """What the frames at these times (n,) say, each by itself, in the arena frame."""
        seen = Observations.empty(self.estimator.skeleton, times_ns)
        start = 0
        for windows in parts:
            place = windows.floor(0).T_arena_camera
            rows = slice(start, start + len(windows.depth))
            # a view: what is put there is put in all of it
            start = rows.stop
            some = seen[rows]
            for h, estimates in enumerate(
                self.estimator.both_ways(*self._cut(windows, size), size)
            ):
                some.put_pose(h, estimates.chosen.pose.moved(place))
                some.error_mm[:, h] = estimates.chosen.error_mm
                some.score[:, h] = estimates.chosen.score
                some.n_px[:, h] = np.where(estimates.found, estimates.crops.n_px, 0)
        return seen

    def subject(self, camera: Camera, T_arena_camera: SE3, size: float) -> Subject:
        """Whom a track out of such windows is of, before which camera."""
        skeleton = self.estimator.skeleton
        calibration = self.estimator.model.calibration
        share = calibration.joint_share or (1.0,) * skeleton.n_joints
        doubtful_mm = calibration.doubtful_mm * size
        return Subject(
            skeleton, camera, T_arena_camera, size * skeleton.length, doubtful_mm, BRIDGE_S, share
        )

    def _cut(self, windows: Windows, size: float) -> tuple[Crops, Array]:
        """The height map of every window and how it was cut."""
        model = self.estimator.model
        n = len(windows.depth)
        used = size if model.method.session_size else 1.0
        area = np.full(n, model.calibration.area_mm2 * size**2)
        lowest = self.estimator.skeleton.view.min_height_mm
        return windows.extract(np.full(n, used), area, lowest, model.method.camera_view)
