"""Append-only writer of MCAP files; a file that was cut after a flush can be resumed.

Foxglove's own writer holds the GIL while compressing, which stops everything else for a millisecond
per depth image. It also lacks long-distance matching, which finds the still scene in the previous
image at a quarter of the cost. Records are encoded by the `mcap` library; their order follows the
format (https://mcap.dev/spec): header, chunks each followed by the indexes of their messages, end
of data, summary with offsets, footer.
"""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import zstandard
from isal import isal_zlib
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
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
from mcap.stream_reader import StreamReader

from liex_lab.errors import SessionError
from liex_lab.recordings.formats.messages.mcap import MAGIC, MESSAGE, RECORD

_WINDOW = 1 << 23
_LEAST, _MOST = 10, 27  # log2 of the windows that every Zstandard reader accepts


@dataclass(frozen=True)
class MessageType:
    """Schema of a topic's messages, such as "foxglove.RawImage" in "protobuf" or "jsonschema", and
    the encoding of the messages, "protobuf" or "json".
    """

    name: str
    encoding: str
    data: bytes
    messages: str


class _Chunk:
    """A chunk in progress: messages are compressed as they arrive, so none waits in memory."""

    def __init__(self, packer: zstandard.ZstdCompressor) -> None:
        self._packing = packer.compressobj()
        self._packed: list[bytes] = []
        self._checksum = 0
        self.size = 0
        self.indexes: dict[int, MessageIndex] = {}

    def put(self, data: bytes | memoryview) -> None:
        self._packed.append(self._packing.compress(data))
        self._checksum = isal_zlib.crc32(data, self._checksum)
        self.size += len(data)

    def begin_message(self, channel: int, time_ns: int) -> None:
        index = self.indexes.setdefault(channel, MessageIndex(channel, []))
        index.records.append((time_ns, self.size))

    def record(self) -> Chunk:
        """The whole chunk; nothing may be appended afterwards."""
        self._packed.append(self._packing.flush())
        times = [time_ns for index in self.indexes.values() for time_ns, _ in index.records]
        return Chunk(
            compression="zstd",
            data=b"".join(self._packed),
            message_start_time=min(times),
            message_end_time=max(times),
            uncompressed_crc=self._checksum,
            uncompressed_size=self.size,
        )


