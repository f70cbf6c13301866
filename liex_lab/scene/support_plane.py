"""Find the plane that animals stand on among a scene's flat grounds.

Moving objects of an animal's size are segmented in the sampled frames before any floor is
estimated: pixels nearer than their own background, connected and filtered by area. The ground under
each object is the background under and around it. The largest plane (`floor.find_floor`) is the
floor if enough moving objects stand on it, otherwise the flat ground (`floor.flat_grounds`) that
supports most of them. If nothing moves, a walled ground that lies above the largest plane is used
and flagged as doubtful.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import VIEWS, CameraView
from liex_lab.errors import EstimationError
from liex_lab.optics.camera import Camera
from liex_lab.runtime.processes import side_by_side
from liex_lab.scene.floor import (
    Array,
    FlatGround,
    Floor,
    components,
    convex_hull,
    find_floor,
    fit_plane,
    flat_grounds,
    floor_region,
)
from liex_lab.scene.scene import BY_SUPPORT, LARGEST, STATED, WALLED

_AROUND_PX = 5  # radius of the ground inspected around an object
_MIN_MOVERS = 5  # fewer moving objects are no evidence
_SUPPORTED = 0.5  # share of the movers that a floor has to support
_ENCLOSED = 0.6  # share of a ground's outline that must be walled if nothing moves


@dataclass(frozen=True)
class SupportPlane:
    """The floor of a scene, and how reliable it is.

    Attributes:
        floor: the plane, in pixels of the analysed camera.
        on_floor: (H, W) bool, pixels of the floor, see `floor.floor_region`.
        region: (H, W) bool, the ground and its surroundings, if another plane than the largest is
            used; None for the full image.
        n_moving: moving objects of an animal's size in the sampled frames.
        support: their share, by volume, that stands on this floor, 0 to 1; NaN without any.
        mover_mm2: their median area from the camera, mm^2; NaN without any.
        origin: how the floor was found, see `scene.Scene.floor_from`.
        doubt: a sentence on why this floor may be wrong; empty without doubt.
    """

    floor: Floor
    on_floor: NDArray[np.bool_]
    region: NDArray[np.bool_] | None
    n_moving: int
    support: float
    mover_mm2: float = float("nan")
    origin: str = LARGEST
    doubt: str = ""

    @property
    def moves(self) -> bool:
        """Whether enough objects moved to judge the floor by them."""
        return self.n_moving >= _MIN_MOVERS


@dataclass(frozen=True)
class MovingObject:
    """A moving object in one frame, and the background around it.

    Attributes:
        rows: of the pixels around it.
        columns: of the same pixels.
        depth: of the background there, mm.
        area_mm2: of the object from the camera.
        volume_mm3: between the object and the background.
        frame: row of the sample.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    depth: Array  # of the background, mm
    area_mm2: float
    volume_mm3: float
    frame: int

    def stands_on(self, floor: Floor) -> bool:
        """Whether the ground around it lies on a plane."""
        # the ground under an object on a plane is this near to it
        return bool(abs(self.above(floor)) < 9.0)

    def above(self, floor: Floor) -> float:
        """Median height of the ground around it above a plane, mm."""
        return float(np.median(floor.heights(self.columns, self.rows, self.depth)))

    def is_on(self, floor: Floor, patch: NDArray[np.bool_]) -> bool:
        """Whether it stands on a patch (H, W) bool of a floor."""
        # of the ground around it is part of the patch
        return self.stands_on(floor) and float(patch[self.rows, self.columns].mean()) > 0.25


@dataclass(frozen=True)
class TargetAnimal:
    """Size and view of the animal to detect.

    Attributes:
        spine_mm: lengths of the smallest and the largest one, mm.
        min_height_mm: smaller heights above the background are ignored.
        view: how such animals are viewed.
    """

    spine_mm: tuple[float, float]
    min_height_mm: float
    view: CameraView

    @property
    def stands_on_floor(self) -> bool:
        """Whether it stands on the floor; a floating animal may be in front of anything."""
        return self.view.frame == VIEWS[0]

    @property
    def smallest_mm2(self) -> float:
        """Visible area of the smallest one, mm^2."""
        return self.view.area[0] * self.spine_mm[0] ** 2

    @property
    def largest_mm2(self) -> float:
        """Visible area of the largest one, mm^2."""
        return self.view.area[1] * self.spine_mm[1] ** 2


