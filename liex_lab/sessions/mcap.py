"""MCAP log of a session for Foxglove: depth, camera, skeleton, transforms, action states; metres.

Messages follow Foxglove's schemas (RawImage 16UC1 in mm, CameraCalibration, FrameTransforms,
SceneUpdate, PosesInFrame, ImageAnnotations, Log) and JSON schemas of our own for actions and the
predicted error. Images are whole, because Foxglove shows a single one. Zstandard finds the still
scene behind cut-outs in the previous image, some 50 images per chunk. Depth is streamed; everything
small is written at the end from the same track as the tables.
"""

import json
import os
import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from itertools import zip_longest
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pandas as pd
import zstandard
from foxglove import messages
from isal import isal_zlib
from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.stream_reader import StreamReader

from liex_lab.arrays import Array, NDArray
from liex_lab.behaviour.interactions import Interactions
from liex_lab.errors import SessionError
from liex_lab.geometry import so3
from liex_lab.recordings.formats.messages.mcap import MAGIC, MESSAGE, RECORD
from liex_lab.runtime.memory import blocks
from liex_lab.sessions.individuals import OtherAnimal, in_replay
from liex_lab.sessions.provenance import Provenance, package_version
from liex_lab.sessions.rrd_scene import dot_mm
from liex_lab.tables.rows import Rows
from liex_lab.tracking.track import Track

_LEAST, _MOST = 10, 27  # log2 of the windows that every Zstandard reader accepts


# of a topic's messages: the schema's name, encoding and content, and the messages' encoding
MessageType = tuple[str, str, bytes, str]


class _Chunk:
    """A chunk in progress: messages are compressed as they arrive, so none waits in memory."""

    def __init__(self, packer: zstandard.ZstdCompressor) -> None:
        self._packing = packer.compressobj()
        self._packed: list[bytes] = []
        self._checksum = 0
        self.size = 0
        self.indexes: dict[int, MessageIndex] = {}

    def put(self, data: bytes | memoryview) -> None:
        self._packed.append(self._packing.compress(data))
        self._checksum = isal_zlib.crc32(data, self._checksum)
        self.size += len(data)

    def record(self) -> Chunk:
        """The whole chunk; nothing may be appended afterwards."""
        self._packed.append(self._packing.flush())
        times = [time_ns for index in self.indexes.values() for time_ns, _ in index.records]
        return Chunk(
            compression="zstd",
            data=b"".join(self._packed),
            message_start_time=min(times),
            message_end_time=max(times),
            uncompressed_crc=self._checksum,
            uncompressed_size=self.size,
        )


