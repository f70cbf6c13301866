"""Infrared by its name: images of 16 bits that hold brightness and look like depth to a reader."""

from __future__ import annotations

import re
from pathlib import Path

from liex_lab.errors import RecordingError, printable

_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_INFRARED = {"ir", "infra", "passiveir"}


def is_infrared(name: str) -> bool:
    """Whether the name of a file, topic or track is that of infrared images: "ir", "PASSIVE_IR".

    The words of the name count, so "circle" is none; one that also says depth is depth.

    Args:
        name: a name or title, without the ending of a file's name.
    """
    words = {word.lower() for word in _WORD.findall(name)}
    found = words & _INFRARED or {word for word in words if word.startswith("infrared")}
    return bool(found) and "depth" not in words


def refuse_infrared(path: Path, name: str) -> None:
    """Refuse a file or folder whose name, or the title of its track, is that of infrared images.

    Args:
        path: the file or folder, for the sentence.
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
