"""Lazy, re-iterable sequence of depth frames from one camera, independent of the file format.

A `Recording` keeps the time stamps and the camera; depth frames are decoded on request, so memory
use does not grow with length. Time stamps are integer nanoseconds and strictly increasing; a gap is
a step of more than 1.5 median steps. The SHA-256 of its files identifies the input.
"""

from __future__ import annotations

import hashlib
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.frame import Depth, DepthFrame, marked, region_mask, side_by_side
from liex_lab.recordings.timestamps import (
    FAULTS,
    JUMPED,
    Gap,
    clock_doubts,
    find_faults,
    find_gaps,
    median_step,
)
from liex_lab.runtime.durable import is_full
from liex_lab.runtime.memory import why_short
from liex_lab.runtime.progress import Progress, silent

# name, size (bytes) and modification time (ns) of each file
Stamp = list[list[Any]]

_BLOCK = 1 << 24  # bytes per read: after each, other threads may hold the GIL for a while
_GONE = -1  # size of a missing file


class SourceFiles:
    """The input files of a recording, shared by its slices; empty for a recording without files.

    Attributes:
        paths: the files.
        stamp_at_opening: their `stamp` when the recording was opened.
        known_digest: hexadecimal SHA-256 of the same, unchanged files; None if not yet computed.
    """

    def __init__(self, paths: Iterable[Path] = ()) -> None:
        """Record the current state of the files."""
        self.paths = tuple(paths)
        self.stamp_at_opening = self.stamp
        self.known_digest: str | None = None

    @property
    def stamp(self) -> Stamp:
        """State of each file, sorted: a cheap check for changes; a missing file has size -1."""
        found: Stamp = []
        for path in self.paths:
            found.append([path.name, _GONE, 0])
            with suppress(OSError):
                found[-1][1:] = path.stat().st_size, path.stat().st_mtime_ns
        return sorted(found)

    def digest(self, progress: Progress = silent) -> str:
        """SHA-256 of the files, see `file_digest`; computed once and cached.

        Args:
            progress: reports how many MB were read.
        """
        if self.known_digest is None:
            self.known_digest = file_digest(self.paths, progress)
        return self.known_digest

    def rewritten(self) -> tuple[str, ...]:
        """A sentence if files were modified since the recording was opened; () otherwise.

        Files that only grew (see `grown`) or were removed do not count.
        """
        return self._sentence(
            lambda size, time, before, then: (
                size != _GONE and (size < before or (size == before and time != then))
            ),
            "changed while the recording was measured, so that frames of two recordings may be "
            "mixed; run it again",
        )

    def grown(self) -> tuple[str, ...]:
        """A sentence if files grew since the recording was opened; () otherwise."""
        return self._sentence(
            lambda size, time, before, then: size > before,
            "grew while the recording was measured; what was appended is not in the session",
        )

    def _sentence(
        self, applies: Callable[[int, int, int, int], bool], what: str
    ) -> tuple[str, ...]:
        """What happened to the files to whose size and time, now and at opening, it applies."""
        names = [
            name
            for (name, *now), (_, *then) in zip(self.stamp, self.stamp_at_opening, strict=True)
            if applies(*now, *then)
        ]
        return (f"{names[0] if len(names) == 1 else f'{len(names)} files'} {what}",) * bool(names)


def file_digest(files: Iterable[Path], progress: Progress = silent) -> str:
    """SHA-256 of one file, or of several files together.

    For one file, its bytes are hashed; for several, the name, size and bytes of each, in order of
    name.

    Args:
        files: the paths of the files, in any order.
        progress: reports how many MB were read.

    Returns:
        64 hexadecimal digits.
    """
    ordered = sorted(files, key=lambda path: path.name)
    sizes = [path.stat().st_size for path in ordered]
    whole = hashlib.sha256()
    done = 0
    room = memoryview(bytearray(_BLOCK))  # allocating memory per block takes as long as reading it
    total = (sum(sizes) >> 20) + 1
    for path, size in zip(ordered, sizes, strict=True):
        if len(ordered) > 1:
            whole.update(f"{path.name}\0{size}\0".encode())
        with path.open("rb", buffering=0) as file:
            while n := file.readinto(room):
                whole.update(room[:n])
                done += n
                progress(done >> 20, total, "reading the recording's hash (MB)")
    return whole.hexdigest()


