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
import tarfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from isal import isal_zlib
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import KINECT_V2, Camera, Distortion, Lens
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile, rate, refuse_infrared
from liex_lab.recordings.formats.images.files import Size, Stack
from liex_lab.recordings.frame import unread_where_damaged
from liex_lab.recordings.recording import Recording, closing_on_error
from liex_lab.recordings.timestamp_files import Stamps, read_stamps
from liex_lab.recordings.timestamps import (
    Times,
    from_rate,
    in_order_of_sensor,
    match_counts,
    median_step,
    start_of_day,
    unpaired,
)
from liex_lab.runtime.durable import Scratch, is_full
from liex_lab.runtime.progress import Progress, silent
from liex_lab.runtime.text_files import read_text

if TYPE_CHECKING:
    from liex_lab.recordings.formats.video import DepthVideo


_PACKED = 1 << 18  # packed bytes read at once
_PIECE = 1 << 17  # unpacked bytes: an empty image is a thousand times its packed size
_GZIP_MAGIC = b"\x1f\x8b"


class _Member(tarfile.TarInfo):
    """A member of an archive, with size limits: tarfile reads any name or note into memory."""

    _LONG = (
        tarfile.GNUTYPE_LONGNAME,
        tarfile.GNUTYPE_LONGLINK,
        tarfile.XHDTYPE,
        tarfile.XGLTYPE,
        tarfile.SOLARIS_XHDTYPE,
    )

    def _proc_member(self, tar: tarfile.TarFile) -> tarfile.TarInfo:
        if self.type == tarfile.GNUTYPE_SPARSE:
            raise RecordingError(
                "the archive has a file with holes in it (GNU sparse); pack the session's folder "
                "again, without --sparse"
            )
        # bytes of a member's name or notes
        if self.type in self._LONG and self.size > (1 << 20):
            raise RecordingError(
                f"the archive has a name or note of {self.size} bytes, which no recording has; "
                "pack the session's folder again"
            )
        found: tarfile.TarInfo = super()._proc_member(tar)  # type: ignore[misc]
        return found


class _Damaged(Exception):
    """ISA-L found damage; zlib then locates it."""


class _ArchiveBytes:
    """The unpacked bytes of an archive, in order, up to its last good byte.

    Attributes:
        zipped: whether the archive is packed by gzip.
        whole: whether it is complete, once read to its end.
    """

    def __init__(self, file: IO[bytes], size: int, progress: Progress, fast: bool) -> None:
        """Start to unpack.

        Args:
            file: the open archive.
            size: its bytes.
            progress: reports how many MB were unpacked.
            fast: use ISA-L, which raises `_Damaged` on damage.
        """
        self._file = file
        self._size = size
        self._progress = progress
        self.zipped = file.read(2) == _GZIP_MAGIC
        file.seek(0)
        self.whole = not self.zipped
        self._coming = (
            self._unpacked(fast) if self.zipped else iter(partial(file.read, _PIECE), b"")
        )
        self._piece = memoryview(b"")  # rest of the last one
        self._n_read = 0

    def read(self, n: int) -> bytes:
        """Some of the next bytes, at most n; empty at their end.

        Raises:
            RecordingError: the compression ratio is implausible for a recording.
        """
        while not self._piece:
            piece = next(self._coming, None)
            packed = self._file.tell()
            self._progress(packed >> 20, (self._size >> 20) + 1, "unpacking the recording (MB)")
            if piece is None:
                return b""
            self._piece = memoryview(piece)
            self._n_read += len(piece)
            # bytes unpacked at any compression ratio; true images have noise
            if self._n_read > (1 << 29) and self._n_read > 200 * max(packed, 1):
                raise RecordingError(
                    "the archive unpacks to more than 200 times its size, which no recording does; "
                    "pack the session's folder again"
                )
        part = bytes(self._piece[:n])
        self._piece = self._piece[n:]
        return part

    def _unpacked(self, fast: bool) -> Iterator[bytes]:
        """The archive unpacked by ISA-L, or by zlib up to the last good byte."""
        library: Any = isal_zlib if fast else zlib
        inflate = library.decompressobj(31)
        while packed := self._file.read(_PACKED):
            while packed:
                if inflate.eof:
                    # a gzip file may have several members; anything else after it is
                    # padding
                    if len(packed) < len(_GZIP_MAGIC):
                        packed += self._file.read(_PACKED)
                    if not packed.startswith(_GZIP_MAGIC):
                        return
                    inflate = library.decompressobj(31)
                spare = inflate if fast else inflate.copy()
                try:
                    yield inflate.decompress(packed, _PIECE)
                except library.error as error:
                    if fast:
                        raise _Damaged from error
                    self.whole = False
                    with suppress(zlib.error):  # zlib withholds the whole damaged piece
                        for k in range(len(packed)):
                            yield spare.decompress(packed[k : k + 1])
                    return
                self.whole = inflate.eof
                packed = inflate.unused_data if inflate.eof else inflate.unconsumed_tail
        if not self.whole:
            yield inflate.flush()


