"""Hashes by which a kept result is known to be of today's code, model, training and test pictures.

- `learning_code`: of the sources that decide what is learned and how a pose is estimated, without
  comments, docstrings and spaces; what is rendered and cut out is told by the pictures themselves.
- `training_pictures`: of the first block of training pictures as the foreground cuts it out.
- `fingerprint_of`: of the pictures, components, choice and size of all test recordings of a split.
"""

from __future__ import annotations

import ast
import hashlib
import io
import platform
import tokenize
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from liex_lab.catalog import MODELS

if TYPE_CHECKING:
    from .common_view import CommonView

DIGITS = 16
# modules that matter to every row, under `liex_lab` and `pipelines`
_ESTIMATION = (
    "_cascade_kernels",
    "_feature_kernels",
    "calibration",
    "cascade",
    "estimator",
    "initial",
    "method",
    "proposals",
    "scoring",
    "training",
)
_FOREST = ("_kernels", "_walk", "forest", "grow")
_OF_ALL = (
    *(f"liex_lab/forests/{name}.py" for name in _FOREST),
    *(f"liex_lab/estimation/{name}.py" for name in _ESTIMATION),
    "liex_lab/baselines/baseline.py",
    "liex_lab/evaluation/pose.py",
    "pipelines/training/pose_model.py",
    "pipelines/evaluation/paper/common_view.py",
)
_OWN = {
    "rf": ("baselines/forest.py", "baselines/_forest.py"),
    "cnn": ("baselines/cnn.py", "baselines/patches.py"),
    "paper-no-metric": ("baselines/ablations.py",),
}


def learning_code(variant: str) -> str:
    """Hash of the sources that decide a row's model and poses.

    Args:
        variant: a row of the tables.
    """
    told = hashlib.sha256()
    paths = [*_OF_ALL, *(f"liex_lab/{path}" for path in _OWN.get(variant, ()))]
    if variant in ("rf", "cnn"):
        paths.append("pipelines/training/baselines.py")
    for path in paths:
        told.update(f"{path}\n{bare_source(_source(path))}\n".encode())
    return told.hexdigest()[:DIGITS]


def _source(path: str) -> str:
    room, rest = path.split("/", 1)
    # installed, `pipelines` lies inside the library; in the repository beside it
    folder = MODELS.parent if room == "liex_lab" else Path(__file__).resolve().parents[2]
    return (folder / rest).read_text(encoding="utf-8")


@cache
def bare_source(source: str) -> str:
    """A module's text without comments, docstrings and spaces.

    Args:
        source: of a Python module.
    """
    lines = [list(line) for line in source.splitlines(keepends=True)]

    def blank(first: tuple[int, int], last: tuple[int, int]) -> None:
        for row in range(first[0], last[0] + 1):
            line = lines[row - 1]
            begin = first[1] if row == first[0] else 0
            end = min(last[1], len(line)) if row == last[0] else len(line)
            line[begin:end] = " " * (end - begin)

    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            blank(token.start, token.end)
    for node in ast.walk(ast.parse(source)):
        body = getattr(node, "body", None)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and body:
            first = body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                blank((first.lineno, 0), (first.end_lineno or first.lineno, 10**9))
    return "".join("".join(map("".join, lines)).split())


def training_pictures(variant: str, animal: str) -> str:
    """Hash of the first block of the pictures that a row's model learns from, cut out.

    Args:
        variant: a row of the tables.
        animal: a bundled animal's name.
    """
    return _first_pictures(base_of(variant), animal)[0]


def training_given(variant: str, animal: str) -> dict[str, float]:
    """What is in these pictures, see `given.of_training`.

    Args:
        variant: a row of the tables.
        animal: a bundled animal's name.
    """
    return _first_pictures(base_of(variant), animal)[1]


def base_of(variant: str) -> str:
    """The variant of the pose model that a row is made with, or whose pictures it learns from.

    Args:
        variant: a row of the tables.
    """
    return "default" if variant == "default" else "paper"


@cache
def _first_pictures(base: str, animal: str) -> tuple[str, dict[str, float]]:
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.estimation.method import method_of
    from liex_lab.runtime.progress import silent

    from ...training.pose_model import recipe_of, rendered_set
    from .given import of_training

    skeleton = Skeleton.load(animal)
    data = rendered_set(
        skeleton, method_of(base, skeleton), recipe_of(base, skeleton), 0, 1, silent
    )
    told = hashlib.sha256(data.images.heights.tobytes())
    told.update(data.truth.positions.round(3).tobytes())
    return told.hexdigest()[:DIGITS], of_training(data)


def fingerprint_of(views: Sequence[CommonView]) -> str:
    """Hash of what every row is given in the recordings of a split, in their order.

    Args:
        views: of the recordings.
    """
    told = hashlib.sha256("\n".join(one.fingerprint for one in views).encode())
    return told.hexdigest()[:DIGITS]


def made_by() -> dict[str, str]:
    """The program and the machine that measure now, as a row states them."""
    from liex_lab.sessions.provenance import package_version

    from .given import processor

    sources = hashlib.sha256()
    for path in sorted(MODELS.parent.rglob("*.py")):
        sources.update(path.read_bytes())
    machine = f"{platform.processor() or platform.machine()}, Python {platform.python_version()}"
    return {
        "version": package_version("liex_lab"),
        "code": sources.hexdigest()[:12],
        "machine": machine,
        "processor": processor(),
    }
