"""Which poses of a track the picture contradicts, whatever error the model predicts for them.

An error of more than a quarter of the length is none to trust, whatever limit the plan states. Of a
measured pose four numbers come from the picture itself (`residual.Agreement`): the distance between
rendered body and readings, the same in the part of the body where it is largest, the share of the
silhouette that the body covers, and the share of the body beside it. Of a pose that was smoothed or
bridged, the distance from what the frame itself says is asked: while an animal is in full view, a
pose that lies elsewhere is none.

The limits were set on virtual recordings of the mouse, the fish and the hand with known truth; how,
and what lies on either side of them, stands in `docs/trust.md`.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.tracking.observations import Observations, joints_of
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]

# of the animal's length
MOST_ERROR = 0.25
MOST_RESIDUAL = 0.12
_ALWAYS_RESIDUAL = 0.04  # below this a residual contradicts nothing, however quiet the session is
_TIMES_RESIDUAL = 4.0  # of the session's own usual residual
_LEAST_COVERED = 0.35
_MOST_BESIDE = 0.6
# an animal is in full view where it shows this share of the usual pixels, at least and at most
_LEAST_SHOWN = 0.6
_MOST_SHOWN = 1.6
# one thing is two animals where it shows so much of the other's pixels beside the usual ones, and
# no less than so many times these: where both touch, a part of each is behind the other
_OF_OTHER = 0.4
_LEAST_TOGETHER = 1.25
# an animal is partly behind something where so much of its outline ends there, and it shows less
# than this share of its usual pixels; what lies before it is there for some frames at least
_BEHIND = 0.03
_FEWEST_WHOLE = 12  # frames without anything before it that tell what an animal usually shows
WHOLE = 0.95
_FRAMES = 2  # before and after
MOSTLY = 0.7  # of it must be in view to tell how it lies
_UNSURE = 0.25  # and all of it where head and tail are exchanged as probably as that
# it has gone behind something where it showed less than this share shortly before it was gone
_GOING = 0.8
_SHORTLY_S = 0.5
_REMEMBERED = 900  # measured frames that say, while the recording goes on, what it usually shows
# a pose lies elsewhere if its joints are so far from every pose that the frame itself allows: so
# many predicted errors, and this share of the length
_TIMES_ERROR = 4.0
_ELSEWHERE = 0.25


def contradicted(
    seen: Observations, path: NDArray[np.int64], length_mm: float
) -> NDArray[np.bool_]:
    """Whether (n,) the picture contradicts the pose that a frame's own hypothesis gives.

    Args:
        seen: hypotheses (n, H) of the frames.
        path: (n,) which of them is meant, negative for none.
        length_mm: of the animal.

    Returns:
        False where there is no hypothesis, or nothing is known of how it agrees with the picture.
    """
    residual = seen.along(seen.residual_mm, path)
    known = residual[np.isfinite(residual)]
    usual = float(np.median(known)) if len(known) else 0.0
    limit = min(
        max(_TIMES_RESIDUAL * usual, _ALWAYS_RESIDUAL * length_mm), MOST_RESIDUAL * length_mm
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (residual > limit)
            | (seen.along(seen.part_mm, path) > MOST_RESIDUAL * length_mm)
            | (seen.along(seen.covered, path) < _LEAST_COVERED)
            | (seen.along(seen.beside, path) > _MOST_BESIDE)
        )


def usual_pixels(seen: Observations, path: NDArray[np.int64]) -> float:
    """The pixels that the animal usually shows where nothing stands before it.

    The median along a path over the frames in which its outline ends at nothing nearer, or over all
    of them where fewer than 12 are such.

    Args:
        seen: hypotheses (n, H) of the frames.
        path: (n,) which of them is meant, negative for none.

    Returns:
        The pixels; 0 where the path is empty.
    """
    return median_of_whole(seen.along(seen.n_px, path), seen.along(seen.behind, path))


def median_of_whole(shown: Array, behind: Array) -> float:
    """The pixels that an animal usually shows where nothing stands before it.

    Args:
        shown: (n,) its pixels, NaN where they are not known.
        behind: (n,) share of its outline that ends at something nearer.

    Returns:
        The median; 0 where none is known.
    """
    known = np.isfinite(shown)
    whole = known & (np.nan_to_num(behind) <= _BEHIND)
    taken = whole if whole.sum() >= _FEWEST_WHOLE else known
    return float(np.median(shown[taken])) if taken.any() else 0.0


def together(seen: Observations, path: NDArray[np.int64], usual_px: float) -> NDArray[np.bool_]:
    """Whether (n,) an animal touches another, so that both are one thing in the picture.

    How large both are is told by the frames in which each is a thing of its own.

    Args:
        seen: hypotheses (n, H) of the frames.
        path: (n,) which of them is meant, negative for none.
        usual_px: pixels that the animal usually shows.
    """
    shown = seen.along(seen.n_px, path)
    others = np.where(seen.known & (seen.n_px != shown[:, None]), seen.n_px, 0).max(axis=1)
    apart = (path >= 0) & (others > 0)
    other_px = float(np.median(others[apart])) if apart.any() else np.inf
    most_px = np.clip(
        usual_px + _OF_OTHER * other_px, _LEAST_TOGETHER * usual_px, _MOST_SHOWN * usual_px
    )
    return np.asarray((path >= 0) & (shown > most_px))


def share_in_view(seen: Observations, path: NDArray[np.int64], usual_px: float) -> Array:
    """The share (n,) of an animal that is in view where something stands before the rest of it.

    Args:
        seen: hypotheses (n, H) of consecutive frames.
        path: (n,) which of them is meant, negative for none, which takes the first.
        usual_px: pixels that the animal usually shows.

    Returns:
        1 where nothing is before it, or there is no hypothesis.
    """
    meant = np.where((path < 0) & seen.known[:, 0], 0, path)
    share = in_view(seen.along(seen.behind, meant), seen.along(seen.n_px, meant), usual_px)
    return np.where(meant >= 0, share, 1.0)


def lies_unknown(in_view: Array, doubt: Array) -> NDArray[np.bool_]:
    """Whether (n,) so much of an animal is hidden that nobody knows how it lies.

    Args:
        in_view: (n,) share of it that is in view.
        doubt: (n,) probability that its head and tail are exchanged.

    Returns:
        True where less than 0.7 is in view, or not all of it and its ends are unknown as well.
    """
    return np.asarray((in_view < MOSTLY) | ((in_view < WHOLE) & (doubt > _UNSURE)))


def in_view(behind: Array, shown_px: Array, usual_px: float, beside: int = _FRAMES) -> Array:
    """The share (n,) of an animal that is in view where something stands before the rest of it.

    Args:
        behind: (n,) share of its outline that ends at something nearer.
        shown_px: (n,) its pixels.
        usual_px: those that it usually shows.
        beside: what stands before it in so many frames before and after does so in this one.
    """
    near = np.pad(np.nan_to_num(behind), beside)
    most = np.max([near[k : k + len(behind)] for k in range(2 * beside + 1)], axis=0)
    return np.where(most > _BEHIND, np.minimum(shown_px / max(usual_px, 1.0), 1.0), 1.0)


def told_ends(seen: Observations) -> Array:
    """How much (n, H), 0 to 1, each hypothesis tells of which end of the animal is its head.

    Of an animal that something stands before, the metric takes one end for the other in frame after
    frame, for it never saw such an animal: it tells nothing where no more than 0.7 is in view.

    Args:
        seen: hypotheses (n, H) of consecutive frames.

    Returns:
        1 where all of it is in view, or there is no hypothesis.
    """
    first = np.where(seen.known[:, 0], 0, -1)
    usual_px = usual_pixels(seen, first)
    told = np.ones(seen.score.shape)
    for h in range(seen.score.shape[1]):
        behind, shown = (values[:, h].astype(float) for values in (seen.behind, seen.n_px))
        share = in_view(behind, shown, usual_px)
        told[:, h] = np.clip((share - MOSTLY) / (WHOLE - MOSTLY), 0.0, 1.0) ** 2
    return told


def gone_behind(
    seen: Observations, measured: NDArray[np.bool_], usual_px: float
) -> NDArray[np.bool_]:
    """Whether (n,) the animal is hidden: it went behind or under something and is not back yet.

    A stretch without a measured pose, in which nothing of the animal's size is in view for a while,
    and just before which less and less of the animal was seen beside something nearer. Where a
    recording begins with such a stretch, what is seen just after it says so.

    Args:
        seen: hypotheses (n, H) of all frames.
        measured: (n,) whether a pose was measured.
        usual_px: pixels that the animal usually shows.
    """
    hidden = np.zeros(len(seen), np.bool_)
    known = np.asarray(seen.known.any(axis=1))
    shown = np.where(known, seen.n_px.max(axis=1), 0) / max(usual_px, 1.0)
    behind = np.where(known, np.nan_to_num(seen.behind).max(axis=1), 0.0)
    seconds = seen.seconds
    edges = np.flatnonzero(np.diff(np.concatenate([[1], measured, [1]]).astype(np.int8)))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        gone = start + np.flatnonzero(~known[start:stop] & seen.has_depth[start:stop])
        if not len(gone):
            continue
        before = np.flatnonzero(known[: gone[0]])
        if len(before):
            near = before[seconds[before] >= seconds[gone[0]] - _SHORTLY_S]
        else:
            after = gone[0] + np.flatnonzero(known[gone[0] :])
            near = after[seconds[after] <= seconds[after[:1]] + _SHORTLY_S]
        if _was_going(shown[near], behind[near]):
            hidden[start:stop] = True
    return hidden


def _was_going(shown: Array, behind: Array) -> bool:
    """Whether frames (k,) show an animal that goes behind something: less of it, and an outline
    that ends at what is nearer.
    """
    return len(shown) > 0 and bool(shown.min() < _GOING and behind.max() > _BEHIND)


class Watch:
    """The same while the recording goes on, told frame by frame from the past alone.

    What comes after cannot be asked: a recording that begins with a hidden animal is of one that
    was not found.
    """

    def __init__(self) -> None:
        # of measured frames: pixels, share of the outline behind something
        self._shown: deque[tuple[float, float]] = deque(maxlen=_REMEMBERED)
        # of the frames shortly before this one in which something was in view: s, px, share behind
        self._near: deque[tuple[float, int, float]] = deque()
        self._lost = False
        self._gone = False

    @property
    def usual_px(self) -> float | None:
        """Pixels that the animal usually shows; None before the first measurement."""
        return median_of_whole(*np.array(self._shown).T) if self._shown else None

    def gone(
        self, seen: Observations, path: NDArray[np.int64], measured: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Whether (n,) the animal is hidden in the next frames, see `gone_behind`.

        Args:
            seen: hypotheses (n, H) of consecutive frames, the first the one after the last.
            path: (n,) which of them is meant, negative for none.
            measured: (n,) whether a pose was measured.
        """
        known = np.asarray(seen.known.any(axis=1))
        behind = np.nan_to_num(seen.behind)
        hidden = np.zeros(len(seen), np.bool_)
        for k, time_ns in enumerate(seen.times_ns):
            now_s = 1e-9 * float(time_ns)
            if measured[k]:
                self._shown.append((float(seen.n_px[k, path[k]]), float(behind[k, path[k]])))
                self._lost = self._gone = False
            if known[k]:
                self._near.append((now_s, int(seen.n_px[k].max()), float(behind[k].max())))
            while self._near and self._near[0][0] < now_s - _SHORTLY_S:
                self._near.popleft()
            if not known[k] and seen.has_depth[k] and not self._lost:
                _, shown, near = np.array([*self._near]).reshape(-1, 3).T
                self._lost = True
                self._gone = _was_going(shown / max(self.usual_px or 0.0, 1.0), near)
            hidden[k] = self._gone
        return hidden


