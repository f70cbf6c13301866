"""MoSeq sessions: depth.dat, depth_ts.txt and metadata.json, in a folder or in the .tar.gz around it."""

from __future__ import annotations

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from liex_lab.camera import KINECT_V2, Camera, Lens
from liex_lab.errors import RecordingError
from liex_lab.progress import Progress, silent
from liex_lab.recordings.archive import Unpacked, remove_tree, unpack
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile, rate
from liex_lab.recordings.frame import Depth, depth_mm
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.times import (
    Times,
    from_rate,
    increasing,
    match_counts,
    median_step,
    read_column_times,
    start_of_day,
)

DEPTH = "depth.dat"
VIDEOS = ("depth.avi", "depth.mkv")
_STAMPS = {"depth_ts.txt": 10**6, "timestamps.csv": 10**9}  # file: nanoseconds in its unit
_METADATA = "metadata.json"
_NOMINAL_HZ = 30.0  # what every camera that MoSeq records from delivers when nothing is lost
_KINECT_V2_SIZE = (512, 424)
_OTHER_SIZES = ((640, 480), (640, 576), (320, 288), (512, 512), (1024, 1024), (848, 480), (1280, 720))


@dataclass(frozen=True)
class _Metadata:
    """What metadata.json says. size: (width, height), None when unstated; dtype: of the stored depths."""

    size: tuple[int, int] | None
    dtype: str
    facts: dict[str, Any]
    problems: list[str]


class RawFrames:
    """Frames one after the other in a file without a header, read with `seek`.

    Not a memory map: mapped pages count as the process's memory, and a long session would look like a leak.
    """

    def __init__(
        self, path: Path, width: int, height: int, dtype: str, unread: CameraFile, folder: Path | None = None
    ) -> None:
        """folder: of unpacked files, removed on closing."""
        self._file, self._folder = path.open("rb"), folder
        self._shape, self._dtype, self._how = (height, width), np.dtype(dtype), unread
        self._bytes = width * height * self._dtype.itemsize
        self._lock = Lock()

    def read(self, index: int) -> Depth:
        """Depth (H, W) float32 mm of one frame."""
        with self._lock:
            self._file.seek(index * self._bytes)
            raw = self._file.read(self._bytes)
        if len(raw) < self._bytes:
            raise RecordingError(
                f"{self._file.name} became shorter while it was read; frame {index} is no longer there"
            )
        stored = np.frombuffer(raw, self._dtype).reshape(self._shape)
        return depth_mm(stored, self._how.unit_mm, self._how.unread)

    def close(self) -> None:
        """Close the file, and remove what was unpacked."""
        self._file.close()
        if self._folder is not None:
            remove_tree(self._folder)


def open_moseq(
    path: Path, camera: Lens | None = None, fps: float | None = None, progress: Progress = silent
) -> Recording:
    """A MoSeq session: its folder, its depth.dat, or the archive around it."""
    if path.is_dir() or path.suffix.lower() == ".dat":
        folder = path if path.is_dir() else path.parent
        depth = folder / DEPTH if path.is_dir() else path
        names = (*_STAMPS, _METADATA, CAMERA_FILE)
        files = {DEPTH: depth} | {name: folder / name for name in names if (folder / name).is_file()}
        name = folder.resolve().name if depth.name == DEPTH else depth.stem
        return _open(name, path, Unpacked(files, frozenset(), False), camera, fps, list(files.values()))
    # gzip has no random access, so the session is streamed once into a folder that lives as long as the recording
    folder = Path(tempfile.mkdtemp(prefix="liex-"))
    try:
        unpacked = unpack(path, (DEPTH, *_STAMPS, _METADATA, CAMERA_FILE), folder, progress)
        return _open(_archive_name(path), path, unpacked, camera, fps, [path], folder)
    except BaseException:
        remove_tree(folder)
        raise


