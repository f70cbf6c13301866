"""Writer of .oni files (version 1.0.1.0), as OpenNI's own recorder writes them.

OpenNI2's player opens them: one depth node with the properties that it wants, frames with times in
µs, a seek table (left out beyond 288,000 frames, which the player could not open) and an end.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import IO, Literal, Self

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.formats.oni import index as properties
from liex_lab.recordings.formats.oni import records
from liex_lab.recordings.formats.oni._codec_kernels import pack_16z
from liex_lab.recordings.frame import Depth
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.durable import replacing
from liex_lab.runtime.progress import Progress, silent

Codec = Literal["16zT", "16zP", "NONE"]

_NODE = 1
_LARGEST = {"16zT": 0xFFFF, "16zP": 0x7FFF, "NONE": 0xFFFF}  # stored value
_PIXEL_FORMATS = {1.0: 100, 0.1: 101}  # mm in a stored step: OpenNI's number for it
# what stands in a file until it is closed
_UNKNOWN_COUNT = 0xFFFFFFFF
_UNKNOWN_TIME = 2**64 - 1
_NOMINAL_FPS = 30.0
# OpenNI2 cannot open a file with a longer table, but one without a table
_MOST_IN_SEEK_TABLE = 288_000


def write_oni(
    recording: Recording,
    path: str | Path,
    *,
    codec: Codec = "16zT",
    unit_mm: float = 1.0,
    exact: bool = True,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Path:
    """Write a recording as .oni, frame by frame; the file has its name only when it is whole.

    Times keep the recording's own clock, rounded to microseconds. The intrinsics are kept as a
    property of our own, and as the angles of view that other programs read.

    Args:
        recording: what is written.
        path: the .oni file; its folder must exist.
        codec: 16zT packs best and loses nothing, 16zP holds depths up to 32,767 steps, NONE does
            not pack.
        unit_mm: mm of a stored step, 1.0 or 0.1.
        exact: refuse depths that are no whole number of steps instead of rounding them.
        overwrite: replace a file that is there.
        progress: told how many frames were written.

    Returns:
        The path of the file.

    Raises:
        RecordingError: the file exists or cannot be written, or a depth does not fit its steps.
        ValueError: unit_mm is neither 1.0 nor 0.1.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise RecordingError(
            f"{path} is there already; give another name, or allow it to be overwritten"
        )
    if not path.parent.is_dir():
        raise RecordingError(
            f"there is no folder {path.parent} to write {path.name} into; make it first"
        )
    start_us = min(
        0, _microseconds(int(recording.times_ns[0]))
    )  # the format has no time before zero
    rate_hz = float(np.nan_to_num(recording.rate_hz, nan=_NOMINAL_FPS))
    with (
        _in_place(path) as part,
        OniWriter(part, recording.camera, codec, unit_mm, rate_hz, exact=exact) as out,
    ):
        for frame in recording:
            out.add(_microseconds(frame.time_ns) - start_us, frame.depth)
            progress(frame.index + 1, len(recording), f"writing {path.name}")
    return path


def _microseconds(time_ns: int) -> int:
    return (time_ns + 500) // 1000


