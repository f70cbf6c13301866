"""Example poses of kept rows: their own, or of their model in the cache; and whether a model that
training gave here is the one that a row was measured with.

A model whose file has the row's digest is. A file holds more than what poses come from (its card,
the calibration of the predicted error), so another file is compared by the poses in the row's
examples.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...build import build_scene, plan_of
from .common_view import CommonView, measured
from .examples import example_frames, pose_at
from .rows import TRAINING_DRAWS, runs_of_models

if TYPE_CHECKING:
    from liex_lab.simulation.recording import TrueRecording

    from .rows import Subject
SAME_MM = 0.03  # joints are kept in hundredths of a mm, in three coordinates


class OtherModel(NamedTuple):
    """Of a model that training gave here in another file than the row's.

    Attributes:
        refused: why the row must not be used; '' where it may.
        told: what stands beside the row; '' where there is nothing to say.
    """

    refused: str = ""
    told: str = ""


def examples_of_kept(
    animal: str,
    variant: str,
    row: Mapping[str, Any],
    tests: Mapping[str, Sequence[TrueRecording]],
    views: Mapping[str, Sequence[CommonView]],
) -> list[dict[str, Any]]:
    """The examples of a kept row, its own or from its model in the cache; [] where neither is.

    Args:
        animal: a bundled animal's name.
        variant: a row of the tables.
        row: the kept row; the digest of its first model proves that one in the cache is its own.
        tests: recordings with their truth by split.
        views: what every row is given, by split and recording.
    """
    if "examples" in row:
        return list(row["examples"])
    from .trained_by import model_digests

    known = row["made"].get("models", [])
    if not known or model_digests(animal, variant, 1)[0] != known[0]:
        return []
    return _poses_of_model(animal, variant, tests, views)


def other_model(
    animal: str,
    variant: str,
    row: Mapping[str, Any],
    models: Sequence[str | None],
    tests: Mapping[str, Sequence[TrueRecording]],
    views: Mapping[str, Sequence[CommonView]],
) -> OtherModel:
    """What a model that today's code trained here says of a kept row.

    Args:
        animal: a bundled animal's name.
        variant: a row of the tables.
        row: the kept row.
        models: digests of today's models, None where there is none.
        tests: recordings with their truth by split.
        views: what every row is given, by split and recording.
    """
    then = row["made"]["models"]
    if models[0] in (None, then[0]) or "examples" not in row:
        return OtherModel()
    files = f"{then[0]}, and training gives {models[0]} here"
    today = _poses_of_model(animal, variant, tests, views)
    apart = max((_apart_mm(*pair) for pair in zip(row["examples"], today, strict=True)), default=0)
    if apart > SAME_MM:
        return OtherModel(
            refused=f"the kept row is of another model: its file is {files}, and of poses in the "
            f"row's {len(today)} example frames joints lie up to {apart:.2f} mm apart"
        )
    return OtherModel(
        told=f"the file of its model is {files}; poses in the row's {len(today)} example frames "
        f"are the same within {SAME_MM:g} mm, so what differs is not what poses come from"
    )


def _apart_mm(then: Mapping[str, Any], now: Mapping[str, Any]) -> float:
    """How far the joints of two examples lie apart at most, mm; infinite where one is none."""
    poses = [one["joints_mm"] for one in (then, now)]
    if None in poses:
        return 0.0 if poses[0] is poses[1] else np.inf
    return float(np.linalg.norm(np.subtract(*poses), axis=-1).max())


def _poses_of_model(
    animal: str,
    variant: str,
    tests: Mapping[str, Sequence[TrueRecording]],
    views: Mapping[str, Sequence[CommonView]],
) -> list[dict[str, Any]]:
    """The examples of the model in the cache."""
    subject = _first_run(animal, variant)
    plan = plan_of(animal)
    found = []
    for split, recordings in tests.items():
        for k, i in example_frames(recordings):
            scene, frames = build_scene(recordings[k], plan, subject.skeleton, len(recordings[k]))
            view = replace(views[split][k], second=views[split][k].second[i : i + 1])
            joints = measured(subject, frames[i : i + 1], scene, view, {})[0]
            found.append(pose_at(split, k, i, joints[0]))
    return found


def _first_run(animal: str, variant: str) -> Subject:
    """The first run of a row whose model is in the cache."""
    from ..pose import estimator_of, subject_of

    if variant in TRAINING_DRAWS:
        return runs_of_models(variant, [estimator_of(animal, "paper")])[0]
    return subject_of(animal, variant)
