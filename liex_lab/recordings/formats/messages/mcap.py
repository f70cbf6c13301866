"""MCAP recordings, whole, cut or still growing: depth in Foxglove's or ROS's messages.

Records (opcode, u64 length, content) are walked in file order; messages are in chunks (none, zstd,
lz4). Schemas and channels are also read from the summary at the file's end, in case the first ones
are damaged.

Callers that refuse damage (`open_recording(..., strict=True)`) open a file by its index instead, if
the index lists every message that the file's statistics count. For the sensor's stamps, each chunk
is unpacked up to the beginning of its last depth message. This takes most of the time of opening,
and `Recording.reopen` does not repeat it. A chunk is checked against its CRC-32 when a frame in it
is read. Any other file is walked.

`open_replay` opens session.mcap, which liex_lab wrote with the times of its frames: no stamp is
read, because single frames of a long recording are needed quickly.
"""

import struct
import tempfile
import zlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from threading import Lock
from typing import IO

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Lens
from liex_lab.recordings.formats.messages.depth_topics import open_topic
from liex_lab.recordings.formats.messages.messages import (
    CALIBRATION_SCHEMAS,
    Channel,
    Chunk,
    DamagedChunk,
    Envelope,
    IndexedMessages,
    IsRelevant,
    MessageFile,
    MessagePlace,
    unpacked,
)
from liex_lab.recordings.formats.messages.parsers import plain_schema, stamp_reader
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.memory import on_disk
from liex_lab.runtime.processes import side_by_side
from liex_lab.runtime.progress import Progress, silent

MAGIC = b"\x89MCAP0\r\n"
NOTES = "liex_lab"  # name of the metadata record in files written by liex_lab
RECORD = struct.Struct("<BQ")  # opcode, length of the content
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time
_FOOTER = struct.Struct(
    "<BQQQI"
)  # its record: opcode, length, positions of the summary and its offsets, CRC
_CHUNK = struct.Struct(
    "<QQQII"
)  # first and last log time, unpacked size, its CRC, length of the packing's name
FACTS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA)
Stamps = dict[int, NDArray[np.void]]  # of the messages that an index lists, by channel
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


def open_mcap(
    path: Path,
    camera: Lens | None = None,
    fps: float | None = None,
    progress: Progress = silent,
    topic: str | None = None,
    strict: bool = False,
    stamps: Stamps | None = None,
) -> Recording:
    """Open one depth topic of an MCAP file as a recording.

    Args:
        path: the .mcap file.
        camera: overrides the camera in the files.
        fps: unused, as every message has its time.
        progress: reports the progress of the walk over the file.
        topic: name of the depth topic; None for the only one.
        strict: open the file by its index if possible; reading a frame in a damaged chunk then
            raises a `RecordingError`.
        stamps: those read when the same, unchanged file was opened before.

    Returns:
        The recording; reading resumes if the file grows (`Recording.grown`), unless strict.

    Raises:
        RecordingError: the file is not MCAP, or has no depth topic to choose.
    """
    known: Stamps = {} if stamps is None else stamps
    file = open_file(path)
    opened = IndexedMcap(path, file, known) if strict else McapFile(path, file)
    recording = open_topic(opened, "mcap", camera, topic, progress)
    recording.reopen = partial(open_mcap, path, camera, fps, silent, topic, strict, known)
    return recording


