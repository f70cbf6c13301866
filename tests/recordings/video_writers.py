"""Depth videos as MoSeq's and Azure's programs leave them. Every writer returns the path it
wrote.
"""

import json
import struct
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from tests.recordings.writers import Frames, write_camera, write_moseq_folder

FACTORY = (
    0.5122697949409485,
    0.49451231956481934,
    0.4921168386936188,
    0.4921667277812958,
)  # cx cy fx fy of one camera
UNKNOWN_SIZE = b"\x01" + b"\xff" * 7


def write_avi(
    path: Path,
    frames: Frames,
    fps: int = 30,
    gop: int = 12,
    pixels: str = "gray16le",
    level: int = 3,
    titles: Sequence[str] = ("DEPTH",),
) -> Path:
    """FFV1 in AVI, one key image in `gop`; level 3 has check sums and level 1 none. Streams other
    than DEPTH hold half its values.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        streams = {title: container.add_stream("ffv1", rate=fps) for title in titles}
        for title, stream in streams.items():
            stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], pixels
            stream.time_base, stream.gop_size = Fraction(1, fps), gop
            stream.options = {"level": str(level), "slicecrc": str(int(level == 3))}
            stream.metadata["title"] = title
        for k, stored in enumerate(frames):
            for title, stream in streams.items():
                values = stored if title == "DEPTH" else stored // 2
                frame = av.VideoFrame.from_ndarray(values, format=pixels)
                frame.pts = k
                container.mux(stream.encode(frame))
        for stream in streams.values():
            container.mux(stream.encode())
    return path


def write_video_session(
    folder: Path, frames: Frames, video: str = "depth.avi", **how: object
) -> Path:
    """A MoSeq session whose depth is a video: depth.avi (FFV1) or depth.mkv (raw), stamps,
    metadata, camera.toml.
    """
    write_moseq_folder(folder, frames)
    (folder / "depth.dat").unlink()
    write_camera(folder)
    if video.endswith(".avi"):
        write_avi(folder / video, frames, **how)  # type: ignore[arg-type]
    else:
        write_mkv(folder / video, frames, **how)  # type: ignore[arg-type]
    return folder


def even_ms(n: int) -> list[int]:
    """Stamps as Azure's recorder has them: whole milliseconds, 30 frames/s."""
    return [round(k * 100 / 3) for k in range(n)]


def write_mkv(
    path: Path,
    frames: Frames,
    times_ms: Sequence[int] | None = None,
    *,
    titles: Sequence[str] = ("COLOR", "DEPTH", "IR"),
    tags: Mapping[str, str] | None = None,
    attachments: Mapping[str, bytes] | None = None,
    date_ns: int | None = None,
    live: bool = False,
    groups: bool = False,
) -> Path:
    """Matroska as Azure's recorder writes it: 16-bit big endian images without compression,
    tagged `b16g`.

    The tracks other than DEPTH hold half its values. live: segment and clusters of open size, as
    after a crash; groups: images in block groups instead of simple blocks; date_ns: since
    2001-01-01.
    """
    times = even_ms(len(frames)) if times_ms is None else times_ms
    height, width = frames.shape[1:]
    info = [_number(0x2AD7B1, 1_000_000), _text(0x4D80, "t"), _text(0x5741, "t")]
    info += [] if date_ns is None else [element(0x4461, date_ns.to_bytes(8, "big", signed=True))]
    attached = [
        element(
            0x61A7,
            _text(0x466E, name)
            + _text(0x4660, "application/json")
            + _number(0x46AE, 7)
            + element(0x465C, data),
        )
        for name, data in (attachments or {}).items()
    ]
    tagged = [
        element(0x7373, element(0x63C0, b"") + element(0x67C8, _text(0x45A3, k) + _text(0x4487, v)))
        for k, v in (tags or {}).items()
    ]
    body = [
        element(0x1549A966, b"".join(info)),
        element(
            0x1654AE6B,
            b"".join(_track(k + 1, title, width, height) for k, title in enumerate(titles)),
        ),
        element(0x1941A469, b"".join(attached)) if attached else b"",
        element(0x1254C367, b"".join(tagged)) if tagged else b"",
    ]
    for start in range(0, len(frames), 4):
        blocks = [_number(0xE7, times[start])]
        for k in range(start, min(start + 4, len(frames))):
            blocks += [
                _block(n + 1, title, frames[k], times[k] - times[start], groups)
                for n, title in enumerate(titles)
            ]
        body.append(element(0x1F43B675, b"".join(blocks), open_size=live))
    head = _text(0x4282, "matroska") + _number(0x4287, 4) + _number(0x4285, 2)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(
        element(0x1A45DFA3, head) + element(0x18538067, b"".join(body), open_size=live)
    )
    return path


def element(id: int, data: bytes, open_size: bool = False) -> bytes:
    """One element of Matroska: id, size in eight bytes, data."""
    size = UNKNOWN_SIZE if open_size else (len(data) | 1 << 56).to_bytes(8, "big")
    return id.to_bytes((id.bit_length() + 7) // 8, "big") + size + data


def _number(id: int, value: int) -> bytes:
    return element(id, value.to_bytes(8, "big"))


def _text(id: int, value: str) -> bytes:
    return element(id, value.encode())


def _track(number: int, title: str, width: int, height: int) -> bytes:
    bitmap = struct.pack(
        "<IiiHH4s5I", 40, width, height, 1, 16, b"b16g", width * height * 2, 0, 0, 0, 0
    )
    facts = (
        _number(0xD7, number) + _number(0x73C5, number) + _number(0x83, 1) + _text(0x536E, title)
    )
    video = element(0xE0, _number(0xB0, width) + _number(0xBA, height))
    return element(0xAE, facts + _text(0x86, "V_MS/VFW/FOURCC") + element(0x63A2, bitmap) + video)


def _block(number: int, title: str, frame: np.ndarray, ticks: int, group: bool) -> bytes:
    stored = (frame if title == "DEPTH" else frame // 2).astype(">u2").tobytes()
    data = bytes([0x80 | number]) + struct.pack(">hB", ticks, 0 if group else 0x80) + stored
    return element(0xA0, element(0xA1, data) + _number(0x9B, 33)) if group else element(0xA3, data)


def factory_calibration(distortion: Sequence[float] = (0.0,) * 8) -> bytes:
    """The JSON that Azure's recorder attaches. distortion: k1 k2 p1 p2 k3 k4 k5 k6."""
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion
    depth = {
        "Intrinsics": {
            "ModelParameterCount": 14,
            "ModelParameters": [*FACTORY, k1, k2, k3, k4, k5, k6, 0, 0, p2, p1],
            "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
        },
        "Location": "CALIBRATION_CameraLocationD0",
        "Purpose": "CALIBRATION_CameraPurposeDepth",
        "SensorHeight": 1024,
        "SensorWidth": 1024,
    }
    colour = {
        "Location": "CALIBRATION_CameraLocationPV0",
        "Purpose": "CALIBRATION_CameraPurposePhotoVideo",
    }
    return json.dumps({"CalibrationInformation": {"Cameras": [colour, depth]}}).encode() + b"\0"
