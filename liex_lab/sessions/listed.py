"""How a study's sessions are listed for those who look at them: what both jobs and views may know
of each.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

WHO = ("subject_id", "group", "cage", "sex", "batch")


@dataclass(frozen=True)
class Entry:
    """A session as the study lists it. key: its name in the study; folder: None where it was not
    measured.

    who: those of `WHO` that are known.
    """

    key: str
    state: str
    reason: str = ""
    remedy: str = ""
    folder: Path | None = None
    who: dict[str, str] = field(default_factory=dict)