class McapLog:
    """Writer of one MCAP file with an index; call `log`, `flush` at will, and `close` once.

    Args:
        sink: binary stream for appending; it stays open.
        topics: the type of each topic's messages. Channels are numbered in this order; to resume a
            file, give the same topics in the same order.
        library: name and version of the writing program.
        level: Zstandard level, 1 to 22.
        chunk_size: bytes of messages that are compressed together.
        repetition: shortest distant repetition to find, bytes; 0 for Zstandard's 64.
        window: bytes searched for repetitions, rounded up to a power of two, 1 kB to 128 MB; a
            window larger than the processor's cache is slow.
        resume: whether `sink` is a file of the same topics that ends after a flush; it is read
            once.
    """

    def __init__(
        self,
        sink: BinaryIO,
        topics: Mapping[str, MessageType],
        *,
        library: str,
        level: int,
        chunk_size: int,
        repetition: int = 0,
        window: int = 1 << 23,
        resume: bool = False,
    ) -> None:
        self._sink = sink
        self._at = 0
        self._chunk_size = chunk_size
        packing = zstandard.ZstdCompressionParameters.from_level(
            level,
            enable_ldm=True,
            window_log=min(max(_LEAST, (window - 1).bit_length()), _MOST),
            ldm_min_match=repetition,
        )
        self._packer = zstandard.ZstdCompressor(compression_params=packing)
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[str, Channel] = {}
        for k, (topic, (name, encoding, data, kind)) in enumerate(topics.items(), 1):
            self._schemas[k] = Schema(id=k, data=data, encoding=encoding, name=name)
            self._channels[topic] = Channel(
                id=k, topic=topic, message_encoding=kind, schema_id=k, metadata={}
            )
        self._introduced: set[str] = set()
        self._counts: Counter[int] = Counter()
        self._chunks: list[ChunkIndex] = []
        self._open = _Chunk(self._packer)
        if resume:
            self._resume(sink)
        else:
            self._write(MAGIC + _bytes_of(Header("liex_lab", library)))

    def _resume(self, written: BinaryIO) -> None:
        """Rebuild counts and chunk indexes from the records of a file without an end."""
        written.seek(0)
        with suppress(McapError, struct.error):
            for record in StreamReader(written, emit_chunks=True).records:
                start, self._at = self._at, written.tell()
                if isinstance(record, Chunk):
                    self._index_chunk(record, start)
                elif isinstance(record, MessageIndex):
                    self._index_messages(record, start)
        if self._at != written.seek(0, os.SEEK_END):
            raise SessionError(
                "the MCAP file was not written whole; make room on the disk and run it again"
            )

    def log(self, topic: str, data: Sequence[bytes | memoryview], time_ns: int) -> None:
        """Add an encoded message, in one or more parts, logged and published at a time."""
        channel = self._channels[topic]
        chunk = self._open
        if topic not in self._introduced:  # in the chunk of its first message
            self._introduced.add(topic)
            chunk.put(_bytes_of(self._schemas[channel.id]) + _bytes_of(channel))
        index = chunk.indexes.setdefault(channel.id, MessageIndex(channel.id, []))
        index.records.append((time_ns, chunk.size))
        number = self._counts[channel.id] + len(index.records)
        head = RECORD.pack(Opcode.MESSAGE, MESSAGE.size + sum(map(len, data)))
        chunk.put(head + MESSAGE.pack(channel.id, number, time_ns, time_ns))
        for part in data:
            chunk.put(part)
        if chunk.size > self._chunk_size:
            self.flush()

    def flush(self) -> None:
        """Write the waiting messages; a file that ends here is readable up to here."""
        chunk = self._open
        if not chunk.indexes:
            return
        record = chunk.record()
        self._open = _Chunk(self._packer)  # not earlier: it resets the packer's state
        start = self._at
        self._write(_bytes_of(record))
        self._index_chunk(record, start)
        for index in chunk.indexes.values():
            start = self._at
            self._write(_bytes_of(index))
            self._index_messages(index, start)

    def _index_chunk(self, record: Chunk, start: int) -> None:
        self._chunks.append(
            ChunkIndex(
                message_start_time=record.message_start_time,
                message_end_time=record.message_end_time,
                chunk_start_offset=start,
                chunk_length=self._at - start,
                message_index_offsets={},
                message_index_length=0,
                compression=record.compression,
                compressed_size=len(record.data),
                uncompressed_size=record.uncompressed_size,
            )
        )

    def _index_messages(self, index: MessageIndex, start: int) -> None:
        self._counts[index.channel_id] += len(index.records)
        self._chunks[-1].message_index_offsets[index.channel_id] = start
        self._chunks[-1].message_index_length += self._at - start

    def close(self) -> None:
        """Write waiting messages, the summary and the footer."""
        self.flush()
        self._write(_bytes_of(DataEnd(0)))
        start = self._at
        channels = [channel for channel in self._channels.values() if self._counts[channel.id]]

        statistics = Statistics(
            attachment_count=0,
            channel_count=len(channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._counts.total(),
            metadata_count=0,
            message_start_time=min((one.message_start_time for one in self._chunks), default=0),
            message_end_time=max((one.message_end_time for one in self._chunks), default=0),
            schema_count=len(channels),
        )
        groups: dict[int, Sequence[McapRecord]] = {
            Opcode.SCHEMA: [self._schemas[channel.id] for channel in channels],
            Opcode.CHANNEL: channels,
            Opcode.STATISTICS: [statistics],
            Opcode.CHUNK_INDEX: self._chunks,
        }
        summary, offsets = RecordBuilder(), RecordBuilder()
        for opcode, records in groups.items():
            first = summary.count
            for record in records:
                record.write(summary)
            SummaryOffset(opcode, start + first, summary.count - first).write(offsets)
        offsets_at = start + summary.count
        content = summary.end() + offsets.end()
        head = _bytes_of(Footer(start, offsets_at, 0))[:-4]
        checksum = isal_zlib.crc32(head, isal_zlib.crc32(content))
        self._write(content + head + checksum.to_bytes(4, "little") + MAGIC)

    def _write(self, data: bytes) -> None:
        self._sink.write(data)
        self._at += len(data)


def _bytes_of(record: McapRecord) -> bytes:
    built = RecordBuilder()
    record.write(built)
    return bytes(built.end())


_SECOND = 10**9
_BLOCK = 8192  # frames of a track in memory at a time
_TIME = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}
_ACTION_SCHEMA: dict[str, Any] = {
    "title": "liex_lab.ActionState",
    "description": "The action that begins now; an empty word ends the last one.",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "action": {"type": "string"},
        "index": {
            "type": "integer",
            "description": "place of the word in the vocabulary, -1 for none",
        },
        "frame_index": {"type": "integer"},
    },
}
_ERROR_SCHEMA: dict[str, Any] = {
    "title": "liex_lab.PredictedError",
    "description": "The joint error to be expected in a frame with a pose, mean over the joints.",
    "type": "object",
    "properties": {"timestamp": _TIME, "predicted_error_mm": {"type": "number"}},
}
_DEPTH = "/camera/depth"
_PROTOBUF: dict[str, Any] = {
    "/camera/calibration": messages.CameraCalibration,
    "/tf": messages.FrameTransforms,
    _DEPTH: messages.RawImage,
    "/skeleton/scene": messages.SceneUpdate,
    "/skeleton/joints": messages.PosesInFrame,
    "/camera/skeleton": messages.ImageAnnotations,
    "/log": messages.Log,
}
_TOGETHER_SCHEMA: dict[str, Any] = {
    "title": "liex_lab.InteractionState",
    "description": "What one animal does to another from now on; empty for nothing.",
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        **{name: {"type": "string"} for name in ("agent", "target", "interactions")},
    },
}
_JSON = {
    "/predicted_error": _ERROR_SCHEMA,
    "/actions": _ACTION_SCHEMA,
    "/interactions": _TOGETHER_SCHEMA,
}
_TYPES = {
    topic: (schema.name, schema.encoding, schema.data, "protobuf")
    for topic, kind in _PROTOBUF.items()
    if (schema := kind.get_schema())
} | {
    topic: (schema["title"], "jsonschema", json.dumps(schema).encode(), "json")
    for topic, schema in _JSON.items()
}
_BONE = messages.Color(r=1.0, g=1.0, b=1.0, a=1.0)
_JOINT = messages.Color(r=1.0, g=0.31, b=0.24, a=1.0)
# an animal in a frame: entity id, joints in m and px, whether it has a pose, and its colours
_Body = tuple[str, Array, Array, bool, messages.Color, messages.Color]


