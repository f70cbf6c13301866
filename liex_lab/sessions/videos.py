"""Where the videos of a session lie, so that the report, `liex suggest` and BORIS find them."""

from __future__ import annotations

from pathlib import Path

from liex_lab.runtime.places import safe_name
from liex_lab.sessions.session import Session


def video_path(folder: Path, name: str, what: str = "") -> Path:
    """Path of a video.

    Args:
        folder: the folder that it lies in.
        name: of the session, or of the study.
        what: what of it is shown, such as an action; "" for all of it.
    """
    tail = "".join(c if c.isalnum() or c in "-_.+" else "_" for c in what)
    return folder / safe_name(f"{name}_{tail}" if tail else name, ".mp4")


def stretch(start_s: float | None, stop_s: float | None) -> str:
    """What a video of a part of a session is called.

    Args:
        start_s: where it begins, s; None at the beginning.
        stop_s: where it ends, s; None at the end.
    """
    start = f"from_{start_s or 0.0:.2f}s"
    return start if stop_s is None else f"{start}_to_{stop_s:.2f}s"


def found_video(session: Session, what: str = "") -> Path | None:
    """The video of a session in its folder; None where none was made.

    Args:
        session: the opened session.
        what: what of it is shown; "" for all of it.
    """
    path = video_path(session.path, session.name, what)
    return path if path.is_file() else None