def _open(
    name: str,
    path: Path,
    found: Unpacked,
    camera: Lens | None,
    fps: float | None,
    sources: list[Path],
    folder: Path | None = None,
) -> Recording:
    files = found.files
    if DEPTH not in files:
        raise _no_depth(path, found)
    camera_file = CameraFile.read(files.get(CAMERA_FILE, path.parent / CAMERA_FILE))
    metadata = _read_metadata(files.get(_METADATA), found.cut)
    problems = [*camera_file.problems, *metadata.problems]
    stamps = _read_stamps(files, found.cut, problems)
    n_bytes = files[DEPTH].stat().st_size
    stated_size = metadata.size or _size_of_camera(camera, camera_file)
    width, height = stated_size or _guess_size(path, n_bytes, stamps)
    frame_bytes = 2 * width * height
    n, left_over = divmod(n_bytes, frame_bytes)
    if not n:
        raise RecordingError(
            f"{DEPTH} of {path} holds {n_bytes} bytes, less than one frame of {width} x {height} pixels ({frame_bytes} "
            "bytes); copy the recording again, or state DepthResolution in metadata.json"
        )
    if left_over or found.cut:
        where = (
            f"ends in the middle of frame {n}" if left_over else f"holds {n} frames, but its archive is cut or damaged"
        )
        problems.append(f"{DEPTH} {where}; its {n} whole frames can be read")
    the_camera = _camera(path, camera_file, width, height, camera, problems)
    if found.cut and stamps is not None and 1 < len(stamps) < n:
        stamps = _continue(stamps, n, problems)
    times = _times(files, stamps, n, fps, problems)
    frames = RawFrames(files[DEPTH], width, height, metadata.dtype, camera_file, folder)
    return Recording(
        name=name, format="moseq", camera=the_camera, times_ns=times, read=frames.read, sources=sources,
        problems=problems, truncated=bool(left_over) or found.cut, metadata={**metadata.facts, **camera_file.metadata},
        close=frames.close,
    )  # fmt: skip


def _no_depth(path: Path, found: Unpacked) -> RecordingError:
    video = next((name for name in VIDEOS if name in found.seen), None)
    if video:
        return video_error(path, video)
    if found.cut:
        return RecordingError(f"{path} is cut short before its {DEPTH}, so no frame can be read; copy it again")
    return RecordingError(f"{path} should hold a MoSeq session, but there is no {DEPTH} in it; give another archive")


def video_error(path: Path, video: str) -> RecordingError:
    """The sentence for a session whose depth is packed as a video."""
    return RecordingError(
        f"{path} holds its depth as {video}, which is not read yet; unpack it to depth.dat with MoSeq's own tools"
    )


def _read_metadata(path: Path | None, cut: bool) -> _Metadata:
    """What metadata.json tells; it is often missing, and then there is nothing to say."""
    if path is None:
        return _Metadata(None, "<u2", {}, [])
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
        if not isinstance(document, dict):
            raise ValueError("it is not an object in braces")
    except ValueError as error:  # broken JSON and broken UTF-8 are both ValueErrors
        if cut:
            return _Metadata(None, "<u2", {}, [f"{_METADATA} is cut short and was not used"])
        raise RecordingError(f"{_METADATA} of the session is not JSON ({error}); correct or remove it") from None
    facts, problems = {}, []
    for key, ours in (("SubjectName", "subject_id"), ("SessionName", "session_name")):
        if isinstance(document.get(key), str) and document[key].strip():
            facts[ours] = document[key].strip()
    if (stated := document.get("StartTime")) is not None:
        if (start := start_of_day(stated if isinstance(stated, str) else None)) is not None:
            facts["session_start_time"] = start
        else:
            problems.append(f"StartTime {stated!r} in {_METADATA} is not a time with a zone, so it was not used")
    little = document.get("IsLittleEndian", True) is not False
    return _Metadata(_stated_size(document.get("DepthResolution")), "<u2" if little else ">u2", facts, problems)


def _stated_size(value: Any) -> tuple[int, int] | None:
    if value is None:
        return None
    if isinstance(value, list) and len(value) == 2 and all(type(v) is int and 0 < v < 20_000 for v in value):
        return value[0], value[1]
    raise RecordingError(f"{_METADATA} states DepthResolution = {value!r}; it is [width, height] in pixels")


