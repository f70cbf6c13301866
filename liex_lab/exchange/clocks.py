"""Alignment of two clocks by events that both recorded, such as the pulses of a TTL line.

The other clock is y = f(x), x the time on our clock: f is continuous and linear between knots, so
that a drift may vary. Both trains may lack pulses and have further ones, and jitter.

1. Offsets by votes (a Hough transform): of a window of pulses, every difference to a pulse of the
   other train votes for an offset, at a grid of rates; the most frequent offsets are candidates.
2. Each candidate is followed from its window to both ends: nearest pulses are matched one to one,
   and the next part is predicted from the line through the last one.
3. f is fitted to the matched pulses by trimmed least squares; the number of knots minimises BIC.
4. The best candidate is tested against every other offset at which its own f also fits in part
   (the autocorrelation of the trains). It is refused unless it matches more pulses than each of
   them with p < 0.001 (sign test, or Fisher's exact test). A regular train fits as well if
   shifted by one pulse, so it is refused unless a stated pair of times decides.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binomtest, fisher_exact

from liex_lab.arrays import Array, Mask, NDArray
from liex_lab.errors import LiexError, refuse
from liex_lab.sessions.clock import ClockMap

Rows = NDArray[np.int64]
MOST_DRIFT = 0.005  # of a clock's rate; a quartz is within 0.0001
_WINDOW = 40  # pulses whose differences vote
_FEWEST = 8  # matched pulses
_STEP_S = 300.0  # longest part that is predicted by a line
_SURE = 1e-3
_CLOSE_S = 5e-4  # residuals below are never outliers
_CANDIDATES = 3  # of each window
_FINE = 0.125  # of the reach: for trains that are nearly regular
_MOST_RATES = 15  # on either side, for the fine votes
_ROUNDS = 6
_FITTED = 20_000  # events at most
_SD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_UNITS = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}


class SyncError(LiexError):
    """Two clocks cannot be aligned by the given events."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """Two trains of events, matched.

    Attributes:
        clock: the map from our clock to the other one.
        pairs: (m, 2) numbers of the matched events, of ours and of the other train.
        residual_s: (m,) time of the other event minus the mapped time of ours.
        inside: (2,) for each train, whether its events are in the span of the other one.
    """

    clock: ClockMap
    pairs: Rows
    residual_s: Array
    inside: tuple[Mask, Mask]

    @property
    def n_overlapping(self) -> tuple[int, int]:
        """Events of each train in the span of the other one."""
        ours, others = self.inside
        return int(ours.sum()), int(others.sum())

    @property
    def rms_s(self) -> float:
        """Root mean square of the residuals, s."""
        return float(np.sqrt(np.mean(self.residual_s**2)))

    @property
    def sd_s(self) -> float:
        """Robust standard deviation of the residuals, s."""
        return _SD * float(np.median(np.abs(self.residual_s))) if len(self.residual_s) else np.inf

    def score(self, reach: float) -> float:
        """Log likelihood relative to events at random within `reach`, for the choice of one."""
        m = len(self.pairs)
        spread = float(np.clip(self.sd_s, 2e-5, reach))
        return m * float(np.log(reach / spread)) - 0.5 * (sum(self.n_overlapping) - 2 * m)

    @property
    def share(self) -> float:
        """Share of the overlapping events of both trains that are matched."""
        return 2 * len(self.pairs) / max(sum(self.n_overlapping), 1)


def check_times(times_s: Any, what: str) -> Array:
    """Times of events, validated.

    Args:
        times_s: (n,) s.
        what: their source, for the error.

    Returns:
        (n,) ascending and distinct.

    Raises:
        SyncError: there are none, or one is not a number, or they go back.
    """
    times = np.asarray(times_s, float).ravel()
    missing, back = ~np.isfinite(times), np.diff(times) < 0.0
    refuse(
        SyncError,
        (not len(times), f"{what} holds no event; check the channel and the level of its pulses"),
        (
            missing.any(),
            f"event {np.argmax([*missing, 1]) + 1} of {what} has no time (NaN or infinite); remove "
            "the row",
        ),
        (
            back.any(),
            f"the times of {what} go back after event {np.argmax([*back, 1]) + 1}: the clock was "
            "set, or the rows are not in order; align the parts separately",
        ),
    )
    return np.unique(times)


def align(own_s: Any, other_s: Any, stated_s: Any = ()) -> Alignment:
    """Match two trains of events, and map the clock of the first to that of the second.

    Args:
        own_s: (n,) times of events on our clock, s, ascending.
        other_s: (m,) times on the other clock, s, ascending.
        stated_s: (p, 2) moments that are known on both clocks, s; each is nearer to the truth than
            half the usual interval of events. Without any, the pattern of intervals decides.

    Raises:
        SyncError: the trains fit nowhere or in several ways, or a clock jumps and a part does.
    """
    x, y = check_times(own_s, "the session's events"), check_times(other_s, "the other file")
    stated = np.reshape(np.asarray(stated_s, float), (-1, 2))
    refuse(
        SyncError,
        (
            min(len(x), len(y)) < _FEWEST,
            f"clocks are aligned by {_FEWEST} events or more on both sides, got {len(x)} and "
            f"{len(y)}; state pairs of times instead (--pairs)",
        ),
    )
    _check_unit(float(np.median(np.diff(y)) / np.median(np.diff(x))))
    # how near an event is to its prediction: well below the interval of neighbours
    reach = float(np.clip(0.2 * min(_short(x), _short(y)), 0.001, 0.05))
    best, others = _ranked(x, y, reach, stated)
    tight = float(np.clip(4.0 * best.sd_s, _CLOSE_S, reach))
    best = _matched(x, y, _fit(*_events(x, y, _matched(x, y, best.clock, tight))), tight)
    for other in (_matched(x, y, one.clock, tight) for one in others):
        compared = min(other.n_overlapping) >= 0.5 * min(best.n_overlapping)
        if compared and _p_alike(best, other) > _SURE and not _apart(best, other):
            shift = float(np.median(other.clock(x) - best.clock(x)))
            raise SyncError(
                f"the events fit in more than one way: {best.share:.1%} of them agree, and "
                f"{other.share:.1%} if shifted by {shift:.3f} s; state that the first events are "
                "the same (--first) or pairs of times (--pairs), or record random intervals"
            )
    if len(best.pairs) >= _FEWEST and (stretch := _unlike(best, len(y))):
        return _across(x, y, best, stated, *stretch)
    if len(best.pairs) < _FEWEST or best.share < 0.5:
        raise SyncError(
            f"the events fit nowhere: at best {len(best.pairs)} of {len(x)} and {len(y)} agree; "
            "check the channel, and that both files are of the same session"
        )
    return best


def align_pairs(pairs_s: Any) -> Alignment:
    """Map a clock to another one by stated pairs of times alone.

    Args:
        pairs_s: (n, 2) moments on our clock and on the other one, s; at least two.

    Raises:
        SyncError: there are too few, or the rates of the clocks differ too much.
    """
    pairs = np.reshape(np.asarray(pairs_s, float), (-1, 2))
    x, y = (check_times(column, "the pairs") for column in pairs.T)
    if len(x) < 2 or len(x) != len(y):
        raise SyncError(
            f"pairs are two distinct moments or more, each on both clocks; got {len(pairs)}"
        )
    _check_unit(float((y[-1] - y[0]) / (x[-1] - x[0])))
    rows = np.arange(len(x))
    clock = _fit(x, y, 1)
    drift = float(clock.rates[0]) - 1.0
    if abs(drift) > MOST_DRIFT:
        raise SyncError(
            f"by these pairs the clocks' rates differ by {drift:.1%}, and {MOST_DRIFT:.1%} is the "
            "most that is accepted; check the pairs and their unit, seconds"
        )
    every = np.ones(len(x), np.bool_)
    return Alignment(clock, np.stack([rows, rows], axis=-1), y - clock(x), (every, every))


def _check_unit(ratio: float) -> None:
    """Refuse another unit, by the ratio of usual intervals."""
    if ratio > 100.0:
        unit = next((u for u, of in _UNITS.items() if 0.5 < ratio / of < 2.0), "samples")
        factor = _UNITS.get(unit, ratio)
        raise SyncError(
            f"the other file's times advance about {ratio:.3g} times as fast as the session's; "
            f"times are in seconds, and these may be {unit}: divide them by {factor:.6g} or "
            "by the sampling rate"
        )
    if ratio < 0.01:
        raise SyncError(
            f"the other file's times advance {ratio:.3g} times as fast as the session's; times of "
            "both are in seconds, so convert those of the session's events or of the other file"
        )


def _short(times: Array) -> float:
    """A short interval of a train: its 10th percentile, s."""
    return float(np.percentile(np.diff(times), 10))


@dataclass(frozen=True)
class _Seed:
    """A line through `rows` of our events: other + rate (x - own)."""

    rows: slice
    own: float
    other: float
    rate: float


def _ranked(x: Array, y: Array, reach: float, stated: Array) -> tuple[Alignment, list[Alignment]]:
    """The best alignment, and the others to test it against.

    Raises:
        SyncError: no alignment exists.
    """
    near = 0.5 * float(np.median(np.diff(y)))
    found: list[Alignment] = []

    def follow(seeds: Iterator[_Seed]) -> None:
        for seed in seeds:
            if all(abs(one.clock(seed.own) - seed.other) > 2.0 * reach for one in found):
                one = _follow(x, y, seed, reach)
                if (
                    one
                    and (np.abs(one.clock(stated[:, 0]) - stated[:, 1]) <= near).all()
                    and (np.abs(one.clock.rates - 1.0) <= 2.0 * MOST_DRIFT).all()
                ):
                    found.append(one)

    follow(_seeds(x, y, reach, stated, near))
    best: Alignment | None = None
    for _ in range(_ROUNDS if found else 0):
        before, best = best, max(found, key=lambda one: one.score(reach))
        if best is before or len(stated):  # stated pairs exclude every shift
            break
        follow(_shifted(x, y, best.clock, reach))
    if best is None:
        raise SyncError(
            "the events fit nowhere; check the channel, and that both files are of the same session"
        )
    of_best = best.clock(x)
    apart = [float(np.median(np.abs(one.clock(x) - of_best))) for one in found]
    return best, [one for one, far in zip(found, apart, strict=True) if far > 2.0 * reach]


def _seeds(x: Array, y: Array, reach: float, stated: Array, near: float) -> Iterator[_Seed]:
    """Lines for which most differences vote, in three windows or around the stated pairs."""
    rows = [_window(x, at) for at in np.quantile(x, (0.15, 0.5, 0.85))]
    about = [(float(x[one].mean()), 0.0, np.inf) for one in rows]
    if len(stated):
        rows = [_window(x, at) for at in stated[:, 0]]
        about = [(own, other, near) for own, other in stated]
    for one, (own, other, within) in zip(rows, about, strict=True):
        window = x[one] - own
        among = y[np.abs(y - other) <= within + 2.0 * np.ptp(window)]
        window = window[:: min(len(among) // 100_000 + 1, 5)]  # bounds the memory
        fine = max(_FINE * reach, MOST_DRIFT * float(np.ptp(window)) / (3.0 * _MOST_RATES))
        for near_s in (reach, min(fine, reach)):
            step = 3.0 * near_s / float(np.ptp(window))
            n = int(MOST_DRIFT / step)
            votes = [
                (count, -abs(rate - 1.0), offset, rate)
                for rate in 1.0 + step * np.arange(-n, n + 1)
                for offset, count in _peaks(
                    among[None] - rate * window[:, None], near_s, other, within
                )
            ]
            kept: list[float] = []
            for count, _, offset, rate in sorted(votes, reverse=True):
                if len(kept) == _CANDIDATES or count < 0.7 * max(votes)[0]:
                    break
                if all(abs(offset - before) > 4.0 * reach for before in kept):
                    kept.append(offset)
                    yield _Seed(one, own, offset, rate)
            if len(kept) == 1:  # it stands out
                break


def _shifted(x: Array, y: Array, clock: ClockMap, reach: float) -> Iterator[_Seed]:
    """Lines parallel to an alignment at which the trains fit in part.

    They are peaks of the autocorrelation, wide and narrow ones, and shifts by one event.
    """
    chosen = x[:: len(x) // int(np.clip(4_000_000 // len(y), _FEWEST, 500)) + 1]
    differences = y[None] - clock(chosen)[:, None]
    apart = differences[np.abs(differences) > 4.0 * reach]
    peaks = [shift for near in (reach, _FINE * reach) for shift, _ in _peaks(apart, near)]
    one = float(np.median(np.diff(y)))
    for shift in (*peaks, one, -one):
        shared = x[(clock(x) + shift >= y[0]) & (clock(x) + shift <= y[-1])]
        if len(shared) >= _FEWEST:
            rows = _window(x, float(np.median(shared)))
            a, b = x[rows][[0, -1]]
            at, end = clock([a, b]) + shift
            yield _Seed(rows, float(a), float(at), float((end - at) / (b - a)))


def _window(x: Array, at: float) -> slice:
    """The rows of up to `_WINDOW` events around a time."""
    first = int(np.clip(np.searchsorted(x, at) - _WINDOW // 2, 0, max(len(x) - _WINDOW, 0)))
    return slice(first, first + _WINDOW)


def _peaks(
    differences: Array, reach: float, about: float = 0.0, within: float = np.inf
) -> Iterator[tuple[float, int]]:
    """The most frequent differences, and how many are within `reach` of each."""
    d = np.sort(differences, axis=None, kind="stable")  # it joins rows that are in order
    d = d[np.abs(d - about) <= within]
    counts = np.searchsorted(d, d + 2.0 * reach, side="right") - np.arange(len(d))
    for _ in range(_CANDIDATES if len(d) else 0):
        k = int(np.argmax(counts))
        if counts[k] < 3:
            return
        middle = float(np.mean(d[k : k + counts[k]]))
        yield middle, int(counts[k])
        counts[np.abs(d - middle) <= 4.0 * reach] = 0


def _mutual(predicted: Array, y: Array, reach: float) -> tuple[Rows, Rows]:
    """Pairs of a prediction and an event that are each other's nearest, within `reach`."""
    to = _nearest(predicted, y)
    good = _nearest(y[to], predicted) == np.arange(len(predicted))
    good &= np.abs(y[to] - predicted) <= reach
    return np.flatnonzero(good), to[good]


