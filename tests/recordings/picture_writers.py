"""Folders of depth images of the rarer kinds. Every writer returns the folder, with camera.toml
and stamps in it.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera
from tests.recordings.writers import SMALL, Frames, even_times, write_camera, write_times


def write_folder(
    folder: Path,
    frames: NDArray[Any],
    suffix: str,
    write: Callable[[Path, NDArray[Any]], object],
    **camera: object,
) -> Path:
    """frame_0, frame_1, ... with `suffix`, each by `write`; `camera` are further keys of
    camera.toml.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for k, frame in enumerate(frames):
        write(folder / f"frame_{k}{suffix}", frame)
    write_camera(folder, SMALL, **camera)
    write_times(folder, even_times(len(frames)))
    return folder


def write_tiff(path: Path, frame: NDArray[Any], compression: str | None = None) -> None:
    tifffile.imwrite(path, frame, photometric="minisblack", compression=compression)


def write_pgm(
    path: Path, frame: NDArray[Any], order: str = ">u2", head: str = "P5\n{w} {h}\n65535\n"
) -> None:
    height, width = frame.shape
    path.write_bytes(head.format(w=width, h=height).encode() + frame.astype(order).tobytes())


def write_pclzf(path: Path, frame: NDArray[Any], kind: bytes = b"depth16") -> None:
    data = np.ascontiguousarray(frame).tobytes()
    packed = pack_lzf(data)
    height, width = frame.shape[:2]
    head = struct.pack(
        "<5sII16sII", b"PCLZF", width, height, kind.ljust(16), len(packed), len(data)
    )
    path.write_bytes(head + packed)


def pack_lzf(data: bytes) -> bytes:
    """LZF with literal runs, and short and long copies (overlapping ones too) where a run of bytes
    repeats.
    """
    out, literal, at = bytearray(), bytearray(), 0
    last: dict[bytes, int] = {}

    def flush() -> None:
        for start in range(0, len(literal), 32):
            part = literal[start : start + 32]
            out.append(len(part) - 1)
            out.extend(part)
        literal.clear()

    while at < len(data):
        before = last.get(data[at : at + 3], -1)
        last[data[at : at + 3]] = at
        n = 0
        if before >= 0 and at - before <= 8192:
            while at + n < len(data) and n < 264 and data[before + n] == data[at + n]:
                n += 1
        if n < 3:
            literal.append(data[at])
            at += 1
            continue
        flush()
        distance = at - before - 1
        if n < 9:
            out.append((n - 2) << 5 | distance >> 8)
        else:
            out += bytes([7 << 5 | distance >> 8, n - 9])
        out.append(distance & 255)
        at += n
    flush()
    return bytes(out)


def write_nyu(folder: Path, frames: Frames) -> Path:
    """depth_1_0000001.png, ...: the high byte in green, the low one in blue; no times, as in the
    data set.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for k, frame in enumerate(frames, start=1):
        colour = np.stack([frame & 255, frame >> 8, np.zeros_like(frame)], axis=-1).astype(np.uint8)
        assert cv2.imwrite(str(folder / f"depth_1_{k:07d}.png"), colour)
    write_camera(folder)
    return folder


def write_raytrix(
    folder: Path,
    frames: NDArray[Any],
    profile: str,
    suffix: str,
    write: Callable[[Path, NDArray[Any]], object],
    more: str = "",
    **camera: object,
) -> Path:
    """A folder of exports with a raytrix.toml; `frames` are stored numbers, `more` further lines of
    raytrix.toml.
    """
    write_folder(folder, frames, suffix, write, **camera)
    (folder / "raytrix.toml").write_text(f'profile = "{profile}"\n{more}', encoding="utf-8")
    return folder


def points_of(frame: NDArray[Any], camera: Camera = SMALL) -> NDArray[np.float64]:
    """The points (n, 3) of a depth image in mm as a Raytrix export has them: y up, z negative."""
    v, u = np.nonzero(frame)
    p = camera.unproject(np.stack([u, v], axis=-1), frame[v, u].astype(float))
    return p * [1.0, -1.0, -1.0]


def write_xyz(path: Path, frame: NDArray[Any], separator: str = " ", header: str = "") -> None:
    lines = [separator.join(f"{x:.4f}" for x in p) for p in points_of(frame)]
    path.write_text("\n".join([*([header] if header else []), *lines, ""]), encoding="utf-8")


def write_ply(path: Path, frame: NDArray[Any], form: str = "binary_little_endian") -> None:
    """Vertices with a colour each, and faces behind them, as many programs write them."""
    points = points_of(frame)
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(form, "")
    head = [
        "ply",
        f"format {form} 1.0",
        "comment made for a test",
        f"element vertex {len(points)}",
        "property float x",
        "property float y",
        "property uchar red",
        "property float z",
        "element face 1",
        "property list uchar int vertex_indices",
        "end_header\n",
    ]
    if order:
        rows = np.zeros(
            len(points),
            [("x", f"{order}f4"), ("y", f"{order}f4"), ("red", "u1"), ("z", f"{order}f4")],
        )
        rows["x"], rows["y"], rows["z"] = points.T
        body = rows.tobytes() + b"\x03" + np.arange(3, dtype=f"{order}i4").tobytes()
    else:
        body = (
            "".join(f"{x:.4f} {y:.4f} 0 {z:.4f}\n" for x, y, z in points) + "3 0 1 2\n"
        ).encode()
    path.write_bytes("\n".join(head).encode() + body)