@dataclass(frozen=True)
class SampledScene:
    """Sampled frames of a recording, their background, and the expected animals.

    Attributes:
        sample: (n, H, W) float32 mm, the frames, 0 where unread.
        background: (H, W) float32 mm, 0 where unknown.
        spread: (H, W) float32 mm, its standard deviation.
        near: (H, W) float32 mm, the nearest usual depth.
        camera: of these pixels, free of lens distortion.
        target: the animals.
    """

    sample: NDArray[np.float32]
    background: NDArray[np.float32]
    spread: NDArray[np.float32]
    near: NDArray[np.float32]
    camera: Camera
    target: TargetAnimal

    @property
    def least_ground_mm2(self) -> float:
        """Area of the smallest ground that such an animal can stand on, mm^2."""
        return 4.0 * self.target.smallest_mm2


def find_support_plane(scene: SampledScene, stated: Floor | None = None) -> SupportPlane:
    """Find the floor that the moving objects stand on.

    Args:
        scene: sampled frames and their background.
        stated: the floor stated in the plan, in pixels of the camera; None to estimate it.

    Raises:
        EstimationError: nothing flat faces the camera, too few pixels are readable, or nothing
            stands on the stated floor.
    """
    movers = find_movers(scene)
    support_plane = (
        levelled(_choose(scene, movers), scene, movers)
        if stated is None
        else _as_stated(stated, scene.background, scene.camera, movers)
    )
    if not movers:
        return support_plane
    return replace(support_plane, mover_mm2=float(np.median([mover.area_mm2 for mover in movers])))


def still_object(
    place: NDArray[np.bool_], background: NDArray[np.float32], camera: Camera, frame: int
) -> MovingObject:
    """An object at rest, whose own depth is part of the background.

    Args:
        place: (H, W) bool, its pixels; the ground is taken from around them.
        background: (H, W) float32 mm, 0 where unknown.
        camera: of these pixels.
        frame: row of the sample.
    """
    own = place.astype(np.uint8)
    outer = np.ones((4 * _AROUND_PX + 1,) * 2, np.uint8)
    inner = np.ones((2 * _AROUND_PX + 1,) * 2, np.uint8)  # the blurred edge is not ground
    near = (cv2.dilate(own, outer) > cv2.dilate(own, inner)) & (background > 0)
    rows, columns = np.nonzero(near)
    mm2 = float((background[place].astype(float) ** 2).sum()) / (camera.fx * camera.fy)
    return MovingObject(rows, columns, background[near].astype(float), mm2, 0.0, frame)


def find_movers(scene: SampledScene) -> list[MovingObject]:
    """Moving objects of an animal's size.

    The largest few of each frame, without those much smaller than the usual largest one.
    """
    limit = scene.background - np.maximum(
        np.float32(scene.target.min_height_mm), 3.0 * scene.spread
    )

    def inspect(frame: int) -> list[MovingObject]:
        """Objects of one frame, the largest first."""
        return sorted(_of_frame(scene, frame, limit), key=lambda mover: -mover.volume_mm3)

    found = side_by_side(inspect, range(len(scene.sample)))
    largest = [movers[0].volume_mm3 for movers in found if movers]
    # smaller ones are something else
    least = (1.0 / 3.0) * float(np.median(largest)) if largest else 0.0
    return [mover for movers in found for mover in movers[:3] if mover.volume_mm3 >= least]


