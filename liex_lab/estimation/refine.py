"""Corrections that follow the regressors and the learned metric (ours).

Gauss-Newton refinement fits a pose to the height map: articulated ICP with a sphere model. The body
is a set of spheres carried by the kinematic tree. With p the tangent vector of the base, the
logarithm of the scale and the free angles, each step minimises

    sum_i w_i d_i(p)^2 + w_b sum_k b_k(p)^2 + (p - p0)^T diag(prior) (p - p0)

over signed distances d_i of depth readings to the nearest sphere and of spheres to the readings
behind them, both with robust Geman-McClure weights, distances b_k of spheres outside the animal to
its nearest pixel, and a prior at the pose of the regressors. The kernels are in `_refine_kernels`.

A ridge correction moves the chosen pose of an unbranched animal, viewed along the optical axis, by
the back above it. The regressors estimate a long animal's depth from its base joint, at one end of
it; once the whole spine is in place, all of its back can be compared with it. A linear map fitted
by ridge regression (Hoerl and Kennard 1970),

    W = (X^T X + lambda n I)^-1 X^T Y        on standardised features X, lambda = 0.01,

on images that no tree was grown on, maps observations along the mid-line to the depth error of each
joint, the displacement of the spine along itself, and the relative error of the animal's size.

The head-tail classifier is a multilayer perceptron on the height map resampled along a candidate.
The learned metric compares two points at a time, and on unfamiliar bodies it confuses head and
tail; the whole outline, the ears and the slope of the back together separate them if the metric is
unsure. With the log odds l of the network for the best candidate of either direction, the direction
changes if

    score_opposite - score_best + w (l_best - l_opposite) < 0,

with w = 4 mm at the reference length.
"""

from dataclasses import dataclass

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import KinematicTree, Pose
from liex_lab.body.shape import Spheres
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation import _feature_kernels as feature_kernels
from liex_lab.estimation import _refine_kernels as kernels
from liex_lab.estimation import _residual_kernels as residual_kernels
from liex_lab.estimation.cascade import Candidates, ImageSet, body_of, residuals
from liex_lab.geometry import SE3
from liex_lab.mlp import Network, descend
from liex_lab.runtime.processes import in_parallel
from liex_lab.scene.height_maps import mm_per_px

_FIRST_STEPS = 1  # of all poses
# cost of leaving the pose of the regressors, in squares of the unit: a radian of the base, a unit
# of its position, of log scale, and a radian of a joint
_PRIOR = np.array([1e4, 0.5, 1e4, 60.0])