def unpack(
    archive: Path, wanted: Sequence[str], folder: Path, progress: Progress
) -> tuple[dict[str, Path], bool]:
    """Write the wanted members of a .tar or .tar.gz into a folder, by their plain names.

    Args:
        archive: the .tar, .tar.gz or .tgz file.
        wanted: plain names of the members to write.
        folder: the output folder.
        progress: reports how many MB were unpacked.

    Returns:
        The files written, by their plain names, and whether the archive is cut or damaged.

    Raises:
        RecordingError: nothing can be unpacked, a wanted name occurs twice, or the disk is full.
    """
    with suppress(_Damaged):
        return _unpack(archive, wanted, folder, progress, fast=True)
    return _unpack(archive, wanted, folder, progress, fast=False)


def _unpack(
    archive: Path, wanted: Sequence[str], folder: Path, progress: Progress, fast: bool
) -> tuple[dict[str, Path], bool]:
    """`unpack` by ISA-L or by zlib.

    Raises:
        _Damaged: ISA-L found damage and zlib may recover more.
    """
    files: dict[str, Path] = {}
    names: set[str] = set()
    cut = False
    with archive.open("rb") as file:
        stream = _ArchiveBytes(file, archive.stat().st_size, progress, fast)
        try:
            with tarfile.open(fileobj=stream, mode="r|", tarinfo=_Member, bufsize=_PIECE) as tar:  # type: ignore[call-overload]
                for member in tar:
                    name = PurePosixPath(member.name).name
                    if not member.isfile() or name.startswith("._"):
                        continue
                    if name in wanted and name in names:
                        raise RecordingError(
                            f"{archive} holds more than one {name}; unpack it and give the folder "
                            "of one session"
                        )
                    names.add(name)
                    if name in wanted:
                        (folder / name).unlink(missing_ok=True)  # frees its disk space
                        _check_size(archive, member, folder)
                        files[name] = folder / name
                        _copy(member, files[name], tar.fileobj)
        except tarfile.TarError:
            if not names and not (fast and stream.zipped):
                raise RecordingError(
                    f"{archive} should be a MoSeq session packed as .tar.gz, but nothing can be "
                    "unpacked from it; pack the session's folder again"
                ) from None
            cut = True
        # a tar ends before the gzip around it, and only gzip's end shows that it is whole
        while stream.read(_PIECE):
            pass
    cut = cut or not stream.whole
    if cut and fast and stream.zipped:
        raise _Damaged
    return files, cut


def _check_size(archive: Path, member: tarfile.TarInfo, folder: Path) -> None:
    """Raises RecordingError if a member is too large for its type, or for the disk."""
    name = PurePosixPath(member.name).name
    if member.issparse():
        raise RecordingError(
            f"{archive} has a file with holes in it, {name}; pack the session's folder again"
        )
    is_note = PurePosixPath(name).suffix in (".json", ".txt", ".csv", ".toml")
    # bytes of any file but the images: stamps of days
    if is_note and member.size > (1 << 28):
        raise RecordingError(
            f"{archive} has a {name} of {member.size / 1e9:.1f} GB, which holds no stamps or "
            "notes; pack the session's folder again"
        )
    room = shutil.disk_usage(folder).free
    if member.size > room:
        raise _no_room(member, folder, f", where {room / 1e9:.1f} GB are free")


def _no_room(member: tarfile.TarInfo, folder: Path, free: str) -> RecordingError:
    return RecordingError(
        f"there is no room to unpack {member.size / 1e9:.1f} GB into {folder}{free}; free some, or "
        "set TMPDIR to a folder on a larger disk"
    )


