"""Writers of recordings, frame by frame: their interface, and folders of 16-bit PNG images.

Use a writer in a `with` block: the end of the file is written when the block ends without an error.
Its `notes` then report what a reader of the file should know. Depth is stored in whole steps of
`step_mm`, either exactly or rounded to the nearest step.
"""

import json
import struct
from abc import ABC, abstractmethod
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import KANNALA_BRANDT, Camera
from liex_lab.recordings.camera_file import CAMERA_FILE
from liex_lab.recordings.depth_kernels import rvl_message
from liex_lab.recordings.formats.messages.mcap import NOTES
from liex_lab.recordings.frame import (
    LARGEST_STEP,
    Depth,
    DepthFrame,
    metres,
    nearest_steps,
    whole_steps,
)

STAMPS = "timestamps.csv"
_FACTS = ("subject_id", "session_start_time")  # the metadata that a camera.toml can state


class RecordingWriter(ABC):
    """Interface of a writer for the frames of a recording, in order of time.

    Attributes:
        path: the file or folder to write; it must not exist.
        camera: the camera of the frames.
        notes: sentences about what the format could not store, complete after `finish`.
    """

    def __init__(self, path: Path, camera: Camera) -> None:
        """Keep the path and the camera; nothing is written."""
        self.path = path
        self.camera = camera
        self.notes: list[str] = []

    @abstractmethod
    def add(self, frame: DepthFrame) -> None:
        """Append the next frame; its time must not precede that of the last one."""

    @abstractmethod
    def finish(self) -> None:
        """Write the end of the file."""

    def release(self) -> None:  # noqa: B027 (a folder holds no file open)
        """Close open files, whether the recording is whole or not."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self.finish()
        finally:
            self.release()


class ImageFolderWriter(RecordingWriter):
    """Writer of a folder of 16-bit PNG images, with a camera.toml and a timestamps.csv.

    One image per frame; the stamps are in nanoseconds.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera,
        *,
        step_mm: float = 1.0,
        exact: bool = True,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        """Create the folder.

        Args:
            path: the folder, which must not exist.
            camera: the camera of the frames, for camera.toml.
            step_mm: mm of a stored step.
            exact: refuse depths between steps instead of rounding them.
            metadata: facts of the recording; only subject_id and session_start_time are stored.
        """
        super().__init__(path, camera)
        self._step_mm = step_mm
        self._exact = exact
        self._facts = {key: str(value) for key, value in (metadata or {}).items() if key in _FACTS}
        self._times: list[int] = []
        path.mkdir()

    def add(self, frame: DepthFrame) -> None:
        """Write one image; its stamp is written by `finish`.

        Args:
            frame: the frame, depth (H, W) float32 mm.

        Raises:
            RecordingError: its depth does not fit into 16 bits, or (exact) lies between steps.
        """
        steps = steps_of(frame, self._step_mm, self._exact)
        (self.path / f"frame_{len(self._times):06d}.png").write_bytes(png_of(steps))
        self._times.append(frame.time_ns)

    def finish(self) -> None:
        """Write camera.toml and timestamps.csv."""
        camera = self.camera
        numbers = {
            name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")
        }
        facts: dict[str, Any] = numbers | {"unit_mm": self._step_mm} | self._facts
        if camera.distortion is not None:
            facts |= {
                "distortion": camera.distortion.coefficients,
                "distortion_model": camera.distortion.model,
            }
        lines = [f"# intrinsics: {' '.join(camera.source.split())}", "[camera]"]
        lines += [f"{key} = {json.dumps(value)}" for key, value in facts.items()]
        (self.path / CAMERA_FILE).write_text("\n".join([*lines, ""]), encoding="utf-8")
        (self.path / STAMPS).write_text(
            "\n".join(["time_ns", *map(str, self._times), ""]), encoding="utf-8"
        )
        if not self._exact:
            self.notes.append(f"depth was rounded to whole steps of {self._step_mm:g} mm")


def steps_of(frame: DepthFrame, step_mm: float, exact: bool) -> NDArray[np.uint16]:
    """Convert depth of a frame to 16-bit steps.

    Args:
        frame: the frame, depth (H, W) float32 mm.
        step_mm: mm of a step.
        exact: refuse depths between steps instead of rounding them.

    Returns:
        (H, W) uint16 steps, 0 where unread.

    Raises:
        RecordingError: a depth is beyond 65535 steps, or (exact) between two of them.
    """
    depth: Depth = frame.depth
    steps = whole_steps(depth, step_mm) if exact else nearest_steps(depth, step_mm)
    if steps is not None:
        return steps
    if float(depth.max()) > LARGEST_STEP * step_mm:
        raise RecordingError(
            f"frame {frame.index} holds depths up to {depth.max():.0f} mm, and 16 bits in steps of "
            f"{step_mm:g} mm hold up to {LARGEST_STEP * step_mm:.0f} mm; write an .mcap file, or "
            "choose a larger step with --step-mm"
        )
    raise RecordingError(
        f"frame {frame.index} holds depths between whole steps of {step_mm:g} mm, which 16 bits do "
        "not keep; write an unpacked .mcap file, which does, or let the depths be rounded with "
        "--step-mm 0.1"
    )