@dataclass(frozen=True)
class Refiner:
    """The Gauss-Newton refinement of poses of one skeleton.

    Attributes:
        skeleton: the animal's skeleton.
        tree: the kinematic tree as a record for the kernels.
        free_angles: its free angles, likewise.
        body: the sphere model, likewise.
    """

    skeleton: Skeleton
    tree: KinematicTree
    free_angles: kernels.FreeAngles
    body: residual_kernels.SphereModel

    @staticmethod
    def of(skeleton: Skeleton, balls: Spheres) -> "Refiner":
        """The refinement for a skeleton of any shape.

        Args:
            skeleton: the animal's skeleton.
            balls: the sphere model of its body.
        """
        tree = KinematicTree.of(skeleton)
        joint, axis = tree.free.T
        above = np.eye(skeleton.n_joints, dtype=bool)  # [j, a]: a is j or one of its ancestors
        for parent, child in skeleton.edges:
            above[child] |= above[parent]
        moves = np.ascontiguousarray(above[:, joint])
        limits = np.ascontiguousarray(skeleton.limits[joint, axis])
        movers = [np.flatnonzero(moves[one] | moves[other]) for one, other in balls.joints]
        turns = np.full((len(movers), max(map(len, movers), default=0)), -1, np.int64)
        for row, some in zip(turns, movers, strict=True):
            row[: len(some)] = some
        return Refiner(skeleton, tree, kernels.FreeAngles(limits, moves, turns), body_of(balls))

    def refine(
        self, pose: Pose, heights: NDArray[np.int16], crop_cameras: Array, size: float, n_steps: int
    ) -> Pose:
        """Fit poses to the height maps by Gauss-Newton steps.

        Args:
            pose: (n, K) poses in their view frames; not changed.
            heights: (n, S, S) int16 height maps, 1/16 mm, 0 outside the animal.
            crop_cameras: (n, 17) packed crop cameras of the height maps.
            size: the animal's size over home size.
            n_steps: number of Gauss-Newton steps.

        Returns:
            (n, K) refined poses.
        """
        unit = self.body.unit_mm * size
        root = SE3(pose.root.rotation.copy(), pose.root.translation.copy())
        moved = Pose(root, pose.angles.copy(), pose.scale.copy())
        # a reading 10 units off counts a quarter, a ball outside the animal 0.3 of a reading
        weights = kernels.ResidualWeights(
            10.0 * unit, 0.3, *(_PRIOR * np.array([unit**2, 1.0, unit**2, unit**2]))
        )
        in_parallel(
            kernels.refine_all,
            len(moved.scale),
            heights,
            crop_cameras,
            self.tree,
            self.free_angles,
            self.body,
            weights,
            n_steps,
            kernels.MovedPoses(root.rotation, root.translation, moved.angles, moved.scale),
        )
        return moved

    def fit(self, pose: Pose, images: ImageSet, size: float) -> Array:
        """Residuals of poses against the height maps.

        Args:
            pose: (n, K) poses in their view frames.
            images: n height maps with their crop cameras and moments.
            size: the animal's size over home size.

        Returns:
            (n, K, N_FIT) residuals, see `_residual_kernels.explain`.
        """
        frames = pose.frames(self.skeleton)
        n, k, j = frames.translation.shape[:3]
        candidates = Candidates(
            np.repeat(np.arange(n, dtype=np.int32), k),
            frames.rotation.reshape(-1, j, 3, 3),
            frames.translation.reshape(-1, j, 3),
            pose.scale.ravel(),
            np.full(n * k, size),
        )
        return residuals(images, candidates, self.body).reshape(n, k, -1).astype(float)

    def best(self, poses: Pose, images: ImageSet, size: float, n_steps: int) -> tuple[Pose, Array]:
        """Refine poses and choose the one that fits each height map best.

        All K poses are refined by one step, and the best two by the remaining steps.

        Args:
            poses: (n, K) poses in their view frames.
            images: n height maps with their crop cameras and moments.
            size: the animal's size over home size.
            n_steps: number of Gauss-Newton steps in all.

        Returns:
            (n) poses, and their residuals (n, N_FIT).
        """
        kept = poses
        rows = np.arange(len(poses.scale))[:, None]
        for n_more in (min(_FIRST_STEPS, n_steps), max(n_steps - _FIRST_STEPS, 0)):
            moved = self.refine(kept, images.heights, images.crop_cameras, size, n_more)
            fit = self.fit(moved, images, size)
            off = fit[..., residual_kernels.OUT_OF] + fit[..., residual_kernels.APART]
            beside = fit[..., residual_kernels.BESIDE] / residual_kernels.SHARE_UNIT
            # 4 units if all balls were outside the animal
            off_mm = off / residual_kernels.MM_UNIT + 4.0 * beside
            order = rows, np.argsort(off_mm, axis=1, kind="stable")[:, :2]
            kept = moved[order]
            fit = fit[order]
        return kept[:, 0], fit[:, 0]


# Ridge correction.


_MOST_SHARE = 0.08  # of the length: readings farther from the back than this are not the back
# share of the frames used for the size: those that show most of the animal's far end
SURE_SHARE = 1 / 3
N_OTHERS = 15  # clues that are not of one joint
_TAIL = 0.01  # quantile of a clue in training at which it is clipped


