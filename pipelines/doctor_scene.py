"""Scene checks of `liex doctor`: floor plane, noise, arena, water, and the animal.

The floor is a plane fitted to the learned background; noise is the 68.3 % quantile of differences
between frames over sqrt(2), which moving objects hardly affect. The animal is found by background
subtraction as in a run, or else among objects up to 20 times smaller or larger.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import EstimationError, PlanError
from liex_lab.optics.refraction import Water
from liex_lab.plan import Plan
from liex_lab.recordings.recording import Recording
from liex_lab.scene.floor import Floor, floor_patch
from liex_lab.scene.scene import find_arena
from liex_lab.scene.support_plane import find_support_plane

from .origin import animal_of, build_zones
from .regions import region_of, stated_floor, target_of

if TYPE_CHECKING:
    from liex_lab.scene.background_segmenter import BackgroundSubtraction

_LEVEL_RAD = math.radians(3.0)  # largest angle between a tank's floor and its water surface
_MUCH_UNREAD = 0.2  # share of the pixels on the floor
_MUCH_NOISE = 0.5  # of the height from which a pixel counts as the animal
_STILL_SHARE = 0.4  # of the animal's area was in the background
# sizes outside the plan's range are searched down to and up to this factor
_WIDER = 20.0

KEYS = (
    "floor_unread_share",
    "noise_mm",
    "floor_mm",
    "floor_tilt_rad",
    "water_depth_mm",
    "arena",
    "scene",
    "animal_length_mm",
    "animal_area_mm2",
    "animal_share",
    "animal_sits_still",
)


@dataclass
class SceneLook:
    """Facts and problems of the still background and the animal in a sample of frames.

    Attributes:
        seen: the recording, rectified.
        plan: expected sizes, thresholds, zones.
        water: the water surface; None if absent.
        sample: (n, H, W) float32 depth, mm, of every `stride`-th pixel.
        stride: image pixels per sample pixel, along an axis.
        facts: numbers by the names of `KEYS`; None if unknown.
        problems: sentences that state what is wrong and what to do.
    """

    seen: Recording
    plan: Plan
    water: Water | None
    sample: NDArray[np.float32]
    stride: int
    facts: dict[str, Any] = field(default_factory=lambda: dict.fromkeys(KEYS))
    problems: list[str] = field(default_factory=list)
    _floor: Floor | None = None
    _region: NDArray[np.bool_] | None = None

    def at_scene(self) -> None:
        """Inspect floor, noise, arena, water and animal; fills facts and problems."""
        from liex_lab.scene.background import sampled_scene

        grid = self.seen.camera.every(self.stride)
        try:
            region = region_of(self.seen, self.plan)
            stated = stated_floor(self.seen.camera, self.plan)
        except (PlanError, EstimationError) as error:
            self.problems.append(str(error))
            return
        if region is not None:
            self._region = region[:: self.stride, :: self.stride]
            self.sample = self.sample * self._region
        self._floor = stated
        scene = sampled_scene(self.sample, grid, target_of(self.plan))
        background = scene.background
        try:
            support_plane = find_support_plane(
                scene, None if stated is None else stated.for_camera(grid)
            )
        except EstimationError as error:
            self.problems.append(f"no floor: {error}")
            return
        if support_plane.doubt:
            self.problems.append(support_plane.doubt)
        if support_plane.region is not None:
            background = np.where(support_plane.region, background, np.float32(0))
        floor = support_plane.floor
        patch = floor_patch(background, floor.depth(grid.width, grid.height))
        noise = _noise(self.sample, patch)
        on_floor = support_plane.on_floor
        read = [frame[on_floor] > 0 for frame in self.sample if frame.any()]
        unread = 1.0 - float(np.mean(read))
        self.facts |= {"noise_mm": noise, "floor_unread_share": unread}
        arena = find_arena(background, floor, grid)
        self.facts["arena"] = arena.to_dict()
        try:
            for zone in build_zones(self.plan):
                zone.placed(
                    self.seen.camera,
                    floor.for_camera(self.seen.camera),
                    arena,
                )
        except PlanError as error:
            self.problems.append(str(error))
        if unread > _MUCH_UNREAD:
            self.problems.append(
                f"{unread:.0%} of the pixels on the floor are unread, more than "
                f"{_MUCH_UNREAD:.0%}; check the camera's range, sunlight, and surfaces that shine "
                "or swallow infrared light"
            )
        if noise is not None and noise > _MUCH_NOISE * self.plan.foreground.min_height_mm:
            self.problems.append(
                f"the floor's depth varies by {noise:.1f} mm from frame to frame, and a pixel "
                f"counts as the animal from {self.plan.foreground.min_height_mm:g} mm above it; "
                "bring the camera nearer, keep sunlight out, or raise foreground.min_height_mm"
            )
        self._at_floor(floor)
        self._at_animal(background)

    def _at_floor(self, floor: Floor) -> None:
        lift = None if self.water is None else self.water.lift_mm
        distance = floor.lens_distance_mm(lift)
        self.facts |= {"floor_mm": distance, "floor_tilt_rad": floor.tilt_rad}
        self.problems += floor.unusual(lift)
        if self.water is not None:
            self._at_water(self.water, floor, distance)

    def _at_water(self, water: Water, floor: Floor, distance: float) -> None:
        cosine = float(floor.normal @ water.normal)
        deep = distance / cosine - water.height_mm
        self.facts["water_depth_mm"] = deep
        if deep <= 0:
            self.problems.append(
                f"the plan puts the water's surface {water.height_mm:.0f} mm below the lens, but "
                "the floor is not below it; measure water.height_mm again, or leave it out if "
                "there is no water"
            )
        elif (angle := math.acos(min(1.0, cosine))) > _LEVEL_RAD:
            tilts = np.arctan2(-floor.normal[:2], floor.normal[2])
            self.problems.append(
                f"the floor is tilted by {math.degrees(angle):.1f} degrees against the water's "
                "surface; if the tank's floor is level, the camera is tilted: set "
                f"water.tilt_x_rad={tilts[0]:.3f} and water.tilt_y_rad={tilts[1]:.3f}, and look "
                "again"
            )

    def _at_animal(self, background: NDArray[np.float32]) -> None:
        """Find the animal as a run would, or else an object of another size."""
        from liex_lab.scene.background import sampled
        from liex_lab.scene.learning import learn_scene

        animal = animal_of(self.plan)
        foreground = self.plan.foreground
        memory = Recording(
            name=self.seen.name,
            format="sample",
            camera=self.seen.camera.every(self.stride),
            times_ns=self.seen.times_ns[sampled(len(self.seen), len(self.sample))],
            read=lambda k: self.sample[k],
        )
        view = Skeleton.load(animal.skeleton).view
        expected = (animal.spine_min_mm, animal.spine_max_mm)
        missing = ""
        for factor in (1.0, _WIDER):
            sizes = (expected[0] / factor, expected[1] * factor)
            try:
                scene, sample = learn_scene(
                    memory,
                    sizes,
                    len(self.sample),
                    foreground.min_height_mm,
                    view,
                    self._floor,
                    self._region,
                )
            except EstimationError as error:
                missing = missing or str(error)
                continue
            if factor == 1.0:
                self.facts["scene"] = scene.described().to_dict()
                self.problems.extend(scene.doubts)
            elif scene.support_plane is not None and not scene.support_plane.moves:
                continue  # a still object of another size is not an animal
            crops = scene.extract(sample, 1.0)
            length = 4.0 * float(np.median(crops.blobs.sd_along[crops.found]))
            if factor == 1.0:
                self._tell_animal(scene, background, length, float(crops.found.mean()))
            else:
                self.problems.append(
                    f"what moves is about {length:.0f} mm long, but the plan expects an animal "
                    f"with a spine of {expected[0]:g} to {expected[1]:g} mm; if the animal is of "
                    "that size, the millimetres are wrong by a factor of about "
                    f"{length / math.sqrt(expected[0] * expected[1]):.2g} (check unit_mm and the "
                    "focal lengths), else set animal.spine_min_mm and animal.spine_max_mm or name "
                    "another --plan"
                )
            return
        self.problems.append(missing)

    def _tell_animal(
        self,
        scene: BackgroundSubtraction,
        background: NDArray[np.float32],
        length: float,
        share: float,
    ) -> None:
        raised = scene.background - background[:: scene.stride, :: scene.stride]
        covered = (
            scene.on_floor
            & (raised > self.plan.foreground.min_height_mm)
            & (raised < scene.background)
        )
        area = float(
            (scene.background[covered].astype(float) ** 2).sum() / (scene.grid.fx * scene.grid.fy)
        )
        still = area > _STILL_SHARE * scene.area_mm2
        self.facts |= {
            "animal_length_mm": length,
            "animal_area_mm2": scene.area_mm2,
            "animal_share": share,
            "animal_sits_still": still,
        }
        if still:
            self.problems.append(
                "the animal hardly leaves its place, so that it is a part of the background; it "
                "was told from the bare floor instead, so check its outline in the replay, or add "
                "some seconds of the empty arena"
            )
        if share < 0.8:
            self.problems.append(
                f"the animal was found in only {share:.0%} of the frames looked at; cut off the "
                "time before it came and after it left, and check that the whole arena is in view"
            )


def _noise(sample: NDArray[np.float32], where: NDArray[np.bool_]) -> float | None:
    """Standard deviation, mm, of pixels over the sample (n, H, W) mm; None if unknown.

    Two thirds of the differences are below one standard deviation of theirs, whatever moves through
    the remaining third.
    """
    changes = [
        np.abs(after - before)[(before > 0) & (after > 0)]
        for before, after in zip(sample[:-1:4, where], sample[1::4, where], strict=False)
    ]
    known = np.concatenate(changes) if changes else np.empty(0)
    return float(np.percentile(known, 68.3)) / math.sqrt(2.0) if len(known) else None
