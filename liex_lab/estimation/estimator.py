"""Pose estimation by a cascade of regression forests: depth frames in, poses with errors out.

Lie-X Algorithm 1 (section 4.1). From multiple initial poses per animal, one regression forest per
joint and round predicts a correction r in the joint's own frame, and the pose moves by the
exponential map of SE(3),

    g_{1:j} <- g_{1:j} exp(r)                                                       (Eq. 10);

a learned metric scores the resulting candidates. The paper returns the candidate with the lowest
score; the default method returns a weighted mean of the best ones, followed by a forest correction,
a ridge correction or a Gauss-Newton refinement, depending on the method. `PoseEstimator` is the
public class.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import KinematicTree
from liex_lab.body.skeleton import Skeleton
from liex_lab.catalog import find_model
from liex_lab.errors import EstimationError, ModelError
from liex_lab.estimation import _cascade_kernels as kernels
from liex_lab.estimation._residual_kernels import SphereModel
from liex_lab.estimation.cascade import (
    N_DIRECTIONS,
    Array,
    ImageSet,
    body_of,
    draw_starts,
    propose,
    start_poses,
)
from liex_lab.estimation.model import Model, check_model
from liex_lab.estimation.refine import (
    SURE_SHARE,
    HeadTailClassifier,
    Refiner,
    RidgeCorrection,
    both_directions,
)
from liex_lab.estimation.scoring import Chosen, choose, corrected, with_best, with_expected_error
from liex_lab.forests.forest import Forest
from liex_lab.runtime.memory import Rows
from liex_lab.runtime.processes import in_parallel, threads
from liex_lab.scene.height_maps import HeightMaps, Segmenter, view_of


@dataclass(frozen=True)
class Estimates(Rows):
    """Poses of n frames in the camera frame; rows are NaN if no animal was found.

    Attributes:
        chosen: the poses with their spreads, scores and expected errors, see `Chosen`.
        found: (n,) bool, whether an animal was found.
        crops: the height maps that the poses were estimated from.
    """

    chosen: Chosen
    found: NDArray[np.bool_]
    crops: HeightMaps


@dataclass(frozen=True)
class Detection(Rows):
    """One detected component in each of n frames, and its candidate poses.

    Attributes:
        crops: the height maps of the component.
        crop_cameras: (n, 17) crop cameras of the height maps.
        rotations: (n, K, J, 3, 3) joint frames of the candidates, in the view frame.
        positions: (n, K, J, 3) joints of the candidates, mm, view frame.
        scores: (n, K) predicted errors, mm at home size; infinite for missing candidates.
    """

    crops: HeightMaps
    crop_cameras: Array
    rotations: Array
    positions: Array
    scores: Array

    @property
    def images(self) -> ImageSet:
        """The height maps with their crop cameras and moments."""
        return ImageSet(self.crops.heights, self.crop_cameras, self.crops.moments)

    @property
    def usable(self) -> NDArray[np.bool_]:
        """(n,) bool: there is a component in the frame, and a candidate for it."""
        return self.crops.found & np.isfinite(self.scores).any(axis=1)

    def opposite(self, tip: int) -> Detection:
        """Keep only the candidates that point away from the best one, base to tip.

        Excluded candidates take the positions of the best remaining one, so that the number of
        candidates stays the same.

        Args:
            tip: the joint that defines the direction from the base.

        Returns:
            The detection with infinite scores if no candidate has the opposite direction.
        """
        _, other, _, away = both_directions(self.positions, self.scores, tip)
        rows = np.arange(len(self.scores))[:, None]
        usable = self.usable[:, None]
        scores = np.where(away & usable, self.scores, np.inf)
        taken = np.where(away, np.arange(scores.shape[1]), other[:, None])
        some = away.any(axis=1, keepdims=True) & usable
        return Detection(
            self.crops,
            self.crop_cameras,
            self.rotations[rows, taken],
            self.positions[rows, taken],
            np.where(some, np.take_along_axis(scores, taken, axis=1), np.inf),
        )


@dataclass(frozen=True)
class PoseEstimator:
    """A trained model that estimates poses from depth frames.

    Attributes:
        model: the trained model.
        n_candidates: initial poses per animal (Kt of the paper); 0: the method's number.
        unpruned: process all candidates through the whole kinematic tree instead of pruning them
            after the base joint.
        n_joints: number of joints to move, to measure the cost of each; 0: all.
        start_seed: seed of the initial poses, which are the same for all frames.
    """

    model: Model
    n_candidates: int = 0
    unpruned: bool = False  # all candidates run the whole chain
    n_joints: int = 0
    start_seed: int = 20170125

    @staticmethod
    def load(name: str | Path = "mouse") -> PoseEstimator:
        """Load an estimator, with the number of candidates of its method.

        Args:
            name: name of a bundled model, or path of a model file.

        Raises:
            ModelError: there is no such model, or the file is not a complete model file.
        """
        return PoseEstimator(Model.load(find_model(name)))

    @property
    def skeleton(self) -> Skeleton:
        """The animal's skeleton."""
        return self.model.skeleton

    @cached_property
    def _packed(self) -> kernels.Forests:
        """The forests as records for the kernels."""
        model = self.model
        try:
            check_model(model)
        except ValueError as error:
            raise ModelError(f"this model cannot be used ({error}); train it again") from None
        regressors = [forest for rounds in model.cascade.forests for forest in rounds]
        return kernels.Forests(
            _pack(regressors), _pack([model.pruner or model.metric]), _pack([model.metric])
        )

    @cached_property
    def _body(self) -> SphereModel:
        """The sphere model that candidates are compared with; empty unless the method uses it."""
        if not self.model.method.explains:
            return SphereModel(
                1.0, 0, np.zeros((0, 2), np.int64), np.zeros((0, 2, 3)), np.zeros(0), np.zeros(0)
            )
        return body_of(self.model.cascade.balls)

    @cached_property
    def _refiner(self) -> Refiner:
        """The Gauss-Newton refinement for this skeleton."""
        return Refiner.of(self.skeleton, self.model.cascade.balls)

    @cached_property
    def _starts(self) -> Array:
        """(1, K, 4) standard numbers of the initial poses, the same for every frame."""
        k = self.n_candidates or self.model.method.n_candidates
        if self.model.cascade.proposals is not None:
            k = N_DIRECTIONS * self.model.cascade.proposals.n_trees
        return draw_starts(np.random.default_rng(self.start_seed), 1, k)

    def candidates(
        self, crops: HeightMaps, crop_cameras: Array, size: float, parallel: bool = True
    ) -> Detection:
        """Process all initial poses by the cascade and score them (Lie-X Algorithm 1).

        Candidates are pruned after the base joint if the model has a pruner; a head-tail
        classifier, if present, adjusts the scores.

        Args:
            crops: height maps of n frames.
            crop_cameras: (n, 17) crop cameras of the height maps.
            size: the animal's size over home size; ignored by methods of fixed size.
            parallel: use all cores rather than one.

        Returns:
            The K surviving candidates of each frame, with the learned metric's scores.
        """
        method = self.model.method
        skeleton = self.skeleton
        size = size if method.session_size else 1.0
        images = ImageSet(crops.heights, crop_cameras, crops.moments)
        n = len(crop_cameras)
        k = self._starts.shape[1]
        sizes = np.full((n, k), size)
        base_rotation, base_position, scales = start_poses(
            crops.moments, self._starts, sizes, skeleton, method
        )
        if self.model.proposals is not None:
            base_rotation, base_position = propose(
                self.model.proposals, images, sizes[:, 0], method
            )
        keep = method.survivors if self.model.pruner is not None and not self.unpruned else 0
        settings = kernels.CascadeSettings(
            method.rounds_of(0),
            method.rounds,
            method.reaches(skeleton.n_joints),
            float(method.base_lever_mm),
            float(method.joint_lever_mm),
            float(method.scale_lever_mm),
            method.mean_shift_mm,
            min(keep or k, k),
            np.array(skeleton.solved[: self.n_joints or None]),
        )
        starts = kernels.CandidatePoses(
            np.ascontiguousarray(base_rotation[:, :, None]),
            base_position[:, :, None].copy(),
            scales,
        )
        kept = n, settings.keep, skeleton.n_joints
        poses = kernels.CandidatePoses(
            np.zeros((*kept, 3, 3)), np.zeros((*kept, 3)), np.zeros(kept[:2])
        )
        scores = np.full(kept[:2], np.inf)
        with threads(parallel):
            in_parallel(
                kernels.estimate_all,
                -(-int(crops.found.sum()) // kernels.FRAMES),
                kernels.FrameBatch(crops.heights, crop_cameras, crops.moments, size),
                np.flatnonzero(crops.found),
                KinematicTree.of(skeleton),
                self._packed,
                settings,
                self._body,
                starts,
                poses,
                scores,
            )
            if self.model.facing is not None and n:
                facing = HeadTailClassifier(skeleton, self.model.facing)
                scores = facing.judged(images, poses.positions, scores, size)
        return Detection(crops, crop_cameras, poses.rotations, poses.positions, scores)

    def estimate(
        self, depths: NDArray[np.float32], scene: Segmenter, size: float, parallel: bool = True
    ) -> Estimates:
        """Estimate one pose per frame.

        If two components have about the animal's size, the likelier of them is used.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            scene: the segmenter fitted to the recording.
            size: the animal's spine over the home length; ignored by methods of fixed size.
            parallel: use all cores rather than one.

        Returns:
            The poses in the camera frame, with expected errors.
        """
        return self._estimates(self.detect(depths, scene, size, parallel)[0], size, parallel)

    def hypotheses(
        self, depths: NDArray[np.float32], scene: Segmenter, size: float, parallel: bool = True
    ) -> tuple[Estimates, ...]:
        """Estimate alternative poses besides the best one.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            scene: the segmenter fitted to the recording.
            size: the animal's spine over the home length; ignored by methods of fixed size.
            parallel: use all cores rather than one.

        Returns:
            Four estimates in the camera frame: that of `estimate`, the best pose in the opposite
                direction, and the same two of the second component of about the animal's size. Rows
                without such a hypothesis are not found.
        """
        first, second, _ = self.detect(depths, scene, size, parallel)
        return self.both_directions([first, second], size, parallel)

    def best_of(
        self, crops: HeightMaps, crop_cameras: Array, size: float, parallel: bool = True
    ) -> Estimates:
        """Estimate one pose per height map, without segmentation.

        Args:
            crops: height maps of n frames.
            crop_cameras: (n, 17) crop cameras of the height maps.
            size: the animal's spine over the home length; ignored by methods of fixed size.
            parallel: use all cores rather than one.

        Returns:
            The poses in the camera frame, as from `estimate`.
        """
        return self._estimates(self.candidates(crops, crop_cameras, size, parallel), size, parallel)

    def both_directions(
        self, detections: Sequence[Detection], size: float, parallel: bool = True
    ) -> tuple[Estimates, ...]:
        """Estimate the best pose of each detection, and the best one in the opposite direction.

        All are chosen in one call, as the cost of few poses is that of the call.

        Args:
            detections: of n frames each.
            size: the animal's spine over the home length; ignored by methods of fixed size.
            parallel: use all cores rather than one.

        Returns:
            Two estimates of each detection in turn, in the camera frame; rows of the second without
            such a pose are not found.
        """
        both = [one for found in detections for one in (found, found.opposite(self.skeleton.tip))]
        whole = self._estimates(Detection.join(both), size, parallel)
        n = len(both[0].crop_cameras)
        return tuple(whole[k * n : (k + 1) * n] for k in range(len(both)))

    def detect(
        self, depths: NDArray[np.float32], scene: Segmenter, size: float, parallel: bool = True
    ) -> tuple[Detection, Detection, NDArray[np.bool_]]:
        """Detect the animal with its candidates, and the next likely component; see `estimate`.

        Of two components of about the animal's size, area and volume decide which is the animal,
        and, if the metric was trained with other objects, its scores.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread.
            scene: the segmenter fitted to the recording.
            size: the animal's spine over the home length; ignored by methods of fixed size.
            parallel: use all cores rather than one.

        Returns:
            Both detections, the second without pixels where there is no such component; and (n,)
            bool, whether the animal is the second component of `Segmenter.extract_both`.
        """
        method = self.model.method
        size = size if method.session_size else 1.0
        crops, others = scene.extract_both(depths, size, parallel, method.camera_view)
        n = len(depths)
        unsure = np.flatnonzero(crops.n_blobs > 1)
        # in one go, as a call costs as much as a frame
        joined = HeightMaps.join([crops, others[unsure]]) if len(unsure) else crops
        crop_cameras = scene.crop_cameras(joined, method.camera_view)
        both = self.candidates(joined, crop_cameras, size, parallel)
        first = np.arange(n)
        second = np.arange(n)
        if len(unsure):
            pair = both.crops[unsure], both.crops[n:]
            if method.camera_view:  # similarity is measured in the scene's own view
                pair = scene.extract_both(depths[unsure], size)
            # of a squared standard deviation relative to the predicted error
            weight = 0.5 * self.skeleton.relative_size
            misfit, other_misfit = (weight * scene.misfit(crop) for crop in pair)
            if method.metric_on_own:
                misfit = both.scores[unsure].min(axis=1) + misfit
                other_misfit = both.scores[n:].min(axis=1) + other_misfit
            second[unsure] = n + np.arange(len(unsure))
            swapped = unsure[other_misfit < misfit]
            first[swapped], second[swapped] = second[swapped], swapped
        animal, other = both[first], both[second]
        absent = crops.n_blobs < 2
        other.crops.n_px[absent] = 0
        other.scores[absent] = np.inf
        return animal, other, first >= n

    def _estimates(self, detection: Detection, size: float, parallel: bool) -> Estimates:
        """The chosen poses of a detection, in the camera frame."""
        size = size if self.model.method.session_size else 1.0
        usable = detection.usable
        some = detection[np.flatnonzero(usable)]
        whole = with_expected_error(
            self.pick(some, size, parallel), self.model, some.images, size
        ).spread_over(usable)
        pose = whole.pose.moved(view_of(detection.crop_cameras).inverse())
        return Estimates(replace(whole, pose=pose), usable, detection.crops)

    def pick(self, detection: Detection, size: float, parallel: bool = True) -> Chosen:
        """Choose one pose per frame from its candidates, and correct it.

        The best candidates are averaged on the manifold (see `choose`). If the method refines, the
        mean and the best candidates are fitted to the height map by Gauss-Newton steps, and the
        best fit is used. The forest correction and the ridge correction follow if the model has
        them.

        Args:
            detection: n frames, each with at least one candidate.
            size: the animal's size over home size; ignored by methods of fixed size.
            parallel: use all cores rather than one.

        Returns:
            The chosen poses in the view frame; their expected error is still that of `choose`.
        """
        method = self.model.method
        size = size if method.session_size else 1.0
        skeleton = self.skeleton
        images = detection.images
        candidates = detection.rotations, detection.positions, detection.scores
        picked = choose(skeleton, method, self.model.calibration, size, *candidates)
        if not len(detection.scores):
            return picked
        with threads(parallel):
            if method.refine_steps:
                poses = with_best(skeleton, picked.pose, method.refined, *candidates)
                pose, fit = self._refiner.best(poses, images, size, method.refine_steps)
                picked = replace(picked, pose=pose, fit=fit, frame_scale=pose.scale)
            picked = corrected(picked, self.model, images, size)
            if self.model.settler is None:
                return picked
            pose, grown, clear = RidgeCorrection(skeleton, self.model.settler).correct(
                picked.pose, images, size
            )
        return replace(picked, pose=pose, frame_scale=size * np.exp(grown), scale_trust=clear)

    def find_size(self, sample: NDArray[np.float32], scene: Segmenter) -> float:
        """Estimate the animal's size from a sample of frames of the recording.

        The area from above gives the first guess. The model then measures the spine in every
        frame, and the median over the most reliable frames becomes the next guess; this is repeated
        eight times, since each pass corrects about a third of the error. The forest correction is
        not used: it has learned the usual proportions and would bias the size towards them.

        Args:
            sample: (n, H, W) float32 frames, mm, 0 where unread.
            scene: the segmenter fitted to the recording.

        Returns:
            The animal's spine over the home length; 1 for methods of fixed size.

        Raises:
            EstimationError: no animal was found in the sampled frames.
        """
        if not self.model.method.session_size:
            return 1.0
        guess = float(np.sqrt(scene.area_mm2 / self.model.calibration.area_mm2))
        # the forest correction has learned the usual proportions and would bias the size
        uncorrected = replace(self, model=replace(self.model, corrector=None))
        for _ in range(8):  # each corrects about a third of the error
            estimates = uncorrected.estimate(sample, scene, guess)
            if not estimates.found.any():
                raise EstimationError(
                    "no animal was found in the sampled frames, so its size could not be measured"
                )
            guess = float(np.median(self.sizes_by_frame(estimates)))
        return guess

    def sizes_by_frame(self, estimates: Estimates) -> Array:
        """The animal's size over home size as estimated from single frames.

        Args:
            estimates: estimates of some frames.

        Returns:
            (m,) sizes of the most reliable frames: two thirds of those with an animal, or one third
            if the ridge correction estimates the size, but at least 8 if available.
        """
        scale = estimates.chosen.frame_scale
        trust = estimates.chosen.scale_trust
        found = np.flatnonzero(estimates.found)
        n_trusted = (
            len(found) * 2 // 3 if self.model.settler is None else round(len(found) * SURE_SHARE)
        )
        return np.asarray(scale[found[np.argsort(-trust[found])[: max(8, n_trusted)]]])


def _pack(forests: list[Forest]) -> kernels.Trees:
    """Pack forests of equally many trees into one node array.

    Their leaves, of different widths, are stored in one row of numbers.
    """
    n_nodes = np.array([len(forest.nodes) for forest in forests])
    first = (np.cumsum(n_nodes) - n_nodes).astype(np.int32)
    nodes = np.concatenate([forest.nodes for forest in forests])
    nodes[:, 2] += np.where(nodes[:, 2] >= 0, np.repeat(first, n_nodes), 0)
    sizes = np.array([forest.leaves.size for forest in forests])
    return kernels.Trees(
        nodes,
        np.stack([forest.roots for forest in forests]) + first[:, None],
        np.concatenate([forest.leaves.ravel() for forest in forests]),
        np.cumsum(sizes) - sizes,
        np.array([forest.leaves.shape[1] for forest in forests]),
    )
