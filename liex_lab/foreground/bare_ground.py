"""What sampled frames say of the empty scene: background, floor, and what is nearer than both.

A reading nearer than

    limit = background - max(min_height_mm, 3 spread)

stands out, where `background` is the farthest mode of the pixel's readings over time and `spread`
the standard deviation of that mode (see `background`). On the floor the plane takes over where no
mode is known; on the rims and walls around it, which flicker between near and far, only what is
nearer than the nearest usual depth counts.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.arena.floor import Floor, near_plane
from liex_lab.body.skeleton import VIEWS, View
from liex_lab.errors import EstimationError
from liex_lab.foreground.background import learn_background
from liex_lab.foreground.floor_level import FloorLevel, wandering
from liex_lab.foreground.standing import (
    SampledScene,
    Standing,
    find_standing,
    levelled,
    thing_at,
)
from liex_lab.foreground.unread_floor import unread_floor
from liex_lab.optics.camera import Camera

Depths = NDArray[np.float32]

SPREADS = 3.0  # an animal stands out by this many standard deviations of the background's own noise


@dataclass(frozen=True)
class Wanted:
    """What animal is looked for.

    Attributes:
        spine_mm: lengths of the smallest and the largest one, mm.
        min_height_mm: what stands out from the background by less is none.
        view: how such animals are looked at.
    """

    spine_mm: tuple[float, float]
    min_height_mm: float
    view: View

    @property
    def stands(self) -> bool:
        """Whether it stands on the floor; one that floats may be seen before anything."""
        return self.view.frame == VIEWS[0]

    @property
    def smallest_mm2(self) -> float:
        """Area of the smallest one as it is seen, mm^2."""
        return self.view.area[0] * self.spine_mm[0] ** 2

    @property
    def largest_mm2(self) -> float:
        """Area of the largest one as it is seen, mm^2."""
        return self.view.area[1] * self.spine_mm[1] ** 2


@dataclass(frozen=True)
class BareGround:
    """The empty scene without what is known of its animal.

    Attributes:
        background: (H, W) float32 mm, 0 where unknown.
        spread: (H, W) float32 mm, its standard deviation.
        near: (H, W) float32 mm, the nearest usual depth.
        standing: the floor that was found.
        camera: whose pixels these are.
        wanted: what animal is looked for.
    """

    background: Depths
    spread: Depths
    near: Depths
    standing: Standing
    camera: Camera
    wanted: Wanted

    @staticmethod
    def learn(
        sample: Depths,
        camera: Camera,
        wanted: Wanted,
        stated: Floor | None = None,
        region: NDArray[np.bool_] | None = None,
    ) -> BareGround:
        """The ground that a sample of frames shows.

        Args:
            sample: (n, H, W) float32 mm, frames spread over a recording.
            camera: whose pixels these are.
            wanted: what animal is looked for.
            stated: the floor where a person states it, in the pixels of the camera.
            region: (H, W) bool, where it is looked at; None everywhere.

        Raises:
            EstimationError: no depth was read, nothing comes back often enough, or no floor was
                found.
        """
        background, spread, near = learn_background(sample)
        _check_background(sample, background)
        seen = SampledScene(
            sample, background, spread, camera, wanted.spine_mm, wanted.min_height_mm, wanted.view
        )
        standing = find_standing(seen, stated)
        if region is not None:
            standing = replace(standing, region=region, on_floor=standing.on_floor & region)
        if standing.region is not None:  # what lies around is not looked at
            background = np.where(standing.region, background, np.float32(0))
            near = np.where(standing.region, near, np.float32(0))
        return BareGround(background, spread, near, standing, camera, wanted)

    @staticmethod
    def steady(
        sample: Depths,
        camera: Camera,
        wanted: Wanted,
        floor: Floor | None = None,
        region: NDArray[np.bool_] | None = None,
    ) -> tuple[BareGround, Depths, FloorLevel | None]:
        """The same, where the floor's depth wanders from frames brought back to its beginning.

        Args:
            sample: (n, H, W) float32 mm, frames spread over a recording.
            camera: whose pixels these are.
            wanted: what animal is looked for.
            floor: the floor where a person states it, in any camera's pixels.
            region: (H, W) bool, where it is looked at; None everywhere.

        Returns:
            The ground, the sample at one level, and what brings frames there, None where the floor
            is still.

        Raises:
            EstimationError: as `learn`.
        """
        stated = (
            None if floor is None else Floor.from_plane(floor.normal, floor.distance_mm, camera)
        )
        ground = BareGround.learn(sample, camera, wanted, stated, region)
        level = ground.level
        levels = level.of(sample) if wanted.stands else np.empty(0)
        wander = wandering(levels) if wanted.stands else None
        if wander is None:
            return ground, sample, None
        first, range_mm = wander
        sample = level.brought_back(sample, levels - first)
        ground = BareGround.learn(sample, camera, wanted, stated, region)
        return ground, sample, replace(ground.level, wander_mm=range_mm)

    def _sampled(self, sample: Depths) -> SampledScene:
        """A sample (n, H, W) mm, and what is known of the empty scene."""
        wanted = self.wanted
        return SampledScene(
            sample,
            self.background,
            self.spread,
            self.camera,
            wanted.spine_mm,
            wanted.min_height_mm,
            wanted.view,
        )

    def under(self, sample: Depths, places: list[NDArray[np.bool_]]) -> BareGround:
        """The same with the plane of the ground on which an animal keeps still, see `levelled`.

        Args:
            sample: (n, H, W) float32 mm, the frames that it was learned from.
            places: (H, W) bool each, the animal's pixels in some frames.
        """
        things = [thing_at(own, self.background, self.camera, k) for k, own in enumerate(places)]
        return replace(self, standing=levelled(self.standing, self._sampled(sample), things))

    @property
    def level(self) -> FloorLevel:
        """The level of its bare floor."""
        return FloorLevel.on(
            self.background, self.standing.on_floor & near_plane(self.background, self._bare)
        )

    @property
    def _bare(self) -> Depths:
        """Depth (H, W) mm of the floor's plane."""
        return self.standing.floor.depth(self.camera.width, self.camera.height)

    def background_and_limit(self, sample: Depths) -> tuple[Depths, Depths]:
        """The background with the floor's plane where it is unknown, and the limit before it.

        Args:
            sample: (n, H, W) float32 mm, the frames that the ground was learned from.

        Returns:
            Both (H, W) float32 mm; what is nearer than the limit stands out.
        """
        background = self.background
        spread = self.spread
        bare = self._bare
        on_floor = self.standing.on_floor
        min_height_mm = self.wanted.min_height_mm
        if self.wanted.stands:
            px_mm2 = self.standing.floor.distance_mm**2 / (self.camera.fx * self.camera.fy)
            least_px = self.wanted.smallest_mm2 / px_mm2
            dark = unread_floor(sample, background, bare, on_floor, min_height_mm, least_px)
            background = np.where(dark, np.float32(0), background)
            spread = np.where(dark, np.float32(0), spread)
        background = np.where((background == 0) & on_floor, bare, background)
        behind = np.where(on_floor, background, self.near)
        margin = np.maximum(np.float32(min_height_mm), np.float32(SPREADS) * spread)
        return background, np.maximum(behind - margin, 0).astype(np.float32)


def _check_background(sample: Depths, background: Depths) -> None:
    """Refuse a sample (n, H, W) mm of frames from which no background (H, W) mm can be learned."""
    n = len(sample)
    if not (sample > 0).any():
        raise EstimationError(
            f"no depth was read in {n} frames spread over the recording; check the camera, its "
            "range and its cable"
        )
    if not (background > 0).any():
        raise EstimationError(
            f"a background is what keeps coming back, and {n} frame{'' if n == 1 else 's'} cannot "
            "tell; record some seconds at least"
        )
