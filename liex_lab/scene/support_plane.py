"""Where animals stand: which of a scene's flat grounds is the floor, by what moves on them.

Things of an animal's size that move are cut out of the sampled frames before any floor is known:
pixels nearer than their own background, joined and kept by their area. Each stands on the ground
that lies at its depth where it is not: the background under and around it. The largest plane
(`arena.floor.find_floor`) stands as long as what moves stands on it, too; else that of the grounds
(`arena.grounds`) on which the most of it does. Where nothing moves, a ground that walls enclose
and that lies above the largest plane is taken, and said to be in doubt.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import VIEWS, View
from liex_lab.errors import EstimationError
from liex_lab.optics.camera import Camera
from liex_lab.runtime.threads import side_by_side
from liex_lab.scene.floor import Floor, Ground, find_floor, fit_plane, flat_grounds, floor_region
from liex_lab.scene.scene import LARGEST, STATED, STOOD_ON, WALLED
from liex_lab.scene.worn import components

Array = NDArray[np.float64]

_AROUND_PX = 5  # the ground around a thing is looked at so far from it
_ON_MM = 9.0  # what stands on a ground has it this near beneath, in the middle of what is read
_ON_SHARE = 0.25  # and so much of that must be a part of it
_MIN_THINGS = 5  # that must be seen moving before they say anything
_SUPPORTED = 0.5  # of the things that move must stand on a floor
_UNSUPPORTED = 0.1  # a floor that is stated is wrong where less stands on it
_BETTER = 0.2  # by which another ground must be supported more
_ENCLOSED = 0.6  # of a ground's outline must rise, where nothing moves
_RAISED_MM = 30.0  # and it must lie so far above the largest plane
_CLEARLY = 1.5  # times the least height by which an animal stands out is not noise
_LEAST_PX = 9
_A_FRAME = 3  # things of a frame, the largest
# the plane of a floor and of what lies a step beside it is neither's: where the ground under what
# moves lies so far from the plane, the plane is fitted to that ground alone
_STEP_MM = 2.5
_LEVEL_MM = 3.0  # so near to it is that ground
_EVEN_MM = 1.5  # and so near must what moves then stand
_ROUNDS = 4
_ROOM = 3.0  # times the area of an animal: a ground that it moves about on is larger
_SMALLER = 1.0 / 3.0  # of the usual volume of the largest: less is another thing


@dataclass(frozen=True)
class Standing:
    """The floor of a scene, and how well it is known.

    Attributes:
        floor: the plane, in the camera whose pixels were looked at.
        on_floor: (H, W) bool, where it lies in the picture, see `arena.floor.floor_region`.
        region: (H, W) bool, the ground and what lies around it, where it is not the largest plane
            that stands; None where the whole picture is looked at.
        n_things: things of an animal's size that were seen moving in the sampled frames.
        support: share of them, by volume, that stand on this floor, 0 to 1; NaN where none were
            seen.
        thing_mm2: their median area seen from the camera, mm^2; NaN where none were seen.
        n_together: how many of them move in one frame, the most that a fifth of those frames show.
        origin: how the floor was found, see `arena.scene.Scene.floor_from`.
        doubt: a sentence about why this floor may be wrong, empty where there is none.
    """

    floor: Floor
    on_floor: NDArray[np.bool_]
    region: NDArray[np.bool_] | None
    n_things: int
    support: float
    thing_mm2: float = float("nan")
    n_together: int = 0
    origin: str = LARGEST
    doubt: str = ""

    @property
    def moves(self) -> bool:
        """Whether enough was seen moving to say anything about it."""
        return self.n_things >= _MIN_THINGS


@dataclass(frozen=True)
class Thing:
    """One thing that moves: where its ground is looked for, and what lies there.

    Attributes:
        rows: of the pixels around it.
        columns: of the same.
        depth: of the background there, mm.
        area_mm2: of the thing seen from the camera.
        volume_mm3: between it and the background.
        frame: of the sample, in which it is seen.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    depth: Array  # of the background, mm
    area_mm2: float
    volume_mm3: float
    frame: int

    def stands_on(self, floor: Floor) -> bool:
        """Whether the ground around it lies on a plane.

        Args:
            floor: the plane.
        """
        return bool(abs(self.above(floor)) < _ON_MM)

    def above(self, floor: Floor) -> float:
        """Height of the ground around it above a plane, mm, the median.

        Args:
            floor: the plane.
        """
        a, b, c = floor.inverse_depth
        inverse = a * self.columns + b * self.rows + c
        return float(np.median(floor.distance_mm * (1.0 - self.depth * inverse)))

    def share_on(self, patch: NDArray[np.bool_]) -> float:
        """Share of the ground around it that is a part of a patch (H, W) bool.

        Args:
            patch: where it lies in the picture.
        """
        return float(patch[self.rows, self.columns].mean())

    def is_on(self, floor: Floor, patch: NDArray[np.bool_]) -> bool:
        """Whether it stands on a patch (H, W) bool of a floor.

        Args:
            floor: the plane.
            patch: where it lies in the picture.
        """
        return self.stands_on(floor) and self.share_on(patch) > _ON_SHARE