def elsewhere(
    skeleton: Skeleton,
    seen: Observations,
    joints_mm: Array,
    error_mm: Array,
    length_mm: float,
    usual_px: float,
) -> NDArray[np.bool_]:
    """Whether (n,) a pose lies elsewhere than everything that its frame says of an animal in view.

    Either way round counts, for which end is the head is told by more than one frame.

    Args:
        skeleton: kinematic tree of the animal.
        seen: hypotheses (n, H) of the frames.
        joints_mm: (n, J, 3) the poses, arena frame, mm; NaN where there is none.
        error_mm: (n,) their predicted errors, mm.
        length_mm: of the animal.
        usual_px: pixels that the animal usually shows.

    Returns:
        False where nothing of the animal's size is in full view, or there is no pose.
    """
    nearest = np.full(len(seen), np.inf)
    allowed = np.zeros(len(seen))
    for h in range(seen.score.shape[1]):
        shown = seen.n_px[:, h] / max(usual_px, 1.0)
        rows = np.flatnonzero(
            seen.known[:, h]
            & np.isfinite(error_mm)
            & (shown >= _LEAST_SHOWN)
            & (shown <= _MOST_SHOWN)
        )
        if not len(rows):
            continue
        own = joints_of(skeleton, seen.pose(np.full(len(seen), h))[rows])
        off = np.linalg.norm(own - joints_mm[rows], axis=-1).mean(axis=1)
        nearer = off < nearest[rows]
        nearest[rows[nearer]] = off[nearer]
        both = np.hypot(seen.error_mm[rows, h], error_mm[rows])
        allowed[rows[nearer]] = np.maximum(_TIMES_ERROR * both, _ELSEWHERE * length_mm)[nearer]
    return np.asarray(np.isfinite(nearest) & (nearest > allowed))


