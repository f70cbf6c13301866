"""Transient objects, which are placed in or removed from the arena during a recording.

A pixel of such an object is above the floor for one interval of time and hardly ever outside of it.
With weights of +1/2 for readings above the floor, -1/2 for readings at the floor and 0 for unread
ones, that interval is the one of the largest sum (Kadane's maximum subarray). Neighbouring pixels
with similar intervals form one object. An animal that pauses is above the floor for an interval,
too: an object is rejected if the animal itself covers it in most of the interval, or if two animals
are in view at other times.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from liex_lab.scene.background_segmenter import BackgroundSubtraction as Scene
from liex_lab.scene.floor import parts
from liex_lab.scene.scene import HIGH_MM, LEAST_MM2, Fixture, fixture_at
from liex_lab.scene.support_plane import TargetAnimal

# the scene with an animal's area, the share of frames that show it, and whether it is like one
Resting: TypeAlias = "tuple[Scene, float, bool]"
# an object's first frame, the frame after its last, its pixels and their depth (H, W)
_Transient: TypeAlias = "tuple[int, int, Mask, Depths]"
Array = NDArray[np.float64]
Depths = NDArray[np.float32]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]

_LEAST_FRAMES = 6  # least frames of the sample with it, and without it
_HIGH_SHARE = 0.9  # least share of high readings inside the interval, and 1 - this at most outside
_ALIKE = 3  # frames by which the intervals of one object's pixels may differ
_LEAST_PX = 8
_MOST = 8  # objects
_OFTEN = 0.5  # of the frames


def find_transient_objects(scene: Scene, sample: Depths, times_s: Array) -> tuple[Fixture, ...]:
    """Find the objects that stand on the floor for a part of the recording, in order of time.

    Args:
        scene: the scene with its animal's area, at whose stride the frames are.
        sample: (n, H, W) float32 mm, frames spread over the recording, 0 where unread.
        times_s: (n,) of the frames, s since the recording's first.

    Returns:
        Each with its start and end times, None for the recording's beginning or end.
    """
    n = len(sample)
    if n < 2 * _LEAST_FRAMES:
        return ()
    found = []
    for start, stop, mask, depth in _transient_objects(scene, sample):
        fixture = fixture_at(mask, depth, scene.grid_floor, scene.grid)
        if fixture.area_mm2 < LEAST_MM2 or _is_an_animal(scene, sample, start, stop, mask):
            continue
        since = float(times_s[start]) if start > 0 else None
        until = float(times_s[stop]) if stop < n else None
        found.append(replace(fixture, since_s=since, until_s=until))
    return tuple(sorted(found, key=lambda one: (one.since_s or 0.0, one.until_s or np.inf)))


def _transient_objects(scene: Scene, sample: Depths) -> list[_Transient]:
    """Objects at rest on the floor for one interval of the frames."""
    rows, columns, first, last = _stretches(scene, sample)
    found: list[_Transient] = []
    left = np.ones(len(rows), np.bool_)
    while left.sum() >= _LEAST_PX and len(found) < _MOST:
        # the most frequent interval
        pairs, counts = np.unique(np.stack([first[left], last[left]]), axis=1, return_counts=True)
        start, stop = pairs[:, np.argmax(counts)]
        one = left & (np.abs(first - start) <= _ALIKE) & (np.abs(last - stop) <= _ALIKE)
        left &= ~one
        mask = np.zeros(scene.limit.shape, np.bool_)
        mask[rows[one], columns[one]] = True
        for part in parts(mask, _LEAST_PX):
            found += _if_still(sample, part, int(start), int(stop))
    return found[:_MOST]


def _if_still(sample: Depths, mask: Mask, first: int, last: int) -> list[_Transient]:
    """The object in a mask (H, W) if it does not move; its first frames may show the person placing
    it.
    """
    readings = sample[first:last, mask]
    usual = np.nanmedian(np.where(readings > 0, readings, np.nan), axis=0)
    same = np.abs(readings - usual) < np.maximum(6.0, 0.012 * usual)
    shows = np.flatnonzero(same.mean(axis=1) > 0.5)
    # hands and animals move, and a shorter presence than a tenth of the recording is a visit
    if same.mean() < 0.6 or len(shows) < max(_LEAST_FRAMES, 0.1 * len(sample)):
        return []
    depth = np.zeros(mask.shape, np.float32)
    depth[mask] = usual
    until = last if last == len(sample) else first + int(shows[-1]) + 1
    return [(first + int(shows[0]) if first else 0, until, mask, depth)]


def _is_an_animal(scene: Scene, sample: Depths, first: int, last: int, mask: Mask) -> bool:
    """Whether a candidate is the animal, which covers it in most of the interval, or a second,
    resting animal: then two are in view in most of the other frames.
    """
    rows = np.arange(len(sample))
    inside = (rows >= first) & (rows < last)
    own = scene.animal_masks(scene.extract(sample[_some(rows[inside])], 1.0))
    # the animal covers this share of it
    if own and float(np.mean([one[mask].mean() > 0.3 for one in own])) > _OFTEN:
        return True
    others = scene.extract(sample[_some(rows[~inside])], 1.0)
    return float((others.n_blobs > 1).mean()) > _OFTEN


def _some(rows: Rows) -> Rows:
    """At most 16 of the rows, spread evenly."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, 16).astype(int))]


