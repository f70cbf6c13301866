"""What became of the faults of a campaign, counted alike for all of them."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

_SHOWN = 20  # of the faults that were not survived


@dataclass
class Tally:
    """Faults tried, and those after which not everything was as it should be.

    Attributes:
        tried: faults.
        lost: faults after which something that was measured or made by a person is gone.
        wrong: faults after which tables differ, half a result was read as a whole one, something
            was refused that should not be, or a process hung or stayed.
        tracebacks: faults that were answered by a traceback, or as a fault of the program.
        slowest_s: the longest time to an end after a fault, s.
        kinds: faults by kind.
        more: other figures of the campaign.
        broken: the first faults that were not survived, each in words.
    """

    tried: int = 0
    lost: int = 0
    wrong: int = 0
    tracebacks: int = 0
    slowest_s: float = 0.0
    kinds: Counter[str] = field(default_factory=Counter)
    more: dict[str, Any] = field(default_factory=dict)
    broken: list[str] = field(default_factory=list)

    def fault(
        self,
        kind: str,
        seconds: float = 0.0,
        *,
        lost: str = "",
        wrong: str = "",
        traceback: bool = False,
        said: str = "",
    ) -> None:
        """Count one fault.

        Args:
            kind: what was done.
            seconds: from the fault to the end.
            lost: what is gone, in words; empty where nothing is.
            wrong: what is wrong, in words; empty where nothing is.
            traceback: it was answered by a traceback.
            said: what the program said, kept where the fault was not survived.
        """
        self.tried += 1
        self.kinds[kind] += 1
        self.lost += bool(lost)
        self.wrong += bool(wrong)
        self.tracebacks += traceback
        self.slowest_s = max(self.slowest_s, seconds)
        if lost or wrong or traceback:
            how = "; ".join(filter(None, (lost, wrong, "a traceback" if traceback else "")))
            self.broken.append(f"{kind}: {how}{': ' if said else ''}{said[-1500:]}")

    def to_dict(self) -> dict[str, Any]:
        """The figures as they stand in the file."""
        return {
            "tried": self.tried,
            "survived": self.tried - len(self.broken),
            "lost": self.lost,
            "wrong": self.wrong,
            "tracebacks": self.tracebacks,
            "slowest_s": round(self.slowest_s, 2),
            "kinds": dict(self.kinds),
            **self.more,
            "broken": self.broken[:_SHOWN],
        }
