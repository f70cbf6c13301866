"""MCAP files opened by their index, without unpacking their chunks.

`open_indexed` opens a recording. Record by record it is looked whether the file is whole and its
index tells of every chunk and every message; of each picture only the beginning is unpacked, where
the sensor's stamp is, on threads of their own. Where anything is odd the file is walked as ever
(`mcap`). A chunk is checked against its CRC-32 when a picture in it is read, and not before: that
is for whoever refuses what is damaged (`open_recording(..., strict=True)`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from numpy.typing import NDArray

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
    Wanted,
    open_file,
)
from liex_lab.recordings.formats.messages.mcap_index import ENTRY, INDEX, IndexedMcap
from liex_lab.recordings.formats.messages.message_file import (
    Channel,
    DamagedChunk,
    Envelope,
    Listed,
    Place,
    first_bytes,
)
from liex_lab.recordings.formats.messages.messages import CALIBRATION_SCHEMAS
from liex_lab.recordings.formats.messages.parsers import plain_schema, stamp_reader
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent

_HEAD = 512  # bytes of a message's record in which its stamp is
# of the unpacked bytes; where so much has to be unpacked for the stamps, threads unpack all of it
_WORTH_IT = 0.6
_BATCH = 32  # chunks from which one task unpacks the beginnings of messages
_AHEAD = 2 * THREADS  # tasks; what they give is small


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


@dataclass
class _Part:
    """One chunk of the file.

    Attributes:
        number: its number.
        listed: channel id -> the messages of a wanted channel, in the order of the index.
        heads: channel id -> the beginnings of their records, where they were unpacked ahead.
    """

    number: int
    listed: dict[int, Listed]
    heads: dict[int, list[bytes]] = field(default_factory=dict)


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
        with ThreadPoolExecutor(THREADS) as unpackers:
            try:
                for part in self._parts(indexes, wanted, met, unpackers):
                    try:
                        yield from self._skim(part, wanted, met)
                    except (*DAMAGE, DamagedChunk):
                        self.whole = False
            finally:
                unpackers.shutdown(wait=False, cancel_futures=True)

    def _parts(
        self,
        indexes: Sequence[ChunkIndex],
        wanted: Wanted,
        met: set[Channel],
        unpackers: ThreadPoolExecutor,
    ) -> Iterator[_Part]:
        """The chunks in their order, the beginnings of messages of channels met before unpacked."""
        coming = deque[Future[list[_Part]]]()
        for first in range(0, len(indexes), _BATCH):
            parts = [self._part(index, wanted) for index in indexes[first : first + _BATCH]]
            whole = [part for part in parts if part is not None]
            coming.append(unpackers.submit(self._with_heads, whole, frozenset(met)))
            if len(coming) > _AHEAD:
                yield from coming.popleft().result()
        while coming:
            yield from coming.popleft().result()

    def _part(self, index: ChunkIndex, wanted: Wanted) -> _Part | None:
        """What an index lists of one chunk; None where it is damaged."""
        try:
            part = _Part(self.take_chunk(index), {})
            for channel_id, at in index.message_index_offsets.items():
                channel = self._by_id[channel_id]
                if wanted(channel):
                    part.listed[channel_id] = self._listed(channel, at, part.number)
        except (*DAMAGE, DamagedChunk):
            self.whole = False
            return None
        return part

    def _with_heads(self, parts: list[_Part], met: frozenset[Channel]) -> list[_Part]:
        """Chunks with the beginnings of the messages whose stamps will be wanted, as far as they
        can be had: of a damaged one who wants them is told in turn.
        """
        with self.path.open("rb") as file:  # a place of its own to read at
            for part in parts:
                for channel_id, listed in part.listed.items():
                    if listed.channel in met and stamp_reader(listed.channel) is not None:
                        with suppress(*DAMAGE, DamagedChunk):
                            part.heads[channel_id] = self._heads(file, listed)
        return parts

    def _skim(self, part: _Part, wanted: Wanted, met: set[Channel]) -> Iterator[Envelope | Listed]:
        """The wanted messages of one chunk; of channels met before with nothing but the stamps."""
        for channel_id, listed in part.listed.items():
            channel = listed.channel
            if not wanted(channel):
                continue
            if channel in met and plain_schema(channel) in CALIBRATION_SCHEMAS:
                yield listed
                continue
            stamps = None
            if channel in met:
                stamps = self._stamps(listed, channel_id, part.heads.get(channel_id))
            if stamps is not None:
                yield Listed(channel, listed.log_time_ns, listed.places, *stamps)
                continue
            for time_ns, numbers in zip(
                listed.log_time_ns.tolist(), listed.places.tolist(), strict=True
            ):
                if wanted(channel):
                    met.add(channel)
                    place = Place(*numbers)
                    data = self._message(place)
                    record = self.unpack(place.chunk)[place.offset + RECORD.size :]
                    yield Envelope(channel, time_ns, place, data, MESSAGE.unpack_from(record)[3])

    def _stamps(
        self, listed: Listed, channel_id: int, heads: list[bytes] | None
    ) -> tuple[NDArray[np.int64], NDArray[np.uint64]] | None:
        """Stamps (n,) and times of sending (n,) of messages of one chunk, ns; None where their
        beginnings do not tell.
        """
        read = stamp_reader(listed.channel)
        if read is None:
            return None
        found = []
        published = []
        if heads is None:
            heads = self._heads(self.file, listed)
        for time_ns, head in zip(listed.log_time_ns.tolist(), heads, strict=True):
            opcode, length = RECORD.unpack_from(head)
            whose, _, logged_ns, published_ns = MESSAGE.unpack_from(head, RECORD.size)
            if opcode != Opcode.MESSAGE or (whose, logged_ns) != (channel_id, time_ns):
                raise DamagedChunk("there is another message than its index says")
            stamp_ns = read(memoryview(head)[RECORD.size + MESSAGE.size : RECORD.size + length])
            if stamp_ns is None:
                return None
            found.append(stamp_ns)
            published.append(published_ns)
        return np.array(found, np.int64), np.array(published, np.uint64)

    def _heads(self, file: IO[bytes], listed: Listed) -> list[bytes]:
        """The first bytes of the records of messages of one chunk."""
        if not len(listed.places):
            return []
        offsets = listed.places[:, 1].tolist()
        chunk = self.believable(int(listed.places[0, 0]))
        if chunk.packing in ("", "none"):
            if chunk.length != chunk.size:
                raise DamagedChunk("its parts do not fit into it")
            heads = []
            for at in offsets:
                file.seek(chunk.offset + at)
                heads.append(file.read(max(0, min(_HEAD, chunk.length - at))))
            return heads
        data = first_bytes(file, chunk, min(offsets[-1] + _HEAD, chunk.size))
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
                n_messages += (end - start - INDEX.size) // ENTRY.itemsize
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
