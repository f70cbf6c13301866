"""The camera.toml format: intrinsics, depth encoding and clock of images without metadata.

Keys are in [camera] (or [recording], or at the top level); all are optional. An unknown key is
reported with the closest valid one. Also: infrared images, recognised by their names.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from liex_lab.errors import (
    LiexError,
    RecordingError,
    UnknownCameraError,
    did_you_mean,
    expecting,
    printable,
)
from liex_lab.optics.camera import Camera, Distortion, Lens
from liex_lab.recordings.frame import ENCODINGS, Depth, Stored, decode
from liex_lab.recordings.timestamp_files import UNITS
from liex_lab.recordings.timestamps import start_of_day
from liex_lab.runtime.durable import named_beside
from liex_lab.runtime.text_files import read_toml

CAMERA_FILE = "camera.toml"
WHAT_TO_WRITE = (
    "write a file camera.toml with the lines [camera], fx = 575.8, fy = 575.8, cx = 319.5, cy = "
    "239.5 (your camera's numbers, in pixels), unit_mm = 1.0 (millimetres per stored step) and "
    "fps = 30.0 where there is no timestamps.csv"
)
_INTRINSICS = ("fx", "fy", "cx", "cy")


def _is_number(value: Any, finite: bool = True) -> bool:
    return type(value) in (int, float) and (math.isfinite(value) or not finite)


_TEXT = (lambda value: isinstance(value, str) and value != "", "it is a text in quotation marks")
_PIXELS = (
    lambda value: _is_number(value) and value >= 1 and value == int(value),
    "it is a positive whole number of pixels",
)
_FOCAL = (
    lambda value: _is_number(value) and 1e-3 < value < 1e7,  # limits far beyond any camera
    "a focal length is a positive number of pixels, some hundreds of most cameras",
)
_NUMBER = (_is_number, "it is a number")
_RULES: dict[str, tuple[Callable[[Any], bool], str]] = {  # key: valid values, and how to state them
    "fx": _FOCAL,
    "fy": _FOCAL,
    "cx": _NUMBER,
    "cy": _NUMBER,
    "width": _PIXELS,
    "height": _PIXELS,
    "fps": _NUMBER,
    "unit_mm": (
        lambda value: _is_number(value) and value != 0,
        "it is the number of millimetres in one stored step",
    ),
    "unread": (
        lambda value: all(
            _is_number(one, finite=False) for one in (value if isinstance(value, list) else [value])
        ),
        "it is a list of stored numbers, as in [0, 65535]",
    ),
    "distortion": (
        lambda value: isinstance(value, list) and all(map(_is_number, value)),
        "it is a list of coefficients, as in [-0.1, 0.02, 0, 0]",
    ),
    "distortion_model": _TEXT,
    "time_column": (
        lambda value: value != "" if isinstance(value, str) else type(value) is int and value >= 0,
        "it is a column's name, or its number from 0",
    ),
    "timestamps": (
        lambda value: _TEXT[0](value) and named_beside(value),
        "it is a file in the recording's own folder, written from there without ..",
    ),
    "pattern": _TEXT,
    "subject_id": _TEXT,
    "session_start_time": (lambda value: True, "it is a date and time"),
    **{
        key: (words.__contains__, "it is one of " + ", ".join(f'"{word}"' for word in words))
        for key, words in {
            "encoding": tuple(ENCODINGS),
            "byte_order": ("big", "little"),
            "time_unit": tuple(UNITS),
        }.items()
    },
}


@dataclass(frozen=True)
class CameraFile:
    """Contents of a camera.toml; every key is optional.

    Attributes:
        path: path of the file, which may not exist.
        intrinsics: any of fx, fy, cx, cy, px.
        width: columns of the images, px.
        height: rows of the images, px.
        unit_mm: mm per stored step.
        states_unit: whether the file states unit_mm.
        unread: stored values that mean "no reading".
        encoding: how stored values encode depth, one of `ENCODINGS`.
        byte_order: of PGM images, "big" or "little".
        fps: frame rate, Hz, used if there are no stamps.
        timestamps: name of the stamp file.
        time_column: its column of times, see `read_stamps`.
        time_unit: the unit of that column.
        pattern: which images of the folder to read, as in "*_depth.png".
        metadata: subject_id and session_start_time, if stated.
        source: origin of the intrinsics, for `Camera.source`.
        problems: sentences about keys that are unknown or were ignored.
        distortion: of the lens, from distortion (a list of coefficients in OpenCV's order) and
            distortion_model.
    """

    path: Path
    intrinsics: dict[str, float] = field(default_factory=dict)
    width: int | None = None
    height: int | None = None
    unit_mm: float = 1.0
    states_unit: bool = False
    unread: tuple[float, ...] = (0.0,)
    encoding: str = "linear"
    byte_order: str | None = None
    fps: float | None = None
    timestamps: str = "timestamps.csv"
    time_column: str | int | None = None
    time_unit: str | None = None
    pattern: str = "*"
    metadata: dict[str, str] = field(default_factory=dict)
    source: str = CAMERA_FILE
    problems: tuple[str, ...] = ()
    distortion: Distortion | None = None

    @staticmethod
    def read(path: Path) -> "CameraFile":
        """Parse the file; defaults if it does not exist.

        Args:
            path: the camera.toml.

        Raises:
            RecordingError: the file is not TOML, or a value is invalid.
        """
        if not path.is_file():
            return CameraFile(path)
        with expecting(
            RecordingError, f"{path} should be a TOML file", ValueError, advice="correct it"
        ):
            document = read_toml(path)
        table = {key: value for key, value in document.items() if not isinstance(value, dict)}
        for name in ("camera", "recording"):
            if isinstance(document.get(name), dict):
                table |= document[name]
        problems = []
        for key in (key for key in table if key not in _RULES):
            hint = did_you_mean(key, _RULES, "; did you mean '{}'?")
            problems.append(f"{path.name} has a key {key!r} that means nothing here{hint}")
        return _from_table(path, table, tuple(problems))

    def decode(self, stored: Stored) -> Depth:
        """Decode stored values to depth, by the stated encoding and unit.

        Args:
            stored: (H, W), or (H, W, 3) for colour images, as in the file.

        Returns:
            (H, W) float32 mm, 0 where unread.
        """
        return decode(stored, self.encoding, self.unit_mm, self.unread)

    def camera(self, width: int, height: int, stated: Lens | None = None) -> Camera:
        """The camera of images of a given size.

        Args:
            width: columns of the images, px.
            height: rows of the images, px.
            stated: a camera or lens that overrides the file.

        Raises:
            UnknownCameraError: intrinsics are missing.
            RecordingError: the stated ones belong to another size.
        """
        if stated is not None:
            return fitting(stated, width, height, "the camera that was stated")
        if not self.intrinsics:
            raise UnknownCameraError(
                f"the camera is not known, for there is no [camera] in {self.path}; {WHAT_TO_WRITE}"
            )
        missing = [name for name in _INTRINSICS if name not in self.intrinsics]
        if missing:
            raise UnknownCameraError(
                f"{self.path} does not state {', '.join(missing)}; {WHAT_TO_WRITE}"
            )
        camera = Camera(
            **self.intrinsics,
            width=self.width or width,
            height=self.height or height,
            source=self.source,
            distortion=self.distortion,
        )
        return fitting(camera, width, height, str(self.path))


def fitting(lens: Lens, width: int, height: int, where: str) -> Camera:
    """The camera of images of a given size, from a camera of that size or a lens without a size.

    Args:
        lens: a camera, or intrinsics without a size.
        width: columns of the images, px.
        height: rows of the images, px.
        where: source of the intrinsics, for the error message.

    Raises:
        RecordingError: the camera is of another size.
    """
    bare = (lens.fx, lens.fy, lens.cx, lens.cy, width, height)
    camera = lens if isinstance(lens, Camera) else Camera(*bare, distortion=lens.distortion)
    if (camera.width, camera.height) != (width, height):
        raise RecordingError(
            f"{where} is for images of {camera.width} x {camera.height} pixels, but these have "
            f"{width} x {height}; state the intrinsics of this image size"
        )
    return camera


def rate(fps: float | None, where: str) -> float | None:
    """Check a stated frame rate, and return it.

    Args:
        fps: frames per second, Hz; None if absent.
        where: its source, for the error message.

    Raises:
        RecordingError: it is not in [0.0001, 100000].
    """
    if fps is not None and not (math.isfinite(fps) and 1e-4 <= fps <= 100_000):
        raise RecordingError(
            f"{where} states fps = {fps:g}; a frame rate is a positive number of frames per second"
        )
    return fps


def _from_table(path: Path, table: dict[str, Any], problems: tuple[str, ...]) -> CameraFile:
    for key, (is_valid, meaning) in _RULES.items():
        if key in table and not is_valid(table[key]):
            raise RecordingError(f"{path} states {key} = {table[key]!r}; {meaning}")
    unread = table.get("unread", [0])
    metadata = {"subject_id": table["subject_id"]} if "subject_id" in table else {}
    if "session_start_time" in table:
        start = start_of_day(table["session_start_time"])
        metadata |= {} if start is None else {"session_start_time": start}
        problems += (
            ()
            if start
            else (
                f"session_start_time in {path} has no time zone, so it was not used; write "
                "2024-05-01T10:00:00Z",
            )
        )
    try:
        distortion = Distortion.of(
            table.get("distortion_model", "plumb_bob"), table.get("distortion", [])
        )
    except LiexError as error:
        raise RecordingError(f"{path}: {error}") from None
    same = ("byte_order", "time_column", "time_unit", "encoding", "timestamps", "pattern")
    return CameraFile(
        path=path,
        intrinsics={key: float(table[key]) for key in _INTRINSICS if key in table},
        width=int(table["width"]) if "width" in table else None,
        height=int(table["height"]) if "height" in table else None,
        unit_mm=float(table.get("unit_mm", ENCODINGS[table.get("encoding", "linear")])),
        states_unit="unit_mm" in table,
        unread=tuple(map(float, unread if isinstance(unread, list) else [unread])),
        fps=rate(float(table["fps"]) if "fps" in table else None, str(path)),
        metadata=metadata,
        problems=problems,
        distortion=distortion,
        **{key: table[key] for key in same if key in table},
    )


# Infrared images, recognised by name: 16-bit brightness that could be mistaken for depth.


_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")


def is_infrared(name: str) -> bool:
    """Whether the name of a file, topic or track is that of infrared images: "ir", "PASSIVE_IR".

    Whole words of the name count, so "circle" does not match; a name with the word depth is depth.

    Args:
        name: a name or title, without the suffix of a file name.
    """
    words = {word.lower() for word in _WORD.findall(name)}
    found = words & {"ir", "infra", "passiveir"} or {
        word for word in words if word.startswith("infrared")
    }
    return bool(found) and "depth" not in words


def refuse_infrared(path: Path, name: str) -> None:
    """Refuse a file, folder or track whose name is that of infrared images.

    Args:
        path: the file or folder, for the error message.
        name: as in `is_infrared`.

    Raises:
        RecordingError: the name is one of infrared images.
    """
    if is_infrared(name):
        raise RecordingError(
            f"{path} holds infrared, by the name {printable(name)}, and depth was expected; give "
            "the recording of the depth (a Matroska track titled DEPTH), or change the name if "
            "this is depth"
        )