def _choose(scene: SampledScene, movers: list[MovingObject]) -> SupportPlane:
    """The largest plane, or another sufficiently large ground that supports more of the movers."""
    background, camera = scene.background, scene.camera
    largest, refusal = None, None
    try:
        floor = find_floor(background, camera)
        on_floor = floor_region(background, floor.depth(camera.width, camera.height))
        support = _share(movers, [mover.is_on(floor, on_floor) for mover in movers])
        largest = SupportPlane(floor, on_floor, None, len(movers), support)
    except EstimationError as error:
        if camera.distortion is not None or (background > 0).sum() < 500:
            raise  # no other ground can be found either
        refusal = error
    moves = len(movers) >= _MIN_MOVERS
    if largest is not None and moves and largest.support >= _SUPPORTED:
        return largest
    least_mm2 = scene.least_ground_mm2
    if moves:  # the flat back of an animal at rest is no ground
        largest_mm2 = float(np.percentile([mover.area_mm2 for mover in movers], 90))
        # it may move only its head
        usual_mm2 = float(np.sqrt(scene.target.smallest_mm2 * scene.target.largest_mm2))
        # an animal's ground is at least three times its area
        least_mm2 = max(least_mm2, 3.0 * max(largest_mm2, usual_mm2))
    grounds = flat_grounds(background, camera, least_mm2)
    if moves:
        chosen = _best_supported(grounds, movers, largest.support if largest else 0.0)
    else:
        chosen = _enclosed(grounds, largest.floor if largest else None)
    if chosen is not None:
        ground, support, doubt = chosen
        # include animals that lean over the edge
        reach = scene.target.spine_mm[1] * np.sqrt(camera.fx * camera.fy) / ground.floor.distance_mm
        on_floor = convex_hull(ground.patch)
        region = ground.region(float(reach))
        return SupportPlane(
            ground.floor,
            on_floor,
            region,
            len(movers),
            support,
            origin=WALLED if doubt else BY_SUPPORT,
            doubt=doubt,
        )
    if refusal is not None:
        raise refusal
    assert largest is not None
    if not moves:
        return replace(largest, support=float("nan"))
    doubt = (
        f"only {largest.support:.0%} of the moving objects stand on the detected floor, the "
        "largest plane, and no other ground is better; state arena.floor in the plan"
    )
    return replace(largest, doubt=doubt)


def levelled(
    support_plane: SupportPlane, scene: SampledScene, movers: list[MovingObject]
) -> SupportPlane:
    """Fit the plane to the ground under the movers only, if a step separates it from the rest.

    An arena's floor is often a few millimetres higher than the bench below it, and a plane fitted
    to both runs between them.

    Args:
        support_plane: the floor as found.
        scene: sampled frames and their background.
        movers: objects, moving or at rest, that may stand on it.
    """
    floor = support_plane.floor
    on = [mover for mover in movers if mover.is_on(floor, support_plane.on_floor)]
    if not scene.target.stands_on_floor or len(on) < _MIN_MOVERS:
        return support_plane
    step_mm = float(np.median([mover.above(floor) for mover in on]))
    if abs(step_mm) < 2.5:  # a plane fitted across a step matches neither side
        return support_plane
    camera = scene.camera
    own = Floor.from_plane(floor.normal, floor.distance_mm - step_mm, camera)
    for _ in range(4):
        bare = own.depth(camera.width, camera.height)
        ground = support_plane.on_floor & (scene.background > 0)
        ground &= np.abs(scene.background - bare) < 3.0
        if (scene.background[ground] ** 2).sum() < scene.least_ground_mm2 * camera.fx * camera.fy:
            return support_plane
        own = fit_plane(scene.background, ground, camera)
    left = np.median([abs(mover.above(own)) for mover in on])
    if left > 1.5:  # still uneven
        return support_plane
    on_floor = floor_region(scene.background, own.depth(camera.width, camera.height))
    return replace(support_plane, floor=own, on_floor=on_floor)


def _as_stated(
    floor: Floor, background: NDArray[np.float32], camera: Camera, movers: list[MovingObject]
) -> SupportPlane:
    """The floor that the plan states.

    Raises:
        EstimationError: the movers do not stand on it, or none of it is visible.
    """
    on_floor = floor_region(background, floor.depth(camera.width, camera.height))
    support = _share(movers, [mover.stands_on(floor) for mover in movers])
    # a stated floor that supports less is wrong
    if not on_floor.any() or (len(movers) >= _MIN_MOVERS and support < 0.1):
        raise EstimationError(
            f"nothing stands on the floor stated by arena.floor, {floor.distance_mm:.0f} mm from "
            "the camera; correct its point and normal, or set arena.floor to 'auto'"
        )
    measured = support if len(movers) >= _MIN_MOVERS else float("nan")
    return SupportPlane(floor, on_floor, None, len(movers), measured, origin=STATED)


