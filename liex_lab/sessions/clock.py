"""The clock of another instrument: a map of times, and its record in the log of a session."""

import hashlib
from dataclasses import asdict
from dataclasses import dataclass as plain_dataclass
from typing import Any, Literal

import numpy as np
from pydantic.dataclasses import dataclass

from liex_lab.arrays import Array

_WANDER = 2e-5  # change of a clock's rate that must be expected beyond the events


@plain_dataclass(frozen=True, eq=False)
class ClockMap:
    """Times of our clock on another one: linear between knots, and beyond the first and last ones.

    Where a clock jumps, nothing is known between the knots on either side.

    Attributes:
        own_s: (k,) knots on our clock, s, ascending; at least two.
        other_s: (k,) the same moments on the other clock, s.
        sd_s: (k,) standard error of `other_s`; NaN if unknown.
        breaks: numbers of the knots before which a clock jumps.
    """

    own_s: Array
    other_s: Array
    sd_s: Array
    breaks: tuple[int, ...] = ()

    @property
    def rates(self) -> Array:
        """(k - 1,) seconds of the other clock per second of ours, between knots."""
        return np.asarray(np.diff(self.other_s) / np.diff(self.own_s))

    def __call__(self, times_s: Any) -> Array:
        """Times (...) s of our clock on the other one; NaN where it jumps."""
        times = np.asarray(times_s, float)
        k = np.clip(np.searchsorted(self.own_s, times) - 1, 0, len(self.own_s) - 2)
        found = self.other_s[k] + self.rates[k] * (times - self.own_s[k])
        inside = (times > self.own_s[k]) & (times < self.own_s[k + 1])
        return np.where(inside & np.isin(k + 1, self.breaks), np.nan, found)

    def sd(self, times_s: Any) -> Array:
        """Standard error (...) s of mapped times; beyond the knots it grows."""
        times = np.asarray(times_s, float)
        beyond = np.maximum(self.own_s[0] - times, times - self.own_s[-1]).clip(0.0)
        of_rate = (self.sd_s[0] + self.sd_s[-1]) / (self.own_s[-1] - self.own_s[0])
        found = np.interp(times, self.own_s, self.sd_s) + beyond * (_WANDER + of_rate)
        return np.where(np.isnan(self(times)), np.nan, found)


def fingerprint(time_ns: Any) -> str:
    """The first 16 hexadecimal digits of the SHA-256 of a recording's time stamps (n,), ns."""
    return hashlib.sha256(np.asarray(time_ns, "<i8").tobytes()).hexdigest()[:16]


@dataclass(frozen=True)
class ClockFit:
    """The session's times are put on the clock of another instrument.

    Attributes:
        name: of the other clock: its file.
        source: the events on the session's side.
        own_ns: (k,) knots on the recording's clock, ns.
        other_s: (k,) the same moments on the other clock, s.
        sd_s: (k,) standard error of `other_s`, s; None if unknown.
        stamps: fingerprint of the recording's time stamps, see `fingerprint`.
        n_matched: events that agree.
        n_unmatched: events of the session and of the other file without a partner, where both
            recorded.
        rms_ms: root mean square of the residuals, ms.
        residuals: moments, s since the first frame, and residuals there, ms; at most 400 of them,
            with the extremes.
        events: names of events and their times on the other clock, s.
        breaks: numbers of the knots before which a clock jumps.
    """

    name: str
    source: str
    own_ns: tuple[int, ...]
    other_s: tuple[float, ...]
    sd_s: tuple[float, ...] | None
    stamps: str
    n_matched: int
    n_unmatched: tuple[int, int]
    rms_ms: float
    residuals: tuple[tuple[float, float], ...] = ()
    events: tuple[tuple[str, float], ...] = ()
    breaks: tuple[int, ...] = ()
    kind: Literal["clock"] = "clock"

    def __post_init__(self) -> None:
        if not 2 <= len(self.own_ns) == len(self.other_s) or min(np.diff(self.own_ns)) <= 0:
            raise ValueError("a clock has two ascending knots or more")
        if not set(self.breaks) <= set(range(1, len(self.own_ns))):
            raise ValueError("a clock jumps before one of its knots")

    def __str__(self) -> str:
        """The sentence for a list of corrections."""
        return (
            f"times on the clock of {self.name}: {self.n_matched} events, residual "
            f"{self.rms_ms:.2f} ms"
            + (f"; a clock jumps {len(self.breaks)} times, see sync_s" if self.breaks else "")
        )

    @property
    def clock(self) -> ClockMap:
        """The map from seconds since the first knot to the other clock."""
        own = (np.array(self.own_ns) - self.own_ns[0]) * 1e-9
        sd = np.full(len(own), np.nan) if self.sd_s is None else np.array(self.sd_s)
        return ClockMap(own, np.array(self.other_s), sd, self.breaks)

    def times_s(self, time_ns: Any) -> tuple[Array, Array]:
        """Times of the recording's clock, ns, on the other one, and their standard errors, s."""
        times = (np.asarray(time_ns, np.int64) - self.own_ns[0]) * 1e-9
        return self.clock(times), self.clock.sd(times)

    def since(self, first_ns: int, times_s: Any) -> Array:
        """Times of the other clock, s, as seconds after a time of the recording's one, ns."""
        forth = self.clock
        back = ClockMap(forth.other_s, forth.own_s, forth.sd_s, forth.breaks)
        return back(times_s) + 1e-9 * (self.own_ns[0] - first_ns)

    def facts(self) -> dict[str, Any]:
        """Section `sync` of session.json."""
        return {k: value for k, value in asdict(self).items() if k not in ("kind", "events")}
