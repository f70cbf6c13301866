"""A folder of 16-bit PNG or TIFF pictures, with a camera.toml and time stamps beside them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from liex_lab.camera import Lens
from liex_lab.errors import RecordingError
from liex_lab.progress import Progress, silent
from liex_lab.recordings.camera_file import CAMERA_FILE, WHAT_TO_WRITE, CameraFile, rate
from liex_lab.recordings.frame import Depth, depth_mm
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.times import Times, from_rate, increasing, match_counts, read_csv_times, start_of_clock

PNG, TIFF = (".png",), (".tif", ".tiff")
_EIGHT_BIT = (".jpg", ".jpeg", ".bmp", ".gif", ".webp")


class Stack(Protocol):
    """Pictures of one size, in order; `read` gives stored values (H, W), or None where a picture is cut or damaged."""

    @property
    def width(self) -> int:
        """Pixels in a row."""

    @property
    def height(self) -> int:
        """Rows in a picture."""

    @property
    def whole(self) -> list[bool]:
        """Which pictures are not cut short."""

    @property
    def problems(self) -> list[str]:
        """Sentences about the files as a whole."""

    @property
    def truncated(self) -> bool:
        """True where a picture, or the end of a stack, is missing."""

    def __len__(self) -> int: ...

    def read(self, index: int) -> NDArray[Any] | None:
        """Stored values (H, W); None where the picture is cut or damaged."""

    def label(self, index: int) -> str:
        """The file of a picture, for a sentence."""

    def close(self) -> None:
        """Let go of open files."""


class Pictures:
    """Pictures as depth: a cut or damaged one is wholly unread, and `problems` says so once."""

    def __init__(self, stack: Stack, camera_file: CameraFile, problems: list[str]) -> None:
        self.stack, self.problems = stack, problems
        self._unit_mm, self._unread = camera_file.unit_mm, camera_file.unread
        self._bad = {i for i, whole in enumerate(stack.whole) if not whole}

    def read(self, index: int) -> Depth:
        """Depth (H, W) float32 mm of one picture."""
        stored = self.stack.read(index)
        if stored is not None:
            return depth_mm(stored, self._unit_mm, self._unread)
        if index not in self._bad:
            self._bad.add(index)
            self.problems.append(f"frame {index} ({self.stack.label(index)}) is damaged and was taken as wholly unread")
        return np.zeros((self.stack.height, self.stack.width), np.float32)


def list_pictures(folder: Path, pattern: str = "*") -> list[Path]:
    """The depth pictures of a folder in natural order: frame_2 before frame_10."""
    inside = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    chosen = [path for path in inside if fnmatch(path.name, pattern)]
    kinds = {kind: [p for p in chosen if p.suffix.lower() in kind] for kind in (PNG, TIFF, _EIGHT_BIT)}
    if kinds[PNG] and kinds[TIFF]:
        raise RecordingError(
            f"{folder} holds both PNG and TIFF pictures, and a recording has one kind; choose with a line such as "
            'pattern = "*.png" under [camera] in camera.toml'
        )
    found = kinds[PNG] or kinds[TIFF]
    if not found and kinds[_EIGHT_BIT]:
        raise RecordingError(
            f"expected 16-bit depth pictures (PNG or TIFF), got 8-bit pictures such as {kinds[_EIGHT_BIT][0].name} "
            f"in {folder}; give the folder of the camera's depth pictures"
        )
    return sorted(found, key=lambda path: natural_key(path.name))


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sorts digits by their value and the rest by its letters."""
    return [
        (0, int(part), "") if part.isascii() and part.isdigit() else (1, 0, part)
        for part in re.findall(r"[0-9]+|[^0-9]+", name)
    ]


