"""Folder of depth images (PNG, TIFF, PGM or PCLZF) with a camera.toml and time stamps.

Images are read in natural order. Times come from a stamp file, or else from the names of the
images, or else from a stated constant rate.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError, SeveralKindsError, UnknownTimesError
from liex_lab.optics.camera import Lens
from liex_lab.recordings.camera_file import (
    CAMERA_FILE,
    WHAT_TO_WRITE,
    CameraFile,
    is_infrared,
    rate,
    refuse_infrared,
)
from liex_lab.recordings.formats.images.files import (
    Stack,
    decode_pclzf,
    open_files,
    open_pgms,
    open_pngs,
    open_tiffs,
    probe_pclzf,
    read_pclzf_camera,
)
from liex_lab.recordings.frame import COLOUR, Depth, Stored, unread_where_damaged
from liex_lab.recordings.recording import Recording, closing_on_error
from liex_lab.recordings.timestamp_files import name_numbers, name_times, read_stamps
from liex_lab.recordings.timestamps import (
    frame_counts,
    from_rate,
    in_order_of_sensor,
    start_of_clock,
)
from liex_lab.runtime.progress import Progress, silent

KINDS: dict[str, tuple[str, ...]] = {  # suffixes of image files
    "PNG": (".png",),
    "TIFF": (".tif", ".tiff"),
    "PGM": (".pgm",),
    "PCLZF": (".pclzf",),
}


def list_images(folder: Path, pattern: str = "*") -> tuple[str, list[Path]]:
    """The depth images of a folder, in natural order: frame_2 before frame_10.

    Args:
        folder: the folder.
        pattern: which names to read, as in "*_depth.png".

    Returns:
        Their kind, a key of `KINDS`, and their paths.

    Raises:
        RecordingError: there are none, or they are of several kinds or of 8 bits.
    """
    inside = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    chosen = [
        path
        for path in inside
        # PCL's grabber writes one per depth image
        if fnmatch(path.name, pattern) and not path.name.endswith("_rgb.pclzf")
    ]
    kinds = {kind: [p for p in chosen if p.suffix.lower() in ends] for kind, ends in KINDS.items()}
    found = [
        (kind, [path for path in files if not is_infrared(path.stem)] or files)
        for kind, files in kinds.items()
        if files
    ]
    if len(found) > 1:
        (first, files), (second, _) = found[:2]
        one = f"*{files[0].suffix}"
        raise SeveralKindsError(
            f"{folder} holds both {first} and {second} images, and a recording has one "
            f'kind; choose with a line such as pattern = "{one}" under [camera] in camera.toml',
            one,
        )
    eight_bit = [
        path for path in chosen if path.suffix.lower() in (".jpg", ".jpeg", ".bmp", ".gif", ".webp")
    ]
    if not found and eight_bit:
        raise RecordingError(
            "expected 16-bit depth images (PNG or TIFF), got 8-bit images such as "
            f"{eight_bit[0].name} in {folder}; give the folder of the camera's depth images"
        )
    if not found:
        raise RecordingError(
            f"no image in {folder} fits pattern = {pattern!r}; correct it in camera.toml"
        )
    kind, files = found[0]
    return kind, sorted(files, key=lambda path: natural_key(path.name))


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that compares digits in a file name by value and the rest by letters."""
    return [
        (0, int(part), "") if part.isascii() and part.isdigit() else (1, 0, part)
        for part in re.findall(r"[0-9]+|[^0-9]+", name)
    ]


def open_images(
    path: Path,
    camera: Lens | None = None,
    fps: float | None = None,
    progress: Progress = silent,
    pattern: str | None = None,
) -> Recording:
    """Open a folder of images, or one image or stack, as a recording.

    Args:
        path: the folder or file.
        camera: overrides a camera.toml.
        fps: frame rate, Hz; used only if there are no time stamps; overrides a camera.toml.
        progress: counts the probed images.
        pattern: which names of the folder to read; None for the pattern in camera.toml.

    Raises:
        RecordingError: there is no depth, or the camera or the times are unknown.
    """
    folder = path if path.is_dir() else path.parent
    camera_toml = CameraFile.read(folder / CAMERA_FILE)
    kind, files = (
        list_images(path, pattern or camera_toml.pattern)
        if path.is_dir()
        else (next(kind for kind, ends in KINDS.items() if path.suffix.lower() in ends), [path])
    )
    refuse_infrared(path, f"{path.name if path.is_dir() else ''}/{files[0].stem}")
    if kind == "PCLZF" and not camera_toml.intrinsics and (xml := read_pclzf_camera(files[0])):
        unit_mm = xml.pop("unit_mm")
        camera_toml = replace(
            camera_toml,
            intrinsics=xml,
            unit_mm=camera_toml.unit_mm if camera_toml.path.is_file() else unit_mm,
            source="the XML files beside the images",
        )
    stack = open_stack(kind, files, camera_toml, progress)
    return image_recording("images", path, files, camera_toml, stack, camera, fps)


