"""Training of the cascaded regressors (Lie-X Algorithm 2) and of the learned internal metric.

Each forest is trained on the result of its predecessors: after round c of joint j its prediction
moves all training candidates, and the label of the next round is again log(g_est^-1 g_true) (Eq.
11). Depending on the method, a candidate is moved only by trees that were not grown on its image.

The learned metric R_m (section 4.1) is a forest that predicts the mean joint error of a pose
without the truth. The paper trains it on perturbed true poses; the default method trains it on the
cascade's own final candidates, and boosts it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.cascade import Candidates, Cascade, ImageSet, Truth
from liex_lab.estimation.initial import (
    N_DIRECTIONS,
    draw_starts,
    propose,
    start_poses,
    train_proposals,
)
from liex_lab.estimation.method import Method
from liex_lab.forests.forest import Forest
from liex_lab.forests.grow import boost_forest, grow_forest
from liex_lab.geometry import SE3, so3

Array = NDArray[np.float64]
ProgressCallback = Callable[[float, str], None]  # completed share, name of the step

# at the reference length: larger errors are capped, as their differences do not matter
_ERROR_CAP_MM = 30.0
_FEW_JOINTS = 3
_PRUNER_SHRINKAGE = 0.3
_SIZE_SD = 0.08  # standard deviation (log) of a session's estimated size


@dataclass(frozen=True)
class TrainingSet:
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

    @staticmethod
    def join(parts: list[TrainingSet]) -> TrainingSet:
        """Concatenate the images of multiple sets."""
        images = [p.images for p in parts]
        truths = [p.truth for p in parts]
        return TrainingSet(
            ImageSet(
                *(
                    np.concatenate([getattr(i, name) for i in images])
                    for name in ImageSet.__annotations__
                )
            ),
            Truth(
                *(
                    np.concatenate([getattr(t, name) for t in truths])
                    for name in Truth.__annotations__
                )
            ),
            np.concatenate([p.size for p in parts]),
            np.concatenate([p.animal for p in parts]),
        )


def base_at_front(skeleton: Skeleton) -> bool:
    """Whether the base joint is the animal's front, like the fish's head, or its rear, like the
    mouse's rump.
    """
    return bool(skeleton.offsets[skeleton.next_joint[0], 0] < 0)


@dataclass(frozen=True)
class Proposals:
    """A forest that proposes initial poses, and the images each of its trees was grown on.

    Attributes:
        forest: the forest.
        in_bag: (T, m) bool.
    """

    forest: Forest
    in_bag: NDArray[np.bool_]

    @staticmethod
    def train(data: TrainingSet, method: Method, rng: np.random.Generator) -> Proposals:
        """Train the proposals on the bases of the images that show the animal.

        Args:
            data: m training images with truth.
            method: the variant, which states the plan of the forest.
            rng: source of bags, seeds and size errors.
        """
        truth = data.truth
        return Proposals(
            *train_proposals(
                data.images,
                truth.rotations[:, 0],
                truth.positions[:, 0],
                data.size,
                data.animal,
                method,
                rng,
            )
        )

    def draw(self, rng: np.random.Generator, m: int, k: int) -> NDArray[np.int64]:
        """Draw K different proposals for every image.

        In-bag trees are used only if there are not enough out-of-bag ones.

        Args:
            rng: source of the draw.
            m: number of images, as many as the forest was trained on.
            k: number of proposals per image.

        Returns:
            (m, k) numbers of proposals, as `propose` orders them.
        """
        order = rng.random((m, N_DIRECTIONS * self.forest.n_trees))
        order += np.repeat(self.in_bag, N_DIRECTIONS, axis=0).T
        return np.argsort(order, axis=1)[:, :k]


def start_candidates(
    data: TrainingSet,
    skeleton: Skeleton,
    method: Method,
    rng: np.random.Generator,
    proposals: Proposals | None = None,
) -> Candidates:
    """Initial poses for every training image, each with its own guess of the animal's size.

    Args:
        data: m training images.
        skeleton: the animal's skeleton.
        method: the variant, which states K, the number of initial poses per image.
        rng: source of the poses and of the size errors.
        proposals: if the method uses them; each initial pose is then that of a tree not grown on
            the image.

    Returns:
        m K candidates with their base in place, those of an image in a row.
    """
    m = len(data.size)
    k = method.training_candidates
    starts = draw_starts(rng, m, k)
    if method.session_size:
        size = data.size[:, None] * np.exp(_SIZE_SD * rng.standard_normal((m, k)))
    else:
        size = np.ones((m, k))
    rotation, position, scale = start_poses(
        data.images.moments,
        starts,
        size,
        skeleton.length,
        base_at_front(skeleton),
        method.axis_start,
        method.camera_view,
        method.home_turn,
    )
    if proposals is not None:
        bases, places = propose(proposals.forest, data.images, data.size, method)
        chosen = proposals.draw(rng, m, k)
        rotation = np.take_along_axis(bases, chosen[..., None, None], axis=1)
        position = np.take_along_axis(places, chosen[..., None], axis=1)
    image = np.repeat(np.arange(m, dtype=np.int32), k)
    return Candidates.start(
        skeleton,
        image,
        rotation.reshape(-1, 3, 3),
        position.reshape(-1, 3),
        scale.ravel(),
        size.ravel(),
    )


def train_cascade(
    data: TrainingSet,
    skeleton: Skeleton,
    method: Method,
    rng: np.random.Generator,
    tell: ProgressCallback,
) -> tuple[Cascade, Candidates]:
    """Train all regressors joint by joint and round by round (Lie-X Algorithm 2).

    Args:
        data: m training images with truth.
        skeleton: the animal's skeleton.
        method: the variant of the method.
        rng: source of all randomness.
        tell: called before each forest with the completed share and the name of the step.

    Returns:
        The cascade, and the training candidates after its last forest.
    """
    proposals = Proposals.train(data, method, rng) if method.proposals is not None else None
    cascade = Cascade(skeleton, method, [], proposals.forest if proposals is not None else None)
    candidates = start_candidates(data, skeleton, method, rng, proposals)
    n_steps = sum(method.rounds_of(joint) for joint in skeleton.solved)
    n_done = 0
    for joint in skeleton.solved:
        if joint:
            cascade.place(candidates, joint)
        rounds: list[Forest] = []
        for c in range(method.rounds_of(joint)):
            tell((n_done + c) / n_steps, f"{skeleton.names[joint]}, round {c + 1}")
            labels, keep = cascade.labels(candidates, joint, data.truth)
            samples = cascade.samples(data.images, candidates, [joint])
            keep &= data.animal[candidates.image]
            rows = np.ascontiguousarray(labels, np.float32)
            forest, in_bag = grow_forest(samples, rows, keep, method.regressors, rng)
            forest = quantised(forest)
            values = cascade.predict(forest, samples, in_bag if method.out_of_bag else None)
            cascade.apply(candidates, joint, values)
            rounds.append(forest)
        cascade.forests.append(rounds)
        n_done += len(rounds)
    cascade.place_ends(candidates)
    return cascade, candidates


def quantised(forest: Forest) -> Forest:
    """Round a forest's leaves to float16, the precision of the model file, so that training uses
    the same forest as estimation.

    Args:
        forest: the forest as grown.

    Returns:
        The forest with float32 leaves of float16 precision.
    """
    return Forest(forest.nodes, forest.roots, forest.leaves.astype(np.float16).astype(np.float32))


def joint_error(candidates: Candidates, truth: Truth) -> Array:
    """Mean joint error of candidates.

    Args:
        candidates: n candidates with all joints in place.
        truth: true poses of the images.

    Returns:
        (n,) mm at home size.
    """
    distance = np.linalg.norm(candidates.positions - truth.positions[candidates.image], axis=2)
    return distance.mean(axis=1) / candidates.size


def perturbed_truth(
    data: TrainingSet, cascade: Cascade, rng: np.random.Generator, n_each: int = 8
) -> Candidates:
    """Randomly perturbed true poses, the paper's training examples of the learned metric.

    The base moves by a random twist, every other joint rotates about its free axes; the strength is
    drawn uniformly for each pose. The paper does not state the distribution; a long chain bends no
    more as a whole than a short one.

    Args:
        data: training images with truth; only those of animals are used.
        cascade: gives skeleton and method.
        rng: source of the perturbations.
        n_each: poses per image.

    Returns:
        The perturbed poses as candidates.
    """
    skeleton = cascade.skeleton
    j = skeleton.n_joints
    image = np.repeat(np.flatnonzero(data.animal).astype(np.int32), n_each)
    size = np.ones(len(image)) if not cascade.method.session_size else data.size[image]
    strength = rng.uniform(0.0, 1.0, len(image))[:, None]
    shift_mm = 8.0 * skeleton.relative_size
    twist = (
        rng.standard_normal((len(image), 6))
        * np.array([0.4, 0.4, 0.9, shift_mm, shift_mm, shift_mm])
        * strength
    )
    base = SE3(data.truth.rotations[image, 0], data.truth.positions[image, 0]) @ SE3.exp(twist)
    candidates = Candidates.start(
        skeleton, image, base.rotation, base.translation, data.truth.scale[image], size
    )
    # a long chain bends no more as a whole than a short one
    bent = 0.35 * np.sqrt(min(1.0, _FEW_JOINTS / max(1, len(skeleton.solved) - 1)))
    for joint in range(1, j):
        cascade.place(candidates, joint)
        parent = skeleton.parents[joint]
        true = (
            np.swapaxes(data.truth.rotations[image, parent], 1, 2)
            @ data.truth.rotations[image, joint]
        )
        turn = bent * strength * rng.standard_normal((len(image), 3)) * skeleton.axes[joint]
        candidates.rotations[:, joint] = candidates.rotations[:, parent] @ true @ so3.exp(turn)
    return candidates


def train_metric(
    data: TrainingSet, cascade: Cascade, candidates: Candidates, rng: np.random.Generator
) -> Forest:
    """Train the learned metric, which predicts a pose's mean joint error without the truth.

    Examples are the cascade's own final candidates or, as in the paper, perturbed true poses,
    depending on the method. Errors are capped at 30 mm at the reference length, as differences
    between gross errors do not matter.

    Args:
        data: training images with truth.
        cascade: the trained cascade.
        candidates: its final training candidates.
        rng: source of bags, seeds and perturbations.

    Returns:
        The forest; its prediction is in mm at home size.
    """
    if not cascade.method.metric_on_own:
        candidates = perturbed_truth(data, cascade, rng)
    error = np.minimum(
        joint_error(candidates, data.truth), _ERROR_CAP_MM * cascade.skeleton.relative_size
    )
    samples = cascade.metric_samples(data.images, candidates)
    labels = error[:, None].astype(np.float32)
    method = cascade.method
    if method.metric_shrinkage > 0:
        return quantised(boost_forest(samples, labels, method.metric, method.metric_shrinkage, rng))
    return quantised(
        grow_forest(samples, labels, np.ones(len(candidates), np.bool_), method.metric, rng)[0]
    )


def train_pruner(
    data: TrainingSet, cascade: Cascade, candidates: Candidates, rng: np.random.Generator
) -> Forest | None:
    """Train the small metric that predicts the error of the whole pose from the base joint alone.

    The base does not move after its own rounds, so the cascade's final candidates are its examples,
    too.

    Args:
        data: training images with truth.
        cascade: the trained cascade.
        candidates: its final training candidates.
        rng: source of bags and seeds.

    Returns:
        The boosted forest, mm at home size; None if the method has no pruner.
    """
    plan = cascade.method.pruner
    if plan is None:
        return None
    error = np.minimum(
        joint_error(candidates, data.truth), _ERROR_CAP_MM * cascade.skeleton.relative_size
    )
    samples = cascade.samples(data.images, candidates, [0])
    return quantised(
        boost_forest(samples, error[:, None].astype(np.float32), plan, _PRUNER_SHRINKAGE, rng)
    )