def open_replay(path: Path, progress: Progress = silent) -> Recording:
    """Open the depth of a session's replay, session.mcap, as a recording.

    Raises:
        RecordingError: it cannot be read, or has no depth.
    """
    try:
        file = IndexedMcap(path, open_file(path), is_replay=True)
        return open_topic(file, "mcap", None, None, progress)
    except OSError as error:
        raise RecordingError(
            f"{path} cannot be read ({error.strerror or error}); check it"
        ) from None


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
        self.indexes: list[records.ChunkIndex] = []
        self.n_notes = 0  # records of metadata
        self._counted = (-1, -1)  # messages and metadata, by the file's own statistics
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

    def walk(self, wanted: IsRelevant, progress: Progress) -> Iterator[Envelope | IndexedMessages]:
        """Every whole message of the wanted channels, in file order.

        A second walk begins after the last whole record of the first.

        Args:
            wanted: whether the messages of a channel are relevant.
            progress: reports how many MB were walked over.

        Yields:
            The messages.
        """
        self._learn_ending()
        at = self._sure[0]
        footer = False
        while at + RECORD.size <= self.size and not footer:
            opcode, start, end = self._record(at)
            whole = end <= self.size and opcode != 0
            if (end > self.size and (opcode != Opcode.CHUNK or self.starts)) or opcode == 0:
                end = self.resume(at)  # an invalid size, or zeros: no record has the opcode 0
            elif opcode == Opcode.CHUNK:
                yield from self._walk_chunk(start, end - start, wanted)
            elif opcode == Opcode.MESSAGE or (opcode in FACTS and end - start <= LARGEST_FACT):
                data = memoryview(self.file.read(end - start))
                yield from self._take(opcode, data, MessagePlace(-1, start, end - start), wanted)
            at = end
            footer = opcode == Opcode.FOOTER
            if whole and not footer:
                self._sure = (at, len(self.chunks), self.whole)
            progress(
                min(at, self.size) >> 20,
                (self.size >> 20) + 1,
                "scanning the recording (MB)",
            )
        self.whole = self.whole and footer and at + len(MAGIC) <= self.size

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
        self.indexes = []
        self._counted = (-1, -1)
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
                if end - start <= LARGEST_FACT:
                    self._learn(kind, ReadDataStream(BytesIO(self.file.read(end - start))))
                at = end
        except DAMAGE:
            pass  # the walk reports damage
        self.starts.sort()

    def _crc(self, start: int, end: int) -> int:
        """CRC-32 of the bytes from start to end, computed in blocks."""
        self.file.seek(start)
        crc = 0
        while start < end and (block := self.file.read(min((1 << 20), end - start))):
            crc = zlib.crc32(block, crc)
            start = start + len(block)
        return crc

    def _walk_chunk(self, start: int, length: int, wanted: IsRelevant) -> Iterator[Envelope]:
        number = len(self.chunks)
        try:
            self.chunks.append(self._chunk(start, length))
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
            yield from self._take(
                opcode, data[begin:at], MessagePlace(number, begin, length), wanted
            )
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
        self, opcode: int, payload: memoryview, place: MessagePlace, wanted: IsRelevant
    ) -> Iterator[Envelope]:
        try:
            if opcode == Opcode.MESSAGE:
                number, _, log_time_ns, sent_ns = MESSAGE.unpack_from(payload)
                channel = self._by_id[number]
                if wanted(channel):
                    head = MESSAGE.size
                    inner = MessagePlace(place.chunk, place.offset + head, place.length - head)
                    yield Envelope(channel, log_time_ns, inner, payload[head:], sent_ns)
            elif opcode in FACTS:
                self._learn(opcode, ReadDataStream(BytesIO(payload)))
        except DAMAGE:
            self.whole = False

    def _learn(self, opcode: int, stream: ReadDataStream) -> None:
        """Record a schema, a channel, metadata, or a part of the index."""
        if opcode == Opcode.SCHEMA:
            schema = records.Schema.read(stream)
            self._schemas[schema.id] = schema.name
        elif opcode == Opcode.CHANNEL:
            record = records.Channel.read(stream)
            schema_name = self._schemas.get(record.schema_id, "no schema")
            known = Channel(record.topic, schema_name, record.message_encoding)
            if self._by_id.setdefault(record.id, known) == known:
                self.channels.setdefault(known)
        elif opcode == Opcode.METADATA:
            note = records.Metadata.read(stream)
            self.n_notes += 1
            if note.name == NOTES:
                self.notes.update(note.metadata)
        elif opcode == Opcode.CHUNK_INDEX:
            self.indexes.append(records.ChunkIndex.read(stream))
            self.starts.append(self.indexes[-1].chunk_start_offset)
        elif opcode == Opcode.METADATA_INDEX:
            kind, start, end = self._record(records.MetadataIndex.read(stream).offset)
            if kind == Opcode.METADATA and end - start <= LARGEST_FACT:
                self._learn(kind, ReadDataStream(BytesIO(self.file.read(end - start))))
        elif opcode == Opcode.STATISTICS:
            counts = records.Statistics.read(stream)
            self._counted = (counts.message_count, counts.metadata_count)


# Files opened by their index.


_UNKNOWN = -1  # the length of a message is only stated in its chunk
_INDEX = struct.Struct("<HI")  # of a message index: channel, bytes of its entries
_ENTRY = np.dtype([("time_ns", "<u8"), ("offset", "<u8")])
# of a message: whether it could be read, the sensor's stamp and its time of sending
_STAMP = np.dtype([("is_whole", "?"), ("stamp_ns", "<i8"), ("sent_ns", "<u8")])
_HEAD = 512  # first bytes of a message's record, with its stamp

