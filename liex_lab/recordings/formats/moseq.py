"""Reader of MoSeq sessions: depth.dat, depth.avi or depth.mkv with stamps and metadata.

A session is a folder or a .tar.gz. depth.dat is raw uint16, frame after frame, without a header.
The camera is stated, or from the factory calibration in the video, or typical of a Kinect v2 or an
Azure Kinect; stamps are in a file next to the depth, or in the video, or follow a constant rate.

The factory of an Azure Kinect (or Orbbec Femto, its successor) states normalised intrinsics of the
whole sensor; a depth mode is a crop of it, perhaps binned two by two:

    fx_px = fx side,    cx_px = cx side - left - 1/2.

Distortion is Brown-Conrady with eight coefficients (ROS: rational_polynomial).
"""

from __future__ import annotations

import json
import re
import shutil
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import KINECT_V2, Camera, Distortion, Lens
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile, rate, refuse_infrared
from liex_lab.recordings.formats.images.files import Stack
from liex_lab.recordings.formats.images.folder import Pictures
from liex_lab.recordings.formats.moseq_files import (
    AZURE,
    KINECT,
    METADATA,
    STAMPS,
    Metadata,
    Unpacked,
    read_metadata,
    read_session_stamps,
    unpack,
)
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.timestamps import (
    Times,
    from_rate,
    in_order_of_sensor,
    match_counts,
    median_step,
    unpaired,
)
from liex_lab.runtime.durable import Scratch
from liex_lab.runtime.places import STRETCH, let_go
from liex_lab.runtime.progress import Progress, silent

if TYPE_CHECKING:
    from liex_lab.recordings.formats.video import DepthTrack


class Mode(NamedTuple):
    """A depth mode.

    Attributes:
        name: its name in the Azure Kinect sensor SDK.
        width: columns of its images, px.
        height: rows of its images, px.
        side: side of the sensor after binning, px.
        left: column of the image's corner on the sensor, px.
        top: row of the image's corner on the sensor, px.
    """

    name: str
    width: int
    height: int
    side: int
    left: int
    top: int


MODES = (  # of the Azure Kinect sensor SDK
    Mode("NFOV_UNBINNED", 640, 576, 1024, 192, 180),
    Mode("NFOV_2X2BINNED", 320, 288, 512, 96, 90),
    Mode("WFOV_2X2BINNED", 512, 512, 512, 0, 0),
    Mode("WFOV_UNBINNED", 1024, 1024, 1024, 0, 0),
)
_TYPICAL = (
    0.5,
    0.5,
    0.492,
    0.492,
)  # cx, cy, fx, fy as shares of the sensor's side; units differ by about 1 %
_DEPTH_CAMERA = ("CALIBRATION_CameraLocationD0", "CALIBRATION_CameraPurposeDepth")


class FactoryLens(NamedTuple):
    """Factory calibration of the depth camera.

    Attributes:
        shares: cx, cy, fx, fy as shares of the sensor's side.
        distortion: k1 k2 p1 p2 k3 k4 k5 k6.
    """

    shares: tuple[float, float, float, float]
    distortion: tuple[float, ...]


def mode_of(width: int, height: int) -> Mode | None:
    """The depth mode with images of a given size, px; None if absent."""
    return next((mode for mode in MODES if (mode.width, mode.height) == (width, height)), None)


def read_calibration(data: bytes) -> FactoryLens | None:
    """The depth camera in the calibration (JSON) that recorders attach to their files.

    Args:
        data: the JSON, perhaps with trailing zeros.

    Returns:
        The lens; None if the data do not contain one.
    """
    try:
        cameras = json.loads(data.rstrip(b"\0"))["CalibrationInformation"]["Cameras"]
        depth = next(
            c
            for c in cameras
            if c.get("Location") == _DEPTH_CAMERA[0] or c.get("Purpose") == _DEPTH_CAMERA[1]
        )
        values = [float(value) for value in depth["Intrinsics"]["ModelParameters"]]
    except (ValueError, KeyError, TypeError, AttributeError, StopIteration, RecursionError):
        return None
    if len(values) < 14 or not np.isfinite(values).all() or min(values[2:4]) <= 0:
        return None
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = values[:14]
    return FactoryLens((cx, cy, fx, fy), (k1, k2, p1, p2, k3, k4, k5, k6))


