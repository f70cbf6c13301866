"""Concatenation of Rerun (.rrd) and MCAP logs that were written in parts.

Bytes are copied and nothing is unpacked. An .rrd file is a header of 12 bytes and messages, each
with a kind and a length of 8 bytes each; the joined file has the messages of all parts and no
index. An MCAP file is chunks and message indexes, whose offsets are shifted, and a summary with
chunk indexes, statistics and CRC-32, which is written anew (https://mcap.dev/spec).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    MessageIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from liex_lab.errors import SessionError
from liex_lab.sessions.renumbering import Known, renumber

Parts = Sequence[tuple[Path, int | None]]  # the bytes of each that count, None for all
_FIRST_CHUNKS = 8  # within so many a part's channels of depth are named

# magic, version and options; the kind of the message that ends a stream
RRD_HEAD = 12
_RRD_END = 0
_CHUNK_HEAD = 8 + 8 + 8 + 4  # start and end time, size, check sum; then the name of the compression
_BLOCK = 1 << 22


def rrd_messages(file: IO[bytes], size: int, start: int = RRD_HEAD) -> Iterator[tuple[int, int]]:
    """Offset and length of each message of an .rrd file, up to its end message if it has one.

    Args:
        file: the open .rrd file.
        size: bytes of it that count.
        start: offset of the first message to look at.

    Yields:
        (offset, bytes); the bytes include the message's own header of 16.

    Raises:
        SessionError: a message goes beyond `size`, so the file was not written whole.
    """
    at = start
    while at < size:
        file.seek(at)
        head = file.read(16)
        kind, length = struct.unpack("<QQ", head) if len(head) == 16 else (0, size)
        if at + 16 + length > size:
            raise SessionError(
                "the replay was not written whole; make room on the disk and run it again"
            )
        if kind == _RRD_END:
            return
        yield at, 16 + length
        at += 16 + length


def join_rrd(parts: Parts, out: Path) -> None:
    """Write one .rrd with the messages of all parts.

    Their indexes are left out, for they count from each part's own beginning.

    Args:
        parts: the parts in order, with the bytes of each that count.
        out: the file to write.

    Raises:
        SessionError: a part is shorter than it should be.
    """
    with out.open("wb") as whole:
        for k, (path, size) in enumerate(parts):
            with path.open("rb") as file:
                end = path.stat().st_size if size is None else size
                if k == 0:
                    whole.write(file.read(RRD_HEAD))
                last = RRD_HEAD
                for at, length in rrd_messages(file, end):
                    last = at + length
                _copy(file, RRD_HEAD, last, whole)


def join_mcap(parts: Parts, out: Path) -> None:
    """Write one MCAP file with the chunks of all parts.

    The last part is a whole file; where its channels are numbered otherwise than those of the first
    part, it is written anew with the numbers of the first (`renumber`).

    Args:
        parts: the parts in order, with the bytes of each that count.
        out: the file to write.

    Raises:
        SessionError: a part is shorter than it should be, or the last one is not whole.
    """
    last = parts[-1][0]
    known = _known_to(last)
    if not _numbered_alike(parts[0], known):
        last = parts[-1][0].with_name(f"numbered-{out.name}")
        known = renumber(parts[-1][0], _first_known(*parts[0]), known, last)
    indexes: list[ChunkIndex] = []
    counts: dict[int, int] = {}
    with out.open("wb") as whole:
        for k, (path, size) in enumerate([*parts[:-1], (last, parts[-1][1])]):
            with path.open("rb") as file:
                end = path.stat().st_size if size is None else size
                start, stop = _chunks_of(file, end, whole.tell() if k else 0, indexes, counts)
                _copy(file, start if k else 0, stop, whole)
        _finish_mcap(whole, *known, indexes, counts)
    if last != parts[-1][0]:
        last.unlink()


def _chunks_of(
    file: IO[bytes], end: int, at_out: int, indexes: list[ChunkIndex], counts: dict[int, int]
) -> tuple[int, int]:
    """Where the chunks of a part begin and end; `indexes` gets theirs, as they will be in the
    joined file.
    """
    at = len(MCAP0_MAGIC)
    first = 0
    while at + 9 <= end:
        file.seek(at)
        opcode, length = struct.unpack("<BQ", file.read(9))
        shift = at_out - first if at_out else 0
        if opcode == Opcode.CHUNK:
            if at_out and not first:
                first = at
                shift = at_out - at
            indexes.append(_chunk_index(file, at + shift, 9 + length))
        elif opcode == Opcode.MESSAGE_INDEX:
            index = MessageIndex.read(ReadDataStream(file))
            counts[index.channel_id] = counts.get(index.channel_id, 0) + len(index.records)
            indexes[-1].message_index_offsets[index.channel_id] = at + shift
            indexes[-1].message_index_length += 9 + length
        elif opcode != Opcode.HEADER:
            break
        at += 9 + length
    if at > end:
        raise SessionError(
            "the MCAP file was not written whole; make room on the disk and run it again"
        )
    return (first or at), at


def _chunk_index(file: IO[bytes], offset: int, length: int) -> ChunkIndex:
    """The index of the chunk whose content `file` is at."""
    start, stop, size, _ = struct.unpack("<QQQI", file.read(_CHUNK_HEAD))
    compression = file.read(struct.unpack("<I", file.read(4))[0]).decode()
    (compressed,) = struct.unpack("<Q", file.read(8))
    return ChunkIndex(
        message_start_time=start,
        message_end_time=stop,
        chunk_start_offset=offset,
        chunk_length=length,
        message_index_offsets={},
        message_index_length=0,
        compression=compression,
        compressed_size=compressed,
        uncompressed_size=size,
    )


def _numbered_alike(first: tuple[Path, int | None], known: Known) -> bool:
    """Whether the channels of the first part have the same numbers in the last one."""
    topics = {channel.topic: channel.id for channel in known[1]}
    return all(topics.get(channel.topic) == channel.id for channel in _first_known(*first)[1])


def _first_known(path: Path, size: int | None) -> Known:
    """Schemas and channels that the first chunks of a part name, whole or not; a channel is named
    where it begins.
    """
    end = path.stat().st_size if size is None else size
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with path.open("rb") as file:
        for content in islice(_chunk_contents(file, end), _FIRST_CHUNKS):
            for record in breakup_chunk(content):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
    return list(schemas.values()), list(channels.values())


def _chunk_contents(file: IO[bytes], end: int) -> Iterator[Chunk]:
    at = len(MCAP0_MAGIC)
    while at + 9 <= end:
        file.seek(at)
        opcode, length = struct.unpack("<BQ", file.read(9))
        if opcode == Opcode.CHUNK:
            yield Chunk.read(ReadDataStream(file))
        elif opcode not in (Opcode.HEADER, Opcode.MESSAGE_INDEX):
            return
        at += 9 + length


def _known_to(path: Path) -> Known:
    """Schemas and channels of a whole file."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    if summary is None:
        raise SessionError(
            "the MCAP file was not written whole; make room on the disk and run it again"
        )
    return list(summary.schemas.values()), list(summary.channels.values())