class OniWriter:
    """Writer of one depth node, frame by frame.

    Leaving its `with` block without an error closes the file properly.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera,
        codec: Codec = "16zT",
        unit_mm: float = 1.0,
        rate_hz: float = _NOMINAL_FPS,
        *,
        exact: bool = True,
    ) -> None:
        """Open the file and write its header and properties.

        Args:
            path: the .oni file.
            camera: the camera of the frames.
            codec: see `write_oni`.
            unit_mm: mm of a stored step, 1.0 or 0.1.
            rate_hz: the frame rate that the file states, Hz; every frame has its own time.
            exact: refuse depths that are no whole number of steps instead of rounding them.

        Raises:
            ValueError: unit_mm is neither 1.0 nor 0.1.
        """
        if unit_mm not in _PIXEL_FORMATS:
            raise ValueError(f"a step of an .oni file is 1 mm or 0.1 mm, got {unit_mm}")
        self._codec = codec
        self._unit_mm = unit_mm
        self._exact = exact
        self._entries: list[tuple[int, int]] = []  # time in µs and position of every frame
        self._file: IO[bytes] = path.open("wb")
        try:
            self._begin(camera, rate_hz)
        except BaseException:
            self._file.close()
            raise

    def _begin(self, camera: Camera, rate_hz: float) -> None:
        self._file.write(
            records.FILE_HEADER.pack(records.FILE_MAGIC, *records.VERSION, _UNKNOWN_TIME, _NODE)
        )
        self._node_at = self._file.tell()
        self._write(records.NODE, self._node_fields(_UNKNOWN_COUNT, _UNKNOWN_TIME, 0))
        for kind, name, value in _properties(camera, _PIXEL_FORMATS[self._unit_mm], rate_hz):
            self._write(kind, records.text(name) + struct.pack("<I", len(value)) + value)
        self._write(records.NODE_READY)
        self._write(records.DATA_BEGIN, struct.pack("<IQ", _UNKNOWN_COUNT, _UNKNOWN_TIME))

    def add(self, time_us: int, depth: Depth) -> None:
        """Append a frame.

        Args:
            time_us: its time, µs, not negative.
            depth: (H, W) float32 mm, 0 where unread.

        Raises:
            RecordingError: a depth does not fit the steps, or there are too many for the codec.
        """
        stored = self._stored(depth)
        payload = (
            stored.tobytes()
            if self._codec == "NONE"
            else pack_16z(stored.ravel(), self._codec == "16zT")
        )
        if payload is None:
            raise RecordingError(
                f"frame {len(self._entries)} holds more different depths than the code "
                f"{self._codec} can tell apart; write it with the code NONE"
            )
        before = self._entries[-1][1] if self._entries else 0
        self._entries.append((time_us, self._file.tell()))
        self._write(
            records.FRAME, records.FRAME_FIELDS.pack(time_us, len(self._entries)), payload, before
        )

    def close(self) -> None:
        """Write what belongs at the end, and the counts at the beginning, and close the file."""
        self._write(records.NODE_REMOVED, undoes=self._node_at)
        n = len(self._entries)
        last = self._entries[-1][0] if self._entries else 0
        table_at = 0
        if n <= _MOST_IN_SEEK_TABLE:
            table_at = self._file.tell()
            table = np.zeros(n + 1, records.SEEK_ENTRY)
            table["time_us"][1:], table["at"][1:] = (
                np.array(self._entries, np.uint64).reshape(n, 2).T
            )
            self._write(records.SEEK_TABLE, payload=table.tobytes())
        self._write(records.END, node=0)
        self._file.seek(self._node_at)
        self._write(records.NODE, self._node_fields(n, last, table_at))
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self.close()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._file.close()

    def _write(
        self,
        kind: int,
        fields: bytes = b"",
        payload: bytes = b"",
        undoes: int = 0,
        node: int = _NODE,
    ) -> None:
        size = records.HEADER.size + len(fields)
        head = records.HEADER.pack(records.RECORD_MAGIC, kind, node, size, len(payload), undoes)
        self._file.write(head + fields)
        self._file.write(payload)

    def _node_fields(self, n_frames: int, last_us: int, table_at: int) -> bytes:
        kind = struct.pack("<i4s", records.DEPTH_NODE, self._codec.encode())
        return records.text("Depth") + kind + struct.pack("<IQQQ", n_frames, 0, last_us, table_at)

    def _stored(self, depth: Depth) -> NDArray[np.uint16]:
        """What the file holds for a depth, (H, W)."""
        number = len(self._entries)
        steps = np.rint(depth / np.float32(self._unit_mm))
        if steps.size and steps.max() > _LARGEST[self._codec]:
            raise RecordingError(
                f"frame {number} holds depths up to {depth.max():.0f} mm, and {self._codec} holds "
                f"up to {_LARGEST[self._codec] * self._unit_mm:.0f} mm in steps of "
                f"{self._unit_mm:g} mm; write it as MCAP"
            )
        # compared as the reader will compute it, for 0.1 is no number of a float32
        if self._exact and np.any(steps * np.float32(self._unit_mm) != depth):
            raise RecordingError(
                f"frame {number} holds depths between steps of {self._unit_mm:g} mm, and .oni has "
                "no finer ones; write it as MCAP, or allow the depths to be rounded"
            )
        return steps.astype("<u2")


def _properties(camera: Camera, pixel_format: int, rate_hz: float) -> list[tuple[int, str, bytes]]:
    """Kind, name and value of what a node says of itself; OpenNI2's player wants all but the last,
    in this form.
    """
    mode = struct.pack("<III", camera.width, camera.height, round(min(max(rate_hz, 1.0), 1000.0)))
    view = [
        2 * math.atan(n / 2 / f) for n, f in ((camera.width, camera.fx), (camera.height, camera.fy))
    ]
    integers = {
        "oniRequiredFrameSize": 2 * camera.width * camera.height,
        "xnIsGenerating": 1,
        "xnDeviceMaxDepth": 0xFFFF,
        "xnSupportedMapOutputModesCount": 1,
        "xnPixelFormat": 4,
        properties.UNIT: pixel_format,
        "Cropping": 1,
        "Mirror": 1,
        properties.MIRROR: 0,
    }
    values = {
        "xnSupportedMapOutputModes": mode,
        properties.MODE: mode,
        "xnSupportedPixelFormats": struct.pack("<I", 8),
        properties.FIELD_OF_VIEW: struct.pack("<dd", *view),
        properties.CROPPING: bytes(12),
        properties.INTRINSICS: struct.pack("<dddd", camera.fx, camera.fy, camera.cx, camera.cy),
    }
    # the player takes the size before the unit
    return [
        *((records.BYTES, name, value) for name, value in values.items()),
        *((records.INTEGER, name, struct.pack("<Q", number)) for name, number in integers.items()),
    ]


@contextmanager
def _in_place(path: Path) -> Iterator[Path]:
    """A name beside `path` to write under; the file gets its own when the block ends, and is gone
    where it fails.
    """
    try:
        with replacing(path) as part:
            yield part
    except OSError as error:
        raise RecordingError(
            f"{path} cannot be written ({error.strerror or error}); check the place"
        ) from None