def azure_camera(mode: Mode, lens: FactoryLens | None) -> Camera:
    """The camera of a depth mode, in pixels of its images.

    Pixel (0, 0) is the centre of the top-left pixel, hence the half that is subtracted.

    Args:
        mode: the depth mode.
        lens: the factory calibration; None for typical values, which differ by about 1 % between
            units.

    Returns:
        The camera, with distortion if lens is given.
    """
    cx, cy, fx, fy = _TYPICAL if lens is None else lens.shares
    facts: dict[str, Any] = {
        "fx": fx * mode.side,
        "fy": fy * mode.side,
        "cx": cx * mode.side - mode.left - 0.5,
        "cy": cy * mode.side - mode.top - 0.5,
        "width": mode.width,
        "height": mode.height,
    }
    if lens is None:
        return Camera(**facts, source=f"typical Azure Kinect, {mode.name}")
    distortion = Distortion.of("rational_polynomial", lens.distortion)
    return Camera(
        **facts, source="the camera's factory calibration in the file", distortion=distortion
    )


DEPTH = "depth.dat"
VIDEOS = ("depth.avi", "depth.mkv")
DEPTHS = (DEPTH, *VIDEOS)
_NOMINAL_HZ = 30.0  # rate of every camera that MoSeq supports
_SURPLUS = 0.05  # share of extra stamps: recorders also write those of frames without infrared
_KINECT_V2_SIZE = (512, 424)
_OTHER_SIZES = (
    (640, 480),
    (640, 576),
    (320, 288),
    (512, 512),
    (1024, 1024),
    (848, 480),
    (1280, 720),
)


@dataclass
class RawFrames(Stack):
    """Consecutive frames in a file without a header, read with `seek`; a `Stack`.

    Not a memory map: mapped pages count as the process's memory, so a long session would appear as
    a leak.

    Attributes:
        path: the file.
        width: columns of a frame, px.
        height: rows of a frame, px.
        dtype: of the stored values, "<u2" or ">u2".
        n: number of whole frames.
        truncated: True if the file ends in the middle of a frame, or its archive is cut.
        problems: sentences about the file.
        once: True for a file unpacked for this recording, which is read from front to back.
    """

    path: Path
    width: int
    height: int
    dtype: str
    n: int
    truncated: bool = False
    problems: list[str] = field(default_factory=list)
    once: bool = False

    def __post_init__(self) -> None:
        self._file = self.path.open("rb")
        self._lock = Lock()
        self._kept_from = 0  # earlier pages may have been released

    def __len__(self) -> int:
        return self.n

    def read(self, index: int) -> NDArray[Any]:
        """Stored values of one frame.

        Args:
            index: number of the frame.

        Returns:
            (H, W) 16-bit integers.

        Raises:
            RecordingError: the file became shorter.
        """
        n_bytes = 2 * self.width * self.height
        with self._lock:
            self._file.seek(index * n_bytes)
            raw = self._file.read(n_bytes)
            end = self._file.tell()
            # limits what the system caches of the file
            if self.once and not 0 <= end - self._kept_from < STRETCH:
                let_go(self._file, min(self._kept_from, end), end)
                self._kept_from = end
        if len(raw) < n_bytes:
            raise RecordingError(
                f"{self.path} became shorter while it was read; frame {index} is no longer there"
            )
        return np.frombuffer(raw, self.dtype).reshape(self.height, self.width)

    def label(self, index: int) -> str:
        """Name of a frame, for a message: the frame and the file."""
        return f"frame {index} of {self.path.name}"

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def open_moseq(
    path: Path, camera: Lens | None = None, fps: float | None = None, progress: Progress = silent
) -> Recording:
    """Open a MoSeq session: its folder, depth.dat, a depth video, or the archive around them.

    An archive is unpacked into a temporary folder, which is removed when the recording is closed.

    Args:
        path: the folder or file.
        camera: overrides the camera in the files.
        fps: frame rate, Hz; used only if there are no time stamps.
        progress: reports the progress of unpacking and indexing.

    Raises:
        RecordingError: there is no whole frame, or the camera is unknown.
    """
    names = (*STAMPS, METADATA, CAMERA_FILE)
    if path.suffix.lower() == ".dat":
        refuse_infrared(path, path.stem)
    opened = ExitStack()
    try:
        if path.is_dir() or path.suffix.lower() in (".dat", ".avi", ".mkv"):
            folder = path if path.is_dir() else path.parent
            depths = [folder / name for name in DEPTHS if (folder / name).is_file()]
            depth = next(iter(depths), path) if path.is_dir() else path
            files = {depth.name: depth} | {
                name: folder / name for name in names if (folder / name).is_file()
            }
            found = Unpacked(files, frozenset(), False)
            name = folder.resolve().name if depth.name in DEPTHS else depth.stem
            session = _Session(path, depth, found, camera, fps, progress)
            return session.open(name, list(files.values()), opened)
        # gzip has no random access, so the session is unpacked once into a temporary
        # folder
        scratch = Scratch()
        opened.callback(scratch.close)
        found = unpack(path, (*DEPTHS, *names), scratch.folder, progress)
        beside = path.parent / CAMERA_FILE
        if CAMERA_FILE not in found.files and beside.is_file():  # so that the folder opens as well
            shutil.copy(beside, scratch.folder)
        inside = next((found.files[name] for name in DEPTHS if name in found.files), None)
        if inside is None:
            raise RecordingError(
                f"{path} is cut short before its {DEPTH}, so no frame can be read; copy it again"
                if found.cut
                else f"{path} should hold a MoSeq session, but there is no {DEPTH} in it; give "
                "another archive"
            )
        session = _Session(path, inside, found, camera, fps, progress)
        name = re.sub(r"\.(tar\.gz|[^.]+)$", "", path.name, flags=re.IGNORECASE)
        return session.open(name, [path], opened, scratch.folder)
    except BaseException:
        opened.close()
        raise


