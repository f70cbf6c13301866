"""All views of a session that its folder alone can give: report and layouts of both replays."""

from __future__ import annotations

from pathlib import Path

from liex_lab.dashboards.replay.layouts import write_blueprint, write_layout

from liex_lab.sessions import Session

from .report import write_report


def write_views(folder: str | Path) -> Path:
    """Write the report, and the layouts of both replays as files of their own.

    Args:
        folder: the session's folder.

    Returns:
        Path of the report.
    """
    session = Session.open(folder)
    write_blueprint(session)
    write_layout(session)
    return write_report(folder)