def _colour(number: int) -> messages.Color:
    """0xRRGGBB as a colour."""
    r, g, b = (part / 255.0 for part in number.to_bytes(3, "big"))
    return messages.Color(r=r, g=g, b=b, a=1.0)


def _packing_of(origin: Provenance) -> dict[str, int]:
    """Settings of `McapLog` for whole images, one per chunk, or for images with cut-outs.

    The latter repeat the still scene of the previous image; short repetitions would split it.
    """
    if origin.background is None:
        return {"level": 3, "chunk_size": 128 * 1024}
    size = 2 * origin.camera.width * origin.camera.height
    window = 2 * size + size // 2
    return {"level": 1, "chunk_size": 32 * 1024 * 1024, "repetition": 256, "window": window}


class McapWriter:
    """Writer of `session.mcap`.

    Call `add` for the depth of consecutive frames, then `finish` once, or `abandon`.
    """

    def __init__(
        self,
        path: Path,
        origin: Provenance,
        *,
        level: int | None = None,
        chunk_size: int | None = None,
        resume: bool = False,
    ) -> None:
        """Open the file.

        Args:
            path: the file to write.
            origin: camera, its position and the skeleton.
            level: Zstandard compression level, 0 for the default, 22 for the smallest file; None
                chooses by the kept images.
            chunk_size: bytes packed at once; None as for level.
            resume: append to a file that ends after `flushed`.
        """
        given = {"level": level, "chunk_size": chunk_size}
        chosen = {name: value for name, value in given.items() if value is not None}
        self._path = path
        self._origin = origin
        self._dot_m = dot_mm(origin.skeleton) / 1000.0
        self._file = path.open("a+b" if resume else "wb")
        self._log = McapLog(
            self._file,
            _TYPES,
            library=f"liex_lab {package_version('liex_lab')}",
            resume=resume,
            **{**_packing_of(origin), **chosen},
        )
        self._calibrated_ns: int | None = None
        self._bone, self._joint = _BONE, _JOINT

    def _log_message(self, topic: str, time_ns: int, message: Any) -> None:
        self._log.log(topic, [message.encode()], time_ns)

    def _log_json(self, topic: str, time_ns: int, content: dict[str, Any]) -> None:
        sec, nsec = divmod(time_ns, _SECOND)
        stamped = {"timestamp": {"sec": sec, "nsec": nsec}, **content}
        self._log.log(topic, [json.dumps(stamped).encode()], time_ns)

    def add(self, times_ns: Sequence[int], depth: Sequence[NDArray[np.uint16]]) -> None:
        """Write the depth of consecutive frames, and the calibration about once a second.

        Args:
            times_ns: times of the n frames, ns.
            depth: n images (H, W) uint16 mm, 0 where unread; empty if depth is not kept.

        Raises:
            OSError: a write failed.
        """
        with _naming(self._path):
            for time_ns, image in zip_longest(map(int, times_ns), depth):
                if self._calibrated_ns is None or time_ns - self._calibrated_ns >= _SECOND:
                    self._log_camera(time_ns)
                if image is not None:
                    self._log.log(_DEPTH, _raw_image(time_ns, image), time_ns)

    def finish(
        self,
        rows: Rows,
        bouts: pd.DataFrame,
        words: Sequence[str],
        problems: Sequence[str],
        together: Interactions | None = None,
    ) -> None:
        """Write skeleton, transforms, actions and notes of the whole track, and close the file.

        Args:
            rows: the track in the form of the tables.
            bouts: the table `bouts`.
            words: the ethogram's vocabulary; a word's position is its index in the messages.
            problems: sentences about the recording, logged as warnings at the first frame.
            together: the interactions with other animals of the arena, which are shown with them;
                None if it is alone.

        Raises:
            OSError: a write failed.
        """
        track = rows.track
        colour, others = in_replay(self._origin, together)
        if colour is not None:
            self._bone = self._joint = _colour(colour)
        with _naming(self._path):
            for part in blocks(track.n_frames, _BLOCK):
                self._log_track(track[part], others, part)
            self._log_actions(rows, bouts, words)
            if together is not None:
                self._log_together(rows, together)
            for problem in problems if len(track.times_ns) else ():
                first_ns = int(track.times_ns[0])
                note = messages.Log(
                    timestamp=_stamp(first_ns),
                    level=messages.LogLevel.Warning,
                    message=problem,
                    name="liex_lab",
                )
                self._log_message("/log", first_ns, note)
        self.abandon()

    def _log_track(self, track: Track, others: Sequence[OtherAnimal], part: slice) -> None:
        """Skeletons and transforms of some frames, of others those of the rows `part`."""
        posed = track.posed
        placed = [(one, one.joints_mm[part], one.uv_px(part)) for one in others]
        quaternions = so3.quaternion(np.where(posed[:, None, None], track.root_rotation, np.eye(3)))
        for i, time_ns in enumerate(track.times_ns.tolist()):
            joints_m = track.joints_mm[i] / 1000.0
            found = bool(posed[i])
            bodies: list[_Body] = [
                ("skeleton", joints_m, track.uv_px[i], found, self._bone, self._joint)
            ]
            for one, own, uv in placed:
                there, colour = bool(np.isfinite(own[i]).all()), _colour(one.colour)
                name = f"skeleton of {one.name}"
                bodies.append((name, own[i] / 1000.0, uv[i], there, colour, colour))
            scene = self._scene_update(time_ns, bodies)
            self._log_message("/skeleton/scene", time_ns, scene)
            joints = messages.PosesInFrame(
                timestamp=_stamp(time_ns),
                frame_id="arena",
                poses=[_place(*xyz) for xyz in joints_m.tolist()] if found else [],
            )
            self._log_message("/skeleton/joints", time_ns, joints)
            overlay = self._annotations(time_ns, bodies)
            self._log_message("/camera/skeleton", time_ns, overlay)
            if found:
                root = _transform(time_ns, "root", track.root_mm[i], quaternions[i])
                self._log_message("/tf", time_ns, root)
            error_mm = float(track.predicted_error_mm[i])
            if np.isfinite(error_mm):
                self._log_json("/predicted_error", time_ns, {"predicted_error_mm": error_mm})

    def flushed(self) -> int:
        """Pass everything to the operating system; returns the file's bytes.

        Raises:
            OSError: a write failed.
        """
        with _naming(self._path):
            self._log.flush()
            self._file.flush()
        return self._file.tell()

    def abandon(self) -> None:
        """Close the file, whole or not.

        Raises:
            OSError: a write failed.
        """
        with _naming(self._path), closing(self._file):
            self._log.close()

    def _log_camera(self, time_ns: int) -> None:
        """Write calibration and camera pose, about once a second: a viewer may start anywhere."""
        camera = self._origin.camera
        place = self._origin.T_arena_camera
        self._calibrated_ns = time_ns
        k = camera.matrix
        calibration = messages.CameraCalibration(
            timestamp=_stamp(time_ns),
            frame_id="camera",
            width=camera.width,
            height=camera.height,
            K=k.ravel().tolist(),
            R=np.eye(3).ravel().tolist(),
            P=np.hstack([k, np.zeros((3, 1))]).ravel().tolist(),
        )
        self._log_message("/camera/calibration", time_ns, calibration)
        turn = so3.quaternion(place.rotation)
        self._log_message("/tf", time_ns, _transform(time_ns, "camera", place.translation, turn))

    def _scene_update(self, time_ns: int, bodies: Sequence[_Body]) -> messages.SceneUpdate:
        """Bones as lines and joints as spheres; an entity id per animal, deleted without a pose."""
        stamp = _stamp(time_ns)
        across = 2.0 * self._dot_m
        size = messages.Vector3(x=across, y=across, z=across)
        entities, gone = [], []
        for name, joints_m, _, found, bone, joint in bodies:
            if not found:
                kind = messages.SceneEntityDeletionType.MatchingId
                gone.append(messages.SceneEntityDeletion(timestamp=stamp, type=kind, id=name))
                continue
            points = [messages.Point3(x=x, y=y, z=z) for x, y, z in joints_m.tolist()]
            lines = messages.LinePrimitive(
                type=messages.LinePrimitiveLineType.LineList,
                pose=_place(0.0, 0.0, 0.0),
                thickness=0.7 * self._dot_m,
                points=[points[end] for edge in self._origin.skeleton.edges for end in edge],
                color=bone,
            )
            spheres = [
                messages.SpherePrimitive(pose=_place(*xyz), size=size, color=joint)
                for xyz in joints_m.tolist()
            ]
            entities.append(
                messages.SceneEntity(
                    timestamp=stamp,
                    frame_id="arena",
                    id=name,
                    lifetime=messages.Duration(sec=0, nsec=0),
                    lines=[lines],
                    spheres=spheres,
                )
            )
        return messages.SceneUpdate(entities=entities, deletions=gone)

    def _annotations(self, time_ns: int, bodies: Sequence[_Body]) -> messages.ImageAnnotations:
        """The skeletons over the depth image."""
        drawn = []
        for _, _, uv, found, _, joint in bodies:
            at = [messages.Point2(x=u, y=v) for u, v in uv.tolist()]
            if found:
                drawn.append(
                    messages.PointsAnnotation(
                        timestamp=_stamp(time_ns),
                        type=messages.PointsAnnotationType.LineList,
                        points=[at[end] for edge in self._origin.skeleton.edges for end in edge],
                        outline_color=joint,
                        thickness=1.5,
                    )
                )
        return messages.ImageAnnotations(points=drawn)

    def _log_together(self, rows: Rows, together: Interactions) -> None:
        """One message per change of what an agent does to a target; empty where it ends."""
        first = int(rows.track.times_ns[0])
        for (agent, target), spans in together.states().items():
            changes = {stop_s: "" for _, _, _, stop_s, _ in spans}
            changes |= {start_s: words for _, _, start_s, _, words in spans}
            for at_s, words in sorted(changes.items()):
                state = {"agent": agent, "target": target, "interactions": words}
                self._log_json("/interactions", first + round(at_s * 1e9), state)

    def _log_actions(self, rows: Rows, bouts: pd.DataFrame, words: Sequence[str]) -> None:
        """One message per change, at the time of its frame."""
        changes: dict[int, str] = {}
        for start_s, stop_s, action in zip(
            bouts["start_s"], bouts["stop_s"], bouts["action"], strict=True
        ):
            changes[round(start_s * 1e9)] = str(action)
            changes.setdefault(round(stop_s * 1e9), "")
        first = int(rows.track.times_ns[0]) if rows.track.n_frames else 0
        elapsed = rows.track.times_ns - first
        for at, action in sorted(changes.items()):
            row = min(int(np.searchsorted(elapsed, at)), len(elapsed) - 1)
            state = {
                "action": action,
                "index": list(words).index(action) if action else -1,
                "frame_index": int(rows.frame_index[row]),
            }
            self._log_json("/actions", first + at, state)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Add the file's name, missing in errors of writing, to OSErrors within the block."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(path)
        raise