class _Session:
    """A session being opened: its depth file, the files next to it, and problems so far."""

    def __init__(
        self,
        path: Path,
        depth: Path,
        found: Unpacked,
        camera: Lens | None,
        fps: float | None,
        progress: Progress,
    ) -> None:
        self.path = path
        self.depth = depth
        self.cut = found.cut
        self.progress = progress
        self.stated_camera = camera
        self.fps = fps
        self.camera_file = CameraFile.read(found.files.get(CAMERA_FILE, path.parent / CAMERA_FILE))
        self.metadata: Metadata = read_metadata(found.files.get(METADATA), found.cut)
        self.problems = [*self.camera_file.problems, *self.metadata.problems]
        self.doubts: list[str] = []
        self.stamps = read_session_stamps(
            found.files, found.cut, self.camera_file, self.problems, self.doubts
        )

    def open(
        self, name: str, sources: list[Path], opened: ExitStack, unpacked: Path | None = None
    ) -> Recording:
        """The recording.

        Args:
            name: its name.
            sources: the input files.
            opened: resources that closing the recording closes, added to.
            unpacked: folder of unpacked files; None if nothing was unpacked.
        """
        stack, track = self._open_depth(once=unpacked is not None)
        opened.callback(stack.close)
        camera = self._camera(stack, track)
        monotone = in_order_of_sensor(self._times(stack, track))
        self.problems += [monotone.problem] if monotone.problem else []
        began = "" if track is None else track.session_start
        start = {"session_start_time": began} if began else {}
        return Recording(
            name=name,
            format="moseq",
            camera=camera,
            times_ns=monotone.times_ns,
            read=Pictures(stack, self.camera_file.decode, self.problems).read,
            sources=sources,
            problems=self.problems,
            truncated=stack.truncated or self.cut,
            close=opened.close,
            faults=monotone.faults,
            doubts=self.doubts,
            stored=monotone.order,
            metadata={**start, **self.metadata.facts, **self.camera_file.metadata},
            unpacked=None if self.cut else unpacked,
        )

    def _open_depth(self, once: bool) -> tuple[Stack, DepthTrack | None]:
        if self.depth.suffix.lower() == ".dat":
            return self._open_raw(once), None
        from liex_lab.recordings.formats.video import open_video

        video = open_video(self.depth, self.progress)
        if self.metadata.size not in (None, (video.width, video.height)):
            self.problems.append(
                f"{METADATA} states pictures of {self.metadata.size}, but those in "
                f"{self.depth.name} have {video.width} x {video.height} pixels, which was used"
            )
        if video.truncated or self.cut:
            self.problems.append(
                f"{self.depth.name} is cut or damaged; its {len(video)} whole frames can be read"
            )
        return video, video.track

    def _open_raw(self, once: bool) -> RawFrames:
        n_bytes = self.depth.stat().st_size
        width, height = self.metadata.size or self._size_of_camera() or self._guess_size(n_bytes)
        n, left_over = divmod(n_bytes, 2 * width * height)
        if not n:
            raise RecordingError(
                f"{DEPTH} of {self.path} holds {n_bytes} bytes, less than one frame of {width} x "
                f"{height} pixels ({2 * width * height} bytes); copy the recording again, or state "
                f"DepthResolution in {METADATA}"
            )
        if left_over or self.cut:
            self.problems.append(
                f"{DEPTH} ends in the middle of frame {n}; its {n} whole frames can be read"
                if left_over
                else f"{DEPTH} holds {n} frames, but its archive is cut or damaged; its {n} whole "
                "frames can be read"
            )
        return RawFrames(
            self.depth,
            width,
            height,
            self.metadata.dtype,
            n,
            bool(left_over) or self.cut,
            once=once,
        )

    def _size_of_camera(self) -> tuple[int, int] | None:
        stated = self.stated_camera if isinstance(self.stated_camera, Camera) else self.camera_file
        return (stated.width, stated.height) if stated.width and stated.height else None

    def _guess_size(self, n_bytes: int) -> tuple[int, int]:
        """The size of a Kinect v2; an error if the stamps only match another camera's size."""
        n = 0 if self.stamps is None else len(self.stamps)
        kinect_bytes = 2 * _KINECT_V2_SIZE[0] * _KINECT_V2_SIZE[1]
        other = next(((w, h) for w, h in _OTHER_SIZES if n and n_bytes == 2 * w * h * n), None)
        if other is not None and n_bytes % kinect_bytes:
            raise RecordingError(
                f"{DEPTH} of {self.path} does not fit frames of 512 x 424 pixels, but it fits {n} "
                f"of {other[0]} x "
                f'{other[1]}; write {{"DepthResolution": [{other[0]}, {other[1]}]}} into '
                f"{METADATA} if that is your "
                "camera"
            )
        return _KINECT_V2_SIZE

    def _camera(self, stack: Stack, track: DepthTrack | None) -> Camera:
        """The stated camera, or else the factory calibration in the file, or else a typical camera
        of the recorded kind.
        """
        width, height = stack.width, stack.height
        if self.stated_camera is not None or self.camera_file.intrinsics:
            return self.camera_file.camera(width, height, self.stated_camera)
        mode = mode_of(width, height)
        attached = track.attachments if track is not None else ()
        lens = next(filter(None, map(read_calibration, attached)), None)
        if mode is not None and lens is not None:
            return azure_camera(mode, lens)
        # no other camera has a Kinect v2's size
        kind = self.metadata.camera or KINECT
        if track is not None and any(name.startswith("K4A_") for name in track.tags):
            kind = AZURE
        if kind == KINECT and (width, height) == _KINECT_V2_SIZE:
            typical, name = KINECT_V2, "Kinect v2"
        elif kind == AZURE and mode is not None:
            typical, name = azure_camera(mode, None), f"Azure Kinect in the mode {mode.name}"
        else:
            raise self._unknown_camera(width, height)
        self.problems.append(
            f"the files hold no intrinsics, so those of a typical {name} were taken; state your "
            "camera's own in a camera.toml beside the recording"
        )
        return typical

    def _unknown_camera(self, width: int, height: int) -> RecordingError:
        whose = (
            f"the camera {self.metadata.camera_name!r}"
            if self.metadata.camera_name
            else "a camera that is not known"
        )
        return RecordingError(
            f"{self.path} holds pictures of {width} x {height} pixels from {whose}; write a "
            "camera.toml beside it with [camera], fx = ..., fy = ..., cx = ... and cy = ... in "
            "pixels"
        )

    def _times(self, stack: Stack, track: DepthTrack | None) -> Times:
        """The stamps next to the depth, or else its own, or else a constant rate."""
        n = len(stack)
        own = None if track is None or not len(track.times_ns) else track
        hz = rate(self.fps, "the call") or self.camera_file.fps
        counted = self.stamps is not None and self.stamps.counts is not None
        if self.stamps is not None and (own is None or own.even or not counted):
            name = self.stamps.path.name
            known = None if own is None else 1e9 / max(median_step(own.times_ns), 1)
            stamps = self.stamps.times(hz or known, self.problems, self.doubts, _NOMINAL_HZ)
            if self.cut and 1 < len(stamps) < n:
                stamps = self._continue(stamps, n)
            if len(stamps) == n or own is None or own.even:
                extra = len(stamps) - n
                self.problems += match_counts(n, len(stamps), self.depth.name, name)
                if not 0 <= extra <= (len(stamps) if stack.truncated else max(3, _SURPLUS * n)):
                    self.doubts.append(unpaired(self.depth.name, name))
                return stamps[:n]
            self.problems.append(
                f"{self.depth.name} holds {n} frames but {name} holds {len(stamps)} time stamps; "
                "those of the video itself are used"
            )
        if own is not None and not (own.even and hz):
            if own.even:
                self.problems.append(
                    "there are no time stamps, so the constant "
                    f"{1e9 / max(median_step(own.times_ns), 1):g} frames/s that {self.depth.name} "
                    "states were assumed"
                )
            return own.times_ns
        origin = "as stated" if hz else "which is the usual rate; state fps if yours differs"
        self.problems.append(
            f"there are no time stamps, so a constant {hz or _NOMINAL_HZ:g} frames/s was assumed, "
            f"{origin}"
        )
        return from_rate(n, hz or _NOMINAL_HZ)

    def _continue(self, stamps: Times, n: int) -> Times:
        """Stamps for frames whose own were cut off: a frame is worth keeping without its exact
        time.
        """
        step = max(1, median_step(stamps))
        self.problems.append(
            f"the time stamps of the last {n - len(stamps)} frames are cut off, so these frames "
            f"were taken to follow every {step / 1e6:.4g} ms, the median step of those before"
        )
        return np.concatenate([stamps, stamps[-1] + step * np.arange(1, n - len(stamps) + 1)])