def _read_stamps(files: dict[str, Path], cut: bool, problems: list[str]) -> Times | None:
    name = next((name for name in _STAMPS if name in files), None)
    if name is None:
        return None
    if cut and not files[name].read_bytes().endswith(b"\n"):
        # the archive broke off inside this file: half a number is a wrong number
        text = files[name].read_bytes()
        files[name].write_bytes(text[: text.rfind(b"\n") + 1])
    times = read_column_times(files[name], _STAMPS[name])
    if not len(times):
        problems.append(f"{name} holds no time stamp")
        return None
    return times


def _size_of_camera(camera: Lens | None, camera_file: CameraFile) -> tuple[int, int] | None:
    if isinstance(camera, Camera):
        return camera.width, camera.height
    return (camera_file.width, camera_file.height) if camera_file.width and camera_file.height else None


def _guess_size(path: Path, n_bytes: int, stamps: Times | None) -> tuple[int, int]:
    """That of a Kinect v2, unless the stamps say that another camera's size fits and this one does not."""
    n = 0 if stamps is None else len(stamps)
    kinect_bytes = 2 * _KINECT_V2_SIZE[0] * _KINECT_V2_SIZE[1]
    other = next(((w, h) for w, h in _OTHER_SIZES if n and n_bytes == 2 * w * h * n), None)
    if other is not None and n_bytes % kinect_bytes:
        raise RecordingError(
            f"{DEPTH} of {path} does not fit frames of 512 x 424 pixels, but it fits {n} of {other[0]} x {other[1]}; "
            f'write {{"DepthResolution": [{other[0]}, {other[1]}]}} into {_METADATA} if that is your camera'
        )
    return _KINECT_V2_SIZE


def _camera(
    path: Path, camera_file: CameraFile, width: int, height: int, stated: Lens | None, problems: list[str]
) -> Camera:
    if stated is None and not camera_file.intrinsics and (width, height) == _KINECT_V2_SIZE:
        problems.append(
            "the files hold no intrinsics, so those of a typical Kinect v2 were taken; state your camera's "
            "own in a camera.toml beside the recording"
        )
        return KINECT_V2
    if stated is None and not camera_file.intrinsics:
        raise RecordingError(
            f"{path} holds pictures of {width} x {height} pixels from a camera that is not known; write a camera.toml "
            "beside it with [camera], fx = ..., fy = ..., cx = ... and cy = ... in pixels"
        )
    return camera_file.camera(width, height, stated)


def _continue(stamps: Times, n: int, problems: list[str]) -> Times:
    """Stamps for the frames whose own were cut off: a whole frame is worth more than its exact time."""
    step, n_lost = max(1, median_step(stamps)), n - len(stamps)
    problems.append(
        f"the time stamps of the last {n_lost} frames are cut off, so these frames were taken to follow every "
        f"{step / 1e6:.4g} ms, the median step of those before"
    )
    return np.concatenate([stamps, stamps[-1] + step * np.arange(1, n_lost + 1)])


def _times(files: dict[str, Path], stamps: Times | None, n: int, fps: float | None, problems: list[str]) -> Times:
    if stamps is None:
        hz = rate(fps, "the call") or _NOMINAL_HZ
        origin = "as stated" if fps else "which is the usual rate; state fps if yours differs"
        problems.append(f"there are no time stamps, so a constant {hz:g} frames/s was assumed, {origin}")
        return from_rate(n, hz)
    n, counts = match_counts(n, stamps, DEPTH, next(name for name in _STAMPS if name in files))
    times, moved = increasing(stamps[:n])
    problems += [sentence for sentence in (counts, moved) if sentence]
    return times


def _archive_name(path: Path) -> str:
    name = path.name
    for suffix in (".tar.gz", ".tgz", ".tar"):
        if name.lower().endswith(suffix):
            return name[: -len(suffix)]
    return path.stem