def _copy(member: tarfile.TarInfo, to: Path, stream: Any) -> None:
    """Write the next member up to its last byte.

    Raises:
        ReadError: the archive ends before it.
    """
    left = member.size
    try:
        with to.open("wb") as out:
            while left and (part := stream.read(min(left, _PIECE))):
                left -= out.write(part)
    except OSError as error:
        if is_full(error):
            raise _no_room(member, to.parent, "") from None
        raise
    if left:
        raise tarfile.ReadError("the archive ends within a file")


# Metadata of a MoSeq session: metadata.json, depth_ts.txt (ms) and timestamps.csv (s).


STAMPS = {"depth_ts.txt": 10**6, "timestamps.csv": 10**9}  # file: nanoseconds in its unit
METADATA = "metadata.json"
# kinds of cameras
AZURE = "Azure Kinect"
KINECT = "Kinect v2"
OTHER = "other"

_CAMERA_KEYS = (
    "camera",
    "cameratype",
    "cameramodel",
    "device",
    "devicename",
    "devicemodel",
    "sensor",
)
_CAMERA_WORDS = {  # word in a camera's name: its kind; the first match counts
    "azure": AZURE,
    "k4a": AZURE,
    "femto": AZURE,
    "kinectv2": KINECT,
    "kinect2": KINECT,
    "kinectone": KINECT,
    "kinectforwindowsv2": KINECT,
}


@dataclass(frozen=True)
class Metadata:
    """Contents of metadata.json.

    Attributes:
        size: (width, height), px; None if absent.
        dtype: of the stored depths, "<u2" or ">u2".
        camera: `AZURE`, `KINECT` or `OTHER`; None if absent.
        camera_name: the camera's name in the file; empty if absent.
        facts: for `Recording.metadata`.
        problems: sentences about ignored values.
    """

    size: tuple[int, int] | None = None
    dtype: str = "<u2"
    camera: str | None = None
    camera_name: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)


def read_metadata(path: Path | None, cut: bool) -> Metadata:
    """Parse metadata.json, which is often missing.

    Args:
        path: the file; None for empty metadata.
        cut: True if its archive is cut; a broken file is then ignored instead of refused.

    Raises:
        RecordingError: the file is not a JSON object, or its DepthResolution is invalid.
    """
    if path is None:
        return Metadata()
    try:
        document = json.loads(read_text(path))
        if not isinstance(document, dict):
            raise ValueError("it is not an object in braces")
    except (
        ValueError,
        RecursionError,
    ) as error:  # broken JSON and broken UTF-8 are both ValueErrors
        if cut:
            return Metadata(problems=[f"{METADATA} is cut short and was not used"])
        raise RecordingError(
            f"{METADATA} of the session is not JSON ({error}); correct or remove it"
        ) from None
    return stated_in(document)


def stated_in(document: dict[str, Any]) -> Metadata:
    """What the metadata of a session state.

    Args:
        document: the content of metadata.json, or its copy in a file of results.

    Raises:
        RecordingError: DepthResolution is invalid.
    """
    stated = document.get("StartTime")
    facts = {
        key: str(value).strip()
        for key, value in {
            "subject_id": document.get("SubjectName"),
            "session_name": document.get("SessionName"),
            "session_start_time": start_of_day(stated),
        }.items()
        if type(value) in (str, int) and str(value).strip()
    }
    problems = []
    if stated is not None and "session_start_time" not in facts:
        problems.append(
            f"StartTime {stated!r} in {METADATA} is not a time with a zone, so it was not used"
        )
    size = document.get("DepthResolution")
    if size is not None and not (
        isinstance(size, list)
        and len(size) == 2
        and all(type(v) is int and 0 < v < 20_000 for v in size)
    ):
        raise RecordingError(
            f"{METADATA} states DepthResolution = {size!r}; it is [width, height] in pixels"
        )
    dtype = ">u2" if document.get("IsLittleEndian", True) is False else "<u2"
    # programs for MoSeq have no common key for the camera
    entries = {
        key.lower().replace("_", "").replace(" ", ""): value for key, value in document.items()
    }
    named = (entries[key].strip() for key in _CAMERA_KEYS if isinstance(entries.get(key), str))
    name = next(filter(None, named), "")
    plain = "".join(letter for letter in name.lower() if letter.isalnum())
    known = (camera for word, camera in _CAMERA_WORDS.items() if word in plain)
    kind = next(known, OTHER if name else None)
    return Metadata((size[0], size[1]) if size else None, dtype, kind, name, facts, problems)


