"""Rows and curves that took long to train for: one JSON for each animal in `datasets/kept_results`.

A kept row is its numbers and how they were made: the version of the program, the command with seeds
and number of training images, the day and the machine. Nothing checks that today's code would give
the same numbers; the tables name each row of another version, and they are measured again before a
release. The files are part of the repository: a row's numbers have six digits, and a list or a
pose takes one line.
"""

from __future__ import annotations

import json
import platform
import re
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any

from liex_lab.catalog import kept_results_folder
from liex_lab.errors import LiexError
from liex_lab.sessions.provenance import package_version

SCHEMA = 4
_DIGITS = 6  # significant ones of a measured number
_DEEP = re.compile(r"\n {5,}|\n {4}(?=[]}])")  # line breaks within a list or the numbers of a split


def kept_results(animal: str, folder: Path | None = None) -> dict[str, Any]:
    """What is kept for an animal: `rows` and `sensitivity` by variant, empty where nothing is.

    Args:
        animal: name of the skeleton.
        folder: where results are kept; None takes datasets/kept_results.

    Raises:
        LiexError: the file is damaged, or of another schema.
    """
    path = (folder or kept_results_folder()) / f"{animal}.json"
    if not path.is_file():
        return {"rows": {}, "sensitivity": {}}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        schema = content["schema"]
        kept = {part: dict(content[part]) for part in ("rows", "sensitivity")}
    except (ValueError, TypeError, KeyError) as error:
        raise LiexError(
            f"{path} should hold kept results as JSON, but is damaged ({error}); restore it from "
            "the repository, or measure every row with --fresh"
        ) from None
    if schema != SCHEMA:
        raise LiexError(
            f"{path} holds kept results of schema {schema}, not {SCHEMA}; restore it from the "
            "repository, or measure every row with --fresh"
        )
    return kept


def keep_results(
    folder: Path, animal: str, rows: Mapping[str, Any], sensitivity: Mapping[str, Any]
) -> Path:
    """Write results in the form in which they are kept; in datasets/kept_results they are used.

    Args:
        folder: where `ANIMAL.json` is written; it is made where it is missing.
        animal: name of the skeleton.
        rows: figures by variant. `default` is measured in every run and is not kept.
        sensitivity: curves by variant.

    Returns:
        The path of the file.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{animal}.json"
    content = {
        "schema": SCHEMA,
        "animal": animal,
        "rows": {name: _rounded(row) for name, row in rows.items() if name != "default"},
        "sensitivity": sensitivity,
    }
    text = json.dumps(content, indent=1, sort_keys=True, allow_nan=False)
    path.write_text(_DEEP.sub("", text) + "\n", encoding="utf-8")
    return path


def _rounded(value: Any) -> Any:
    """Plain values with their numbers rounded."""
    if isinstance(value, Mapping):
        return {key: _rounded(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return float(f"{value:.{_DIGITS}g}") if isinstance(value, float) else value


def processor() -> str:
    """The kind of processor that numba compiles for, as LLVM names it, such as `znver4`."""
    import llvmlite.binding as llvm
    import numba

    return str(numba.config.CPU_NAME or llvm.get_host_cpu_name())


def made_by(command: str) -> dict[str, Any]:
    """How a row or a curve is made now: command, version, day and machine.

    Args:
        command: the command line that makes the same numbers.
    """
    return {
        "command": command,
        "version": package_version("liex_lab"),
        "date": date.today().isoformat(),
        "machine": f"{platform.processor() or platform.machine()}, "
        f"Python {platform.python_version()}",
        "processor": processor(),
    }
