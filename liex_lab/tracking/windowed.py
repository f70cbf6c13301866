"""The track of an animal from windows of depth around it, as from whole pictures: for rendered motion in bulk."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.estimation.cascade import ImageSet
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.scoring import Chosen, with_expected_error
from liex_lab.geometry import SE3
from liex_lab.recordings.crops import Crops, Windows
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]

_SIZE_PASSES = 4
_SURE = 0.5  # of the frames measure the size: those of which the model is surest


@dataclass(frozen=True)
class WindowTracker:
    """Measures windows one by one. min_height_mm: what stands out by less is not the animal."""

    estimator: PoseEstimator
    min_height_mm: float

    def find_size(self, windows: Windows) -> float:
        """The animal's length over the home length, measured in some windows as over a recording's sample."""
        model, size = self.estimator.model, 1.0
        uncorrected = replace(self, estimator=replace(self.estimator, model=replace(model, corrector=None)))
        for _ in range(_SIZE_PASSES if model.method.session_size else 0):
            crops, _, chosen = uncorrected._estimate(windows, size)
            if not crops.found.any():
                return 1.0
            sure = np.argsort(-chosen.told_trust)[: max(8, int(_SURE * len(chosen.score)))]
            size = float(np.median(chosen.told_scale[sure]))
        return size

    def follow(self, parts: Iterable[Windows], times_ns: NDArray[np.int64], size: float) -> Track:
        """The track of all windows in the arena frame, one row for each time (n,)."""
        track, start = Track.empty(self.estimator.skeleton, times_ns), 0
        for windows in parts:
            crops, looks, chosen = self._estimate(windows, size)
            rows = start + np.flatnonzero(crops.found)
            start += len(crops.found)
            seen = looks[crops.found]
            turn = np.ascontiguousarray(seen[:, 4:13].reshape(-1, 3, 3))
            shift = np.stack([0 * seen[:, 13], 0 * seen[:, 13], seen[:, 13]], axis=1)
            T_camera_view = SE3(turn, shift).inverse()
            place = windows.floor(0).T_arena_camera
            n = len(rows)
            T_arena_camera = SE3(np.tile(place.rotation, (n, 1, 1)), np.tile(place.translation, (n, 1)))
            self._fill(track, rows, chosen, chosen.pose.moved(T_arena_camera @ T_camera_view))
        return track

    def _fill(self, track: Track, rows: NDArray[np.int64], chosen: Chosen, pose: Pose) -> None:
        track.joints_mm[rows] = pose.joints(self.estimator.skeleton)
        track.root_rotation[rows], track.root_mm[rows] = pose.root.rotation, pose.root.translation
        track.angles_rad[rows], track.scale[rows] = pose.angles, pose.scale
        track.sd_mm[rows], track.sd_root[rows], track.sd_angles_rad[rows] = (
            chosen.sd_mm, chosen.sd_root, chosen.sd_angles
        )  # fmt: skip
        track.predicted_error_mm[rows], track.flag[rows] = chosen.error_mm, ""

    def _estimate(self, windows: Windows, size: float) -> tuple[Crops, Array, Chosen]:
        """Crops and looks of all windows, and the poses, in their view frames, of those that show an animal."""
        model, n = self.estimator.model, len(windows.depth)
        used = size if model.method.session_size else 1.0
        area = np.full(n, model.calibration.area_mm2 * size**2)
        crops, looks = windows.extract(np.full(n, used), area, self.min_height_mm, model.method.camera_view)
        rotations, positions, _, scores = self.estimator.candidates(crops, looks, used)
        seen = crops.found
        images = ImageSet(crops.heights[seen], looks[seen], crops.moments[seen])
        chosen = self.estimator.pick(images, used, rotations[seen], positions[seen], scores[seen])
        return crops, looks, with_expected_error(chosen, model, crops.moments[seen], looks[seen], used)
