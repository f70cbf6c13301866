"""Monte Carlo evaluation of the alignment of clocks: `liex evaluate sync`.

Every pair of trains has one base train, recorded by two clocks of unknown offset, whose rate
differs by a constant and by a slow oscillation, as with temperature. Each side loses events, has
further ones, and jitters. The error is that of the map, at 200 moments of the common span.
"""

from typing import Any

import numpy as np

from liex_lab.arrays import Array
from liex_lab.exchange.clocks import SyncError, align
from liex_lab.runtime.progress import Progress, silent

PROTOCOL = (
    "trains of 5 to 60 minutes: regular (0.5 to 5 s), random intervals (0.5 to 1.5 times a mean of "
    "0.5 to 5 s), barcodes (a counter of 32 bits of 30 ms every 10 to 30 s), regular with the "
    "first event stated as common, nearly regular (intervals that vary by 0.03 to 5 %), and "
    "unrelated trains of random intervals; clocks offset by up to 10,000 s, rates apart by up to "
    "200 ppm and an oscillation of up to 20 ppm in 20 to 60 min; of random intervals, a clock that "
    "jumps by 0.2 to 100 s at a moment within its middle 60 %; on each side jitter of 0.02 to 2 "
    "ms (SD), 0 to 10 % of the events lost and 0 to 10 % added, and up to 20 % cut off at each end"
)
KINDS = (
    "regular",
    "random",
    "barcode",
    "regular_first_stated",
    "nearly_regular",
    "unrelated",
    "jump",
)
_WRONG_S = 0.01  # off by more at a tenth of the moments is wrong; so is any of unrelated


def base_train(kind: str, duration_s: float, rng: np.random.Generator) -> Array:
    """Times of the common events, s."""
    if kind == "barcode":
        every, first = rng.uniform(10.0, 30.0), int(rng.integers(2**31))
        starts = np.arange(0.0, duration_s, every)
        codes = (first + np.arange(len(starts))) % 2**32
        bits = codes[:, None] >> np.arange(32) & 1
        # a start and a stop pulse around the bits
        levels = np.pad(bits, ((0, 0), (1, 2)))
        levels = np.concatenate([np.ones((len(starts), 1), int), levels], axis=1)
        levels[:, -1] = 1
        rises = np.diff(levels, axis=1, prepend=0) == 1
        return np.sort((starts[:, None] + 0.03 * np.arange(levels.shape[1]))[rises])
    mean = rng.uniform(0.5, 5.0)
    spread = 0.0 if kind.startswith("regular") else 0.5
    if kind == "nearly_regular":
        spread = np.exp(rng.uniform(np.log(3e-4), np.log(0.05)))
    steps = mean * rng.uniform(1.0 - spread, 1.0 + spread, int(2.0 * duration_s / mean) + 1)
    times = np.cumsum(steps)
    return times[times < duration_s]


def recorded(times: Array, rng: np.random.Generator, first: bool) -> Array:
    """The events as one side records them: cut, lost, added, and with jitter.

    Args:
        times: true times on its clock, s.
        rng: random numbers.
        first: whether its first event is the common first one.
    """
    cut = rng.uniform(0.0, 0.2, 2) * len(times)
    kept = times[0 if first else int(cut[0]) : len(times) - int(cut[1])]
    lost = rng.random(len(kept)) < rng.uniform(0.0, 0.1)
    lost[0] &= not first
    n_more = int(rng.uniform(0.0, 0.1) * len(kept))
    jitter = np.exp(rng.uniform(np.log(2e-5), np.log(2e-3)))
    events = kept[~lost] + rng.normal(0.0, jitter, int((~lost).sum()))
    return np.sort(np.append(events, rng.uniform(kept[0], kept[-1], n_more)))


def evaluate_sync(
    n_pairs: int = 1000, seed: int = 0, progress: Progress = silent
) -> dict[str, Any]:
    """Error of aligned clocks, and how many were refused; `liex evaluate sync`.

    Args:
        n_pairs: simulated pairs of clocks, a seventh of each kind.
        seed: of the simulation.
        progress: called pair by pair.

    Returns:
        `median_ms` and `p99_ms` of the error of all aligned pairs, `wrong_alignment` (their
        number), `refused` (share of all); `trains`, the same by kind; and protocol, n_pairs, seed.
    """
    found: dict[str, list[Array | None]] = {kind: [] for kind in KINDS}
    for k in range(n_pairs):
        progress(k, n_pairs, "clocks")
        kind = KINDS[k % len(KINDS)]
        found[kind].append(_error_s(kind, np.random.default_rng([seed, k])))
    every = [one for kind in KINDS for one in found[kind]]
    return {
        "protocol": PROTOCOL,
        "n_pairs": n_pairs,
        "seed": seed,
        **_scores(every),
        "trains": {kind: _scores(found[kind]) for kind in KINDS},
    }


def _error_s(kind: str, rng: np.random.Generator) -> Array | None:
    """Errors of the map, s; None if the pair was refused."""
    duration = float(rng.uniform(300.0, 3600.0))
    offset, rate = rng.uniform(-1e4, 1e4), rng.uniform(-2e-4, 2e-4)
    period, phase = rng.uniform(1200.0, 3600.0), rng.uniform(0.0, 2.0 * np.pi)
    swing = rng.uniform(0.0, 2e-5) * period / (2.0 * np.pi)
    at = jump = 0.0
    if kind == "jump":
        at, jump = rng.uniform(0.2, 0.8) * duration, np.exp(rng.uniform(np.log(0.2), np.log(100.0)))

    def other_clock(times: Array) -> Array:
        slow = swing * np.sin(2.0 * np.pi * times / period + phase)
        return np.asarray(offset + (1.0 + rate) * times + slow + jump * (times > at))

    events = base_train(kind, duration, rng)
    first = kind == "regular_first_stated"
    theirs = base_train(kind, duration, rng) if kind == "unrelated" else events
    own, other = recorded(events, rng, first), recorded(other_clock(theirs), rng, first)
    try:
        stated = [(own[0], other[0])] if first else []
        clock = align(own, other, stated).clock
    except SyncError:
        return None
    if kind == "unrelated":
        return np.full(1, np.inf)
    times = np.linspace(clock.own_s[0], clock.own_s[-1], 200)
    error = np.abs(clock(times) - other_clock(times))
    return error[np.isfinite(error)]  # unknown where a clock jumps


def _scores(errors: list[Array | None]) -> dict[str, Any]:
    aligned = [one for one in errors if one is not None]
    found: dict[str, Any] = {
        "wrong_alignment": sum(float(np.quantile(one, 0.9)) > _WRONG_S for one in aligned),
        "refused": round(1.0 - len(aligned) / len(errors), 4),
    }
    if aligned:
        median, p99 = np.percentile(1e3 * np.concatenate(aligned), (50.0, 99.0))
        found |= {"median_ms": round(float(median), 4), "p99_ms": round(float(p99), 4)}
    return found