def _place(x: float, y: float, z: float) -> messages.Pose:
    return messages.Pose(
        position=messages.Vector3(x=x, y=y, z=z),
        orientation=messages.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
    )


def _transform(
    time_ns: int, child: str, translation_mm: Array, wxyz: Array
) -> messages.FrameTransforms:
    """The transform from a frame to the arena frame."""
    x, y, z = (translation_mm / 1000.0).tolist()
    qw, qx, qy, qz = wxyz.tolist()
    transform = messages.FrameTransform(
        timestamp=_stamp(time_ns),
        parent_frame_id="arena",
        child_frame_id=child,
        translation=messages.Vector3(x=x, y=y, z=z),
        rotation=messages.Quaternion(x=qx, y=qy, z=qz, w=qw),
    )
    return messages.FrameTransforms(transforms=[transform])


def _raw_image(time_ns: int | np.int64, image: NDArray[np.uint16]) -> list[bytes | memoryview]:
    """A depth image as a `RawImage`, in parts, without a copy of the pixels.

    Protobuf's fields are in order of their numbers, and only the frame id follows the pixels.
    """
    height, width = image.shape
    pixels = np.ascontiguousarray(image, "<u2")
    varint = bytearray()  # the number of bytes, seven bits per byte, lowest first
    left = pixels.nbytes
    while left > 127:
        varint.append(left & 127 | 128)
        left >>= 7
    varint.append(left)
    before = messages.RawImage(
        timestamp=_stamp(time_ns), encoding="16UC1", width=width, height=height, step=2 * width
    )
    return [
        # tag of the pixels' field of RawImage: number 6, bytes
        before.encode() + b"\x32" + bytes(varint),
        pixels.reshape(-1).view(np.uint8).data,
        messages.RawImage(frame_id="camera").encode(),
    ]


def _stamp(time_ns: int | np.int64) -> Any:
    return messages.Timestamp(sec=int(time_ns) // _SECOND, nsec=int(time_ns) % _SECOND)
