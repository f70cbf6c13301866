"""Things that are put in or taken out while a recording runs, as a novel object at minute ten.

A pixel of such a thing stands above the floor for one stretch of time and nearly never besides. Of
the pixel's readings over time, with weights of +1/2 where it stands above the floor, -1/2 where it
does not and 0 where it is unread, that stretch is the one of the largest sum (Kadane's maximum
subarray). Neighbouring pixels of about the same stretch are one thing. An animal that pauses stands
above the floor for a stretch, too: what the animal itself covers in most of it is none, nor is
anything where two animals are in view at other times.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from liex_lab.scene.scene import HIGH_MM, LEAST_MM2, Fixture, fixture_at

if TYPE_CHECKING:
    from liex_lab.scene.background import Wanted
    from liex_lab.scene.height_maps import HeightMaps
    from liex_lab.scene.still_scene import StillScene


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


# Animals that keep still, wholly or in part, and so are taken for the scene's background.


AnyScene = TypeVar("AnyScene", bound="StillScene")

# of the frames: a lump that the animal touches that often is a part of it that keeps still
_TOUCH_SHARE = 0.9
_READ = 0.5  # of a lump: it is there, and not gone with what was under it unread
# what was never seen moving is an animal only if it is no longer than so many largest spines,
# higher than so many times what stands out at all, and larger than so many of the least areas
_LONGEST = 2.0
_HIGHER = 1.4
_LARGER = 1.5
_KINDS = 4  # areas of things that are held against an animal
_IN_PLACE = 0.8  # of the frames must show it where it usually is
_LEAST_LUMP_PX = 16  # of a lump
_MOST_LUMPS = 16  # that are held against an animal
_FREE = 0.75  # of a lump's edge is bare floor; of the foot of a wall half is
_AROUND_PX = 4  # a lump's edge, whose readings flicker between it and the floor


@dataclass(frozen=True)
class Resting(Generic[AnyScene]):
    """An animal that was found at rest.

    Attributes:
        scene: the scene with the floor under it, so that it stands out.
        area_mm2: its usual area, mm^2.
        share: of the frames that show it, 0 to 1.
        is_like: whether it is like an animal, see `is_like_an_animal`.
    """

    scene: AnyScene
    area_mm2: float
    share: float
    is_like: bool = False


def at_rest(
    scene: AnyScene, sample: Depths, wanted: Wanted, area: float, share: float
) -> Resting[AnyScene] | None:
    """The animal that sits in its own background.

    So it is where fewer than half of the frames show something that moves, or what most of them
    show is no animal, as the specks of an edge that flickers.

    Args:
        scene: the scene as it was learned.
        sample: (n, H, W) float32 mm, frames at its stride.
        wanted: what animal is expected.
        area: usual area of what was seen moving, mm^2.
        share: of the frames that show that.

    Returns:
        What was found; None where the scene as it is is the better one.
    """
    moving = replace(scene, area_mm2=area)
    if share >= 0.5 and (not wanted.stands or is_like_an_animal(moving, sample, wanted)):
        return None
    rests = _changing_lump(scene, sample, wanted) if wanted.stands else None
    rests = rests or _on_bare_floor(scene, sample, wanted, 1 if share > 0.0 else _KINDS)
    if rests.share <= (share if share < 0.5 else 0.0):
        return None
    moves = wanted.stands and area > 0.0 and scene.standing is not None and scene.standing.moves
    if (share >= 0.5 or moves) and not rests.is_like:
        return None
    resting = replace(rests.scene, area_mm2=rests.area_mm2)
    if share < 0.5 and moves and _stays_beside(resting, moving, sample):
        return None
    return rests


def with_its_still_part(
    scene: AnyScene, sample: Depths, wanted: Wanted, area: float
) -> tuple[AnyScene, float]:
    """The scene with the floor put under an animal that was partly taken for background.

    Such a part is a lump on the floor that the moving animal touches in (nearly, nine tenths of)
    every frame in which it is read, and together with which it is still no larger than an animal.
    It is read in all frames, or until the animal goes and leaves floor that is never read.

    Args:
        scene: the scene as it was learned.
        sample: (n, H, W) float32 mm, frames at its stride.
        wanted: what animal is expected.
        area: area of the moving animal, mm^2.

    Returns:
        The scene, the same where there is no such lump, and the area mm^2 of the whole animal.
    """
    crops = replace(scene, area_mm2=area).extract(sample, 1.0)
    moving = np.array(scene.places(crops)).reshape(-1, *scene.limit.shape)
    shown = sample if crops.found.all() else sample[crops.found]
    best, best_area = scene, area
    for lump in _lumps(scene, wanted):
        near = _around(lump)
        box = _box(near)
        there = (shown[:, *box][:, lump[box]] > 0).mean(axis=1) > _READ
        touched = moving[there][:, *box][:, near[box]].any(axis=1)
        if not there.any() or touched.mean() < _TOUCH_SHARE:
            continue
        whole = _with_floor_at(scene, near, wanted)
        whole_area, share = whole.usual_area(sample, wanted.spine_mm)
        if share >= 0.5 and whole_area > best_area:
            best, best_area = whole, whole_area
    return best, best_area


def is_like_an_animal(scene: StillScene, sample: Depths, wanted: Wanted) -> bool:
    """Whether what is found is neither longer than the largest animal, nor as low as uneven floor.

    Args:
        scene: the scene with the area of what is looked for.
        sample: (n, H, W) float32 mm, frames at its stride.
        wanted: what animal is expected.
    """
    return _is_like(_shown(scene, sample), scene.area_mm2, wanted)


def _shown(scene: StillScene, sample: Depths) -> HeightMaps:
    """The height maps of the frames of a sample (n, H, W) mm in which something is found."""
    crops = scene.extract(sample, 1.0)
    return crops[crops.found]


def _is_like(shown: HeightMaps, area_mm2: float, wanted: Wanted) -> bool:
    """`is_like_an_animal` of what was found with such an area."""
    if not len(shown.n_px):
        return False
    blobs = shown.blobs
    length = 4.0 * float(np.median(blobs.sd_along))
    height = float(np.median(blobs.volume_mm3 / np.maximum(blobs.area_mm2, 1e-9)))
    return (
        length < _LONGEST * wanted.spine_mm[1]
        and height > _HIGHER * wanted.min_height_mm
        and area_mm2 > _LARGER * wanted.smallest_mm2
    )


def _changing_lump(scene: AnyScene, sample: Depths, wanted: Wanted) -> Resting[AnyScene] | None:
    """The free lump that is like an animal, keeps its place and changes most; None without one.

    A thing that lies still only flickers along its edge; an animal moves a part of itself. The foot
    of a wall flickers as much as an animal moves, but has floor on one side only.
    """
    free = []
    for lump in _lumps(scene, wanted):
        near = _around(lump)
        if _free(scene, near & ~lump, wanted) >= _FREE:
            free.append((_change(scene, sample, near, wanted), lump, near))
    for _, lump, near in sorted(free, key=lambda one: -one[0])[:_MOST_LUMPS]:
        whole = _with_floor_at(scene, near, wanted)
        areas = _areas_at(whole, sample, lump, wanted)
        own = (areas > wanted.smallest_mm2) & (areas < wanted.largest_mm2)
        if own.mean() < 0.5:
            continue
        area = float(np.median(areas[own]))
        shown = _shown(replace(whole, area_mm2=area), sample)
        if _is_like(shown, area, wanted) and _keeps_its_place(shown, area):
            return Resting(whole, area, float(own.mean()), is_like=True)
    return None


def _on_bare_floor(
    scene: AnyScene, sample: Depths, wanted: Wanted, kinds: int
) -> Resting[AnyScene]:
    """What stands on the floor's bare plane in most frames and is like an animal.

    A wall's foot or a step along the floor's edge is in every frame, too, and longer than any
    animal; what is tried after it must also keep its place, as specks of an edge do not. Where
    nothing is like an animal, it is what most frames show; at most `kinds` areas are tried.
    """
    on_floor = scene.on_floor if scene.standing is None else scene.standing.on_floor
    bare = _with_floor_at(scene, on_floor, wanted)
    tried: list[float] = []
    first: Resting[AnyScene] | None = None
    while len(tried) < kinds:
        area, share = bare.usual_area(sample, wanted.spine_mm, tried)
        if share == 0.0:
            break
        shown = _shown(replace(bare, area_mm2=area), sample)
        found = Resting(bare, area, share, _is_like(shown, area, wanted))
        if found.is_like and (not tried or _keeps_its_place(shown, area)):
            return found
        first = first or found
        tried.append(area)
    return first or Resting(bare, bare.area_mm2, 0.0)


def _lumps(scene: StillScene, wanted: Wanted) -> Iterator[Mask]:
    """The lumps (H, W) bool of the background that stand on the floor."""
    above = _bare(scene) - scene.background
    stands = scene.on_floor & (scene.background > 0) & (above > wanted.min_height_mm)
    n, labels, stats, _ = cv2.connectedComponentsWithStats(stands.astype(np.uint8))
    for k in range(1, n):
        if stats[k, cv2.CC_STAT_AREA] >= _LEAST_LUMP_PX:
            yield labels == k


def _free(scene: StillScene, edge: Mask, wanted: Wanted) -> float:
    """The share of a lump's edge (H, W) that is bare floor, 0 to 1."""
    off = np.abs(_bare(scene) - scene.background)[edge]
    return float((scene.on_floor[edge] & (off < wanted.min_height_mm)).mean())


