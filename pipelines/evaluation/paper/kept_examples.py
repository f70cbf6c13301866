"""Example poses of kept rows: their own, or of their model in the cache.

A model in the cache serves where the digest of its file is that of the row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ...build import build_scene, plan_of
from .common_view import CommonView, measured
from .examples import example_frames, pose_at
from .rows import TRAINING_DRAWS, runs_of_models

if TYPE_CHECKING:
    from liex_lab.simulation.recording import TrueRecording

    from .rows import Subject


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
    from .fingerprints import model_digests

    known = row["made"].get("models", [])
    if not known or model_digests(animal, variant, 1)[0] != known[0]:
        return []
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
