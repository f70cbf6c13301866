"""MCAP recordings, whole, cut or still growing: depth in Foxglove's or ROS's messages.

Records (opcode, u64 length, content) are walked in file order; messages are in chunks (none, zstd,
lz4), which threads unpack ahead if the summary at the file's end lists their positions. Schemas and
channels are also read from the summary, in case the first ones are damaged.
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_right
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from io import BytesIO
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import Metadata as MetadataRecord
from mcap.records import Schema as SchemaRecord

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Lens
from liex_lab.recordings.formats.messages.depth_topics import open_topic
from liex_lab.recordings.formats.messages.messages import (
    Channel,
    Chunk,
    DamagedChunk,
    Envelope,
    Listed,
    MessageFile,
    Place,
    unpacked,
)
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent

MAGIC = b"\x89MCAP0\r\n"
NOTES = "liex_lab"  # name of the metadata record in files written by liex_lab
RECORD = struct.Struct("<BQ")  # opcode, length of the content
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_FOOTER = struct.Struct(
    "<BQQQI"
)  # its record: opcode, length, positions of the summary and its offsets, CRC
_START = struct.Struct("<16xQ")  # of a chunk, in its index
_CHUNK = struct.Struct(
    "<QQQII"
)  # first and last log time, unpacked size, its CRC, length of the packing's name
_BLOCK = 1 << 20
# chunks of at most this size are unpacked ahead
THREADS = 2
_SMALL_CHUNK = 1 << 23
FACTS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA)
LARGEST_FACT = 1 << 24  # bytes of one such record
DAMAGE = (
    McapError,
    KeyError,
    ValueError,
    OverflowError,
    MemoryError,
    RuntimeError,
    struct.error,
    EOFError,
)

Wanted = Callable[[Channel], bool]


def open_mcap(
    path: Path,
    camera: Lens | None = None,
    fps: float | None = None,
    progress: Progress = silent,
    topic: str | None = None,
) -> Recording:
    """Open one depth topic of an MCAP file as a recording.

    Args:
        path: the .mcap file.
        camera: overrides the camera in the files.
        fps: unused, as every message has its time.
        progress: reports the progress of the walk over the file.
        topic: name of the depth topic; None for the only one.

    Returns:
        The recording; reading resumes if the file grows (`Recording.grown`).

    Raises:
        RecordingError: the file is not MCAP, or has no depth topic to choose.
    """
    return open_topic(McapFile(path, open_file(path)), "mcap", camera, topic, progress)


def open_file(path: Path) -> IO[bytes]:
    """Open a file with the magic bytes of MCAP.

    Args:
        path: the file.

    Raises:
        RecordingError: the magic bytes are missing.
    """
    file = path.open("rb")
    if file.read(len(MAGIC)) != MAGIC:
        file.close()
        raise RecordingError(
            f"{path} is named like an MCAP file but holds something else; give another file"
        )
    return file


class McapFile(MessageFile):
    """An open MCAP file."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        """Keep an open file; nothing is read."""
        super().__init__(path, file)
        self._by_id: dict[int, Channel] = {}
        self._schemas: dict[int, str] = {0: "no schema"}
        self.listed: list[bytes] = []  # the raw indexes of its chunks
        self.n_messages: int | None = None  # in all chunks, from the file's own statistics
        # chunks being unpacked, by the position of their content
        self._coming: dict[int, Future[bytes]] = {}
        self._sure = (
            len(MAGIC),
            0,
            True,
        )  # after the last whole record: position, number of chunks, `whole`

    def go_on(self) -> int | None:
        """Prepare a walk over what was written since, after the last whole record.

        Returns:
            Number of valid chunks of earlier walks; None if the file became shorter.
        """
        size = self.path.stat().st_size
        if size < self.size:
            return None
        self.size, (_, n_chunks, self.whole) = size, self._sure
        del self.chunks[n_chunks:]
        self._last_chunk = (-1, memoryview(b""))
        return n_chunks

    def walk(self, wanted: Wanted, progress: Progress) -> Iterator[Envelope | Listed]:
        """Every whole message of the wanted channels, in file order.

        A second walk begins after the last whole record of the first.

        Args:
            wanted: whether the messages of a channel are relevant.
            progress: reports how many MB were walked over.

        Yields:
            The messages.
        """
        self._learn_ending()
        with ThreadPoolExecutor(THREADS) as unpackers:
            try:
                yield from self._walk(wanted, progress, unpackers)
            finally:
                unpackers.shutdown(wait=False, cancel_futures=True)
                self._coming.clear()

    def _walk(
        self, wanted: Wanted, progress: Progress, unpackers: ThreadPoolExecutor
    ) -> Iterator[Envelope]:
        at = self._sure[0]
        footer = False
        while at + RECORD.size <= self.size and not footer:
            opcode, start, end = self._record(at)
            whole = end <= self.size and opcode != 0
            if (end > self.size and (opcode != Opcode.CHUNK or self.starts)) or opcode == 0:
                end = self.resume(at)  # an invalid size, or zeros: no record has the opcode 0
            elif opcode == Opcode.CHUNK:
                self._look_ahead(at, unpackers)
                yield from self._walk_chunk(start, end - start, wanted)
            elif opcode == Opcode.MESSAGE or (opcode in FACTS and end - start <= LARGEST_FACT):
                data = memoryview(self.file.read(end - start))
                yield from self._take(opcode, data, Place(-1, start, end - start), wanted)
            at = end
            footer = opcode == Opcode.FOOTER
            if whole and not footer:
                self._sure = (at, len(self.chunks), self.whole)
            progress(
                min(at, self.size) >> 20,
                (self.size >> 20) + 1,
                "looking through the recording (MB)",
            )
        self.whole = self.whole and footer and at + len(MAGIC) <= self.size

    def _look_ahead(self, at: int, unpackers: ThreadPoolExecutor) -> None:
        """Unpack the next chunks after `at` in the background, if the file's index lists them."""
        n = bisect_right(self.starts, at)
        for later in self.starts[n : n + THREADS]:
            if later + RECORD.size + _CHUNK.size > self.size:
                return
            opcode, start, end = self._record(later)
            if opcode != Opcode.CHUNK or start in self._coming:
                continue
            try:
                chunk = self._chunk(start, end - start)
            except (DamagedChunk, struct.error, UnicodeDecodeError):
                return  # the walk reports it later
            if chunk.size <= _SMALL_CHUNK:
                self.file.seek(chunk.offset)
                self._coming[start] = unpackers.submit(
                    unpacked, self.file.read(chunk.length), chunk
                )

    def _record(self, at: int) -> tuple[int, int, int]:
        """Opcode of the record at `at`, and start and end of its content."""
        self.file.seek(at)
        opcode, length = RECORD.unpack(self.file.read(RECORD.size))
        return opcode, at + RECORD.size, at + RECORD.size + length

    def _learn_ending(self) -> None:
        """Read schemas, channels and positions of chunks from the summary of a finished file.

        They replace damaged records at the beginning. A damaged summary is ignored.
        """
        self.starts = []
        self.listed = []
        self.n_messages = None
        try:
            ending = self.size - _FOOTER.size - len(MAGIC)
            self.file.seek(max(0, ending))
            opcode, _, at, _, crc = _FOOTER.unpack(self.file.read(_FOOTER.size))
            if (
                opcode != Opcode.FOOTER
                or not 0 < at < ending
                or (crc and crc != self._crc(at, self.size - 4 - len(MAGIC)))
            ):
                return
            while at < ending:
                kind, start, end = self._record(at)
                if kind == Opcode.CHUNK_INDEX and end - start <= LARGEST_FACT:
                    content = self.file.read(end - start)
                    self.starts.append(_START.unpack_from(content)[0])
                    self.listed.append(content)
                elif kind == Opcode.STATISTICS:
                    (self.n_messages,) = struct.unpack("<Q", self.file.read(8))
                elif kind in FACTS and end - start <= LARGEST_FACT:
                    self._learn(kind, ReadDataStream(BytesIO(self.file.read(end - start))))
                at = end
        except DAMAGE:
            pass  # the walk reports damage
        self.starts.sort()

    def _crc(self, start: int, end: int) -> int:
        """CRC-32 of the bytes from start to end, computed in blocks."""
        self.file.seek(start)
        crc = 0
        while start < end and (block := self.file.read(min(_BLOCK, end - start))):
            crc = zlib.crc32(block, crc)
            start = start + len(block)
        return crc

    def _walk_chunk(self, start: int, length: int, wanted: Wanted) -> Iterator[Envelope]:
        number = len(self.chunks)
        try:
            self.chunks.append(self._chunk(start, length))
            if start in self._coming:
                self._last_chunk = (number, memoryview(self._coming.pop(start).result()))
            data = self.unpack(number)
        except (DamagedChunk, struct.error, UnicodeDecodeError):
            self.whole = False
            return
        at = 0
        while at + RECORD.size <= len(data):
            opcode, length = RECORD.unpack_from(data, at)
            begin = at + RECORD.size
            at = at + RECORD.size + length
            if at > len(data) or opcode == 0:
                break
            yield from self._take(opcode, data[begin:at], Place(number, begin, length), wanted)
        self.whole = self.whole and at == len(data) and not self.chunks[number].cut

    def _chunk(self, start: int, length: int) -> Chunk:
        """The chunk whose record is at `start`, up to the end of the file."""
        cut = start + length > self.size
        end = min(start + length, self.size)
        self.file.seek(start)
        head = self.file.read(min(_CHUNK.size + 64, end - start))
        *_, size, crc, n_name = _CHUNK.unpack_from(head)
        packed = _CHUNK.size + n_name
        packing = head[_CHUNK.size : packed].decode()
        (n_packed,) = struct.unpack_from("<Q", head, packed)
        offset = start + packed + 8
        if not cut and offset + n_packed > end:
            raise DamagedChunk("its parts do not fit into it")
        return Chunk(offset, min(n_packed, end - offset), packing, size, crc, cut)

    def _take(
        self, opcode: int, payload: memoryview, place: Place, wanted: Wanted
    ) -> Iterator[Envelope]:
        try:
            if opcode == Opcode.MESSAGE:
                number, _, log_time_ns, sent_ns = MESSAGE.unpack_from(payload)
                channel = self._by_id[number]
                if wanted(channel):
                    head = MESSAGE.size
                    inner = Place(place.chunk, place.offset + head, place.length - head)
                    yield Envelope(channel, log_time_ns, inner, payload[head:], sent_ns)
            elif opcode in FACTS:
                self._learn(opcode, ReadDataStream(BytesIO(payload)))
        except DAMAGE:
            self.whole = False

    def _learn(self, opcode: int, stream: ReadDataStream) -> None:
        """Record a schema, channel or metadata record."""
        if opcode == Opcode.SCHEMA:
            schema = SchemaRecord.read(stream)
            self._schemas[schema.id] = schema.name
        elif opcode == Opcode.CHANNEL:
            record = ChannelRecord.read(stream)
            known = Channel(
                record.topic,
                self._schemas.get(record.schema_id, "no schema"),
                record.message_encoding,
            )
            if self._by_id.setdefault(record.id, known) == known:
                self.channels.setdefault(known)
        elif opcode == Opcode.METADATA:
            note = MetadataRecord.read(stream)
            if note.name == NOTES:
                self.notes.update(note.metadata)
