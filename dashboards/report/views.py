"""All views that need only the session folder: the report and the layouts of both replays."""

from __future__ import annotations

from pathlib import Path

from liex_lab.sessions import Session

from ..replay.layouts import write_blueprint, write_layout
from .report import write_report


def write_views(folder: str | Path) -> Path:
    """Write the report and the layout files of both replays; returns the report's path."""
    session = Session.open(folder)
    write_blueprint(session)
    write_layout(session)
    return write_report(folder)