_Table = tuple[int, bytes]  # number of a chunk, and times and offsets of messages as written


class IndexedMcap(McapFile):
    """An MCAP file that is complete according to its index; any other is walked."""

    def __init__(
        self, path: Path, file: IO[bytes], stamps: Stamps | None = None, is_replay: bool = False
    ) -> None:
        """Keep an open file; the times of logging in a replay are those of its frames.

        `stamps` are those known; the others are added.
        """
        super().__init__(path, file)
        self._is_replay = is_replay
        self._stamps: Stamps = {} if stamps is None else stamps
        self._lock = Lock()

    def walk(self, wanted: IsRelevant, progress: Progress) -> Iterator[Envelope | IndexedMessages]:
        """The messages of the wanted channels, by channel: the first of each with its data."""
        self._learn_ending()
        try:
            tables = self._tables(wanted, progress)
        except (*DAMAGE, DamagedChunk):  # the walk reports damage
            self.chunks.clear()
            yield from super().walk(wanted, progress)
            return
        self.parsed = self._is_replay
        for channel_id, those in tables.items():
            yield from self._messages(channel_id, those, wanted)

    def _tables(self, wanted: IsRelevant, progress: Progress) -> dict[int, list[_Table]]:
        """Contents of the message indexes of all chunks, by channel.

        Raises:
            DamagedChunk: the index does not match the file, or does not list all messages.
        """
        n_messages = 0
        tables: defaultdict[int, list[_Table]] = defaultdict(list)
        for index in sorted(self.indexes, key=lambda index: index.chunk_start_offset):
            at = index.chunk_start_offset
            opcode, start, end = self._record(at)
            if (opcode, end - at) != (Opcode.CHUNK, index.chunk_length):
                raise DamagedChunk("its index names no chunk")
            self.chunks.append(self._chunk(start, end - start))
            offsets = index.message_index_offsets
            first = min(offsets.values(), default=0)
            # bytes of one
            if not 0 <= index.message_index_length <= min((1 << 26), self.size):
                raise DamagedChunk("an index is larger than its file")
            self.file.seek(first)
            content = self.file.read(index.message_index_length)
            for channel_id, place in offsets.items():
                kind, length = RECORD.unpack_from(content, place - first)
                begin = place - first + RECORD.size
                whose, n_bytes = _INDEX.unpack_from(content, begin)
                entries = content[begin + _INDEX.size : begin + length]
                rest = n_bytes % _ENTRY.itemsize
                is_sound = n_bytes == len(entries) and not rest
                if (kind, whose, is_sound) != (Opcode.MESSAGE_INDEX, channel_id, True):
                    raise DamagedChunk("there is no index where it should be")
                n_messages += n_bytes // _ENTRY.itemsize
                if wanted(self._by_id[channel_id]):
                    tables[channel_id].append((len(self.chunks) - 1, entries))
            progress(end >> 20, (self.size >> 20) + 1, "scanning the recording (MB)")
        if (n_messages, self.n_notes) != self._counted:
            raise DamagedChunk("there is more in the file than in its index")
        return tables

    def _messages(
        self, channel_id: int, tables: Sequence[_Table], wanted: IsRelevant
    ) -> Iterator[Envelope | IndexedMessages]:
        """One channel's messages: the first with its data, and the rest listed if possible."""
        channel = self._by_id[channel_id]
        listed = _listed(channel, tables)
        n_stated = sum(len(entries) for _, entries in tables) // _ENTRY.itemsize
        self.whole &= len(listed.places) == n_stated
        rest: IndexedMessages | None = None
        tried = False
        for k, (time_ns, numbers) in enumerate(
            zip(listed.log_time_ns.tolist(), listed.places.tolist(), strict=True)
        ):
            if not wanted(channel):
                return
            try:
                place = MessagePlace(*numbers)
                data = self._message(place)
                head = place.offset + RECORD.size
                sent_ns = MESSAGE.unpack_from(self.unpack(place.chunk), head)[3]
            except (*DAMAGE, DamagedChunk):
                self.whole = False
                continue
            yield Envelope(channel, time_ns, place, data, sent_ns)
            if not tried:
                later = IndexedMessages(
                    channel, listed.log_time_ns[k + 1 :], listed.places[k + 1 :]
                )
                tried, rest = True, self._stamped(channel_id, later)
            if rest is not None:
                yield rest
                return

    def _stamped(self, channel_id: int, listed: IndexedMessages) -> IndexedMessages | None:
        """Messages with the sensor's stamps; None if reading these needs whole messages."""
        channel = listed.channel
        is_calibration = plain_schema(channel) in CALIBRATION_SCHEMAS
        if self._is_replay or is_calibration or not len(listed.places):
            return listed
        read = stamp_reader(channel)
        if read is None:
            return None
        if channel_id not in self._stamps:
            edges = np.flatnonzero(np.diff(listed.places[:, 0])) + 1
            split = np.split(np.arange(len(listed.places)), edges)
            found = side_by_side(partial(self._stamps_in_chunk, read, channel_id, listed), split)
            tables = [table for table in found if table is not None]
            if len(tables) < len(found):
                return None
            held = on_disk(Path(tempfile.gettempdir()))((len(listed.places),), _STAMP)
            self._stamps[channel_id] = np.concatenate(tables, out=held)
        table = self._stamps[channel_id]
        good = table["is_whole"]
        self.whole = self.whole and bool(good.all())
        return IndexedMessages(
            channel,
            listed.log_time_ns[good],
            listed.places[good],
            table["stamp_ns"][good],
            table["sent_ns"][good],
        )

    def _stamps_in_chunk(
        self,
        read: Callable[[memoryview], int | None],
        channel_id: int,
        listed: IndexedMessages,
        rows: NDArray[np.int64],
    ) -> NDArray[np.void] | None:
        """A `_STAMP` for each of these messages, which are in one chunk.

        None if the beginnings of messages do not contain their stamps.
        """
        stamps = []
        try:
            chunk = self.believable(int(listed.places[rows[0], 0]))
            offsets = listed.places[rows, 1].tolist()
            with self._lock:
                self.file.seek(chunk.offset)
                packed = self.file.read(chunk.length)
            data = unpacked(packed, chunk, min(offsets[-1] + _HEAD, chunk.size))
            for at, listed_ns in zip(offsets, listed.log_time_ns[rows].tolist(), strict=True):
                head = memoryview(data)[at : at + _HEAD]
                opcode, length = RECORD.unpack_from(head)
                whose, _, log_ns, sent_ns = MESSAGE.unpack_from(head, RECORD.size)
                if (opcode, whose, log_ns) != (Opcode.MESSAGE, channel_id, listed_ns):
                    raise DamagedChunk("there is another message than in its index")
                stamp_ns = read(head[RECORD.size + MESSAGE.size : RECORD.size + length])
                if stamp_ns is None:
                    return None
                stamps.append((True, stamp_ns, sent_ns))
            return np.array(stamps, _STAMP)
        except (*DAMAGE, DamagedChunk):
            return np.zeros(len(rows), _STAMP)

    def read(self, place: MessagePlace) -> memoryview:
        """The data of one message; an unknown length is read from its chunk.

        Raises:
            RecordingError: its chunk is damaged.
        """
        if place.length != _UNKNOWN:
            return super().read(place)
        try:
            return self._message(place)
        except (DamagedChunk, struct.error) as error:
            advice = (
                "run `liex run` on its recording"
                if self._is_replay
                else "go on with what is whole by adding --set recording.accept_truncated=true"
            )
            raise RecordingError(
                f"{self.path} is damaged ({error}); copy it again, or {advice}"
            ) from None

    def _message(self, place: MessagePlace) -> memoryview:
        """The data of a message whose length is only stated in its chunk."""
        data = self.unpack(place.chunk)
        opcode, length = RECORD.unpack_from(data, place.offset)
        begin = place.offset + RECORD.size
        if opcode != Opcode.MESSAGE or not MESSAGE.size <= length <= len(data) - begin:
            raise DamagedChunk("its index names no message")
        return data[begin + MESSAGE.size : begin + length]


def _listed(channel: Channel, tables: Sequence[_Table]) -> IndexedMessages:
    """Messages of a channel in file order, without those with invalid offsets.

    An hour has sixteen thousand chunks, so their tables are parsed as one.
    """
    table = np.frombuffer(b"".join(entries for _, entries in tables), _ENTRY)
    counts = [len(entries) // _ENTRY.itemsize for _, entries in tables]
    number = np.repeat(np.array([number for number, _ in tables], np.int64), counts)
    order = np.lexsort((table["offset"], number))
    order = order[table["offset"][order] <= (1 << 40)]
    places = np.full((len(order), 3), _UNKNOWN, np.int64)
    places[:, 0] = number[order]
    places[:, 1] = table["offset"][order]
    return IndexedMessages(channel, table["time_ns"][order], places)