def image_recording(
    format: str,
    path: Path,
    files: list[Path],
    camera_toml: CameraFile,
    stack: Stack,
    camera: Lens | None,
    fps: float | None,
    decode: Callable[[Stored], Depth] | None = None,
    beside: Sequence[Path] = (),
) -> Recording:
    """The recording of a stack of images, with its camera and times; the stack is closed on an
    error.

    Args:
        format: name of the format, for `Recording.format`.
        path: the requested folder or file.
        files: the image files.
        camera_toml: the folder's camera.toml.
        stack: the stored images.
        camera: overrides the camera.toml.
        fps: frame rate, Hz; used only if there are no time stamps.
        decode: converts stored values to depth (H, W) float32 mm; None for that of the camera.toml.
        beside: further files that describe the images.

    Raises:
        RecordingError: the camera or the times are unknown, or all depths are negative.
    """
    decode = decode or camera_toml.decode
    folder = path if path.is_dir() else path.parent
    doubts: list[str] = []
    with closing_on_error(stack):
        the_camera = camera_toml.camera(stack.width, stack.height, camera)
        cut = [i for i, whole in enumerate(stack.whole) if not whole]
        problems = [*camera_toml.problems, *stack.problems]
        problems += [
            f"{len(cut)} of {len(stack)} images are cut short or damaged and were taken as "
            f"wholly unread, the first is frame {first} ({stack.label(first)})"
            for first in cut[:1]
        ]
        kept, times, absolute = _times(folder, files, stack, camera_toml, fps, problems, doubts)
        _refuse_negative(stack, decode, camera_toml)
    monotone = in_order_of_sensor(times)
    problems += [monotone.problem] if monotone.problem else []
    start = start_of_clock(int(monotone.times_ns[0])) if absolute else None
    at = path.resolve()
    stated_in = [folder / CAMERA_FILE, folder / camera_toml.timestamps, *beside]
    size = (stack.height, stack.width)
    return Recording(
        name=at.stem if at.is_file() else at.name,
        format=format,
        camera=the_camera,
        times_ns=monotone.times_ns,
        read=unread_where_damaged(stack.depth(decode), size, problems, cut),
        sources=[*files, *(file for file in stated_in if file.is_file())],
        problems=problems,
        truncated=stack.truncated,
        whole=np.array(stack.whole, np.bool_)[kept[monotone.order]],
        stored=kept[monotone.order],
        metadata=({"session_start_time": start} if start else {}) | camera_toml.metadata,
        close=stack.close,
        faults=monotone.faults,
        doubts=doubts,
    )


def _times(
    folder: Path,
    files: list[Path],
    stack: Stack,
    camera_toml: CameraFile,
    fps: float | None,
    problems: list[str],
    doubts: list[str],
) -> tuple[NDArray[np.int64], NDArray[np.int64], bool]:
    """The images that have a stamp, their stamps, and whether these count from 1970 in UTC.

    From the stamp file, or else from the names of the images, or else from a stated rate.
    """
    path = folder / camera_toml.timestamps
    n = len(stack)
    kept = np.arange(n)
    names = [file.name for file in files]
    numbers = name_numbers(names) if len(names) == n else kept
    numbers = np.zeros(n, np.int64) if numbers is None else numbers
    hz = rate(fps, "the call") or camera_toml.fps
    if path.is_file():
        stamps = read_stamps(path, doubts, camera_toml.time_column, camera_toml.time_unit)
        times = stamps.times(hz, problems, doubts, None)
        rows = stamps.rows_of(folder.name, names, numbers, problems, doubts)
        kept = np.flatnonzero(rows >= 0)
        if not len(kept):
            raise RecordingError(
                f"{path} holds no time stamp; write one per image, or remove it and state "
                "fps in camera.toml"
            )
        return kept, times[rows[kept]], stamps.zoned
    if len(names) == n and (named := name_times(names)) is not None:
        return kept, *named
    if hz is None:
        raise UnknownTimesError(
            f"the times of the images in {folder} are not known; write "
            f"{camera_toml.timestamps} with a line time_ns (or time_s) and then one time per "
            "image, or state a constant rate with fps = 30.0 under [camera] in camera.toml"
            + ("" if camera_toml.path.is_file() else f" ({WHAT_TO_WRITE})")
        )
    problems.append(f"there are no time stamps, so a constant {hz:g} frames/s was assumed")
    counts = frame_counts(numbers)
    if counts is not None and (left_out := int(counts[-1]) + 1 - n) > 0:
        problems.append(
            f"the numbers in the names leave out {left_out} of {n + left_out}; these were "
            "taken for frames that are missing"
        )
    return kept, from_rate(n if counts is None else counts, hz), False


def open_stack(kind: str, files: list[Path], camera_file: CameraFile, progress: Progress) -> Stack:
    """The images of one kind, as a stack.

    Args:
        kind: a key of `KINDS`.
        files: the images, in order.
        camera_file: the folder's camera.toml, for encoding and byte_order.
        progress: counts the probed images.

    Raises:
        RecordingError: they cannot be read, or the stated encoding does not fit their kind.
    """
    if kind == "PNG":
        return open_pngs(files, progress, colour=camera_file.encoding == COLOUR)
    if camera_file.encoding == COLOUR:
        raise RecordingError(
            f'{camera_file.path} states encoding = "{COLOUR}", which is one of colour PNG '
            "images, but "
            f"{files[0].name} is a {kind} image; correct it"
        )
    if kind == "PGM":
        return open_pgms(files, progress, camera_file.byte_order)
    if kind == "PCLZF":
        return open_files(files, kind, probe_pclzf, decode_pclzf, progress)
    return open_tiffs(files, progress)


def _refuse_negative(
    stack: Stack, decode: Callable[[Stored], Depth], camera_file: CameraFile
) -> None:
    """Raise RecordingError if all depths are negative (floats or signed integers): all would be
    unread.
    """
    stored = stack.read(stack.whole.index(True))
    if stored is None or stored.dtype.kind not in "fi" or decode(stored).any():
        return
    read = stored[np.isfinite(stored) & (stored != 0)] * camera_file.unit_mm
    if read.size and np.median(read) < 0:
        raise RecordingError(
            f"the depths in {stack.label(stack.whole.index(True))} are negative, so its depth axis "
            f"points towards the camera; write unit_mm = {-camera_file.unit_mm:g} under [camera] "
            "in camera.toml"
        )
