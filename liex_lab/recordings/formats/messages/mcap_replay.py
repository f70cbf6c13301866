"""A session's replay, session.mcap, opened by its index without unpacking its chunks.

It was written by this program, under the times of its frames, and holds almost as many bytes of
still scene as frames; of an hour's, some pictures are wanted at once. So its index is believed, and
of a damaged one the rest is read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from liex_lab.errors import RecordingError
from liex_lab.recordings.formats.messages.depth_topics import open_topic
from liex_lab.recordings.formats.messages.mcap import DAMAGE, RECORD, Wanted, open_file
from liex_lab.recordings.formats.messages.mcap_index import (
    ENTRY,
    LARGEST_OFFSET,
    IndexedMcap,
    entries,
    listed_in,
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

_BYTES = ENTRY.itemsize  # of a message in an index


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


class _Replay(IndexedMcap):
    """An MCAP file whose index is believed; one without an index is walked."""

    advice = "copy it again, or run `liex run` on its recording"

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
            indexes = self.indexes()
        except DAMAGE:
            indexes = []
        if not indexes or not all(index.message_index_length for index in indexes):
            yield from super().walk(wanted, progress)
            return
        tables: dict[Channel, list[tuple[int, bytes]]] = {}
        for index in indexes:
            try:
                parts = self._tables(index, wanted)
            except (*DAMAGE, DamagedChunk):
                self.whole = False
                continue
            for channel, part in parts:
                if channel in tables:
                    tables[channel].append(part)
                    continue
                first = _together(channel, [part])
                if len(first.places):
                    place = Place(*first.places[0].tolist())
                    yield Envelope(channel, int(first.log_time_ns[0]), place, self.read(place))
                    tables[channel] = [part]
        for channel, those in tables.items():
            if wanted(channel):
                every = _together(channel, those)
                self.whole &= len(every.places) == sum(len(one) for _, one in those) // _BYTES
                yield Listed(channel, every.log_time_ns[1:], every.places[1:])

    def _tables(self, index: ChunkIndex, wanted: Wanted) -> list[tuple[Channel, tuple[int, bytes]]]:
        """Of each wanted channel in a chunk the chunk's number and the times and offsets of the
        messages, as they are written.
        """
        number = self.take_chunk(index)
        where = index.message_index_offsets
        first = min(where.values(), default=0)
        content = self.between(first, first + index.message_index_length)
        found = []
        for channel_id, at in where.items():
            channel = self._by_id[channel_id]
            if not wanted(channel):
                continue
            kind, length = RECORD.unpack_from(content, at - first)
            begin = at - first + RECORD.size
            if kind != Opcode.MESSAGE_INDEX or begin + length > len(content):
                raise DamagedChunk("there is no index where it should be")
            found.append((channel, (number, entries(content[begin : begin + length]))))
        return found


def _together(channel: Channel, tables: Sequence[tuple[int, bytes]]) -> Listed:
    """Messages of a channel in chunks (number, times and offsets), in file order; those whose
    offset cannot be are left out.

    Of an hour there are sixteen thousand chunks, so their tables are read as one.
    """
    table = np.frombuffer(b"".join(content for _, content in tables), ENTRY)
    counts = [len(content) // _BYTES for _, content in tables]
    number = np.repeat(np.array([number for number, _ in tables], np.int64), counts)
    order = np.lexsort((table["offset"], number))
    order = order[table["offset"][order] <= LARGEST_OFFSET]
    return listed_in(channel, number[order], table[order])