def _bare(scene: StillScene) -> Depths:
    """Depth (H, W) mm of the floor's plane."""
    return scene.grid_floor.depth(scene.grid.width, scene.grid.height)


def _around(lump: Mask) -> Mask:
    """A lump (H, W) with its edge."""
    square = np.ones((2 * _AROUND_PX + 1, 2 * _AROUND_PX + 1), np.uint8)
    return cv2.dilate(lump.astype(np.uint8), square).astype(bool)


def _box(mask: Mask) -> tuple[slice, slice]:
    """The rows and columns of the picture between which a mask (H, W) lies."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return slice(top, top + height), slice(left, left + width)


def _with_floor_at(scene: AnyScene, where: Mask, wanted: Wanted) -> AnyScene:
    """The scene with the floor's bare plane as background in some of its pixels (H, W)."""
    bare = _bare(scene)
    there = where & scene.on_floor
    limit = np.where(there, np.maximum(bare - np.float32(wanted.min_height_mm), 0), scene.limit)
    background = np.where(there, bare, scene.background)
    return replace(scene, background=background, limit=limit.astype(np.float32))


def _areas_at(scene: StillScene, sample: Depths, lump: Mask, wanted: Wanted) -> NDArray[np.float64]:
    """Area (n,) mm^2 of what stands out and touches a lump (H, W), frame by frame."""
    rows, columns = np.nonzero(lump)
    reach = int(wanted.spine_mm[1] * scene.grid.fx / float(np.median(scene.background[lump])))
    cut = (
        slice(max(0, rows.min() - reach), rows.max() + reach + 1),
        slice(max(0, columns.min() - reach), columns.max() + reach + 1),
    )
    areas = np.zeros(len(sample))
    for k, depth in enumerate(sample):
        near = depth[cut]
        out = (near > 0) & (near < scene.limit[cut]) & scene.on_floor[cut]
        _, labels = cv2.connectedComponents(out.astype(np.uint8))
        own = np.isin(labels, np.unique(labels[lump[cut] & out])) & out
        areas[k] = (near[own].astype(float) ** 2).sum() / (scene.grid.fx * scene.grid.fy)
    return areas


