"""Things that are put in or taken out while a recording runs, as a novel object at minute ten.

A pixel of such a thing stands above the floor for one stretch of time and nearly never besides. Of
the pixel's readings over time, with weights of +1/2 where it stands above the floor, -1/2 where it
does not and 0 where it is unread, that stretch is the one of the largest sum (Kadane's maximum
subarray). Neighbouring pixels of about the same stretch are one thing. An animal that pauses stands
above the floor for a stretch, too: what the animal itself covers in most of it is none, nor is
anything where two animals are in view at other times.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from liex_lab.arena.scene import HIGH_MM, LEAST_MM2, Fixture, fixture_at

if TYPE_CHECKING:
    from liex_lab.foreground.still_scene import StillScene

Array = NDArray[np.float64]
Depths = NDArray[np.float32]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

_LEAST_FRAMES = 6  # of the sample that show it, and of those that do not
_LEAST_SHARE = 0.1  # of the recording: what is there for less is a visit
_STANDS = 0.9  # of the readings in the stretch, and one less this in the others
_SAME_MM = 6.0  # or of the depth: readings this near to the usual one are of the thing,
_SAME_SHARE = 0.012
_STILL = 0.6  # as are so many of its readings: hands and animals move
_ALIKE = 3  # frames of the sample by which the stretches of one thing's pixels begin or end apart
_LEAST_PX = 8
_MOST = 8  # things
_OWN = 0.3  # of a thing's pixels that the animal covers: it is the animal there
_OFTEN = 0.5  # of the frames
_ASKED = 16  # frames of which that is asked


def find_put_in(scene: StillScene, sample: Depths, times_s: Array) -> tuple[Fixture, ...]:
    """The things that stand on the floor for a part of the recording, in order of time.

    Args:
        scene: the scene with its animal's area, at whose stride the frames are.
        sample: (n, H, W) float32 mm, frames spread over the recording, 0 where unread.
        times_s: (n,) of the frames, s since the recording's first.

    Returns:
        Each with the times since when and until when it stands there, None where that is the
        recording's beginning or end.
    """
    n = len(sample)
    if n < 2 * _LEAST_FRAMES:
        return ()
    found = []
    for thing in _things(scene, sample):
        fixture = fixture_at(thing.place, thing.depth, scene.grid_floor, scene.grid)
        if fixture.area_mm2 < LEAST_MM2 or _is_an_animal(scene, sample, thing):
            continue
        since = float(times_s[thing.first]) if thing.first > 0 else None
        until = float(times_s[thing.last]) if thing.last < n else None
        found.append(replace(fixture, since_s=since, until_s=until))
    return tuple(sorted(found, key=lambda one: (one.since_s or 0.0, one.until_s or np.inf)))


@dataclass(frozen=True)
class _Thing:
    """Pixels (H, W) that show one thing from frame `first` to before `last`, at a depth (H, W)."""

    first: int
    last: int
    place: Mask
    depth: Depths


def _things(scene: StillScene, sample: Depths) -> list[_Thing]:
    """What stands still on the floor for one stretch of the frames."""
    rows, columns, first, last = _stretches(scene, sample)
    found: list[_Thing] = []
    left = np.ones(len(rows), np.bool_)
    while left.sum() >= _LEAST_PX and len(found) < _MOST:
        # the stretch that most of the pixels have
        pairs, counts = np.unique(np.stack([first[left], last[left]]), axis=1, return_counts=True)
        start, stop = pairs[:, np.argmax(counts)]
        one = left & (np.abs(first - start) <= _ALIKE) & (np.abs(last - stop) <= _ALIKE)
        left &= ~one
        place = np.zeros(scene.limit.shape, np.uint8)
        place[rows[one], columns[one]] = 1
        count, labels, stats, _ = cv2.connectedComponentsWithStats(place)
        for k in range(1, count):
            if stats[k, cv2.CC_STAT_AREA] >= _LEAST_PX:
                found += _standing(sample, labels == k, int(start), int(stop))
    return found[:_MOST]


def _standing(sample: Depths, place: Mask, first: int, last: int) -> list[_Thing]:
    """The thing at a place (H, W) if it keeps still; its first frames may show who puts it in."""
    readings = sample[first:last, place]
    usual = np.nanmedian(np.where(readings > 0, readings, np.nan), axis=0)
    same = np.abs(readings - usual) < np.maximum(_SAME_MM, _SAME_SHARE * usual)
    shows = np.flatnonzero(same.mean(axis=1) > 0.5)
    if same.mean() < _STILL or len(shows) < max(_LEAST_FRAMES, _LEAST_SHARE * len(sample)):
        return []
    depth = np.zeros(place.shape, np.float32)
    depth[place] = usual
    until = last if last == len(sample) else first + int(shows[-1]) + 1
    return [_Thing(first + int(shows[0]) if first else 0, until, place, depth)]


def _is_an_animal(scene: StillScene, sample: Depths, thing: _Thing) -> bool:
    """Whether a thing is the animal, which covers its place in most of the stretch, or a second one
    that rests there: then two are in view in most of the other frames.
    """
    rows = np.arange(len(sample))
    inside = (rows >= thing.first) & (rows < thing.last)
    own = scene.places(scene.extract(sample[_some(rows[inside])], 1.0))
    if own and float(np.mean([one[thing.place].mean() > _OWN for one in own])) > _OFTEN:
        return True
    others = scene.extract(sample[_some(rows[~inside])], 1.0)
    return float((others.n_blobs > 1).mean()) > _OFTEN


def _some(rows: Rows) -> Rows:
    """At most so many of some frames as are asked, spread over them."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, _ASKED).astype(int))]


def _stretches(scene: StillScene, sample: Depths) -> tuple[Rows, Rows, Rows, Rows]:
    """Row and column (k,) of the pixels that stand above the floor for one stretch of the frames,
    its first frame and the one after its last.
    """
    n = len(sample)
    inner = cv2.erode(scene.on_floor.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    limit = np.where(inner, scene.background - np.float32(HIGH_MM), np.float32(0))
    often = np.zeros(limit.shape, np.int64)
    for depth in sample:
        often += (depth > 0) & (depth < limit)
    rows, columns = np.nonzero((often >= _LEAST_FRAMES) & (often <= n - _LEAST_FRAMES))
    readings = sample[:, rows, columns]
    read = readings > 0
    high = read & (readings < limit[rows, columns])
    weight = np.where(read, high - 0.5, 0.0)
    total = np.concatenate([np.zeros((1, len(rows))), np.cumsum(weight, axis=0)])
    last = np.argmax(total - np.minimum.accumulate(total, axis=0), axis=0)
    first = np.argmin(np.where(np.arange(n + 1)[:, None] <= last, total, np.inf), axis=0)
    inside = (np.arange(n)[:, None] >= first) & (np.arange(n)[:, None] < last)
    n_inside, n_besides = (inside & read).sum(axis=0), (~inside & read).sum(axis=0)
    is_one = (n_inside >= _LEAST_FRAMES) & (n_besides >= _LEAST_FRAMES)
    is_one &= (inside & high).sum(axis=0) >= _STANDS * n_inside
    is_one &= (~inside & high).sum(axis=0) <= (1.0 - _STANDS) * n_besides
    return rows[is_one], columns[is_one], first[is_one], last[is_one]