def read_session_stamps(
    files: dict[str, Path],
    cut: bool,
    camera_file: CameraFile,
    problems: list[str],
    doubts: list[str],
) -> Stamps | None:
    """Read the file of time stamps next to the depth.

    depth_ts.txt is in milliseconds and timestamps.csv in seconds, unless their first line names a
    column in another unit, or camera.toml does. In a cut archive, half a number at the end is
    dropped, also from the file.

    Args:
        files: the session's files by name.
        cut: True if their archive is cut.
        camera_file: may state the column of times and its unit.
        problems: sentences, appended to if there are no stamps.
        doubts: reasons why the times are unreliable, appended to.

    Returns:
        The stamps; None if absent.

    Raises:
        RecordingError: a line has no valid stamp.
    """
    name = next((name for name in STAMPS if name in files), None)
    if name is None:
        return None
    path = files[name]
    if cut:  # the archive may end inside this file: half a number is a wrong number
        text = path.read_bytes()
        path.write_bytes(text[: text.rfind(b"\n") + 1])
    stated = (camera_file.time_column, camera_file.time_unit, STAMPS[name])
    stamps = read_stamps(path, doubts, *stated)
    if not len(stamps):
        problems.append(f"{name} holds no time stamp")
        return None
    return stamps


# columns and rows of a depth mode's images, px: its name in the Azure Kinect SDK, the side of
# the sensor after binning, and column and row of the image's corner on the sensor, px
MODES = {
    (640, 576): ("NFOV_UNBINNED", 1024, 192, 180),
    (320, 288): ("NFOV_2X2BINNED", 512, 96, 90),
    (512, 512): ("WFOV_2X2BINNED", 512, 0, 0),
    (1024, 1024): ("WFOV_UNBINNED", 1024, 0, 0),
}
_TYPICAL = (
    0.5,
    0.5,
    0.492,
    0.492,
)  # cx, cy, fx, fy as shares of the sensor's side; units differ by about 1 %


# cx, cy, fx, fy as shares of the sensor's side, and k1 k2 p1 p2 k3 k4 k5 k6
FactoryLens = tuple[tuple[float, ...], tuple[float, ...]]


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
            if c.get("Location") == "CALIBRATION_CameraLocationD0"
            or c.get("Purpose") == "CALIBRATION_CameraPurposeDepth"
        )
        values = [float(value) for value in depth["Intrinsics"]["ModelParameters"]]
    except (ValueError, KeyError, TypeError, AttributeError, StopIteration, RecursionError):
        return None
    if len(values) < 14 or not np.isfinite(values).all() or min(values[2:4]) <= 0:
        return None
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = values[:14]
    return (cx, cy, fx, fy), (k1, k2, p1, p2, k3, k4, k5, k6)


def azure_camera(size: Size, lens: FactoryLens | None) -> Camera:
    """The camera of a depth mode, in pixels of its images.

    Pixel (0, 0) is the centre of the top-left pixel, hence the half that is subtracted.

    Args:
        size: of the mode's images, a key of `MODES`.
        lens: the factory calibration; None for typical values, which differ by about 1 % between
            units.

    Returns:
        The camera, with distortion if lens is given.
    """
    name, side, left, top = MODES[size]
    shares, bent = lens or (_TYPICAL, ())
    cx, cy, fx, fy = (share * side for share in shares)
    source = "the camera's factory calibration in the file"
    return Camera(
        fx,
        fy,
        cx - left - 0.5,
        cy - top - 0.5,
        *size,
        source if lens else f"typical Azure Kinect, {name}",
        distortion=Distortion.of("rational_polynomial", bent),
    )


def assumed_camera(
    path: Path, size: Size, kind: str, metadata: Metadata, problems: list[str]
) -> Camera:
    """The typical camera of a recording without intrinsics.

    Args:
        path: the recording, for the error message.
        size: columns and rows of the images, px.
        kind: of the camera, see `Metadata`; no camera but a Kinect v2 has the size of its images.
        metadata: may name the camera.
        problems: sentences, appended to.

    Raises:
        RecordingError: no known camera of that kind has such images.
    """
    if kind == KINECT and size == _KINECT_V2_SIZE:
        typical, name = KINECT_V2, "Kinect v2"
    elif kind == AZURE and size in MODES:
        typical = azure_camera(size, None)
        name = f"Azure Kinect in the mode {MODES[size][0]}"
    else:
        whose = f"the camera {metadata.camera_name!r}"
        raise RecordingError(
            f"{path} holds images of {size[0]} x {size[1]} pixels from "
            f"{whose if metadata.camera_name else 'a camera that is not known'}; write a "
            "camera.toml beside it with [camera], fx = ..., fy = ..., cx = ... and cy = ... in "
            "pixels"
        )
    problems.append(
        f"the files hold no intrinsics, so those of a typical {name} were taken; state your "
        "camera's own in a camera.toml beside the recording"
    )
    return typical


