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

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, MessageIndex

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
    Place,
)
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent

_UNTOLD = -1  # the length of a message that only its chunk tells
_LARGEST_INDEX = 1 << 26  # bytes of one


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

    def walk(self, wanted: Wanted, progress: Progress) -> Iterator[Envelope]:
        """The messages of the wanted channels, in file order: the first of each with its data.

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
                envelopes = self._listed_in(index, wanted)
            except (*DAMAGE, DamagedChunk):
                self.whole = False
                continue
            for one in envelopes:
                if one.channel in met:
                    if wanted(one.channel):
                        yield one
                    continue
                met.add(one.channel)
                yield one._replace(data=self.read(one.place))

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

    def _listed_in(self, index: ChunkIndex, wanted: Wanted) -> list[Envelope]:
        """The wanted messages of one chunk, in file order, without their data."""
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
            for time_ns, offset in MessageIndex.read(self._stream(begin, stop)).records:
                found.append(Envelope(channel, time_ns, Place(number, offset, _UNTOLD), None))
        self.chunks.append(self._chunk(start, end - start))
        return sorted(found, key=lambda one: one.place.offset)

    def _stream(self, start: int, end: int) -> ReadDataStream:
        """The bytes between, of a record of some kilobytes."""
        if not 0 <= end - start <= min(_LARGEST_INDEX, self.size):
            raise ValueError("an index is larger than its file")
        self.file.seek(start)
        return ReadDataStream(BytesIO(self.file.read(end - start)))
