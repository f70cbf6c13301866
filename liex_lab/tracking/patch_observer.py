"""Pose hypotheses of patches of depth around animals, like `FrameTracker.observe` of frames.

For rendered motion in bulk: training of the tracker and its development sequences. Only one
component, hence two hypotheses of each frame, head and tail either way round.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.foreground.height_maps import HeightMaps, Patches
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.subject import Subject
from liex_lab.tracking.tracker import BRIDGE_S

Array = NDArray[np.float64]

_SIZE_PASSES = 4
_SURE = 0.5  # of the frames measure the size: those of which the model is surest


@dataclass(frozen=True)
class PatchObserver:
    """Measures patches of depth one by one.

    Attributes:
        estimator: the pose estimator.
    """

    estimator: PoseEstimator

    def find_size(self, windows: Patches) -> float:
        """The animal's spine over the home length, measured in some patches.

        As over a recording's sample, a fixed-point iteration: the median of the sizes that the
        surest half of the frames estimate becomes the size of the next of four passes. The
        estimator's final correction is left out, as it pulls sizes to the usual.

        Args:
            windows: patches of one animal.

        Returns:
            The size; 1 where the model knows no session size or no patch shows an animal.
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
        self, parts: Iterable[Patches], times_ns: NDArray[np.int64], size: float
    ) -> Observations:
        """The pose hypotheses of frames, each by itself, in the arena frame.

        Args:
            parts: patches of consecutive frames, batch by batch; each batch on one floor.
            times_ns: (n,) time stamps of all of them.
            size: the animal's spine over the home length.

        Returns:
            Observations of n frames, with hypotheses 0 and 1; centroids and residuals are NaN.
        """
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
        """Whom a track from such patches is of.

        Args:
            camera: the camera that the track is projected into.
            T_arena_camera: its pose in the arena frame, mm.
            size: the animal's spine over the home length.

        Returns:
            The subject, with the model's flagging limit at that size and the default `BRIDGE_S`.
        """
        skeleton = self.estimator.skeleton
        calibration = self.estimator.model.calibration
        share = calibration.joint_share or (1.0,) * skeleton.n_joints
        doubtful_mm = calibration.doubtful_mm * size
        return Subject(
            skeleton, camera, T_arena_camera, size * skeleton.length, doubtful_mm, BRIDGE_S, share
        )

    def _cut(self, windows: Patches, size: float) -> tuple[HeightMaps, Array]:
        """The height map of every patch and its crop camera."""
        model = self.estimator.model
        n = len(windows.depth)
        used = size if model.method.session_size else 1.0
        area = np.full(n, model.calibration.area_mm2 * size**2)
        lowest = self.estimator.skeleton.view.min_height_mm
        return windows.extract(np.full(n, used), area, lowest, model.method.camera_view)
