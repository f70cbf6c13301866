"""BORIS project file (JSON, format version 7.0) with a session's ethogram as one observation.

The fields are those of BORIS 9. A state event is two rows of the same subject and behaviour, start
and stop. BORIS refuses a project newer than itself, so the oldest sufficient version is written.
"""

import gzip
import io
import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from liex_lab.actions.labels import HUMAN, checked
from liex_lab.errors import LiexError, expecting
from liex_lab.runtime.text_files import decoded, read_text, read_texts, split_lines
from liex_lab.sessions import Session
from liex_lab.sessions.session import found_video, video_path

VERSION = "7.0"
_MEDIA = "1"  # BORIS' first player
_KEYS = "abcdefghijklmnopqrstuvwxyz0123456789"


def write_boris(session: Session, path: Path) -> None:
    """Write the project as a .boris file.

    It names the session's video if one was made (`liex export --to video`), which BORIS searches in
    the project's folder first.
    """
    # escapes, because BORIS uses the machine's own encoding, which on Windows is not UTF-8
    text = json.dumps(project(session, path.parent), indent=1)
    path.write_text(text + "\n", encoding="ascii")


def project(session: Session, folder: Path) -> dict[str, Any]:
    """The project as a dict for JSON."""
    about = session.metadata
    subject = about["individual"]
    meanings = about.get("actions", {})
    words = dict.fromkeys([*meanings, *(str(word) for word in session.bouts["action"])])
    behaviours = {
        str(k): {
            "type": "State event",
            "key": _KEYS[k] if k < len(_KEYS) else "",
            "code": word,
            "description": meanings.get(word, ""),
            "color": "",
            "category": "",
            "modifiers": {},
            "excluded": "",
            "coding map": "",
        }
        for k, word in enumerate(words)
    }
    return {
        "time_format": "hh:mm:ss",
        "project_date": _date(session),
        "project_name": session.name,
        "project_description": (
            f"ethogram by liex_lab {about['versions'].get('liex_lab', '')}"
        ).strip(),
        "project_format_version": VERSION,
        "subjects_conf": {
            "0": {"key": "1", "name": subject, "description": about["animal"]["name"]}
        },
        "behaviors_conf": behaviours,
        "observations": {session.name: _observation(session, subject, folder)},
        "behavioral_categories": [],
        "behavioral_categories_config": {},
        "independent_variables": {},
        "coding_map": {},
        "behaviors_coding_map": [],
        "converters": {},
    }


def _observation(session: Session, subject: str, folder: Path) -> dict[str, Any]:
    """The video as the media file, and two rows per bout.

    Without a video the media file is the recording's name, which BORIS need not find.
    """
    beside = video_path(folder, session.name)
    made = found_video(session)
    media = session.metadata["input"]["name"] if made is None else str(made.resolve())
    name = beside.name if beside.is_file() else str(media)
    frames = session.metadata["frames"]
    ends = (("start_s", "start_frame"), ("stop_s", "stop_frame"))
    rows = [
        [round(float(bout[time]), 6), subject, str(bout["action"]), "", "", int(bout[frame])]
        for bout in session.bouts.to_dict("records")
        for time, frame in ends
    ]
    return {
        "file": {_MEDIA: [name]},
        "type": "MEDIA",
        "date": _date(session),
        "description": "",
        "time offset": 0.0,
        "events": sorted(rows, key=lambda row: row[0]),
        "independent_variables": {},
        "close_behaviors_between_videos": False,
        "media_info": {
            "length": {name: frames["duration_s"]},
            "fps": {name: frames["fps_median"] or 0.0},
            "hasVideo": {name: True},
            "hasAudio": {name: False},
            "offset": {_MEDIA: 0.0},
        },
    }


def _date(session: Session) -> str:
    """The recording's beginning in BORIS's format, without a time zone."""
    stated = session.metadata.get("session_start_time") or "1970-01-01T00:00:00"
    return str(stated)[:19]


# Reader of human labels from BORIS project files (JSON) and from its aggregated-events exports.


_STATE = "State event"


