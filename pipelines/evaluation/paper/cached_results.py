"""Cache of evaluation results whose models take long to train: JSON in `datasets/kept_results`.

Each row is kept with how it was made (recipe, method, command, version) and with the true joints of
each split's first frame; it is used again only where both agree with what would be measured now.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from liex_lab.catalog import kept_results_folder
from liex_lab.errors import LiexError

if TYPE_CHECKING:
    from liex_lab.simulation.recording import TrueRecording

SCHEMA = 1
_SAME_MM = 0.05  # joints of the same test frame differ by less than this between machines


def kept_results(animal: str, folder: Path | None = None) -> dict[str, Any]:
    """What is kept for an animal: `rows` and `sensitivity` by variant, empty where nothing is.

    Args:
        animal: name of the skeleton.
        folder: where results are kept; None takes datasets/kept_results.

    Raises:
        LiexError: the file is no JSON, or of another schema.
    """
    path = (folder or kept_results_folder()) / f"{animal}.json"
    if not path.is_file():
        return {"rows": {}, "sensitivity": {}}
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise LiexError(
            f"the kept results {path} should be JSON, but: {error}; install liex_lab again"
        ) from None
    if kept.get("schema") != SCHEMA:
        raise LiexError(
            f"the kept results {path} are of schema {kept.get('schema')}, not {SCHEMA}; use --fresh"
        )
    return dict(kept)


def keep_results(
    folder: Path, animal: str, rows: Mapping[str, Any], sensitivity: Mapping[str, Any]
) -> Path:
    """Write results in the form in which they are kept.

    Copied into datasets/kept_results they are used again.

    Args:
        folder: where `ANIMAL.json` is written; it is made where it is missing.
        animal: name of the skeleton.
        rows: figures by variant.
        sensitivity: curves by variant.

    Returns:
        The path of the file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{animal}.json"
    content = {
        "schema": SCHEMA,
        "animal": animal,
        "rows": dict(rows),
        "sensitivity": dict(sensitivity),
    }
    path.write_text(
        json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8"
    )
    return path


def fits(
    row: Mapping[str, Any],
    made_from: Mapping[str, Any],
    tests: Mapping[str, Sequence[TrueRecording]],
) -> bool:
    """Whether a kept row is of the same training and the same test frames as would be measured now.

    Args:
        row: the kept row.
        made_from: how the row's model would be trained now.
        tests: recordings by split; each split's first frame has to agree within 0.05 mm.
    """
    if row["made"]["from"] != json.loads(json.dumps(made_from)):
        return False
    for split, sessions in tests.items():
        known = row["splits"].get(split)
        if known is None or not np.allclose(
            known["first_joints_mm"], first_joints(sessions), atol=_SAME_MM
        ):
            return False
    return True


def first_joints(sessions: Sequence[TrueRecording]) -> list[list[float]]:
    """True joints (J, 3), mm, camera frame, of a split's first frame, by which it is recognised.

    Args:
        sessions: recordings of the split with their truth.
    """
    return [[round(float(x), 3) for x in joint] for joint in sessions[0].joints_camera[0]]