def _change(scene: StillScene, sample: Depths, near: Mask, wanted: Wanted) -> float:
    """Share of the readings at some pixels (H, W) that are an animal's height off the background.

    Counted are pixels of which that is so in more than one frame of ten, so that noise adds little.
    """
    off = np.abs(sample[:, near] - scene.background[near]) > wanted.min_height_mm
    often = (off & (sample[:, near] > 0)).mean(axis=0)
    return float(np.where(often > 0.1, often, 0.0).mean())


def _keeps_its_place(shown: HeightMaps, area_mm2: float) -> bool:
    """Whether what is found with such an area lies in one place in most frames that show it."""
    place = shown.centroid[:, :2]
    off = np.linalg.norm(place - np.median(place, axis=0), axis=1)
    return bool((off < 0.5 * np.sqrt(area_mm2)).mean() > _IN_PLACE)


def _stays_beside(resting: StillScene, moving: StillScene, sample: Depths) -> bool:
    """Whether what rests, in a sample (n, H, W) mm, is there beside what moves: another thing."""
    mover = moving.extract(sample, 1.0)
    both = resting.extract(sample, 1.0)
    seen = mover.found & both.found
    if not seen.any():
        return True
    apart = np.linalg.norm(mover[seen].centroid[:, :2] - both[seen].centroid[:, :2], axis=1)
    beside = (apart > np.sqrt(resting.area_mm2)) | (both.n_blobs[seen] > 1)
    return bool(beside.mean() > 0.5)
