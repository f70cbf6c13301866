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

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.runtime.progress import Progress, silent
from liex_lab.runtime.threads import serial_products

if TYPE_CHECKING:
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.estimation.method import Method
    from liex_lab.estimation.model import Model
    from liex_lab.estimation.training import TrainingSet
    from liex_lab.scene.height_maps import HeightMaps
    from liex_lab.simulation.training_patches import TrainingPatches

Array = NDArray[np.float64]


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


# images of the last training by their inputs, see `shared_pictures`; None keeps none
_shared: ContextVar[list[tuple[Any, TrainingSet]] | None] = ContextVar("_shared", default=None)
# separate random streams, so that each step can be repeated by itself
_CALIBRATION = 1
_CORRECTION = 2
_DRAW = 3
# share of the images for calibrating an animal's predicted error that show bodies that vary as
# individuals do; with the others alone, which vary far more, intervals would be wider than most
# animals need
_ORDINARY_SHARE = {"mouse": 0.5}
# of home-sized animals from above, if it differs from the home pose's
_AREAS_MM2 = {"mouse": 1070.0}

# the paper's variant and the baselines learn from the same images, noise and sizes: of animals near
# home size, with as much noise as the default's
RECIPES = {
    "default": Recipe(),
    "paper": Recipe(n_images=40_960, n_correction=0, n_calibration=4_096, sizes=((0.0, 144),)),
}
_AMOUNTS = ("n_images", "n_correction", "n_calibration", "degraded_share")
_OWN_SIZES = (1.0, 0.8, 1.0, 1.25)  # sizes of a user's own animal, over its home length
_FISH_SIZES = ((0.0, 272), (21.0, 192), (0.0, 272), (36.0, 328))
# recipes by animal and variant that differ from the mouse's
_OWN: dict[tuple[str, str], Recipe] = {
    ("fish", "default"): Recipe(
        seed=31, n_images=16_384, n_correction=4_096, n_calibration=4_096, sizes=_FISH_SIZES
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
    from liex_lab.simulation.simulator import GenericSimulator, world_of

    world = world_of(skeleton)
    if not isinstance(world, GenericSimulator):
        return _OWN.get((skeleton.name, variant), RECIPES[variant])
    sizes = tuple(
        (factor * skeleton.length, world.window_px(factor * skeleton.length))
        for factor in _OWN_SIZES
    )
    images = {name: getattr(_OWN["fish", variant], name) for name in _AMOUNTS}
    return Recipe(**images, sizes=sizes if variant == "default" else sizes[:1])


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

    The model is written under another name and renamed once it is complete. The card states its
    provenance, its SHA-256 and its number of bytes.

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
    import numba

    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.method import method_of

    if workers:
        numba.set_num_threads(min(workers, numba.config.NUMBA_NUM_THREADS))
    skeleton = Skeleton.load(animal)
    recipe = recipe_of(variant, skeleton)
    if n_images is not None:
        recipe = replace(
            recipe, n_images=n_images, n_correction=n_images // 4, n_calibration=n_images // 4
        )
    model = make_model(skeleton, method_of(variant, skeleton), recipe, progress, draw)
    path = Path(out)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = model.to_bytes()
    unfinished = path.with_name(f"{path.name}.part-{os.getpid()}")
    unfinished.write_bytes(content)
    card = {**model.card, "sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    path.with_suffix(".json").write_text(
        json.dumps(card, indent=1, sort_keys=True) + "\n", encoding="utf-8"
    )
    unfinished.replace(path)
    return path


@serial_products()
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
    from liex_lab.estimation.calibration import calibrate, with_corrector, with_facing, with_settler
    from liex_lab.estimation.model import ErrorCalibration, Model
    from liex_lab.estimation.training import train_cascade, train_metric, train_pruner
    from liex_lab.scene.height_maps import moment_columns
    from liex_lab.simulation.simulator import world_of

    rng = np.random.default_rng([recipe.seed, _DRAW, draw] if draw else recipe.seed)
    data = rendered_set(skeleton, method, recipe, 0, recipe.n_images, progress)
    steps = len(skeleton.solved) * method.rounds + 2

    def tell(share: float, what: str) -> None:
        """Report that a `share` (0 to 1) of the forests is grown, and `what` is being grown."""
        progress(round(share * (steps - 2)), steps, f"growing forests: {what}")

    cascade, candidates = train_cascade(data, skeleton, method, rng, tell)
    progress(steps - 2, steps, "growing forests: the learned metric")
    metric = train_metric(data, cascade, candidates, rng)
    pruner = train_pruner(data, cascade, candidates, rng)
    area_mm2 = moment_columns(data.images.moments).area_mm2
    area = float(np.median((area_mm2 / data.size**2)[data.animal]))
    card = {
        "animal": skeleton.name,
        "variant": method.variant,
        "made_by": "liex train",
        "recipe": vars(recipe),
        "images": world_of(skeleton).sources,
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
        own = np.random.default_rng([recipe.seed, _CORRECTION])
        model = with_settler(with_corrector(model, unseen, own), unseen, own)
    if recipe.n_calibration:
        progress(steps - 1, steps, "calibrating the predicted error")
        first = recipe.n_images + recipe.n_correction
        unseen = calibration_set(skeleton, method, recipe, first)
        model = calibrate(model, unseen, np.random.default_rng([recipe.seed, _CALIBRATION]))
    if method.tells_facing:
        progress(steps - 1, steps, "learning to tell head from tail")
        first = recipe.n_images + recipe.n_correction + recipe.n_calibration
        model = with_facing(
            model,
            rendered_set(skeleton, method, recipe, first, recipe.n_images, silent),
            recipe.seed,
        )
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
    shared = _shared.get()
    if shared is None or first:
        return _rendered(skeleton, method, recipe, first, n, progress, family)
    # the inputs of images and labels
    key = (skeleton.table, method.camera_view, method.session_size, vars(recipe), n, family)
    for known, data in shared:
        if known == key:
            return data
    data = _rendered(skeleton, method, recipe, first, n, progress, family)
    shared[:] = [(key, data)]
    return data


@contextmanager
def shared_pictures() -> Iterator[None]:
    """A context that keeps a training's images for the next training with the same ones.

    Only those of the last different training are kept, as they take a gigabyte.
    """
    before = _shared.set([])
    try:
        yield
    finally:
        _shared.reset(before)


def _rendered(
    skeleton: Skeleton,
    method: Method,
    recipe: Recipe,
    first: int,
    n: int,
    progress: Progress,
    family: str,
) -> TrainingSet:
    """See `rendered_set`."""
    from liex_lab.estimation.training import TrainingSet
    from liex_lab.simulation.simulator import world_of
    from liex_lab.simulation.training_patches import BLOCK

    world = world_of(skeleton)
    blocks = -(-n // BLOCK)
    begin = -(-first // BLOCK)
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
    return TrainingSet.join(parts)


def calibration_set(skeleton: Skeleton, method: Method, recipe: Recipe, first: int) -> TrainingSet:
    """Held-out images for calibrating a model's predicted error.

    A share of them (`_ORDINARY_SHARE`, half for the mouse) shows bodies that vary as individuals
    do, the rest bodies as varied as in training: intervals from the latter alone would be wider
    than most animals need.

    Args:
        skeleton: the animal's skeleton.
        method: the variant.
        recipe: seed, sizes, and `n_calibration`, the total number of images.
        first: number of the first image.

    Returns:
        The images, varied bodies first.
    """
    from liex_lab.estimation.training import TrainingSet

    ordinary = round(_ORDINARY_SHARE.get(skeleton.name, 0.0) * recipe.n_calibration)
    varied = rendered_set(skeleton, method, recipe, first, recipe.n_calibration - ordinary, silent)
    if not ordinary:
        return varied
    first += recipe.n_calibration - ordinary
    return TrainingSet.join(
        [varied, rendered_set(skeleton, method, recipe, first, ordinary, silent, "train")]
    )


def cut_out(skeleton: Skeleton, method: Method, windows: TrainingPatches) -> TrainingSet:
    """Training images of the two largest components of the segmentation in each patch.

    A hand is segmented by distance (`HandPatches`), every other animal by background subtraction
    (`Patches`) with the patch's own estimated floor and, if the sensor's noise is known, a
    threshold of `SPREADS` standard deviations of the background's readings.

    Args:
        skeleton: the animal's skeleton; its view selects the segmentation.
        method: the variant; whether crops follow the camera's axis, and whether the size is known.
        windows: rendered patches with their background and truth.

    Returns:
        The images of the first components of all patches, then those of the second ones.
    """
    from liex_lab.body.skeleton import FOREGROUNDS
    from liex_lab.estimation.training import TrainingSet
    from liex_lab.scene.background import SPREADS
    from liex_lab.scene.hand_segmenter import HandPatches
    from liex_lab.scene.height_maps import Patches

    size = windows.spine_mm / skeleton.length
    origin = windows.origin.astype(float)
    shown = size if method.session_size else np.ones(len(size))
    if skeleton.view.foreground == FOREGROUNDS[1]:
        held = HandPatches(windows.depth, windows.intrinsics, origin, skeleton.view)
        crops, crop_cameras = held.extract(shown, method.camera_view, n_candidates=2)
    else:
        depth, background = (
            picture if windows.unit_mm == 1.0 else picture * np.float32(windows.unit_mm)
            for picture in (windows.depth, windows.background)
        )
        cut = Patches(depth, background, windows.intrinsics, origin, windows.floor, skeleton.view)
        area = home_area_mm2(skeleton) * size**2  # only ranks the blobs of a window
        # a scene learned from a recording has an estimate of its readings' spread
        least = np.maximum(skeleton.view.min_height_mm, SPREADS * windows.spread_mm)
        crops, crop_cameras = cut.extract(shown, area, least, method.camera_view, n_candidates=2)
    n = len(size)
    return TrainingSet.join(
        [
            with_truth(skeleton, method, windows, crops[thing], crop_cameras[thing])
            for thing in (slice(n), slice(n, None))
        ]
    )


def with_truth(
    skeleton: Skeleton,
    method: Method,
    windows: TrainingPatches,
    crops: HeightMaps,
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
    from liex_lab.body.pose import Pose
    from liex_lab.estimation.cascade import ImageSet, Truth
    from liex_lab.estimation.training import TrainingSet
    from liex_lab.geometry import SE3
    from liex_lab.scene.height_maps import view_of

    T_view_camera = view_of(crop_cameras)
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


def home_area_mm2(skeleton: Skeleton) -> float:
    """Approximate area, mm^2, of a home-sized animal from above; it only ranks blobs by size.

    A fixed value for the mouse, else the area of the skeleton's surface in the home pose.
    """
    from liex_lab.body.surface import Surface

    return _AREAS_MM2.get(skeleton.name) or Surface.of(skeleton).area_mm2


def cached_model(animal: str, variant: str, progress: Progress = silent, draw: int = 0) -> Path:
    """The path of a model that is not bundled: trained once, kept in the user's cache folder.

    Its name contains a hash of the program's version, method, recipe and skeleton; if one of these
    changes, a new model is trained.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        variant: `default` or `paper`.
        progress: called with the progress of a training.
        draw: number of the draw, see `make_model`.

    Returns:
        The path of the model (.npz).
    """
    path = cache_path(animal, variant, draw)
    if path.is_file():
        return path
    return train_model(animal, variant, path, draw=draw, progress=progress)


def cache_path(animal: str, variant: str, draw: int = 0) -> Path:
    """The path in the cache of a model that is not bundled, trained or not.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        variant: `default` or `paper`.
        draw: number of the draw, see `make_model`.
    """
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.method import method_of
    from liex_lab.sessions.provenance import package_version

    skeleton = Skeleton.load(animal)
    method = method_of(variant, skeleton)
    recipe = recipe_of(variant, skeleton)
    made_from: dict[str, Any] = {
        "method": method.to_dict(),
        "recipe": vars(recipe),
        "skeleton": skeleton.table,
    }
    key = hashlib.sha256(
        json.dumps([package_version("liex_lab"), made_from], sort_keys=True).encode()
    ).hexdigest()[:12]
    number = f"-{draw}" if draw else ""
    return cache_folder() / f"{skeleton.name}-{variant}-{key}{number}.npz"


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
    from liex_lab.catalog import bundled_models, find_model
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.estimation.model import Model

    if model is not None or (variant == "default" and animal in bundled_models()):
        return PoseEstimator(Model.load(find_model(model or animal)))
    return PoseEstimator(Model.load(cached_model(animal, variant, progress, draw)))