def _nearest(of: Array, among: Array) -> Rows:
    """Number of the nearest value in `among`, ascending, for each value."""
    after = np.clip(np.searchsorted(among, of), 1, max(len(among) - 1, 1))
    before = after - 1
    if len(among) == 1:
        return np.zeros(len(of), np.int64)
    return np.where(of - among[before] <= among[after] - of, before, after).astype(np.int64)


def _follow(x: Array, y: Array, seed: _Seed, reach: float) -> Alignment | None:
    """The alignment of a seed, followed to both ends; None if it matches too few events."""
    i, j = _mutual(seed.other + seed.rate * (x[seed.rows] - seed.own), y, 2.0 * reach)
    i = i + seed.rows.start
    if len(i) < 3:
        return None
    i, j = _extended(x, y, i, j, reach)
    # to the left, with time reversed
    a, b = _extended(-x[::-1], -y[::-1], len(x) - 1 - i[::-1], len(y) - 1 - j[::-1], reach)
    i, j = len(x) - 1 - a[::-1], len(y) - 1 - b[::-1]
    return _matched(x, y, _fit(x[i], y[j]), reach)


def _extended(x: Array, y: Array, i: Rows, j: Rows, reach: float) -> tuple[Rows, Rows]:
    """Matched pairs, continued to the end of our train part by part."""
    k = int(i[-1]) + 1
    while k < len(x):
        span = min(x[i[-1]] - x[i[0]], max(_STEP_S, np.ptp(x[_window(x, x[k])])))
        recent = slice(min(int(np.searchsorted(x[i], x[i[-1]] - 2.0 * span)), len(i) - 3), None)
        line = _fit(x[i][recent], y[j][recent], 1)
        stop = max(k + 1, int(np.searchsorted(x, x[k - 1] + span)))
        a, b = _mutual(line(x[k:stop]), y, reach)
        i, j = np.append(i, k + a), np.append(j, b)
        k = stop
    return i, j


