"""BORIS project file (JSON, format version 7.0) with a session's ethogram as one observation.

The fields are those that BORIS 9 writes. A state event is two rows of the same subject and
behaviour, start and stop. BORIS refuses a project that is newer than itself, so the oldest version
that has all of this is written.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from liex_lab.sessions import Session

VERSION = "7.0"
_MEDIA = "1"  # BORIS' first player
_KEYS = "abcdefghijklmnopqrstuvwxyz0123456789"


def write(session: Session, path: Path) -> None:
    """Write the project.

    Args:
        session: the session.
        path: the .boris file to write.
    """
    path.write_text(
        json.dumps(project(session), indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
    )


def project(session: Session) -> dict[str, Any]:
    """The project as BORIS keeps it, ready for JSON.

    Args:
        session: the session.
    """
    about = session.metadata
    subject = about["individual"]
    bouts = session.bouts
    words = list(
        dict.fromkeys([*about.get("actions", {}), *(str(word) for word in bouts["action"])])
    )
    behaviours = {
        str(k): _behaviour(word, about.get("actions", {}).get(word, ""), k)
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
        "observations": {session.name: _observation(session, subject)},
        "behavioral_categories": [],
        "behavioral_categories_config": {},
        "independent_variables": {},
        "coding_map": {},
        "behaviors_coding_map": [],
        "converters": {},
    }


def _behaviour(word: str, meaning: str, place: int) -> dict[str, Any]:
    key = _KEYS[place] if place < len(_KEYS) else ""
    return {
        "type": "State event",
        "key": key,
        "code": word,
        "description": meaning,
        "color": "",
        "category": "",
        "modifiers": {},
        "excluded": "",
        "coding map": "",
    }


def _observation(session: Session, subject: str) -> dict[str, Any]:
    """The recording as a media file that BORIS need not find, and two rows per bout."""
    frames = session.metadata["frames"]
    name = session.metadata["input"]["name"]
    bouts = session.bouts
    times = bouts[["start_s", "stop_s"]].to_numpy(float)
    indices = bouts[["start_frame", "stop_frame"]].to_numpy(int)
    rows = [
        [round(float(time), 6), subject, str(action), "", "", int(index)]
        for action, two_times, two_indices in zip(bouts["action"], times, indices, strict=True)
        for time, index in zip(two_times, two_indices, strict=True)
    ]
    rate = frames["fps_median"] or 0.0
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
            "fps": {name: rate},
            "hasVideo": {name: True},
            "hasAudio": {name: False},
            "offset": {_MEDIA: 0.0},
        },
    }


def _date(session: Session) -> str:
    """The recording's beginning as BORIS writes dates; without a zone, as it knows none."""
    stated = session.metadata.get("session_start_time") or "1970-01-01T00:00:00"
    return str(stated)[:19]