def _of_frame(
    scene: SampledScene, frame: int, limit: NDArray[np.float32]
) -> Iterator[MovingObject]:
    """Objects of an animal's area in one frame that are nearer than the limit (H, W) mm."""
    depth, background, camera = scene.sample[frame], scene.background, scene.camera
    around = np.ones((2 * _AROUND_PX + 1, 2 * _AROUND_PX + 1), np.uint8)
    square = np.ones((3, 3), np.uint8)
    nearer = ((depth > 0) & (depth < limit)).astype(np.uint8)
    nearer |= cv2.dilate(nearer, square) & (depth == 0)  # holes in it are bridged
    labels, stats = components(
        np.asarray(cv2.morphologyEx(nearer, cv2.MORPH_OPEN, square), np.uint8)
    )
    for k in range(1, len(stats)):
        u, v, width, height, n_px = stats[k]
        if n_px < 9:
            continue
        cut = (
            slice(max(0, v - _AROUND_PX), v + height + _AROUND_PX),
            slice(max(0, u - _AROUND_PX), u + width + _AROUND_PX),
        )
        whole = labels[cut] == k
        own = whole & (depth[cut] > 0) & (background[cut] > 0)
        mm2 = depth[cut][own].astype(float) ** 2 / (camera.fx * camera.fy)
        if not scene.target.smallest_mm2 < float(mm2.sum()) < scene.target.largest_mm2:
            continue
        rise = (background[cut][own] - depth[cut][own]).astype(float)
        if float(np.median(rise / (background[cut][own] - limit[cut][own]))) < 1.5:
            continue  # noise of distant surfaces rises little, an animal much
        near = (cv2.dilate(whole.astype(np.uint8), around) > 0) & (background[cut] > 0)
        rows, columns = np.nonzero(near)
        yield MovingObject(
            rows + cut[0].start,
            columns + cut[1].start,
            background[cut][near].astype(float),
            float(mm2.sum()),
            float((mm2 * rise).sum()),
            frame,
        )


def _share(movers: list[MovingObject], chosen: list[bool]) -> float:
    """The share of the movers, by volume, that is selected; 0 without movers."""
    volume = np.array([mover.volume_mm3 for mover in movers])
    return float(volume[np.array(chosen)].sum() / volume.sum()) if movers else 0.0


def _best_supported(
    grounds: list[FlatGround], movers: list[MovingObject], least: float
) -> tuple[FlatGround, float, str] | None:
    """The ground that supports the most movers, its share of them, and no doubt; None if none is
    clearly better than `least`.
    """
    best, most = None, min(least + 0.2, _SUPPORTED)  # another ground has to support clearly more
    for ground in grounds:
        share = _share(movers, [mover.is_on(ground.floor, ground.patch) for mover in movers])
        if share > most:
            best, most = ground, share
    return None if best is None else (best, most, "")


def _enclosed(
    grounds: list[FlatGround], largest: Floor | None
) -> tuple[FlatGround, float, str] | None:
    """If nothing moves: the largest walled ground that is not below the largest plane."""
    for ground in sorted(grounds, key=lambda ground: -int(ground.patch.sum())):
        if ground.enclosed < _ENCLOSED:
            continue
        rows, columns = np.nonzero(ground.patch)
        depth = 1.0 / np.maximum(ground.floor.inverse_at(columns, rows), 1e-9)
        if largest is not None and (np.median(largest.heights(columns, rows, depth)) <= 30.0):
            return None  # walls enclose the largest plane itself
        doubt = (
            "no object of an animal's size moved, so the largest walled ground is used as the "
            "floor; check it in the replay, or state arena.floor in the plan"
        )
        return ground, float("nan"), doubt
    return None


