"""Which code trained a model of the cache: a note beside the file, NAME.trained-by.json.

The name of a cached model tells method, recipe and version, and no code. A row that is measured
anew takes a cached model only where the note says that today's learning code trained this very
file; any other, and one without a note, is trained again.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING

from liex_lab.runtime.progress import Progress, silent

from .fingerprints import DIGITS, base_of, learning_code

if TYPE_CHECKING:
    from liex_lab.baselines.baseline import Baseline
    from liex_lab.estimation.estimator import PoseEstimator


def paper_of_today(animal: str, draw: int, progress: Progress = silent) -> PoseEstimator:
    """The paper's variant as today's code trains it, from the cache where that is proven.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        draw: number of the training.
        progress: told how far the training is, where there is one.
    """
    from ...training.pose_model import cache_path
    from ..pose import estimator_of

    path = cache_path(animal, "paper", draw)
    forget_unless_of(path, learning_code("paper"))
    estimator = estimator_of(animal, "paper", progress, draw=draw)
    note(path, learning_code("paper"))
    return estimator


def baseline_of_today(animal: str, variant: str, progress: Progress = silent) -> Baseline:
    """A baseline as today's code trains it, from the cache where that is proven.

    Args:
        animal: a bundled animal's name, or the path of a skeleton's TOML.
        variant: `rf` or `cnn`.
        progress: told how far the training is, where there is one.

    Raises:
        MissingPackageError: the CNN is asked for and torch is not installed.
    """
    from liex_lab.body.skeleton import Skeleton

    from ...training.baselines import cached_baseline, trained_baseline, training_of

    skeleton = Skeleton.load(animal)
    path = cached_baseline(variant, skeleton, training_of(variant, skeleton))
    forget_unless_of(path, learning_code(variant))
    baseline = trained_baseline(animal, variant, progress)
    note(path, learning_code(variant))
    return baseline


def is_of(path: Path, code: str) -> bool:
    """Whether a note says that a model file was trained by some code.

    Args:
        path: of the model.
        code: hash of the learning code.
    """
    try:
        told = json.loads(_note_of(path).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return (
        isinstance(told, dict)
        and told.get("learning_code") == code
        and told.get("sha256") == _digest(path)
    )


def model_digests(
    animal: str, variant: str, draws: int, *, of_today: bool = False
) -> list[str | None]:
    """SHA-256 of a row's model files; None for one that is not at hand.

    Args:
        animal: a bundled animal's name.
        variant: a row of the tables.
        draws: number of models that the row is the mean of.
        of_today: only those of the cache that a note says today's learning code trained: another
            one says nothing about what training gives (`trained_by`).
    """
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.catalog import bundled_models, find_model

    from ...training.baselines import BASELINES, cached_baseline, training_of
    from ...training.pose_model import cache_path

    if variant == "default" and animal in bundled_models():
        paths = [find_model(animal)]
    elif variant in BASELINES:
        skeleton = Skeleton.load(animal)
        paths = [cached_baseline(variant, skeleton, training_of(variant, skeleton))]
    else:
        paths = [cache_path(animal, base_of(variant), draw) for draw in range(draws)]
    code = learning_code(variant if variant in BASELINES else base_of(variant))
    asked = of_today and variant != "default"
    return [
        hashlib.sha256(path.read_bytes()).hexdigest()[:DIGITS]
        if path.is_file() and (not asked or is_of(path, code))
        else None
        for path in paths
    ]


def forget_unless_of(path: Path, code: str) -> None:
    """Take a model out of the cache unless it is known to be trained by some code.

    Args:
        path: of the model, which need not be there.
        code: hash of the learning code.
    """
    if path.is_file() and not is_of(path, code):
        path.unlink()
    if not path.is_file():
        _note_of(path).unlink(missing_ok=True)


def note(path: Path, code: str) -> None:
    """Write beside a model which code trained it.

    Args:
        path: of the model; where there is none, nothing is written.
        code: hash of the learning code.
    """
    if not path.is_file() or is_of(path, code):
        return
    told = {"learning_code": code, "sha256": _digest(path)}
    _note_of(path).write_text(json.dumps(told, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def _note_of(path: Path) -> Path:
    return path.with_name(f"{path.stem}.trained-by.json")


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
