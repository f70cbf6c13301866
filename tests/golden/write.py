"""Makes a golden session once: `python -m tests.golden.write 1`, from the repository's root."""

from __future__ import annotations

import gzip
import io
import json
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.optics.camera import Camera, Water
from liex_lab.plan import Plan
from liex_lab.recordings.timestamps import find_gaps, median_step
from liex_lab.scene.scene import Arena
from liex_lab.scene.zones import Zone
from liex_lab.sessions import Session
from tests.sessions.walking_mouse import WalkingMouse, write

HERE = Path(__file__).parent
TABLES = (
    "frames",
    "poses",
    "rotations",
    "kinematics",
    "bouts",
    "gaps",
    "flips",
    "sessions",
    "summary",
)
ARENA = Arena("round", (5.0, -3.0), 210.0, None, None, 0.4, 0.95, "wall")
ZONES = (
    Zone("centre", (5.0, -3.0, 148.0)),
    Zone("east", polygon_mm=((0.0, -250.0), (250.0, -250.0), (0.0, 250.0))),
)
WATER = Water(500.0)
CAMERA = Camera(71.6, 71.6, 39.5, 29.5, 80, 60, source="typical PrimeSense, an eighth of its size")


def contents(session: Session) -> dict[str, Any]:
    """Every table of a session in short: its rows, and of each column its type and its values added
    up.
    """
    found: dict[str, Any] = {}
    for name in TABLES:
        table = getattr(session, name) if name != "sessions" else session.table("sessions")
        found[name] = {
            "n_rows": len(table),
            "columns": {str(c): summed(table[c]) for c in table.columns},
        }
    return found


def summed(column: pd.Series[Any]) -> list[Any]:
    """A column's kind, how many of its values are known, and their sum, or the different words
    among them.
    """
    if pd.api.types.is_numeric_dtype(column):
        known = column[np.isfinite(column.astype(float))]
        return [str(column.dtype), len(known), float(known.sum())]
    return ["text", len(column), sorted({str(word) for word in column})]


def main(number: int) -> None:
    """Write session_N.tar.gz and session_N.json."""
    archive, expected = HERE / f"session_{number}.tar.gz", HERE / f"session_{number}.json"
    if archive.exists():
        raise SystemExit(f"{archive} is there and is never written anew; see README.md beside it")
    mouse = WalkingMouse(
        np.delete(np.arange(14) / 30, [5, 6]), rear_s=(0.15, 0.6), lost=(9,), camera=CAMERA
    )
    with tempfile.TemporaryDirectory() as folder:
        session = write(
            Path(folder) / f"session_{number}",
            mouse,
            chunk=5,
            plan_toml=Plan.load("mouse").to_toml(),
            gaps=find_gaps(mouse.times_ns, median_step(mouse.times_ns)),
            problems=["written for a test"],
            model={"name": "mouse", "sha256": "ab" * 32},
            subject={"subject_id": "m01"},
            session_start_time="2026-01-05T10:00:00+01:00",
            optics={"distortion": None, "water": WATER.to_dict()},
            arena=ARENA,
            zones=ZONES,
        )
        archive.write_bytes(packed(session.path))
        expected.write_text(
            json.dumps(contents(session), indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
        )


def packed(folder: Path) -> bytes:
    """A folder as .tar.gz, without times and owners."""
    plain = io.BytesIO()
    with tarfile.open(fileobj=plain, mode="w") as tar:
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            member = tarfile.TarInfo(path.relative_to(folder.parent).as_posix())
            member.size = path.stat().st_size
            tar.addfile(member, io.BytesIO(path.read_bytes()))
    return gzip.compress(plain.getvalue(), 9, mtime=0)


if __name__ == "__main__":
    main(int(sys.argv[1]))
