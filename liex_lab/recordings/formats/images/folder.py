"""Folder of depth images (PNG, TIFF, PGM or PCLZF) with a camera.toml and time stamps.

Images are read in natural order. Times come from a stamp file, or else from the names of the
images, or else from a stated constant rate.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
from liex_lab.recordings.formats.images.files import Stack
from liex_lab.recordings.frame import COLOUR, Depth, Stored
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.timestamp_files import name_numbers, name_times, read_stamps
from liex_lab.recordings.timestamps import (
    MonotoneTimes,
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
SUFFIXES = tuple(suffix for kind in KINDS.values() for suffix in kind)
_EIGHT_BIT = (".jpg", ".jpeg", ".bmp", ".gif", ".webp")
_COLOUR_PCLZF = "_rgb.pclzf"  # PCL's grabber writes one per depth image


class Pictures:
    """Images as depth: cut or damaged ones are all unread, and reported once in `problems`."""

    def __init__(
        self, stack: Stack, decode: Callable[[Stored], Depth], problems: list[str]
    ) -> None:
        """Keep a stack of images.

        Args:
            stack: the stored images.
            decode: converts stored values of one image to depth (H, W) float32 mm.
            problems: the recording's sentences, appended to for damaged images.
        """
        self.stack = stack
        self.problems = problems
        self._decode = decode
        self._bad = {i for i, whole in enumerate(stack.whole) if not whole}

    def read(self, index: int) -> Depth:
        """Depth of one image, (H, W) float32 mm, 0 where unread."""
        stored = self.stack.read(index)
        if stored is not None:
            return self._decode(stored)
        if index not in self._bad:
            self._bad.add(index)
            self.problems.append(
                f"frame {index} ({self.stack.label(index)}) is damaged and was taken as wholly "
                "unread"
            )
        return np.zeros((self.stack.height, self.stack.width), np.float32)


def list_pictures(folder: Path, pattern: str = "*") -> tuple[str, list[Path]]:
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
        if fnmatch(path.name, pattern) and not path.name.endswith(_COLOUR_PCLZF)
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
            f"{folder} holds both {first} and {second} pictures, and a recording has one "
            f'kind; choose with a line such as pattern = "{one}" under [camera] in camera.toml',
            one,
        )
    eight_bit = [path for path in chosen if path.suffix.lower() in _EIGHT_BIT]
    if not found and eight_bit:
        raise RecordingError(
            "expected 16-bit depth pictures (PNG or TIFF), got 8-bit pictures such as "
            f"{eight_bit[0].name} in {folder}; give the folder of the camera's depth pictures"
        )
    if not found:
        raise RecordingError(
            f"no picture in {folder} fits pattern = {pattern!r}; correct it in camera.toml"
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
        list_pictures(path, pattern or camera_toml.pattern)
        if path.is_dir()
        else (_kind(path), [path])
    )
    refuse_infrared(path, f"{path.name if path.is_dir() else ''}/{files[0].stem}")
    if kind == "PCLZF":
        camera_toml = _with_xml(camera_toml, files[0])
    stack = open_stack(kind, files, camera_toml, progress)
    return Folder(path, files, camera_toml, stack, camera_toml.decode).recording(
        "images", camera, fps
    )


@dataclass(frozen=True)
class Folder:
    """Images with everything needed to make a recording of them.

    Attributes:
        path: the requested folder or file.
        files: the image files.
        camera_toml: the folder's camera.toml.
        stack: the stored images.
        decode: converts stored values to depth (H, W) float32 mm.
        beside: further files that describe the images.
    """

    path: Path
    files: list[Path]
    camera_toml: CameraFile
    stack: Stack
    decode: Callable[[Stored], Depth]
    beside: Sequence[Path] = ()

    def recording(self, format: str, camera: Lens | None, fps: float | None) -> Recording:
        """The recording, with its camera and times; the stack is closed on an error.

        Args:
            format: name of the format, for `Recording.format`.
            camera: overrides the camera.toml.
            fps: frame rate, Hz; used only if there are no time stamps.

        Raises:
            RecordingError: the camera or the times are unknown, or all depths are negative.
        """
        try:
            return self._recording(format, camera, fps)
        except BaseException:
            self.stack.close()
            raise

    def _recording(self, format: str, camera: Lens | None, fps: float | None) -> Recording:
        stack, camera_toml = self.stack, self.camera_toml
        the_camera = camera_toml.camera(stack.width, stack.height, camera)
        problems = [*camera_toml.problems, *stack.problems, *_cut_problems(stack)]
        doubts: list[str] = []
        kept, monotone, start = self._times(fps, problems, doubts)
        _refuse_negative(stack, self.decode, camera_toml)
        at = self.path.resolve()
        stated_in = [self.folder / CAMERA_FILE, self.folder / camera_toml.timestamps, *self.beside]
        return Recording(
            name=at.stem if at.is_file() else at.name,
            format=format,
            camera=the_camera,
            times_ns=monotone.times_ns,
            read=Pictures(stack, self.decode, problems).read,
            sources=[*self.files, *(file for file in stated_in if file.is_file())],
            problems=problems,
            truncated=stack.truncated,
            whole=np.array(stack.whole, np.bool_)[kept[monotone.order]],
            stored=kept[monotone.order],
            metadata=({"session_start_time": start} if start else {}) | camera_toml.metadata,
            close=stack.close,
            faults=monotone.faults,
            doubts=doubts,
        )

    @property
    def folder(self) -> Path:
        """The folder of the images."""
        return self.path if self.path.is_dir() else self.path.parent

    def _times(
        self, fps: float | None, problems: list[str], doubts: list[str]
    ) -> tuple[NDArray[np.int64], MonotoneTimes, str | None]:
        """The images that have a stamp, their stamps, and the start time, ISO 8601, if stated.

        From the stamp file, or else from the names of the images, or else from a stated rate.
        """
        path = self.folder / self.camera_toml.timestamps
        n = len(self.stack)
        kept = np.arange(n)
        names = [file.name for file in self.files]
        numbers = name_numbers(names) if len(names) == n else kept
        numbers = np.zeros(n, np.int64) if numbers is None else numbers
        hz = rate(fps, "the call") or self.camera_toml.fps
        if path.is_file():
            stated = (self.camera_toml.time_column, self.camera_toml.time_unit)
            stamps = read_stamps(path, doubts, *stated)
            times = stamps.times(hz, problems, doubts, None)
            rows = stamps.rows_of(self.folder.name, names, numbers, problems, doubts)
            kept = np.flatnonzero(rows >= 0)
            if not len(kept):
                raise RecordingError(
                    f"{path} holds no time stamp; write one per picture, or remove it and state "
                    "fps in camera.toml"
                )
            times, moment = times[rows[kept]], stamps.zoned
        elif len(names) == n and (named := name_times(names)) is not None:
            times, moment = named
        elif hz is None:
            raise self._no_times()
        else:
            problems.append(f"there are no time stamps, so a constant {hz:g} frames/s was assumed")
            counts = frame_counts(numbers)
            times, moment = from_rate(n if counts is None else counts, hz), False
            if counts is not None and (left_out := int(counts[-1]) + 1 - n) > 0:
                problems.append(
                    f"the numbers in the names leave out {left_out} of {n + left_out}; these were "
                    "taken for frames that are missing"
                )
        monotone = in_order_of_sensor(times)
        problems += [monotone.problem] if monotone.problem else []
        return kept, monotone, start_of_clock(int(monotone.times_ns[0])) if moment else None

    def _no_times(self) -> RecordingError:
        return UnknownTimesError(
            f"the times of the pictures in {self.folder} are not known; write "
            f"{self.camera_toml.timestamps} with a line time_ns (or time_s) and then one time per "
            "picture, or state a constant rate with fps = 30.0 under [camera] in camera.toml"
            + ("" if self.camera_toml.path.is_file() else f" ({WHAT_TO_WRITE})")
        )


def _kind(path: Path) -> str:
    return next(kind for kind, ends in KINDS.items() if path.suffix.lower() in ends)


def _with_xml(camera_file: CameraFile, picture: Path) -> CameraFile:
    """The camera file completed by the intrinsics in PCL's XML file of an image."""
    from liex_lab.recordings.formats.images.files import read_pclzf_camera

    found = read_pclzf_camera(picture)
    if camera_file.intrinsics or found is None:
        return camera_file
    unit_mm = found.pop("unit_mm")
    return replace(
        camera_file,
        intrinsics=found,
        unit_mm=camera_file.unit_mm if camera_file.path.is_file() else unit_mm,
        source="the XML files beside the pictures",
    )


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
        from liex_lab.recordings.formats.images.files import open_pngs

        return open_pngs(files, progress, colour=camera_file.encoding == COLOUR)
    if camera_file.encoding == COLOUR:
        raise RecordingError(
            f'{camera_file.path} states encoding = "{COLOUR}", which is one of colour PNG '
            "pictures, but "
            f"{files[0].name} is a {kind} picture; correct it"
        )
    if kind == "PGM":
        from liex_lab.recordings.formats.images.files import open_pgms

        return open_pgms(files, progress, camera_file.byte_order)
    if kind == "PCLZF":
        from liex_lab.recordings.formats.images.files import open_pclzfs

        return open_pclzfs(files, progress)
    from liex_lab.recordings.formats.images.tiff import open_tiffs

    return open_tiffs(files, progress)


def _cut_problems(stack: Stack) -> list[str]:
    cut = [i for i, whole in enumerate(stack.whole) if not whole]
    return [
        f"{len(cut)} of {len(stack)} pictures are cut short or damaged and were taken as wholly "
        f"unread, the first is frame {first} ({stack.label(first)})"
        for first in cut[:1]
    ]


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