def _stretches(scene: Scene, sample: Depths) -> tuple[Rows, Rows, Rows, Rows]:
    """Row and column (k,) of the pixels above the floor for one interval of the frames, its first
    frame, and the frame after its last one.
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
    n_inside, n_outside = (inside & read).sum(axis=0), (~inside & read).sum(axis=0)
    is_one = (n_inside >= _LEAST_FRAMES) & (n_outside >= _LEAST_FRAMES)
    is_one &= (inside & high).sum(axis=0) >= _HIGH_SHARE * n_inside
    is_one &= (~inside & high).sum(axis=0) <= (1.0 - _HIGH_SHARE) * n_outside
    return rows[is_one], columns[is_one], first[is_one], last[is_one]


# Animals at rest, wholly or in part, that were absorbed into the scene's background.


_AROUND_PX = 4  # width of a lump's edge, which flickers between it and the floor


def find_resting_animal(
    scene: Scene, sample: Depths, target: TargetAnimal, area: float, share: float
) -> Resting | None:
    """Find an animal that is part of its own background.

    This is tried if fewer than half of the frames show something moving, or if what most of them
    show is no animal, such as specks of a flickering edge.

    Args:
        scene: the scene as learned.
        sample: (n, H, W) float32 mm, frames at its stride.
        target: the expected animal.
        area: usual area of the moving object, mm^2.
        share: of the frames that show it.

    Returns:
        The scene with the floor under the animal, so that it is foreground, and its area; the share
            of the frames that show it; and whether it resembles an animal. None if the scene as
            learned is better.
    """
    moving = replace(scene, area_mm2=area)
    if share >= 0.5 and (not target.stands_on_floor or is_like_an_animal(moving, sample, target)):
        return None
    rests = _changing_lump(scene, sample, target) if target.stands_on_floor else None
    rests = rests or _on_bare_floor(scene, sample, target, 1 if share > 0.0 else 4)
    resting, resting_share, is_like = rests
    if resting_share <= (share if share < 0.5 else 0.0):
        return None
    plane_moves = scene.support_plane is not None and scene.support_plane.moves
    moves = target.stands_on_floor and area > 0.0 and plane_moves
    if (share >= 0.5 or moves) and not is_like:
        return None
    if share < 0.5 and moves and _is_separate(resting, moving, sample):
        return None
    return rests


def with_its_still_part(scene: Scene, sample: Depths, target: TargetAnimal, area: float) -> Scene:
    """The scene with floor under an animal that was partly absorbed into the background.

    The absorbed part is a lump on the floor that the moving animal touches in at least nine tenths
    of the frames in which the lump is read, and that together with the animal is no larger than an
    animal. It is read in all frames, or until the animal leaves and uncovers floor that is never
    read.

    Args:
        scene: the scene as learned.
        sample: (n, H, W) float32 mm, frames at its stride.
        target: the expected animal.
        area: area of the moving animal, mm^2.

    Returns:
        The scene, and in it the area of the whole animal.
    """
    best = replace(scene, area_mm2=area)
    crops = best.extract(sample, 1.0)
    moving = np.array(scene.animal_masks(crops)).reshape(-1, *scene.limit.shape)
    shown = sample if crops.found.all() else sample[crops.found]
    for lump in _lumps(scene, target):
        near = _around(lump)
        box = _box(near)
        # present if half of it is read
        there = (shown[:, *box][:, lump[box]] > 0).mean(axis=1) > 0.5
        touched = moving[there][:, *box][:, near[box]].any(axis=1)
        # a lump touched less often is no resting part of it
        if not there.any() or touched.mean() < 0.9:
            continue
        whole = _with_floor_at(scene, near, target)
        whole_area, share = whole.usual_area(sample, target.spine_mm)
        if share >= 0.5 and whole_area > best.area_mm2:
            best = replace(whole, area_mm2=whole_area)
    return best


def is_like_an_animal(scene: Scene, sample: Depths, target: TargetAnimal) -> bool:
    """Whether the detection is neither longer than the largest animal nor as low as an uneven
    floor.

    Args:
        scene: the scene with the expected area.
        sample: (n, H, W) float32 mm, frames at its stride.
        target: the expected animal.
    """
    return _inspected(scene, sample, target)[0]


def _inspected(scene: Scene, sample: Depths, target: TargetAnimal) -> tuple[bool, bool]:
    """`is_like_an_animal`, and whether it is in one position in most frames that show it."""
    crops = scene.extract(sample, 1.0)
    shown = crops[crops.found]
    if not len(shown.n_px):
        return False, False
    blobs = shown.blobs
    length = 4.0 * float(np.median(blobs.sd_along))
    height = float(np.median(blobs.volume_mm3 / np.maximum(blobs.area_mm2, 1e-9)))
    # in units of the largest spine, the detection height and the smallest area
    is_like = (
        length < 2.0 * target.spine_mm[1]
        and height > 1.4 * target.min_height_mm
        and scene.area_mm2 > 1.5 * target.smallest_mm2
    )
    centroid = np.column_stack([blobs.x, blobs.y])
    off = np.linalg.norm(centroid - np.median(centroid, axis=0), axis=1)
    # near its median position in most frames that show it
    stays = (off < 0.5 * np.sqrt(scene.area_mm2)).mean() > 0.8
    return is_like, bool(stays)


def _changing_lump(scene: Scene, sample: Depths, target: TargetAnimal) -> Resting | None:
    """The free lump that resembles an animal, stays in place and changes most; None without one.

    An object at rest only flickers along its edge; an animal moves a part of itself. The foot of a
    wall flickers as much as an animal moves, but has floor on one side only.
    """
    free = []
    for lump in _lumps(scene, target):
        near = _around(lump)
        # of its edge is bare floor; half for the foot of a wall
        if _free(scene, near & ~lump, target) >= 0.75:
            free.append((_change(scene, sample, near, target), lump, near))
    for _, lump, near in sorted(free, key=lambda one: -one[0])[:16]:
        whole = _with_floor_at(scene, near, target)
        areas = _areas_at(whole, sample, lump, target)
        own = (areas > target.smallest_mm2) & (areas < target.largest_mm2)
        if own.mean() < 0.5:
            continue
        whole = replace(whole, area_mm2=float(np.median(areas[own])))
        if all(_inspected(whole, sample, target)):
            return whole, float(own.mean()), True
    return None


def _on_bare_floor(scene: Scene, sample: Depths, target: TargetAnimal, kinds: int) -> Resting:
    """The component above the floor's bare plane that is in most frames and resembles an animal.

    The foot of a wall or a step along the floor's edge is in every frame, too, but longer than any
    animal; later candidates must also stay in place, which specks of an edge do not. If nothing
    resembles an animal, the result is what most frames show; at most `kinds` areas are tried.
    """
    on_floor = scene.on_floor if scene.support_plane is None else scene.support_plane.on_floor
    bare = _with_floor_at(scene, on_floor, target)
    tried: list[float] = []
    first = bare, 0.0, False
    while len(tried) < kinds:
        area, share = bare.usual_area(sample, target.spine_mm, tried)
        if share == 0.0:
            break
        resting = replace(bare, area_mm2=area)
        is_like, stays = _inspected(resting, sample, target)
        if is_like and (not tried or stays):
            return resting, share, True
        first = first if tried else (resting, share, is_like)
        tried.append(area)
    return first


def _lumps(scene: Scene, target: TargetAnimal) -> Iterator[Mask]:
    """The lumps (H, W) bool of the background on the floor."""
    above = scene.bare - scene.background
    raised = scene.on_floor & (scene.background > 0) & (above > target.min_height_mm)
    return parts(raised, 16)


def _free(scene: Scene, edge: Mask, target: TargetAnimal) -> float:
    """The share of a lump's edge (H, W) that is bare floor, 0 to 1."""
    off = np.abs(scene.bare - scene.background)[edge]
    return float((scene.on_floor[edge] & (off < target.min_height_mm)).mean())


