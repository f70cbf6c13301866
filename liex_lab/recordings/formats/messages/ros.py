"""Parsers of the `sensor_msgs` that hold depth, in ROS 1 serialisation and ROS 2 CDR.

The pixels are not copied. The definitions have been the same for as long as there are recordings,
so they are written down here; both systems order the fields alike and differ in alignment, in the
header and in the zero at a string's end.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from liex_lab.recordings.formats.messages.message_file import unpacked_message
from liex_lab.recordings.formats.messages.messages import (
    Calibration,
    DamagedMessage,
    Message,
    PackedPicture,
    Parser,
    PointCloud,
    RawPicture,
    Statement,
)

# sensor_msgs/PointField: number of a type, and NumPy's name of it without the byte order
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_MOST_FIELDS = 256
_SECOND_VERSION = 4  # bytes to which its numbers are aligned at most
_PLAIN_CDR = (b"\0\0", b"\0\1", b"\0\6", b"\0\7")  # big and little endian, version 1 and 2


class _Fields:
    """Reads one field after the other: ROS 1, little endian, nothing aligned."""

    order = "<"
    origin = 0
    largest_step = 1  # bytes to which numbers are aligned at most
    end_of_text = 0

    def __init__(self, data: memoryview) -> None:
        self.data = data
        self.at = self.origin

    def _next(self, n_bytes: int) -> memoryview:
        """The next bytes."""
        begin = self.at
        self.at = begin + n_bytes
        if self.at > len(self.data):
            raise DamagedMessage("a message ends too early")
        return self.data[begin : self.at]

    def numbers(self, kind: str, n: int = 1) -> tuple[Any, ...]:
        """`n` numbers of a type, as `struct` names it."""
        size = struct.calcsize(f"<{kind}")
        self.at += (self.origin - self.at) % min(size, self.largest_step)
        return struct.unpack(f"{self.order}{n}{kind}", self._next(n * size))

    def whole(self, kind: str = "I") -> int:
        """One integer."""
        return int(self.numbers(kind)[0])

    def floats(self) -> tuple[float, ...]:
        """Float64s with their number before them."""
        n = self.whole()
        if n > len(self.data) // 8:
            raise DamagedMessage("a message states more numbers than it has bytes")
        return self.numbers("d", n) if n else ()

    def blob(self) -> memoryview:
        """Bytes with their number before them."""
        return self._next(self.whole())

    def text(self) -> str:
        """A string."""
        raw = self.blob()
        return bytes(raw[: len(raw) - self.end_of_text]).decode("utf-8", "replace")

    def header(self) -> tuple[int, str]:
        """The stamp, ns, and the frame's name of a std_msgs/Header."""
        self.whole()  # a number that counts up
        return self.whole() * 10**9 + self.whole(), self.text()


class _CdrFields(_Fields):
    """The same in ROS 2 (CDR): byte order in the first four bytes, numbers aligned to their size.

    Strings end in a zero, and headers have no counter. The second version (XCDR2) aligns to four
    bytes at most.
    """

    origin = 4
    end_of_text = 1

    def __init__(self, data: memoryview) -> None:
        super().__init__(data)
        kind = bytes(data[:2])
        if len(data) < 4 or kind not in _PLAIN_CDR:
            raise DamagedMessage(
                f"a message begins with {kind.hex(' ')}, which is no plain CDR (00 00, 00 01, 00 "
                "06 or 00 07)"
            )
        self.order = "<" if data[1] & 1 else ">"
        self.largest_step = _SECOND_VERSION if data[1] > 1 else 8

    def header(self) -> tuple[int, str]:
        """The stamp, ns, and the frame's name of a std_msgs/Header without the counter."""
        return self.whole("i") * 10**9 + self.whole(), self.text()  # seconds have a sign here


def _image(fields: _Fields) -> RawPicture:
    stamp_ns, frame_id = fields.header()
    height, width = fields.numbers("I", 2)
    encoding = fields.text()
    big_endian = bool(fields.whole("B"))
    step = fields.whole()
    return RawPicture(stamp_ns, frame_id, width, height, encoding, step, big_endian, fields.blob())


