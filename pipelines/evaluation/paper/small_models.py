"""What a version of the program learns from few pictures, and the poses that come of it, as hashes.

`same_code` puts this file into the version that another interpreter has, so that two versions are
asked in the same way. It uses nothing but what both have.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from liex_lab.estimation.model import Model

# enough that the tests of a node are tried on a part of its samples, and then on more of them
_N_IMAGES = 2_048
_N_AFTERWARDS = 512  # for the correction of a pose, and for the predicted error


def learned(animal: str) -> dict[str, dict[str, str]]:
    """Code and outcome of each row of the tables, of models that learn from some 2,000 pictures.

    Args:
        animal: a bundled animal's name.

    Returns:
        By row `code`, the hash of the learning code (`fingerprints`), and `learned`, the hash of
        its small models and of their poses in a recording; without the CNN where torch is not
        installed.
    """
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.errors import MissingPackageError
    from liex_lab.estimation.estimator import PoseEstimator
    from liex_lab.simulation.simulator import world_of

    from ...build import plan_of
    from ...training.baselines import BASELINES
    from ..pose import estimator_of
    from .common_view import common_view, measured
    from .fingerprints import learning_code
    from .quick import quick_runs
    from .rows import ROWS, runs_of_models

    skeleton = Skeleton.load(animal)
    world = world_of(skeleton)
    recording = world.test_split(world.splits[-1], n_sessions=1)[0]
    chooser = estimator_of(animal, "default")
    scene, frames, view = common_view(recording, plan_of(animal), chooser)
    models = {variant: _small(skeleton, variant) for variant in ("default", "paper")}
    runs: dict[str, Sequence[Any]] = {"default": [PoseEstimator(models["default"])]}
    paper = PoseEstimator(models["paper"])
    told = {}
    for row in ROWS:
        model = models["default" if row == "default" else "paper"].to_bytes()
        if row in BASELINES:
            try:
                runs[row] = quick_runs(animal, row)
            except MissingPackageError:
                continue
            model = runs[row][0].to_bytes()
        elif row != "default":
            runs[row] = runs_of_models(row, [paper])
        sha = hashlib.sha256(model)
        cut: dict[Any, Any] = {}
        for run in runs[row]:
            for found in measured(run, frames, scene, view, cut):
                sha.update(found.tobytes())
        told[row] = {"code": learning_code(row), "learned": sha.hexdigest()}
    return told


def _small(skeleton: Any, variant: str) -> Model:
    """A model of the variant as it is trained, but for the number of pictures."""
    from liex_lab.estimation.method import method_of
    from liex_lab.runtime.progress import silent

    from ...training.pose_model import make_model, recipe_of

    recipe = recipe_of(variant, skeleton)
    few = replace(
        recipe,
        n_images=_N_IMAGES,
        n_correction=min(recipe.n_correction, _N_AFTERWARDS),
        n_calibration=_N_AFTERWARDS,
    )
    return make_model(skeleton, method_of(variant, skeleton), few, silent)
