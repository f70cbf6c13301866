"""Training of the cascade and of its learned metric (Lie-X Algorithm 2 and the internal evaluation
metric).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.cascade import Candidates, Cascade, ImageSet, Truth
from liex_lab.estimation.initial import draw_starts, start_poses
from liex_lab.estimation.method import Method
from liex_lab.estimation.proposals import N_WAYS, propose, train_proposals
from liex_lab.forests.forest import Forest, predict
from liex_lab.forests.grow import boost_forest, grow_forest
from liex_lab.geometry import SE3, so3

Array = NDArray[np.float64]
Tell = Callable[[float, str], None]  # share done, what is being done

# at the reference length: a pose worse than this is simply wrong; how wrong is not worth learning
_ERROR_CAP_MM = 30.0
_FEW_JOINTS = 3
_PRUNER_SHRINKAGE = 0.3
_SIZE_SD = 0.08  # how far off (log) a session's estimated size may be


@dataclass(frozen=True)
class TrainingSet:
    """Images with their true poses in the view frame, and the true size (m,) of each animal over
    home size.

    animal (m,): False where the height map shows something else of about the animal's size; such an
    image teaches the learned metric what is no animal, and the regressors nothing.
    """

    images: ImageSet
    truth: Truth
    size: Array
    animal: NDArray[np.bool_]

    @staticmethod
    def join(parts: list[TrainingSet]) -> TrainingSet:
        """The images of several sets, one after the other."""
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
    """Whether the base joint is the animal's front, as the fish's head, and not its rear, as the
    mouse's rump.
    """
    return bool(skeleton.offsets[skeleton.next_joint[0], 0] < 0)


@dataclass(frozen=True)
class Proposals:
    """A forest that says where a start may be, and which images each of its trees saw (T, m)."""

    forest: Forest
    in_bag: NDArray[np.bool_]

    @staticmethod
    def train(data: TrainingSet, method: Method, rng: np.random.Generator) -> Proposals:
        """Learned from the bases of the images that show the animal."""
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
        """K different candidates (m, k) for every image, of trees that have not seen it as far as
        these go.
        """
        order = rng.random((m, N_WAYS * self.forest.n_trees))
        order += np.repeat(self.in_bag, N_WAYS, axis=0).T
        return np.argsort(order, axis=1)[:, :k]


def start_candidates(
    data: TrainingSet,
    skeleton: Skeleton,
    method: Method,
    rng: np.random.Generator,
    seen: Proposals | None = None,
) -> Candidates:
    """K starts for every training image, each with its own guess of the animal's size.

    seen: proposals, where the method starts from them; each start is what a tree says that has not
    seen the image.
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
    if seen is not None:
        bases, places = propose(seen.forest, data.images, data.size, method)
        chosen = seen.draw(rng, m, k)
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
    data: TrainingSet, skeleton: Skeleton, method: Method, rng: np.random.Generator, tell: Tell
) -> tuple[Cascade, Candidates]:
    """Algorithm 2: every forest is trained on the state its predecessors left. Also returns that
    final state.
    """
    seen = Proposals.train(data, method, rng) if method.proposals is not None else None
    cascade = Cascade(skeleton, method, [], seen.forest if seen is not None else None)
    candidates = start_candidates(data, skeleton, method, rng, seen)
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
            cascade.apply(
                candidates, joint, predict(forest, samples, in_bag if method.out_of_bag else None)
            )
            rounds.append(forest)
        cascade.forests.append(rounds)
        n_done += len(rounds)
    cascade.place_ends(candidates)
    return cascade, candidates


def quantised(forest: Forest) -> Forest:
    """The forest with its leaves rounded to what the model file holds, so that training moves what
    a user will get.
    """
    return Forest(forest.nodes, forest.roots, forest.leaves.astype(np.float16).astype(np.float32))


def joint_error(candidates: Candidates, truth: Truth) -> Array:
    """Mean joint error (n,) of the candidates, mm at home size."""
    off = np.linalg.norm(candidates.positions - truth.positions[candidates.image], axis=2)
    return off.mean(axis=1) / candidates.size


def perturbed_truth(
    data: TrainingSet, cascade: Cascade, rng: np.random.Generator, n_each: int = 8
) -> Candidates:
    """Randomly perturbed true poses, the paper's metric examples: a twist of the base and a turn of
    every joint.
    """
    skeleton = cascade.skeleton
    j = skeleton.n_joints
    image = np.repeat(np.flatnonzero(data.animal).astype(np.int32), n_each)
    size = np.ones(len(image)) if not cascade.method.session_size else data.size[image]
    strength = rng.uniform(0.0, 1.0, len(image))[:, None]
    off = 8.0 * skeleton.relative_size
    twist = (
        rng.standard_normal((len(image), 6)) * np.array([0.4, 0.4, 0.9, off, off, off]) * strength
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
    """The learned metric: a forest that predicts the mean joint error (mm at home size) of a pose
    without the truth.

    Trained on the cascade's own final candidates, or on perturbed truth as the paper has it.
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
    """The small metric that tells from the base joint alone how far off the whole pose will be
    (METHOD lesson 9).

    The base has not moved since its own rounds, so the cascade's final candidates are its examples,
    too.
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
