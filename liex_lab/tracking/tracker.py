"""Single-frame measurement before smoothing: the animal's size and girth, and hypotheses per frame.

`FrameTracker.prepare` estimates the session's constants from a sample of frames (spine length over
the home length, girth of the body, usual error of depth); `observe` then gives the pose hypotheses
of every frame by the estimator of Lie-X Algorithm 1, and `track` smooths them all (`offline`).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import Surface
from liex_lab.errors import EstimationError
from liex_lab.estimation.estimator import Estimates, PoseEstimator
from liex_lab.estimation.session_shape import ShapePrior
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.recordings.frame import DepthFrame, has_readings, stacked
from liex_lab.runtime.memory import Allocator
from liex_lab.runtime.processes import threads
from liex_lab.scene.background import has_noise
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.height_maps import HeightMaps, Patches, Segmenter
from liex_lab.tracking.curve import track_whole
from liex_lab.tracking.observations import Array, Observations
from liex_lab.tracking.own_shape import OwnShape, StatedShape, fit_shape
from liex_lab.tracking.residual import (
    BodyResidual,
    OcclusionCorrection,
    SampleFit,
    behind_something,
)
from liex_lab.tracking.smoother import TrackingParameters
from liex_lab.tracking.track import Flip, Subject, Tracked
from liex_lab.tracking.trust import WHOLE, finite_median, median_of_whole, visible_share

BRIDGE_S = 0.5


@dataclass(frozen=True)
class FrameTracker:
    """Measures each frame on its own; `track` then makes the smoothed curve of them all.

    Attributes:
        estimator: the pose estimator.
        scene: the segmenter of the recording's camera.
        size: the animal's spine over the skeleton's home length, a fact of the session.
        size_origin: where the size comes from, 'plan' or 'recording'.
        body: the default body at the recording's girth, or that of `shape`.
        doubtful_mm: frames with a larger predicted mean joint error, mm, are flagged.
        bridge_s: the longest gap that is bridged, s.
        blur: distance of the body from the depth, over its length, in the sampled frames.
        size_spread: standard deviation of the logarithm of the size that the sampled frames
            estimate.
        free_ends: occlusion correction, which shifts a swimming animal according to its visible
            end; None to disable it.
        sample_fit: agreement of the model with the sampled frames; None without sampled frames.
        shape: the session's own shape; None if it is not used.
        noisy: whether the sensor has noise, so that a depth image which repeats is a copy.
        n_measured: how many animals of the recording are measured.
    """

    estimator: PoseEstimator
    scene: Segmenter
    size: float
    size_origin: str
    body: BodyResidual
    doubtful_mm: float
    bridge_s: float = BRIDGE_S
    blur: float = 0.0
    size_spread: float = 0.0
    free_ends: OcclusionCorrection | None = None
    sample_fit: SampleFit | None = None
    shape: OwnShape | None = None
    noisy: bool = False
    n_measured: int = 1

    @staticmethod
    def prepare(
        estimator: PoseEstimator,
        scene: Segmenter,
        sample: NDArray[np.float32],
        spine_mm: float | None = None,
        doubtful_mm: float | None = None,
        bridge_s: float = BRIDGE_S,
        adapt: bool = True,
        stated: StatedShape | None = None,
    ) -> "FrameTracker":
        """A tracker for a recording: a sample of its frames gives the animal's size and shape.

        Args:
            estimator: the pose estimator.
            scene: the segmenter of the recording's camera.
            sample: (n, H, W) float32 mm, frames spread over the recording.
            spine_mm: spine length, mm, if known; None measures it.
            doubtful_mm: flagging limit, mm; None uses the model's calibration at the animal's
                size.
            bridge_s: the longest gap that is bridged whole, s.
            adapt: fit a shape to the sample; else the body is the average one at its best girth.
            stated: a stated shape of the animal; None fits it.

        Raises:
            EstimationError: no sampled frame shows an animal.
        """
        skeleton = estimator.skeleton
        method = estimator.model.method
        home = skeleton.length
        size = spine_mm / home if spine_mm else estimator.find_size(sample, scene)
        estimates = estimator.estimate(sample, scene, size)
        whole = _whole(scene, sample, estimates)
        if whole.sum() < len(whole) and (whole & estimates.found).sum() >= 20:  # enough frames
            # the length of a partly hidden animal is unknown
            sample = sample[whole]
            size = size if spine_mm else estimator.find_size(sample, scene)
            estimates = estimator.estimate(sample, scene, size)
        used = estimates.found
        if not used.any():
            raise EstimationError(
                "no animal was found in the sampled frames; check the depth unit and the plan"
            )
        body, shape = _body_of(estimator, scene, estimates, size, adapt, stated)
        pose = estimates.chosen.pose
        if shape is not None:
            pose = shape.corrected(estimator, pose, size)
        crops = estimates.crops[used]
        shown = sample if used.all() else sample[used]  # copies about a hundred depth images
        agreement = body.agreement(pose.moved(scene.floor.T_arena_camera)[used], crops, scene)
        # animals on the floor are recorded from above and may rear
        swims = method.camera_view and skeleton.is_chain
        fit = SampleFit(
            sum(has_readings(image) for image in sample),
            int(used.sum()),
            size * home,
            float(np.median(estimates.chosen.error_mm[used])),
            finite_median(agreement.residual_mm, np.nan),
            float(np.median(agreement.covered)),
            float(np.median(agreement.beside)),
            scene.n_animals,
        )
        return FrameTracker(
            estimator,
            scene,
            size,
            "plan" if spine_mm else "recording",
            body,
            doubtful_mm or estimator.model.calibration.doubtful_mm * size,
            bridge_s,
            finite_median(agreement.residual_mm, 0.0) / (home * size),
            float(np.log(estimator.sizes_by_frame(estimates)).std()),
            OcclusionCorrection.fit(skeleton, scene, estimates.chosen.pose[used], crops, shown)
            if swims
            else None,
            fit,
            shape,
            has_noise(sample),
        )

    @property
    def spine_mm(self) -> float:
        """The animal's spine length, mm."""
        return self.size * self.estimator.skeleton.length

    @cached_property
    def subject(self) -> Subject:
        """The animal of the track, with the limits and shares of this recording."""
        skeleton = self.estimator.skeleton
        share = self.estimator.model.calibration.joint_share or (1.0,) * skeleton.n_joints
        shared_mm = 0.0 if self.shape is None else self.shape.shared_error_mm(self.spine_mm)
        return Subject(
            skeleton,
            self.scene.camera,
            self.scene.floor.T_arena_camera,
            self.spine_mm,
            math.hypot(self.doubtful_mm, shared_mm),
            self.bridge_s,
            share,
            TrackingParameters.of(skeleton.name).motion.stretch_sd(self.blur, self.size_spread),
            None if self.shape is None else self.shape.unseen,
            1 if self.sample_fit is None else self.sample_fit.n_animals,
            self.n_measured,
        )

    def observe(self, frames: Sequence[DepthFrame]) -> Observations:
        """The pose hypotheses of consecutive frames, one frame at a time.

        A depth image that a noisy sensor repeats bit for bit is a copy and is ignored.

        Args:
            frames: at least one.

        Returns:
            Observations of n frames, arena frame.
        """
        depths = stacked(frames)
        times = np.array([frame.time_ns for frame in frames], np.int64)
        observed = Observations.empty(self.estimator.skeleton, times)
        observed.has_depth[:] = [has_readings(depth) for depth in depths]
        observed.repeats[:] = [frame.repeats for frame in frames]
        # kernels distribute frames over cores: with one frame the others would idle
        with threads(len(frames) > 1):
            hypotheses = self.estimator.hypotheses(
                self.scene.levelled(depths, times), self.scene, self.size
            )
            observed.objects[:] = hypotheses[0].crops.objects
            poses = [self.put(observed, h, some, depths) for h, some in enumerate(hypotheses)]
            self.put_agreement(observed, hypotheses, poses, self.scene.cleared(depths))
        if self.noisy:
            observed.forget(observed.repeats)
        return observed

    def track(
        self,
        observed: Observations,
        corrections: Sequence[Flip] = (),
        allocate: Allocator = np.empty,
    ) -> Tracked:
        """The smoothed track of a whole recording, see `offline.track_whole`.

        Args:
            observed: result of `observe` for all frames.
            corrections: spans that a person marked as having head and tail exchanged.
            allocate: allocator of the track's columns.

        Returns:
            The track and its head-tail flips.
        """
        return track_whole(self.subject, observed, corrections, allocate=allocate)

    def put(
        self, observed: Observations, h: int, estimates: Estimates, depths: NDArray[np.float32]
    ) -> Pose:
        """Set estimates as hypothesis h, with their component's pixels and centroid.

        Returns their poses (n), arena frame.
        """
        found = np.flatnonzero(estimates.found)
        chosen = estimates.chosen
        pose = chosen.pose
        if not len(found):
            return pose
        crops = estimates.crops
        if self.free_ends is not None:
            pose = self.free_ends.slid(pose, crops, depths)
        if self.shape is not None:
            pose = self.shape.corrected(self.estimator, pose, self.size)
        pose = pose.moved(self.scene.floor.T_arena_camera)
        observed.put_pose(h, pose)
        observed.error_mm[:, h] = chosen.error_mm
        observed.score[:, h] = chosen.score
        observed.n_px[found, h] = crops.n_px[found]
        centre = self.scene.middles(crops[found], self.estimator.model.method.camera_view)
        observed.centroid_mm[found, h] = centre
        from_camera = self.scene.floor.T_arena_camera.inverse() @ centre
        observed.centroid_px[found, h] = self.scene.camera.project(from_camera)
        return pose

    def put_agreement(
        self,
        observed: Observations,
        hypotheses: Sequence[Estimates],
        poses: Sequence[Pose],
        cleared: NDArray[np.float32],
    ) -> None:
        """Set the agreement of the best pose (n) of each component with the depth, arena frame.

        `cleared` are the depth images without worn objects. All components are compared in one
        call, because a call costs as much as a frame.
        """
        rows = [np.flatnonzero(one.found) for one in hypotheses]
        best = [h for h in range(0, len(hypotheses), 2) if len(rows[h])]
        columns = (observed.residual_mm, observed.covered, observed.beside, observed.part_mm)
        if best:
            agreement = self.body.agreement(
                Pose.join([poses[h][rows[h]] for h in best]),
                HeightMaps.join([hypotheses[h].crops[rows[h]] for h in best]),
                self.scene,
            )
            hypothesis = np.repeat(best, [len(rows[h]) for h in best])
            frame = np.concatenate([rows[h] for h in best])
            for column, values in zip(columns, vars(agreement).values(), strict=True):
                column[frame, hypothesis] = values
        for h in best:
            # for all frames: discarding unused values is cheaper than copying depth images
            observed.behind[rows[h], h] = behind_something(hypotheses[h].crops, cleared)[rows[h]]
            # the reversed body covers nearly the same pixels
            for column in (*columns, observed.behind):
                column[rows[h + 1], h + 1] = column[rows[h + 1], h]


