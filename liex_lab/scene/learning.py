"""Learning of a recording's background subtraction, its animal, and its sensor's quality card.

The ground is learned from sampled frames (`background.BareGround`); worn devices are removed from
the sample (`worn`); the animal is the component that recurs in the most frames, or an object at
rest that was absorbed into the background (`find_resting_animal`).

Transient objects are placed in or removed from the arena during a recording. A pixel of such an
object is above the floor for one interval of time and hardly ever outside of it. With weights of
+1/2 for readings above the floor, -1/2 for readings at the floor and 0 for unread ones, that
interval is the one of the largest sum (Kadane's maximum subarray). Neighbouring pixels with similar
intervals form one object. An animal that pauses is above the floor for an interval, too: an object
is rejected if the animal itself covers it in most of the interval, or if two animals are in view at
other times.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import MOUSE_VIEW, VIEWS, CameraView
from liex_lab.errors import EstimationError
from liex_lab.optics.camera import Camera, SensorCard
from liex_lab.recordings.recording import Recording
from liex_lab.scene.background import (
    BareGround,
    FloorLevel,
    SceneChange,
    sample_frames,
    sampled,
    stride_for,
)
from liex_lab.scene.background_segmenter import BackgroundSubtraction as Scene
from liex_lab.scene.changing_ground import ChangingGround, RaisedGround
from liex_lab.scene.floor import Array, Depths, Floor, Mask, parts
from liex_lab.scene.height_maps import ANIMAL_HEIGHTS
from liex_lab.scene.scene import HIGH_MM, LEAST_MM2, Fixture, fixture_at
from liex_lab.scene.support_plane import TargetAnimal
from liex_lab.scene.worn import find_worn

# the scene with an animal's area, the share of frames that show it, and whether it is like one
Resting: TypeAlias = "tuple[Scene, float, bool]"
# an object's first frame, the frame after its last, its pixels and their depth (H, W)
_Transient: TypeAlias = "tuple[int, int, Mask, Depths]"
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
    often = sum((depth > 0) & (depth < limit) for depth in sample)
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
        edge = near & ~lump
        off = np.abs(scene.bare - scene.background)[edge]
        # of its edge is bare floor; half for the foot of a wall
        if (scene.on_floor[edge] & (off < target.min_height_mm)).mean() >= 0.75:
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
    raised = (
        scene.on_floor
        & (scene.background > 0)
        & (scene.bare - scene.background > target.min_height_mm)
    )
    return parts(raised, 16)


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
    return replace(
        scene,
        background=np.where(there, scene.bare, scene.background),
        limit=limit.astype(np.float32),
    )


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


def learn_scene(
    recording: Recording,
    spine_mm: tuple[float, float],
    n_frames: int = 96,
    min_height_mm: float = 7.0,
    view: CameraView = MOUSE_VIEW,
    floor: Floor | None = None,
    region: Mask | None = None,
    alone: bool = True,
) -> tuple[Scene, Depths]:
    """Learn the background subtraction of a recording from frames spread over it.

    The background of a pixel is its farthest recurring depth, which remains visible although an
    animal covers it most of the time; under an animal that never moves, the floor plane is
    used. Rims and walls around the floor flicker between near and far, so only readings nearer
    than the nearest usual depth are foreground there. If fewer than half of the frames show an
    animal, it may be absorbed into its own background: the floor plane is then tried as
    background, and kept if more frames show an animal.

    If the ground changes and sampled frames show it without the animal, the rest is learned from
    frames on level ground, see `changing_ground`.

    Args:
        recording: of an ideal pinhole camera, see `recordings.rectify`.
        spine_mm: lengths of the smallest and the largest expected animal, mm.
        n_frames: sampled frames at most.
        min_height_mm: smaller heights above the background are not the animal.
        view: how such animals are viewed; one that does not stand on the floor may be anywhere.
        floor: the stated floor; None to estimate it.
        region: (height, width) bool of the full image, analysed pixels; None for all.
        alone: whether there is one animal, so that the rest of a frame shows the ground.

    Returns:
        The segmenter, and the sample (n, H, W) float32 mm of frames that it was learned from,
        at its stride.

    Raises:
        EstimationError: no depth was read, no depth recurs often enough to be a background, no
            floor was found, or nothing of an animal's size stands on it.
    """
    target = TargetAnimal(spine_mm, min_height_mm, view)
    stride = stride_for(recording, spine_mm[0])
    sample = sample_frames(recording, n_frames, stride)
    cut = None if region is None else region[::stride, ::stride]
    sample *= True if cut is None else cut
    times_ns = recording.times_ns[sampled(len(recording), n_frames)]
    times_s = (times_ns - recording.times_ns[0]) * 1e-9
    known = recording.camera, stride, target, floor, cut, times_s
    scene, first, raised = _learned(sample, *known)
    ground = _changing_ground(recording, scene, first, target) if raised and alone else None
    if ground is not None and ground.changes_s and ground.unknown_share < 0.5:
        with suppress(EstimationError):
            even, level, left = _learned(ground.levelled(sample, times_ns), *known)
            if not (left or even.changed) and even.n_animals == 1:
                return replace(
                    even,
                    ground=ground,
                    # unknown for more of the time than this, it is reported
                    changed=ground if ground.unknown_share > 0.05 else None,
                    transient_objects=scene.transient_objects,
                ), level
    return scene, first


def _learned(
    sample: Depths,
    camera: Camera,
    stride: int,
    target: TargetAnimal,
    floor: Floor | None,
    cut: Mask | None,
    times_s: Array,
) -> tuple[Scene, Depths, RaisedGround | None]:
    """The scene of a sample, the sample as corrected, and its ground that changed, see
    `learn_scene`.
    """
    ground, level = BareGround.steady(sample, camera.every(stride), target, floor, cut)
    scene, sample = _scene_of(camera, stride, ground, level)
    if target.stands_on_floor and floor is None and not ground.support_plane.moves:
        # without movers, the animal at rest decides which of two levels is the floor
        under = ground.under(scene.animal_masks(scene.extract(sample, 1.0)))
        if under.support_plane is not ground.support_plane:
            scene, sample = _scene_of(camera, stride, under, level)
    changed: SceneChange | RaisedGround | None = SceneChange.find(
        sample, times_s, scene.grid, scene.area_mm2
    )
    scene = replace(scene, volume_mm3=scene.usual_volume(sample), changed=changed)
    n_animals, share = count_in_sample(scene, sample)
    scene = replace(
        scene, n_animals=n_animals, n_animals_share=share, sensor=read_sensor(scene, sample)
    )
    if not target.stands_on_floor:
        return scene, sample, None
    objects = () if changed else find_transient_objects(scene, sample, times_s)
    # an animal asleep is no ground; a nest may have been taken for it, but does not move
    moving_mm2 = float(np.fmin(scene.area_mm2, ground.support_plane.mover_mm2))
    raised = RaisedGround.find(
        sample, scene.on_floor, scene.grid, (target.min_height_mm, 1.5 * moving_mm2)
    )
    # and neither are several side by side
    if (
        raised is not None
        and not (changed or objects)
        and raised.part_mm2 > 1.5 * max(n_animals, 1) * scene.area_mm2
    ):
        changed = raised
    return replace(scene, transient_objects=objects, changed=changed), sample, raised


def _changing_ground(
    recording: Recording, scene: Scene, sample: Depths, target: TargetAnimal
) -> ChangingGround | None:
    """The ground of a recording in stretches; None if too few frames show it.

    Args:
        recording: to read four times as many frames from.
        scene: learned from the sample.
        sample: (n, H, W) float32 mm, frames at its stride.
        target: the expected animal.
    """
    where = ChangingGround.places(sample, scene.on_floor, target.min_height_mm)
    near = cv2.dilate(where.astype(np.uint8), np.ones((9, 9))) > 0
    area, _ = scene.usual_area(np.where(where, np.float32(0), sample), target.spine_mm)
    own = replace(scene, area_mm2=area)
    chosen = sampled(len(recording), 4 * len(sample))
    readings = np.empty((len(chosen), np.count_nonzero(where)), np.float32)
    places = np.full((len(chosen), 2), np.nan)
    for k, index in enumerate(chosen):
        depth = recording.frame(int(index)).depth[None, :: scene.stride, :: scene.stride]
        depth = depth if scene.level is None else scene.level.brought_back(depth)
        readings[k] = depth[0, where]
        crops = own.extract(np.where(where, np.float32(0), depth), 1.0)
        if area / 1.5 < crops.blobs.area_mm2[0] < 1.5 * area:
            is_beside = (own.animal_masks(crops)[0] & near).any()
            places[k] = np.nan if is_beside else crops.centroid[0, :2]
    # what stands still from frame to frame, or for two seconds, may be an object
    step = 1 + int(2e9 / np.diff(recording.times_ns[chosen]).mean())
    moved = np.linalg.norm(places[step:] - places[:-step], axis=1) > 0.5 * np.sqrt(area)
    shows = np.append(moved, [False] * step) | np.append([False] * step, moved)
    if shows.sum() < _LEAST_FRAMES:
        return None
    return ChangingGround.follow(
        where,
        (scene.background - scene.limit)[where],
        readings,
        shows,
        recording.times_ns[chosen],
        0.5 * area * scene.grid.fx * scene.grid.fy / scene.floor.distance_mm**2,
        scene.level,
    )


def _scene_of(
    camera: Camera, stride: int, ground: BareGround, level: FloorLevel | None
) -> tuple[Scene, Depths]:
    """The scene of a ground with its animal, and the ground's sample without worn devices."""
    target, sample, found = ground.scene.target, ground.scene.sample, ground.support_plane
    background, limit = ground.background_and_limit()
    scene = Scene(
        camera,
        found.floor if stride == 1 else found.floor.for_camera(camera),
        background,
        limit,
        found.on_floor if target.stands_on_floor else np.ones_like(found.on_floor),
        view=target.view,
        stride=stride,
        support_plane=found,
        level=level,
    )
    if target.stands_on_floor:
        worn, sample = find_worn(sample, limit, found.floor, ground.scene.camera, target)
        scene = replace(scene, worn=worn)
    return _with_its_animal(scene, sample, target), sample