@dataclass(frozen=True)
class SampledScene:
    """Frames spread over a recording, what they say of the empty scene, and what is looked for.

    Attributes:
        sample: (n, H, W) float32 mm, the frames, 0 where unread.
        background: (H, W) float32 mm, 0 where unknown.
        spread: (H, W) float32 mm, its standard deviation.
        camera: whose pixels these are, free of lens distortion.
        spine_mm: lengths of the smallest and the largest animal to expect, mm.
        min_height_mm: what stands out from the background by less does not count.
        view: how such animals are looked at.
    """

    sample: NDArray[np.float32]
    background: NDArray[np.float32]
    spread: NDArray[np.float32]
    camera: Camera
    spine_mm: tuple[float, float]
    min_height_mm: float
    view: View

    @property
    def areas_mm2(self) -> tuple[float, float]:
        """Areas of the smallest and the largest animal as they are seen, mm^2."""
        low, high = self.view.area
        return low * self.spine_mm[0] ** 2, high * self.spine_mm[1] ** 2

    @property
    def least_ground_mm2(self) -> float:
        """Area of the smallest ground that such an animal can stand on, mm^2."""
        return 4.0 * self.areas_mm2[0]


def find_standing(scene: SampledScene, stated: Floor | None = None) -> Standing:
    """The floor on which what moves stands.

    Args:
        scene: sampled frames and their background.
        stated: the floor where a person states it, in the pixels of the camera; None finds it.

    Returns:
        The floor, and how well it is known.

    Raises:
        EstimationError: nothing flat faces the camera, too little of the picture is readable, or
            nothing stands on the floor that is stated.
    """
    things = things_moving(scene)
    standing = (
        levelled(_choose(scene, things), scene, things)
        if stated is None
        else _as_stated(stated, scene.background, scene.camera, things)
    )
    if not things:
        return standing
    n_together = np.unique([thing.frame for thing in things], return_counts=True)[1]
    return replace(
        standing,
        thing_mm2=float(np.median([thing.area_mm2 for thing in things])),
        n_together=int(np.percentile(n_together, 80, method="lower")),
    )


def thing_at(
    place: NDArray[np.bool_], background: NDArray[np.float32], camera: Camera, frame: int
) -> Thing:
    """A thing that keeps still, whose own depth is in the background.

    Args:
        place: (H, W) bool, its pixels; the ground around them is what it stands on.
        background: (H, W) float32 mm, 0 where unknown.
        camera: whose pixels these are.
        frame: of the sample, in which it is seen.
    """
    import cv2

    own = place.astype(np.uint8)
    outer = np.ones((4 * _AROUND_PX + 1,) * 2, np.uint8)
    inner = np.ones((2 * _AROUND_PX + 1,) * 2, np.uint8)  # its blurred edge is not ground
    near = (cv2.dilate(own, outer) > cv2.dilate(own, inner)) & (background > 0)
    rows, columns = np.nonzero(near)
    mm2 = float((background[place].astype(float) ** 2).sum()) / (camera.fx * camera.fy)
    return Thing(rows, columns, background[near].astype(float), mm2, 0.0, frame)


def things_moving(scene: SampledScene) -> list[Thing]:
    """Things of an animal's size that move, at most three of each frame; see `find_standing`.

    Args:
        scene: sampled frames and their background.
    """
    margin = np.maximum(np.float32(scene.min_height_mm), 3.0 * scene.spread)
    limit = scene.background - margin
    return _moving(scene.sample, scene.background, limit, scene.camera, scene.areas_mm2)


