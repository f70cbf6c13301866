"""Writer of depth as MCAP: zstd chunks, stamps in ns, the calibration beside the pictures.

Every picture closes its chunk (128 KiB), so that one frame is unpacked to read one frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from mcap.writer import Writer

from liex_lab.optics.camera import Camera
from liex_lab.recordings.depth_units import metres, whole_steps
from liex_lab.recordings.formats.messages.mcap import NOTES
from liex_lab.recordings.formats.messages.mcap_encoding import (
    FoxgloveMessages,
    Messages,
    RosMessages,
    Schema,
)
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.rvl import rvl_message
from liex_lab.recordings.writer import RecordingWriter, png_of, steps_of

DEPTH_TOPIC = "/camera/depth"
CALIBRATION_TOPICS = {"foxglove": "/camera/calibration", "ros": "/camera/camera_info"}
_SECOND = 10**9
_CHUNK_BYTES = (
    128 * 1024
)  # a picture closes its chunk, so that one frame is unpacked to read one frame


class McapDepthWriter(RecordingWriter):
    """Writer of one depth topic and its calibration topic.

    Whole millimetres are 16UC1; from the first frame on that is something else, depth is 32FC1 in
    metres. It uses `mcap`'s own writer: Foxglove's goes on without a word when the disk is full.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera,
        *,
        messages: Literal["foxglove", "ros"] = "foxglove",
        packing: Literal["raw", "png", "rvl"] = "raw",
        step_mm: float = 1.0,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        """Open the file and register schemas and channels.

        Args:
            path: the .mcap file.
            camera: the camera of the frames.
            messages: "foxglove" for Foxglove's schemas in protobuf, "ros" for ROS 2's.
            packing: "raw", "png", or of ROS's messages "rvl", of a picture within its chunk.
            step_mm: mm of a stored step, of "png" and "rvl".
            metadata: facts of the recording, kept as text in a metadata record.
        """
        super().__init__(path, camera)
        self._packing = packing
        self._step_mm = step_mm
        self._float = False
        self._n_off = 0
        self._calibrated_ns: int | None = None
        self._ros = RosMessages() if messages == "ros" else None
        self._messages: Messages = self._ros or FoxgloveMessages()
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES)
        self._writer.start(self._messages.profile, "liex_lab")
        facts = {key: str(value) for key, value in (metadata or {}).items()}
        self._writer.add_metadata(NOTES, facts | {"camera_source": camera.source})
        self._lens = self._channel(CALIBRATION_TOPICS[messages], self._messages.lens)
        self._depth = self._channel(
            DEPTH_TOPIC, self._messages.raw if packing == "raw" else self._messages.packed
        )

    def _channel(self, topic: str, schema: Schema) -> int:
        number = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        return self._writer.register_channel(topic, self._messages.encoding, number)

    def add(self, frame: DepthFrame) -> None:
        """Write a picture, and about once a second the calibration.

        The calibration is repeated so that a viewer may start anywhere.

        Args:
            frame: the frame, depth (H, W) float32 mm.

        Raises:
            RecordingError: (png, rvl) its depth is not in whole steps of 16 bits, or (ros) its time
                is beyond 2038.
        """
        time_ns = frame.time_ns
        if self._calibrated_ns is None or time_ns - self._calibrated_ns >= _SECOND:
            self._calibrated_ns = time_ns
            self._log(self._lens, self._messages.calibration(time_ns, self.camera), time_ns)
        self._log(self._depth, self._picture(frame), time_ns)

    def _log(self, channel: int, message: bytes, time_ns: int) -> None:
        logged_ns = max(0, time_ns)  # the time of logging has no sign; the stamp is what counts
        self._writer.add_message(channel, logged_ns, message, logged_ns)

    def _picture(self, frame: DepthFrame) -> bytes:
        if self._packing != "raw":
            exact = steps_of(frame, self._step_mm, exact=True)
            if self._packing == "rvl" and self._ros is not None:
                return self._ros.rvl_picture(frame.time_ns, rvl_message(exact).tobytes())
            return self._messages.packed_picture(frame.time_ns, png_of(exact))
        steps = None if self._float else whole_steps(frame.depth, 1.0)
        if steps is not None:
            data = steps.astype("<u2", copy=False).tobytes()
            encoding = "16UC1"
        else:
            self._float = True
            scaled, n_off = metres(frame.depth)
            self._n_off += n_off
            data = scaled.astype("<f4", copy=False).tobytes()
            encoding = "32FC1"
        size = self.camera.width, self.camera.height
        return self._messages.raw_picture(frame.time_ns, size, encoding, data)

    def note(self, facts: Mapping[str, str]) -> None:
        """Write facts that are known only when all frames were added, as a metadata record.

        Args:
            facts: texts by name.
        """
        self._writer.add_metadata(NOTES, dict(facts))

    def finish(self) -> None:
        """Write the index, and note in what unit depth was kept."""
        self._writer.finish()
        if self._float:
            self.notes.append("depth is not in whole millimetres and was written as 32-bit metres")
        if self._n_off:
            self.notes.append(
                f"{self._n_off} depths differ in the last of their 24 bits, which metres do not "
                "hold"
            )

    def release(self) -> None:
        """Close the file."""
        self._file.close()
