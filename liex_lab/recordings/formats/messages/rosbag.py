"""ROS bags, whole or cut: ROS 1 `.bag` (format 2.0, also RealSense's) and ROS 2 `.db3` (SQLite).

A `.bag` is walked from its beginning and needs no index. The index is written last, so interrupted
recordings lack it; `rosbags`, the reference library in the tests, refuses such files. A record is a
header of named fields and data; a chunk packs records (none, bz2, lz4).
"""

import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Lens
from liex_lab.recordings.formats.messages.depth_topics import open_topic
from liex_lab.recordings.formats.messages.messages import (
    Channel,
    Chunk,
    DamagedChunk,
    Envelope,
    IsRelevant,
    MessageFile,
    MessagePlace,
)
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent

_VERSION = b"#ROSBAG V2.0\n"
_SQLITE = b"SQLite format 3\0"
_U32 = struct.Struct("<I")
_TIME = struct.Struct("<II")
_MESSAGE = 2
_HEADER = 3
_CHUNK = 5
_CONNECTION = 7
_DAMAGE = (KeyError, ValueError, OverflowError, struct.error)


def open_bag(
    path: Path,
    camera: Lens | None = None,
    fps: float | None = None,
    progress: Progress = silent,
    topic: str | None = None,
) -> Recording:
    """Open one depth topic of a ROS bag as a recording.

    Args:
        path: the .bag or .db3 file.
        camera: overrides the camera in the files.
        fps: unused, as every message has its time.
        progress: reports the progress of the walk over the file.
        topic: name of the depth topic; None for the only one.

    Raises:
        RecordingError: the file is not such a bag, is encrypted, or has no depth topic to choose.
    """
    file = path.open("rb")
    magic = file.read(len(_SQLITE))
    if magic.startswith(_VERSION):
        return open_topic(BagFile(path, file), "rosbag", camera, topic, progress)
    if magic == _SQLITE:
        return open_topic(Db3File(path, file), "rosbag2", camera, topic, progress)
    file.close()
    if magic.startswith(b"#ROSBAG V"):
        raise RecordingError(
            f"{path} is a bag of an old ROS; bring it to version 2.0 with `rosbag fix` and give "
            "that"
        )
    raise RecordingError(
        f"{path} is named like a ROS bag but holds something else; give another file"
    )


