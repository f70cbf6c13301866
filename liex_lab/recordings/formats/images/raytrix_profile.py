"""raytrix.toml: which profile a folder of exports is read through, and what about it is
different.
"""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from liex_lab.errors import RecordingError
from liex_lab.recordings.frame import Depth

PROFILE_FILE = "raytrix.toml"
_SHIPPED = Path(__file__).with_name("raytrix_profiles.toml")
_CONFIRMED = "confirmed"  # how evidence begins that needs no warning

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Profile(BaseModel):
    """How the stored numbers of an export mean millimetres; the keys are explained in
    raytrix_profiles.toml.

    focal_mm, pitch_mm: of the main lens and of the sensor's pixels, from which the intrinsics
    follow where no camera.toml states them; lens_f_mm, lens_to_grid_mm, grid_to_sensor_mm: what
    turns virtual depth into millimetres.
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
        """f, distance from lens to micro-lens grid and from grid to sensor, mm, where all are
        stated.
        """
        numbers = (self.lens_f_mm, self.lens_to_grid_mm, self.grid_to_sensor_mm)
        return None if None in numbers else numbers  # type: ignore[return-value]

    def facts(self) -> dict[str, Any]:
        """The profile in JSON's own types, for session.json."""
        return {
            **self.model_dump(mode="json", exclude_none=True),
            "invalid": [str(value) for value in self.invalid],
        }

    def read(self, stored: NDArray[Any]) -> NDArray[np.float64]:
        """Signed mm (H, W) of stored values, NaN where they are invalid, before `valid_mm` is
        looked at.
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
        """Distance from the main lens, mm: the image lies v micro-lens gaps behind the grid, and
        the thin lens law.
        """
        assert self.lens is not None
        f, to_grid, gap = self.lens
        v = values if self.virtual == "v" else 1.0 / (1.0 - np.where(values < 1.0, values, np.nan))
        behind = to_grid + np.where(v > 0, v, np.nan) * gap
        behind = np.where(behind > f, behind, np.nan)  # nearer than f there is no real image
        return behind * f / (behind - f)

    def decode(self, stored: NDArray[Any]) -> Depth:
        """Stored values -> depth (H, W) float32 mm, 0 = unread."""
        return self.within(self.read(stored))

    def within(self, depth_mm: NDArray[Any]) -> Depth:
        """Depth mm with what lies outside `valid_mm` taken as unread."""
        good = (depth_mm >= self.valid_mm[0]) & (depth_mm <= self.valid_mm[1])
        return np.where(good & (depth_mm > 0), depth_mm, 0.0).astype(np.float32)


def shipped_profiles() -> dict[str, dict[str, Any]]:
    """The profiles that come with the package, by name."""
    return tomllib.loads(_SHIPPED.read_text(encoding="utf-8"))


def read_profile(path: Path) -> Profile:
    """The profile that a raytrix.toml names or states in full."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
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
