"""The pictures of a session's replay by the index of its MCAP file, without unpacking its chunks.

A recording from elsewhere is walked as a whole (`mcap`): it may be cut, and its messages bear the
sensor's own stamps. A replay was written by this program, under the times of its frames, and holds
almost as many bytes of still scene as frames; of an hour's, some pictures are wanted at once.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.recordings.formats.messages.depth_topics import open_topic
from liex_lab.recordings.formats.messages.mcap import (
    DAMAGE,
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
)
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent

_UNTOLD = -1  # the length of a message that only its chunk tells
_LARGEST_INDEX = 1 << 26  # bytes of one
_LARGEST_OFFSET = 1 << 40
_INDEX = struct.Struct("<HI")  # of a message index: channel, bytes of its entries
_ENTRY = np.dtype([("time_ns", "<u8"), ("offset", "<u8")])


def open_replay(path: Path, progress: Progress = silent) -> Recording:
    """Open the depth of a session's replay as a recording.

    Args:
        path: session.mcap.
        progress: told how far the walk is, where there is no index.

    Raises:
        RecordingError: it cannot be read, or holds no depth.
    """
    try:
        return open_topic(_Replay(path, open_file(path)), "mcap", None, None, progress)
    except OSError as error:
        raise RecordingError(
            f"{path} cannot be read ({error.strerror or error}); check it"
        ) from None


class _Replay(McapFile):
    """An MCAP file whose index is believed; one without an index is walked."""

    def walk(self, wanted: Wanted, progress: Progress) -> Iterator[Envelope | Listed]:
        """The messages of the wanted channels by chunk: the first of each channel with its data.

        Args:
            wanted: says of a channel whether its messages are of use.
            progress: told how many MB were walked over, where there is no index.

        Yields:
            The messages.
        """
        self._learn_ending()
        try:
            indexes = [ChunkIndex.read(self._stream(*place)) for place in self.listed]
        except DAMAGE:
            indexes = []
        if not indexes or not all(index.message_index_length for index in indexes):
            yield from super().walk(wanted, progress)
            return
        met = set[Channel]()
        for index in sorted(indexes, key=lambda index: index.chunk_start_offset):
            try:
                parts = self._listed_in(index, wanted)
            except (*DAMAGE, DamagedChunk):
                self.whole = False
                continue
            for part in parts:
                rest = part
                if part.channel not in met and len(part.places):
                    met.add(part.channel)
                    place = Place(*part.places[0].tolist())
                    yield Envelope(part.channel, int(part.log_time_ns[0]), place, self.read(place))
                    rest = Listed(part.channel, part.log_time_ns[1:], part.places[1:])
                if len(rest.places) and wanted(part.channel):
                    yield rest

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
            data = self.unpack(place.chunk)
            opcode, length = RECORD.unpack_from(data, place.offset)
            begin = place.offset + RECORD.size
            if opcode != Opcode.MESSAGE or not MESSAGE.size <= length <= len(data) - begin:
                raise DamagedChunk("there is no message where its index says")
        except (DamagedChunk, struct.error) as error:
            raise RecordingError(
                f"{self.path} is damaged ({error}); copy it again, or run `liex run` on its "
                "recording"
            ) from None
        return data[begin + MESSAGE.size : begin + length]

    def _listed_in(self, index: ChunkIndex, wanted: Wanted) -> list[Listed]:
        """The wanted messages of one chunk, by channel and in file order."""
        opcode, start, end = self._record(index.chunk_start_offset)
        if opcode != Opcode.CHUNK:
            raise DamagedChunk("there is no chunk where its index says")
        number = len(self.chunks)
        found = []
        for channel_id, at in index.message_index_offsets.items():
            channel = self._by_id[channel_id]
            if not wanted(channel):
                continue
            kind, begin, stop = self._record(at)
            if kind != Opcode.MESSAGE_INDEX:
                raise DamagedChunk("there is no index where it should be")
            table = self._message_index(begin, stop)
            places = np.empty((len(table), 3), np.int64)
            places[:] = number, 0, _UNTOLD
            places[:, 1] = table["offset"]
            found.append(Listed(channel, table["time_ns"], places))
        self.chunks.append(self._chunk(start, end - start))
        return found

    def _message_index(self, begin: int, stop: int) -> NDArray[np.void]:
        """Times and offsets of one channel's messages in a chunk, in file order.

        An hour's index lists a hundred thousand, so they are read as a table.
        """
        content = self._bytes(begin, stop)
        _, length = _INDEX.unpack_from(content)
        if length != len(content) - _INDEX.size or length % _ENTRY.itemsize:
            raise ValueError("an index does not fit into its record")
        table = np.frombuffer(content, _ENTRY, offset=_INDEX.size)
        if len(table) and table["offset"].max() > _LARGEST_OFFSET:
            raise ValueError("an index leads out of its chunk")
        return table[np.argsort(table["offset"], kind="stable")]

    def _stream(self, start: int, end: int) -> ReadDataStream:
        """The bytes between, of a record of some kilobytes."""
        return ReadDataStream(BytesIO(self._bytes(start, end)))

    def _bytes(self, start: int, end: int) -> bytes:
        """The bytes between, of a record of some kilobytes."""
        if not 0 <= end - start <= min(_LARGEST_INDEX, self.size):
            raise ValueError("an index is larger than its file")
        self.file.seek(start)
        return self.file.read(end - start)
