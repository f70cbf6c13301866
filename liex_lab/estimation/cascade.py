"""Cascaded pose regression on a kinematic tree: the forests, their features and their labels.

Lie-X Algorithms 1 and 2 (section 4.1). For joint j, base first, and round c, the forest R_j^(c)
predicts the tangent vector r from features at the current pose, and

    g_{1:j} <- g_{1:j} exp(r)                                                       (Eq. 10),

    label = log(g_est^-1 g_true)                                                    (Eq. 11),

so corrections are in the joint's own frame. A joint other than the base corrects the rotation about
its free axes only. Estimation runs the same steps in `_cascade_kernels`; this module is used in
training, and to follow the cascade step by step.

Initial poses (section 4, preprocessing): the paper places the home pose at the centroid and the
mean depth of the foreground, rotates it in the image plane by an angle uniform in (-pi, pi), and
scales all bones by a factor uniform in [0.9, 1.1]; this is repeated Kt times. The default method
starts along the principal axis of the foreground in both directions, with small jitter (PCA
initialisation), which needs fewer initial poses.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import ndtr

from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import KinematicTree, aim
from liex_lab.body.shape import Spheres
from liex_lab.body.skeleton import REFERENCE_MM, Skeleton
from liex_lab.estimation import _feature_kernels as kernels
from liex_lab.estimation import _residual_kernels as residual_kernels
from liex_lab.estimation._cascade_kernels import modes_of_votes
from liex_lab.estimation.method import Method
from liex_lab.forests._kernels import VIEW
from liex_lab.forests.forest import Forest, Samples, predict, predict_each
from liex_lab.forests.grow import grow_forest
from liex_lab.geometry import SE3, so3
from liex_lab.runtime.memory import Rows, check_index, check_shapes
from liex_lab.runtime.processes import in_parallel
from liex_lab.scene._blob_kernels import N_MOMENTS
from liex_lab.scene._height_map_kernels import N_CROP_CAMERA
from liex_lab.scene.height_maps import moment_columns


@dataclass
class Candidates:
    """Candidate poses in progress, n of them on a set of images, as frames of all joints.

    Attributes:
        image: (n,) int32 index of each candidate's image.
        rotations: (n, J, 3, 3) joint frames, in the view frame of the image.
        positions: (n, J, 3) joints, mm, in the view frame of the image.
        scale: (n,) scale of the bones over their home lengths.
        size: (n,) the animal's size over home size, which normalises features.
    """

    image: NDArray[np.int32]
    rotations: Array
    positions: Array
    scale: Array
    size: Array

    def __post_init__(self) -> None:
        """Check that the shapes match, as kernels do not."""
        check_shapes(
            "candidates",
            ("image", self.image, ("n",)),
            ("rotations", self.rotations, ("n", "J", 3, 3)),
            ("positions", self.positions, ("n", "J", 3)),
            ("scale", self.scale, ("n",)),
            ("size", self.size, ("n",)),
        )

    @staticmethod
    def start(
        skeleton: Skeleton,
        image: NDArray[np.int32],
        rotation: Array,
        position: Array,
        scale: Array,
        size: Array,
    ) -> "Candidates":
        """Make candidates with only the base in place.

        Args:
            skeleton: the animal's skeleton.
            image: (n,) int32 index of each candidate's image.
            rotation: (n, 3, 3) base rotation, view frame.
            position: (n, 3) base position, mm, view frame.
            scale: (n,) scale of the bones; copied.
            size: (n,) the animal's size over home size; not copied.
        """
        joints = len(image), skeleton.n_joints
        rotations = np.zeros((*joints, 3, 3))
        positions = np.zeros((*joints, 3))
        rotations[:, 0] = rotation
        positions[:, 0] = position
        return Candidates(image, rotations, positions, scale.copy(), size)

    def __len__(self) -> int:
        """Number of candidates."""
        return len(self.image)


@dataclass(frozen=True)
class ImageSet(Rows):
    """Height maps with their crop cameras and moments.

    Attributes:
        heights: (m, S, S) int16 height maps, 1/16 mm, 0 outside the animal.
        crop_cameras: (m, 17) packed crop cameras, see `CropCamera`.
        moments: (m, 9) moments of the animal's blob, see `HeightMaps`.
    """

    heights: NDArray[np.int16]
    crop_cameras: Array
    moments: Array

    def __post_init__(self) -> None:
        """Check that the shapes match, as kernels do not."""
        check_shapes(
            "images",
            ("heights", self.heights, ("m", "S", "S")),
            ("crop_cameras", self.crop_cameras, ("m", N_CROP_CAMERA)),
            ("moments", self.moments, ("m", N_MOMENTS)),
        )


@dataclass(frozen=True)
class Cascade:
    """A skeleton, a method, and one regression forest per solved joint and round.

    Attributes:
        skeleton: the animal's skeleton.
        method: the variant of the method.
        forests: the forests of every round of each solved joint, in order.
        proposals: forest that proposes initial poses; None if they are drawn.
    """

    skeleton: Skeleton
    method: Method
    forests: list[list[Forest]]
    proposals: Forest | None = None

    def n_values(self, joint: int) -> int:
        """Length of a joint's correction.

        Args:
            joint: number of the joint.

        Returns:
            6 for the base, or 7 with the scale; otherwise the number of the joint's free axes.
        """
        return int(self.skeleton.axes[joint].sum()) if joint else 6 + self.method.regress_scale

    def place(self, candidates: Candidates, joint: int) -> None:
        """Place a joint relative to its parent, which must be in place, at its home angle.

        Args:
            candidates: changed in place.
            joint: number of the joint.
        """
        in_parallel(
            kernels.place_all,
            len(candidates),
            joint,
            KinematicTree.of(self.skeleton),
            candidates.scale,
            candidates.rotations,
            candidates.positions,
        )

    def steps(self, images: ImageSet, candidates: Candidates) -> Iterator[tuple[int, int]]:
        """Run Algorithm 1 as written in the paper, one forest after the other.

        Every candidate is moved independently, without pruning. Yields after each forest.

        Args:
            images: the candidates' images.
            candidates: with their base in place; changed in place.

        Yields:
            The joint and the round of the forest that was just applied.
        """
        for joint, rounds in zip(self.skeleton.solved, self.forests, strict=True):
            if joint:
                self.place(candidates, joint)
            for c, forest in enumerate(rounds):
                values = self.predict(forest, self.samples(images, candidates, [joint]))
                self.apply(candidates, joint, values)
                yield joint, c
        self.place_ends(candidates)

    def predict(
        self, forest: Forest, samples: Samples, in_bag: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float32]:
        """A forest's prediction for samples, in training and in estimation.

        It is the mean-shift mode of the trees' votes if the method has a bandwidth, as for the
        paper's regressors and metric, else their mean.

        Args:
            forest: a regressor or the learned metric.
            samples: n samples.
            in_bag: (T, n_images) bool, the images each tree was grown on, to exclude such trees;
                None uses all trees, as a mode always does.

        Returns:
            (n, D) float32 predictions.
        """
        if self.method.mean_shift_mm <= 0:
            return predict(forest, samples, in_bag)
        votes = predict_each(forest, samples)
        modes = np.empty((len(samples), votes.shape[2]))
        in_parallel(modes_of_votes, len(votes), votes, self.method.mean_shift_mm, modes)
        return modes.astype(np.float32)

    def place_ends(self, candidates: Candidates) -> None:
        """Place every joint without a regressor relative to its parent; changes the candidates."""
        for joint in range(1, self.skeleton.n_joints):
            if joint not in self.skeleton.solved:
                self.place(candidates, joint)

    def samples(self, images: ImageSet, candidates: Candidates, joints: list[int]) -> Samples:
        """Features of the candidates relative to the given joints.

        Args:
            images: the candidates' images.
            candidates: n candidates.
            joints: the joints of the views; the first one gives the scalars.

        Returns:
            n samples with one view per joint, on the height maps of the images.
        """
        check_index("images", candidates.image, len(images.heights))
        n = len(candidates)
        views = np.empty((n, len(joints), VIEW), np.float32)
        scalars = np.empty((n, kernels.N_SCALARS), np.float32)
        in_parallel(
            kernels.all_features,
            n,
            np.array(joints),
            images.crop_cameras,
            images.moments,
            candidates.image,
            candidates.size,
            self.method.reaches(self.skeleton.n_joints)[joints],
            candidates.rotations,
            candidates.positions,
            candidates.scale,
            kernels.FeatureRows(views, scalars),
        )
        return Samples(
            images.heights,
            candidates.image,
            (1.0 / candidates.size).astype(np.float32),
            views,
            scalars,
        )

    @cached_property
    def balls(self) -> Spheres:
        """The body's sphere model, which candidates are compared with the height map by."""
        return Spheres.of(self.skeleton)

    def metric_samples(self, images: ImageSet, candidates: Candidates) -> Samples:
        """Features of finished candidates for the learned metric.

        They are computed from all joints; if the method uses them, the residuals of the posed body
        against the height map are appended to the scalars.

        Args:
            images: the candidates' images.
            candidates: n candidates with all joints in place.

        Returns:
            n samples with J views.
        """
        samples = self.samples(images, candidates, list(range(self.skeleton.n_joints)))
        if not self.method.explains:
            return samples
        fit = residuals(images, candidates, body_of(self.balls))
        return replace(samples, scalars=np.concatenate([samples.scalars, fit], axis=1))

    def apply(self, candidates: Candidates, joint: int, values: NDArray[np.float32]) -> None:
        """Move the candidates by a forest's prediction (Eq. 10).

        Args:
            candidates: n candidates, changed in place.
            joint: number of the joint to correct.
            values: (n, n_values) float32 correction, rotations times their lever arm, mm at home
                size.
        """
        c = candidates
        method = self.method
        if joint == 0:
            levers = np.array([method.base_lever_mm, method.scale_lever_mm])
            in_parallel(
                kernels.correct_base_all,
                len(c),
                c.rotations,
                c.positions,
                c.scale,
                values,
                levers,
                c.size,
            )
        else:
            in_parallel(
                kernels.correct_joint_all,
                len(c),
                joint,
                c.rotations,
                self.skeleton.axes[joint],
                values,
                method.joint_lever_mm,
            )

    def labels(
        self, candidates: Candidates, joint: int, truth: "Truth"
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Corrections from the candidates to the truth, and the samples to learn from.

        Base: log(g_est^-1 g_true) (Eq. 11) with lengths at home size and, if the method corrects
        it, the logarithm of the ratio of scales. Other joints: the remaining rotation about the
        free axes, or the one that aims the bone at the true next joint.

        Args:
            candidates: n candidates with the joint in place.
            joint: number of the joint.
            truth: true poses of the images.

        Returns:
            (n, n_values) labels, rotations and log scale times their lever arms, and (n,) bool, the
            samples near enough to the truth to learn from.
        """
        method = self.method
        i = candidates.image
        estimate = SE3(candidates.rotations[:, joint], candidates.positions[:, joint])
        true = SE3(truth.rotations[i, joint], truth.positions[i, joint])
        if joint == 0:
            twist = (estimate.inverse() @ true).log()
            keep = np.linalg.norm(twist[:, :3], axis=1) < method.keep_turned
            twist[:, :3] *= method.base_lever_mm
            twist[:, 3:] /= candidates.size[:, None]
            if not method.regress_scale:
                return twist, keep
            grow = np.log(truth.scale[i] / candidates.scale) * method.scale_lever_mm
            return np.concatenate([twist, grow[:, None]], axis=1), keep
        axes = self.skeleton.axes[joint]
        if method.point_at:
            child = self.skeleton.next_joint[joint]
            ahead = truth.positions[i, child] - estimate.translation
            ahead = (ahead[:, None, :] @ estimate.rotation)[:, 0]
            turn = aim_about(self.skeleton.offsets[child], ahead, axes)[:, axes]
        else:
            turn = so3.log(np.swapaxes(estimate.rotation, 1, 2) @ true.rotation)[:, axes]
        distance = np.linalg.norm(true.translation - estimate.translation, axis=1) / candidates.size
        keep = (np.linalg.norm(turn, axis=1) < method.keep_bent) & (distance < method.keep_off_mm)
        return turn * method.joint_lever_mm, keep


def body_of(balls: Spheres) -> residual_kernels.SphereModel:
    """The body's spheres as a record for the kernels."""
    return residual_kernels.SphereModel(
        balls.unit_mm, balls.n_own, balls.joints, balls.offsets, balls.share, balls.radius
    )


def residuals(
    images: ImageSet, candidates: Candidates, body: residual_kernels.SphereModel
) -> NDArray[np.float32]:
    """Residuals (n, N_FIT) of n posed bodies against their height maps."""
    out = np.empty((len(candidates), residual_kernels.N_FIT), np.float32)
    in_parallel(
        residual_kernels.explain_all,
        len(candidates),
        images.heights,
        images.crop_cameras,
        images.moments,
        candidates.image,
        candidates.rotations,
        candidates.positions,
        candidates.scale,
        candidates.size,
        body,
        out,
    )
    return out


@dataclass(frozen=True)
class Truth(Rows):
    """True poses of m images, in their view frames.

    Attributes:
        rotations: (m, J, 3, 3) joint frames.
        positions: (m, J, 3) joints, mm.
        scale: (m,) scale of the bones.
    """

    rotations: Array
    positions: Array
    scale: Array


@dataclass(frozen=True)
class TrainingSet(Rows):
    """Images with their true poses in the view frame.

    Attributes:
        images: m images.
        truth: true poses of the m images.
        size: (m,) the true size of each animal over home size.
        animal: (m,) bool, False if the height map shows another object of about the animal's size;
            such an image is a negative example of the learned metric, and not used by the
            regressors.
    """

    images: ImageSet
    truth: Truth
    size: Array
    animal: NDArray[np.bool_]


def aim_about(bone: Array, direction: Array, axes: NDArray[np.bool_]) -> Array:
    """Rotation vectors about free axes that rotate a bone towards given directions.

    A hinge rotates by the angle as projected along its axis. A joint with more axes uses the
    smallest rotation; the caller drops components about its fixed axes.

    Args:
        bone: (3,) the bone at home, in the joint's frame.
        direction: (n, 3) target directions, in the joint's frame.
        axes: (3,) bool, the free axes.

    Returns:
        (n, 3) rotation vectors, rad.
    """
    if axes.sum() > 1:
        return aim(bone, direction)
    axis = axes.astype(float)
    flat_bone = bone - (bone @ axis) * axis
    flat = direction - (direction @ axis)[:, None] * axis
    angle = np.arctan2(
        np.cross(np.broadcast_to(flat_bone, flat.shape), flat) @ axis, flat @ flat_bone
    )
    return angle[:, None] * axis


# Initial poses from the moments of the foreground: PCA initialisation, or the paper's.


_JITTER = (
    0.12,
    0.7,
)  # rad: spread of the headings of a long thin animal, and the increase for a round one


def draw_starts(rng: np.random.Generator, n_images: int, n_candidates: int) -> Array:
    """Draw the standard numbers of initial poses.

    Args:
        rng: source of the numbers.
        n_images: number of images.
        n_candidates: number of initial poses per image.

    Returns:
        (n_images, n_candidates, 4): three standard normal numbers, for heading and position (the
        second also for the paper's scale), and one uniform in (-1, 1), for the paper's heading and
        the rise; see `start_poses`.
    """
    starts = rng.standard_normal((n_images, n_candidates, 4))
    starts[..., 3] = rng.uniform(-1.0, 1.0, (n_images, n_candidates))
    return starts


def start_poses(
    moments: Array, starts: Array, size: Array, skeleton: Skeleton, method: Method
) -> tuple[Array, Array, Array]:
    """Base poses of K candidates for each of n animals.

    Along the long axis, every other start points in the opposite direction, and the spread of the
    headings increases with the roundness of the animal; in camera view, an animal rises or sinks
    with the slope of its back. The paper's start has any heading in (-pi, pi), the base at the
    centroid and at the animal's mean height, and bones scaled by a factor uniform in [0.9, 1.1].

    Args:
        moments: (n, 9) moments of the height map, see `HeightMaps`.
        starts: (n or 1, K, 4) numbers drawn by `draw_starts`.
        size: (n, K) the animal's size over home size.
        skeleton: the animal's; its base joint is the front, like the fish's head, or the rear.
        method: whether to start along the long axis, the view of the height map, and the rotation
            of the home pose relative to the view from above, as for a hand that shows its palm.

    Returns:
        Base rotation (n, K, 3, 3), base position (n, K, 3) mm and scale (n, K), view frame.
    """
    n, k = size.shape
    starts = np.broadcast_to(starts, (n, k, 4))
    blob = moment_columns(moments)
    centre = np.stack([blob.x, blob.y], axis=-1)[:, None]
    position = np.empty((n, k, 3))
    mean_height = (blob.volume_mm3 / np.maximum(blob.area_mm2, 1.0))[:, None]
    home_length = skeleton.length
    opposite = np.arange(k) % 2
    if method.axis_start:
        jitter = 2.0 * round(home_length / REFERENCE_MM, 6)
        spread = _JITTER[0] + _JITTER[1] * (blob.sd_across / np.maximum(blob.sd_along, 1e-6)) ** 2
        heading = blob.angle[:, None] + np.pi * opposite + spread[:, None] * starts[..., 0]
        scale = size.copy()
        base_at_front = skeleton.offsets[skeleton.next_joint[0], 0] < 0
        # the base is this far from the centroid, towards its own end
        behind = 0.42 * home_length * scale * (-1.0 if base_at_front else 1.0)
        direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        position[..., :2] = (
            centre - behind[..., None] * direction + jitter * scale[..., None] * starts[..., 1:3]
        )
        high = 0.2 * home_length * scale  # above the floor
        low = mean_height - 0.05 * home_length * scale  # in camera view, below the mean height
        position[..., 2] = low if method.camera_view else high
    else:
        heading = np.pi * starts[..., 3]
        # the quantile of a standard normal number is uniform
        scale = size * (1.0 + 0.1 * (2.0 * ndtr(starts[..., 1]) - 1.0))
        position[..., :2] = centre
        position[..., 2] = mean_height
    rotation = _turned(heading, 0, 1)
    if method.axis_start and method.camera_view:
        slope = np.arctan(blob.slope[:, None]) * (1.0 - 2.0 * opposite)
        rise = slope + 0.03 * starts[..., 3]
        rotation = rotation @ _turned(rise, 0, 2)
        # the base is ahead of or behind the middle of the animal
        position[..., 2] -= behind * np.sin(rise)
    if any(method.home_turn):
        rotation = rotation @ so3.exp(np.array(method.home_turn))
    return rotation, position, scale


def _turned(angle: Array, a: int, b: int) -> Array:
    """Rotations (..., 3, 3) from axis a towards axis b by an angle (...), rad."""
    rotation = np.zeros((*angle.shape, 3, 3)) + np.eye(3)
    rotation[..., a, a] = rotation[..., b, b] = np.cos(angle)
    rotation[..., b, a] = np.sin(angle)
    rotation[..., a, b] = -rotation[..., b, a]
    return rotation


# Initial poses proposed by a regression forest, for an animal of any orientation (ours).


N_DIRECTIONS = 2  # both directions along the animal's long axis


def views_along_axis(
    images: ImageSet, size: Array, reach_mm: float
) -> tuple[Samples, Array, Array]:
    """Features of each animal from its centre, with x along its long axis in both directions.

    Args:
        images: m images.
        size: (m,) the animals' size over home size.
        reach_mm: range of offsets from the centre, mm at home size.

    Returns:
        2 m samples, an image's two in a row, and their frames: rotations (2 m, 3, 3) and centres (2
        m, 3) mm, view frame.
    """
    m = len(images.heights)
    image = np.repeat(np.arange(m, dtype=np.int32), N_DIRECTIONS)
    opposite = np.arange(N_DIRECTIONS * m) % N_DIRECTIONS
    blob = moment_columns(images.moments[image])
    turn = np.zeros((N_DIRECTIONS * m, 3))
    turn[:, 2] = blob.angle + np.pi * opposite
    rotation = so3.exp(turn)
    position = np.column_stack([blob.x, blob.y, blob.volume_mm3 / np.maximum(blob.area_mm2, 1.0)])
    each = size[image]
    views = np.empty((N_DIRECTIONS * m, 1, VIEW), np.float32)
    scalars = np.empty((N_DIRECTIONS * m, kernels.N_SCALARS), np.float32)
    in_parallel(
        kernels.all_features,
        len(image),
        np.zeros(1, np.int64),
        images.crop_cameras,
        images.moments,
        image,
        each,
        np.array([reach_mm]),
        rotation[:, None],
        position[:, None],
        each,
        kernels.FeatureRows(views, scalars),
    )
    # some segmenters determine the direction of the long axis
    rows = np.column_stack([scalars, (1000.0 - 2000.0 * opposite).astype(np.float32)])
    samples = Samples(images.heights, image, (1.0 / each).astype(np.float32), views, rows)
    return samples, rotation, position


def train_proposals(
    data: TrainingSet, method: Method, rng: np.random.Generator
) -> tuple[Forest, NDArray[np.bool_]]:
    """Train the forest that proposes base poses, on the images that show the animal.

    Args:
        data: m training images with truth; an error is added to the animals' size.
        method: states the plan, the reach of the features and the lever arm of rotations.
        rng: source of bags, seeds and size errors.

    Returns:
        The forest, with leaves of float16 precision, and (T, m) bool, the images each tree was
        grown on.
    """
    assert method.proposals is not None
    truth = data.truth
    # as a session's estimated size errs
    guess = data.size * np.exp(0.08 * rng.standard_normal(len(data.size)))
    samples, frame, centre = views_along_axis(data.images, guess, method.proposal_reach_mm)
    i = samples.image
    turned = np.swapaxes(frame, 1, 2) @ truth.rotations[i, 0]
    offset = np.einsum("nji,nj->ni", frame, truth.positions[i, 0] - centre) / guess[i][:, None]
    labels = np.concatenate([method.base_lever_mm * turned.reshape(-1, 9), offset], axis=1)
    forest, in_bag = grow_forest(
        samples, labels.astype(np.float32), data.animal[i], method.proposals, rng
    )
    return forest.quantised(), in_bag


def propose(forest: Forest, images: ImageSet, size: Array, method: Method) -> tuple[Array, Array]:
    """Base poses that each tree votes for, from both directions of the long axis.

    Args:
        forest: the forest of T trees.
        images: m images.
        size: (m,) the animals' size over home size.
        method: the method that the forest was trained for.

    Returns:
        Rotations (m, 2 T, 3, 3) and positions (m, 2 T, 3) mm, view frame; candidate 2 t + w is tree
        t's, with the axis in direction w.
    """
    samples, frame, centre = views_along_axis(images, size, method.proposal_reach_mm)
    votes = predict_each(forest, samples).astype(float)
    rotation = frame[:, None] @ so3.nearest_rotation(votes[..., :9].reshape(*votes.shape[:2], 3, 3))
    offset = np.einsum("nij,ntj->nti", frame, votes[..., 9:]) * size[samples.image][:, None, None]
    position = centre[:, None] + offset

    m = len(size)
    # from (2 m, T, ...) to (m, 2 T, ...), the tree varying more slowly
    by_direction = (v.reshape(m, N_DIRECTIONS, -1, *v.shape[2:]) for v in (rotation, position))
    rotation, position = (np.swapaxes(v, 1, 2).reshape(m, -1, *v.shape[3:]) for v in by_direction)
    return rotation, position
