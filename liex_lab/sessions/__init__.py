"""The only door for results: a session folder is written and read here."""

from liex_lab.sessions.provenance import Provenance
from liex_lab.sessions.session import Session
from liex_lab.sessions.writer import SessionWriter

__all__ = ["Provenance", "Session", "SessionWriter"]