DEPTH = "depth.dat"
DEPTHS = (DEPTH, "depth.avi", "depth.mkv")
NOMINAL_HZ = 30.0  # rate of every camera that MoSeq supports
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


class RawFrames(Stack):
    """Consecutive frames in a file without a header, read with `seek`.

    Not a memory map: mapped pages count as the process's memory, so a long session would appear as
    a leak.
    """

    def __init__(self, path: Path, size: Size, dtype: str, n: int, truncated: bool) -> None:
        """Open the file.

        Args:
            path: the file.
            size: columns and rows of a frame, px.
            dtype: of the stored values, "<u2" or ">u2".
            n: number of whole frames.
            truncated: True if the file ends in the middle of a frame, or its archive is cut.
        """
        super().__init__(size, [True] * n, truncated)
        self._path = path
        self._dtype = dtype
        self._file = path.open("rb")
        self._lock = Lock()

    def read(self, index: int) -> NDArray[Any]:
        """Stored values of one frame, (H, W) 16-bit integers.

        Raises:
            RecordingError: the file became shorter.
        """
        n_bytes = 2 * self.width * self.height
        with self._lock:
            self._file.seek(index * n_bytes)
            raw = self._file.read(n_bytes)
        if len(raw) < n_bytes:
            raise RecordingError(
                f"{self._path} became shorter while it was read; frame {index} is no longer there"
            )
        return np.frombuffer(raw, self._dtype).reshape(self.height, self.width)

    def label(self, index: int) -> str:
        """Name of a frame, for a message: the frame and the file."""
        return f"frame {index} of {self._path.name}"

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
    with closing_on_error(opened):
        if path.is_dir() or path.suffix.lower() in (".dat", ".avi", ".mkv"):
            folder = path if path.is_dir() else path.parent
            depths = [folder / name for name in DEPTHS if (folder / name).is_file()]
            depth = next(iter(depths), path) if path.is_dir() else path
            files = {depth.name: depth} | {
                name: folder / name for name in names if (folder / name).is_file()
            }
            name = folder.resolve().name if depth.name in DEPTHS else depth.stem
            session = _Session(path, depth, files, False, camera, fps, progress)
            return session.open(name, list(files.values()), opened)
        # gzip has no random access, so the session is unpacked once into a temporary
        # folder
        scratch = Scratch()
        opened.callback(scratch.close)
        files, cut = unpack(path, (*DEPTHS, *names), scratch.folder, progress)
        beside = path.parent / CAMERA_FILE
        if CAMERA_FILE not in files and beside.is_file():  # so that the folder opens as well
            shutil.copy(beside, scratch.folder)
        inside = next((files[name] for name in DEPTHS if name in files), None)
        if inside is None:
            raise RecordingError(
                f"{path} is cut short before its {DEPTH}, so no frame can be read; copy it again"
                if cut
                else f"{path} should hold a MoSeq session, but there is no {DEPTH} in it; give "
                "another archive"
            )
        session = _Session(path, inside, files, cut, camera, fps, progress)
        name = re.sub(r"\.(tar\.gz|[^.]+)$", "", path.name, flags=re.IGNORECASE)
        return session.open(name, [path], opened, scratch.folder)


