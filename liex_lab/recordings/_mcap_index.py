"""Where the messages of an MCAP file lie: one walk forward, which needs no summary and so reads cut files too."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream

from liex_lab.errors import RecordingError
from liex_lab.progress import Progress

MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # opcode, length of what follows
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_OPAQUE = (ValueError, OverflowError, MemoryError, RuntimeError, struct.error, EOFError)  # what damage comes out as


class Place(NamedTuple):
    """Where a message's data lies: in the file, or (chunk >= 0) in the unpacked bytes of a chunk."""

    chunk: int
    offset: int
    length: int


class Envelope(NamedTuple):
    """A message as it is met on the walk."""

    channel: Channel
    schema: Schema | None
    log_time_ns: int
    place: Place
    data: bytes


@dataclass
class McapIndex:
    """An open MCAP file, and where its chunks lie; `read` fetches a message's data again.

    whole: the file ends as it should and every chunk unpacked.
    """

    file: IO[bytes]
    size: int
    whole: bool = True
    chunks: list[tuple[int, int]] = field(default_factory=list)  # offset and length of the chunk record
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    _last_chunk: tuple[int, bytes] = (-1, b"")

    @staticmethod
    def open(path: Path) -> McapIndex:
        """Open a file that begins like MCAP."""
        file = path.open("rb")
        if file.read(len(MAGIC)) != MAGIC:
            file.close()
            raise RecordingError(f"{path} is named like an MCAP file but holds something else; give another file")
        return McapIndex(file, path.stat().st_size)

    def walk(self, wanted: Callable[[Channel, Schema | None], bool], progress: Progress) -> Iterator[Envelope]:
        """Every whole message of the wanted channels, in file order."""
        at, footer = len(MAGIC), False
        while at + _RECORD.size <= self.size and not footer:
            self.file.seek(at)
            opcode, length = _RECORD.unpack(self.file.read(_RECORD.size))
            start, at = at + _RECORD.size, at + _RECORD.size + length
            if at > self.size:
                break
            footer = opcode == Opcode.FOOTER
            if opcode == Opcode.CHUNK:
                self.chunks.append((start, length))
                yield from self._walk_chunk(wanted)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                yield from self._take(opcode, self.file.read(length), Place(-1, start, length), wanted)
            progress(at >> 20, (self.size >> 20) + 1, "looking through the recording (MB)")
        self.whole = self.whole and footer

    def _walk_chunk(self, wanted: Callable[[Channel, Schema | None], bool]) -> Iterator[Envelope]:
        try:
            data = self._unpack(len(self.chunks) - 1)
        except RecordingError:
            self.whole = False
            return
        at = 0
        while at + _RECORD.size <= len(data):
            opcode, length = _RECORD.unpack_from(data, at)
            start, at = at + _RECORD.size, at + _RECORD.size + length
            if at > len(data):
                self.whole = False
                return
            yield from self._take(opcode, data[start:at], Place(len(self.chunks) - 1, start, length), wanted)

    def _take(
        self, opcode: int, payload: bytes, place: Place, wanted: Callable[[Channel, Schema | None], bool]
    ) -> Iterator[Envelope]:
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(payload)))
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(payload)))
                self.channels[channel.id] = channel
            elif opcode == Opcode.MESSAGE:
                number, _, log_time_ns, _ = _MESSAGE.unpack_from(payload)
                channel = self.channels[number]
                schema = self.schemas.get(channel.schema_id)
                if wanted(channel, schema):
                    head = _MESSAGE.size
                    inner = Place(place.chunk, place.offset + head, place.length - head)
                    yield Envelope(channel, schema, log_time_ns, inner, payload[head:])
        except (McapError, KeyError, *_OPAQUE):
            self.whole = False

    def _unpack(self, chunk: int) -> bytes:
        """The unpacked bytes of a chunk; the last one is kept, for neighbouring frames share it."""
        if self._last_chunk[0] != chunk:
            start, length = self.chunks[chunk]
            self.file.seek(start)
            try:
                record = Chunk.read(ReadDataStream(BytesIO(self.file.read(length))))
                stream, size = get_chunk_data_stream(record, validate_crc=True)
                self._last_chunk = (chunk, stream.read(size))
            except Exception as error:  # the codecs are foreign and have exceptions of their own
                raise RecordingError(
                    f"chunk {chunk} of {self.file.name} is damaged ({error}); copy the file again"
                ) from None
        return self._last_chunk[1]

    def read(self, place: Place) -> bytes:
        """The data of one message."""
        if place.chunk >= 0:
            return self._unpack(place.chunk)[place.offset : place.offset + place.length]
        self.file.seek(place.offset)
        return self.file.read(place.length)

    def close(self) -> None:
        """Close the file and let go of the last chunk."""
        self.file.close()
        self._last_chunk = (-1, b"")
