"""Entry of a study's session list, shared by the jobs that make it and the views that show it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from liex_lab.sessions.verdict import CAUTION, LOOK_AT_IT

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


def state_in_words(state: str, reason: str) -> str:
    """The state of a session as people read it: of one that is done, whether all is well with it.

    Args:
        state: done, failed, new, begun, changed or excluded.
        reason: why it is in this state, or what to look at although it is done.
    """
    if state == "done" and reason.startswith(LOOK_AT_IT):
        return f"done, {LOOK_AT_IT}"
    return "done with cautions" if state == "done" and reason.startswith(CAUTION) else state