def _with_its_animal(scene: Scene, sample: Depths, target: TargetAnimal) -> Scene:
    """The scene with the usual area of its animal, and floor under an animal at rest.

    Args:
        scene: of the ground.
        sample: (n, H, W) float32 mm, frames at the scene's stride.
        target: the expected animal.

    Raises:
        EstimationError: nothing of an animal's size stands on the floor.
    """
    area, share = _moving_area(scene, sample, target)
    plane_moves = scene.support_plane is not None and scene.support_plane.moves
    moves = share >= 0.5 or (share > 0.0 and plane_moves)
    rests = find_resting_animal(scene, sample, target, area, share)
    if rests is not None:
        scene, share, _ = rests
        area, moves = scene.area_mm2, False
    elif target.stands_on_floor and share >= 0.5:
        scene = with_its_still_part(scene, sample, target, area)
        area = scene.area_mm2
    # an object that does not move must have an animal's size and height
    if target.stands_on_floor and share > 0.0 and not moves:
        share = share if is_like_an_animal(replace(scene, area_mm2=area), sample, target) else 0.0
    if share == 0.0:
        raise EstimationError(
            f"no animal was found in {len(sample)} frames spread over the recording: nothing "
            f"between {target.smallest_mm2:.0f} and {target.largest_mm2:.0f} mm^2 stands on "
            "the floor; check the depth unit, or set animal.spine_min_mm and spine_max_mm in "
            "the plan"
        )
    return replace(scene, area_mm2=area)