@contextmanager
def closing_on_error(opened: Any) -> Iterator[None]:
    """Close what was opened if the block fails; the recording closes it otherwise."""
    try:
        yield
    except BaseException:
        opened.close()
        raise


class Recording:
    """Depth frames from one camera, in order of time, read one at a time.

    A format creates one by passing `read`, which decodes the depth of a stored frame. Memory use
    does not grow with length; each iteration reads the files again and yields the same frames.

    Attributes:
        name: name of the recording, usually that of its file or folder without the suffix.
        format: name of the format, such as "images", "moseq", "mcap", "oni" or "rosbag".
        camera: the camera of the depth images.
        files: the input files, shared with slices; empty for a recording without files.
        times_ns: (n,) int64 time stamps on the recording's own clock, ns, strictly increasing;
            read-only.
        problems: sentences about irregularities in the files, including those found while reading.
        doubts: the problems that may make lengths or times wrong; each becomes a reason of the
            verdict.
        truncated: True if the file is cut or damaged.
        metadata: facts that the files state, such as subject_id and session_start_time (ISO 8601
            with zone).
        measured: what the files state of each stored frame, measured by another program, by name;
            see `measurements`.
        optics: corrections applied on reading (distortion, water, mirroring), empty if none; see
            `rectify`.
        reopen: opens the same, unchanged files once more, without what takes long the first time;
            None if nothing does.
        unpacked: folder with the unpacked archive, which opens as the same recording while this one
            is open; None if nothing was unpacked.
        region_px: (u, v) corners, pixels, of the polygon outside of which all pixels are unread; ()
            for whole images, see `masked`.
    """

    def __init__(
        self,
        *,
        name: str,
        format: str,
        camera: Camera,
        times_ns: NDArray[np.int64],
        read: Callable[[int], Depth],
        sources: Sequence[Path] | SourceFiles = (),
        problems: list[str] | None = None,
        truncated: bool = False,
        whole: NDArray[np.bool_] | None = None,
        metadata: dict[str, Any] | None = None,
        close: Callable[[], None] | None = None,
        step_ns: int | None = None,
        stored: NDArray[np.int64] | None = None,
        faults: NDArray[np.uint8] | None = None,
        grow: Callable[[], Recording | None] | None = None,
        unpacked: Path | None = None,
        doubts: list[str] | None = None,
    ) -> None:
        """Check and freeze the time stamps; no frame is read.

        Of the arguments that are not attributes, `read` decodes a stored frame, by its number, to
        depth (H, W) float32 mm, 0 where unread; `sources` are the input files, or () for a
        recording without files; `whole` (n,) states which frames are whole (None: all); `close`
        closes open files, once, at the latest when the recording is garbage collected; `step_ns`
        is the median step (None: computed); `stored` (n,) is the number of the stored frame of
        each row (None: 0 ... n - 1); `faults` (n,) states which stamps were moved and why, an
        index into `FAULTS` (None: none); `grow` opens the data appended to the files since, see
        `grown`. The lists `problems` and `doubts` are shared, so reading may append to them.

        Raises:
            RecordingError: there is no frame, or the stamps do not increase strictly.
        """
        self.name = name
        self.format = format
        self.camera = camera
        self.times_ns = np.ascontiguousarray(times_ns, np.int64)
        self.problems: list[str] = [] if problems is None else problems
        self.doubts: list[str] = [] if doubts is None else doubts
        self.problems += [doubt for doubt in self.doubts if doubt not in self.problems]
        self.truncated = truncated
        self.metadata: dict[str, Any] = {} if metadata is None else dict(metadata)
        self.measured: dict[str, NDArray[np.float64]] = {}
        self.optics: dict[str, Any] = {}
        self.region_px: tuple[tuple[float, float], ...] = ()
        self.unpacked = unpacked
        self._read = read
        self.files = sources if isinstance(sources, SourceFiles) else SourceFiles(sources)
        self._stored = np.arange(len(self.times_ns)) if stored is None else stored
        self._whole_frames = np.ones(len(self.times_ns), np.bool_) if whole is None else whole
        self._faults = np.zeros(len(self.times_ns), np.uint8) if faults is None else faults
        self._step_ns = median_step(self.times_ns) if step_ns is None else step_ns
        self._whole: Recording | None = None
        self._grow = grow
        self.reopen: Callable[[], Recording] | None = None
        self._closed = False
        if not len(self.times_ns):
            raise RecordingError(f"{name} holds no frame; a recording has at least one")
        if not np.all(np.diff(self.times_ns) > 0):
            raise RecordingError(
                f"the time stamps of {name} do not increase strictly; pass them through "
                "`make_monotone`"
            )
        self.times_ns.flags.writeable = False
        # at the latest on garbage collection or when the program ends
        self._close = None if close is None else weakref.finalize(self, close)

    @property
    def sources(self) -> tuple[Path, ...]:
        """The input files; empty for a recording without files."""
        return self.files.paths

    @property
    def stamp_faults(self) -> NDArray[np.uint8]:
        """(n,) which stamps were moved and why, an index into `timestamps.FAULTS`; a copy."""
        return self._faults.copy()

    @property
    def measurements(self) -> dict[str, NDArray[np.float64]]:
        """What the files state of each frame (n,), measured by another program, by name."""
        return {name: values[self._stored] for name, values in self.measured.items()}

    @property
    def n_whole(self) -> int:
        """Number of whole frames."""
        return int(self._whole_frames.sum())

    @property
    def width(self) -> int:
        """Columns of a depth image, px."""
        return self.camera.width

    @property
    def height(self) -> int:
        """Rows of a depth image, px."""
        return self.camera.height

    @property
    def rate_hz(self) -> float:
        """Frame rate without gaps, Hz; NaN for a single frame.

        The inverse of the usual step between neighbouring frames, see `median_step`.
        """
        return 1e9 / self._step_ns if self._step_ns else float("nan")

    @property
    def clock_doubts(self) -> tuple[str, ...]:
        """Reasons why the times are unreliable, in sentences; usually empty."""
        return clock_doubts(self._step_ns, self._faults)

    @property
    def duration_s(self) -> float:
        """Time from the first frame to the last, s."""
        return int(self.times_ns[-1] - self.times_ns[0]) / 1e9

    @property
    def gaps(self) -> list[Gap]:
        """Intervals in which the camera dropped frames: steps of more than 1.5 median steps.

        A gap at which the clock jumped has the reason `JUMPED`.
        """
        found = find_gaps(self.times_ns, self._step_ns)
        return [replace(gap, reason=JUMPED) if self._jumped(gap) else gap for gap in found]

    def _jumped(self, gap: Gap) -> bool:
        return FAULTS[self._faults[gap.start_frame]] == JUMPED

    @property
    def faults(self) -> list[Gap]:
        """Frames whose stamps had to be moved: repeated, out of order, or wild.

        Clock jumps that cause a gap are listed in `gaps` instead.
        """
        joined = {gap.start_frame for gap in self.gaps if self._jumped(gap)}
        found = find_faults(self.times_ns, self._step_ns, self._faults)
        return [fault for fault in found if fault.start_frame not in joined]

    def __len__(self) -> int:
        return len(self.times_ns)

    def __repr__(self) -> str:
        return (
            f"<Recording {self.name}: {len(self)} frames of {self.width} x {self.height}, "
            f"{self.format}>"
        )

    def frame(self, index: int) -> DepthFrame:
        """Decode one frame.

        Args:
            index: row of the frame, counted from 0, or from the end if negative.

        Returns:
            The frame, with its row, its stamp and its depth (H, W) float32 mm.

        Raises:
            IndexError: there is no such row.
            RecordingError: the recording was closed, or its files can no longer be read.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of a recording of {len(self)} frames")
        if (self._whole or self)._closed:
            raise RecordingError(f"{self.name} was closed; open it again to read from it")
        row = index % len(self)
        try:
            depth = self._read(int(self._stored[row]))
        except OSError as error:
            if is_full(error) or why_short(error):
                raise
            raise RecordingError(
                f"{error.filename or self.name} can be read no more ({error.strerror or error}); "
                "put it back, or mend its drive, and run the same command again"
            ) from error
        return DepthFrame(row, int(self.times_ns[row]), depth)

    def frames(self, first: int = 0, stop: int | None = None) -> Iterator[DepthFrame]:
        """Consecutive frames, decoded one by one; a frame that repeats the previous one is marked.

        Args:
            first: row of the first frame.
            stop: row after the last one; None for the end of the recording.
        """
        before = self.frame(first - 1).depth if 0 < first < len(self) else None
        return marked((self.frame(i) for i in range(len(self))[first:stop]), before)

    def __iter__(self) -> Iterator[DepthFrame]:
        return self.frames()

    def chunks(
        self, n_frames: int, first: int = 0, stop: int | None = None
    ) -> Iterator[list[DepthFrame]]:
        """Consecutive frames in lists of equal length; one list is in memory at a time.

        Args:
            n_frames: frames per list; the last list may be shorter.
            first: row of the first frame.
            stop: row after the last one; None for the end of the recording.

        Yields:
            Lists of decoded frames, in order.

        Raises:
            ValueError: n_frames is less than 1.
        """
        if n_frames < 1:
            raise ValueError(f"a chunk has at least one frame, got {n_frames}")
        frames = self.frames(first, stop)
        yield from iter(lambda: side_by_side(frames, n_frames), [])

    def __getitem__(self, part: slice) -> Recording:
        """Some of the frames as a recording of its own, with rows counted from 0.

        It reads from the same files, and has the digest of the whole input.

        Args:
            part: a slice with a positive step.

        Raises:
            TypeError: part is not a slice.
            RecordingError: the slice is empty or runs backwards.
        """
        if not isinstance(part, slice):
            raise TypeError(
                "a recording is cut with a slice, as in recording[10:20]; one frame is "
                "recording.frame(10)"
            )
        start, stop, step = part.indices(len(self))
        if step < 1 or start >= stop:
            raise RecordingError(
                f"the part {start}:{stop}:{step} of {self.name} holds no frame in order of time"
            )
        rows = slice(start, stop, step)
        cut = Recording(
            name=self.name,
            format=self.format,
            camera=self.camera,
            times_ns=self.times_ns[rows].copy(),
            read=self._read,
            sources=self.files,
            problems=self.problems,
            truncated=self.truncated,
            whole=self._whole_frames[rows],
            metadata=self.metadata,
            step_ns=self._step_ns * step,
            stored=self._stored[rows],
            faults=self._faults[rows],
            doubts=self.doubts,
        )
        cut._whole = self._whole or self
        cut.optics = self.optics
        cut.measured = self.measured
        cut.region_px = self.region_px
        return cut

    def viewed_by(
        self,
        camera: Camera,
        change: Callable[[Depth], Depth],
        optics: dict[str, Any],
        *,
        lent: bool = False,
    ) -> Recording:
        """The same frames as another camera would have recorded them, transformed on reading.

        The input, and so the digest, stays the same. Closing one recording closes both, also when
        it is garbage collected, unless it is lent.

        Args:
            camera: the camera of the transformed images.
            change: transforms depth (H, W) float32 mm of this camera into depth of the other one.
            optics: the corrections that `change` applies, kept as the `optics` of the result.
            lent: keep this recording open when the result is closed.
        """
        read = self._read
        other = Recording(
            name=self.name,
            format=self.format,
            camera=camera,
            times_ns=self.times_ns.copy(),
            read=lambda number: change(read(number)),
            sources=self.files,
            problems=self.problems,
            truncated=self.truncated,
            whole=self._whole_frames,
            metadata=self.metadata,
            step_ns=self._step_ns,
            stored=self._stored,
            close=None if lent else self.close,
            faults=self._faults,
            unpacked=self.unpacked,
            grow=lambda: (more := self.grown()) and more.viewed_by(camera, change, optics),
            doubts=self.doubts,
        )
        other._whole = self._whole or self
        other.optics = optics
        other.measured = self.measured
        return other

    def masked(self, region_px: Sequence[Sequence[float]], *, lent: bool = False) -> Recording:
        """The same frames with every pixel outside a polygon unread, to isolate one arena.

        Image size and camera are unchanged, so pixel coordinates stay valid. The input, and so the
        digest, stays the same.

        Args:
            region_px: (u, v) corners of the polygon, pixels.
            lent: keep this recording open when the result is closed.

        Raises:
            PlanError: the corners are not a polygon in the image.
        """
        inside = region_mask(region_px, self.width, self.height)
        cut = self.viewed_by(
            self.camera,
            lambda depth: np.where(inside, depth, np.float32(0)),
            self.optics,
            lent=lent,
        )
        cut.region_px = tuple((float(u), float(v)) for u, v in region_px)
        return cut

    def remembering(self, most_bytes: int) -> Recording:
        """The same recording with a cache of the first frames read, for several readers.

        Closing the result closes this recording.

        Args:
            most_bytes: size of the cache; frames read after it is full are decoded each time.
        """
        kept: dict[int, Depth] = {}
        n_most = most_bytes // max(1, 4 * self.width * self.height)
        read = self._read

        def recall(number: int) -> Depth:
            """Depth of a stored frame by its `number`."""
            depth = kept.get(number)
            if depth is None:
                depth = read(number)
                if len(kept) < n_most:
                    kept[number] = depth
            return depth

        other = self.viewed_by(self.camera, lambda depth: depth, self.optics)
        other._read = recall
        other.region_px = self.region_px
        return other

    def grown(self) -> Recording | None:
        """The same recording with what was appended to its files since it was opened.

        Reading resumes where it ended. The result replaces this recording, which must not be used
        afterwards.

        Returns:
            The longer recording; None if the format has to be opened again for that.
        """
        more = None if self._grow is None else self._grow()
        if more is not None:
            more.camera = self.camera
            more.region_px = self.region_px
            if self._close is not None:
                self._close.detach()  # the files stay open
        return more

    def digest(self, progress: Progress = silent) -> str:
        """SHA-256 of the input, in hexadecimal; computed once and kept.

        For one file, its bytes are hashed; for several, their names, sizes and bytes in order of
        name. For a recording without files, its times and depths. A slice has the digest of the
        whole input.

        Args:
            progress: reports how many MB were read.
        """
        if not self.files.paths and self.files.known_digest is None:
            origin = self._whole or self
            whole = hashlib.sha256(origin.times_ns.astype("<i8").tobytes())
            for frame in origin:
                whole.update(frame.depth.astype("<f4").tobytes())
            self.files.known_digest = whole.hexdigest()
        return self.files.digest(progress)

    def close(self) -> None:
        """Close files, and remove what was unpacked.

        Closing a slice has no effect on the recording that it was cut from.
        """
        self._closed = self._whole is None
        if self._close is not None:
            self._close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self.close()
