"""The raytrix.toml format: which profile a folder of Raytrix exports is read through.

depth_mm = sign * unit_mm * stored + offset_mm. Virtual depth v goes through the thin lens law
first: the image lies b = lens_to_grid + v * grid_to_sensor behind the main lens, and the object a =
b f / (b - f) in front of it. `raw` values are 1 - 1 / v.
"""

from __future__ import annotations

import difflib
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from liex_lab.errors import RecordingError
from liex_lab.recordings.frame import Depth
from liex_lab.runtime.text_files import read_toml

PROFILE_FILE = "raytrix.toml"
_SHIPPED = Path(__file__).with_name("raytrix_profiles.toml")
_CONFIRMED = "confirmed"  # how evidence begins that needs no warning

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Profile(BaseModel):
    """How the stored numbers of an export mean millimetres.

    The keys are explained in raytrix_profiles.toml.

    Attributes:
        name: name of the profile, or of the file that states it.
        pattern: which files of the folder.
        kind: metric (depth maps), virtual (relative depth) or points (point clouds).
        stored: type of the stored values, float32 or uint16.
        unit_mm: mm per stored step.
        offset_mm: added after scaling, mm.
        sign: -1 where object space lies on the negative side of the file's z axis.
        invalid: stored values that mean "no reading" (of points: z).
        valid_mm: nearest and farthest depth after conversion, mm; what is outside is unread.
        resolution_divisor: the sensor's pixels per pixel of the exported picture.
        evidence: how it is known that the profile is right; begins with "confirmed" once measured.
        virtual: v for virtual depth itself, raw for 1 - 1 / v.
        up: True where y points up in the file.
        columns: of x, y, z in a text file, from 0.
        focal_mm: focal length of the main lens, mm, from which the intrinsics follow where no
            camera.toml states them.
        pitch_mm: pitch of the sensor's pixels, mm; also for the intrinsics.
        lens_f_mm: focal length of the main lens, mm, to turn virtual depth into mm.
        lens_to_grid_mm: distance from the main lens to the micro-lens grid, mm.
        grid_to_sensor_mm: distance from the grid to the sensor, mm.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    pattern: str
    kind: Literal["metric", "virtual", "points"]
    stored: Literal["float32", "uint16"]
    unit_mm: Positive
    offset_mm: Finite
    sign: Literal[-1, 1]
    invalid: tuple[float, ...]
    valid_mm: tuple[float, float]
    resolution_divisor: Positive
    evidence: str
    virtual: Literal["v", "raw"] = "v"
    up: bool = False
    columns: tuple[int, int, int] = (0, 1, 2)
    focal_mm: Positive | None = None
    pitch_mm: Positive | None = None
    lens_f_mm: Positive | None = None
    lens_to_grid_mm: Positive | None = None
    grid_to_sensor_mm: Positive | None = None

    @model_validator(mode="after")
    def _in_order(self) -> Profile:
        if not 0 <= self.valid_mm[0] < self.valid_mm[1]:
            raise ValueError("valid_mm is a nearest and a farthest depth, as in [20.0, 2000.0]")
        if min(self.columns) < 0:
            raise ValueError("columns are counted from 0, as in [0, 1, 2]")
        return self

    @property
    def doubt(self) -> str | None:
        """A sentence for as long as nobody has confirmed the profile; None after that."""
        if self.evidence.lower().startswith(_CONFIRMED):
            return None
        return (
            f"depth is read through the profile {self.name!r}, which is not confirmed "
            f"({self.evidence}); record a step "
            f'of known height, and write evidence = "confirmed with a ruler" into {PROFILE_FILE} '
            "once it measures right"
        )

    @property
    def lens(self) -> tuple[float, float, float] | None:
        """(f, lens to micro-lens grid, grid to sensor), mm, where all are stated; else None."""
        numbers = (self.lens_f_mm, self.lens_to_grid_mm, self.grid_to_sensor_mm)
        return None if None in numbers else numbers  # type: ignore[return-value]

    def facts(self) -> dict[str, Any]:
        """The profile in JSON's own types, for session.json."""
        return {
            **self.model_dump(mode="json", exclude_none=True),
            "invalid": [str(value) for value in self.invalid],
        }

    def read(self, stored: NDArray[Any]) -> NDArray[np.float64]:
        """Signed distance of stored values, before `valid_mm` is looked at.

        Args:
            stored: (H, W) float32 or uint16, as the file holds them.

        Returns:
            (H, W) mm, NaN where they are invalid.
        """
        with np.errstate(
            invalid="ignore"
        ):  # damage may hold any bits, also those of a NaN that signals
            values = stored.astype(np.float64)
        for value in self.invalid:
            values[stored == value] = np.nan
        values[~np.isfinite(values)] = np.nan
        if self.kind == "virtual":
            values = self._from_virtual(values)
        return self.sign * self.unit_mm * values + self.offset_mm

    def _from_virtual(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance a from the main lens, mm, by the thin lens law 1/f = 1/a + 1/b.

        The image lies b = lens_to_grid + v * grid_to_sensor behind the lens, v micro-lens gaps
        behind the grid. NaN where b <= f, for there is no real image then.
        """
        assert self.lens is not None
        f, to_grid, gap = self.lens
        v = values if self.virtual == "v" else 1.0 / (1.0 - np.where(values < 1.0, values, np.nan))
        behind = to_grid + np.where(v > 0, v, np.nan) * gap
        behind = np.where(behind > f, behind, np.nan)  # nearer than f there is no real image
        return behind * f / (behind - f)

    def decode(self, stored: NDArray[Any]) -> Depth:
        """Depth of stored values.

        Args:
            stored: (H, W) float32 or uint16, as the file holds them.

        Returns:
            (H, W) float32 mm, 0 = unread.
        """
        return self.within(self.read(stored))

    def within(self, depth_mm: NDArray[Any]) -> Depth:
        """Depth with what lies outside `valid_mm` taken as unread.

        Args:
            depth_mm: (H, W) mm, NaN or 0 where unread.

        Returns:
            (H, W) float32 mm, 0 = unread.
        """
        good = (depth_mm >= self.valid_mm[0]) & (depth_mm <= self.valid_mm[1])
        return np.where(good & (depth_mm > 0), depth_mm, 0.0).astype(np.float32)


def shipped_profiles() -> dict[str, dict[str, Any]]:
    """The profiles that come with the package, by name."""
    return read_toml(_SHIPPED)


def read_profile(path: Path) -> Profile:
    """The profile that a raytrix.toml names or states in full.

    Args:
        path: the raytrix.toml.

    Returns:
        The profile; keys stated in the file count before those of the named profile.

    Raises:
        RecordingError: the file is no TOML, names no known profile, or the value of a key cannot
            be.
    """
    try:
        table = read_toml(path)
    except ValueError as error:
        raise RecordingError(
            f"{path} should be a TOML file, but it does not parse ({error}); correct it"
        ) from None
    shipped = shipped_profiles()
    name = table.pop("profile", None)
    if name is not None and name not in shipped:
        raise RecordingError(
            f"{path} names the profile {name!r}, but there are {', '.join(shipped)}; choose one"
        )
    known = tuple(key for key in Profile.model_fields if key != "name")
    for key in table:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else "remove it"
            raise RecordingError(f"{path} has a key {key!r} that no profile has; {hint}")
    try:
        return Profile(**{"name": name or path.name, **shipped.get(str(name), {}), **table})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        why = str(first["msg"]).removeprefix("Value error, ")
        if first["type"] == "missing":
            why = (
                "is not stated; name a profile that has it, as in profile = "
                f'"{next(iter(shipped))}"'
            )
        raise RecordingError(f"{path}: {f'{key} {why}' if key else why}") from None
