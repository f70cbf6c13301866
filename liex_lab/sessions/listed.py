"""Entry of a study's session list, shared by the jobs that make it and the views that show it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

WHO = ("subject_id", "group", "cage", "sex", "batch")
ALSO = ("species", "age")  # what archives ask for as well; nothing is grouped by them


@dataclass(frozen=True)
class Entry:
    """A session as the study lists it.

    Attributes:
        key: its name in the study.
        state: done, failed, new, begun, changed or excluded.
        reason: why it is in this state.
        remedy: what to do about it.
        folder: the session folder; None where it was not measured.
        who: those of `WHO` (subject, group, cage, sex, batch) that are known.
    """

    key: str
    state: str
    reason: str = ""
    remedy: str = ""
    folder: Path | None = None
    who: dict[str, str] = field(default_factory=dict)
