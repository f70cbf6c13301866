"""Fit of an animal's shape prior on rendered mini-sessions, `liex train shape`.

A mini-session consists of some frames of one animal and one camera. Many are rendered from a wide
family of builds and measured by the animal's pose model as a session is, including its size; each
yields the features of its mean cross-sections, the poses' mean error, and the animal's build. The
residual of the fitted regression on builds of another family, which neither it nor the forests were
trained on, estimates the remaining error of the joints. Everything is drawn from seeds, so training
is deterministic.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from liex_lab.body.pose import Array, Pose
from liex_lab.body.shape import BodyShape
from liex_lab.errors import LiexError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.session_shape import PLACES, ShapePrior, labels_of, session_clues
from liex_lab.runtime import durable, processes
from liex_lab.runtime.progress import Progress, silent
from liex_lab.scene.height_maps import HeightMaps, view_of
from liex_lab.simulation import simulator, training_patches

from .pose_model import estimator_of, extract, recipe_of, use_cores

PER_SESSION = 16
_LEAST_GOOD = 8  # frames per mini-session


MiniSession = tuple[Array, Array]  # clues (F,), see `session_clues`; labels (K,), see `ShapePrior`


@processes.serial_products()
def train_shape(
    animal: str,
    out: Path,
    *,
    n_sessions: int | None = None,
    workers: int = 0,
    progress: Progress = silent,
) -> Path:
    """Write an animal's shape prior; byte-identical on every run.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        out: path of the file that is written.
        n_sessions: mini-sessions of the wide family; None means the usual number.
        workers: threads of the kernels; 0 means all.
        progress: called block by block.

    Returns:
        `out`.

    Raises:
        LiexError: the animal is not a chain with a tube as its body.
    """
    use_cores(workers)
    estimator = estimator_of(animal, "default", progress)
    known = n_sessions or 512
    rows = list(mini_sessions(estimator, "wide", known, progress))
    prior = ShapePrior.fit(*(np.stack(part) for part in zip(*rows, strict=True)))
    others = list(mini_sessions(estimator, "other", known // 4, progress))
    prior = replace(prior, unseen=left_over(prior, others), model=estimator.model.fingerprint)
    with durable.replacing(out) as part:
        np.savez(part, **prior.arrays())  # type: ignore[arg-type]
    return out


def left_over(prior: ShapePrior, others: Sequence[MiniSession]) -> tuple[float, float]:
    """Residuals of a prior on other builds: the joints' height and position along the body.

    Returns:
        Standard deviations over the length, of all joints together.
    """
    joints = np.stack([labels - prior.predict(clues) for clues, labels in others])[
        :, : -2 * len(PLACES)
    ].reshape(len(others), -1, 3)
    height, along = (round(float(np.sqrt(np.mean(joints[..., k] ** 2))), 4) for k in (2, 0))
    return height, along


def mini_sessions(
    estimator: PoseEstimator, family: str, n: int, progress: Progress = silent
) -> Iterator[MiniSession]:
    """Measured rendered mini-sessions of a family of builds, without lost ones.

    Args:
        estimator: the animal's.
        family: of body shapes.
        n: number of rendered mini-sessions; it is rounded up to whole blocks.
        progress: called block by block.

    Raises:
        LiexError: the animal is not a chain with a tube as its body.
    """
    skeleton = estimator.skeleton
    world = simulator.world_of(skeleton)
    if "stations" not in skeleton.surface:
        raise LiexError(
            f"a shape is learned of animals that are one chain with a tube around it, not of "
            f"'{skeleton.name}'"
        )
    recipe = recipe_of("default", skeleton)
    # of a family's images
    seed = {"wide": 41, "other": 42}[family]
    n_blocks = -(-n * PER_SESSION // training_patches.BLOCK)
    for number in range(n_blocks):
        progress(number, n_blocks, f"rendering animals of the family '{family}'")
        spine_mm, window_px = recipe.sizes[number % len(recipe.sizes)]
        (windows,) = world.training_blocks(
            seed,
            1,
            first=number,
            window_px=window_px,
            family=family,
            degraded_share=recipe.degraded_share,
            spine_mm=spine_mm or None,
            per_session=PER_SESSION,
        )
        bodies = windows.body[::PER_SESSION]
        assert isinstance(bodies, BodyShape)
        yield from _measured(estimator, windows, bodies, np.random.default_rng([seed, number, 2]))


def _measured(
    estimator: PoseEstimator,
    windows: training_patches.TrainingPatches,
    bodies: BodyShape,
    rng: np.random.Generator,
) -> Iterator[MiniSession]:
    """The mini-sessions of one block."""
    skeleton = estimator.skeleton
    size = windows.spine_mm / skeleton.length
    crops, crop_cameras = extract(skeleton, windows, size, estimator.model.method.camera_view)
    joints = Pose(view_of(crop_cameras) @ windows.root, windows.angles, windows.scale).joints(
        skeleton
    )
    for k in range(len(bodies)):
        rows = np.arange(k * PER_SESSION, (k + 1) * PER_SESSION)
        true = float(size[rows[0]])
        # sd of the initial error (log) of the size
        begin = float(true * np.exp(0.06 * rng.standard_normal()))
        found = _mini_session(
            estimator, crops[rows], crop_cameras[rows], joints[rows], bodies[k], true, begin
        )
        if found is not None:
            yield found


def _mini_session(
    estimator: PoseEstimator,
    crops: HeightMaps,
    crop_cameras: Array,
    truth: Array,
    body: BodyShape,
    true_size: float,
    begin: float,
) -> MiniSession | None:
    """One mini-session, its size estimated from `begin` on; None if too few frames are measured.

    truth (n, J, 3) mm are its true joints in the view frames.
    """
    skeleton = estimator.skeleton
    plain = replace(estimator, model=replace(estimator.model, corrector=None))
    size = begin
    for _ in range(2):
        estimates = plain.best_of(crops, crop_cameras, size)
        if estimates.found.sum() < _LEAST_GOOD:
            return None
        observed = float(np.median(plain.sizes_by_frame(estimates)))
        # a pass covers a third of the way; the exponent extends it
        size *= (observed / size) ** 2.0
    estimates = estimator.best_of(crops, crop_cameras, size)
    pose = estimates.chosen.pose.moved(view_of(crop_cameras))
    off = truth - pose.joints(skeleton)
    length = skeleton.length * size
    # a pose with a larger error is lost, and not an error of the build
    good = np.linalg.norm(off, axis=-1).mean(axis=1) < 0.12 * length  # False if not finite
    if good.sum() < _LEAST_GOOD:
        return None
    use = estimates.found
    clues = session_clues(skeleton, pose[use], crops.heights[use], crop_cameras[use], size)
    offset = np.einsum("nji,nkj->nki", pose.root.rotation[good], off[good]).mean(axis=0) / length
    average, stations = BodyShape.default(skeleton), skeleton.surface["stations"]
    width, height = (
        true_size / size * np.interp(PLACES, stations, own) / np.interp(PLACES, stations, usual)
        for own, usual in (
            (body.half_width, average.half_width),
            (body.half_height, average.half_height),
        )
    )
    return clues, labels_of(offset, width, height)
