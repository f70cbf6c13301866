"""Training of a pose model: Algorithm 2 of Lie-X (section 4.1) on rendered depth, `liex train`.

Per skeleton joint and round a regression forest learns the twist that is still missing, `d_theta =
log(g_est^-1 g_true)` (Eq 11), from the state after its predecessors; a further forest, boosted in
the default variant, learns the mean joint error of a pose without the truth (the learned metric
Rm). Held-out images are then used to learn, in this order, the correction of the chosen pose of an
animal that is one chain (a boosted forest, a ridge regression, or neither), the calibration of the
predicted error with its 90 % interval, and the head-tail classifier.

Images are rendered from a seed in numbered blocks and segmented as in a run. The forests grow from
seeds and BLAS runs on one thread, so training is deterministic. `Recipe` states the numbers of
images; `RECIPES` and `_OWN` have one for each animal and variant.
"""

import hashlib
import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numba
import numpy as np

from liex_lab.baselines import baseline
from liex_lab.baselines.baseline import Baseline
from liex_lab.body.pose import Pose
from liex_lab.body.shape import Surface
from liex_lab.body.skeleton import FOREGROUNDS, Array, Skeleton
from liex_lab.catalog import bundled_models, find_model
from liex_lab.estimation.cascade import ImageSet, TrainingSet, Truth
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.method import Method, method_of
from liex_lab.estimation.model import ErrorCalibration, Model
from liex_lab.estimation.training import (
    ProgressCallback,
    calibrate,
    train_cascade,
    train_metric,
    train_pruner,
    with_corrector,
    with_facing,
    with_settler,
)
from liex_lab.forests.grow import GrowthPlan
from liex_lab.geometry import SE3
from liex_lab.runtime import durable, processes
from liex_lab.runtime.progress import Progress, silent
from liex_lab.scene import hand_segmenter, height_maps
from liex_lab.scene.background import SPREADS
from liex_lab.sessions.provenance import package_version
from liex_lab.simulation import simulator, species, training_patches


@dataclass(frozen=True)
class Recipe:
    """Number of rendered images that a model is trained on, and sizes of their animals.

    Features do not depend on the animal's size, but pixels and noise do, so the images cover
    several sizes, alternating by block.

    Attributes:
        seed: seed of the images and of the forests.
        n_images: images for the cascade and the learned metric.
        n_correction: further images for the correction of the chosen pose; 0 leaves it out.
        n_calibration: further images for the predicted error; 0 leaves the calibration out.
        degraded_share: share of the images that have up to 2.5 times the noise.
        sizes: (mean spine length mm, width px of the patch around the animal), for one block of
            images after the other; a length of 0 is the skeleton's own.
    """

    seed: int = 20
    n_images: int = 49_152
    n_correction: int = 12_288  # further images, for the last correction
    n_calibration: int = 24_576  # and further ones, for the predicted error
    degraded_share: float = 0.5
    sizes: tuple[tuple[float, int], ...] = (
        (0.0, 144),
        (45.0, 144),
        (0.0, 144),
        (80.0, 192),
        (45.0, 144),
        (100.0, 232),
    )


# images of the last training by their inputs, see `shared_images`; None keeps none
_shared: ContextVar[list[tuple[Any, TrainingSet]] | None] = ContextVar("_shared", default=None)

# the paper's variant and the baselines learn from the same images, noise and sizes: of animals near
# home size, with as much noise as the default's
RECIPES = {
    "default": Recipe(),
    "paper": Recipe(n_images=40_960, n_correction=0, n_calibration=4_096, sizes=((0.0, 144),)),
}
# recipes by animal and variant that differ from the mouse's
_OWN: dict[tuple[str, str], Recipe] = {
    ("fish", "default"): Recipe(
        seed=31,
        n_images=16_384,
        n_correction=4_096,
        n_calibration=4_096,
        sizes=((0.0, 272), (21.0, 192), (0.0, 272), (36.0, 328)),
    ),
    ("fish", "paper"): Recipe(
        seed=31, n_images=16_384, n_correction=0, n_calibration=2_048, sizes=((0.0, 272),)
    ),
    ("hand", "default"): Recipe(
        n_images=20_480, n_correction=0, n_calibration=4_096, sizes=((0.0, 320),)
    ),
    ("hand", "paper"): Recipe(
        n_images=20_480, n_correction=0, n_calibration=2_048, sizes=((0.0, 320),)
    ),
}


