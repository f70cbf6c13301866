"""Models for `liex evaluate tables --quick`, trained within seconds to see that every row runs.

Nobody quotes their numbers.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from liex_lab.runtime.progress import Progress, silent

from .sensitivity import Sweep

if TYPE_CHECKING:
    from liex_lab.baselines.baseline import Baseline
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.estimation.training import TrainingSet

    from .rows import Subject

_N_PAPER = 1_024
_N_BASELINE = 2_048
QUICK_SWEEP = Sweep(
    n_images=512,
    n_test=512,
    values=(
        ("initial poses", (1, 10)),
        ("rounds", (1,)),
        ("trees", (2,)),
        ("tree depth", (8,)),
        ("metric trees", (5,)),
    ),
)


def quick_runs(animal: str, variant: str, progress: Progress = silent) -> list[Subject]:
    """As `rows.runs_of`, from next to no training; the default is the bundled model.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        variant: a row of the tables, such as `paper-no-metric` or `rf`.
        progress: is not told anything.

    Raises:
        MissingPackageError: the CNN is asked for and torch is not installed.
    """
    from ..pose import estimator_of
    from .rows import runs_of_models

    if variant == "default":
        return [estimator_of(animal, "default")]
    if variant in ("rf", "cnn"):
        return [_quick_baseline(animal, variant)]
    return runs_of_models(variant, [_quick_paper(animal)])


@cache
def _quick_paper(animal: str) -> PoseEstimator:
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.estimation.method import method_of

    from ...training.pose_model import make_model, recipe_of

    skeleton = Skeleton.load(animal)
    recipe = replace(recipe_of("paper", skeleton), n_images=_N_PAPER, n_calibration=0)
    return PoseEstimator(make_model(skeleton, method_of("paper", skeleton), recipe, silent))


def _quick_baseline(animal: str, variant: str) -> Baseline:
    from liex_lab.baselines.cnn import CnnPlan, require_torch, train_cnn
    from liex_lab.baselines.forest import ForestPlan, train_forests
    from liex_lab.body.skeleton import Skeleton

    from ...training.baselines import training_of

    skeleton = Skeleton.load(animal)
    rng = np.random.default_rng(0)
    plan = training_of(variant, skeleton).plan
    if isinstance(plan, CnnPlan):
        require_torch()
        small = replace(plan, width=0.25, connected=128, epochs=1)
        return train_cnn(_quick_set(animal), skeleton, small, rng, lambda share, what: None)
    assert isinstance(plan, ForestPlan)
    return train_forests(_quick_set(animal), skeleton, plan, rng, lambda share, what: None)


@cache
def _quick_set(animal: str) -> TrainingSet:
    """Images for the baselines."""
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.method import method_of

    from ...training.baselines import training_of
    from ...training.pose_model import rendered_set

    skeleton = Skeleton.load(animal)
    recipe = training_of("rf", skeleton).recipe
    method = replace(method_of("paper", skeleton), session_size=False)
    return rendered_set(skeleton, method, recipe, 0, _N_BASELINE, silent)