def _matched(x: Array, y: Array, clock: ClockMap, reach: float) -> Alignment:
    """The events that a map matches within `reach`."""
    predicted = clock(x)
    i, j = _mutual(predicted, y, reach)
    ours = (predicted >= y[0] - reach) & (predicted <= y[-1] + reach)
    others = (y >= predicted[0] - reach) & (y <= predicted[-1] + reach)
    return Alignment(clock, np.stack([i, j], axis=-1), y[j] - predicted[i], (ours, others))


def _p_alike(best: Alignment, other: Alignment) -> float:
    """Probability of so much more agreement of the best, if the other one were as good.

    The smaller one of two tests: of the events within both, those matched by one alone (sign test),
    and the shares of all (Fisher's exact test).
    """
    matched = []
    for one in (best, other):
        masks = [np.zeros(len(of), np.bool_) for of in one.inside]
        for mask, rows in zip(masks, one.pairs.T, strict=True):
            mask[rows] = True
        matched.append(np.concatenate(masks))
    both = np.concatenate(best.inside) & np.concatenate(other.inside)
    more, less = (int((both & a & ~b).sum()) for a, b in (matched, matched[::-1]))
    table = [
        [2 * len(one.pairs), sum(one.n_overlapping) - 2 * len(one.pairs)] for one in (best, other)
    ]
    sign = binomtest(more, more + less, alternative="greater").pvalue if more else 1.0
    return float(min(sign, fisher_exact(table, "greater").pvalue))