# Whether an animal goes as fast as animals do, by the clock of its recording.


_OVER_S = 0.1  # noise of single frames is small beside what is gone in so long
_MOST_S = 0.2  # frames may be missing, but not so many
_N_LOOKED_AT = 20_000  # frames, spread over the recording
_FEWEST = 30
_MOST_LENGTHS_S = 10.0  # for a quarter of the time; 1 to 4 are usual, in short bursts 30


def why_too_fast(track: Track, length_mm: float) -> str:
    """That the animal goes faster than animals keep up; "" where it does not, or nobody can tell.

    Args:
        track: one row for every frame.
        length_mm: of the animal, mm.
    """
    times_s = (track.times_ns - track.times_ns[0]) / 1e9
    n = len(times_s)
    first = np.unique(np.linspace(0, n - 1, min(n, _N_LOOKED_AT)).round().astype(int))
    then = np.searchsorted(times_s, times_s[first] + _OVER_S)
    first, then = first[then < n], then[then < n]
    passed_s = times_s[then] - times_s[first]
    gone = track.centroid_mm[then, :2] - track.centroid_mm[first, :2]
    known = np.isfinite(gone).all(axis=1) & (passed_s <= _MOST_S)
    if known.sum() < _FEWEST:
        return ""
    speed = float(np.quantile(np.hypot(*gone[known].T) / passed_s[known], 0.75))
    if speed <= _MOST_LENGTHS_S * length_mm:
        return ""
    return (
        f"by its time stamps the animal goes {speed:,.0f} mm/s for a quarter of the time, "
        f"{speed / length_mm:.0f} of its lengths a second, which none keeps up: check the frame "
        "rate"
    )
