"""Recordings on disk, as cameras and other programs write them. Every writer returns the path to
open.
"""

import io
import itertools
import json
import math
import struct
import tarfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import foxglove
import numpy as np
import tifffile
from foxglove.channels import CameraCalibrationChannel, CompressedImageChannel, RawImageChannel
from foxglove.mcap import MCAPCompression, MCAPWriteOptions
from foxglove.messages import CameraCalibration, CompressedImage, RawImage, Timestamp
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera
from liex_lab.recordings import Recording
from tests.recordings.oni_files import Codec, depth_builder, plain_payload

Frames = NDArray[np.uint16]

SMALL = Camera(60.0, 61.0, 31.5, 23.5, 64, 48, source="stated")
STEP_NS = 33_333_333
START_NS = 1_760_000_000_123_456_789  # October 2025: stamps that a float64 of seconds cannot hold


def depth_frames(
    n: int, width: int = 64, height: int = 48, seed: int = 0, floor_mm: int = 700
) -> Frames:
    """(n, H, W) mm: a flat floor, noise, unread pixels, and a lump 30 mm high that walks along the
    row.
    """
    rng = np.random.default_rng(seed)
    frames = floor_mm + rng.integers(-1, 2, (n, height, width))
    for k in range(n):
        column = (k * 3) % (width - 10)
        frames[k, height // 2 - 3 : height // 2 + 3, column : column + 8] -= 30
    frames[rng.random(frames.shape) < 0.03] = 0
    return frames.astype(np.uint16)


def even_times(n: int, start_ns: int = START_NS, step_ns: int = STEP_NS) -> list[int]:
    """Evenly spaced stamps, ns."""
    return [start_ns + k * step_ns for k in range(n)]


def write_camera(folder: Path, camera: Camera = SMALL, **more: object) -> Path:
    """A camera.toml; `more` are further keys of [camera]."""
    facts = {
        name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")
    } | more
    lines = [f"{key} = {json.dumps(value)}" for key, value in facts.items()]
    path = folder / "camera.toml"
    path.write_text("\n".join(["[camera]", *lines, ""]), encoding="utf-8")
    return path


def write_times(folder: Path, times_ns: Sequence[int], seconds: bool = False) -> Path:
    """A timestamps.csv, in ns or in decimal seconds."""
    rows = (
        [f"{t // 10**9}.{t % 10**9:09d}" for t in times_ns]
        if seconds
        else [str(t) for t in times_ns]
    )
    path = folder / "timestamps.csv"
    path.write_text("\n".join(["time_s" if seconds else "time_ns", *rows, ""]), encoding="utf-8")
    return path


def write_png_folder(
    folder: Path,
    frames: Frames,
    camera: Camera = SMALL,
    times_ns: Sequence[int] | None = None,
    **more: object,
) -> Path:
    """frame_0.png, frame_1.png, ... (so that sorting by letters would be wrong), camera.toml and
    timestamps.csv.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for k, frame in enumerate(frames):
        assert cv2.imwrite(str(folder / f"frame_{k}.png"), frame)
    write_camera(folder, camera, **more)
    write_times(folder, even_times(len(frames)) if times_ns is None else times_ns)
    return folder


def write_tiff_stack(path: Path, frames: NDArray[Any], camera: Camera = SMALL, **how: Any) -> Path:
    """One TIFF with a page per frame, and a camera.toml and timestamps.csv beside it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tifffile.TiffWriter(path) as tif:
        for frame in frames:
            tif.write(frame, photometric="minisblack", contiguous=False, **how)
    write_camera(path.parent, camera)
    write_times(path.parent, even_times(len(frames)))
    return path


def write_moseq_folder(
    folder: Path,
    frames: Frames,
    times_ms: Sequence[float | str] | None = None,
    metadata: dict[str, object] | None = None,
) -> Path:
    """depth.dat, depth_ts.txt and metadata.json, as the Kinect v2 program writes them."""
    folder.mkdir(parents=True, exist_ok=True)
    frames.astype("<u2").tofile(folder / "depth.dat")
    stamps = (
        [f"{1000.0 + k * 33.3333:.4f}" for k in range(len(frames))]
        if times_ms is None
        else times_ms
    )
    (folder / "depth_ts.txt").write_text("".join(f"{t} 0\n" for t in stamps), encoding="utf-8")
    facts: dict[str, object] = {
        "DepthResolution": [int(frames.shape[2]), int(frames.shape[1])],
        "IsLittleEndian": True,
        "SessionName": "a session",
        "StartTime": "2017-01-25T10:42:07.1734698-05:00",
        "SubjectName": "m01",
    }
    (folder / "metadata.json").write_text(
        json.dumps(facts if metadata is None else metadata), encoding="utf-8"
    )
    return folder


def write_archive(folder: Path, archive: Path, order: Sequence[str] | None = None) -> Path:
    """A folder's files as .tar.gz, without a folder inside; `order` names the members and their
    order.
    """
    with tarfile.open(archive, "w:gz", compresslevel=1) as tar:
        for name in order or sorted(path.name for path in folder.iterdir()):
            content = (folder / name).read_bytes()
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    return archive


def write_mcap(
    path: Path,
    frames: NDArray[Any],
    camera: Camera | None = SMALL,
    times_ns: Sequence[int] | None = None,
    *,
    topics: Sequence[str] = ("/camera/depth",),
    encoding: str = "16UC1",
    stamped: bool = True,
    padding: int = 0,
    compression: MCAPCompression | None = MCAPCompression.Zstd,
    chunk_size: int = 16 * 1024,
    use_chunks: bool = True,
    log_delay_ns: int = 0,
    distortion: Sequence[float] = (),
) -> Path:
    """Foxglove protobuf depth, and (unless camera is None) one CameraCalibration per depth topic.

    encoding "png" writes CompressedImage; `padding` bytes follow each row; log times lag the stamps
    by `log_delay_ns`.
    """
    options = MCAPWriteOptions(
        compression=compression, chunk_size=chunk_size, use_chunks=use_chunks
    )
    context = foxglove.Context()
    writer = foxglove.open_mcap(path, context=context, allow_overwrite=True, writer_options=options)
    for topic in topics:
        if camera is not None:
            lens = CameraCalibrationChannel(
                topic.rpartition("/")[0] + "/calibration", context=context
            )
            lens.log(
                CameraCalibration(
                    timestamp=Timestamp(sec=0, nsec=0),
                    frame_id=topic,
                    width=camera.width,
                    height=camera.height,
                    K=[float(k) for k in camera.matrix.ravel()],
                    D=list(distortion),
                ),
                log_time=START_NS,
            )
        make: Any = CompressedImageChannel if encoding == "png" else RawImageChannel
        channel = make(topic, context=context)
        for time_ns, frame in zip(
            even_times(len(frames)) if times_ns is None else times_ns, frames, strict=True
        ):
            stamp = (
                Timestamp(sec=time_ns // 10**9, nsec=time_ns % 10**9)
                if stamped
                else Timestamp(sec=0, nsec=0)
            )
            channel.log(
                _image(frame, stamp, topic, encoding, padding), log_time=time_ns + log_delay_ns
            )
    writer.close()
    return path


def write_mcap_parts(
    folder: Path,
    frames: Frames,
    cuts: Sequence[int] = (2, 5),
    times_ns: Sequence[int] | None = None,
    camera: Camera | None = SMALL,
) -> Path:
    """The frames in MCAP files cam1_0.mcap, cam1_1.mcap ... that begin at `cuts`; the folder."""
    times = even_times(len(frames)) if times_ns is None else times_ns
    edges = [0, *cuts, len(frames)]
    for k, (start, stop) in enumerate(itertools.pairwise(edges)):
        path = folder / f"cam1_{k}.mcap"
        write_mcap(path, frames[start:stop], camera, times_ns=times[start:stop])
    return folder


def _image(
    frame: NDArray[Any], stamp: Timestamp, frame_id: str, encoding: str, padding: int
) -> RawImage | CompressedImage:
    if encoding == "png":
        data = cv2.imencode(".png", frame)[1].tobytes()
        return CompressedImage(timestamp=stamp, frame_id=frame_id, format="png", data=data)
    rows = np.ascontiguousarray(frame).view(np.uint8).reshape(len(frame), -1)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xAB)
    return RawImage(
        timestamp=stamp,
        frame_id=frame_id,
        encoding=encoding,
        width=frame.shape[1],
        height=frame.shape[0],
        step=padded.shape[1],
        data=padded.tobytes(),
    )


def in_memory(
    frames: NDArray[Any], camera: Camera = SMALL, times_ns: Sequence[int] | None = None
) -> Recording:
    """Depths (n, H, W) mm as a recording that is in no file."""
    times = even_times(len(frames)) if times_ns is None else times_ns
    return Recording(
        name="in memory",
        format="memory",
        camera=camera,
        times_ns=np.array(times, np.int64),
        read=lambda index: frames[index].astype(np.float32),
    )


def write_oni_file(
    path: Path,
    frames: NDArray[Any],
    camera: Camera = SMALL,
    times_ns: Sequence[int] | None = None,
    codec: Codec = "16zT",
    tenths: bool = False,
) -> Path:
    """An .oni file of stored depths (mm, or tenths of them) with its intrinsics in a property."""
    times = even_times(len(frames)) if times_ns is None else times_ns
    sides = ((camera.width, camera.fx), (camera.height, camera.fy))
    made = depth_builder(
        [plain_payload(frame, codec) for frame in frames],
        codec,
        camera.width,
        camera.height,
        table=True,
        times_us=[(time_ns + 500) // 1000 for time_ns in times],
        fov=tuple(2 * math.atan(n / 2 / f) for n, f in sides),
        lens=struct.pack("<dddd", camera.fx, camera.fy, camera.cx, camera.cy),
        pixel_format=101 if tenths else 100,
    )
    return made.write(path)


def cut(path: Path, share: float, to: Path | None = None) -> Path:
    """The first `share` of a file's bytes, in place or as another file."""
    content = path.read_bytes()
    target = to or path
    target.write_bytes(content[: int(len(content) * share)])
    return target