def recipe_of(variant: str, skeleton: Skeleton) -> Recipe:
    """The recipe of a variant for an animal: its own if it has one, else that of the variant.

    A user's own animal (a skeleton from TOML) gets as many images as the fish, of sizes around its
    home length: 1, 0.8, 1 and 1.25 times it; for the paper's variant only the first.

    Args:
        variant: `default` or `paper`, a key of `RECIPES`.
        skeleton: the animal's skeleton.
    """
    world = simulator.world_of(skeleton)
    if not isinstance(world, species.GenericSpecies):
        return _OWN.get((skeleton.name, variant), RECIPES[variant])
    # sizes of a user's own animal, over its home length
    sizes = tuple(
        (factor * skeleton.length, world.window_px(factor * skeleton.length))
        for factor in (1.0, 0.8, 1.0, 1.25)
    )
    sizes = sizes if variant == "default" else sizes[:1]
    return replace(_OWN["fish", variant], seed=Recipe.seed, sizes=sizes)


def use_cores(workers: int) -> None:
    """Run kernels on this many cores, at most those of the machine; 0 means all of them."""
    if workers:
        numba.set_num_threads(min(workers, numba.config.NUMBA_NUM_THREADS))


def train_model(
    animal: str,
    variant: str,
    out: str | Path,
    *,
    workers: int = 0,
    n_images: int | None = None,
    draw: int = 0,
    progress: Progress = silent,
) -> Path:
    """Train an animal's pose model and write it with its card next to it (`.json`).

    The card states the model's provenance, its SHA-256 and its number of bytes.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        variant: `default` or `paper`.
        out: path of the model file (.npz); missing folders are created.
        workers: threads of the kernels, at most those of the machine; 0 means all of them.
        n_images: number of training images instead of the recipe's, and a quarter of that each for
            the correction and for the calibration.
        draw: number of the random draw in training, see `make_model`.
        progress: called with the progress of the job.

    Returns:
        The path of the model.
    """
    use_cores(workers)
    skeleton = Skeleton.load(animal)
    recipe = recipe_of(variant, skeleton)
    if n_images is not None:
        recipe = replace(
            recipe, n_images=n_images, n_correction=n_images // 4, n_calibration=n_images // 4
        )
    model = make_model(skeleton, method_of(variant, skeleton), recipe, progress, draw)
    content, path = model.to_bytes(), Path(out)
    _store(
        path,
        content,
        {**model.card, "sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)},
    )
    return path


def _store(path: Path, content: bytes, card: dict[str, Any]) -> None:
    """Write a model, and its card next to it; it gets its name only once both are complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with durable.replacing(path) as part:
        part.write_bytes(content)
        durable.write_whole(
            path.with_suffix(".json"), json.dumps(card, indent=1, sort_keys=True) + "\n"
        )


@processes.serial_products()
def make_model(
    skeleton: Skeleton, method: Method, recipe: Recipe, progress: Progress, draw: int = 0
) -> Model:
    """Train a model: cascade, learned metric, and the parts learned from held-out images.

    The cascade and the metric are Algorithm 2 of Lie-X. Held-out images are then used for the
    correction of the chosen pose, the calibration of the predicted error and the head-tail
    classifier, if method and recipe have them. Images are numbered in blocks, and amounts that are
    whole blocks share no image.

    Args:
        skeleton: the animal's skeleton.
        method: the variant's parameters: rounds, candidates, growth of the forests.
        recipe: numbers and sizes of images.
        progress: called with the progress of the job.
        draw: number of the random draw for growing the forests: initial poses, bags and tests; the
            images are the same. Models of several draws show how much of an error is chance.

    Returns:
        The model with its card, in memory.
    """
    rng = np.random.default_rng([recipe.seed, 3, draw] if draw else recipe.seed)
    data = rendered_set(skeleton, method, recipe, 0, recipe.n_images, progress)
    steps = len(skeleton.solved) * method.rounds + 2
    cascade, candidates = train_cascade(
        data,
        skeleton,
        method,
        rng,
        lambda share, what: progress(round(share * (steps - 2)), steps, f"growing forests: {what}"),
    )
    progress(steps - 2, steps, "growing forests: the learned metric")
    metric = train_metric(data, cascade, candidates, rng)
    pruner = train_pruner(data, cascade, candidates, rng)
    area_mm2 = height_maps.moment_columns(data.images.moments).area_mm2
    area = float(np.median((area_mm2 / data.size**2)[data.animal]))
    card = {
        "animal": skeleton.name,
        "variant": method.variant,
        "made_by": "liex train",
        "recipe": vars(recipe),
        "images": simulator.world_of(skeleton).sources,
        **({"draw": draw} if draw else {}),
    }
    model = Model(
        cascade, metric, None, skeleton.table, ErrorCalibration(area_mm2=area), card, pruner
    )
    if recipe.n_correction and (method.corrector is not None or method.settle):
        progress(steps - 1, steps, "learning the last correction")
        unseen = rendered_set(
            skeleton, method, recipe, recipe.n_images, recipe.n_correction, silent
        )
        own = np.random.default_rng([recipe.seed, 2])  # own random stream
        model = with_settler(with_corrector(model, unseen, own), unseen, own)
    if recipe.n_calibration:
        progress(steps - 1, steps, "calibrating the predicted error")
        first = recipe.n_images + recipe.n_correction
        unseen = calibration_set(skeleton, method, recipe, first)
        # separate random streams, so that each step can be repeated by itself
        model = calibrate(model, unseen, np.random.default_rng([recipe.seed, 1]))
    if method.tells_facing:
        progress(steps - 1, steps, "training the head-tail classifier")
        first = recipe.n_images + recipe.n_correction + recipe.n_calibration
        unseen = rendered_set(skeleton, method, recipe, first, recipe.n_images, silent)
        model = with_facing(model, unseen, recipe.seed)
    return model


def rendered_set(
    skeleton: Skeleton,
    method: Method,
    recipe: Recipe,
    first: int,
    n: int,
    progress: Progress,
    family: str = "augmented",
) -> TrainingSet:
    """Training images from number `first` on, segmented, with the truth in their view frames.

    Images come in whole blocks, so there are at least n of them before removing those in which
    animal and distractor have merged; up to two objects are cut from each image.

    Args:
        skeleton: the animal's skeleton.
        method: the variant: camera or height view, session size or none.
        recipe: seed, sizes and share of degraded images.
        first: number of the first image; it is rounded up to whole blocks.
        n: number of rendered images; it is rounded up to whole blocks.
        progress: called block by block.
        family: family of body shapes, `augmented` (more varied than individuals are) or `train`.

    Returns:
        The images, animals and other objects of about their size.
    """
    shared = _shared.get() if first == 0 else None
    # the inputs of images and labels
    key = (skeleton.table, method.camera_view, method.session_size, vars(recipe), n, family)
    for known, data in shared or ():
        if known == key:
            return data
    world = simulator.world_of(skeleton)
    blocks = -(-n // training_patches.BLOCK)
    begin = -(-first // training_patches.BLOCK)
    parts: list[TrainingSet] = []
    for number in range(begin, begin + blocks):
        progress(number - begin, blocks, "rendering training images")
        spine_mm, window_px = recipe.sizes[number % len(recipe.sizes)]
        (windows,) = world.training_blocks(
            recipe.seed,
            1,
            first=number,
            family=family,
            degraded_share=recipe.degraded_share,
            spine_mm=spine_mm or None,
            window_px=window_px,
        )
        parts.append(cut_out(skeleton, method, windows))
    data = TrainingSet.join(parts)
    if shared is not None:
        shared[:] = [(key, data)]
    return data


@contextmanager
def shared_images() -> Iterator[None]:
    """A context that keeps a training's images for the next training with the same ones.

    Only those of the last different training are kept, as they take a gigabyte.
    """
    before = _shared.set([])
    try:
        yield
    finally:
        _shared.reset(before)


def calibration_set(skeleton: Skeleton, method: Method, recipe: Recipe, first: int) -> TrainingSet:
    """Held-out images for calibrating a model's predicted error.

    A share of them (`_ORDINARY_SHARE`) shows bodies that vary as individuals do.

    Args:
        skeleton: the animal's skeleton.
        method: the variant.
        recipe: seed, sizes, and `n_calibration`, the total number of images.
        first: number of the first image.

    Returns:
        The images, varied bodies first.
    """
    # share of the images for calibrating an animal's predicted error that show bodies that vary as
    # individuals do; with the others alone, which vary far more, intervals would be wider than most
    # animals need
    ordinary = round({"mouse": 0.5}.get(skeleton.name, 0.0) * recipe.n_calibration)
    varied = rendered_set(skeleton, method, recipe, first, recipe.n_calibration - ordinary, silent)
    if not ordinary:
        return varied
    first += recipe.n_calibration - ordinary
    return TrainingSet.join(
        [varied, rendered_set(skeleton, method, recipe, first, ordinary, silent, "train")]
    )


def cut_out(
    skeleton: Skeleton, method: Method, windows: training_patches.TrainingPatches
) -> TrainingSet:
    """Training images of the two largest components of the segmentation in each patch.

    Args:
        skeleton: the animal's skeleton.
        method: the variant; whether crops follow the camera's axis, and whether the size is known.
        windows: rendered patches with their background and truth.

    Returns:
        The images of the first components of all patches, then those of the second ones.
    """
    size = windows.spine_mm / skeleton.length
    crops, crop_cameras = extract(
        skeleton,
        windows,
        size if method.session_size else np.ones(len(size)),
        method.camera_view,
        n_candidates=2,
    )
    n = len(size)
    return TrainingSet.join(
        [
            with_truth(skeleton, method, windows, crops[k], crop_cameras[k])
            for k in (slice(n), slice(n, None))
        ]
    )


def extract(
    skeleton: Skeleton,
    windows: training_patches.TrainingPatches,
    size: Array,
    camera_view: bool,
    n_candidates: int = 1,
) -> tuple[height_maps.HeightMaps, Array]:
    """Height maps of the largest components of the segmentation in each patch, and their cameras.

    A hand is segmented by distance (`HandPatches`), every other animal by background subtraction
    (`Patches`) with the patch's own estimated floor and, if the sensor's noise is known, a
    threshold of `SPREADS` standard deviations of the background's readings.

    Args:
        skeleton: the animal's skeleton; its view selects the segmentation.
        windows: rendered patches (n) with their background and truth.
        size: (n,) size over home size that the crops are scaled to.
        camera_view: whether crops follow the camera's axis.
        n_candidates: components of each patch; the first ones of all patches come first.
    """
    origin = windows.origin.astype(float)
    if skeleton.view.foreground == FOREGROUNDS[1]:
        return hand_segmenter.HandPatches(
            windows.depth, windows.intrinsics, origin, skeleton.view
        ).extract(size, camera_view, n_candidates=n_candidates)
    depth, background = (
        image if windows.unit_mm == 1.0 else image * np.float32(windows.unit_mm)
        for image in (windows.depth, windows.background)
    )
    cut = height_maps.Patches(
        depth, background, windows.intrinsics, origin, windows.floor, skeleton.view
    )
    # of an animal from above, about; only ranks the blobs of a window
    # of home-sized animals from above, if it differs from the home pose's
    home_mm2 = {"mouse": 1070.0}.get(skeleton.name) or Surface.of(skeleton).area_mm2
    area_mm2 = home_mm2 * (windows.spine_mm / skeleton.length) ** 2
    # a scene learned from a recording has an estimate of its readings' spread
    least_mm = np.maximum(skeleton.view.min_height_mm, SPREADS * windows.spread_mm)
    return cut.extract(size, area_mm2, least_mm, camera_view, n_candidates=n_candidates)


def with_truth(
    skeleton: Skeleton,
    method: Method,
    windows: training_patches.TrainingPatches,
    crops: height_maps.HeightMaps,
    crop_cameras: Array,
) -> TrainingSet:
    """Training images of segmented blobs, labelled as animal or other object by the true pose.

    A blob within 0.4 spine lengths of the true middle (in the image plane and, in the camera's
    view, in depth) is the animal, one beyond 0.8 is another object, which is used by the learned
    metric only. In between the two have merged; such images are left out, as they are not
    informative.

    Args:
        skeleton: the animal's skeleton.
        method: the variant; whether crops follow the camera's axis.
        windows: the patches (n) that the blobs were cut from, with root poses, angles and scales.
        crops: the blobs' height maps (n), one per patch.
        crop_cameras: (n, 17) crop cameras, which define the view frames.

    Returns:
        The remaining images, poses in their view frames, mm.
    """
    T_view_camera = height_maps.view_of(crop_cameras)
    pose = Pose(T_view_camera @ windows.root, windows.angles, windows.scale)
    frames = pose.frames(skeleton)
    joints = frames.translation
    if windows.own_bones:
        joints = (
            SE3(T_view_camera.rotation[:, None], T_view_camera.translation[:, None])
            @ windows.joints_mm
        )
    middle = joints.mean(axis=1)
    blob = crops.blobs
    distance = np.linalg.norm(np.stack([blob.x, blob.y], axis=1) - middle[:, :2], axis=1)
    if method.camera_view:  # an object at another depth is another object as well
        distance = np.maximum(
            distance, np.abs(blob.volume_mm3 / np.maximum(blob.area_mm2, 1e-9) - middle[:, 2])
        )
    animal = distance < 0.4 * windows.spine_mm
    other = distance > 0.8 * windows.spine_mm
    # in between the two have merged, which is not informative
    good = crops.found & (animal | other)
    return TrainingSet(
        ImageSet(crops.heights[good], crop_cameras[good], crops.moments[good]),
        Truth(frames.rotation[good], joints[good], pose.scale[good]),
        (windows.spine_mm / skeleton.length)[good],
        animal[good],
    )


def cache_path(animal: str, variant: str, draw: int = 0) -> Path:
    """The path in the cache of a model that is not bundled, trained or not.

    Its name contains a hash of the program's version, method, recipe and skeleton; if one of these
    changes, a new model is trained.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        variant: `default` or `paper`.
        draw: number of the draw, see `make_model`.
    """
    skeleton = Skeleton.load(animal)
    made_from = {
        "method": method_of(variant, skeleton).to_dict(),
        "recipe": vars(recipe_of(variant, skeleton)),
        "skeleton": skeleton.table,
    }
    return _cached(f"{skeleton.name}-{variant}", made_from, f"-{draw}" if draw else "")


def _cached(name: str, made_from: dict[str, Any], number: str = "") -> Path:
    made = json.dumps([package_version("liex_lab"), made_from], sort_keys=True).encode()
    return cache_folder() / f"{name}-{hashlib.sha256(made).hexdigest()[:12]}{number}.npz"


def cache_folder() -> Path:
    """The user's folder for reproducible files: `LIEX_CACHE`, or the system's cache folder."""
    if stated := os.environ.get("LIEX_CACHE"):
        return Path(stated)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "liex_lab"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "liex_lab"
    return Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "liex_lab"


def estimator_of(
    animal: str,
    variant: str,
    progress: Progress = silent,
    model: str | Path | None = None,
    draw: int = 0,
) -> PoseEstimator:
    """The pose estimator of a model file or of a variant of the method.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        variant: `default` is the bundled model if there is one; every other is trained now, or
            comes from the cache.
        progress: called with the progress of a training.
        model: name or path of a model file, which overrides the variant.
        draw: number of the draw of a trained model, see `make_model`.

    Raises:
        ModelError: there is no such model, or its file is damaged.
    """
    if model is not None or (variant == "default" and animal in bundled_models()):
        return PoseEstimator(Model.load(find_model(model or animal)))
    path = cache_path(animal, variant, draw)
    if not path.is_file():
        train_model(animal, variant, path, draw=draw, progress=progress)
    return PoseEstimator(Model.load(path))


# Training of the paper's baselines RF and CNN (Lie-X section 5.2), kept in the user's cache.


@dataclass(frozen=True)
class Training:
    """Training images and parameters of a baseline.

    Attributes:
        recipe: the rendered images.
        plan: parameters of the forests or of the network.
    """

    recipe: Recipe
    plan: baseline.ForestPlan | baseline.CnnPlan

    def to_dict(self) -> dict[str, Any]:
        """Plain values of the training, a cache key: equal values mean equal training."""
        plan = {
            name: value._asdict() if isinstance(value, GrowthPlan) else value
            for name, value in vars(self.plan).items()
        }
        return {"recipe": vars(self.recipe), "plan": plan}


BASELINES: dict[str, baseline.ForestPlan | baseline.CnnPlan] = {
    "rf": baseline.ForestPlan(),
    "cnn": baseline.CnnPlan(),
}


def training_of(variant: str, skeleton: Skeleton) -> Training:
    """The training of a baseline, on the images of the paper's variant.

    They are the same in number, noise and sizes (40,960 for the mouse, 20,480 for the hand, 16,384
    for others, half of them degraded); the CNN gets about 122,880 views in total, over as many
    epochs as needed.

    Args:
        variant: `rf` or `cnn`, a key of `BASELINES`.
        skeleton: the animal's skeleton.
    """
    recipe = replace(recipe_of("paper", skeleton), n_calibration=0)
    plan = BASELINES[variant]
    if isinstance(plan, baseline.CnnPlan):
        # total views of the CNN, whatever the number of images
        plan = replace(plan, epochs=round(122_880 / recipe.n_images))
    else:
        plan = replace(plan, home_turn=method_of("paper", skeleton).home_turn)
    return Training(recipe, plan)


def trained_baseline(animal: str, variant: str, progress: Progress = silent) -> Baseline:
    """The baseline of an animal, from the cache or trained now.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        variant: `rf` or `cnn`.
        progress: called with the progress of the training.

    Raises:
        MissingPackageError: the variant is `cnn` and torch is not installed.
    """
    if variant == "cnn":
        baseline.require_torch()  # before anything is rendered
    skeleton = Skeleton.load(animal)
    training = training_of(variant, skeleton)
    path = cached_baseline(variant, skeleton, training)
    if not path.is_file():
        train_baseline(variant, skeleton, training, path, progress)
    return baseline.load_baseline(path, skeleton, training.plan)


def cached_baseline(variant: str, skeleton: Skeleton, training: Training) -> Path:
    """The path of a baseline in the cache (.npz), with its card next to it (.json).

    Args:
        variant: `rf` or `cnn`.
        skeleton: the animal's skeleton.
        training: its images and parameters; their hash with the program's version is in the name.
    """
    return _cached(f"{skeleton.name}-{variant}", training.to_dict())


def train_baseline(
    variant: str, skeleton: Skeleton, training: Training, path: Path, progress: Progress
) -> None:
    """Train a baseline and write it with its card; it gets its name only once it is complete.

    Args:
        variant: `rf` or `cnn`.
        skeleton: the animal's skeleton.
        training: images and parameters.
        path: where the model is written (.npz); the card is next to it (.json).
        progress: called with the progress of rendering and training.
    """
    # the paper's view of an animal of unknown size
    method = replace(method_of("paper", skeleton), session_size=False)
    recipe = training.recipe
    data = rendered_set(skeleton, method, recipe, 0, recipe.n_images, progress)
    began = time.perf_counter()
    model = fit(
        training,
        data,
        skeleton,
        lambda share, what: progress(round(100 * share), 100, f"training {what}"),
    )
    card = {
        "animal": skeleton.name,
        "variant": variant,
        **training.to_dict(),
        "n_images": len(data.size),
        "training_s": round(time.perf_counter() - began, 1),
        "cores": numba.get_num_threads(),
    }
    _store(path, model.to_bytes(), card)


def fit(
    training: Training, data: Any, skeleton: Skeleton, progress: ProgressCallback
) -> baseline.RegressionForest | baseline.Cnn:
    """Train a baseline on rendered images.

    Raises:
        MissingPackageError: the plan is of the CNN and torch is not installed.
    """
    rng = np.random.default_rng(training.recipe.seed)
    if isinstance(training.plan, baseline.CnnPlan):
        return baseline.train_cnn(data, skeleton, training.plan, rng, progress)
    return baseline.train_forests(data, skeleton, training.plan, rng, progress)