class McapLog:
    """Writer of one MCAP file with an index; call `log`, `flush` at will, and `close` once."""

    def __init__(
        self,
        sink: BinaryIO,
        *,
        profile: str,
        library: str,
        level: int,
        chunk_size: int,
        repetition: int = 0,
        window: int = _WINDOW,
        written: BinaryIO | None = None,
    ) -> None:
        """Write the beginning of the file, unless it is resumed.

        Args:
            sink: binary stream for appending; it stays open.
            profile: purpose of the messages.
            library: name and version of the writing program.
            level: Zstandard level, 1 to 22.
            chunk_size: bytes of messages that are compressed together.
            repetition: shortest distant repetition to find, bytes; 0 for Zstandard's 64.
            window: bytes searched for repetitions, rounded up to a power of two, 1 kB to 128 MB; a
                window larger than the processor's cache is slow.
            written: the present content of `sink`, a file of the same topics that ends after a
                flush; it is read once.
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
        self._introduced: set[int] = set()
        self._counts: Counter[int] = Counter()
        self._chunks: list[ChunkIndex] = []
        self._open = _Chunk(self._packer)
        if written is None:
            self._write(MAGIC)
            self._write(_bytes_of(Header(profile, library)))
        else:
            self._resume(written)

    def _resume(self, written: BinaryIO) -> None:
        """Rebuild counts and chunk indexes from the records of a file without an end."""
        written.seek(0)
        with suppress(McapError, struct.error):
            for record in StreamReader(written, emit_chunks=True).records:
                start, self._at = self._at, written.tell()
                if isinstance(record, Chunk):
                    self._index_chunk(record, start)
                elif isinstance(record, MessageIndex):
                    self._index_messages(record, start)
        if self._at != written.seek(0, os.SEEK_END):
            raise SessionError(
                "the MCAP file was not written whole; make room on the disk and run it again"
            )

    def declare(self, topic: str, kind: MessageType) -> Channel:
        """The channel of a topic. Channels are numbered in the order of their declaration; to
        resume a file, declare the same ones in the same order.
        """
        if topic not in self._channels:
            new = Schema(
                id=len(self._schemas) + 1, data=kind.data, encoding=kind.encoding, name=kind.name
            )
            self._channels[topic] = Channel(
                id=len(self._channels) + 1,
                topic=topic,
                message_encoding=kind.messages,
                schema_id=self._schemas.setdefault(kind.name, new).id,
                metadata={},
            )
        return self._channels[topic]

    def log(
        self, topic: str, kind: MessageType, data: Sequence[bytes | memoryview], time_ns: int
    ) -> None:
        """Add an encoded message, in one or more parts, logged and published at a time."""
        channel = self.declare(topic, kind)
        chunk = self._open
        if channel.id not in self._introduced:  # in the chunk of its first message
            self._introduced.add(channel.id)
            chunk.put(_bytes_of(self._schemas[kind.name]) + _bytes_of(channel))
        chunk.begin_message(channel.id, time_ns)
        number = self._counts[channel.id] + len(chunk.indexes[channel.id].records)
        head = RECORD.pack(Opcode.MESSAGE, MESSAGE.size + sum(map(len, data)))
        chunk.put(head + MESSAGE.pack(channel.id, number, time_ns, time_ns))
        for part in data:
            chunk.put(part)
        if chunk.size > self._chunk_size:
            self.flush()

    def flush(self) -> None:
        """Write the waiting messages; a file that ends here is readable up to here."""
        chunk = self._open
        if not chunk.indexes:
            return
        record = chunk.record()
        self._open = _Chunk(self._packer)  # not earlier: it resets the packer's state
        start = self._at
        self._write(_bytes_of(record))
        self._index_chunk(record, start)
        for index in chunk.indexes.values():
            start = self._at
            self._write(_bytes_of(index))
            self._index_messages(index, start)

    def _index_chunk(self, record: Chunk, start: int) -> None:
        self._chunks.append(
            ChunkIndex(
                message_start_time=record.message_start_time,
                message_end_time=record.message_end_time,
                chunk_start_offset=start,
                chunk_length=self._at - start,
                message_index_offsets={},
                message_index_length=0,
                compression=record.compression,
                compressed_size=len(record.data),
                uncompressed_size=record.uncompressed_size,
            )
        )

    def _index_messages(self, index: MessageIndex, start: int) -> None:
        self._counts[index.channel_id] += len(index.records)
        self._chunks[-1].message_index_offsets[index.channel_id] = start
        self._chunks[-1].message_index_length += self._at - start

    def close(self) -> None:
        """Write waiting messages, the summary and the footer."""
        self.flush()
        self._write(_bytes_of(DataEnd(0)))
        start = self._at
        channels = [channel for channel in self._channels.values() if self._counts[channel.id]]
        used = {channel.schema_id for channel in channels}
        groups: dict[int, Sequence[McapRecord]] = {
            Opcode.SCHEMA: [schema for schema in self._schemas.values() if schema.id in used],
            Opcode.CHANNEL: channels,
            Opcode.STATISTICS: [self._statistics(len(used), len(channels))],
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
        head = _bytes_of(Footer(start, offsets_at, 0))[:-4]
        checksum = isal_zlib.crc32(head, isal_zlib.crc32(content))
        self._write(content + head + checksum.to_bytes(4, "little") + MAGIC)

    def _statistics(self, n_schemas: int, n_channels: int) -> Statistics:
        return Statistics(
            attachment_count=0,
            channel_count=n_channels,
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            metadata_count=0,
            message_start_time=min((one.message_start_time for one in self._chunks), default=0),
            message_end_time=max((one.message_end_time for one in self._chunks), default=0),
            schema_count=n_schemas,
        )

    def _write(self, data: bytes) -> None:
        self._sink.write(data)
        self._at += len(data)


def _bytes_of(record: McapRecord) -> bytes:
    built = RecordBuilder()
    record.write(built)
    return bytes(built.end())