def _packed_image(fields: _Fields) -> PackedPicture:
    stamp_ns, frame_id = fields.header()
    return PackedPicture(stamp_ns, frame_id, fields.text(), fields.blob())


def _camera_info(fields: _Fields) -> Calibration:
    _, frame_id = fields.header()
    height, width = fields.numbers("I", 2)
    model = fields.text()
    d = fields.floats()
    kr = fields.numbers("d", 18)  # camera matrix, rotation
    p = fields.numbers("d", 12)
    across, down, x, y, rows, columns = fields.numbers("I", 6)
    part = (x, y, columns, rows)
    return Calibration(frame_id, width, height, model, d, kr[:9], p, (across, down), part)


def _cloud(fields: _Fields) -> PointCloud:
    stamp_ns, frame_id = fields.header()
    height, width = fields.numbers("I", 2)
    if fields.largest_step == _SECOND_VERSION:  # the list's length in bytes
        fields.whole()
    n_fields = fields.whole()
    if n_fields > _MOST_FIELDS:
        raise DamagedMessage(f"a cloud's points have {n_fields} fields")
    found = []
    for _ in range(n_fields):
        found.append((fields.text(), fields.whole(), fields.whole("B")))
        fields.whole()  # how many numbers the field has: one
    order = ">" if fields.whole("B") else "<"
    columns = {
        name: (at, order + _FIELD_TYPES[kind]) for name, at, kind in found if kind in _FIELD_TYPES
    }
    point_step, row_step = fields.numbers("I", 2)
    data = fields.blob()
    return PointCloud(stamp_ns, frame_id, width, height, columns, point_step, row_step, data)


def _value(fields: _Fields) -> Statement:
    return Statement({"value": f"{fields.numbers('f')[0]:.6g}"})  # 0.001 was meant, not its float32


def _text(fields: _Fields) -> Statement:
    """Facts as in "fx=287.9;fy=287.9", or one bare value."""
    text = fields.text()
    pairs = dict(part.split("=", 1) for part in text.split(";") if "=" in part)
    return Statement(pairs or {"value": text})


def _key_value(fields: _Fields) -> Statement:
    return Statement({fields.text(): fields.text()})


_PARSERS: dict[str, Callable[[_Fields], Message]] = {
    "sensor_msgs/Image": _image,
    "sensor_msgs/CompressedImage": _packed_image,
    "sensor_msgs/CameraInfo": _camera_info,
    "sensor_msgs/PointCloud2": _cloud,
    "std_msgs/Float32": _value,
    "std_msgs/String": _text,
    "diagnostic_msgs/KeyValue": _key_value,
}
_LAYOUTS: dict[str, type[_Fields]] = {"ros1": _Fields, "cdr": _CdrFields}


def parser(schema: str, encoding: str) -> Parser | None:
    """The function that reads messages of a schema.

    Args:
        schema: its name without "msg", such as "sensor_msgs/Image".
        encoding: "ros1" or "cdr".

    Returns:
        The parser, which raises `DamagedMessage`; None where there is none.
    """
    layout = _LAYOUTS.get(encoding)
    if layout is None or schema not in _PARSERS:
        return None
    read = _PARSERS[schema]
    if encoding == "ros1":
        return lambda data: read(layout(data))
    return lambda data: _read_cdr(read, unpacked_message(data))


def _read_cdr(read: Callable[[_Fields], Message], data: memoryview) -> Message:
    """A message in CDR; one that begins as of the second version may be laid out as the first."""
    fields = _CdrFields(data)
    message = read(fields)
    if fields.largest_step == _SECOND_VERSION <= len(data) - fields.at:
        fields = _CdrFields(data)
        fields.largest_step = 8
        message = read(fields)
    return message


def stamp_reader(encoding: str) -> Callable[[memoryview], int | None] | None:
    """The function that reads the stamp, ns, of a message that begins with a header.

    Args:
        encoding: "ros1" or "cdr".

    Returns:
        The function, which returns None where the header is longer than the bytes that it is given;
        None for another encoding.
    """
    layout = _LAYOUTS.get(encoding)
    if layout is None:
        return None

    def read(head: memoryview) -> int | None:
        try:
            return layout(head).header()[0]
        except DamagedMessage:
            return None

    return read
