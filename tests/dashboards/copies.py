"""A study whose sessions are copies of one, so that two hundred are made in seconds: other animals,
other numbers.
"""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pandas as pd

from liex_lab.sessions import Session
from liex_lab.sessions.folder import write_failure

GROUPS = (
    "control",
    "<b>drug</b> %{y}",
)  # a name that must not be taken for markup, nor for a part of a template
_OWN = ("session.json", "summary.csv", "sessions.parquet", "report.html")
FAILED, WAITING = 1, 2  # the places of the sessions that are not done


def study(first: Session, folder: Path, n_sessions: int) -> Path:
    """A study file with its sessions: two per animal, the animals in two groups, one session
    failed, one waiting.
    """
    summary, rng = first.summary, np.random.default_rng(3)
    lines = ['name = "copies"', 'plan = "mouse"', 'results = "derivatives"']
    for k in range(0, n_sessions, 2):
        lines += [
            "[[animals]]",
            f'id = "m{k // 2:03d}"',
            f'group = "{GROUPS[k // 2 % 2]}"',
            f'cage = "c{k // 4}"',
        ]
    for k in range(n_sessions):
        animal, name = f"m{k // 2:03d}", f"{k % 2 + 1:02d}"
        lines += [
            "[[sessions]]",
            f'animal = "{animal}"',
            f'session = "{name}"',
            f'recording = "raw/{k}.oni"',
        ]
        place = folder / "derivatives" / f"sub-{animal}" / f"ses-{name}" / "behav"
        if k == FAILED:
            failure = {
                "stage": "measuring poses",
                "reason": "frame 33 cannot be read",
                "remedy": "copy it again",
            }
            write_failure(place, failure)
        elif k != WAITING:
            speed = summary["mean_speed_mm_s"] - 40.0 * (k // 2 % 2) + 10.0 * rng.standard_normal()
            slower = summary.assign(mean_speed_mm_s=speed)
            _copy(first, place, f"sub-{animal}_ses-{name}", animal, slower)
    (folder / "study.toml").write_text("\n".join(lines), encoding="utf-8")
    _as_planned(folder / "study.toml")
    return folder / "study.toml"


def _copy(first: Session, place: Path, name: str, animal: str, summary: pd.DataFrame) -> None:
    place.mkdir(parents=True)
    for path in first.path.iterdir():
        if path.is_file() and path.name not in _OWN:
            os.link(path, place / path.name)
    shutil.copy(first.path / "report.html", place)
    about = first.metadata | {"session_id": name, "model": {}}
    (place / "session.json").write_text(json.dumps(about), encoding="utf-8")
    summary.assign(session_id=name).to_csv(place / "summary.csv", index=False)
    first.table("sessions").assign(session_id=name, subject_id=animal).to_parquet(
        place / "sessions.parquet"
    )


def _as_planned(path: Path) -> None:
    """Let every session say that it was measured with the study's plan."""
    from liex_lab.plan.study import Study

    for planned in Study.load(path).sessions:
        document = planned.folder / "session.json"
        if document.is_file():
            about = json.loads(document.read_text())
            about["plan"], about["input"]["stamp"] = planned.plan.model_dump(exclude_none=True), ""
            document.write_text(json.dumps(about))
