"""Exports of Raytrix light-field (plenoptic) cameras: depth maps and point clouds.

The vendor documents little about the numbers, so raytrix.toml names a profile, which is checked
against the first image (type, sign, working distance). Without a camera.toml,

    f_px = focal_mm / (pitch_mm * resolution_divisor).

depth_mm = sign * unit_mm * stored + offset_mm. Virtual depth v is converted by the thin lens law
first: the image is b = lens_to_grid + v * grid_to_sensor behind the main lens, and the object
a = b f / (b - f) in front of it. `raw` values are 1 - 1 / v. Point clouds (XYZ text, PLY) become
depth images by projection into a pinhole camera with a z-buffer.
"""

import warnings
from collections.abc import Callable
from dataclasses import replace
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from liex_lab.errors import RecordingError, did_you_mean, expecting
from liex_lab.optics.camera import Camera, Lens
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile
from liex_lab.recordings.formats.images.files import (
    Points,
    Probe,
    Size,
    Stack,
    open_files,
    render_points,
    something_else,
)
from liex_lab.recordings.formats.images.folder import (
    image_recording,
    list_images,
    natural_key,
    open_stack,
)
from liex_lab.recordings.frame import Depth, Stored
from liex_lab.recordings.recording import Recording, closing_on_error
from liex_lab.runtime.progress import Progress, silent
from liex_lab.runtime.text_files import read_toml

PROFILE_FILE = "raytrix.toml"

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
        unit_mm: mm per stored step; for virtual depth, a factor on the converted mm.
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
    def _in_order(self) -> "Profile":
        if not 0 <= self.valid_mm[0] < self.valid_mm[1]:
            raise ValueError("valid_mm is a nearest and a farthest depth, as in [20.0, 2000.0]")
        if min(self.columns) < 0:
            raise ValueError("columns are counted from 0, as in [0, 1, 2]")
        return self

    @property
    def doubt(self) -> str | None:
        """A sentence for an unconfirmed profile; None if it is confirmed."""
        # start of evidence that needs no warning
        if self.evidence.lower().startswith("confirmed"):
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
        with np.errstate(invalid="ignore"):  # damage may contain a signalling NaN
            values = stored.astype(np.float64)
        for value in self.invalid:
            values[stored == value] = np.nan
        values[~np.isfinite(values)] = np.nan
        if self.kind == "virtual":
            # thin lens law 1/f = 1/a + 1/b, with the image v micro-lens gaps behind the grid
            assert self.lens is not None
            f, to_grid, gap = self.lens
            if self.virtual == "raw":
                values = 1.0 / (1.0 - np.where(values < 1.0, values, np.nan))
            behind = to_grid + np.where(values > 0, values, np.nan) * gap
            behind = np.where(behind > f, behind, np.nan)  # no real image within f
            values = behind * f / (behind - f)
        return self.sign * self.unit_mm * values + self.offset_mm

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
    return read_toml(Path(__file__).with_name("raytrix_profiles.toml"))


def read_profile(path: Path) -> Profile:
    """The profile that a raytrix.toml names or defines.

    Keys in the file override those of the named profile.

    Args:
        path: the raytrix.toml.

    Raises:
        RecordingError: the file is not TOML, names no known profile, or a value is invalid.
    """
    with expecting(
        RecordingError, f"{path} should be a TOML file", ValueError, advice="correct it"
    ):
        table = read_toml(path)
    shipped = shipped_profiles()
    name = table.pop("profile", None)
    if name is not None and name not in shipped:
        raise RecordingError(
            f"{path} names the profile {name!r}, but there are {', '.join(shipped)}; choose one"
        )
    known = tuple(key for key in Profile.model_fields if key != "name")
    for key in table:
        if key not in known:
            hint = did_you_mean(key, known, "did you mean '{}'?") or "remove it"
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


