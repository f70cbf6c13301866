"""The index of an MCAP file: its chunks, and the messages in them without unpacking."""

from __future__ import annotations

import struct
from io import BytesIO

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.recordings.formats.messages.mcap import MESSAGE, RECORD, McapFile
from liex_lab.recordings.formats.messages.message_file import (
    Channel,
    DamagedChunk,
    Listed,
    Place,
)

_UNTOLD = -1  # the length of a message that only its chunk tells
_LARGEST_INDEX = 1 << 26  # bytes of one
LARGEST_OFFSET = 1 << 40
INDEX = struct.Struct("<HI")  # of a message index: channel, bytes of its entries
# of a chunk's index: first and last time, where it begins, its length, bytes of the places of its
# message indexes; the channel and place of each; how long these are, bytes of the packing's name;
# packed and unpacked bytes
_OF_CHUNK = struct.Struct("<4QI")
_AT = struct.Struct("<HQ")
_LENGTHS = struct.Struct("<QI")
_SIZES = struct.Struct("<QQ")
ENTRY = np.dtype([("time_ns", "<u8"), ("offset", "<u8")])


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


def entries(index: bytes) -> bytes:
    """The times and offsets of messages, as they are written.

    Args:
        index: content of a message index's record.

    Raises:
        struct.error, ValueError: they do not fit into it.
    """
    _, length = INDEX.unpack_from(index)
    if length != len(index) - INDEX.size or length % ENTRY.itemsize:
        raise ValueError("an index does not fit into its record")
    return index[INDEX.size :]


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