def _finish_mcap(
    whole: IO[bytes],
    schemas: list[Schema],
    channels: list[Channel],
    indexes: list[ChunkIndex],
    counts: dict[int, int],
) -> None:
    """The end of the data and the summary."""
    end = RecordBuilder()
    DataEnd(0).write(end)
    whole.write(end.end())
    start = whole.tell()
    builder = RecordBuilder()
    offsets = []
    statistics = Statistics(
        attachment_count=0,
        channel_count=len(channels),
        channel_message_counts=counts,
        chunk_count=len(indexes),
        message_count=sum(counts.values()),
        metadata_count=0,
        schema_count=len(schemas),
        message_start_time=min((index.message_start_time for index in indexes), default=0),
        message_end_time=max((index.message_end_time for index in indexes), default=0),
    )
    groups: list[tuple[Opcode, Sequence[Schema | Channel | Statistics | ChunkIndex]]] = [
        (Opcode.SCHEMA, schemas),
        (Opcode.CHANNEL, channels),
        (Opcode.STATISTICS, [statistics]),
        (Opcode.CHUNK_INDEX, indexes),
    ]
    for opcode, records in groups:
        group = builder.count
        for record in records:
            record.write(builder)
        offsets.append(SummaryOffset(opcode, start + group, builder.count - group))
    offset_start = start + builder.count
    for offset in offsets:
        offset.write(builder)
    summary = builder.end()
    head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start)
    whole.write(summary)
    Footer(start, offset_start, zlib.crc32(head, zlib.crc32(summary))).write(builder)
    whole.write(builder.end() + MCAP0_MAGIC)


def _copy(file: IO[bytes], start: int, stop: int, whole: IO[bytes]) -> None:
    file.seek(start)
    left = stop - start
    while left > 0:
        block = file.read(min(_BLOCK, left))
        if not block:
            raise SessionError("a log became shorter while it was read; run it again")
        whole.write(block)
        left -= len(block)