def _choose(scene: SampledScene, things: list[Thing]) -> Standing:
    """The largest plane, or another ground of a size to stand on where that is better."""
    background = scene.background
    camera = scene.camera
    largest = _largest(background, camera, things)
    if (
        isinstance(largest, Standing)
        and largest.support >= _SUPPORTED
        and len(things) >= _MIN_THINGS
    ):
        return largest
    least_mm2 = scene.least_ground_mm2
    if len(things) >= _MIN_THINGS:  # the back of one that keeps still is flat, and no ground
        moving_mm2 = float(np.percentile([thing.area_mm2 for thing in things], 90))
        usual_mm2 = float(np.sqrt(np.prod(scene.areas_mm2)))  # perhaps it moves only its head
        least_mm2 = max(least_mm2, _ROOM * max(moving_mm2, usual_mm2))
    grounds = flat_grounds(background, camera, least_mm2)
    if len(things) >= _MIN_THINGS:
        least = largest.support if isinstance(largest, Standing) else 0.0
        chosen = _stood_on(grounds, things, least)
    else:
        chosen = _enclosed(grounds, largest.floor if isinstance(largest, Standing) else None)
    if chosen is not None:
        ground, support, doubt = chosen
        # an animal that leans over the edge is still looked at
        reach = scene.spine_mm[1] * np.sqrt(camera.fx * camera.fy) / ground.floor.distance_mm
        on_floor = ground.region(0.0)
        region = ground.region(float(reach))
        origin = WALLED if doubt else STOOD_ON
        return Standing(
            ground.floor, on_floor, region, len(things), support, origin=origin, doubt=doubt
        )
    if isinstance(largest, EstimationError):
        raise largest
    if len(things) < _MIN_THINGS:
        return replace(largest, support=float("nan"))
    doubt = (
        f"only {largest.support:.0%} of what moves stands on the floor that was found, the largest "
        "plane, and no other ground is better; state arena.floor in the plan"
    )
    return replace(largest, doubt=doubt)


def levelled(standing: Standing, scene: SampledScene, things: list[Thing]) -> Standing:
    """The same with the plane of the ground that things stand on, where a step parts it from more.

    An arena's floor is often a few millimetres higher than the bench that it lies on, and a plane
    that is fitted to both runs between them.

    Args:
        standing: the floor as it was found.
        scene: sampled frames and their background.
        things: what moves, or keeps still, on it.
    """
    floor = standing.floor
    on = [thing for thing in things if thing.is_on(floor, standing.on_floor)]
    if scene.view.frame != VIEWS[0] or len(on) < _MIN_THINGS:
        return standing
    step_mm = float(np.median([thing.above(floor) for thing in on]))
    if abs(step_mm) < _STEP_MM:
        return standing
    camera = scene.camera
    own = Floor.from_plane(floor.normal, floor.distance_mm - step_mm, camera)
    for _ in range(_ROUNDS):
        bare = own.depth(camera.width, camera.height)
        ground = standing.on_floor & (scene.background > 0)
        ground &= np.abs(scene.background - bare) < _LEVEL_MM
        if (scene.background[ground] ** 2).sum() < scene.least_ground_mm2 * camera.fx * camera.fy:
            return standing
        own = fit_plane(scene.background, ground, camera)
    left = np.median([abs(thing.above(own)) for thing in on])
    if left > _EVEN_MM:
        return standing
    on_floor = floor_region(scene.background, own.depth(camera.width, camera.height))
    return replace(standing, floor=own, on_floor=on_floor)


def _as_stated(
    floor: Floor, background: NDArray[np.float32], camera: Camera, things: list[Thing]
) -> Standing:
    """The floor that a person states.

    Raises:
        EstimationError: what moves does not stand on it, or nothing of it is seen.
    """
    bare = floor.depth(camera.width, camera.height)
    on_floor = floor_region(background, bare)
    support = _share(things, [thing.stands_on(floor) for thing in things])
    if not on_floor.any() or (len(things) >= _MIN_THINGS and support < _UNSUPPORTED):
        raise EstimationError(
            f"nothing stands on the floor that arena.floor states, {floor.distance_mm:.0f} mm from "
            "the camera; correct its point and normal, or set arena.floor to 'auto'"
        )
    known = support if len(things) >= _MIN_THINGS else float("nan")
    return Standing(floor, on_floor, None, len(things), known, origin=STATED)


def _largest(
    background: NDArray[np.float32], camera: Camera, things: list[Thing]
) -> Standing | EstimationError:
    """The largest plane as the floor, or why it is none.

    Raises:
        EstimationError: no ground can be found in such a picture.
    """
    try:
        floor = find_floor(background, camera)
    except EstimationError as error:
        if camera.distortion is not None or (background > 0).sum() < 500:
            raise
        return error
    on_floor = floor_region(background, floor.depth(camera.width, camera.height))
    on = [thing.is_on(floor, on_floor) for thing in things]
    return Standing(floor, on_floor, None, len(things), _share(things, on))