def _body_of(
    estimator: PoseEstimator,
    scene: Segmenter,
    estimates: Estimates,
    size: float,
    adapt: bool,
    stated: StatedShape | None,
) -> tuple[BodyResidual, OwnShape | None]:
    """The body that sampled frames are compared with, and the session's own shape."""
    used = estimates.found
    average = Surface.of(estimator.skeleton)
    camera_view = estimator.model.method.camera_view
    if stated is not None and stated.girth is not None:
        body = BodyResidual(average, stated.girth, camera_view, size)
    else:
        pose = estimates.chosen.pose.moved(scene.floor.T_arena_camera)[used]
        body = BodyResidual.fit(average, pose, estimates.crops[used], scene, camera_view, size)
    if not adapt:
        return body, None
    shape, body = fit_shape(
        ShapePrior.of(estimator.skeleton.name), estimator, scene, estimates, size, body, stated
    )
    return body, shape


def _whole(
    scene: Segmenter, sample: NDArray[np.float32], estimates: Estimates
) -> NDArray[np.bool_]:
    """Which frames (n,) of a sample (n, H, W) mm show the whole animal, not partly hidden by a
    nearer object.
    """
    if not isinstance(scene, BackgroundSubtraction):
        return np.ones(len(sample), np.bool_)
    crops = estimates.crops
    if scene.stride > 1:  # from pixels of the full image to those of the subsampled image
        crops = replace(crops, origin=crops.origin // scene.stride, step=crops.step // scene.stride)
    behind = behind_something(crops, scene.cleared(sample))
    shown = np.where(estimates.found, crops.n_px, np.nan)
    share = visible_share(behind, shown, median_of_whole(shown, behind), 0)
    return ~estimates.found | (share >= WHOLE)


# Pose hypotheses of patches of depth around animals, like `FrameTracker.observe` of frames.


@dataclass(frozen=True)
class PatchObserver:
    """Measures patches of depth one by one.

    Attributes:
        estimator: the pose estimator.
    """

    estimator: PoseEstimator

    def find_size(self, windows: Patches) -> float:
        """The animal's spine over the home length, measured in some patches.

        A fixed-point iteration, as over a recording's sample: the median size in the most certain
        half of the frames becomes the size of the next of four passes. The estimator's final
        correction is omitted, because it biases sizes towards the usual one.

        Args:
            windows: patches of one animal.

        Returns:
            The size; 1 if the model has no session size or no patch shows an animal.
        """
        model = self.estimator.model
        size = 1.0
        uncorrected = replace(self.estimator, model=replace(model, corrector=None))
        for _ in range(4 if model.method.session_size else 0):
            best = uncorrected.best_of(*self._cut(windows, size), size)
            found = np.flatnonzero(best.found)
            if not len(found):
                return 1.0
            order = np.argsort(-best.chosen.scale_trust[found])
            sure = found[order[: max(8, int(0.5 * len(found)))]]
            size = float(np.median(best.chosen.frame_scale[sure]))
        return size

    def observe(
        self, parts: Iterable[Patches], times_ns: NDArray[np.int64], size: float
    ) -> Observations:
        """The pose hypotheses of single frames, in the arena frame.

        Args:
            parts: patches of consecutive frames, batch by batch; each batch on one floor.
            times_ns: (n,) time stamps of all of them.
            size: the animal's spine over the home length.

        Returns:
            Observations of n frames, with hypotheses 0 and 1; centroids and residuals are NaN.
        """
        observed = Observations.empty(self.estimator.skeleton, times_ns)
        start = 0
        for windows in parts:
            place = windows.floor(0).T_arena_camera
            rows = slice(start, start + len(windows.depth))
            # a view: writes change the whole
            start = rows.stop
            some = observed[rows]
            detection = self.estimator.candidates(*self._cut(windows, size), size)
            for h, estimates in enumerate(self.estimator.both_directions([detection], size)):
                some.put_pose(h, estimates.chosen.pose.moved(place))
                some.error_mm[:, h] = estimates.chosen.error_mm
                some.score[:, h] = estimates.chosen.score
                some.n_px[:, h] = np.where(estimates.found, estimates.crops.n_px, 0)
        return observed

    def subject(self, camera: Camera, T_arena_camera: SE3, size: float) -> Subject:
        """The subject of a track from such patches.

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
        return Subject(
            skeleton,
            camera,
            T_arena_camera,
            size * skeleton.length,
            calibration.doubtful_mm * size,
            BRIDGE_S,
            share,
        )

    def _cut(self, windows: Patches, size: float) -> tuple[HeightMaps, Array]:
        """The height map of every patch and its crop camera."""
        model = self.estimator.model
        n = len(windows.depth)
        used = size if model.method.session_size else 1.0
        area = np.full(n, model.calibration.area_mm2 * size**2)
        return windows.extract(
            np.full(n, used),
            area,
            self.estimator.skeleton.view.min_height_mm,
            model.method.camera_view,
        )