def _events(x: Array, y: Array, of: Alignment) -> tuple[Array, Array]:
    return x[of.pairs[:, 0]], y[of.pairs[:, 1]]


def _fit(x: Array, y: Array, most: int = 256) -> ClockMap:
    """The map through matched events by trimmed least squares, with up to `most` + 1 knots.

    Every piece has twelve events and lasts a minute. Outliers are those of the finest map.
    """
    step = len(x) // _FITTED + 1
    x, y = x[::step], y[::step]
    finest = min(most, max(1, len(x) // 12), max(1, int(np.ptp(x) / 60.0)))
    for _ in range(2 if len(x) > 3 else 0):
        residual = np.abs(y - _solved(x, y, finest)[0](x))
        kept = residual <= max(4.0 * _SD * float(np.median(residual)), _CLOSE_S)
        x, y = x[kept], y[kept]
    levels = [n for n in (1, 4, 16, 64, 256) if n <= finest]
    fits = [_solved(x, y, n) for n in levels]
    bic = [
        len(x) * np.log(v + 1e-12) + n * np.log(len(x))
        for n, (_, v) in zip(levels, fits, strict=True)
    ]
    return fits[int(np.argmin(bic))][0]


def _solved(x: Array, y: Array, n: int) -> tuple[ClockMap, float]:
    """Least-squares map of n pieces with equally many events each, and its mean square residual."""
    knots = np.unique(np.quantile(x, np.linspace(0.0, 1.0, n + 1)))
    hats = np.stack([np.interp(x, knots, one) for one in np.eye(len(knots))], axis=-1)
    middle_x, middle_y = float(np.median(x)), float(np.median(y))
    beyond = (y - middle_y) - (x - middle_x)  # small: keeps the digits of long recordings
    inverse = np.linalg.pinv(hats.T @ hats)
    values = inverse @ (hats.T @ beyond)
    square = float(np.mean((beyond - hats @ values) ** 2))
    free = len(x) - len(knots)
    sd = np.sqrt(np.diag(inverse) * square * len(x) / free) if free else np.full(len(knots), np.nan)
    return ClockMap(knots, knots - middle_x + middle_y + values, sd), square


def _apart(one: Alignment, other: Alignment) -> bool:
    """Whether two alignments match events of different parts of the session, as after a jump."""
    a, b = (np.quantile(each.pairs[:, 0], (0.05, 0.95)) for each in (one, other))
    return bool(a[1] < b[0] or b[1] < a[0])


def _unlike(best: Alignment, n_others: int) -> tuple[int, int] | None:
    """First and last of many successive events of ours that agree with none, while others do.

    A few may agree by chance.
    """
    rows = np.flatnonzero(best.inside[0])
    agree = np.isin(rows, best.pairs[:, 0])
    begin, end, excess = _longest(np.where(agree, -4, 1))
    alike = _longest(np.where(agree, 1, -2))[2]
    if min(excess, alike) < _FEWEST:
        return None
    first, last = int(rows[begin]), int(rows[end - 1])
    before, after = _edges(best, first, last, n_others)
    return (first, last) if after - before >= _FEWEST else None


def _longest(gain: Rows) -> tuple[int, int, int]:
    """The stretch (start, stop) with the largest sum, and the sum (maximum subarray)."""
    total = np.concatenate([[0], np.cumsum(gain)])
    least = np.minimum.accumulate(total)
    end = int(np.argmax(total - least))
    return int(np.flatnonzero(total[: end + 1] == least[end])[-1]), end, int(max(total - least))


def _edges(best: Alignment, first: int, last: int, n_others: int) -> tuple[int, int]:
    """The span (start, stop) of the other events between those matched around a stretch of ours."""
    ours, others = best.pairs.T
    before, after = others[ours < first], others[ours > last]
    return int(before[-1]) + 1 if len(before) else 0, int(after[0]) if len(after) else n_others


def _across(x: Array, y: Array, best: Alignment, stated: Array, first: int, last: int) -> Alignment:
    """The alignment in parts of trains between which a clock jumps at a stretch of our events.

    Raises:
        SyncError: a part cannot be aligned by itself.
    """
    b, d = _edges(best, first, last, len(y))
    # all events at an end belong to the stretch
    a, c = first if b else 0, last + 1 if d < len(y) else len(x)
    parts = [
        (slice(0, a), slice(0, b)),
        (slice(a, c), slice(b, d)),
        (slice(c, None), slice(d, None)),
    ]
    pieces: list[Rows] = []
    inside: list[tuple[Mask, Mask]] = []
    try:
        for ours, others in (part for part in parts if len(x[part[0]])):
            own = x[ours]
            among = (stated[:, 0] >= own[0]) & (stated[:, 0] <= own[-1])
            found = align(own, y[others], stated[among])
            starts = found.clock.own_s[list(found.clock.breaks)]
            number = np.searchsorted(starts, own[found.pairs[:, 0]], side="right")
            rows = found.pairs + np.array([ours.start, others.start])
            pieces += [_supported(rows[number == k]) for k in range(len(starts) + 1)]
            inside.append(found.inside)
        refuse(SyncError, (min(map(len, pieces)) < _FEWEST, "a part has too few events"))
    except SyncError as error:
        raise SyncError(
            f"a clock jumps: from {x[first]:.3f} to {x[last]:.3f} s of the session "
            f"{last - first + 1} events do not fit, although others do, and the parts cannot be "
            f"aligned separately ({error}); split the recording there"
        ) from None
    clocks = [_fit(x[rows[:, 0]], y[rows[:, 1]]) for rows in pieces]
    breaks = np.cumsum([len(one.own_s) for one in clocks])[:-1]
    clock = ClockMap(
        np.concatenate([one.own_s for one in clocks]),
        np.concatenate([one.other_s for one in clocks]),
        np.concatenate([one.sd_s for one in clocks]),
        tuple(breaks.tolist()),
    )
    pairs = np.concatenate(pieces)
    ours_in, others_in = (np.concatenate(masks) for masks in zip(*inside, strict=True))
    residual = y[pairs[:, 1]] - clock(x[pairs[:, 0]])
    return Alignment(clock, pairs, residual, (ours_in, others_in))


def _supported(pairs: Rows) -> Rows:
    """Pairs without those at the ends of a part that may agree by chance.

    The last one kept is the third of four successive events that agree, on either side.
    """
    if len(pairs) < 3:
        return pairs[:0]
    dense = np.flatnonzero((pairs[2:] - pairs[:-2] <= 3).all(axis=1))
    return pairs[dense[0] : dense[-1] + 3] if len(dense) else pairs[:0]