def png_of(steps: NDArray[np.uint16]) -> bytes:
    """Encode a depth image (H, W) uint16 as the bytes of a 16-bit grey PNG file."""
    import cv2

    good, packed = cv2.imencode(".png", steps)
    assert good
    return bytes(packed.tobytes())


# Writer of depth as MCAP: zstd chunks, stamps in ns, the calibration along with the images.


FRAME_ID = "camera"
_SECOND = 10**9


def _matrices(camera: Camera) -> list[list[float]]:
    """K (3, 3), R (3, 3) and P (3, 4), row by row."""
    k = camera.matrix
    return [m.ravel().tolist() for m in (k, np.eye(3), np.hstack([k, np.zeros((3, 1))]))]


def _distortion(camera: Camera) -> tuple[str, list[float]]:
    """ROS's name of the distortion model, and its coefficients; Foxglove uses the same."""
    bent = camera.distortion
    if bent is None:
        return "plumb_bob", [0.0] * 5
    values = list(bent.coefficients)
    if bent.model == KANNALA_BRANDT:
        return "equidistant", values
    return ("rational_polynomial", values) if any(values[5:]) else ("plumb_bob", values[:5])


class FoxgloveMessages:
    """foxglove.RawImage, CompressedImage and CameraCalibration, in protobuf.

    Attributes:
        profile: of the MCAP file.
        encoding: of the messages.
        schema_encoding: of their definitions.
        schemas: name and definition of a raw image, a packed image, and the calibration.
    """

    profile = ""
    encoding = schema_encoding = "protobuf"

    def __init__(self) -> None:
        from foxglove import messages
        from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
        from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
        from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

        self._types = (RawImage, CompressedImage, CameraCalibration)
        # the SDK states their definitions, but takes no stamp before 1970
        stated = (messages.RawImage, messages.CompressedImage, messages.CameraCalibration)
        self.schemas = [(schema.name, schema.data) for schema in (m.get_schema() for m in stated)]

    def _message(self, kind: int, time_ns: int, **fields: Any) -> bytes:
        message = self._types[kind](frame_id=FRAME_ID, **fields)
        message.timestamp.seconds, message.timestamp.nanos = divmod(time_ns, _SECOND)
        return bytes(message.SerializeToString())

    def raw_image(self, time_ns: int, size: tuple[int, int], encoding: str, data: bytes) -> bytes:
        """foxglove.RawImage of unpacked pixels, "16UC1" or "32FC1", row by row without padding."""
        width, height = size
        facts = {"width": width, "height": height, "step": len(data) // height}
        return self._message(0, time_ns, encoding=encoding, data=data, **facts)

    def packed_image(self, time_ns: int, png: bytes) -> bytes:
        """foxglove.CompressedImage of a 16-bit PNG."""
        return self._message(1, time_ns, format="png", data=png)

    def calibration(self, time_ns: int, camera: Camera) -> bytes:
        """foxglove.CameraCalibration, with the distortion in ROS's terms."""
        k, r, p = _matrices(camera)
        model, d = _distortion(camera)
        size = {"width": camera.width, "height": camera.height}
        return self._message(2, time_ns, distortion_model=model, D=d, K=k, R=r, P=p, **size)


_PART = "=" * 80 + "\nMSG: "
_HEADER = (
    f"{_PART}std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{_PART}builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
_ROS_SCHEMAS = {
    "sensor_msgs/msg/Image": f"""\
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
{_HEADER}""",
    "sensor_msgs/msg/CompressedImage": f"""\
std_msgs/Header header
string format
uint8[] data
{_HEADER}""",
    "sensor_msgs/msg/CameraInfo": f"""\
std_msgs/Header header
uint32 height
uint32 width
string distortion_model
float64[] d
float64[9] k
float64[9] r
float64[12] p
uint32 binning_x
uint32 binning_y
sensor_msgs/RegionOfInterest roi
{_HEADER}{_PART}sensor_msgs/RegionOfInterest
uint32 x_offset
uint32 y_offset
uint32 height
uint32 width
bool do_rectify
""",
}


class RosMessages:
    """sensor_msgs/msg/Image, CompressedImage and CameraInfo of ROS 2, in CDR.

    Each raises a RecordingError if the time is beyond 2038. For the attributes see
    `FoxgloveMessages`.
    """

    profile = "ros2"
    encoding = "cdr"
    schema_encoding = "ros2msg"
    schemas = tuple((name, text.encode()) for name, text in _ROS_SCHEMAS.items())

    def raw_image(self, time_ns: int, size: tuple[int, int], encoding: str, data: bytes) -> bytes:
        """sensor_msgs/msg/Image of unpacked pixels, "16UC1" or "32FC1", rows without padding."""
        width, height = size
        head = _Cdr(time_ns).numbers("I", height, width).text(encoding).numbers("B", 0)
        return bytes(head.numbers("I", len(data) // height, len(data)).content) + data

    def packed_image(self, time_ns: int, data: bytes, how: str = "16UC1; png compressed ") -> bytes:
        """sensor_msgs/msg/CompressedImage of a 16-bit PNG, or of an image packed otherwise."""
        return bytes(_Cdr(time_ns).text(how).numbers("I", len(data)).content) + data

    def calibration(self, time_ns: int, camera: Camera) -> bytes:
        """sensor_msgs/msg/CameraInfo, with the distortion in ROS's terms."""
        model, d = _distortion(camera)
        out = _Cdr(time_ns).numbers("I", camera.height, camera.width).text(model)
        out.numbers("I", len(d)).numbers("d", *d, *chain.from_iterable(_matrices(camera)))
        out.numbers("I", 0, 0, 0, 0, 0, 0).numbers("B", 0)  # not binned, the whole image
        return bytes(out.content)


class _Cdr:
    """CDR, ROS 2's layout: little endian, each number at a multiple of its size.

    Positions count from after the first four bytes. It begins with a std_msgs/Header.
    """

    def __init__(self, time_ns: int) -> None:
        self.content = bytearray(b"\x00\x01\x00\x00")
        seconds, nanoseconds = divmod(time_ns, _SECOND)
        if not -(2**31) <= seconds < 2**31:
            raise RecordingError(
                f"a time of {seconds} s does not fit into ROS's messages, which end in 2038; write "
                "it without --ros"
            )
        self.content += struct.pack("<iI", seconds, nanoseconds)
        self.text(FRAME_ID)

    def numbers(self, kind: str, *values: float) -> Self:
        """Append numbers of a type, named as in `struct`."""
        self.content += bytes((4 - len(self.content)) % struct.calcsize(kind))
        self.content += struct.pack(f"<{len(values)}{kind}", *values)
        return self

    def text(self, text: str) -> Self:
        """Append a string, preceded by its length and followed by a zero."""
        raw = text.encode() + b"\x00"
        self.numbers("I", len(raw)).content += raw
        return self


_CHUNK_BYTES = 128 * 1024  # an image closes its chunk, so that reading one frame unpacks one frame


class McapDepthWriter(RecordingWriter):
    """Writer of one depth topic and its calibration topic.

    Whole millimetres are 16UC1; from the first other frame on, depth is 32FC1 in metres. It uses
    the `mcap` library's writer: Foxglove's does not report a full disk.
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
            packing: "raw", "png" or (ROS only) "rvl", of an image within its chunk.
            step_mm: mm of a stored step, for "png" and "rvl".
            metadata: facts of the recording, stored as text in a metadata record.
        """
        super().__init__(path, camera)
        self._packing = packing
        self._step_mm = step_mm
        self._float = False
        self._n_off = 0
        self._calibrated_ns: int | None = None
        self._messages = RosMessages() if messages == "ros" else FoxgloveMessages()
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=_CHUNK_BYTES)
        self._writer.start(self._messages.profile, "liex_lab")
        facts = {key: str(value) for key, value in (metadata or {}).items()}
        self._writer.add_metadata(NOTES, facts | {"camera_source": camera.source})
        raw, packed, lens = self._messages.schemas
        self._lens = self._channel(
            {"foxglove": "/camera/calibration", "ros": "/camera/camera_info"}[messages], *lens
        )
        self._depth = self._channel("/camera/depth", *(raw if packing == "raw" else packed))

    def _channel(self, topic: str, name: str, definition: bytes) -> int:
        number = self._writer.register_schema(name, self._messages.schema_encoding, definition)
        return self._writer.register_channel(topic, self._messages.encoding, number)

    def add(self, frame: DepthFrame) -> None:
        """Write an image, and about once a second the calibration.

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
        self._log(self._depth, self._image(frame), time_ns)

    def _log(self, channel: int, message: bytes, time_ns: int) -> None:
        logged_ns = max(0, time_ns)  # the time of logging is unsigned; the stamp is authoritative
        self._writer.add_message(channel, logged_ns, message, logged_ns)

    def _image(self, frame: DepthFrame) -> bytes:
        if self._packing != "raw":
            exact = steps_of(frame, self._step_mm, exact=True)
            if self._packing == "rvl" and isinstance(self._messages, RosMessages):
                rvl, how = rvl_message(exact).tobytes(), "16UC1; compressedDepth rvl"
                return self._messages.packed_image(frame.time_ns, rvl, how)
            return self._messages.packed_image(frame.time_ns, png_of(exact))
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
        return self._messages.raw_image(frame.time_ns, size, encoding, data)

    def note(self, facts: Mapping[str, str]) -> None:
        """Write facts (texts by name) known only after all frames, as a metadata record."""
        self._writer.add_metadata(NOTES, dict(facts))

    def finish(self) -> None:
        """Write the index, and note the unit of the stored depth."""
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
