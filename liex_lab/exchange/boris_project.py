"""BORIS projects, there and back: an ethogram that a person can correct in BORIS, and the corrections as labels.

A project is JSON; state events are pairs of rows, start and stop. What BORIS puts in and we do not know is kept.
"""

from __future__ import annotations

import gzip
import json
import string
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import pandas as pd

from liex_lab.actions.labels import HUMAN, checked
from liex_lab.errors import LiexError

_VERSION = "7.0"  # BORIS refuses projects that are newer than itself
_COLOURS = (
    "#EE6677", "#CCBB44", "#4477AA", "#BBBBBB", "#228833", "#66CCEE", "#AA3377", "#332288", "#999933", "#DDCC77",
)  # fmt: skip
_STATE = "State event"


def write_boris_project(
    path: str | Path, bouts: pd.DataFrame, vocabulary: Mapping[str, str], *, observation: str, duration_s: float,
    fps: float, media: str = "", date: str = "", project: dict[str, Any] | None = None,
) -> Path:  # fmt: skip
    """Write bouts (action, start_s, stop_s, individual) as the observation of a project; returns its path.

    media: the video that a person will look at; '' makes a live observation. project: one that was read before, whose
    other observations and settings stay as they are.
    """
    document = project or _empty(observation)
    words = [*vocabulary, *sorted(set(bouts["action"]) - set(vocabulary))]
    subjects = sorted({str(name) for name in bouts["individual"]}) if "individual" in bouts else []
    _declare(document["behaviors_conf"], "code", [_behaviour(w, vocabulary.get(w, ""), k) for k, w in enumerate(words)])
    _declare(document["subjects_conf"], "name", [{"key": "", "name": s, "description": ""} for s in subjects])
    document["observations"][observation] = _observation(bouts, media, date or _now(), duration_s, fps)
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(document, indent=1, ensure_ascii=False)
    unfinished = target.with_name(f"{target.name}.part")
    unfinished.write_bytes(gzip.compress(text.encode(), mtime=0) if target.suffix == ".gz" else text.encode())
    unfinished.replace(target)
    return target


def read_boris_project(path: str | Path) -> dict[str, Any]:
    """The content of a project, .boris or .boris.gz. Raises LiexError where it is none."""
    source = Path(path)
    try:
        raw = source.read_bytes()
        document = json.loads(gzip.decompress(raw) if raw[:2] == b"\x1f\x8b" else raw)
    except (OSError, EOFError, ValueError) as error:
        raise LiexError(f"{source} should be a BORIS project (JSON), but: {error}") from None
    if not isinstance(document, dict) or not isinstance(document.get("observations"), dict):
        raise LiexError(f"{source} should be a BORIS project, but holds no observations; save it from BORIS again")
    return document


def boris_labels(path: str | Path) -> pd.DataFrame:
    """The state events of a project as labels: session_id (the observation), individual, action, start_s, stop_s.

    The observation's time offset is taken off. An event without its end raises a LiexError that names it; point events
    have no length and are left out.
    """
    document = read_boris_project(path)
    points = {str(b.get("code")) for b in _values(document.get("behaviors_conf"))
              if str(b.get("type", _STATE)).lower().startswith("point")}  # fmt: skip
    rows: list[dict[str, Any]] = []
    for name, observation in document["observations"].items():
        offset = float(observation.get("time offset") or 0.0)
        rows += _pairs(observation.get("events", []), points, str(name), offset, path)
    columns = ["session_id", "individual", "action", "start_s", "stop_s", "source"]
    return checked(pd.DataFrame(rows, columns=columns), str(path))


def boris_export_labels(path: str | Path) -> pd.DataFrame:
    """The labels of BORIS's export 'aggregated events' (TSV or CSV); see `boris_labels`."""
    source = Path(path)
    try:
        table = pd.read_csv(source, sep="\t" if source.suffix == ".tsv" else ",")
    except (OSError, ValueError) as error:
        raise LiexError(f"{source} should be an export of BORIS, but: {error}") from None
    wanted = {"Observation id": "session_id", "Subject": "individual", "Behavior": "action", "Start (s)": "start_s",
              "Stop (s)": "stop_s"}  # fmt: skip
    lacking = [name for name in wanted if name not in table]
    if lacking:
        raise LiexError(f"{source} should be BORIS's export of aggregated events; it lacks the column {lacking[0]}")
    if "Behavior type" in table:
        table = table[table["Behavior type"] == "STATE"]
    return checked(table[list(wanted)].rename(columns=wanted).assign(source=HUMAN), str(source))


