"""Point clouds (XYZ text, PLY) as depth images: projection into a pinhole camera with a z-buffer.

u = floor(fx x / z + cx + 1/2), v likewise; the nearest point of a pixel is used.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera
from liex_lab.recordings.formats.images.files import (
    FileStack,
    Probe,
    Size,
    open_files,
    something_else,
)
from liex_lab.runtime.progress import Progress

Points = NDArray[np.float64]

TEXTS = (".xyz", ".txt", ".csv", ".asc")
PLY = ".ply"
SUFFIXES = (*TEXTS, PLY)
_HEAD_BYTES = 1 << 16
_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def open_clouds(
    files: list[Path],
    camera: Camera,
    columns: tuple[int, int, int],
    to_camera: Callable[[Points], Points],
    progress: Progress,
) -> FileStack:
    """Open point clouds, one per file, as images of a camera.

    Args:
        files: the clouds, in order.
        camera: the camera of the images.
        columns: of x, y, z in a text file, from 0.
        to_camera: converts a file's points (n, 3) in its own units to mm in the camera frame.
        progress: counts the probed files.

    Returns:
        Images (H, W) float64 mm, 0 = unread, as a stack.

    Raises:
        RecordingError: none of the files is whole.
    """
    size = (camera.width, camera.height)

    def decode(path: Path) -> NDArray[Any] | None:
        """Depth (H, W) mm of a file; None if it is damaged."""
        points = read_points(path, columns)
        return None if points is None else render_points(to_camera(points), camera)

    return open_files(files, "point cloud", lambda path: _look(path, size), decode, progress)


def render_points(p_camera: Points, camera: Camera) -> NDArray[np.float64]:
    """Render points as a depth image: the nearest point in every pixel.

    Args:
        p_camera: (n, 3) mm, camera frame; points that are not finite or behind the lens are
            ignored.
        camera: the camera.

    Returns:
        (H, W) float64 mm, 0 without a point.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        p_camera = p_camera[np.isfinite(p_camera).all(axis=1) & (p_camera[:, 2] > 0)]
        uv = np.floor(camera.project(p_camera) + 0.5)
    inside = ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)
    column, row = uv[inside].astype(np.int64).T
    depth = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(depth, (row, column), p_camera[inside, 2])
    return np.where(np.isfinite(depth), depth, 0.0)


def read_points(path: Path, columns: tuple[int, int, int]) -> Points | None:
    """Points of a file, in its own units.

    Args:
        path: a .ply file, or a text file with one point per line.
        columns: of x, y, z in a text file, from 0.

    Returns:
        (n, 3); None if the file is damaged.
    """
    try:
        return _read_ply(path) if path.suffix.lower() == PLY else _read_text(path, columns)
    except (ValueError, OverflowError, UnicodeDecodeError):
        return None


def _look(path: Path, size: Size) -> Probe:
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if path.suffix.lower() != PLY:
        lines = head.decode("utf-8", "replace").splitlines()[:3]
        return size if any(map(_numbers, lines)) else something_else(path, "point cloud")
    if not head.startswith(b"ply"[: len(head)]):
        return something_else(path, "PLY")
    header = _ply_header(head)
    there = header is not None and path.stat().st_size - header.start >= header.n * header.row_bytes
    return size if there else None


def _numbers(line: str) -> list[str]:
    """The cells of a line if there are at least three numbers and nothing else."""
    cells = line.replace(",", " ").replace(";", " ").split()
    try:
        return (
            cells if len(cells) >= 3 and np.isfinite([float(cell) for cell in cells]).any() else []
        )
    except ValueError:
        return []


def _read_text(path: Path, columns: tuple[int, int, int]) -> Points:
    with path.open(encoding="utf-8", errors="strict") as file:
        first = [file.readline(_HEAD_BYTES) for _ in range(3)]
    n_header = next((k for k, line in enumerate(first) if _numbers(line)), 0)
    delimiter = next((mark for mark in ";," if mark in first[n_header]), None)
    with warnings.catch_warnings():  # an empty file has no points
        warnings.simplefilter("ignore", UserWarning)
        return np.loadtxt(
            path, delimiter=delimiter, skiprows=n_header, usecols=columns, ndmin=2, encoding="utf-8"
        )


class _PlyHeader(NamedTuple):
    """Layout of the vertices in a PLY file.

    Attributes:
        order: of bytes, "<" or ">"; empty for text.
        n: number of vertices.
        fields: (name, NumPy type) of each number of a vertex.
        start: their position in the file, bytes.
        row_bytes: size of one vertex, bytes; for text, its least size.
    """

    order: str
    n: int
    fields: list[tuple[str, str]]
    start: int
    row_bytes: int


def _ply_header(head: bytes) -> _PlyHeader | None:
    """Parse the header; None if it is cut, or the vertices are not the first element."""
    end = head.find(b"end_header")
    start = head.find(b"\n", end) + 1
    if end < 0 or not start:
        return None
    order = None
    n = -1
    element = ""
    fields: list[tuple[str, str]] = []
    for line in head[:end].decode("latin-1").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            order = _ORDERS.get(words[1])
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            element = words[1]
            if n < 0 and element != "vertex":
                return None
            n = int(words[2]) if n < 0 else n
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _TYPES or words[2] in dict(fields):
                return None  # a list among the vertices has no fixed size
            fields.append((words[2], _TYPES[words[1]]))
    if order is None or n < 0 or not {"x", "y", "z"} <= set(dict(fields)):
        return None
    row = 2 * len(fields) if not order else np.dtype(fields).itemsize
    return _PlyHeader(order, n, fields, start, row)


def _read_ply(path: Path) -> Points | None:
    with path.open("rb") as file:
        header = _ply_header(file.read(_HEAD_BYTES))
        if header is None or path.stat().st_size - header.start + 1 < header.n * header.row_bytes:
            return None
        file.seek(header.start)
        if not header.order:
            places = [[name for name, _ in header.fields].index(axis) for axis in "xyz"]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                return np.loadtxt(
                    file, max_rows=max(header.n, 1), usecols=places, ndmin=2, encoding="latin-1"
                )
        row = np.dtype([(name, header.order + kind) for name, kind in header.fields])
        raw = file.read(header.n * row.itemsize)
    if len(raw) < header.n * row.itemsize:
        return None
    vertices = np.frombuffer(raw, row)
    with np.errstate(
        invalid="ignore"
    ):  # damage may contain any bits, also those of a signalling NaN
        return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=-1)
