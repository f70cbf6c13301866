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
from liex_lab.sessions.videos import found_video, video_path

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
        # escapes, for BORIS opens it in the machine's own encoding, which on Windows is not UTF-8
        json.dumps(project(session, path.parent), indent=1) + "\n",
        encoding="ascii",
    )


def project(session: Session, folder: Path | None = None) -> dict[str, Any]:
    """The project as BORIS keeps it, ready for JSON.

    It names the session's video where one was made (`liex export --to video`).

    Args:
        session: the session.
        folder: the folder of the project, in which BORIS looks for the video first; None names the
            video by its whole path.
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
        "observations": {session.name: _observation(session, subject, folder)},
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


def _media(session: Session, folder: Path | None) -> str:
    """The video as BORIS finds it: seen from the project's folder where it lies there.

    Without a video the recording's name, which BORIS need not find.
    """
    beside = None if folder is None else video_path(folder, session.name)
    if beside is not None and beside.is_file():
        return beside.name
    made = found_video(session)
    return str(session.metadata["input"]["name"]) if made is None else str(made.resolve())


def _observation(session: Session, subject: str, folder: Path | None) -> dict[str, Any]:
    """The video as the media file, and two rows per bout."""
    frames = session.metadata["frames"]
    name = _media(session, folder)
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