def read_boris_project(path: str | Path) -> dict[str, Any]:
    """Read the content of a BORIS project.

    Args:
        path: a .boris file, or one compressed with gzip (.boris.gz), of up to 256 MB uncompressed.

    Raises:
        LiexError: the file is not a BORIS project.
    """
    source = Path(path)
    with expecting(
        LiexError,
        f"{source} should be a BORIS project (JSON)",
        OSError,
        EOFError,
        ValueError,
        RecursionError,
        zlib.error,
    ):
        raw = source.read_bytes()
        if raw[:2] == b"\x1f\x8b":
            with gzip.open(io.BytesIO(raw)) as file:
                raw = file.read((1 << 28) + 1)
            if len(raw) > 1 << 28:
                raise ValueError("it unpacks to more than 256 MB")
        document = json.loads(decoded(raw))
    if not isinstance(document, dict) or not isinstance(document.get("observations"), dict):
        raise LiexError(
            f"{source} should be a BORIS project, but holds no observations; save it from BORIS "
            "again"
        )
    return document


def boris_labels(path: str | Path) -> pd.DataFrame:
    """State events of a project as labels.

    The observation's time offset is subtracted. Point events have no length and are left out.

    Args:
        path: a .boris or .boris.gz file.

    Returns:
        A table with session_id (the observation), individual, action, start_s, stop_s (s) and
            source.

    Raises:
        LiexError: the file is not a BORIS project, or an event has no end; the message names it.
    """
    document = read_boris_project(path)
    conf = document.get("behaviors_conf")
    behaviours = conf.values() if isinstance(conf, dict) else ()
    points = {
        str(b.get("code"))
        for b in behaviours
        if isinstance(b, dict) and str(b.get("type", _STATE)).lower().startswith("point")
    }
    rows: list[dict[str, Any]] = []
    for name, observation in document["observations"].items():
        name = " ".join(str(name).split())
        if not isinstance(observation, dict):
            raise LiexError(
                f"{path}: the observation {name} is not an object; save it from BORIS again"
            )
        try:
            offset = float(observation.get("time offset") or 0.0)
        except (TypeError, ValueError, OverflowError):
            raise LiexError(
                f"{path}: the observation {name} has a time offset that is no number; correct it"
            ) from None
        rows += _pairs(observation.get("events", []), points, name, offset, path)
    columns = ["session_id", "individual", "action", "start_s", "stop_s", "source"]
    return checked(pd.DataFrame(rows, columns=columns), str(path))


def boris_export_labels(path: str | Path) -> pd.DataFrame:
    """Labels of BORIS's export 'aggregated events', a TSV or CSV file; see `boris_labels`.

    Raises:
        LiexError: the file is not such an export.
    """
    source = Path(path)
    with expecting(LiexError, f"{source} should be an export of BORIS", OSError, ValueError):
        table = read_texts(source)
    wanted = {
        "Observation id": "session_id",
        "Subject": "individual",
        "Behavior": "action",
        "Start (s)": "start_s",
        "Stop (s)": "stop_s",
    }
    lacking = [name for name in wanted if name not in table]
    if lacking:
        raise LiexError(
            f"{source} should be BORIS's export of aggregated events; it lacks the column "
            f"{lacking[0]}"
        )
    if "Behavior type" in table:
        table = table[table["Behavior type"] == "STATE"]
    return checked(table[list(wanted)].rename(columns=wanted).assign(source=HUMAN), str(source))


def is_boris_export(path: str | Path) -> bool:
    """Whether a text file's first line is that of BORIS's aggregated-events exports."""
    try:
        lines = split_lines(read_text(Path(path)))[1]
    except ValueError:
        return False
    return "".join(lines[:2]).startswith(("Observation id", '"Observation id"'))


def _pairs(
    events: Sequence[Sequence[Any]], points: set[str], name: str, offset: float, path: str | Path
) -> list[dict[str, Any]]:
    """Labels of the events of one observation; state events alternate between start and stop."""
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
            rows.append(
                {
                    "session_id": name,
                    "individual": key[0],
                    "action": key[1],
                    "start_s": start - offset,
                    "stop_s": float(time) - offset,
                    "source": HUMAN,
                }
            )
    except (TypeError, ValueError, IndexError, OverflowError, KeyError):
        raise LiexError(
            f"{path}: the observation {name} has an event that cannot be read; check it in BORIS"
        ) from None
    if begun:
        (_, code, _), start = next(iter(begun.items()))
        raise LiexError(
            f"{path}: in the observation {name}, {code} starts at {start:g} s and never stops; "
            "pair it in BORIS (Observations, Check state events)"
        )
    return rows
