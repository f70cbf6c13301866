"""Training of the paper's baselines RF and CNN (Lie-X section 5.2), kept in the user's cache.

RF is a pair of regression forests, CNN an AlexNet that regresses all joints. Both are trained on
first use, on the rendered images of the paper's variant (`recipe_of`).
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liex_lab.baselines.cnn import CnnPlan
from liex_lab.baselines.forest import ForestPlan
from liex_lab.runtime.progress import Progress, silent

if TYPE_CHECKING:
    from liex_lab.baselines.baseline import Baseline
    from liex_lab.baselines.cnn import Cnn
    from liex_lab.baselines.forest import RegressionForest
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.training import ProgressCallback

    from .pose_model import Recipe


@dataclass(frozen=True)
class Training:
    """Training images and parameters of a baseline.

    Attributes:
        recipe: the rendered images.
        plan: parameters of the forests or of the network.
    """

    recipe: Recipe
    plan: ForestPlan | CnnPlan

    def to_dict(self) -> dict[str, Any]:
        """Plain values of the training, a cache key: equal values mean equal training.

        A zero turn of the home pose is omitted, so that keys of older plans stay the same.
        """
        plan = {
            name: value
            for name, value in asdict(self.plan).items()
            if name != "home_turn" or any(value)
        }
        plain: dict[str, Any] = json.loads(json.dumps({"recipe": vars(self.recipe), "plan": plan}))
        return plain


BASELINES: dict[str, ForestPlan | CnnPlan] = {"rf": ForestPlan(), "cnn": CnnPlan()}
_SEEN = 122_880  # total views of the CNN, whatever the number of images


def training_of(variant: str, skeleton: Skeleton) -> Training:
    """The training of a baseline, on the images of the paper's variant.

    They are the same in number, noise and sizes (40,960 for the mouse, 20,480 for the hand, 16,384
    for others, half of them degraded); the CNN gets about 122,880 views in total, over as many
    epochs as needed.

    Args:
        variant: `rf` or `cnn`, a key of `BASELINES`.
        skeleton: the animal's skeleton.
    """
    from liex_lab.estimation.method import method_of

    from .pose_model import recipe_of

    recipe = replace(recipe_of("paper", skeleton), n_calibration=0)
    plan = BASELINES[variant]
    if isinstance(plan, CnnPlan):
        plan = replace(plan, epochs=round(_SEEN / recipe.n_images))
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
    from liex_lab.body.skeleton import Skeleton

    if variant == "cnn":
        from liex_lab.baselines.cnn import require_torch

        require_torch()  # before anything is rendered
    skeleton = Skeleton.load(animal)
    training = training_of(variant, skeleton)
    path = cached_baseline(variant, skeleton, training)
    if not path.is_file():
        train_baseline(variant, skeleton, training, path, progress)
    return _load(path, skeleton, training.plan)


def cached_baseline(variant: str, skeleton: Skeleton, training: Training) -> Path:
    """The path of a baseline in the cache (.npz), with its card next to it (.json).

    Args:
        variant: `rf` or `cnn`.
        skeleton: the animal's skeleton.
        training: its images and parameters; their hash with the program's version is in the name.
    """
    from liex_lab.sessions.provenance import package_version

    from .pose_model import cache_folder

    made_from = json.dumps([package_version("liex_lab"), training.to_dict()], sort_keys=True)
    return (
        cache_folder()
        / f"{skeleton.name}-{variant}-{hashlib.sha256(made_from.encode()).hexdigest()[:12]}.npz"
    )


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
    import numba

    from liex_lab.estimation.method import method_of

    from .pose_model import rendered_set

    recipe = training.recipe
    # the paper's view of an animal of unknown size
    method = replace(method_of("paper", skeleton), session_size=False)
    data = rendered_set(skeleton, method, recipe, 0, recipe.n_images, progress)
    began = time.perf_counter()

    def tell(share: float, what: str) -> None:
        """Report that a `share` (0 to 1) of the training is done, and `what` is being trained."""
        progress(round(100 * share), 100, f"training {what}")

    model = fit(training, data, skeleton, tell)
    card = {
        "animal": skeleton.name,
        "variant": variant,
        **training.to_dict(),
        "n_images": len(data.size),
        "training_s": round(time.perf_counter() - began, 1),
        "cores": numba.get_num_threads(),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f"{path.name}.part-{os.getpid()}")
    unfinished.write_bytes(model.to_bytes())
    path.with_suffix(".json").write_text(
        json.dumps(card, indent=1, sort_keys=True) + "\n", encoding="utf-8"
    )
    unfinished.replace(path)


def fit(
    training: Training, data: Any, skeleton: Skeleton, tell: ProgressCallback
) -> RegressionForest | Cnn:
    """Train a baseline on rendered images.

    Raises:
        MissingPackageError: the plan is of the CNN and torch is not installed.
    """
    rng = np.random.default_rng(training.recipe.seed)
    if isinstance(training.plan, CnnPlan):
        from liex_lab.baselines.cnn import train_cnn

        return train_cnn(data, skeleton, training.plan, rng, tell)
    from liex_lab.baselines.forest import train_forests

    return train_forests(data, skeleton, training.plan, rng, tell)


def _load(path: Path, skeleton: Skeleton, plan: ForestPlan | CnnPlan) -> RegressionForest | Cnn:
    if isinstance(plan, CnnPlan):
        from liex_lab.baselines.cnn import Cnn

        return Cnn.load(path, skeleton, plan)
    from liex_lab.baselines.forest import RegressionForest

    return RegressionForest.load(path, skeleton, plan)
