"""Following one animal frame by frame: every frame of the recording becomes one row of the track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.surface import Surface
from liex_lab.errors import EstimationError
from liex_lab.estimation.estimator import Estimates, PoseEstimator
from liex_lab.recordings.crops import Foreground
from liex_lab.recordings.frame import DepthFrame
from liex_lab.tracking.residual import BodyResidual
from liex_lab.tracking.track import Track


@dataclass(frozen=True)
class FrameTracker:
    """Measures each frame on its own. size: the animal's spine over the skeleton's home length, a fact of the session.

    size_origin says where the size comes from: 'plan' or 'recording'. doubtful_mm: frames with a larger predicted
    error are flagged.
    """

    estimator: PoseEstimator
    scene: Foreground
    size: float
    size_origin: str
    body: BodyResidual
    doubtful_mm: float

    @staticmethod
    def prepare(
        estimator: PoseEstimator,
        scene: Foreground,
        sample: NDArray[np.float32],
        spine_mm: float | None = None,
        doubtful_mm: float | None = None,
    ) -> FrameTracker:
        """A tracker for a recording, from a sample (n, H, W) mm of its frames: the animal's size and girth are found.

        spine_mm: the size where the user knows it. Raises EstimationError where no sampled frame shows an animal.
        """
        home = estimator.skeleton.length
        size = spine_mm / home if spine_mm else estimator.find_size(sample, scene)
        estimates = estimator.estimate(sample, scene, size)
        if not estimates.found.any():
            raise EstimationError("no animal was found in the sampled frames; check the depth unit and the plan")
        pose = estimates.chosen.pose.moved(scene.floor.T_arena_camera)
        crops, used = estimates.crops, estimates.found
        camera_view = estimator.model.method.camera_view
        body = BodyResidual.fit(Surface.of(estimator.skeleton), pose[used], crops[used], scene, camera_view)
        limit = doubtful_mm or estimator.model.calibration.doubtful_mm * size
        return FrameTracker(estimator, scene, size, "plan" if spine_mm else "recording", body, limit)

    @property
    def spine_mm(self) -> float:
        """The animal's spine, mm."""
        return self.size * self.estimator.skeleton.length

    def follow(self, frames: Sequence[DepthFrame]) -> Track:
        """The track of consecutive frames."""
        depths = np.stack([frame.depth for frame in frames])
        times = np.array([frame.time_ns for frame in frames], np.int64)
        return self.track_of(self.estimator.estimate(depths, self.scene, self.size), depths, times)

    def track_of(self, estimates: Estimates, depths: NDArray[np.float32], times: NDArray[np.int64]) -> Track:
        """Estimates of frames (n, H, W) mm as rows of a track in the arena frame."""
        skeleton, chosen = self.estimator.skeleton, estimates.chosen
        track = Track.empty(skeleton, times)
        seen = estimates.found
        in_camera = chosen.pose.joints(skeleton)
        pose = chosen.pose.moved(self.scene.floor.T_arena_camera)
        track.joints_mm[:] = self.scene.floor.T_arena_camera @ in_camera
        track.uv_px[seen] = self.scene.camera.project(in_camera[seen])
        track.root_rotation[:], track.root_mm[:] = pose.root.rotation, pose.root.translation
        track.angles_rad[:], track.scale[:] = pose.angles, pose.scale
        track.sd_mm[:], track.sd_root[:], track.sd_angles_rad[:] = chosen.sd_mm, chosen.sd_root, chosen.sd_angles
        track.predicted_error_mm[:] = chosen.error_mm
        track.n_foreground_px[:] = estimates.crops.n_px
        camera_view = self.estimator.model.method.camera_view
        track.centroid_mm[seen] = self.scene.middles(estimates.crops[seen], camera_view)
        to_camera = self.scene.floor.T_arena_camera.inverse()
        track.centroid_px[seen] = self.scene.camera.project(to_camera @ track.centroid_mm[seen])
        track.residual_mm[seen] = self.body.of(pose[seen], estimates.crops[seen], self.scene)
        track.flag[seen] = np.where(chosen.error_mm[seen] > self.doubtful_mm, "doubtful", "")
        track.flag[~seen & ~(depths > 0).any(axis=(1, 2))] = "no_depth"
        return track