# Multiple arenas in one image: separates the grounds on which different animals move.


_MOST = 8
_LEAST_MOVERS = 3  # moving objects on a ground
_ALIKE = 2.0  # largest ratio of areas for a ground without movement
_APART_PX = 2.0  # between two regions at least
_SMOOTH_PX = 1.5  # by which a polygon may leave its region


def arenas_apart(scene: SampledScene) -> list[list[tuple[int, int]]]:
    """The outlines of multiple arenas.

    Args:
        scene: sampled frames and their background.

    Returns:
        (u, v) corners of each, pixels of the scene's camera, row by row from the top left; [] for
        fewer than two or more than eight.
    """
    camera = scene.camera
    movers = find_movers(scene)
    supporting: list[FlatGround] = []
    others: list[FlatGround] = []
    for ground in flat_grounds(scene.background, camera, scene.least_ground_mm2):
        n = sum(mover.is_on(ground.floor, ground.patch) for mover in movers)
        (supporting if n >= _LEAST_MOVERS else others).append(ground)
    supporting = _one_each(supporting)
    if supporting:
        usual = float(np.median([ground.patch.sum() for ground in supporting]))
        asleep = [
            ground
            for ground in others
            if ground.enclosed >= _ENCLOSED and usual / _ALIKE < ground.patch.sum() < usual * _ALIKE
        ]
        supporting = _one_each([*supporting, *asleep])
    if not 2 <= len(supporting) <= _MOST:
        return []
    reach = [
        scene.target.spine_mm[1] * float(np.sqrt(camera.fx * camera.fy)) / ground.floor.distance_mm
        for ground in supporting
    ]
    return _outlines(supporting, reach)


def _one_each(grounds: list[FlatGround]) -> list[FlatGround]:
    """The grounds, without those that overlap the hull of an earlier one."""
    kept: list[FlatGround] = []
    for ground in grounds:
        rows, columns = np.nonzero(ground.patch)
        middle = (int(np.median(rows)), int(np.median(columns)))
        hull = convex_hull(ground.patch)
        others = [convex_hull(one.patch) for one in kept]
        if not any(other[middle] or (hull & other).sum() > 0.2 * hull.sum() for other in others):
            kept.append(ground)
    return kept


def _outlines(grounds: list[FlatGround], reach_px: list[float]) -> list[list[tuple[int, int]]]:
    """The polygons of the Voronoi cells around the grounds, within the reach of each, px."""
    away = np.stack(
        [
            cv2.distanceTransform(1 - convex_hull(ground.patch).astype(np.uint8), cv2.DIST_L2, 5)
            for ground in grounds
        ]
    )
    found = []
    for k, reach in enumerate(reach_px):
        nearest_other = np.delete(away, k, axis=0).min(axis=0)
        margin = _APART_PX + 2.0 * _SMOOTH_PX
        cell = ((away[k] <= reach) & (away[k] + margin < nearest_other)).astype(np.uint8)
        outlines, _ = cv2.findContours(cell, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        largest = max(outlines, key=cv2.contourArea)
        corners = cv2.approxPolyDP(largest, _SMOOTH_PX, True)[:, 0]
        found.append([(int(u), int(v)) for u, v in corners])
    return _in_reading_order(found)


def _in_reading_order(outlines: list[list[tuple[int, int]]]) -> list[list[tuple[int, int]]]:
    """Row by row from the top, within a row from the left."""
    middles = [np.mean(corners, axis=0) for corners in outlines]
    heights = [np.ptp(np.array(corners)[:, 1]) for corners in outlines]
    row_px = 0.5 * float(np.median(heights)) if heights else 1.0
    order = sorted(range(len(outlines)), key=lambda k: float(middles[k][1]))
    rows: list[list[int]] = []
    for k in order:
        if rows and middles[k][1] - middles[rows[-1][0]][1] < row_px:
            rows[-1].append(k)
        else:
            rows.append([k])
    return [outlines[k] for row in rows for k in sorted(row, key=lambda k: float(middles[k][0]))]
