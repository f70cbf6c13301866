"""Everything that is there to look at in a session's folder and can be made again from what lies in
it.
"""

from __future__ import annotations

from pathlib import Path

from liex_lab.sessions import Session

from ..replay.foxglove_layout import write_layout
from ..replay.rerun_blueprint import write_blueprint
from .report import write_report


def write_views(folder: str | Path) -> Path:
    """The report, and the layouts of both replays as files of their own; returns the
    report's path.
    """
    session = Session.open(folder)
    write_blueprint(session)
    write_layout(session)
    return write_report(folder)
