"""Writer of MCAP files whose chunks are packed with Zstandard parameters of our choice.

Foxglove's own writer packs while it holds Python's lock, which stops everything else for a
millisecond a picture, and has no long-distance matching, which finds the still scene in the picture
before at a quarter of the cost. Records are written by the `mcap` library; what stands in which
order is the file format's (https://mcap.dev/spec): header, chunks each followed by the indexes of
their messages, end of data, summary with offsets, footer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import zstandard
from isal import isal_zlib
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from liex_lab.recordings.formats.messages.mcap import MAGIC, MESSAGE, RECORD

_WINDOW = 1 << 23
_LEAST, _MOST = 10, 27  # log2 of the windows that every reader of Zstandard takes


class Sink(Protocol):
    """What an MCAP file is written to."""

    def write(self, data: bytes) -> int:
        """Append bytes; the number of them."""


@dataclass(frozen=True)
class SchemaOf:
    """What describes the messages of a topic.

    Attributes:
        name: of the schema, as "foxglove.RawImage".
        encoding: of the schema, as "protobuf" or "jsonschema".
        data: the schema itself.
        messages: encoding of the messages, "protobuf" or "json".
    """

    name: str
    encoding: str
    data: bytes
    messages: str


class _Chunk:
    """A chunk under way: its messages are packed as they come, so none waits in memory."""

    def __init__(self, packer: zstandard.ZstdCompressor) -> None:
        self._packing = packer.compressobj()
        self._packed: list[bytes] = []
        self._checksum = 0
        self.size = 0
        self.indexes: dict[int, MessageIndex] = {}
        self.first_ns = 0
        self.last_ns = 0

    def put(self, data: bytes | memoryview) -> None:
        """Append bytes."""
        self._packed.append(self._packing.compress(data))
        self._checksum = isal_zlib.crc32(data, self._checksum)
        self.size += len(data)

    def note(self, channel: int, time_ns: int) -> None:
        """A message of a channel begins here."""
        if not self.indexes:
            self.first_ns = self.last_ns = time_ns
        self.first_ns = min(self.first_ns, time_ns)
        self.last_ns = max(self.last_ns, time_ns)
        index = self.indexes.setdefault(channel, MessageIndex(channel, []))
        index.records.append((time_ns, self.size))

    def record(self) -> Chunk:
        """The whole chunk; nothing may be appended any more."""
        self._packed.append(self._packing.flush())
        return Chunk(
            compression="zstd",
            data=b"".join(self._packed),
            message_start_time=self.first_ns,
            message_end_time=self.last_ns,
            uncompressed_crc=self._checksum,
            uncompressed_size=self.size,
        )


class McapFile:
    """Writer of one MCAP file with an index; call `log`, `flush` at will, and `close` once."""

    def __init__(
        self,
        sink: Sink,
        *,
        profile: str,
        library: str,
        level: int,
        chunk_size: int,
        repetition: int = 0,
        window: int = _WINDOW,
    ) -> None:
        """Write the file's beginning.

        Args:
            sink: where the bytes go; it is left open.
            profile: what the file's messages are for.
            library: name and version of the program that writes.
            level: of Zstandard, 1 to 22.
            chunk_size: bytes of messages that are packed at once.
            repetition: bytes that are at least the same where something far back is looked for; 0
                for Zstandard's usual 64.
            window: bytes that it is looked for in, rounded up to a power of two, 1 kB to 128 MB;
                what is more than the processor's cache holds costs time.
        """
        self._sink = sink
        self._at = 0
        self._chunk_size = chunk_size
        packing = zstandard.ZstdCompressionParameters.from_level(
            level,
            enable_ldm=True,
            window_log=min(max(_LEAST, (window - 1).bit_length()), _MOST),
            ldm_min_match=repetition,
        )
        self._packer = zstandard.ZstdCompressor(compression_params=packing)
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[str, Channel] = {}
        self._counts: Counter[int] = Counter()
        self._chunks: list[ChunkIndex] = []
        self._open = _Chunk(self._packer)
        self._write(MAGIC)
        self._write(_bytes_of(Header(profile, library)))

    def log(
        self, topic: str, schema: SchemaOf, data: Sequence[bytes | memoryview], time_ns: int
    ) -> None:
        """Add a message.

        Args:
            topic: its topic, which has one schema.
            schema: of the topic.
            data: the message, encoded, in one part or more.
            time_ns: when it was logged and published, ns.
        """
        channel = self._channels.get(topic) or self._channel(topic, schema)
        self._counts[channel.id] += 1
        chunk = self._open
        chunk.note(channel.id, time_ns)
        number = self._counts[channel.id]
        head = RECORD.pack(Opcode.MESSAGE, MESSAGE.size + sum(map(len, data)))
        chunk.put(head + MESSAGE.pack(channel.id, number, time_ns, time_ns))
        for part in data:
            chunk.put(part)
        if chunk.size > self._chunk_size:
            self.flush()

    def flush(self) -> None:
        """Write the messages that wait; a file that ends here can be read up to here."""
        if not self._open.indexes:
            return
        chunk = self._open
        record = chunk.record()
        self._open = _Chunk(self._packer)  # not before: it takes the packer's state
        start = self._at
        self._write(_bytes_of(record))
        length = self._at - start
        offsets = {}
        for number, index in chunk.indexes.items():
            offsets[number] = self._at
            self._write(_bytes_of(index))
        self._chunks.append(
            ChunkIndex(
                message_start_time=chunk.first_ns,
                message_end_time=chunk.last_ns,
                chunk_start_offset=start,
                chunk_length=length,
                message_index_offsets=offsets,
                message_index_length=self._at - start - length,
                compression=record.compression,
                compressed_size=len(record.data),
                uncompressed_size=chunk.size,
            )
        )

    def close(self) -> None:
        """Write what waits, the summary and the footer."""
        self.flush()
        self._write(_bytes_of(DataEnd(0)))
        start = self._at
        groups: dict[int, Sequence[McapRecord]] = {
            Opcode.SCHEMA: list(self._schemas.values()),
            Opcode.CHANNEL: list(self._channels.values()),
            Opcode.STATISTICS: [self._statistics()],
            Opcode.CHUNK_INDEX: self._chunks,
        }
        summary, offsets = RecordBuilder(), RecordBuilder()
        for opcode, records in groups.items():
            first = summary.count
            for record in records:
                record.write(summary)
            SummaryOffset(opcode, start + first, summary.count - first).write(offsets)
        offsets_at = start + summary.count
        content = summary.end() + offsets.end()
        self._write(content)
        head = _bytes_of(Footer(start, offsets_at, 0))[:-4]
        told = isal_zlib.crc32(head, isal_zlib.crc32(content))
        self._write(head + told.to_bytes(4, "little"))
        self._write(MAGIC)

    def _channel(self, topic: str, schema: SchemaOf) -> Channel:
        """A topic that is new, with its schema; both stand in the chunk of its first message."""
        known = self._schemas.get(schema.name)
        if known is None:
            number = len(self._schemas) + 1
            known = Schema(id=number, data=schema.data, encoding=schema.encoding, name=schema.name)
            self._schemas[schema.name] = known
            self._open.put(_bytes_of(known))
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding=schema.messages,
            schema_id=known.id,
            metadata={},
        )
        self._channels[topic] = channel
        self._open.put(_bytes_of(channel))
        return channel

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            metadata_count=0,
            message_start_time=min((one.message_start_time for one in self._chunks), default=0),
            message_end_time=max((one.message_end_time for one in self._chunks), default=0),
            schema_count=len(self._schemas),
        )

    def _write(self, data: bytes) -> None:
        self._sink.write(data)
        self._at += len(data)


def _bytes_of(record: McapRecord) -> bytes:
    """A record as it stands in the file."""
    built = RecordBuilder()
    record.write(built)
    return bytes(built.end())