def _moving(
    sample: NDArray[np.float32],
    background: NDArray[np.float32],
    limit: NDArray[np.float32],
    camera: Camera,
    areas: tuple[float, float],
) -> list[Thing]:
    """Things of an animal's area mm^2 in the frames (n, H, W), nearer than the limit (H, W).

    The largest few of each frame; of them, those that are not much smaller than the usual largest.
    """

    def look(frame: int) -> list[Thing]:
        """Those of a frame, the largest first."""
        things = _of_frame(sample, frame, background, limit, camera, areas)
        return sorted(things, key=lambda thing: -thing.volume_mm3)

    found = []
    largest = []
    for things in side_by_side(look, range(len(sample))):
        found += things[:_A_FRAME]
        largest += [thing.volume_mm3 for thing in things[:1]]
    least = _SMALLER * float(np.median(largest)) if largest else 0.0
    return [thing for thing in found if thing.volume_mm3 >= least]


def _of_frame(
    sample: NDArray[np.float32],
    frame: int,
    background: NDArray[np.float32],
    limit: NDArray[np.float32],
    camera: Camera,
    areas: tuple[float, float],
) -> Iterator[Thing]:
    """All such things of one frame."""
    import cv2

    depth = sample[frame]
    around = np.ones((2 * _AROUND_PX + 1, 2 * _AROUND_PX + 1), np.uint8)
    square = np.ones((3, 3), np.uint8)
    nearer = ((depth > 0) & (depth < limit)).astype(np.uint8)
    nearer |= cv2.dilate(nearer, square) & (depth == 0)  # holes in it are bridged
    labels, stats = components(
        np.asarray(cv2.morphologyEx(nearer, cv2.MORPH_OPEN, square), np.uint8)
    )
    for k in range(1, len(stats)):
        u, v, width, height, n_px = stats[k]
        if n_px < _LEAST_PX:
            continue
        cut = (
            slice(max(0, v - _AROUND_PX), v + height + _AROUND_PX),
            slice(max(0, u - _AROUND_PX), u + width + _AROUND_PX),
        )
        whole = labels[cut] == k
        own = whole & (depth[cut] > 0) & (background[cut] > 0)
        mm2 = depth[cut][own].astype(float) ** 2 / (camera.fx * camera.fy)
        if not areas[0] < float(mm2.sum()) < areas[1]:
            continue
        rise = (background[cut][own] - depth[cut][own]).astype(float)
        if float(np.median(rise / (background[cut][own] - limit[cut][own]))) < _CLEARLY:
            continue  # noise of what is far away stands out a little, an animal a lot
        near = (cv2.dilate(whole.astype(np.uint8), around) > 0) & (background[cut] > 0)
        rows, columns = np.nonzero(near)
        behind = background[cut][near].astype(float)
        yield Thing(
            rows + cut[0].start,
            columns + cut[1].start,
            behind,
            float(mm2.sum()),
            float((mm2 * rise).sum()),
            frame,
        )


def _share(things: list[Thing], chosen: list[bool]) -> float:
    """The share, by volume, of the things that were chosen; 0 where there are none."""
    volume = np.array([thing.volume_mm3 for thing in things])
    return float(volume[np.array(chosen)].sum() / volume.sum()) if things else 0.0


def _stood_on(
    grounds: list[Ground], things: list[Thing], least: float
) -> tuple[Ground, float, str] | None:
    """The ground that the most things stand on, its share of them, and no doubt; None where none
    is better than what there is.
    """
    best = None
    most = min(least + _BETTER, _SUPPORTED)
    for ground in grounds:
        on = [thing.is_on(ground.floor, ground.patch) for thing in things]
        share = _share(things, on)
        if share > most:
            best = ground
            most = share
    return None if best is None else (best, most, "")


def _enclosed(grounds: list[Ground], largest: Floor | None) -> tuple[Ground, float, str] | None:
    """Where nothing moves: the largest ground that walls enclose and that does not lie lower."""
    for ground in sorted(grounds, key=lambda ground: -int(ground.patch.sum())):
        if ground.enclosed < _ENCLOSED:
            continue
        if largest is not None and not _is_raised(ground, largest):
            return None  # walls enclose the largest plane itself
        doubt = (
            "nothing of an animal's size was seen moving, so the floor is taken to be the largest "
            "ground that walls enclose; check it in the replay, or state arena.floor in the plan"
        )
        return ground, float("nan"), doubt
    return None


def _is_raised(ground: Ground, floor: Floor) -> bool:
    """Whether a ground lies clearly above a plane."""
    rows, columns = np.nonzero(ground.patch)
    a, b, c = floor.inverse_depth
    own = ground.floor.inverse_depth
    depth = 1.0 / np.maximum(own[0] * columns + own[1] * rows + own[2], 1e-9)
    above = floor.distance_mm * (1.0 - depth * (a * columns + b * rows + c))
    return bool(np.median(above) > _RAISED_MM)