def is_boris_export(path: str | Path) -> bool:
    """Whether a table's first line is that of BORIS's exports."""
    with Path(path).open(encoding="utf-8", errors="replace") as file:
        return file.readline().lstrip("\ufeff").startswith(("Observation id", '"Observation id"'))


def _pairs(
    events: Sequence[Sequence[Any]], points: set[str], name: str, offset: float, path: str | Path
) -> list[dict[str, Any]]:
    """Rows of labels from the events of one observation: state events alternate between start and stop."""
    begun: dict[tuple[str, str, str], float] = {}
    rows = []
    try:
        events = sorted(events, key=lambda event: float(event[0]))
        for time, subject, code, modifier, *_ in events:
            if str(code) in points:
                continue
            key = (str(subject), str(code), str(modifier))
            if key not in begun:
                begun[key] = float(time)
                continue
            start = begun.pop(key)
            rows.append({"session_id": name, "individual": key[0], "action": key[1], "start_s": start - offset,
                         "stop_s": float(time) - offset, "source": HUMAN})  # fmt: skip
    except (TypeError, ValueError, IndexError):
        raise LiexError(f"{path}: the observation {name} has an event that cannot be read; check it in BORIS") from None
    if begun:
        (_, code, _), start = next(iter(begun.items()))
        raise LiexError(
            f"{path}: in the observation {name}, {code} starts at {start:g} s and never stops; pair it in BORIS "
            "(Observations, Check state events)"
        )
    return rows


def _observation(bouts: pd.DataFrame, media: str, date: str, duration_s: float, fps: float) -> dict[str, Any]:
    subjects = bouts["individual"] if "individual" in bouts else [""] * len(bouts)
    events: list[list[Any]] = []
    for action, start_s, stop_s, subject in zip(
        bouts["action"], bouts["start_s"], bouts["stop_s"], subjects, strict=True
    ):
        for at in (start_s, stop_s):
            row = [round(float(at), 3), str(subject), str(action), "", ""]
            events.append([*row, round(float(at) * fps)] if media else row)
    events.sort(key=lambda event: event[0])
    shown = {"length": {media: duration_s}, "fps": {media: fps}, "hasVideo": {media: True}, "hasAudio": {media: False},
             "offset": {"1": 0.0}}  # fmt: skip
    return {
        "file": {"1": [media]} if media else {}, "type": "MEDIA" if media else "LIVE", "date": date, "description": "",
        "time offset": 0.0, "independent_variables": {}, "close_behaviors_between_videos": False,
        "media_info": shown if media else {}, "events": events,
    }  # fmt: skip


def _empty(name: str) -> dict[str, Any]:
    return {
        "time_format": "hh:mm:ss", "project_date": _now(), "project_name": name, "project_description": "",
        "project_format_version": _VERSION, "subjects_conf": {}, "behaviors_conf": {}, "observations": {},
        "behavioral_categories": [], "behavioral_categories_config": {}, "independent_variables": {},
        "coding_map": {}, "behaviors_coding_map": [], "converters": {},
    }  # fmt: skip


def _declare(conf: dict[str, Any], key: str, wanted: list[dict[str, Any]]) -> None:
    """Add what is not there yet to one of the project's numbered lists."""
    known = {str(entry.get(key)) for entry in _values(conf)}
    for entry in wanted:
        if entry[key] not in known:
            conf[str(max((int(k) for k in conf if str(k).isdigit()), default=-1) + 1)] = entry


def _values(conf: Any) -> list[dict[str, Any]]:
    return [entry for entry in conf.values() if isinstance(entry, dict)] if isinstance(conf, dict) else []


def _behaviour(word: str, definition: str, number: int) -> dict[str, Any]:
    keys = string.ascii_lowercase + string.digits
    return {
        "type": _STATE, "key": keys[number] if number < len(keys) else "", "code": word, "description": definition,
        "color": _COLOURS[number % len(_COLOURS)], "category": "", "modifiers": {}, "excluded": "", "coding map": "",
    }  # fmt: skip


def _now() -> str:
    return datetime.now().isoformat(timespec="seconds")
