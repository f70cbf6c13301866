"""The clock of another instrument: a map of times, and its record in the log of a session."""

from dataclasses import asdict
from dataclasses import dataclass as plain_dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic.dataclasses import dataclass

Array = NDArray[np.float64]
_WANDER = 2e-5  # change of a clock's rate that must be expected beyond the events


@plain_dataclass(frozen=True, eq=False)
class ClockMap:
    """Times of our clock on another one: linear between knots, and beyond the first and last ones.

    Attributes:
        own_s: (k,) knots on our clock, s, ascending; at least two.
        other_s: (k,) the same moments on the other clock, s.
        sd_s: (k,) standard error of `other_s`; NaN if unknown.
    """

    own_s: Array
    other_s: Array
    sd_s: Array

    @property
    def rates(self) -> Array:
        """(k - 1,) seconds of the other clock per second of ours, between knots."""
        return np.asarray(np.diff(self.other_s) / np.diff(self.own_s))

    def __call__(self, times_s: Any) -> Array:
        """Times (...) s of our clock on the other one."""
        times = np.asarray(times_s, float)
        k = np.clip(np.searchsorted(self.own_s, times) - 1, 0, len(self.own_s) - 2)
        return np.asarray(self.other_s[k] + self.rates[k] * (times - self.own_s[k]))

    def sd(self, times_s: Any) -> Array:
        """Standard error (...) s of mapped times; beyond the knots it grows."""
        times = np.asarray(times_s, float)
        beyond = np.maximum(self.own_s[0] - times, times - self.own_s[-1]).clip(0.0)
        of_rate = (self.sd_s[0] + self.sd_s[-1]) / (self.own_s[-1] - self.own_s[0])
        return np.asarray(
            np.interp(times, self.own_s, self.sd_s) + beyond * (_WANDER + of_rate), float
        )


@dataclass(frozen=True)
class ClockFit:
    """The session's times are put on the clock of another instrument.

    Attributes:
        name: of the other clock: its file.
        source: the events on the session's side.
        own_ns: (k,) knots on the recording's clock, ns.
        other_s: (k,) the same moments on the other clock, s.
        sd_s: (k,) standard error of `other_s`, s; None if unknown.
        n_matched: events that agree.
        n_unmatched: events of the session and of the other file without a partner, where both
            recorded.
        rms_ms: root mean square of the residuals, ms.
        residuals: moments, s since the first frame, and residuals there, ms; at most 400 of them,
            with the extremes.
    """

    name: str
    source: str
    own_ns: tuple[int, ...]
    other_s: tuple[float, ...]
    sd_s: tuple[float, ...] | None
    n_matched: int
    n_unmatched: tuple[int, int]
    rms_ms: float
    residuals: tuple[tuple[float, float], ...] = ()
    kind: Literal["clock"] = "clock"

    def __post_init__(self) -> None:
        if not 2 <= len(self.own_ns) == len(self.other_s) or min(np.diff(self.own_ns)) <= 0:
            raise ValueError("a clock has two ascending knots or more")

    def __str__(self) -> str:
        """The sentence for a list of corrections."""
        return (
            f"times on the clock of {self.name}: {self.n_matched} events, residual "
            f"{self.rms_ms:.2f} ms"
        )

    def times_s(self, time_ns: Any) -> tuple[Array, Array]:
        """Times of the recording's clock, ns, on the other one, and their standard errors, s."""
        own = (np.array(self.own_ns) - self.own_ns[0]) * 1e-9
        sd = np.full(len(own), np.nan) if self.sd_s is None else np.array(self.sd_s)
        clock = ClockMap(own, np.array(self.other_s), sd)
        times = (np.asarray(time_ns, np.int64) - self.own_ns[0]) * 1e-9
        return clock(times), clock.sd(times)

    def facts(self) -> dict[str, Any]:
        """Section `sync` of session.json."""
        return {name: value for name, value in asdict(self).items() if name != "kind"}