def open_images(
    path: Path, camera: Lens | None = None, fps: float | None = None, progress: Progress = silent
) -> Recording:
    """A folder of pictures, or one picture or stack, as a recording."""
    folder = path if path.is_dir() else path.parent
    camera_file = CameraFile.read(folder / CAMERA_FILE)
    files = list_pictures(path, camera_file.pattern) if path.is_dir() else [path]
    if not files:
        raise RecordingError(
            f"no picture in {path} fits pattern = {camera_file.pattern!r} of {CAMERA_FILE}; correct it"
        )
    stack = _open_stack(files, progress)
    the_camera = camera_file.camera(stack.width, stack.height, camera)
    problems = [*camera_file.problems, *stack.problems, *_say_cut(stack)]
    times = _times(folder, camera_file, fps, len(stack), problems)
    _refuse_negative(stack, camera_file)
    n = len(times)
    pictures = Pictures(stack, camera_file, problems)
    metadata = dict(camera_file.metadata)
    stamps = folder / camera_file.timestamps
    if "session_start_time" not in metadata and (start := start_of_clock(int(times[0]))) is not None:
        metadata["session_start_time"] = start
    return Recording(
        name=path.resolve().stem if path.is_file() else path.resolve().name, format="images", camera=the_camera,
        times_ns=times, read=pictures.read, sources=_existing([*files, folder / CAMERA_FILE, stamps]),
        problems=problems, truncated=stack.truncated, n_whole=sum(stack.whole[:n]), metadata=metadata,
        close=stack.close,
    )  # fmt: skip


def _open_stack(files: list[Path], progress: Progress) -> Stack:
    if files[0].suffix.lower() in PNG:
        from liex_lab.recordings._png import open_pngs

        return open_pngs(files, progress)
    from liex_lab.recordings._tiff import open_tiffs

    return open_tiffs(files, progress)


def _say_cut(stack: Stack) -> list[str]:
    cut = [i for i, whole in enumerate(stack.whole) if not whole]
    if not cut:
        return []
    return [
        f"{len(cut)} of {len(stack)} pictures are cut short and were taken as wholly unread, the first is frame "
        f"{cut[0]} ({stack.label(cut[0])})"
    ]


def _times(folder: Path, camera_file: CameraFile, fps: float | None, n: int, problems: list[str]) -> Times:
    """Stamps for the frames that have one, from the stamp file or else from a stated rate."""
    path = folder / camera_file.timestamps
    if not path.is_file():
        fps = rate(fps, "the call") or camera_file.fps
        if fps is None:
            raise RecordingError(
                f"the times of the pictures in {folder} are not known; write {path.name} with a line time_ns (or "
                "time_s) and then one time per picture, or state a constant rate with fps = 30.0 under [camera] in "
                "camera.toml" + ("" if camera_file.path.is_file() else f" ({WHAT_TO_WRITE})")
            )
        problems.append(f"there are no time stamps, so a constant {fps:g} frames/s was assumed as stated")
        return from_rate(n, fps)
    times = read_csv_times(path)
    n, counts = match_counts(n, times, folder.name, path.name)
    if not n:
        raise RecordingError(
            f"{path} holds no time stamp; write one per picture, or remove it and state fps in camera.toml"
        )
    settled, moved = increasing(times[:n])
    problems += [sentence for sentence in (counts, moved) if sentence]
    return settled


def _refuse_negative(stack: Stack, camera_file: CameraFile) -> None:
    """Float pictures may count away from the camera with a minus sign; nothing would be left of them unread."""
    stored = stack.read(stack.whole.index(True))
    if stored is None or stored.dtype.kind != "f":
        return
    read = stored[np.isfinite(stored) & (stored != 0)] * camera_file.unit_mm
    if read.size and np.median(read) < 0:
        raise RecordingError(
            f"the depths in {stack.label(stack.whole.index(True))} are negative, so its depth axis points towards the "
            f"camera; write unit_mm = {-camera_file.unit_mm:g} under [camera] in camera.toml"
        )


def _existing(files: Iterable[Path]) -> list[Path]:
    return [path for path in files if path.is_file()]
