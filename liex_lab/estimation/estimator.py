"""PoseEstimator: depth frames in, a pose with its expected error for each of them out (Lie-X
Algorithm 1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.catalog import find_model
from liex_lab.errors import EstimationError
from liex_lab.estimation import _cascade_kernels as kernels
from liex_lab.estimation._residual_kernels import Body
from liex_lab.estimation.cascade import ImageSet, body_of
from liex_lab.estimation.forest_correction import corrected
from liex_lab.estimation.head_tail import Facing, both_ways
from liex_lab.estimation.initial import draw_starts, start_poses
from liex_lab.estimation.model import Model
from liex_lab.estimation.proposals import N_WAYS, propose
from liex_lab.estimation.refine import Refiner
from liex_lab.estimation.ridge_correction import SURE_SHARE, Settler
from liex_lab.estimation.scoring import Chosen, choose, with_best, with_expected_error
from liex_lab.estimation.training import base_at_front
from liex_lab.foreground.height_maps import Crops, Foreground, view_of
from liex_lab.forests.forest import Forest
from liex_lab.geometry import SE3
from liex_lab.runtime.threads import threads

Array = NDArray[np.float64]

_START_SEED = 20170125
_SIZE_PASSES = (
    8  # of estimating the size with the size just found; each goes about a third of the way
)
# what a squared standard deviation of area or volume weighs against the predicted error, at
_MM_PER_MISFIT = 0.5
# the reference length


@dataclass(frozen=True)
class Estimates:
    """Poses of n frames in the camera frame; NaN rows where no animal was found. Fields as
    `Chosen`; found (n,).
    """

    chosen: Chosen
    found: NDArray[np.bool_]
    crops: Crops

    def __getitem__(self, rows: slice) -> Estimates:
        return Estimates(self.chosen[rows], self.found[rows], self.crops[rows])


@dataclass(frozen=True)
class _Sight:
    """A thing in each of n frames and its candidates: looks (n, 17); rotations (n, K, J, 3, 3),
    positions (n, K, J, 3) mm, scores (n, K), infinite where there is no such candidate.
    """

    crops: Crops
    looks: Array
    rotations: Array
    positions: Array
    scores: Array

    def __getitem__(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> _Sight:
        return _Sight(
            self.crops[index],
            self.looks[index],
            self.rotations[index],
            self.positions[index],
            self.scores[index],
        )

    @staticmethod
    def join(parts: Sequence[_Sight]) -> _Sight:
        """Those of several batches, one after the other."""
        rest = (np.concatenate([getattr(p, name) for p in parts]) for name in _OF_SIGHT)
        return _Sight(Crops.join([p.crops for p in parts]), *rest)

    @property
    def usable(self) -> NDArray[np.bool_]:
        """(n,) where there is something, and a candidate for it."""
        return self.crops.found & np.isfinite(self.scores).any(axis=1)

    def put(self, rows: NDArray[np.int64], other: _Sight) -> None:
        """Take these rows (m,) from another one of m frames."""
        self.crops.put(rows, other.crops)
        for name in _OF_SIGHT:
            getattr(self, name)[rows] = getattr(other, name)

    def nothing(self) -> _Sight:
        """As many frames in which no such thing is."""
        nothing = self[np.arange(len(self.looks))]
        nothing.crops.n_px[:] = 0
        nothing.scores[:] = np.inf
        return nothing

    def opposite(self, usable: NDArray[np.bool_], tip: int) -> _Sight:
        """The same with only the candidates that point away from where the one with the lowest
        score does, in frames `usable`, from base to `tip`; the best of them takes the others'
        places, so that their number stays.
        """
        _, other, _, away = both_ways(self.positions, self.scores, tip)
        rows = np.arange(len(self.scores))
        scores = np.where(away & usable[:, None], self.scores, np.inf)
        taken = np.where(away, np.arange(scores.shape[1]), other[:, None])
        some = away.any(axis=1) & usable
        return _Sight(
            self.crops,
            self.looks,
            self.rotations[rows[:, None], taken],
            self.positions[rows[:, None], taken],
            np.where(some[:, None], np.take_along_axis(scores, taken, axis=1), np.inf),
        )


_OF_SIGHT = ("looks", "rotations", "positions", "scores")


@dataclass(frozen=True)
class PoseEstimator:
    """A trained model at work."""

    model: Model
    n_candidates: int = 0  # 0: as the model's method says
    unpruned: bool = False  # all candidates run the whole chain
    n_joints: int = 0  # only so many joints are moved, to see what each costs; 0: all that can be

    @staticmethod
    def load(name: str | Path = "mouse") -> PoseEstimator:
        """An estimator from a bundled model's name or the path of a model file. Raises
        ModelError.
        """
        return PoseEstimator(Model.load(find_model(name)))

    @property
    def skeleton(self) -> Skeleton:
        """The animal's skeleton."""
        return self.model.skeleton

    @cached_property
    def _packed(self) -> tuple[kernels.Trees, kernels.Trees, kernels.Trees]:
        """Regressors, pruner and metric as the kernels want them."""
        model = self.model
        regressors = [forest for rounds in model.cascade.forests for forest in rounds]
        return _pack(regressors), _pack([model.pruner or model.metric]), _pack([model.metric])

    @cached_property
    def _chain(self) -> kernels.Chain:
        s = self.skeleton
        return kernels.Chain(
            s.parents, s.offsets, s.rest, s.axes, np.array(s.solved[: self.n_joints or None])
        )

    def _tuning(self, n_starts: int) -> kernels.Tuning:
        method = self.model.method
        keep = method.survivors if self.model.pruner is not None and not self.unpruned else 0
        return kernels.Tuning(
            method.rounds_of(0),
            method.rounds,
            method.reaches(self.skeleton.n_joints),
            np.array([method.base_lever_mm, method.joint_lever_mm, method.scale_lever_mm]),
            method.mean_shift_mm,
            min(keep or n_starts, n_starts),
        )

    @cached_property
    def _body(self) -> Body:
        """The body that candidates are held against the picture with."""
        if not self.model.method.explains:
            return Body(
                1.0, 0, np.zeros((0, 2), np.int64), np.zeros((0, 2, 3)), np.zeros(0), np.zeros(0)
            )
        return body_of(self.model.cascade.balls)

    @cached_property
    def _refiner(self) -> Refiner:
        return Refiner.of(self.skeleton, self.model.cascade.balls)

    @cached_property
    def _starts(self) -> Array:
        k = self.n_candidates or self.model.method.n_candidates
        if self.model.cascade.proposals is not None:
            k = N_WAYS * self.model.cascade.proposals.n_trees
        return draw_starts(np.random.default_rng(_START_SEED), 1, k)

    def candidates(
        self, crops: Crops, looks: Array, size: float, parallel: bool = True
    ) -> tuple[Array, Array, Array, Array]:
        """The candidates of n frames that outlive the base joint, in their view frames: rotations
        (n, K, J, 3, 3), positions (n, K, J, 3) mm, scales (n, K), and the metric's scores (n, K),
        mm at home size.
        """
        method = self.model.method
        skeleton = self.skeleton
        n = len(looks)
        k = self._starts.shape[1]
        sizes = np.full((n, k), size)
        base_rotation, base_position, scales = start_poses(
            crops.moments,
            self._starts,
            sizes,
            skeleton.length,
            base_at_front(skeleton),
            method.axis_start,
            method.camera_view,
            method.home_turn,
        )
        if self.model.cascade.proposals is not None:
            images = ImageSet(crops.heights, looks, crops.moments)
            base_rotation, base_position = propose(
                self.model.cascade.proposals, images, sizes[:, 0], method
            )
        tuning = self._tuning(k)
        starts = (
            np.ascontiguousarray(base_rotation[:, :, None]),
            base_position[:, :, None].copy(),
            scales,
        )
        rotations = np.zeros((n, tuning.keep, skeleton.n_joints, 3, 3))
        positions = np.zeros((n, tuning.keep, skeleton.n_joints, 3))
        poses = rotations, positions, np.zeros((n, tuning.keep)), np.full((n, tuning.keep), np.inf)
        with threads(parallel):
            kernels.estimate_all(
                crops.heights,
                looks,
                crops.moments,
                np.flatnonzero(crops.found),
                size,
                self._chain,
                *self._packed,
                tuning,
                self._body,
                starts,
                poses,
            )
            if self.model.facing is None or not n:
                return poses
            facing = Facing(skeleton, self.model.facing)
            scores = facing.judged(
                ImageSet(crops.heights, looks, crops.moments), poses[1], poses[3], size
            )
        return *poses[:3], scores

    def estimate(
        self, depths: NDArray[np.float32], scene: Foreground, size: float, parallel: bool = True
    ) -> Estimates:
        """Poses of frames (n, H, W) mm in the camera frame. size: the animal's spine over the home
        length.
        """
        size = size if self.model.method.session_size else 1.0
        return self._estimates(self._look(depths, scene, size, parallel)[0], size, parallel)

    def hypotheses(
        self, depths: NDArray[np.float32], scene: Foreground, size: float, parallel: bool = True
    ) -> tuple[Estimates, ...]:
        """What else the frames (n, H, W) mm may show, each like `estimate`'s answer, which comes
        first: the best pose that points the other way, and the same two of the second thing of
        about the animal's size. Rows without such are not found.
        """
        size = size if self.model.method.session_size else 1.0
        return self._ways(self._look(depths, scene, size, parallel), size, parallel)

    def best_of(self, crops: Crops, looks: Array, size: float, parallel: bool = True) -> Estimates:
        """The pose of each height map (n), camera frame; see `estimate`."""
        size = size if self.model.method.session_size else 1.0
        return self._estimates(self._sighted(crops, looks, size, parallel), size, parallel)

    def both_ways(
        self, crops: Crops, looks: Array, size: float, parallel: bool = True
    ) -> tuple[Estimates, Estimates]:
        """The same, and the best pose that points the other way; see `hypotheses`."""
        size = size if self.model.method.session_size else 1.0
        best, turned = self._ways((self._sighted(crops, looks, size, parallel),), size, parallel)
        return best, turned

    def _sighted(self, crops: Crops, looks: Array, size: float, parallel: bool) -> _Sight:
        """What was cut out of each frame, with its candidates."""
        rotations, positions, _, scores = self.candidates(crops, looks, size, parallel)
        return _Sight(crops, looks, rotations, positions, scores)

    def _ways(self, sights: Sequence[_Sight], size: float, parallel: bool) -> tuple[Estimates, ...]:
        """The chosen poses of each sight and those that point the other way, in turn.

        All are chosen in one go: a live frame's poses are few, and what a step costs is its call.
        """
        both = [way for s in sights for way in (s, s.opposite(s.usable, self.skeleton.tip))]
        whole = self._estimates(_Sight.join(both), size, parallel)
        n = len(both[0].looks)
        return tuple(whole[k * n : (k + 1) * n] for k in range(len(both)))

    def _look(
        self, depths: NDArray[np.float32], scene: Foreground, size: float, parallel: bool
    ) -> tuple[_Sight, _Sight]:
        """What was taken for the animal, with its candidates, and the next best thing; see
        `estimate`.
        """
        camera_view = self.model.method.camera_view
        crops, others = scene.extract_both(depths, size, parallel, camera_view)
        first = self._sighted(crops, scene.looks(crops, camera_view), size, parallel)
        second = first.nothing()
        unsure = np.flatnonzero(crops.n_blobs > 1)
        if len(unsure):
            others = others[unsure]
            other = self._sighted(others, scene.looks(others, camera_view), size, parallel)
            better = self._is_animal(depths[unsure], scene, size, first[unsure], other)
            second.put(unsure, other)
            rows = unsure[better]
            kept = first[rows]
            first.put(rows, other[better])
            second.put(rows, kept)
        return first, second

    def _estimates(self, sight: _Sight, size: float, parallel: bool) -> Estimates:
        """The chosen poses of what was seen, in the camera frame."""
        crops = sight.crops
        usable = sight.usable
        seen = sight[np.flatnonzero(usable)]
        images = ImageSet(seen.crops.heights, seen.looks, seen.crops.moments)
        picked = self.pick(images, size, seen.rotations, seen.positions, seen.scores, parallel)
        picked = with_expected_error(picked, self.model, images.moments, images.looks, size)
        whole = _spread_out(picked, usable, self.skeleton.n_joints)
        return Estimates(
            replace(whole, pose=whole.pose.moved(view_of(sight.looks).inverse())), usable, crops
        )

    def pick(
        self,
        images: ImageSet,
        size: float,
        rotations: Array,
        positions: Array,
        scores: Array,
        parallel: bool = True,
    ) -> Chosen:
        """One pose for each of n height maps out of its candidates, after the last correction, and
        settled.

        Where the method takes poses into the picture, it is of the mean and the best ones the one
        that then fits best.
        """
        method = self.model.method
        picked = choose(
            self.skeleton, method, self.model.calibration, size, rotations, positions, scores
        )
        with threads(parallel):
            if method.refine_steps and len(scores):
                poses = with_best(
                    self.skeleton, picked.pose, method.refined, rotations, positions, scores
                )
                pose, fit = self._refiner.best(poses, images, size, method.refine_steps)
                picked = replace(picked, pose=pose, fit=fit, told_scale=pose.scale)
            picked = corrected(picked, self.model, images, size)
            if self.model.settler is None or not len(scores):
                return picked
            settled = Settler(self.skeleton, self.model.settler).settle(picked.pose, images, size)
        return replace(
            picked,
            pose=settled.pose,
            told_scale=size * np.exp(settled.grown),
            told_trust=settled.clear,
        )

    def _is_animal(
        self,
        depths: NDArray[np.float32],
        scene: Foreground,
        size: float,
        first: _Sight,
        second: _Sight,
    ) -> NDArray[np.bool_]:
        """Where (n,) the second of two things of about the animal's size is the animal, and not the
        first.

        Told by area and volume and, where the metric has learned what is no animal, by its scores.
        """
        weight = _MM_PER_MISFIT * self.skeleton.relative_size
        crops = first.crops, second.crops
        if self.model.method.camera_view:  # likeness is told by what the scene's own view shows
            crops = scene.extract_both(depths, size)
        likeness = [weight * scene.misfit(crop) for crop in crops]
        if not self.model.method.metric_on_own:
            return likeness[1] < likeness[0]
        return second.scores.min(axis=1) + likeness[1] < first.scores.min(axis=1) + likeness[0]

    def find_size(self, sample: NDArray[np.float32], scene: Foreground) -> float:
        """The animal's spine over the home length, estimated from a sample of frames (n, H, W) mm
        of the recording.

        The area seen from above gives the first guess; the model then measures the spine in every
        frame, the median of the frames that it trusts most becomes the next guess, a few times
        over.
        """
        guess = self.size_from_area(scene.area_mm2)
        if not self.model.method.session_size:
            return 1.0
        # the last correction has learned how long animals of usual shape are: it would pull this
        # one's size to theirs
        uncorrected = replace(self, model=replace(self.model, corrector=None))
        for _ in range(_SIZE_PASSES):
            estimates = uncorrected.estimate(sample, scene, guess)
            if not estimates.found.any():
                raise EstimationError(
                    "no animal was found in the sampled frames, so its size could not be measured"
                )
            guess = float(np.median(self.sizes_told(estimates)))
        return guess

    def sizes_told(self, estimates: Estimates) -> Array:
        """What frames tell of the animal's size over the home size, those of them that the model
        trusts most.
        """
        scale = estimates.chosen.told_scale
        trust = estimates.chosen.told_trust
        seen = np.flatnonzero(estimates.found)
        n_trusted = (
            len(seen) * 2 // 3 if self.model.settler is None else round(len(seen) * SURE_SHARE)
        )
        return np.asarray(scale[seen[np.argsort(-trust[seen])[: max(8, n_trusted)]]])

    def size_from_area(self, area_mm2: float) -> float:
        """A first guess of the size from the animal's usual area."""
        return float(np.sqrt(area_mm2 / self.model.calibration.area_mm2))