def _moving_area(scene: Scene, sample: Depths, target: TargetAnimal) -> tuple[float, float]:
    """The usual area mm^2, and the share of the frames that show it, see `usual_area`.

    If that differs clearly from the area of the moving objects, as for specks that recur in
    more frames before the animal arrives, the area of the moving objects is used. A component
    that resembles an animal is no speck, even if a larger object moves in and out of view.
    """
    area, share = scene.usual_area(sample, target.spine_mm)
    support_plane = scene.support_plane
    if support_plane is None or not support_plane.moves or scene.view.frame != VIEWS[0]:
        return area, share
    # beyond this ratio, it is another object
    if area > 0.0 and abs(np.log(area / support_plane.mover_mm2)) < np.log(3.0):
        return area, share
    if share >= 0.5 and is_like_an_animal(replace(scene, area_mm2=area), sample, target):
        return area, share
    crops = replace(scene, area_mm2=support_plane.mover_mm2).extract(sample, 1.0)
    return support_plane.mover_mm2, float(crops.found.mean())


# The number of animals in sampled frames.


def count_in_sample(scene: Scene, sample: Depths) -> tuple[int, float]:
    """How many animals are in view at once in a fifth of the frames that show any.

    Counted are the components of about the animal's size that are 0.4 to 2 times as high as usual
    and do not stand at one position in half of the frames.

    Args:
        scene: the scene with its animal's area.
        sample: (n, H, W) float32 mm, frames at its stride, spread over the recording.

    Returns:
        The number, and the share of the frames with an animal in which as many stand free.
    """
    objects = scene.extract(sample, 1.0, n_candidates=2).objects[: len(sample)]
    known = np.isfinite(objects[..., 0])
    if not known[:, 1:].any():
        return 1, 1.0
    if scene.view.frame == VIEWS[0]:
        height = objects[..., 2] / np.median(objects[known[:, 0], 0, 2])
        known &= (height > ANIMAL_HEIGHTS[0]) & (height < ANIMAL_HEIGHTS[1])
    reach = 0.1 * np.sqrt(scene.area_mm2)  # less than a resting animal moves its head
    for i, k in zip(*np.nonzero(known[:, 1:]), strict=True):  # the first is the animal
        off = np.linalg.norm(objects[..., :2] - objects[i, k + 1, :2], axis=-1)
        known[i, k + 1] = (off < reach).any(axis=1).mean() < _OFTEN
    counts = np.maximum(known.sum(axis=1), 1)
    n_animals = int(np.percentile(counts, 80, method="lower"))
    return n_animals, float((counts == n_animals).mean())


# The quality card of a sensor.

