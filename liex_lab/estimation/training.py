"""Training of the cascaded regressors (Lie-X Algorithm 2) and of the learned internal metric.

Each forest is trained on the result of its predecessors: after round c of joint j its prediction
moves all training candidates, and the label of the next round is again log(g_est^-1 g_true) (Eq.
11). Depending on the method, a candidate is moved only by trees that were not grown on its image.

The learned metric R_m (section 4.1) is a forest that predicts the mean joint error of a pose
without the truth. The paper trains it on perturbed true poses; the default method trains it on the
cascade's own final candidates, and boosts it.

Stacking on held-out images then gives a model its corrections, its head-tail classifier and its
error calibration. Learning from a model's own choices requires images that no tree was grown on
(stacked generalisation, Wolpert 1992): the forest correction and the ridge correction of the chosen
pose, the head-tail classifier, and the expectation forest, which predicts the error of a chosen
pose in mm. The last is calibrated by cross-fitting: the 5 % and 95 % quantiles of true over
predicted error come from predictions for folds excluded from the forest's training (as in split
conformal prediction).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.cascade import (
    N_DIRECTIONS,
    Array,
    Candidates,
    Cascade,
    TrainingSet,
    Truth,
    draw_starts,
    propose,
    start_poses,
    train_proposals,
)
from liex_lab.estimation.estimator import Detection, PoseEstimator
from liex_lab.estimation.method import Method
from liex_lab.estimation.model import ErrorCalibration, Model
from liex_lab.estimation.refine import (
    HeadTailClassifier,
    RidgeCorrection,
    both_directions,
    laid_along,
)
from liex_lab.estimation.scoring import (
    LEAST_MM,
    LOG_UNIT,
    Chosen,
    blank_samples,
    clue_samples,
    pose_samples,
)
from liex_lab.forests.forest import Forest, Samples, predict
from liex_lab.forests.grow import GrowthPlan, boost_forest, grow_forest
from liex_lab.geometry import SE3, so3
from liex_lab.scene.height_maps import HeightMaps, crop_columns

ProgressCallback = Callable[[float, str], None]  # completed share, name of the step


def start_candidates(
    data: TrainingSet,
    skeleton: Skeleton,
    method: Method,
    rng: np.random.Generator,
    proposals: tuple[Forest, NDArray[np.bool_]] | None = None,
) -> Candidates:
    """Initial poses for every training image, each with its own guess of the animal's size.

    Args:
        data: m training images.
        skeleton: the animal's skeleton.
        method: the variant, which states K, the number of initial poses per image.
        rng: source of the poses and of the size errors.
        proposals: the forest that proposes poses, if the method uses one, and (T, m) bool, the
            images that each of its trees was grown on; initial poses are those of other trees if
            there are enough.

    Returns:
        m K candidates with their base in place, those of an image in a row.
    """
    m = len(data.size)
    k = method.training_candidates
    starts = draw_starts(rng, m, k)
    size = np.ones((m, k))
    if method.session_size:
        # as a session's estimated size errs
        size = data.size[:, None] * np.exp(0.08 * rng.standard_normal((m, k)))
    rotation, position, scale = start_poses(data.images.moments, starts, size, skeleton, method)
    if proposals is not None:
        forest, in_bag = proposals
        bases, places = propose(forest, data.images, data.size, method)
        order = rng.random((m, N_DIRECTIONS * forest.n_trees))
        order += np.repeat(in_bag, N_DIRECTIONS, axis=0).T
        chosen = np.argsort(order, axis=1)[:, :k]
        rotation = np.take_along_axis(bases, chosen[..., None, None], axis=1)
        position = np.take_along_axis(places, chosen[..., None], axis=1)
    return Candidates.start(
        skeleton,
        np.repeat(np.arange(m, dtype=np.int32), k),
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
    report: ProgressCallback,
) -> tuple[Cascade, Candidates]:
    """Train all regressors joint by joint and round by round (Lie-X Algorithm 2).

    Args:
        data: m training images with truth.
        skeleton: the animal's skeleton.
        method: the variant of the method.
        rng: source of all randomness.
        report: called before each forest with the completed share and the name of the step.

    Returns:
        The cascade, and the training candidates after its last forest.
    """
    proposals = train_proposals(data, method, rng) if method.proposals is not None else None
    cascade = Cascade(skeleton, method, [], proposals[0] if proposals is not None else None)
    candidates = start_candidates(data, skeleton, method, rng, proposals)
    n_steps = sum(method.rounds_of(joint) for joint in skeleton.solved)
    n_done = 0
    for joint in skeleton.solved:
        if joint:
            cascade.place(candidates, joint)
        rounds: list[Forest] = []
        for c in range(method.rounds_of(joint)):
            report((n_done + c) / n_steps, f"{skeleton.names[joint]}, round {c + 1}")
            labels, keep = cascade.labels(candidates, joint, data.truth)
            samples = cascade.samples(data.images, candidates, [joint])
            keep &= data.animal[candidates.image]
            forest, in_bag = grow_forest(
                samples, np.ascontiguousarray(labels, np.float32), keep, method.regressors, rng
            )
            forest = forest.quantised()
            values = cascade.predict(forest, samples, in_bag if method.out_of_bag else None)
            cascade.apply(candidates, joint, values)
            rounds.append(forest)
        cascade.forests.append(rounds)
        n_done += len(rounds)
    cascade.place_ends(candidates)
    return cascade, candidates


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
    bent = 0.35 * np.sqrt(min(1.0, 3 / max(1, len(skeleton.solved) - 1)))
    for joint in range(1, skeleton.n_joints):
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
    method = cascade.method
    if not method.metric_on_own:
        candidates = perturbed_truth(data, cascade, rng)
    samples = cascade.metric_samples(data.images, candidates)
    labels = _capped_error(cascade, candidates, data.truth)
    if method.metric_shrinkage > 0:
        return boost_forest(
            samples, labels, method.metric, method.metric_shrinkage, rng
        ).quantised()
    every = np.ones(len(candidates), np.bool_)
    return grow_forest(samples, labels, every, method.metric, rng)[0].quantised()


def _capped_error(cascade: Cascade, candidates: Candidates, truth: Truth) -> NDArray[np.float32]:
    """Labels (n, 1) of both metrics: the joint error, mm at home size, capped if gross."""
    cap = 30.0 * cascade.skeleton.relative_size
    return np.minimum(joint_error(candidates, truth), cap)[:, None].astype(np.float32)


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
    samples = cascade.samples(data.images, candidates, [0])
    return boost_forest(
        samples, _capped_error(cascade, candidates, data.truth), plan, 0.3, rng
    ).quantised()


# Stacking on held-out images: corrections, head-tail classifier and error calibration of a model.


_TRIAL_SIZE_SD = 0.05  # (log) of a session's size, estimated over many frames
_EXPECTATION = GrowthPlan(
    n_trees=120,
    max_depth=6,
    min_leaf=40,
    n_tests=60,
    one_probe_share=0.0,
    scalar_share=1.0,
    depth_share=0.3,
    bag_share=0.5,
)
_SHRINKAGE = 0.12
_FOLDS = 4


@dataclass(frozen=True)
class Trial:
    """A model's own choices for n images with known truth.

    Attributes:
        score: (n,) score of the chosen pose, mm at home size.
        spread: (n,) spread of the averaged candidates, mm at home size.
        joint_error: (n, J) distance of each joint from the truth, mm at home size.
        clues: n samples, the features of the expectation forest.
    """

    score: Array
    spread: Array
    joint_error: Array
    clues: Samples


def _choices(
    model: Model, data: TrainingSet, rng: np.random.Generator, size_sd: float = _TRIAL_SIZE_SD
) -> Iterator[tuple[NDArray[np.int64], Detection, float, Chosen]]:
    """Let a model choose poses for the images of animals.

    In order of size; each group of images shares one guess of the size, with an error of `size_sd`
    (log), as the frames of a recording do. Yields the rows of a group in the set, its candidates,
    the guess over home size, and the choices.
    """
    animals = np.flatnonzero(data.animal)
    order = animals[np.argsort(data.size[animals], kind="stable")]
    estimator = PoseEstimator(model)
    for rows in np.array_split(order, max(1, len(order) // 50)):  # images share a size guess
        size = float(np.median(data.size[rows]) * np.exp(size_sd * rng.standard_normal()))
        size = size if model.method.session_size else 1.0
        images = data.images[rows]
        camera = crop_columns(images.crop_cameras)
        crops = replace(
            HeightMaps.blank(len(rows), camera.distance),
            heights=images.heights,
            origin=np.stack([camera.u0, camera.v0], axis=-1).astype(np.int32),
            step=camera.step.astype(np.int32),
            n_px=np.full(len(rows), 1),
            moments=images.moments,
            n_blobs=np.ones(len(rows), np.int64),
        )
        detection = estimator.candidates(crops, images.crop_cameras, size)
        yield rows, detection, size, estimator.pick(detection, size)


def run_on(model: Model, data: TrainingSet, rng: np.random.Generator) -> Trial:
    """Let a model choose poses for images with truth, and measure their errors.

    Args:
        model: the model.
        data: images with truth; those without an animal are excluded.
        rng: source of the errors of the assumed sizes.

    Returns:
        Scores, spreads, errors and features of the choices, in order of the animals' size.
    """
    # the ridge correction estimates it better
    size_sd = _TRIAL_SIZE_SD if model.settler is None else 0.02
    columns = []
    for rows, detection, size, chosen in _choices(model, data, rng, size_sd):
        off = chosen.pose.joints(model.skeleton) - data.truth.positions[rows]
        joint_error = np.linalg.norm(off, axis=-1) / size
        clues = clue_samples(chosen, model.skeleton, detection.images, size).scalars
        columns.append((chosen.score, chosen.spread, joint_error, clues))
    score, spread, joint_error, clues = (np.concatenate(c) for c in zip(*columns, strict=True))
    return Trial(score, spread, joint_error, blank_samples(clues))


def with_corrector(model: Model, data: TrainingSet, rng: np.random.Generator) -> Model:
    """Add the forest correction of chosen poses, learned on images that no tree was grown on.

    Poses with a gross error, such as the wrong direction, are excluded. Branched skeletons have no
    such correction, as their poses are not determined by the positions of their joints.

    Args:
        model: the model; returned unchanged if its method has no corrector.
        data: held-out images with truth.
        rng: source of size errors, bags and seeds.
    """
    plan = model.method.corrector
    skeleton = model.skeleton
    if plan is None or not skeleton.is_chain:
        return model
    parts = []
    moves = []
    for rows, detection, size, chosen in _choices(model, data, rng):
        frames = chosen.pose.frames(skeleton)
        off = data.truth.positions[rows] - frames.translation
        error = np.linalg.norm(off, axis=-1).mean(axis=1)
        near = error < 12.0 * skeleton.relative_size * size  # larger errors are gross
        samples = pose_samples(chosen.pose, model, detection.images, size)
        samples = replace(samples, heights=data.images.heights, image=rows.astype(np.int32))
        parts.append(samples[np.flatnonzero(near)])
        move = np.einsum("nji,nkj->nki", frames.rotation[:, 0], off) / size
        moves.append(move.reshape(len(move), -1)[near])
    forest = boost_forest(
        Samples.join(parts), np.concatenate(moves).astype(np.float32), plan, 0.1, rng
    )
    return replace(model, corrector=forest.quantised())


def with_settler(model: Model, data: TrainingSet, rng: np.random.Generator) -> Model:
    """Add the ridge correction of chosen poses, learned on images that no tree was grown on.

    Args:
        model: the model; returned unchanged if its method has no ridge correction.
        data: held-out images with truth.
        rng: source of the errors of the assumed sizes.
    """
    if not model.method.settle:
        return model
    groups = list(_choices(model, data, rng, 0.08))
    rows = np.concatenate([rows for rows, *_ in groups])
    sizes = np.concatenate([np.full(len(rows), size) for rows, _, size, _ in groups])
    pose = Pose.join([chosen.pose for *_, chosen in groups])
    settler = RidgeCorrection.fit(
        model.skeleton, pose, data.images[rows], sizes, data.truth.positions[rows], data.size[rows]
    )
    return replace(model, settler=settler.table)


def with_facing(model: Model, data: TrainingSet, seed: int) -> Model:
    """Add the head-tail classifier, learned on images that no tree was grown on.

    It learns from the best candidate of each direction.

    Args:
        model: the model; returned unchanged if its method has no such classifier.
        data: held-out images with truth.
        seed: of the size errors and of the network's training.
    """
    skeleton = model.skeleton
    if not model.method.tells_facing:
        return model
    resampled = []
    right = []
    for rows, detection, size, _ in _choices(model, data, np.random.default_rng(seed)):
        true = data.truth.positions[rows]
        along = true[:, skeleton.tip] - true[:, 0]
        scores = detection.scores
        best, opposite, behind, _ = both_directions(detection.positions, scores, skeleton.tip)
        for k, exists in ((best, np.isfinite(scores.min(axis=1))), (opposite, np.isfinite(behind))):
            some = np.flatnonzero(exists)
            joints = detection.positions[some, k[some]]
            resampled.append(
                laid_along(skeleton, detection.images[some], joints, np.full(len(some), size))
            )
            right.append(
                np.einsum("nd,nd->n", joints[:, skeleton.tip] - joints[:, 0], along[some]) > 0
            )
    network = HeadTailClassifier.fit(np.concatenate(resampled), np.concatenate(right), seed)
    return replace(model, facing=network)


def _on_own_maps(samples: Samples) -> Samples:
    """The samples, each on a height map of its own, so that bags are drawn over samples."""
    n = len(samples)
    return replace(
        samples, heights=np.zeros((n, 1, 1), np.int16), image=np.arange(n, dtype=np.int32)
    )


def calibrate(model: Model, data: TrainingSet, rng: np.random.Generator) -> Model:
    """Add the expectation forest and the calibration, learned on held-out images.

    The boosted forest predicts the logarithm of the true error of the chosen pose, capped at 25 mm
    at the reference length: errors differ by factors, and in mm the few gross ones would dominate.
    The ratios of true to predicted error that bound 90 % of the images, and the limit above which a
    pose is flagged (97 % quantile of the predictions), come from 4-fold cross-fitting.

    Args:
        model: the model with its corrections.
        data: held-out images with truth.
        rng: source of size errors, folds, bags and seeds.

    Returns:
        The model with new expectation and calibration; area_mm2 is kept.
    """
    trial = run_on(model, data, rng)
    error = trial.joint_error.mean(axis=1)
    capped = np.minimum(error, 25.0 * model.skeleton.relative_size)  # a lost pose must not dominate
    target = (LOG_UNIT * np.log(capped))[:, None].astype(np.float32)
    n = len(error)
    fold = rng.permutation(n) % _FOLDS
    predicted = np.empty(n)
    for k in range(_FOLDS):
        others = np.flatnonzero(fold != k)
        held_out = np.flatnonzero(fold == k)
        forest = boost_forest(
            _on_own_maps(trial.clues[others]), target[others], _EXPECTATION, _SHRINKAGE, rng
        )
        predicted[held_out] = np.exp(predict(forest, trial.clues[held_out])[:, 0] / LOG_UNIT)
    gain = capped.mean() / predicted.mean()  # from the median of the expected error to its mean
    predicted = np.maximum(gain * predicted, LEAST_MM * model.skeleton.relative_size)
    low, high = np.quantile(error / predicted, [0.05, 0.95])
    expectation = boost_forest(
        _on_own_maps(trial.clues),
        target + np.float32(LOG_UNIT * np.log(gain)),
        _EXPECTATION,
        _SHRINKAGE,
        rng,
    ).quantised()
    design = np.stack([np.ones(n), trial.score, trial.spread], axis=1)
    line, *_ = np.linalg.lstsq(design, capped, rcond=None)
    calibration = ErrorCalibration(
        offset=float(line[0]),
        slope=float(line[1]),
        spread_slope=float(line[2]),
        quantiles=(float(low), float(high)),
        joint_share=tuple((np.median(trial.joint_error, axis=0) / np.median(error)).tolist()),
        doubtful_mm=float(np.quantile(predicted, 0.97)),  # of ordinary images are trusted
        area_mm2=model.calibration.area_mm2,
        logarithmic=True,
    )
    return replace(model, expectation=expectation, calibration=calibration)