def _around(lump: Mask) -> Mask:
    """A lump (H, W) with its edge."""
    square = np.ones((2 * _AROUND_PX + 1, 2 * _AROUND_PX + 1), np.uint8)
    return cv2.dilate(lump.astype(np.uint8), square).astype(bool)


def _box(mask: Mask) -> tuple[slice, slice]:
    """The rows and columns that enclose a mask (H, W)."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return slice(top, top + height), slice(left, left + width)


def _with_floor_at(scene: Scene, where: Mask, target: TargetAnimal) -> Scene:
    """The scene with the floor's bare plane as background in some pixels (H, W)."""
    there = where & scene.on_floor
    limit = np.where(
        there, np.maximum(scene.bare - np.float32(target.min_height_mm), 0), scene.limit
    )
    background = np.where(there, scene.bare, scene.background)
    return replace(scene, background=background, limit=limit.astype(np.float32))


def _areas_at(
    scene: Scene, sample: Depths, lump: Mask, target: TargetAnimal
) -> NDArray[np.float64]:
    """Area (n,) mm^2 of the foreground that touches a lump (H, W), frame by frame."""
    rows, columns = np.nonzero(lump)
    reach = int(target.spine_mm[1] * scene.grid.fx / float(np.median(scene.background[lump])))
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


def _change(scene: Scene, sample: Depths, near: Mask, target: TargetAnimal) -> float:
    """Share of the readings in some pixels (H, W) that differ from the background by an animal's
    height.

    Only pixels that do so in more than one frame in ten count, so that noise adds little.
    """
    off = np.abs(sample[:, near] - scene.background[near]) > target.min_height_mm
    often = (off & (sample[:, near] > 0)).mean(axis=0)
    return float(np.where(often > 0.1, often, 0.0).mean())


def _is_separate(resting: Scene, moving: Scene, sample: Depths) -> bool:
    """Whether the resting object is visible apart from the moving one in a sample (n, H, W)."""
    mover = moving.extract(sample, 1.0)
    both = resting.extract(sample, 1.0)
    together = mover.found & both.found
    if not together.any():
        return True
    apart = np.linalg.norm(mover[together].centroid[:, :2] - both[together].centroid[:, :2], axis=1)
    separate = (apart > np.sqrt(resting.area_mm2)) | (both.n_blobs[together] > 1)
    return bool(separate.mean() > 0.5)
