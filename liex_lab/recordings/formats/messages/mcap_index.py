"""MCAP files opened by their index, without unpacking their chunks.

`open_indexed` first compares the records of the file with its index, which must list every chunk
and every message. Only the beginning of each depth message, with the sensor's stamp, is unpacked,
on several threads. Any other file is walked (`mcap`). A chunk is checked against its CRC-32 only
when a frame in it is read, so this is for callers that refuse damage (`open_recording(...,
strict=True)`).

`open_replay` opens session.mcap, which liex_lab wrote with the times of its frames: its index is
trusted and no stamp is read, because single frames of a long recording are needed quickly.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import IO

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Lens
from liex_lab.recordings.formats.messages.depth_topics import open_topic
from liex_lab.recordings.formats.messages.mcap import (
    DAMAGE,
    FACTS,
    LARGEST_FACT,
    MAGIC,
    MESSAGE,
    RECORD,
    THREADS,
    McapFile,
    Wanted,
    open_file,
)
from liex_lab.recordings.formats.messages.messages import (
    CALIBRATION_SCHEMAS,
    Channel,
    DamagedChunk,
    Envelope,
    Listed,
    Place,
    first_bytes,
)
from liex_lab.recordings.formats.messages.parsers import plain_schema, stamp_reader
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent

_UNKNOWN = -1  # the length of a message is only stated in its chunk
_LARGEST_INDEX = 1 << 26  # bytes of one
_LARGEST_OFFSET = 1 << 40
_INDEX = struct.Struct("<HI")  # of a message index: channel, bytes of its entries
_ENTRY = np.dtype([("time_ns", "<u8"), ("offset", "<u8")])
_HEAD = 512  # first bytes of a message's record, with its stamp
# share of the packed bytes; if stamps need more, everything is unpacked
_WORTH_IT = 0.6
_BATCH = 32  # chunks per task of unpacking
_NOT_READ = (*DAMAGE, DamagedChunk)

_StampReader = Callable[[memoryview], int | None]
_Table = tuple[int, bytes]  # number of a chunk, and times and offsets of messages as written


def open_indexed(
    path: Path,
    camera: Lens | None = None,
    fps: float | None = None,
    progress: Progress = silent,
    topic: str | None = None,
) -> Recording:
    """Open one depth topic of an MCAP file by its index, or like `open_mcap` without an index.

    `fps` is unused, as every message has its time. Reading a frame raises a `RecordingError` if its
    chunk is damaged.

    Raises:
        RecordingError: the file is not MCAP, or has no depth topic to choose.
    """
    return open_topic(_Indexed(path, open_file(path)), "mcap", camera, topic, progress)


def open_replay(path: Path, progress: Progress = silent) -> Recording:
    """Open the depth of a session's replay, session.mcap, as a recording.

    Raises:
        RecordingError: it cannot be read, or has no depth.
    """
    try:
        return open_topic(_Replay(path, open_file(path)), "mcap", None, None, progress)
    except OSError as error:
        raise RecordingError(
            f"{path} cannot be read ({error.strerror or error}); check it"
        ) from None


class _Indexed(McapFile):
    """An MCAP file that is complete according to its index; any other is walked."""

    trusted = False
    advice = (
        "copy it again, or go on with what is whole by adding --set recording.accept_truncated=true"
    )

    def walk(self, wanted: Wanted, progress: Progress) -> Iterator[Envelope | Listed]:
        """The messages of the wanted channels, by channel: the first of each with its data."""
        self._learn_ending()
        indexes: list[ChunkIndex] = []
        usable = False
        try:
            indexes = [ChunkIndex.read(ReadDataStream(BytesIO(one))) for one in self.listed]
            indexes.sort(key=lambda index: index.chunk_start_offset)
            if self.trusted:
                usable = all(index.message_index_length for index in indexes)
            else:
                usable = self._agrees(indexes, progress)
        except _NOT_READ:
            pass  # the walk reports damage
        tables: dict[int, list[_Table]] = {}
        for index in indexes if usable else []:
            try:
                for channel_id, table in self._tables(index, wanted):
                    tables.setdefault(channel_id, []).append(table)
            except _NOT_READ:
                self.whole = False
        if not (indexes and usable and (self.trusted or self._is_worth_it(tables))):
            self.chunks.clear()
            yield from super().walk(wanted, progress)
            return
        self.parsed = self.trusted
        for channel_id, those in tables.items():
            yield from self._messages(channel_id, those, wanted)

    def _tables(self, index: ChunkIndex, wanted: Wanted) -> list[tuple[int, _Table]]:
        """Contents of the message indexes of one chunk, by channel."""
        opcode, start, end = self._record(index.chunk_start_offset)
        if opcode != Opcode.CHUNK:
            raise DamagedChunk("there is no chunk where its index says")
        number = len(self.chunks)
        self.chunks.append(self._chunk(start, end - start))
        offsets = index.message_index_offsets
        first = min(offsets.values(), default=0)
        if not 0 <= index.message_index_length <= min(_LARGEST_INDEX, self.size):
            raise ValueError("an index is larger than its file")
        self.file.seek(first)
        content = self.file.read(index.message_index_length)
        found = []
        for channel_id, at in offsets.items():
            if not wanted(self._by_id[channel_id]):
                continue
            kind, length = RECORD.unpack_from(content, at - first)
            begin = at - first + RECORD.size
            _, n_bytes = _INDEX.unpack_from(content, begin)
            entries = content[begin + _INDEX.size : begin + length]
            if kind != Opcode.MESSAGE_INDEX or n_bytes != len(entries) or n_bytes % _ENTRY.itemsize:
                raise DamagedChunk("there is no index where it should be")
            found.append((channel_id, (number, entries)))
        return found

    def _is_worth_it(self, tables: dict[int, list[_Table]]) -> bool:
        """Whether reading the stamps unpacks few enough bytes."""
        last = [0] * len(self.chunks)
        for number, entries in itertools.chain.from_iterable(tables.values()):
            offsets = np.frombuffer(entries, _ENTRY)["offset"]
            last[number] = max(last[number], int(offsets.max(initial=0)) + _HEAD)
        packed = [
            (n, chunk.size)
            for n, chunk in enumerate(self.chunks)
            if chunk.packing not in ("", "none")
        ]
        needed = sum(min(last[n], size) for n, size in packed)
        return needed <= _WORTH_IT * sum(size for _, size in packed)

    def _messages(
        self, channel_id: int, tables: Sequence[_Table], wanted: Wanted
    ) -> Iterator[Envelope | Listed]:
        """One channel's messages: the first with its data, and the rest listed if possible."""
        channel = self._by_id[channel_id]
        listed = _listed(channel, tables)
        n_stated = sum(len(entries) for _, entries in tables) // _ENTRY.itemsize
        self.whole &= len(listed.places) == n_stated
        rest: Listed | None = None
        tried = False
        for k, (time_ns, numbers) in enumerate(
            zip(listed.log_time_ns.tolist(), listed.places.tolist(), strict=True)
        ):
            if not wanted(channel):
                return
            try:
                place = Place(*numbers)
                data = self._message(place)
                head = place.offset + RECORD.size
                sent_ns = MESSAGE.unpack_from(self.unpack(place.chunk), head)[3]
            except _NOT_READ:
                self.whole = False
                continue
            yield Envelope(channel, time_ns, place, data, sent_ns)
            if not tried:
                later = Listed(channel, listed.log_time_ns[k + 1 :], listed.places[k + 1 :])
                tried, rest = True, self._stamped(channel_id, later)
            if rest is not None:
                yield rest
                return

    def _stamped(self, channel_id: int, listed: Listed) -> Listed | None:
        """Messages with the sensor's stamps; None if reading these needs whole messages."""
        channel = listed.channel
        if self.trusted or plain_schema(channel) in CALIBRATION_SCHEMAS:
            return listed
        read = stamp_reader(channel)
        if read is None:
            return None
        by_chunk = np.flatnonzero(np.diff(listed.places[:, 0])) + 1
        edges = [0, *by_chunk[_BATCH - 1 :: _BATCH].tolist(), len(listed.places)]
        parts = [listed.places[a:b] for a, b in itertools.pairwise(edges)]
        logged = [listed.log_time_ns[a:b] for a, b in itertools.pairwise(edges)]
        with ThreadPoolExecutor(THREADS) as unpackers:
            found = list(unpackers.map(partial(self._stamps, read, channel_id), parts, logged))
        if not all(one is not None for one in found):
            return None
        table = np.concatenate([one for one in found if one is not None])
        good = table[:, 0] == 1
        self.whole = self.whole and bool(good.all())
        sent_ns = table[good, 2].view(np.uint64)
        return Listed(
            channel, listed.log_time_ns[good], listed.places[good], table[good, 1], sent_ns
        )

    def _stamps(
        self,
        read: _StampReader,
        channel_id: int,
        places: NDArray[np.int64],
        logged_ns: NDArray[np.uint64],
    ) -> NDArray[np.int64] | None:
        """(n, 3) for each message whether it could be read, its stamp and its time of sending, ns.

        None if the beginnings of messages do not contain their stamps.
        """
        table = np.zeros((len(places), 3), np.int64)
        with self.path.open("rb") as file:  # threads need separate file positions
            for rows in np.split(np.arange(len(places)), np.flatnonzero(np.diff(places[:, 0])) + 1):
                if not len(rows):
                    continue
                try:
                    heads = self._heads(file, places[rows])
                    for row, head in zip(rows.tolist(), heads, strict=True):
                        opcode, length = RECORD.unpack_from(head)
                        whose, _, log_ns, sent_ns = MESSAGE.unpack_from(head, RECORD.size)
                        if (opcode, whose, log_ns) != (Opcode.MESSAGE, channel_id, logged_ns[row]):
                            raise DamagedChunk("there is another message than its index says")
                        begin = RECORD.size + MESSAGE.size
                        stamp_ns = read(memoryview(head)[begin : RECORD.size + length])
                        if stamp_ns is None:
                            return None
                        table[row] = 1, stamp_ns, np.uint64(sent_ns).view(np.int64)
                except _NOT_READ:
                    table[rows, 0] = 0
        return table

    def _heads(self, file: IO[bytes], places: NDArray[np.int64]) -> list[bytes]:
        """The first bytes of the records of messages of one chunk."""
        offsets = places[:, 1].tolist()
        chunk = self.believable(int(places[0, 0]))
        if chunk.packing not in ("", "none"):
            data = first_bytes(file, chunk, min(offsets[-1] + _HEAD, chunk.size))
            return [data[at : at + _HEAD] for at in offsets]
        if chunk.length != chunk.size:
            raise DamagedChunk("its parts do not fit into it")
        heads = []
        for at in offsets:
            file.seek(chunk.offset + at)
            heads.append(file.read(max(0, min(_HEAD, chunk.length - at))))
        return heads

    def read(self, place: Place) -> memoryview:
        """The data of one message; an unknown length is read from its chunk.

        Raises:
            RecordingError: its chunk is damaged.
        """
        if place.length != _UNKNOWN:
            return super().read(place)
        try:
            return self._message(place)
        except DamagedChunk as error:
            raise RecordingError(f"{self.path} is damaged ({error}); {self.advice}") from None

    def _message(self, place: Place) -> memoryview:
        """The data of a message whose length is only stated in its chunk."""
        data = self.unpack(place.chunk)
        try:
            opcode, length = RECORD.unpack_from(data, place.offset)
        except struct.error:
            opcode, length = 0, 0
        begin = place.offset + RECORD.size
        if opcode != Opcode.MESSAGE or not MESSAGE.size <= length <= len(data) - begin:
            raise DamagedChunk("there is no message where its index says")
        return data[begin + MESSAGE.size : begin + length]

    def _agrees(self, indexes: Sequence[ChunkIndex], progress: Progress) -> bool:
        """Whether the file's records match its index, from beginning to end."""
        at, n_messages = len(MAGIC), 0
        unseen = {index.chunk_start_offset: index for index in indexes}
        if len(unseen) < len(indexes):
            return False
        expected = set[int]()  # positions of the message indexes of the last chunk
        while at + RECORD.size <= self.size:
            opcode, start, end = self._record(at)
            if opcode in (0, Opcode.MESSAGE) or end > self.size:
                return False
            if opcode == Opcode.MESSAGE_INDEX:
                if at not in expected:
                    return False
                expected.remove(at)
                n_messages += (end - start - _INDEX.size) // _ENTRY.itemsize
            elif expected:
                return False
            elif opcode == Opcode.CHUNK:
                index = unseen.pop(at, None)
                if index is None or index.chunk_length != end - at:
                    return False
                expected = set(index.message_index_offsets.values())
            elif opcode in FACTS and end - start <= LARGEST_FACT:
                self._learn(opcode, ReadDataStream(BytesIO(self.file.read(end - start))))
            elif opcode == Opcode.FOOTER:
                known = {i for index in indexes for i in index.message_index_offsets}
                agrees = n_messages == self.n_messages and known <= set(self._by_id)
                return agrees and end + len(MAGIC) <= self.size and not unseen
            at = end
            progress(at >> 20, (self.size >> 20) + 1, "looking through the recording (MB)")
        return False


class _Replay(_Indexed):
    """An MCAP file with a trusted index; one without an index is walked."""

    trusted = True
    advice = "copy it again, or run `liex run` on its recording"


def _listed(channel: Channel, tables: Sequence[_Table]) -> Listed:
    """Messages of a channel in file order, without those with invalid offsets.

    An hour has sixteen thousand chunks, so their tables are parsed as one.
    """
    table = np.frombuffer(b"".join(entries for _, entries in tables), _ENTRY)
    counts = [len(entries) // _ENTRY.itemsize for _, entries in tables]
    number = np.repeat(np.array([number for number, _ in tables], np.int64), counts)
    order = np.lexsort((table["offset"], number))
    order = order[table["offset"][order] <= _LARGEST_OFFSET]
    places = np.full((len(order), 3), _UNKNOWN, np.int64)
    places[:, 0] = number[order]
    places[:, 1] = table["offset"][order]
    return Listed(channel, table["time_ns"][order], places)
