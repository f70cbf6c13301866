"""Session folders: the on-disk format of one recording's results, written and read here only."""

from liex_lab.sessions.provenance import Provenance
from liex_lab.sessions.session import Session
from liex_lab.sessions.writer import SessionWriter

__all__ = ["Provenance", "Session", "SessionWriter"]
