"""Exports of Raytrix light-field (plenoptic) cameras: depth maps and point clouds.

The vendor documents little of what the numbers mean, so a profile is named in raytrix.toml and
checked against the first picture (type, sign, working distance). Without a camera.toml,

    f_px = focal_mm / (pitch_mm * resolution_divisor).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET  # nosec B405: see B314 below
from collections.abc import Callable
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera, Lens
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile
from liex_lab.recordings.depth_units import Stored
from liex_lab.recordings.formats.images import point_clouds
from liex_lab.recordings.formats.images.folder import Folder, list_pictures, natural_key, open_stack
from liex_lab.recordings.formats.images.raytrix_profile import (
    PROFILE_FILE,
    Profile,
    read_profile,
    shipped_profiles,
)
from liex_lab.recordings.formats.images.stack import Stack
from liex_lab.recordings.frame import Depth
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent

_CALIBRATION_BYTES = 1 << 20
_LOOKS_LIKE = ("*depthmap*.*", "*depth3d*.*", "*.xyz", "*.ply")  # as exports are named
_CALIBRATION = "RayCalibData"


def open_raytrix(
    folder: Path, camera: Lens | None = None, fps: float | None = None, progress: Progress = silent
) -> Recording:
    """Open a folder of exported depth maps or point clouds with its raytrix.toml as a recording.

    Args:
        folder: where the exports are.
        camera: comes before a camera.toml and the profile's lens.
        fps: frame rate, Hz; used only where there are no time stamps.
        progress: told how many files were looked at.

    Returns:
        The recording, with the profile in its metadata.

    Raises:
        RecordingError: the profile does not fit the exports, depth is virtual and no calibration is
            stated, or the camera or the times are not known.
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
    """Whether files are exports: so named, point clouds, or with the vendor's calibration.

    Args:
        folder: where they are.
        names: names of the files in it.

    Returns:
        True where one of them is.
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
    """The error for a folder of exports without a raytrix.toml.

    Args:
        folder: the folder.

    Returns:
        The error, to be raised.
    """
    listed = ", ".join(shipped_profiles())
    return RecordingError(
        f"{folder} holds exports of a Raytrix camera, whose numbers mean depth in several ways; "
        f"write a {PROFILE_FILE} "
        f'into it with a line such as profile = "raytrix-f32-negative-mm" (one of {listed}), and '
        "a camera.toml"
    )


def _with_lens(camera_toml: CameraFile, profile: Profile, stack: Stack, path: Path) -> CameraFile:
    """Intrinsics from the lens and the sensor, where no camera.toml states measured ones."""
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
    """The first picture must be what the profile says: stored type, sign, working distance."""
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
    """The function that carries a file's points into the camera frame.

    Args:
        profile: for units, signs, offset and invalid values.

    Returns:
        A function from points (n, 3) in the file's units to (n, 3) mm, camera frame; NaN where z is
        invalid.
    """
    scale = profile.unit_mm * np.array([1.0, -1.0 if profile.up else 1.0, float(profile.sign)])

    def to_camera(points: point_clouds.Points) -> point_clouds.Points:
        """Points in the camera frame.

        Args:
            points: (n, 3) in the file's units.

        Returns:
            (n, 3) mm; all three NaN where z is invalid.
        """
        p_camera = points * scale
        for value in profile.invalid:
            p_camera[points[:, 2] == value] = np.nan
        p_camera[:, 2] += profile.offset_mm
        return p_camera

    return to_camera


@dataclass(frozen=True)
class RayCalibration:
    """The vendor's calibration: the grid of micro-lenses and the ranges of virtual depth.

    It has no focal length and no metric scale, so it does not turn virtual depth into millimetres.

    Attributes:
        diameter_px: diameter of a micro-lens, px.
        rotation_rad: rotation of the grid, rad.
        tcp: total covering plane, in virtual depth.
        depth_ranges: (least, greatest) virtual depth of each type of micro-lens.
    """

    diameter_px: float
    rotation_rad: float
    tcp: float
    depth_ranges: tuple[tuple[float, float], ...]


def read_ray_calibration(path: Path) -> RayCalibration:
    """The `RayCalibData` of an XML file.

    Args:
        path: the XML file.

    Returns:
        What it holds.

    Raises:
        RecordingError: it is no such calibration.
    """
    with path.open("rb") as file:
        text = file.read(_CALIBRATION_BYTES)
    try:
        # bandit B314: expat reads no external entities and bounds the others; tests hold it to that
        root = ET.fromstring(text)  # nosec B314
        if root.tag != _CALIBRATION:
            raise ValueError(f"its root is <{root.tag}>")
        ranges = tuple(
            (float(found.findtext("min", "")), float(found.findtext("max", "")))
            for found in root.findall("lens_type/depth_range")
        )
        diameter, rotation, tcp = (
            float(root.findtext(name, "")) for name in ("diameter", "rotation", "tcp")
        )
    except (ET.ParseError, ValueError) as error:
        raise RecordingError(
            f"{path} should be a Raytrix calibration ({_CALIBRATION}), but: {error}"
        ) from None
    return RayCalibration(diameter, rotation, tcp, ranges)


def _refuse_virtual(folder: Path, profile: Profile) -> None:
    """Virtual depth is relative; without the distances inside the camera it never becomes
    millimetres.
    """
    if profile.kind != "virtual" or profile.lens is not None:
        return
    held = ""
    for path in sorted(folder.glob("*.xml")):
        try:
            found = read_ray_calibration(path)
        except RecordingError:
            continue
        held = (
            f" ({path.name} holds the micro-lens grid and tcp = {found.tcp:.3f} in virtual depth, "
            "but no focal length and no metric scale)"
        )
    raise RecordingError(
        f"the depth in {folder} is virtual, which is relative, and no calibration to millimetres "
        f"is stated{held}; export metric depth, or state lens_f_mm, lens_to_grid_mm and "
        f"grid_to_sensor_mm in {PROFILE_FILE}"
    )
