"""MCAP files opened by their index, without unpacking their chunks.

`open_indexed` opens a recording. Record by record it is looked whether the file is whole and its
index tells of every chunk and every message; of each picture only the beginning is unpacked, where
the sensor's stamp is. Where anything is odd the file is walked as ever (`mcap`). A chunk is checked
against its CRC-32 when a picture in it is read, and not before: that is for whoever refuses what is
damaged (`open_recording(..., strict=True)`).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path

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
    McapFile,
    Wanted,
    open_file,
)
from liex_lab.recordings.formats.messages.message_file import (
    Channel,
    DamagedChunk,
    Envelope,
    Listed,
    Place,
    first_bytes,
)
from liex_lab.recordings.formats.messages.parsers import stamp_reader
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent

_UNTOLD = -1  # the length of a message that only its chunk tells
_LARGEST_INDEX = 1 << 26  # bytes of one
LARGEST_OFFSET = 1 << 40
_INDEX = struct.Struct("<HI")  # of a message index: channel, bytes of its entries
# of a chunk's index: first and last time, where it begins, its length, bytes of the places of its
# message indexes; the channel and place of each; how long these are, bytes of the packing's name;
# packed and unpacked bytes
_OF_CHUNK = struct.Struct("<4QI")
_AT = struct.Struct("<HQ")
_LENGTHS = struct.Struct("<QI")
_SIZES = struct.Struct("<QQ")
ENTRY = np.dtype([("time_ns", "<u8"), ("offset", "<u8")])
_HEAD = 512  # bytes of a message's record in which its stamp is
# of the unpacked bytes; where so much has to be unpacked for the stamps, threads unpack all of it
_WORTH_IT = 0.6


def open_indexed(
    path: Path,
    camera: Lens | None = None,
    fps: float | None = None,
    progress: Progress = silent,
    topic: str | None = None,
) -> Recording:
    """Open one depth topic of an MCAP file by its index, or as `open_mcap` does where it has none.

    Args:
        path: the .mcap file.
        camera: comes before whatever the files state.
        fps: not needed, for every message has its time.
        progress: told how far the file was looked through.
        topic: name of the depth topic; None for the only one.

    Returns:
        The recording. Reading a frame of it raises a `RecordingError` where its chunk is damaged.

    Raises:
        RecordingError: the file is no MCAP file, or holds no depth that can be chosen.
    """
    return open_topic(_Skimmed(path, open_file(path)), "mcap", camera, topic, progress)


class IndexedMcap(McapFile):
    """An MCAP file whose messages are found by its index.

    Attributes:
        advice: what to do where a chunk of it is damaged.
    """

    advice = ""

    def read(self, place: Place) -> memoryview:
        """The data of one message.

        Args:
            place: where it lies; a length that is not told is looked up in its chunk.

        Raises:
            RecordingError: its chunk is damaged.
        """
        if place.length != _UNTOLD:
            return super().read(place)
        try:
            return self._message(place)
        except DamagedChunk as error:
            raise RecordingError(f"{self.path} is damaged ({error}); {self.advice}") from None

    def _message(self, place: Place) -> memoryview:
        """The data of a message whose length only its chunk tells."""
        data = self.unpack(place.chunk)
        try:
            opcode, length = RECORD.unpack_from(data, place.offset)
        except struct.error:
            opcode, length = 0, 0
        begin = place.offset + RECORD.size
        if opcode != Opcode.MESSAGE or not MESSAGE.size <= length <= len(data) - begin:
            raise DamagedChunk("there is no message where its index says")
        return data[begin + MESSAGE.size : begin + length]

    def take_chunk(self, index: ChunkIndex) -> int:
        """Note a chunk.

        Args:
            index: its index.

        Returns:
            Its number.

        Raises:
            DamagedChunk: there is none where its index says.
        """
        opcode, start, end = self._record(index.chunk_start_offset)
        if opcode != Opcode.CHUNK:
            raise DamagedChunk("there is no chunk where its index says")
        self.chunks.append(self._chunk(start, end - start))
        return len(self.chunks) - 1

    def _listed(self, channel: Channel, at: int, number: int) -> Listed:
        """The messages of a channel in a chunk, of the index at `at`, in file order."""
        kind, begin, stop = self._record(at)
        if kind != Opcode.MESSAGE_INDEX:
            raise DamagedChunk("there is no index where it should be")
        return listed_in(channel, number, self._message_index(begin, stop))

    def indexes(self) -> list[ChunkIndex]:
        """The indexes of its chunks, in file order."""
        found = [chunk_index(content) for content in self.listed]
        return sorted(found, key=lambda index: index.chunk_start_offset)

    def _message_index(self, begin: int, stop: int) -> NDArray[np.void]:
        """Times and offsets of one channel's messages in a chunk, in file order.

        An hour's index lists a hundred thousand, so they are read as a table.
        """
        table = np.frombuffer(entries(self.between(begin, stop)), ENTRY)
        if len(table) and table["offset"].max() > LARGEST_OFFSET:
            raise ValueError("an index leads out of its chunk")
        return table[np.argsort(table["offset"], kind="stable")]

    def _stream(self, start: int, end: int) -> ReadDataStream:
        """The bytes between, of a record of some kilobytes."""
        return ReadDataStream(BytesIO(self.between(start, end)))

    def between(self, start: int, end: int) -> bytes:
        """The bytes of records of some kilobytes.

        Args:
            start: where they begin in the file.
            end: where they end.

        Raises:
            ValueError: they are more than a file's index can be.
        """
        if not 0 <= end - start <= min(_LARGEST_INDEX, self.size):
            raise ValueError("an index is larger than its file")
        self.file.seek(start)
        return self.file.read(end - start)


class _Skimmed(IndexedMcap):
    """An MCAP file that is whole as its index says; one about which that is not sure is walked."""

    advice = (
        "copy it again, or go on with what is whole by adding --set recording.accept_truncated=true"
    )

    def walk(self, wanted: Wanted, progress: Progress) -> Iterator[Envelope | Listed]:
        """The messages of the wanted channels by chunk: the first of each channel with its data.

        Args:
            wanted: says of a channel whether its messages are of use.
            progress: told how many MB were looked through.

        Yields:
            The messages.
        """
        self._learn_ending()
        indexes = self._whole_by_index(progress)
        if not indexes:
            yield from super().walk(wanted, progress)
            return
        self.parsed = False
        met = set[Channel]()
        for index in indexes:
            try:
                yield from self._skim(index, wanted, met)
            except (*DAMAGE, DamagedChunk):
                self.whole = False

    def _skim(
        self, index: ChunkIndex, wanted: Wanted, met: set[Channel]
    ) -> Iterator[Envelope | Listed]:
        """The wanted messages of one chunk; of channels met before with nothing but the stamps."""
        number = self.take_chunk(index)
        for channel_id, at in index.message_index_offsets.items():
            channel = self._by_id[channel_id]
            if not wanted(channel):
                continue
            listed = self._listed(channel, at, number)
            stamps = self._stamps(listed, channel_id) if channel in met else None
            if stamps is not None:
                yield Listed(channel, listed.log_time_ns, listed.places, stamps)
                continue
            for time_ns, numbers in zip(
                listed.log_time_ns.tolist(), listed.places.tolist(), strict=True
            ):
                if wanted(channel):
                    met.add(channel)
                    place = Place(*numbers)
                    yield Envelope(channel, time_ns, place, self._message(place))

    def _stamps(self, listed: Listed, channel_id: int) -> NDArray[np.int64] | None:
        """Stamps (n,) of messages of one chunk, ns; None where their beginnings do not tell."""
        read = stamp_reader(listed.channel)
        if read is None:
            return None
        found = []
        number = int(listed.places[0, 0]) if len(listed.places) else 0
        heads = self._heads(number, listed.places[:, 1].tolist())
        for time_ns, head in zip(listed.log_time_ns.tolist(), heads, strict=True):
            opcode, length = RECORD.unpack_from(head)
            whose, _, logged_ns, _ = MESSAGE.unpack_from(head, RECORD.size)
            if opcode != Opcode.MESSAGE or (whose, logged_ns) != (channel_id, time_ns):
                raise DamagedChunk("there is another message than its index says")
            stamp_ns = read(head[RECORD.size + MESSAGE.size : RECORD.size + length])
            if stamp_ns is None:
                return None
            found.append(stamp_ns)
        return np.array(found, np.int64)

    def _heads(self, number: int, offsets: Sequence[int]) -> list[memoryview]:
        """The first bytes of the records at these offsets of a chunk."""
        if not offsets:
            return []
        chunk = self.believable(number)
        if chunk.packing in ("", "none"):
            if chunk.length != chunk.size:
                raise DamagedChunk("its parts do not fit into it")
            places = [(chunk.offset + at, chunk.offset + chunk.length) for at in offsets]
            return [memoryview(self.between(at, min(at + _HEAD, end))) for at, end in places]
        need = min(offsets[-1] + _HEAD, chunk.size)
        data = memoryview(first_bytes(self.file, chunk, need))
        return [data[at : at + _HEAD] for at in offsets]

    def _whole_by_index(self, progress: Progress) -> list[ChunkIndex]:
        """The indexes of all chunks of a file that is whole as they say; none where that is not
        sure, or where unpacking all is no more work.
        """
        try:
            indexes = self.indexes()
            by_start = {index.chunk_start_offset: index for index in indexes}
            if len(by_start) == len(indexes) and self._agrees(by_start, progress):
                return indexes if self._is_worth_it(indexes) else []
        except (*DAMAGE, DamagedChunk):
            pass  # the walk says what it finds
        return []

    def _agrees(self, by_start: dict[int, ChunkIndex], progress: Progress) -> bool:
        """Whether the file's records are those that its index tells of, from its beginning to its
        end.
        """
        at, n_messages = len(MAGIC), 0
        unseen = dict(by_start)
        expected = set[int]()  # where the indexes of the messages in the last chunk are
        while at + RECORD.size <= self.size:
            opcode, start, end = self._record(at)
            if opcode in (0, Opcode.MESSAGE) or end > self.size:
                return False
            if opcode == Opcode.MESSAGE_INDEX:
                if at not in expected:
                    return False
                expected.remove(at)
                n_messages += (end - start - _INDEX.size) // ENTRY.itemsize
            elif expected:
                return False
            elif opcode == Opcode.CHUNK:
                index = unseen.pop(at, None)
                if index is None or index.chunk_length != end - at:
                    return False
                expected = set(index.message_index_offsets.values())
            elif opcode in FACTS and end - start <= LARGEST_FACT:
                self._learn(opcode, self._stream(start, end))
            elif opcode == Opcode.FOOTER:
                whole = end + len(MAGIC) <= self.size
                known = {i for index in by_start.values() for i in index.message_index_offsets}
                told = n_messages == self.n_messages and known <= set(self._by_id)
                return whole and told and not unseen
            at = end
            progress(at >> 20, (self.size >> 20) + 1, "looking through the recording (MB)")
        return False

    def _is_worth_it(self, indexes: Sequence[ChunkIndex]) -> bool:
        """Whether the stamps are in so few of the bytes that the rest need not be unpacked."""
        size, needed = 1, 0
        for index in indexes:
            if index.compression in ("", "none"):
                continue
            size += index.uncompressed_size
            last = 0
            for at in index.message_index_offsets.values():
                _, begin, stop = self._record(at)
                offsets = self._message_index(begin, stop)["offset"]
                last = max(last, int(offsets[-1]) + _HEAD if len(offsets) else 0)
            needed += min(last, index.uncompressed_size)
        return needed <= _WORTH_IT * size


def entries(index: bytes) -> bytes:
    """The times and offsets of messages, as they are written.

    Args:
        index: content of a message index's record.

    Raises:
        struct.error, ValueError: they do not fit into it.
    """
    _, length = _INDEX.unpack_from(index)
    if length != len(index) - _INDEX.size or length % ENTRY.itemsize:
        raise ValueError("an index does not fit into its record")
    return index[_INDEX.size :]


def listed_in(channel: Channel, number: int | NDArray[np.int64], table: NDArray[np.void]) -> Listed:
    """Messages whose lengths only their chunks tell.

    Args:
        channel: theirs.
        number: of the chunk that they are in, or (n,) of each one's.
        table: (n,) `ENTRY` of each.
    """
    places = np.empty((len(table), 3), np.int64)
    places[:, 0] = number
    places[:, 1] = table["offset"]
    places[:, 2] = _UNTOLD
    return Listed(channel, table["time_ns"], places)


def chunk_index(content: bytes) -> ChunkIndex:
    """The index of a chunk; the library reads it a number at a time, and of an hour there are
    sixteen thousand.

    Args:
        content: of its record.

    Raises:
        struct.error: it is shorter than it says.
        ValueError: a part does not fit into it.
    """
    first_ns, last_ns, start, length, n_bytes = _OF_CHUNK.unpack_from(content)
    at = _OF_CHUNK.size
    places = dict(_AT.iter_unpack(content[at : at + n_bytes]))
    index_length, n_name = _LENGTHS.unpack_from(content, at + n_bytes)
    at += n_bytes + _LENGTHS.size
    packed, size = _SIZES.unpack_from(content, at + n_name)
    return ChunkIndex(
        chunk_length=length,
        chunk_start_offset=start,
        compression=content[at : at + n_name].decode(),
        compressed_size=packed,
        message_end_time=last_ns,
        message_index_length=index_length,
        message_index_offsets=places,
        message_start_time=first_ns,
        uncompressed_size=size,
    )
