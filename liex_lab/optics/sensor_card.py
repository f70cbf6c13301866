"""What a recording says of its depth sensor: noise, steps, edges that are not read, mixed pixels.

It is measured by `foreground.sensor_reading`, written to session.json (`scene.sensor`) and printed
by `liex doctor`. How deep light goes into fur or wet skin cannot be told from a recording without
its truth.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

_NONE_MM = 0.05  # no sensor is so quiet


@dataclass(frozen=True)
class SensorCard:
    """The depth sensor of one recording.

    Attributes:
        noise: (depth mm, standard deviation mm) from near to far, () where nothing keeps still.
        step_mm: to which depth is rounded at the usual distance; None where no step shows.
        seam_px: width of what is not read around the animal, pixels; None without an animal.
        mixed_share: of readings at still edges, those that lie between both sides ("flying
            pixels"), 0 to 1; None without such edges.
    """

    noise: tuple[tuple[float, float], ...] = ()
    step_mm: float | None = None
    seam_px: float | None = None
    mixed_share: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """For session.json; lengths in mm and pixels."""
        return asdict(self) | {"noise": [list(one) for one in self.noise]}

    @staticmethod
    def from_dict(known: dict[str, Any]) -> SensorCard:
        """The card that `to_dict` wrote.

        Args:
            known: section `scene.sensor` of session.json.
        """
        noise = tuple((float(depth), float(sd)) for depth, sd in known["noise"])
        return SensorCard(noise, known["step_mm"], known["seam_px"], known["mixed_share"])

    def __str__(self) -> str:
        """A line for a person."""
        noise = ", ".join(f"{sd:.1f} mm at {depth / 1000:.2f} m" for depth, sd in self.noise)
        if self.noise and max(sd for _, sd in self.noise) < _NONE_MM:
            noise = "none, as of pictures that were filtered or put together"
        parts = [f"noise {noise or 'unknown'}"]
        if self.step_mm is not None:
            parts.append(f"steps of {self.step_mm:.2g} mm")
        if self.seam_px is not None:
            parts.append(f"{self.seam_px:.1f} px unread around the animal")
        if self.mixed_share is not None:
            parts.append(f"{self.mixed_share:.0%} of readings at edges lie between both sides")
        return ", ".join(parts)