class _Session:
    """A session being opened: its depth file, the files next to it, and problems so far."""

    def __init__(
        self,
        path: Path,
        depth: Path,
        files: dict[str, Path],
        cut: bool,
        camera: Lens | None,
        fps: float | None,
        progress: Progress,
    ) -> None:
        self.path = path
        self.depth = depth
        self.cut = cut
        self.progress = progress
        self.stated_camera = camera
        self.fps = fps
        self.camera_file = CameraFile.read(files.get(CAMERA_FILE, path.parent / CAMERA_FILE))
        self.metadata = read_metadata(files.get(METADATA), cut)
        self.problems = [*self.camera_file.problems, *self.metadata.problems]
        self.doubts: list[str] = []
        self.stamps = read_session_stamps(files, cut, self.camera_file, self.problems, self.doubts)

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
        video: DepthVideo | None = None
        if self.depth.suffix.lower() == ".dat":
            stack: Stack = self._open_raw()
        else:
            stack = video = self._open_video()
        opened.callback(stack.close)
        camera = self._camera(stack, video)
        monotone = in_order_of_sensor(self._times(stack, video))
        self.problems += [monotone.problem] if monotone.problem else []
        start = {} if video is None else {"session_start_time": video.session_start}
        facts = {**start, **self.metadata.facts, **self.camera_file.metadata}
        size = (stack.height, stack.width)
        return Recording(
            name=name,
            format="moseq",
            camera=camera,
            times_ns=monotone.times_ns,
            read=unread_where_damaged(stack.depth(self.camera_file.decode), size, self.problems),
            sources=sources,
            problems=self.problems,
            truncated=stack.truncated or self.cut,
            close=opened.close,
            faults=monotone.faults,
            doubts=self.doubts,
            stored=monotone.order,
            metadata={key: fact for key, fact in facts.items() if fact},
            unpacked=None if self.cut else unpacked,
        )

    def _open_video(self) -> DepthVideo:
        from liex_lab.recordings.formats.video import DepthVideo

        video = DepthVideo(self.depth, self.progress)
        if self.metadata.size not in (None, (video.width, video.height)):
            self.problems.append(
                f"{METADATA} states images of {self.metadata.size}, but those in "
                f"{self.depth.name} have {video.width} x {video.height} pixels, which was used"
            )
        if video.truncated or self.cut:
            self.problems.append(
                f"{self.depth.name} is cut or damaged; its {len(video)} whole frames can be read"
            )
        return video

    def _open_raw(self) -> RawFrames:
        n_bytes = self.depth.stat().st_size
        camera = self.stated_camera if isinstance(self.stated_camera, Camera) else self.camera_file
        stated = (camera.width, camera.height) if camera.width and camera.height else None
        width, height = self.metadata.size or stated or self._guess_size(n_bytes)
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
        cut = bool(left_over) or self.cut
        return RawFrames(self.depth, (width, height), self.metadata.dtype, n, cut)

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

    def _camera(self, stack: Stack, video: DepthVideo | None) -> Camera:
        """The stated camera, or else the factory calibration in the file, or else a typical camera
        of the recorded kind.
        """
        width, height = stack.width, stack.height
        if self.stated_camera is not None or self.camera_file.intrinsics:
            return self.camera_file.camera(width, height, self.stated_camera)
        attached = () if video is None else video.attachments
        lens = next(filter(None, map(read_calibration, attached)), None)
        if (width, height) in MODES and lens is not None:
            return azure_camera((width, height), lens)
        kind = self.metadata.camera or KINECT
        if video is not None and any(name.startswith("K4A_") for name in video.tags):
            kind = AZURE
        return assumed_camera(self.path, (width, height), kind, self.metadata, self.problems)

    def _times(self, stack: Stack, own: DepthVideo | None) -> Times:
        """The stamps next to the depth, or else its own, or else a constant rate."""
        n = len(stack)
        hz = rate(self.fps, "the call") or self.camera_file.fps
        counted = self.stamps is not None and self.stamps.counts is not None
        if self.stamps is not None and (own is None or own.even or not counted):
            name = self.stamps.path.name
            known = None if own is None else 1e9 / max(median_step(own.times_ns), 1)
            stamps = self.stamps.times(hz or known, self.problems, self.doubts, NOMINAL_HZ)
            if self.cut and 1 < len(stamps) < n:  # a frame is worth keeping without its exact time
                step = max(1, median_step(stamps))
                n_late = n - len(stamps)
                self.problems.append(
                    f"the time stamps of the last {n_late} frames are cut off, so these frames "
                    f"were taken to follow every {step / 1e6:.4g} ms, the median step of those "
                    "before"
                )
                stamps = np.append(stamps, stamps[-1] + step * np.arange(1, n_late + 1))
            if len(stamps) == n or own is None or own.even:
                extra = len(stamps) - n
                self.problems += match_counts(n, len(stamps), self.depth.name, name)
                # share of extra stamps: recorders also write those of frames without infrared
                if not 0 <= extra <= (len(stamps) if stack.truncated else max(3, 0.05 * n)):
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
            f"there are no time stamps, so a constant {hz or NOMINAL_HZ:g} frames/s was assumed, "
            f"{origin}"
        )
        return from_rate(n, hz or NOMINAL_HZ)
