"""Learning of a recording's background subtraction, its animal, and its sensor's quality card.

The ground is learned from sampled frames (`background.BareGround`); worn devices are removed from
the sample (`worn`); the animal is the component that recurs in the most frames, or an object at
rest that was absorbed into the background (`objects.find_resting_animal`).
"""

from dataclasses import replace

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
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.floor import Floor
from liex_lab.scene.objects import (
    find_resting_animal,
    find_transient_objects,
    is_like_an_animal,
    with_its_still_part,
)
from liex_lab.scene.support_plane import TargetAnimal
from liex_lab.scene.worn import find_worn

Depths = NDArray[np.float32]
Mask = NDArray[np.bool_]


def learn_scene(
    recording: Recording,
    spine_mm: tuple[float, float],
    n_frames: int = 96,
    min_height_mm: float = 7.0,
    view: CameraView = MOUSE_VIEW,
    floor: Floor | None = None,
    region: Mask | None = None,
) -> tuple[BackgroundSubtraction, Depths]:
    """Learn the background subtraction of a recording from frames spread over it.

    The background of a pixel is its farthest recurring depth, which remains visible although an
    animal covers it most of the time; under an animal that never moves, the floor plane is
    used. Rims and walls around the floor flicker between near and far, so only readings nearer
    than the nearest usual depth are foreground there. If fewer than half of the frames show an
    animal, it may be absorbed into its own background: the floor plane is then tried as
    background, and kept if more frames show an animal.

    Args:
        recording: of an ideal pinhole camera, see `recordings.rectify`.
        spine_mm: lengths of the smallest and the largest expected animal, mm.
        n_frames: sampled frames at most.
        min_height_mm: smaller heights above the background are not the animal.
        view: how such animals are viewed; one that does not stand on the floor may be anywhere.
        floor: the stated floor; None to estimate it.
        region: (height, width) bool of the full image, analysed pixels; None for all.

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
    cut = None
    if region is not None:
        cut = region[::stride, ::stride]
        sample *= cut
    camera = recording.camera
    ground, level = BareGround.steady(sample, camera.every(stride), target, floor, cut)
    times_ns = recording.times_ns[sampled(len(recording), n_frames)]
    times_s = (times_ns - recording.times_ns[0]) * 1e-9
    scene, sample = _scene_of(camera, stride, ground, level)
    if target.stands_on_floor and floor is None and not ground.support_plane.moves:
        # without movers, the animal at rest decides which of two levels is the floor
        under = ground.under(scene.animal_masks(scene.extract(sample, 1.0)))
        if under.support_plane is not ground.support_plane:
            scene, sample = _scene_of(camera, stride, under, level)
    changed = SceneChange.find(sample, times_s, scene.grid, scene.area_mm2)
    scene = replace(scene, volume_mm3=scene.usual_volume(sample), changed=changed)
    scene = replace(scene, sensor=read_sensor(scene, sample))
    if target.stands_on_floor and changed is None:
        found = find_transient_objects(scene, sample, times_s)
        scene = replace(scene, transient_objects=found)
    return scene, sample


def _scene_of(
    camera: Camera, stride: int, ground: BareGround, level: FloorLevel | None
) -> tuple[BackgroundSubtraction, Depths]:
    """The scene of a ground with its animal, and the ground's sample without worn devices."""
    target, sample, found = ground.scene.target, ground.scene.sample, ground.support_plane
    background, limit = ground.background_and_limit()
    scene = BackgroundSubtraction(
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


def _with_its_animal(
    scene: BackgroundSubtraction, sample: Depths, target: TargetAnimal
) -> BackgroundSubtraction:
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
        as_animal = replace(scene, area_mm2=area)
        share = share if is_like_an_animal(as_animal, sample, target) else 0.0
    if share == 0.0:
        raise EstimationError(
            f"no animal was found in {len(sample)} frames spread over the recording: nothing "
            f"between {target.smallest_mm2:.0f} and {target.largest_mm2:.0f} mm^2 stands on "
            "the floor; check the depth unit, or set animal.spine_min_mm and spine_max_mm in "
            "the plan"
        )
    return replace(scene, area_mm2=area)


def _moving_area(
    scene: BackgroundSubtraction, sample: Depths, target: TargetAnimal
) -> tuple[float, float]:
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


# The quality card of a sensor.

_N_PIXELS = 20_000  # inspected for noise and edges, spread over the image
_LEAST = 200  # fewer pixels, readings or seam pixels give no estimate
_MIDDLE = (0.25, 0.75)  # of the jump: readings there belong to neither side
_REACH_PX = 4  # largest distance of the seam from the outline


def read_sensor(scene: BackgroundSubtraction, sample: Depths) -> SensorCard:
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


def _seam(scene: BackgroundSubtraction, sample: Depths) -> float | None:
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