@dataclass(frozen=True)
class RidgeCorrection:
    """The fitted correction.

    Attributes:
        skeleton: the animal's skeleton, one unbranched chain.
        table: (F, J + 4), by columns: the least and the most of each feature of `clues` (beyond
            which it is clipped), then the weights of the features for the rise of each joint (J),
            the slide along the spine (both over the animal's length), and the logarithm of the true
            over the assumed size.
    """

    skeleton: Skeleton
    table: Array

    @staticmethod
    def fit(
        skeleton: Skeleton,
        pose: Pose,
        images: ImageSet,
        size: Array,
        true_joints: Array,
        true_size: Array,
    ) -> "RidgeCorrection":
        """Fit the correction to chosen poses with known truth.

        Poses with an error of a tenth of the length or more, or of 0.25 in the logarithm of the
        size, are excluded. Features are clipped to their 1 % and 99 % quantiles.

        Args:
            skeleton: the animal's skeleton, one unbranched chain.
            pose: (n) chosen poses, view frame.
            images: n height maps with their crop cameras and moments.
            size: (n,) assumed size over home size.
            true_joints: (n, J, 3) true joints, mm, view frame.
            true_size: (n,) true size over home size.
        """
        joints = pose.joints(skeleton)
        features = clues(skeleton, pose, joints, images, size)
        length = skeleton.length * size
        error = (true_joints - joints) / length[:, None, None]
        slide = np.sum(error * tangents(joints), axis=-1).mean(axis=1)
        grown = np.log(true_size / size)
        labels = np.column_stack([error[..., 2], slide, grown])
        good = np.linalg.norm(error, axis=-1).mean(axis=1) < 0.1
        good &= np.abs(grown) < 0.25
        bounds = np.quantile(features[good], [_TAIL, 1.0 - _TAIL], axis=0)
        # from all of them: those that show its far end best were mostly underestimated in size
        x = np.clip(features[good], *bounds)
        weights, constant = ridge_regression(x, labels[good], ridge=1e-2, least_spread=1e-6)
        weights[0] = constant  # the first feature is 1
        return RidgeCorrection(skeleton, np.column_stack([*bounds, weights]))

    def correct(self, pose: Pose, images: ImageSet, size: float) -> tuple[Pose, Array, Array]:
        """Correct poses, and estimate the animal's size from each of them.

        Args:
            pose: (n) chosen poses, view frame.
            images: n height maps with their crop cameras and moments.
            size: assumed size over home size.

        Returns:
            The corrected poses; the logarithm (n,) of the animal's true over its assumed size, as
            each pose estimates it; and (n,), in [0, 1], the visible share of the last quarter of
            the chain, which the size estimate requires.
        """
        skeleton = self.skeleton
        j = skeleton.n_joints
        joints = pose.joints(skeleton)
        features = clues(skeleton, pose, joints, images, np.full(len(joints), size))
        clipped = np.clip(features, self.table[:, 0], self.table[:, 1])
        # a product's last bits depend on the batch size, and a frame's pose must not
        correction = (clipped @ self.table[:, 2:]).round(12)
        length = skeleton.length * size
        moved = joints + length * correction[:, -2, None, None] * tangents(joints)
        moved[..., 2] += length * correction[:, :-2]
        corrected = Pose.from_joints(skeleton, moved, pose.root.rotation[..., 2])
        clear = features[:, 1 + j + 3 * j // 4 : 1 + 2 * j].mean(axis=1)
        return corrected, correction[:, -1], clear


def ridge_regression(x: Array, y: Array, ridge: float, least_spread: float) -> tuple[Array, Array]:
    """Ridge regression from features (n, F) to labels (n, K), on standardised features.

    Args:
        x: the features.
        y: the labels.
        ridge: penalty, of the features' variance.
        least_spread: a feature with a smaller standard deviation is constant: it has no
            information.

    Returns:
        Weights (F, K) of the features as they are, and the constant (K,).
    """
    middle = x.mean(axis=0)
    spread = x.std(axis=0)
    per = np.where(spread > least_spread, 1.0 / np.maximum(spread, least_spread), 0.0)
    z = (x - middle) * per
    normal = z.T @ z + ridge * len(z) * np.eye(z.shape[1])
    weights = np.linalg.solve(normal, z.T @ (y - y.mean(axis=0))) * per[:, None]
    return weights, y.mean(axis=0) - middle @ weights


def tangents(joints: Array) -> Array:
    """Unit tangents of chains of joints, in the image plane.

    Args:
        joints: (n, J, 3) joints, mm, view frame.

    Returns:
        (n, J, 3) unit vectors from base to tip with z = 0.
    """
    tangent = np.gradient(joints, axis=1)
    tangent[..., 2] = 0.0
    return np.asarray(tangent / np.maximum(np.linalg.norm(tangent, axis=-1, keepdims=True), 1e-9))


def clues(skeleton: Skeleton, pose: Pose, joints: Array, images: ImageSet, size: Array) -> Array:
    """Features of a pose against the height map along its mid-line.

    They are a constant, the height of the back over each joint (J) and its visible share (J), the
    extent of the animal past the ends of the chain and the square of that, the slope and roll of
    the base, the total bend, the size of a pixel, and the scale of the bones. Lengths are over the
    animal's own.

    Args:
        skeleton: the animal's skeleton, one unbranched chain.
        pose: (n) poses, view frame.
        joints: (n, J, 3) their joints, mm.
        images: n height maps with their crop cameras and moments.
        size: (n,) assumed size over home size.

    Returns:
        (n, F) features, F = 2 J + N_OTHERS.
    """
    n, j, _ = joints.shape
    length = skeleton.length * size
    profile = np.empty((n, 2 * j + 2))
    in_parallel(
        feature_kernels.back_profiles,
        n,
        images.heights,
        images.crop_cameras,
        np.ascontiguousarray(joints),
        length,
        _MOST_SHARE,
        profile,
    )
    share = np.minimum(profile[:, j : 2 * j] * 2.0, 1.0)
    back = np.clip(profile[:, :j] / length[:, None], -2 * _MOST_SHARE, 2 * _MOST_SHARE) * (
        share > 0
    )
    ends = profile[:, 2 * j :] / length[:, None]
    rise = pose.root.rotation[:, 2, 0]
    roll = pose.root.rotation[:, 2, 1]
    bent = np.abs(pose.angles[..., 2]).sum(axis=1)
    pixel = mm_per_px(images.crop_cameras) / length
    return np.column_stack(
        [
            np.ones(n),
            back,
            share,
            ends,
            ends**2,
            rise,
            np.abs(rise),
            rise**2,
            np.abs(roll),
            roll**2,
            bent,
            pixel,
            ends * pixel[:, None],
            np.log(pose.scale / size),
        ]
    )


# Head-tail classifier.


# at the reference length: extent of the image along and across the animal, and its step
_ALONG_MM = 50.0
_ACROSS_MM = 25.0
_STEP_MM = 2.5
# smaller differences between both directions' scores are unsure, at the reference length
UNSURE_MM = 15.0
_MOST_LOGIT = 6.0
_RATE = 1e-3


@dataclass(frozen=True)
class HeadTailClassifier:
    """The head-tail classifier.

    Attributes:
        skeleton: the animal's skeleton.
        network: the trained network on images from `laid_along`.
    """

    skeleton: Skeleton
    network: Network

    @staticmethod
    def fit(images: NDArray[np.float32], right: NDArray[np.bool_], seed: int) -> Network:
        """Train the network, also on mirrored images; weights are rounded to the precision of the
        model file.

        Args:
            images: (m, A, B) float32 images from `laid_along`.
            right: (m,) bool, whether the poses point in the right direction.
            seed: of the network's training.
        """
        inputs = np.concatenate([images, images[:, :, ::-1]]).reshape(2 * len(images), -1)
        layers = descend(
            inputs,
            np.concatenate([right, right]),
            (128, 32),
            epochs=15,
            batch=min(256, len(inputs)),
            rate=_RATE,
            least_rate=1e-2 * _RATE,
            weight_decay=1e-2,
            seed=seed,
        )
        # rounded to the precision of the model file
        return Network.plain(
            [part.astype(np.float16).astype(np.float32) for part in layer] for layer in layers
        )

    def logits(self, images: ImageSet, joints: Array, size: float) -> Array:
        """Log odds that poses point in the right direction.

        They are the mean over the image and its mirror image, computed in double precision and then
        rounded: the last bits of a product depend on the batch size, and a frame's pose must not.

        Args:
            images: n height maps with their crop cameras.
            joints: (n, J, 3) joints of the poses, mm, view frame.
            size: the animal's size over home size.

        Returns:
            (n,) log odds, between -6 and 6.
        """
        resampled = laid_along(self.skeleton, images, joints, np.full(len(joints), size))
        views = np.concatenate([resampled, resampled[:, :, ::-1]])
        flat = views.reshape(len(views), -1).astype(np.float64)
        return (
            np.clip(self.network.logits(flat).reshape(2, -1), -_MOST_LOGIT, _MOST_LOGIT)
            .mean(axis=0)
            .round(6)
        )

    def judged(self, images: ImageSet, positions: Array, scores: Array, size: float) -> Array:
        """Adjust the candidates' scores by the network if the metric is unsure of the direction.

        The metric is unsure if both directions have a candidate and their best scores are within 15
        mm at the reference length. If the network outweighs the difference, the scores of the
        leading direction are raised by the excess.

        Args:
            images: n height maps with their crop cameras.
            positions: (n, K, J, 3) joints of the candidates, mm, view frame.
            scores: (n, K) predicted errors, mm at home size.
            size: the animal's size over home size.

        Returns:
            (n, K) scores, mm at home size.
        """
        unit = self.skeleton.relative_size
        best, opposite, ahead, away = both_directions(positions, scores, self.skeleton.tip)
        doubted = np.flatnonzero(ahead < UNSURE_MM * unit)
        if not len(doubted):
            return scores
        poses = np.concatenate([positions[doubted, k[doubted]] for k in (best, opposite)])
        first, second = np.split(self.logits(images[np.tile(doubted, 2)], poses, size), 2)
        total = ahead[doubted] + 4.0 * unit * (first - second)
        wrong = doubted[total < 0]
        behind = (ahead[doubted] - total)[total < 0]
        judged = scores.copy()
        judged[wrong] += np.where(away[wrong], 0.0, behind[:, None])
        return judged


def both_directions(
    positions: Array, scores: Array, tip: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Best candidate of each frame, and the best one in the opposite direction.

    Args:
        positions: (n, K, J, 3) joints of the candidates, mm.
        scores: (n, K) predicted errors; infinite for missing candidates.
        tip: the joint that defines the direction from the base.

    Returns:
        The index (n,) of the best candidate; the index (n,) of the best one in the opposite
        direction; the difference (n,) of its score, infinite or NaN if absent; and (n, K)
        bool, the candidates in the opposite direction.
    """
    rows = np.arange(len(scores))
    best = scores.argmin(axis=1)
    direction = positions[:, :, tip] - positions[:, :, 0]
    away = np.einsum("nkd,nd->nk", direction, direction[rows, best]) < 0
    other = np.where(away, scores, np.inf)
    opposite = other.argmin(axis=1)
    with np.errstate(invalid="ignore"):
        return best, opposite, other[rows, opposite] - scores[rows, best], away


def laid_along(
    skeleton: Skeleton, images: ImageSet, joints: Array, size: Array
) -> NDArray[np.float32]:
    """Resample height maps along poses: the direction from base to tip is the first axis.

    Args:
        skeleton: the animal's skeleton.
        images: n height maps with their crop cameras.
        joints: (n, J, 3) joints of the poses, mm, view frame.
        size: (n,) the animals' size over home size.

    Returns:
        (n, A, B) float32 heights in units of 10 mm at home size, for the reference length; 0
        outside the animal.
    """
    unit = skeleton.relative_size
    along = np.arange(-_ALONG_MM, _ALONG_MM + 1e-6, _STEP_MM) * unit
    across = np.arange(-_ACROSS_MM, _ACROSS_MM + 1e-6, _STEP_MM) * unit
    out = np.empty((len(joints), len(along), len(across)))
    in_parallel(
        feature_kernels.lay_along,
        len(joints),
        images.heights,
        images.crop_cameras,
        joints[:, 0],
        joints[:, skeleton.tip],
        joints.mean(axis=1),
        size,
        along,
        across,
        out,
    )
    return (out / (10.0 * unit * size[:, None, None])).astype(np.float32)