_NO_SCALE = (
    " (the Raytrix calibration in it holds the micro-lens grid in virtual depth, but no focal "
    "length and no metric scale)"
)


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
    if profile.doubt is not None:
        camera_toml = replace(camera_toml, problems=(*camera_toml.problems, profile.doubt))
    if profile.kind == "virtual" and profile.lens is None:
        has_calibration = any(map(_is_calibration, folder.glob("*.xml")))
        raise RecordingError(
            f"the depth in {folder} is virtual, which is relative, and no calibration to "
            f"millimetres is stated{_NO_SCALE if has_calibration else ''}; export metric depth, or "
            f"state lens_f_mm, lens_to_grid_mm and grid_to_sensor_mm in {PROFILE_FILE}"
        )
    decode: Callable[[Stored], Depth]
    stack: Stack
    if profile.kind == "points":
        files, stack = _open_clouds(folder, profile, camera_toml, camera, progress)
        decode = profile.within
    else:
        kind, files = list_images(folder, profile.pattern)
        stack = open_stack(kind, files, camera_toml, progress)
        # intrinsics from lens and sensor, unless a camera.toml states measured ones
        if not camera_toml.intrinsics and profile.focal_mm and profile.pitch_mm:
            f_px = profile.focal_mm / (profile.pitch_mm * profile.resolution_divisor)
            centre = {"cx": (stack.width - 1) / 2.0, "cy": (stack.height - 1) / 2.0}
            estimated = (
                f"the focal length of {f_px:.1f} px follows from focal_mm and pitch_mm in "
                f"{path.name}; a lens that is focused close up has a longer one, so measure a "
                "ruler at a known distance and state fx and fy in camera.toml"
            )
            camera_toml = replace(
                camera_toml,
                intrinsics={"fx": f_px, "fy": f_px, **centre},
                source=path.name,
                problems=(*camera_toml.problems, estimated),
            )
        decode = profile.decode
        with closing_on_error(stack):
            _check(stack, profile, path)
    recording = image_recording(
        "raytrix", folder, files, camera_toml, stack, camera, fps, decode, (path,)
    )
    recording.metadata["profile"] = profile.facts()
    return recording


def is_raytrix(folder: Path, names: list[str]) -> bool:
    """Whether a folder holds a Raytrix export, a point cloud or the vendor's calibration.

    Args:
        folder: the folder.
        names: names of the files in it.
    """
    return any(
        fnmatch(name.lower(), pattern)
        for name in names
        for pattern in ("*depthmap*.*", "*depth3d*.*", "*.xyz", "*.ply")
    ) or any(_is_calibration(folder / name) for name in names if name.lower().endswith(".xml"))


def _is_calibration(path: Path) -> bool:
    """Whether an XML file is the vendor's calibration."""
    with path.open("rb") as file:
        return b"<RayCalibData" in file.read(1024)


def no_profile_error(folder: Path) -> RecordingError:
    """The error for a folder of exports without a raytrix.toml."""
    listed = ", ".join(shipped_profiles())
    return RecordingError(
        f"{folder} seems to hold exports of a Raytrix camera, whose numbers mean depth in several "
        f"ways; write a {PROFILE_FILE} "
        f'into it with a line such as profile = "raytrix-f32-negative-mm" (one of {listed}), and '
        "a camera.toml"
    )


