"""Putting .oni files together by hand, record by record, as old and odd programs wrote them."""

import itertools
import struct
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

Codec = Literal["16zT", "16zP", "NONE"]
DEVICE, DEPTH, COLOUR, INFRARED = 1, 2, 3, 4
STEP_US = 33_333
OPEN_FILE = 0xFFFFFFFF  # the number of frames in a file that was never closed


def text(name: str) -> bytes:
    """A string of a record."""
    return struct.pack("<I", len(name) + 1) + name.encode() + b"\0"


def mode(width: int, height: int, fps: int = 30) -> bytes:
    """The property xnMapOutputMode."""
    return struct.pack("<III", width, height, fps)


def cropping(x: int, y: int, width: int, height: int, on: int = 1) -> bytes:
    """The property xnCropping."""
    return struct.pack("<IHHHH", on, x, y, width, height)


class OniBuilder:
    """The bytes of a file, record after record. old: with 32-bit positions, as before version
    1.0.1.0.
    """

    def __init__(self, old: bool = False, version: tuple[int, int, int, int] | None = None) -> None:
        version = version or ((1, 0, 0, 5) if old else (1, 0, 1, 0))
        self.old = old
        self.content = bytearray(struct.pack("<4sBBHIQI", b"NI10", *version, 2**64 - 1, 9))
        self.frames: dict[int, list[tuple[int, int]]] = {}  # node: time and position of each

    def record(
        self, kind: int, node: int = 0, fields: bytes = b"", payload: bytes = b"", undoes: int = 0
    ) -> int:
        """Append a record; where it begins."""
        at = len(self.content)
        head = "<IIIIII" if self.old else "<IIIIIQ"
        size = struct.calcsize(head) + len(fields)
        self.content += (
            struct.pack(head, 0x0052494E, kind, node, size, len(payload), undoes) + fields + payload
        )
        return at

    def node(
        self,
        number: int,
        name: str,
        kind: int,
        codec: str,
        n_frames: int = OPEN_FILE,
        record: int = 0x0D,
        table: int = 0,
    ) -> int:
        """Add a node, in the form of version 1.0.0.4 (record 0x02), 1.0.0.5 (0x0C) or of today;
        where it begins.
        """
        fields = text(name) + struct.pack("<i4s", kind, codec.encode())
        if record != 0x02:
            fields += struct.pack("<IQQ", n_frames, 0, 2**64 - 1)
        if record == 0x0D:
            fields += struct.pack("<I" if self.old else "<Q", table)
        return self.record(record, number, fields)

    def integers(self, node: int, **values: int) -> None:
        """Add integer properties."""
        for name, value in values.items():
            self.record(0x03, node, text(name) + struct.pack("<IQ", 8, value))

    def real(self, node: int, name: str, value: float) -> None:
        """Add a real property."""
        self.record(0x04, node, text(name) + struct.pack("<Id", 8, value))

    def properties(self, node: int, **values: bytes) -> None:
        """Add properties of bytes."""
        for name, value in values.items():
            self.record(0x06, node, text(name) + struct.pack("<I", len(value)) + value)

    def depth_properties(
        self,
        node: int,
        width: int,
        height: int,
        fov: tuple[float, ...] | None = (1.0, 0.8),
        crop: bytes = bytes(12),
        pixel_format: int = 100,
        lens: bytes = b"",
    ) -> None:
        """What OpenNI2's player wants of a depth node."""
        shape = mode(width, height)
        self.properties(
            node, xnMapOutputMode=shape, xnSupportedMapOutputModes=shape, xnCropping=crop
        )
        if lens:
            self.properties(node, liexIntrinsics=lens)
        if fov:
            self.properties(node, xnFOV=struct.pack("<dd", *fov))
        self.integers(
            node,
            oniRequiredFrameSize=2 * width * height,
            xnIsGenerating=1,
            xnDeviceMaxDepth=10_000,
            xnSupportedMapOutputModesCount=1,
            xnPixelFormat=4,
            oniPixelFormat=pixel_format,
            xnMirror=0,
        )

    def begin(self, node: int) -> None:
        """The properties of a node are complete, and its data begins."""
        self.record(0x09, node)
        self.record(0x08, node, struct.pack("<IQ", OPEN_FILE, 2**64 - 1))

    def frame(self, node: int, time_us: int, payload: bytes) -> int:
        """Add a frame; where it begins."""
        known = self.frames.setdefault(node, [])
        at = self.record(0x0A, node, struct.pack("<QI", time_us, len(known) + 1), payload)
        known.append((time_us, at))
        return at

    def seek_table(self, node: int) -> int:
        """Add the table of a node's frames; where it begins."""
        entry, known = "<QII" if self.old else "<QIQ", self.frames.get(node, [])
        rows = [
            struct.pack(entry, 0, 0, 0),
            *(struct.pack(entry, time_us, 3, at) for time_us, at in known),
        ]
        return self.record(0x0E, node, payload=b"".join(rows))

    def write(self, path: Path, closed: bool = True) -> Path:
        """The file, with its last record unless the recording program crashed."""
        if closed:
            self.record(0x0B)
        path.write_bytes(self.content)
        return path


def depth_builder(
    payloads: Sequence[bytes],
    codec: str,
    width: int = 64,
    height: int = 48,
    *,
    old: bool = False,
    record: int = 0x0D,
    closed: bool = True,
    table: bool = False,
    times_us: Sequence[int] | None = None,
    **properties: Any,
) -> OniBuilder:
    """A file with one depth node, all but its last record. record: form of the node's own one;
    table: of seeking; properties: see `depth_properties`.
    """
    where = 0
    for _ in range(2 if table else 1):  # where the table is, is known only once it is there
        made = OniBuilder(old)
        made.node(1, "Depth", DEPTH, codec, len(payloads) if closed else OPEN_FILE, record, where)
        made.depth_properties(1, width, height, **properties)
        made.begin(1)
        for k, payload in enumerate(payloads):
            made.frame(1, times_us[k] if times_us else k * STEP_US, payload)
        made.record(0x07, 1)
        where = made.seek_table(1) if table else 0
    return made


def plain_16z(numbers: NDArray[np.uint16]) -> bytes:
    """A stream of runs, half-filled bytes and whole numbers: far from the best packing."""
    out = bytearray(struct.pack("<H", numbers[0]))
    run = 0
    for before, number in itertools.pairwise([*numbers.tolist(), None]):
        step = None if number is None else before - number
        run += step == 0
        if step != 0 or run == 30:
            out += bytes([0xE0 + run // 2] * (run > 1) + [6 << 4 | 13] * (run % 2))
            run = 0
        if not step:
            continue
        if abs(step) <= 6:
            out.append((step + 6) << 4 | 13)
        elif abs(step) <= 62:
            out += bytes([0xFF, step + 192])
        else:
            out += struct.pack(">BH", 0xFF, number)
    return bytes(out)


def plain_payload(frame: NDArray[np.uint16], codec: str) -> bytes:
    """A frame in one of the three codecs."""
    if codec == "NONE":
        return frame.astype("<u2").tobytes()
    return _packed(frame.astype("<u2").tobytes(), codec)


@lru_cache(maxsize=4096)
def _packed(pixels: bytes, codec: str) -> bytes:
    """A packed frame; tests write the same ones again and again."""
    frame = np.frombuffer(pixels, "<u2")
    if codec == "16zP":
        return plain_16z(frame)
    table, numbers = np.unique(frame, return_inverse=True)
    return (
        struct.pack("<H", len(table))
        + table.astype("<u2").tobytes()
        + plain_16z(numbers.ravel().astype(np.uint16))
    )
