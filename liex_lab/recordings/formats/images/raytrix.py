"""Exports of Raytrix light-field (plenoptic) cameras: depth maps and point clouds.

The vendor documents little about the numbers, so raytrix.toml names a profile, which is checked
against the first image (type, sign, working distance). Without a camera.toml,

    f_px = focal_mm / (pitch_mm * resolution_divisor).

depth_mm = sign * unit_mm * stored + offset_mm. Virtual depth v is converted by the thin lens law
first: the image is b = lens_to_grid + v * grid_to_sensor behind the main lens, and the object
a = b f / (b - f) in front of it. `raw` values are 1 - 1 / v.
"""

from __future__ import annotations

import difflib
import xml.etree.ElementTree as ET  # nosec B405: see B314 below
from collections.abc import Callable
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera, Lens
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile
from liex_lab.recordings.formats.images import point_clouds
from liex_lab.recordings.formats.images.files import Stack
from liex_lab.recordings.formats.images.folder import Folder, list_pictures, natural_key, open_stack
from liex_lab.recordings.frame import Depth, Stored
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent
from liex_lab.runtime.text_files import read_toml

PROFILE_FILE = "raytrix.toml"
_SHIPPED = Path(__file__).with_name("raytrix_profiles.toml")
_CONFIRMED = "confirmed"  # start of evidence that needs no warning

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Profile(BaseModel):
    """Conversion of the stored numbers of an export to millimetres.

    The keys are explained in raytrix_profiles.toml.

    Attributes:
        name: name of the profile, or of its file.
        pattern: which files of the folder to read.
        kind: metric (depth maps), virtual (relative depth) or points (point clouds).
        stored: type of the stored values, float32 or uint16.
        unit_mm: mm per stored step.
        offset_mm: added after scaling, mm.
        sign: -1 if object space is on the negative side of the file's z axis.
        invalid: stored values that mean "no reading" (z of points).
        valid_mm: nearest and farthest depth after conversion, mm; other depths are unread.
        resolution_divisor: the sensor's pixels per pixel of the exported image.
        evidence: source of the profile; begins with "confirmed" once measured.
        virtual: v for virtual depth itself, raw for 1 - 1 / v.
        up: True if y points up in the file.
        columns: of x, y, z in a text file, from 0.
        focal_mm: focal length of the main lens, mm, for the intrinsics without a camera.toml.
        pitch_mm: pitch of the sensor's pixels, mm; also for the intrinsics.
        lens_f_mm: focal length of the main lens, mm, to convert virtual depth to mm.
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
        """A sentence for an unconfirmed profile; None if it is confirmed."""
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
        """(f, lens to micro-lens grid, grid to sensor), mm; None unless all are stated."""
        numbers = (self.lens_f_mm, self.lens_to_grid_mm, self.grid_to_sensor_mm)
        return None if None in numbers else numbers  # type: ignore[return-value]

    def facts(self) -> dict[str, Any]:
        """The profile in JSON's own types, for session.json."""
        return {
            **self.model_dump(mode="json", exclude_none=True),
            "invalid": [str(value) for value in self.invalid],
        }

    def read(self, stored: NDArray[Any]) -> NDArray[np.float64]:
        """Signed distance of stored values, before `valid_mm` is applied.

        Args:
            stored: (H, W) float32 or uint16, as in the file.

        Returns:
            (H, W) mm, NaN for invalid values.
        """
        with np.errstate(
            invalid="ignore"
        ):  # damage may contain any bits, also those of a signalling NaN
            values = stored.astype(np.float64)
        for value in self.invalid:
            values[stored == value] = np.nan
        values[~np.isfinite(values)] = np.nan
        if self.kind == "virtual":
            values = self._from_virtual(values)
        return self.sign * self.unit_mm * values + self.offset_mm

    def _from_virtual(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance a from the main lens, mm, by the thin lens law 1/f = 1/a + 1/b.

        The image is b = lens_to_grid + v * grid_to_sensor behind the lens, v micro-lens gaps behind
        the grid. NaN if b <= f, because there is no real image then.
        """
        assert self.lens is not None
        f, to_grid, gap = self.lens
        v = values if self.virtual == "v" else 1.0 / (1.0 - np.where(values < 1.0, values, np.nan))
        behind = to_grid + np.where(v > 0, v, np.nan) * gap
        behind = np.where(behind > f, behind, np.nan)  # no real image within f
        return behind * f / (behind - f)

    def decode(self, stored: NDArray[Any]) -> Depth:
        """Convert stored values (H, W), float32 or uint16, to depth in float32 mm, 0 = unread."""
        return self.within(self.read(stored))

    def within(self, depth_mm: NDArray[Any]) -> Depth:
        """Mark depths outside `valid_mm` as unread.

        Args:
            depth_mm: (H, W) mm, NaN or 0 where unread.

        Returns:
            (H, W) float32 mm, 0 = unread.
        """
        good = (depth_mm >= self.valid_mm[0]) & (depth_mm <= self.valid_mm[1])
        return np.where(good & (depth_mm > 0), depth_mm, 0.0).astype(np.float32)


def shipped_profiles() -> dict[str, dict[str, Any]]:
    """The profiles included in the package, by name."""
    return read_toml(_SHIPPED)


def read_profile(path: Path) -> Profile:
    """The profile that a raytrix.toml names or defines.

    Keys in the file override those of the named profile.

    Args:
        path: the raytrix.toml.

    Raises:
        RecordingError: the file is not TOML, names no known profile, or a value is invalid.
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


_CALIBRATION_BYTES = 1 << 20
_LOOKS_LIKE = ("*depthmap*.*", "*depth3d*.*", "*.xyz", "*.ply")  # names of exports
_CALIBRATION = "RayCalibData"


def open_raytrix(
    folder: Path, camera: Lens | None = None, fps: float | None = None, progress: Progress = silent
) -> Recording:
    """Open a folder of exported depth maps or point clouds with its raytrix.toml as a recording.

    Args:
        folder: the folder of the exports.
        camera: overrides a camera.toml and the profile's lens.
        fps: frame rate, Hz; used only if there are no time stamps.
        progress: counts the probed files.

    Returns:
        The recording, with the profile in its metadata.

    Raises:
        RecordingError: the profile does not fit the exports, depth is virtual without a
            calibration, or the camera or the times are unknown.
    """
    path = folder / PROFILE_FILE
    profile = read_profile(path)
    camera_toml = CameraFile.read(folder / CAMERA_FILE)
    problems = () if profile.doubt is None else (profile.doubt,)
    camera_toml = replace(camera_toml, problems=(*camera_toml.problems, *problems))
    _refuse_virtual(folder, profile)
    stack: Stack
    decode: Callable[[Stored], Depth]
    if profile.kind == "points":
        files, stack = _open_clouds(folder, profile, camera_toml, camera, progress)
        decode = profile.within
    else:
        kind, files = list_pictures(folder, profile.pattern)
        stack = open_stack(kind, files, camera_toml, progress)
        camera_toml = _with_lens(camera_toml, profile, stack, path)
        decode = profile.decode
        try:
            _check(stack, profile, path)
        except BaseException:
            stack.close()
            raise
    recording = Folder(folder, files, camera_toml, stack, decode, (path,)).recording(
        "raytrix", camera, fps
    )
    recording.metadata["profile"] = profile.facts()
    return recording


def looks_like_raytrix(folder: Path, names: list[str]) -> bool:
    """Whether a file's name is that of an export, or it is a point cloud or the vendor's
    calibration.

    Args:
        folder: their folder.
        names: names of the files in it.
    """
    if any(fnmatch(name.lower(), pattern) for name in names for pattern in _LOOKS_LIKE):
        return True
    for name in names:
        if name.lower().endswith(".xml"):
            with (folder / name).open("rb") as file:
                if f"<{_CALIBRATION}".encode() in file.read(1024):
                    return True
    return False


def no_profile_error(folder: Path) -> RecordingError:
    """The error for a folder of exports without a raytrix.toml."""
    listed = ", ".join(shipped_profiles())
    return RecordingError(
        f"{folder} holds exports of a Raytrix camera, whose numbers mean depth in several ways; "
        f"write a {PROFILE_FILE} "
        f'into it with a line such as profile = "raytrix-f32-negative-mm" (one of {listed}), and '
        "a camera.toml"
    )


def _with_lens(camera_toml: CameraFile, profile: Profile, stack: Stack, path: Path) -> CameraFile:
    """Intrinsics from lens and sensor, unless a camera.toml states measured ones."""
    if camera_toml.intrinsics or profile.focal_mm is None or profile.pitch_mm is None:
        return camera_toml
    f_px = profile.focal_mm / (profile.pitch_mm * profile.resolution_divisor)
    centre = {"cx": (stack.width - 1) / 2.0, "cy": (stack.height - 1) / 2.0}
    told_once = (
        f"the focal length of {f_px:.1f} px follows from focal_mm and pitch_mm in {path.name}; a "
        "lens that is focused close up has a longer one, so measure a ruler at a known distance "
        "and state fx and fy in camera.toml"
    )
    return replace(
        camera_toml,
        intrinsics={"fx": f_px, "fy": f_px, **centre},
        source=path.name,
        problems=(*camera_toml.problems, told_once),
    )


def _check(stack: Stack, profile: Profile, path: Path) -> None:
    """Check the first image against the profile: stored type, sign, working distance."""
    first = stack.whole.index(True)
    stored = stack.read(first)
    if stored is None:
        return
    if stored.dtype != np.dtype(profile.stored):
        raise RecordingError(
            f"the profile {profile.name!r} is for {profile.stored} pictures, but "
            f"{stack.label(first)} is {stored.dtype.name}; choose another profile in {path}, or "
            "change stored"
        )
    depth = profile.read(stored)
    read = depth[np.isfinite(depth)]
    if not read.size:
        return
    median, (low, high) = float(np.median(read)), profile.valid_mm
    if median < 0:
        raise RecordingError(
            f"the depths in {stack.label(first)} are on the other side of the camera when read "
            f"through {profile.name!r} (median {median:.4g} mm); change sign to {-profile.sign} in "
            f"{path}"
        )
    if not low <= median <= high:
        raise RecordingError(
            f"the median depth in {stack.label(first)} is {median:.4g} mm when read through "
            f"{profile.name!r}, outside valid_mm = [{low:g}, {high:g}]; change unit_mm, offset_mm "
            f"or valid_mm in {path}"
        )


def _open_clouds(
    folder: Path, profile: Profile, camera_toml: CameraFile, stated: Lens | None, progress: Progress
) -> tuple[list[Path], Stack]:
    inside = [
        path for path in folder.iterdir() if path.is_file() and fnmatch(path.name, profile.pattern)
    ]
    beside = (camera_toml.timestamps, CAMERA_FILE, PROFILE_FILE)
    files = [
        p for p in inside if p.suffix.lower() in point_clouds.SUFFIXES and p.name not in beside
    ]
    if not files:
        raise RecordingError(
            f"no point cloud (.xyz, .txt, .csv or .ply) in {folder} fits pattern = "
            f"{profile.pattern!r} of {PROFILE_FILE}; correct it"
        )
    files.sort(key=lambda path: natural_key(path.name))
    width = stated.width if isinstance(stated, Camera) else camera_toml.width
    height = stated.height if isinstance(stated, Camera) else camera_toml.height
    if not (width and height):
        raise RecordingError(
            f"a point cloud has no pixels, so state the camera that shall see those in {folder}: "
            "write a camera.toml with fx, fy, cx, cy, width and height in pixels"
        )
    camera = camera_toml.camera(width, height, stated)
    return files, point_clouds.open_clouds(
        files, camera, profile.columns, profile_points(profile), progress
    )


def profile_points(profile: Profile) -> Callable[[point_clouds.Points], point_clouds.Points]:
    """The function that converts a file's points to the camera frame.

    Args:
        profile: for units, signs, offset and invalid values.

    Returns:
        A function from points (n, 3) in the file's units to (n, 3) mm, camera frame; NaN if z is
        invalid.
    """
    scale = profile.unit_mm * np.array([1.0, -1.0 if profile.up else 1.0, float(profile.sign)])

    def to_camera(points: point_clouds.Points) -> point_clouds.Points:
        """Convert points (n, 3) in the file's units to mm, camera frame; all three NaN if z is
        invalid.
        """
        p_camera = points * scale
        for value in profile.invalid:
            p_camera[points[:, 2] == value] = np.nan
        p_camera[:, 2] += profile.offset_mm
        return p_camera

    return to_camera


def read_ray_calibration(path: Path) -> float:
    """The total covering plane, in virtual depth, of a `RayCalibData` XML file.

    The file has no focal length and no metric scale, so it cannot convert virtual depth to mm.

    Raises:
        RecordingError: it is not such a calibration.
    """
    with path.open("rb") as file:
        text = file.read(_CALIBRATION_BYTES)
    try:
        # bandit B314: expat reads no external entities and limits the others, which tests check
        root = ET.fromstring(text)  # nosec B314
        if root.tag != _CALIBRATION:
            raise ValueError(f"its root is <{root.tag}>")
        return float(root.findtext("tcp", ""))
    except (ET.ParseError, ValueError) as error:
        raise RecordingError(
            f"{path} should be a Raytrix calibration ({_CALIBRATION}), but: {error}"
        ) from None


def _refuse_virtual(folder: Path, profile: Profile) -> None:
    """Raise RecordingError for virtual (relative) depth without the distances inside the camera."""
    if profile.kind != "virtual" or profile.lens is not None:
        return
    held = ""
    for path in sorted(folder.glob("*.xml")):
        try:
            tcp = read_ray_calibration(path)
        except RecordingError:
            continue
        held = (
            f" ({path.name} holds the micro-lens grid and tcp = {tcp:.3f} in virtual depth, "
            "but no focal length and no metric scale)"
        )
    raise RecordingError(
        f"the depth in {folder} is virtual, which is relative, and no calibration to millimetres "
        f"is stated{held}; export metric depth, or state lens_f_mm, lens_to_grid_mm and "
        f"grid_to_sensor_mm in {PROFILE_FILE}"
    )