class BagFile(MessageFile):
    """An open ROS 1 bag, version 2.0: records, each with a header of named fields and data."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        """Keep an open file; nothing is read."""
        super().__init__(path, file)
        self._by_id: dict[int, Channel] = {}

    def walk(self, wanted: IsRelevant, progress: Progress) -> Iterator[Envelope]:
        """Every whole message of the wanted channels, in file order.

        Args:
            wanted: whether the messages of a channel are relevant.
            progress: reports how many MB were walked over.

        Yields:
            The messages.

        Raises:
            RecordingError: the bag is encrypted.
        """
        at = len(_VERSION)
        indexed = False
        while at + _U32.size <= self.size:
            try:
                header, begin, end = self._record(at)
                opcode = header["op"][0]
                if opcode == _CHUNK and (end <= self.size or not self.starts):
                    yield from self._walk_chunk(header, begin, end, wanted)
                elif end > self.size:
                    raise ValueError("a record reaches past the end of the file")
                elif opcode == _HEADER:
                    indexed = self._learn_ending(header)
                elif opcode in (_CONNECTION, _MESSAGE):
                    self.file.seek(begin)
                    data = memoryview(self.file.read(end - begin))
                    yield from self._take(
                        opcode, header, data, MessagePlace(-1, begin, end - begin), wanted
                    )
                at = end
            except DamagedChunk:
                self.whole = False
                at = end
            except (*_DAMAGE, IndexError):
                at = self.resume(at)
            progress(
                min(at, self.size) >> 20,
                (self.size >> 20) + 1,
                "scanning the recording (MB)",
            )
        # Only an interrupted recording has no index at its end.
        self.whole = self.whole and at == self.size and indexed

    def _record(self, at: int) -> tuple[dict[str, bytes], int, int]:
        """The header of the record at `at`, and start and end of its data."""
        self.file.seek(at)
        (n_header,) = _U32.unpack(self.file.read(_U32.size))
        begin = at + 2 * _U32.size + n_header
        # a connection's header contains its message definition
        if n_header > (1 << 24) or begin > self.size:
            raise ValueError("a header is too long")
        block = self.file.read(n_header + _U32.size)
        (n_data,) = _U32.unpack_from(block, n_header)
        return _fields(memoryview(block)[:n_header]), begin, begin + n_data

    def _learn_ending(self, header: dict[str, bytes]) -> bool:
        """Read connections and positions of chunks from the index at the end; False without one."""
        if header.get("encryptor"):
            raise RecordingError(
                f"{self.path} is an encrypted bag, which cannot be read; give it without encryption"
            )
        (at,) = struct.unpack("<Q", header["index_pos"])
        indexed = at > 0
        try:
            while 0 < at < self.size:
                facts, begin, end = self._record(at)
                if facts["op"][0] == 6:  # information on a chunk
                    self.starts += struct.unpack("<Q", facts["chunk_pos"])
                elif (
                    facts["op"][0] == _CONNECTION and end <= self.size
                ):  # not past the end of the file
                    self.file.seek(begin)
                    self._connect(facts, memoryview(self.file.read(end - begin)))
                else:
                    break
                at = end
        except (*_DAMAGE, IndexError):
            pass  # the walk reports damage
        self.starts.sort()
        return indexed

    def _walk_chunk(
        self, header: dict[str, bytes], begin: int, end: int, wanted: IsRelevant
    ) -> Iterator[Envelope]:
        cut = end > self.size
        (size,) = _U32.unpack(header["size"])
        packing = header["compression"].decode()
        number = len(self.chunks)
        self.chunks.append(Chunk(begin, min(end, self.size) - begin, packing, size, 0, cut))
        data = self.unpack(number)
        at = 0
        while at + _U32.size <= len(data):
            (n_header,) = _U32.unpack_from(data, at)
            start = at + 2 * _U32.size + n_header
            if start > len(data):
                break
            inner = _fields(data[at + _U32.size : start - _U32.size])
            (length,) = _U32.unpack_from(data, start - _U32.size)
            at = start + length
            if at > len(data):
                break
            yield from self._take(
                inner["op"][0], inner, data[start:at], MessagePlace(number, start, length), wanted
            )
        self.whole = self.whole and at == len(data) and not cut

    def _take(
        self,
        opcode: int,
        header: dict[str, bytes],
        data: memoryview,
        place: MessagePlace,
        wanted: IsRelevant,
    ) -> Iterator[Envelope]:
        """Record a connection, or yield a message."""
        if opcode == _CONNECTION:
            self._connect(header, data)
        elif opcode == _MESSAGE:
            (number,) = _U32.unpack(header["conn"])
            seconds, nanoseconds = _TIME.unpack(header["time"])
            channel = self._by_id[number]
            if wanted(channel):
                yield Envelope(channel, seconds * 10**9 + nanoseconds, place, data)

    def _connect(self, header: dict[str, bytes], data: memoryview) -> None:
        """Record a connection: the topic and its message type."""
        (number,) = _U32.unpack(header["conn"])
        topic = "/" + "/".join(part for part in header["topic"].decode().split("/") if part)
        channel = Channel(topic, _fields(data)["type"].decode(), "ros1")
        if self._by_id.setdefault(number, channel) == channel:
            self.channels.setdefault(channel)


def _fields(header: memoryview) -> dict[str, bytes]:
    """The named fields of a header: each is preceded by its length, with an = after the name."""
    fields: dict[str, bytes] = {}
    at = 0
    while at < len(header):
        (length,) = _U32.unpack_from(header, at)
        at += _U32.size + length
        if at > len(header):
            raise ValueError("a header ends too early")
        name, _, value = bytes(header[at - length : at]).partition(b"=")
        fields[name.decode()] = value
    return fields


class Db3File(MessageFile):
    """An open ROS 2 bag in SQLite: a table of topics and a table of messages."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        """Open the database, read-only."""
        super().__init__(path, file)
        # used by several threads, one at a time; immutable: no lock file is
        # created
        uri = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
        self._base = sqlite3.connect(uri, uri=True, check_same_thread=False)

    def walk(self, wanted: IsRelevant, progress: Progress) -> Iterator[Envelope]:
        """Every message of the wanted channels, in the order in which they were stored.

        Args:
            wanted: whether the messages of a channel are relevant.
            progress: reports how many messages were walked over.

        Yields:
            The messages, up to the first damaged one.

        Raises:
            RecordingError: the tables are views, virtual or generated.
        """
        self._refuse_views()
        try:
            rows = self._base.execute(
                "SELECT id, name, type, serialization_format FROM topics"
            ).fetchall()
            by_id = {int(row[0]): Channel(*map(str, row[1:])) for row in rows}
            self.channels = dict.fromkeys(by_id.values())
            (last,) = self._base.execute("SELECT max(id) FROM messages").fetchone()
            messages = self._base.execute(
                "SELECT id, topic_id, timestamp FROM messages ORDER BY id"
            )
            for number, topic, log_time_ns in messages:
                channel = by_id[topic]
                if wanted(channel):
                    place = MessagePlace(-1, number, 0)
                    yield Envelope(channel, int(log_time_ns), place, self._fetch(number))
                progress(number, last, "scanning the recording (messages)")
        except (sqlite3.Error, KeyError, ValueError, TypeError, OverflowError):
            self.whole = False

    def _refuse_views(self) -> None:
        """Refuse tables that are computed on reading: a recursive one never ends."""
        try:
            stored = self._base.execute(
                "SELECT lower(name), type, lower(sql) FROM sqlite_master "
                "WHERE lower(name) IN ('topics', 'messages')"
            ).fetchall()
        except (sqlite3.Error, ValueError, OverflowError):
            return  # the walk reports damage
        for name, kind, made in stored:
            if kind != "table" or "virtual" in str(made) or "generated" in str(made):
                raise RecordingError(
                    f"{self.path} is no ROS 2 bag: its {name} are not stored but worked out; give "
                    "another file"
                )

    def _fetch(self, number: int) -> memoryview:
        row = self._base.execute("SELECT data FROM messages WHERE id = ?", (number,)).fetchone()
        return memoryview(row[0])

    def read(self, place: MessagePlace) -> memoryview:
        """The data of one message; empty if it is damaged.

        Args:
            place: its `offset` is the message's id in the table.
        """
        try:
            return self._fetch(place.offset)
        except (sqlite3.Error, TypeError):
            return memoryview(b"")  # damaged: messages are never empty

    def close(self) -> None:
        """Close the database and the file."""
        self._base.close()
        super().close()
