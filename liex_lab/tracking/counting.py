"""Number of animals in view, frame by frame: what stands free, moves and is of an animal's size.

No body is fitted, so an animal of any build counts. The components of about the animal's size
(`Observations.objects`) are linked from frame to frame: mutual nearest neighbours within a gate of
distance and area, and connected components of these links (tracklets). A tracklet is an animal's if
it moves by more than half the root of its area and is 0.4 to 2 times as high as usual; so is a
tracklet at rest that begins or ends where an animal's ends or begins. Animals that touch are one
component: the sum of all areas then shows how many there are, compared with the sum while they
stand free.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from liex_lab.arrays import Mask, NDArray
from liex_lab.body.skeleton import VIEWS
from liex_lab.runtime.memory import in_windows
from liex_lab.scene.height_maps import ANIMAL_HEIGHTS, N_OBJECTS
from liex_lab.tracking.observations import Array, Observations, Small
from liex_lab.tracking.track import spans

# in roots of the animal's area, about half the length of its outline
_MOVES = 0.5
_NEAR = 0.4  # distance of a resting tracklet from the end of another one
_GATE = 0.3  # between two frames, and as much a second as
_FASTEST = 12.0
_ALIKE = 0.6  # largest change of the logarithm of the area from frame to frame
_GONE_S = 0.3  # time after which an object that reappears is another one; a tracklet lasts longer
_FILLED = 0.6  # least share of its frames in which it is found
_BESIDE = 2.2  # a length
_RESTS_S = 2.0  # time between the tracklets of an animal at rest
_LEAST_S = 1.0  # time, and share of the frames, in which several animals stand free
_LEAST = 0.02


@dataclass(frozen=True)
class Count:
    """The animals in view in n frames.

    Attributes:
        in_view: (n,) int64, how many in each frame.
        n_animals: how many at once; 0 if none.
        share: share of the frames with an animal in view that show this number, 0 to 1.
    """

    in_view: NDArray[np.int64]
    n_animals: int
    share: float


def count_animals(observed: Observations, n_measured: int = 1) -> Count:
    """Count the animals in view in the frames of a recording.

    Args:
        observed: hypotheses (n, H) of all frames, with their objects.
        n_measured: of how many animals these are the hypotheses of one.
    """
    objects = observed.objects
    seconds = observed.seconds
    some = np.asarray(observed.known.any(axis=1))
    if n_measured > 1:  # where it is hidden, another one may be in view
        some |= np.isfinite(objects[:, 0, 0])
    in_view = some.astype(np.int64)
    n_animals = int(some.any())
    if np.isfinite(objects[:, 1, 0]).any():  # else there is never a second one
        free, area, near = _free(objects, seconds, observed.skeleton.view.frame == VIEWS[0])
        step_s = max(float(np.median(np.diff(seconds))), 1e-9)
        least = max(2.0, _LEAST * len(seconds), _LEAST_S / step_s)
        for n in range(2, N_OBJECTS + 1):
            if (free >= n).sum() < least:
                break
            n_animals = n
            # two that touch hide parts of each other; one fewer shows less than this
            there = (free >= n) | (area >= (1.0 - 0.5 / n) * np.median(area[free >= n]))
            there |= _merged(there, free >= n, near)
            in_view[there & some] = n
    counts = np.bincount(in_view, minlength=n_animals + 1)
    return Count(in_view, n_animals, float(counts[n_animals] / max(1, counts[1:].sum())))


def _merged(there: Mask, free: Mask, near: Mask) -> Mask:
    """Frames (n,) between those that are `there`, without any that left: before and after, two of
    those that stood `free` were `near` each other.
    """
    merged = np.zeros(len(there), np.bool_)
    rows = np.flatnonzero(free)
    for start, stop in spans(~there):
        at = np.searchsorted(rows, start)
        merged[start:stop] = near[rows[max(at - 1, 0) : at + 1]].all()
    return merged


def _free(objects: Small, seconds: Array, stands: bool) -> tuple[NDArray[np.int64], Array, Mask]:
    """Animals that stand free (n,), the area (n,) mm^2 of all objects of each frame, and whether
    two of them are within a length of each other.
    """
    known = np.isfinite(objects[..., 0])
    area = in_windows(
        len(known),
        0,
        lambda at: np.where(known[at], objects[at, :, 3], 0.0).sum(axis=1, dtype=float),
    )
    rows, _ = np.nonzero(known)
    nodes = objects[known].astype(float)
    # of the components most similar in area to the session's animal
    height, area_mm2 = np.median(objects[known[:, 0], 0, 2:].astype(float), axis=0)
    usual = float(np.sqrt(area_mm2))
    label = _tracklets(nodes, rows, seconds, usual)
    order = np.lexsort((rows, label))
    begins = np.flatnonzero(np.diff(label[order], prepend=-1))
    parts = np.split(order, begins[1:])
    own = np.array([_moves(nodes[part], rows[part], seconds, usual) for part in parts])
    if stands:
        heights = np.array([np.median(nodes[part, 2]) for part in parts]) / height
        right = (heights > ANIMAL_HEIGHTS[0]) & (heights < ANIMAL_HEIGHTS[1])
    else:
        right = np.ones(len(parts), np.bool_)
    own &= right
    _adopt_resting(own, right, nodes, parts, seconds[rows], usual)
    free = np.zeros(len(objects), np.int64)
    for part, is_own in zip(parts, own, strict=True):
        free[rows[part[0]] : rows[part[-1]] + 1] += is_own

    def near(at: slice) -> Mask:
        """Whether two objects of some frames are near each other."""
        xy = objects[at, :, :2].astype(float)
        off = np.linalg.norm(xy[:, :, None] - xy[:, None], axis=-1)
        off[:, range(N_OBJECTS), range(N_OBJECTS)] = np.inf
        return np.asarray((off < _BESIDE * usual).any(axis=(1, 2)))

    return free, area, in_windows(len(objects), 0, near)


def _moves(nodes: Array, rows: NDArray[np.int64], seconds: Array, usual: float) -> bool:
    """Whether the objects (k, 4) of one tracklet are at different positions; what flickers at the
    edge of a wall or a lid is in few of its frames.
    """
    first, last = rows[0], rows[-1]
    if len(rows) < _FILLED * (last - first + 1) or seconds[last] - seconds[first] < _GONE_S:
        return False
    low, high = np.quantile(nodes[:, :2], (0.05, 0.95), axis=0)
    return bool(np.hypot(*(high - low)) > _MOVES * usual)


def _tracklets(
    nodes: Array, rows: NDArray[np.int64], seconds: Array, usual: float
) -> NDArray[np.int64]:
    """The tracklet (k,) of each object (k, 4) of the frames `rows` (k,), in order of time."""
    k = len(nodes)
    ahead = np.ones(k, np.bool_)  # not linked with a later one yet
    behind = np.ones(k, np.bool_)
    links: list[NDArray[np.int64]] = []
    starts = np.searchsorted(rows, np.arange(len(seconds) + 1))
    n_lags = int(_GONE_S / max(float(np.median(np.diff(seconds))), 1e-9))
    for lag in range(1, max(1, n_lags) + 1):
        a, b = _pairs(rows, starts, lag, ahead, behind)
        passed = seconds[rows[b]] - seconds[rows[a]]
        off = np.linalg.norm(nodes[a, :2] - nodes[b, :2], axis=1) / usual
        fits = (off < _GATE + _FASTEST * np.minimum(passed, 0.1)) & (passed < _GONE_S)
        fits &= np.abs(np.log(nodes[a, 3] / nodes[b, 3])) < _ALIKE
        a, b, off = a[fits], b[fits], off[fits]
        nearest_a, nearest_b = np.full(k, np.inf), np.full(k, np.inf)
        np.minimum.at(nearest_a, a, off)
        np.minimum.at(nearest_b, b, off)
        mutual = (off == nearest_a[a]) & (off == nearest_b[b])
        links.append(np.stack([a[mutual], b[mutual]]))
        ahead[a[mutual]] = False
        behind[b[mutual]] = False
    a, b = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(k, k))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _pairs(
    rows: NDArray[np.int64],
    starts: NDArray[np.int64],
    lag: int,
    ahead: Mask,
    behind: Mask,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All pairs of an object and one `lag` frames later that are not linked on these sides yet."""
    firsts, seconds = [], []
    later = rows + lag
    for step in range(N_OBJECTS):
        other = np.append(starts, starts[-1])[np.minimum(later, len(starts) - 1)] + step
        inside = (later < len(starts) - 1) & (
            other < starts[np.minimum(later + 1, len(starts) - 1)]
        )
        one = np.flatnonzero(inside)
        two = other[one]
        some = ahead[one] & behind[two]
        firsts.append(one[some])
        seconds.append(two[some])
    return np.concatenate(firsts), np.concatenate(seconds)


def _adopt_resting(
    own: Mask,
    right: Mask,
    nodes: Array,
    parts: list[NDArray[np.int64]],
    times_s: Array,
    usual: float,
) -> None:
    """Add to the animals' tracklets `own` (m,) those at rest that continue or precede one of them.

    parts are the objects (k, 4) of each tracklet, at times_s (k,).
    """
    first, last = (np.array([part[end] for part in parts]) for end in (0, -1))
    order = np.argsort(times_s[first])
    since = times_s[first][order]
    links = []
    for k in np.flatnonzero(right):
        begin, end = np.searchsorted(since, times_s[last[k]] + np.array([1e-9, _RESTS_S]))
        later = order[begin:end]
        off = np.linalg.norm(nodes[first[later], :2] - nodes[last[k], :2], axis=1)
        links += [(k, one) for one in later[right[later] & (off < _NEAR * usual)]]
    a, b = np.array(links, np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(len(a)), (a, b)), shape=(len(own), len(own)))
    group = connected_components(graph, directed=False)[1]
    own |= np.isin(group, group[own])