def _check(stack: Stack, profile: Profile, path: Path) -> None:
    """Check the first image against the profile: stored type, sign, working distance."""
    first = stack.whole.index(True)
    stored = stack.read(first)
    if stored is None:
        return
    if stored.dtype != np.dtype(profile.stored):
        raise RecordingError(
            f"the profile {profile.name!r} is for {profile.stored} images, but "
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


# Point clouds, one per file, as images of a camera.


_PLY = ".ply"
_CLOUD_SUFFIXES = (".xyz", ".txt", ".csv", ".asc", _PLY)
_HEAD_BYTES = 1 << 16
_TYPES = {  # PLY's name of a type: NumPy's
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def _open_clouds(
    folder: Path, profile: Profile, camera_toml: CameraFile, stated: Lens | None, progress: Progress
) -> tuple[list[Path], Stack]:
    beside = (camera_toml.timestamps, CAMERA_FILE, PROFILE_FILE)
    files = [
        path
        for path in sorted(folder.iterdir(), key=lambda path: natural_key(path.name))
        if path.is_file()
        and fnmatch(path.name, profile.pattern)
        and path.suffix.lower() in _CLOUD_SUFFIXES
        and path.name not in beside
    ]
    if not files:
        raise RecordingError(
            f"no point cloud ({', '.join(_CLOUD_SUFFIXES)}) in {folder} fits pattern = "
            f"{profile.pattern!r} of {PROFILE_FILE}; correct it"
        )
    width = stated.width if isinstance(stated, Camera) else camera_toml.width
    height = stated.height if isinstance(stated, Camera) else camera_toml.height
    if not (width and height):
        raise RecordingError(
            f"point clouds have no pixels; describe the camera onto which those in {folder} are "
            "projected: write a camera.toml with fx, fy, cx, cy, width and height in pixels"
        )
    camera = camera_toml.camera(width, height, stated)
    scale = profile.unit_mm * np.array([1.0, -1.0 if profile.up else 1.0, float(profile.sign)])

    def decode(path: Path) -> Stored | None:
        """Depth (H, W) mm of a file; None if it is damaged."""
        try:
            ply = path.suffix.lower() == _PLY
            points = _read_ply(path) if ply else _read_text(path, profile.columns)
        except (ValueError, OverflowError):
            return None
        if points is None:
            return None
        p_camera = points * scale
        for value in profile.invalid:
            p_camera[points[:, 2] == value] = np.nan
        p_camera[:, 2] += profile.offset_mm
        return render_points(p_camera, camera)

    probe = partial(_probe_cloud, size=(width, height))
    return files, open_files(files, "point cloud", probe, decode, progress)


def _probe_cloud(path: Path, size: Size) -> Probe:
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if path.suffix.lower() != _PLY:
        lines = head.decode("utf-8", "replace").splitlines()[:3]
        return size if any(map(_are_numbers, lines)) else something_else(path, "point cloud")
    if not head.startswith(b"ply"[: len(head)]):
        return something_else(path, "PLY")
    header = _ply_header(head)
    return size if header is not None and not header.is_cut(path) else None


def _are_numbers(line: str) -> bool:
    """Whether a line has at least three numbers and nothing else."""
    cells = line.replace(",", " ").replace(";", " ").split()
    try:
        return len(cells) >= 3 and bool(np.isfinite([float(cell) for cell in cells]).any())
    except ValueError:
        return False


def _read_text(path: Path, columns: tuple[int, int, int]) -> Points:
    with path.open(encoding="utf-8", errors="strict") as file:
        first = [file.readline(_HEAD_BYTES) for _ in range(3)]
    n_header = next((k for k, line in enumerate(first) if _are_numbers(line)), 0)
    delimiter = next((mark for mark in ";," if mark in first[n_header]), None)
    return _loadtxt(path, delimiter=delimiter, skiprows=n_header, usecols=columns, encoding="utf-8")


class _PlyHeader(NamedTuple):
    """Layout of the vertices in a PLY file.

    Attributes:
        n: number of vertices.
        row: NumPy's type of a vertex, with the byte order; in native order for text.
        is_text: True if numbers are written as text.
        start: position of the vertices in the file, bytes.
    """

    n: int
    row: np.dtype[Any]
    is_text: bool
    start: int

    def is_cut(self, path: Path) -> bool:
        """Whether the file is too short for the vertices; a number takes two bytes of text."""
        row_bytes = 2 * len(self.row.names or ()) if self.is_text else self.row.itemsize
        return path.stat().st_size + self.is_text < self.start + self.n * row_bytes


def _ply_header(head: bytes) -> _PlyHeader | None:
    """Parse the header; None if it is cut, or the vertices are not the first element."""
    end = head.find(b"end_header")
    start = head.find(b"\n", end) + 1
    if end < 0 or not start:
        return None
    order: str | None = None
    element = ""
    n = -1
    fields: dict[str, str] = {}
    for line in head[:end].decode("latin-1").splitlines():
        match line.split():
            case ["format", stated, *_]:
                order = _ORDERS.get(stated)
            case ["element", element, count] if count.isdigit():
                if n < 0 and element != "vertex":
                    return None
                n = int(count) if n < 0 else n
            case ["property", *words] if element == "vertex":
                if len(words) != 2 or words[0] not in _TYPES or words[1] in fields:
                    return None  # a list among the vertices has no fixed size
                fields[words[1]] = _TYPES[words[0]]
    if order is None or n < 0 or not {"x", "y", "z"} <= fields.keys():
        return None
    row = np.dtype([(name, order + kind) for name, kind in fields.items()])
    return _PlyHeader(n, row, not order, start)


def _read_ply(path: Path) -> Points | None:
    with path.open("rb") as file:
        header = _ply_header(file.read(_HEAD_BYTES))
        if header is None or header.is_cut(path):
            return None
        file.seek(header.start)
        if header.is_text:
            columns = [list(header.row.names or ()).index(axis) for axis in "xyz"]
            return _loadtxt(file, usecols=columns, max_rows=max(header.n, 1), encoding="latin-1")
        vertices = np.frombuffer(file.read(header.n * header.row.itemsize), header.row)
    with np.errstate(invalid="ignore"):  # damage may contain a signalling NaN
        return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=-1)


def _loadtxt(file: Any, **how: Any) -> Points:
    with warnings.catch_warnings():  # an empty file has no points
        warnings.simplefilter("ignore", UserWarning)
        return np.loadtxt(file, ndmin=2, **how)