def _pack(forests: list[Forest]) -> kernels.Trees:
    """Forests of equally many trees in one node array; their leaves, of different widths, in one
    row of numbers.
    """
    nodes = []
    roots = []
    n_nodes = 0
    for forest in forests:
        shifted = forest.nodes.copy()
        shifted[shifted[:, 2] >= 0, 2] += n_nodes
        nodes.append(shifted)
        roots.append(forest.roots + n_nodes)
        n_nodes += len(forest.nodes)
    sizes = np.array([forest.leaves.size for forest in forests])
    return kernels.Trees(
        np.concatenate(nodes),
        np.stack(roots),
        np.concatenate([forest.leaves.ravel() for forest in forests]),
        np.cumsum(sizes) - sizes,
        np.array([forest.leaves.shape[1] for forest in forests]),
    )


def _spread_out(picked: Chosen, usable: NDArray[np.bool_], n_joints: int) -> Chosen:
    """The chosen poses of the usable frames as rows of all frames, NaN elsewhere."""
    n = len(usable)

    def rows(values: Array, *shape: int) -> Array:
        out = np.full((n, *shape), np.nan)
        out[usable] = values
        return out

    pose = Pose(
        SE3(rows(picked.pose.root.rotation, 3, 3), rows(picked.pose.root.translation, 3)),
        rows(picked.pose.angles, n_joints, 3),
        rows(picked.pose.scale),
    )
    return Chosen(
        pose,
        rows(picked.sd_root, 6),
        rows(picked.sd_angles, n_joints, 3),
        rows(picked.sd_mm, n_joints),
        rows(picked.error_mm),
        rows(picked.score),
        rows(picked.spread),
        rows(picked.doubts, 4),
        rows(picked.fit, picked.fit.shape[1]),
        rows(picked.told_scale),
        rows(picked.told_trust),
    )
