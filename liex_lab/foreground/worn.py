"""What an animal wears, such as a cable or a head stage, as one camera sees it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from liex_lab.arena.floor import Floor
from liex_lab.optics.camera import Camera


@dataclass(frozen=True)
class Worn:
    """How something that an animal wears is told from it before one camera.

    Attributes:
        camera: whose pixels are looked at.
        floor: the floor as that camera sees it.
    """

    camera: Camera
    floor: Floor

    def every(self, step: int) -> Self:
        """The same in pictures of every `step`-th row and column.

        Args:
            step: pixels from one to the next, at least 1.
        """
        camera = self.camera.every(step)
        floor = Floor.from_plane(self.floor.normal, self.floor.distance_mm, camera)
        return replace(self, camera=camera, floor=floor)

    @property
    def _px_mm(self) -> float:
        """Width of a pixel on the floor, mm."""
        return self.floor.distance_mm / float(np.sqrt(self.camera.fx * self.camera.fy))