_N_PIXELS = 20_000  # inspected for noise and edges, spread over the image
_LEAST = 200  # fewer pixels, readings or seam pixels give no estimate
_MIDDLE = (0.25, 0.75)  # of the jump: readings there belong to neither side
_REACH_PX = 4  # largest distance of the seam from the outline


def read_sensor(scene: Scene, sample: Depths) -> SensorCard:
    """The quality card of the sensor that recorded a sample.

    Args:
        scene: learned from the sample, including its animal's area.
        sample: (n, H, W) float32 mm, frames at the scene's stride, 0 where unread.
    """
    return SensorCard(
        _noise(scene.background, sample),
        _step(sample),
        _seam(scene, sample),
        _mixed(scene.background, sample),
    )


def _noise(background: Depths, sample: Depths) -> tuple[tuple[float, float], ...]:
    """Noise by depth: of the nearest, middle and farthest third of the still pixels; a single value
    if their depths differ by less than a tenth.
    """
    valid = np.flatnonzero(background > 0)
    valid = valid[:: max(1, len(valid) // _N_PIXELS)]
    depth = background.ravel()[valid]
    off = sample.reshape(len(sample), -1)[:, valid] - depth
    # readings nearer than this are the background
    still = np.abs(off) < np.maximum(6.0, 0.012 * depth)
    n = still.sum(axis=0)
    steady = n >= max(3, 0.5 * len(sample))  # of the frames
    if steady.sum() < _LEAST:
        return ()
    off, still, n, depth = off[:, steady], still[:, steady], n[steady], depth[steady]
    mean = np.where(still, off, 0.0).sum(axis=0) / n
    sd = np.sqrt(np.where(still, (off - mean) ** 2, 0.0).sum(axis=0) / (n - 1))
    order = np.argsort(depth, kind="stable")
    low, high = depth[order[len(order) // 20]], depth[order[-1 - len(order) // 20]]
    parts = [order] if high < 1.1 * low else np.array_split(order, 3)
    return tuple(
        (round(float(np.median(depth[part])), 1), round(float(np.median(sd[part])), 2))
        for part in parts
    )


def _step(sample: Depths) -> float | None:
    """The usual distance between neighbouring depth values near the median."""
    read = sample[:: max(1, len(sample) // 8)]
    read = read[read > 0]
    if len(read) < _LEAST:
        return None
    middle = float(np.median(read))
    values = np.unique(read[np.abs(read - middle) < 0.03 * middle])
    if len(values) < 3:
        return None
    gap = float(np.median(np.diff(values)))
    return round(gap, 3) if gap > 0.05 else None  # a finer step is continuous


def _seam(scene: Scene, sample: Depths) -> float | None:
    """Width of the unread seam around the animal, px of the image, beyond the usual share of unread
    pixels.
    """
    # some frames show the seam well enough
    rows = np.linspace(0, len(sample) - 1, min(12, len(sample))).astype(int)
    shown = sample[rows]
    crops = scene.extract(shown, 1.0)
    unread = np.zeros(_REACH_PX)
    counted = np.zeros(_REACH_PX)
    for i, own in zip(np.flatnonzero(crops.found), scene.animal_masks(crops), strict=True):
        v, u, height, width = cv2.boundingRect(own.T.astype(np.uint8))
        cut = (
            slice(max(0, v - _REACH_PX), v + height + _REACH_PX),
            slice(max(0, u - _REACH_PX), u + width + _REACH_PX),
        )
        around = cv2.distanceTransform((~own[cut]).astype(np.uint8), cv2.DIST_C, 3)
        for k in range(_REACH_PX):
            ring = (around == k + 1) & scene.on_floor[cut]
            unread[k] += (shown[i][cut][ring] == 0).sum()
            counted[k] += ring.sum()
    if counted.min() < _LEAST:
        return None
    anyway = float((shown[:, scene.on_floor] == 0).mean())
    return round(scene.stride * float(np.clip(unread / counted - anyway, 0.0, 1.0).sum()), 2)


def _mixed(background: Depths, sample: Depths) -> float | None:
    """Share of the readings at edges of the still scene that lie between both sides."""
    left, right = background[:, :-2], background[:, 2:]
    # a jump of depth within two pixels is an edge
    edge = (left > 0) & (right > 0) & (np.abs(left - right) > 60.0)
    rows, columns = np.nonzero(edge)
    chosen = slice(None, None, max(1, len(rows) // _N_PIXELS))
    rows, columns = rows[chosen], columns[chosen]
    reading = sample[:, rows, columns + 1]
    at = (reading - left[rows, columns]) / (right - left)[rows, columns]
    read = reading > 0
    if read.sum() < _LEAST:
        return None
    between = read & (at > _MIDDLE[0]) & (at < _MIDDLE[1])
    return round(float(between.sum() / read.sum()), 3)
