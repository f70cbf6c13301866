"""Background subtraction with a learned depth background, and choice of the animal's component.

A pixel is foreground where its reading is nearer than

    limit = background - max(min_height_mm, 3 spread),

where `background` is the farthest mode of the pixel's readings over time and `spread` the standard
deviation of that mode (see `background`); where no mode is known on the floor, the plane fitted to
the floor takes over. Segmenter pixels are joined to 8-connected components of 4 x 4 blocks; the
animal is the component whose area comes nearest to the one that recurs in the most frames, and its
height map and image moments are cut by the kernels (see `height_maps`). An animal that keeps still,
wholly or in part, and so is absorbed into the background is found by `resting`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import MOUSE_VIEW, VIEWS, View
from liex_lab.errors import EstimationError
from liex_lab.optics.camera import Camera, SensorCard
from liex_lab.recordings.recording import Recording
from liex_lab.scene.background import SPREADS as SPREADS  # models are trained with it
from liex_lab.scene.background import (
    BareGround,
    FloorLevel,
    Wanted,
    sample_frames,
    sampled,
    stride_for,
)
from liex_lab.scene.floor import Floor
from liex_lab.scene.objects import at_rest, find_put_in, is_like_an_animal, with_its_still_part
from liex_lab.scene.still_scene import SceneChange, StillScene
from liex_lab.scene.worn import Cable, HeadStage

Depths = NDArray[np.float32]

_N_PIXELS = 20_000  # looked at for noise and edges, spread over the picture
_N_FRAMES = 12  # looked at for the seam around the animal
_LEAST_READ = 0.5  # of the frames read a pixel that tells noise
_LEAST = 200  # pixels, readings or seam pixels below which nothing is told
_SAME_MM = 6.0  # or of the depth: readings this near to the background are of it
_SAME_SHARE = 0.012
_JUMP_MM = 60.0  # of depth within two pixels: an edge
_MIDDLE = (0.25, 0.75)  # of the jump: what lies there is of neither side
_REACH_PX = 4  # from the outline: the seam is looked for
_ROUND_MM = 0.05  # a finer step is none


def read_sensor(scene: StillScene, sample: Depths) -> SensorCard:
    """The card of the sensor that took a sample.

    Args:
        scene: the scene that was learned from it, with its animal's area.
        sample: (n, H, W) float32 mm, frames at the scene's stride, 0 where unread.
    """
    return SensorCard(
        _noise(scene.background, sample),
        _step(sample),
        _seam(scene, sample),
        _mixed(scene.background, sample),
    )


def _noise(background: Depths, sample: Depths) -> tuple[tuple[float, float], ...]:
    """Noise by depth: of the nearest, the middle and the farthest third of the still pixels, one of
    all where these are of one depth to a tenth.
    """
    known = np.flatnonzero(background > 0)
    known = known[:: max(1, len(known) // _N_PIXELS)]
    depth = background.ravel()[known]
    off = sample.reshape(len(sample), -1)[:, known] - depth
    still = np.abs(off) < np.maximum(_SAME_MM, _SAME_SHARE * depth)
    n = still.sum(axis=0)
    steady = n >= max(3, _LEAST_READ * len(sample))
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
    """The usual distance between neighbouring values of depth near the median one."""
    read = sample[:: max(1, len(sample) // 8)]
    read = read[read > 0]
    if len(read) < _LEAST:
        return None
    middle = float(np.median(read))
    values = np.unique(read[np.abs(read - middle) < 0.03 * middle])
    if len(values) < 3:
        return None
    gap = float(np.median(np.diff(values)))
    return round(gap, 3) if gap > _ROUND_MM else None


def _seam(scene: StillScene, sample: Depths) -> float | None:
    """How many pixels of the picture around the animal are unread, beyond those unread anyway."""
    rows = np.linspace(0, len(sample) - 1, min(_N_FRAMES, len(sample))).astype(int)
    shown = sample[rows]
    crops = scene.extract(shown, 1.0)
    unread = np.zeros(_REACH_PX)
    seen = np.zeros(_REACH_PX)
    for i, own in zip(np.flatnonzero(crops.found), scene.places(crops), strict=True):
        v, u, height, width = cv2.boundingRect(own.T.astype(np.uint8))
        cut = (
            slice(max(0, v - _REACH_PX), v + height + _REACH_PX),
            slice(max(0, u - _REACH_PX), u + width + _REACH_PX),
        )
        around = cv2.distanceTransform((~own[cut]).astype(np.uint8), cv2.DIST_C, 3)
        for k in range(_REACH_PX):
            ring = (around == k + 1) & scene.on_floor[cut]
            unread[k] += (shown[i][cut][ring] == 0).sum()
            seen[k] += ring.sum()
    if seen.min() < _LEAST:
        return None
    anyway = float((shown[:, scene.on_floor] == 0).mean())
    return round(scene.stride * float(np.clip(unread / seen - anyway, 0.0, 1.0).sum()), 2)


def _mixed(background: Depths, sample: Depths) -> float | None:
    """Of the readings at edges of the still scene, the share that lies between both sides."""
    left, right = background[:, :-2], background[:, 2:]
    edge = (left > 0) & (right > 0) & (np.abs(left - right) > _JUMP_MM)
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


Array = NDArray[np.float64]

_OTHER = 3.0  # times larger or smaller is another thing


@dataclass(frozen=True)
class BackgroundSubtraction(StillScene):
    """The empty scene of one camera as it was learned from a recording, see `StillScene`."""

    @staticmethod
    def from_floor(
        camera: Camera, floor: Floor, min_height_mm: float = 7.0
    ) -> BackgroundSubtraction:
        """A segmenter that knows nothing but the floor; the background is the bare plane.

        Args:
            camera: the ideal pinhole camera.
            floor: the floor plane in its frame.
            min_height_mm: what stands out from the floor by less is not the animal.
        """
        bare = floor.depth(camera.width, camera.height)
        limit = np.maximum(bare - np.float32(min_height_mm), 0).astype(np.float32)
        return BackgroundSubtraction(camera, floor, bare, limit, np.ones(bare.shape, np.bool_))

    @staticmethod
    def learn(
        recording: Recording,
        spine_mm: tuple[float, float],
        n_frames: int = 96,
        min_height_mm: float = 7.0,
        view: View = MOUSE_VIEW,
        floor: Floor | None = None,
        region: NDArray[np.bool_] | None = None,
    ) -> tuple[BackgroundSubtraction, NDArray[np.float32]]:
        """The background subtraction of a recording, learned from frames spread over it.

        The background of a pixel is the farthest depth that keeps coming back, which survives an
        animal that covers it most of the time; where the animal never leaves its place the floor
        plane takes over. On the rims and walls around the floor, which flicker between near and
        far, only what is nearer than the nearest usual depth counts. Where fewer than half of the
        frames show an animal, it perhaps sits in its own background: then the floor plane itself is
        tried as background, and kept if more frames show one.

        Args:
            recording: an ideal pinhole's recording, see `recordings.rectify`.
            spine_mm: lengths of the smallest and the largest animal to expect, mm.
            n_frames: frames that are sampled, at most.
            min_height_mm: what stands out from the background by less is not the animal.
            view: how such animals are looked at; one that does not stand on the floor may be
                anywhere.
            floor: the floor where it is stated; None finds it.
            region: (height, width) bool of the whole picture, where it is looked at; None
                everywhere.

        Returns:
            The segmenter, and the sample (n, H, W) float32 mm of frames from which it was learned,
            at its stride.

        Raises:
            EstimationError: no depth was read, nothing comes back often enough to be a background,
                no floor was found, or nothing of an animal's size stands on it.
        """
        wanted = Wanted(spine_mm, min_height_mm, view)
        stride = stride_for(recording, spine_mm[0])
        sample = sample_frames(recording, n_frames, stride)
        cut = None
        if region is not None:
            cut = region[::stride, ::stride]
            sample *= cut
        ground, sample, level = BareGround.steady(
            sample, recording.camera.every(stride), wanted, floor, cut
        )
        camera = recording.camera
        times_ns = recording.times_ns[sampled(len(recording), n_frames)]
        times_s = (times_ns - recording.times_ns[0]) * 1e-9
        whole = sample
        scene, sample = BackgroundSubtraction._of(camera, stride, ground, whole, level)
        if wanted.stands and floor is None and not ground.standing.moves:
            # nothing that moves has told which of two levels is the floor: what lies there does
            under = ground.under(whole, scene.places(scene.extract(sample, 1.0)))
            if under.standing is not ground.standing:
                scene, sample = BackgroundSubtraction._of(camera, stride, under, whole, level)
        changed = SceneChange.find(sample, times_s, scene.grid, scene.area_mm2)
        scene = replace(scene, volume_mm3=scene.usual_volume(sample), changed=changed)
        put_in = find_put_in(scene, sample, times_s) if wanted.stands and changed is None else ()
        return replace(scene, sensor=read_sensor(scene, sample), put_in=put_in), sample

    @staticmethod
    def _of(
        camera: Camera,
        stride: int,
        ground: BareGround,
        sample: NDArray[np.float32],
        level: FloorLevel | None,
    ) -> tuple[BackgroundSubtraction, NDArray[np.float32]]:
        """The scene of a ground with its animal, and the sample without what that wears; see
        `_empty`.
        """
        scene = BackgroundSubtraction._empty(camera, stride, ground, sample, level)
        if ground.wanted.stands:
            scene, sample = scene._without_worn(sample, ground.wanted)
        return scene._with_its_animal(sample, ground.wanted), sample

    @staticmethod
    def _empty(
        camera: Camera,
        stride: int,
        ground: BareGround,
        sample: NDArray[np.float32],
        level: FloorLevel | None,
    ) -> BackgroundSubtraction:
        """The scene of a ground, of whose animal nothing is known yet.

        Args:
            camera: the ideal pinhole camera of the recording.
            stride: of the pixels that are looked at.
            ground: what was learned of the empty scene.
            sample: (n, H, W) float32 mm, the frames that it was learned from.
            level: brings frames to one level of the floor; None where it is still.
        """
        background, limit = ground.background_and_limit(sample)
        on_floor = ground.standing.on_floor
        seen = ground.standing.floor
        return BackgroundSubtraction(
            camera,
            seen if stride == 1 else Floor.from_plane(seen.normal, seen.distance_mm, camera),
            background,
            limit,
            on_floor if ground.wanted.stands else np.ones_like(on_floor),
            view=ground.wanted.view,
            stride=stride,
            standing=ground.standing,
            level=level,
        )

    def _without_worn(
        self, sample: NDArray[np.float32], wanted: Wanted
    ) -> tuple[BackgroundSubtraction, NDArray[np.float32]]:
        """The scene and the sample (n, H, W) mm with cables and head stages cut out, themselves
        where there are none.
        """
        scene = self
        floor = self.grid_floor if self.standing is None else self.standing.floor
        grid = self.grid
        cable = Cable.find(sample, self.limit, grid, floor, wanted.spine_mm[1], wanted.smallest_mm2)
        if cable is not None:
            whole, sample = sample, cable.cut(sample, self.limit)
            scene = replace(scene, cable=cable.with_fixed(whole, sample))
        stage = HeadStage.find(sample, self.limit, grid, floor, wanted.smallest_mm2)
        if stage is not None:
            scene = replace(scene, stage=stage)
            sample = stage.cut(sample, self.limit)
        return scene, sample

    def _with_its_animal(
        self, sample: NDArray[np.float32], wanted: Wanted
    ) -> BackgroundSubtraction:
        """The scene with the usual area of its animal, and the floor under one that keeps still.

        Args:
            sample: (n, H, W) float32 mm, frames at this scene's stride.
            wanted: what animal is expected.

        Raises:
            EstimationError: nothing of an animal's size stands on the floor.
        """
        scene = self
        area, share = scene._moving_area(sample, wanted)
        moves = share >= 0.5 or (share > 0.0 and self.standing is not None and self.standing.moves)
        rests = at_rest(scene, sample, wanted, area, share)
        if rests is not None:
            scene, area, share = rests.scene, rests.area_mm2, rests.share
            moves = False
        elif wanted.stands and share >= 0.5:
            scene, area = with_its_still_part(scene, sample, wanted, area)
        # what was not seen moving is an animal only where it is as large and as high as one
        if wanted.stands and share > 0.0 and not moves:
            seen_as = replace(scene, area_mm2=area)
            share = share if is_like_an_animal(seen_as, sample, wanted) else 0.0
        if share == 0.0:
            raise EstimationError(
                f"no animal was found in {len(sample)} frames spread over the recording: nothing "
                f"between {wanted.smallest_mm2:.0f} and {wanted.largest_mm2:.0f} mm^2 stands on "
                "the floor; check the depth unit, or set animal.spine_min_mm and spine_max_mm in "
                "the plan"
            )
        return replace(scene, area_mm2=area)

    def _moving_area(self, sample: NDArray[np.float32], wanted: Wanted) -> tuple[float, float]:
        """The usual area mm^2, and the share of the frames that show it, see `usual_area`.

        Where that is not the area of what was seen moving clearly, but of specks that come back in
        more frames, as before an animal came, the area of what moves counts. What is like an animal
        is no speck, though a larger thing comes and goes beside it.
        """
        area, share = self.usual_area(sample, wanted.spine_mm)
        standing = self.standing
        if standing is None or not standing.moves or self.view.frame != VIEWS[0]:
            return area, share
        if area > 0.0 and abs(np.log(area / standing.thing_mm2)) < np.log(_OTHER):
            return area, share
        if share >= 0.5 and is_like_an_animal(replace(self, area_mm2=area), sample, wanted):
            return area, share
        crops = replace(self, area_mm2=standing.thing_mm2).extract(sample, 1.0)
        return standing.thing_mm2, float(crops.found.mean())
