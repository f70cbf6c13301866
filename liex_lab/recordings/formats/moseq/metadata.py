"""Metadata of a MoSeq session: metadata.json, depth_ts.txt (ms) and timestamps.csv (s).

SubjectName, SessionName, StartTime, DepthResolution and IsLittleEndian are read; the camera is told
from any of several keys, for programs that record for MoSeq have no common one.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from liex_lab.errors import RecordingError
from liex_lab.recordings.camera_file import CameraFile
from liex_lab.recordings.timestamp_files import Stamps, read_stamps
from liex_lab.recordings.timestamps import start_of_day
from liex_lab.runtime.text_files import read_text

STAMPS = {"depth_ts.txt": 10**6, "timestamps.csv": 10**9}  # file: nanoseconds in its unit
METADATA = "metadata.json"
# cameras, as far as they are told apart
AZURE = "Azure Kinect"
KINECT = "Kinect v2"
OTHER = "other"

_CAMERA_KEYS = (
    "camera",
    "cameratype",
    "cameramodel",
    "device",
    "devicename",
    "devicemodel",
    "sensor",
)
_CAMERA_WORDS = {  # word in a camera's name: which one it is; the first that is found counts
    "azure": AZURE,
    "k4a": AZURE,
    "femto": AZURE,
    "kinectv2": KINECT,
    "kinect2": KINECT,
    "kinectone": KINECT,
    "kinectforwindowsv2": KINECT,
}


@dataclass(frozen=True)
class Metadata:
    """What metadata.json says.

    Attributes:
        size: (width, height), px; None when unstated.
        dtype: of the stored depths, "<u2" or ">u2".
        camera: `AZURE`, `KINECT`, `OTHER`, or None when it does not say.
        camera_name: the camera in the file's own words; empty when unstated.
        facts: for `Recording.metadata`.
        problems: sentences about what was not used.
    """

    size: tuple[int, int] | None
    dtype: str
    camera: str | None
    camera_name: str
    facts: dict[str, Any]
    problems: list[str]


def read_metadata(path: Path | None, cut: bool) -> Metadata:
    """Parse metadata.json, which is often missing.

    Args:
        path: the file; None where there is none, and then nothing is stated.
        cut: True where its archive is cut; a broken file is then left out instead of refused.

    Returns:
        What it says.

    Raises:
        RecordingError: the file is no JSON object, or its DepthResolution cannot be.
    """
    nothing = Metadata(None, "<u2", None, "", {}, [])
    if path is None:
        return nothing
    try:
        document = json.loads(read_text(path))
        if not isinstance(document, dict):
            raise ValueError("it is not an object in braces")
    except (
        ValueError,
        RecursionError,
    ) as error:  # broken JSON and broken UTF-8 are both ValueErrors
        if cut:
            return replace(nothing, problems=[f"{METADATA} is cut short and was not used"])
        raise RecordingError(
            f"{METADATA} of the session is not JSON ({error}); correct or remove it"
        ) from None
    named = {
        "subject_id": document.get("SubjectName"),
        "session_name": document.get("SessionName"),
    }
    facts = {key: str(said).strip() for key, said in named.items() if type(said) in (str, int)}
    stated = document.get("StartTime")
    facts |= {"session_start_time": start_of_day(stated) or ""}
    facts = {key: said for key, said in facts.items() if said}
    problems = []
    if stated is not None and "session_start_time" not in facts:
        problems.append(
            f"StartTime {stated!r} in {METADATA} is not a time with a zone, so it was not used"
        )
    little = document.get("IsLittleEndian", True) is not False
    size = _stated_size(document.get("DepthResolution"))
    return Metadata(size, "<u2" if little else ">u2", *_stated_camera(document), facts, problems)


def _stated_size(value: Any) -> tuple[int, int] | None:
    if value is None:
        return None
    if (
        isinstance(value, list)
        and len(value) == 2
        and all(type(v) is int and 0 < v < 20_000 for v in value)
    ):
        return value[0], value[1]
    raise RecordingError(
        f"{METADATA} states DepthResolution = {value!r}; it is [width, height] in pixels"
    )


def _stated_camera(document: dict[str, Any]) -> tuple[str | None, str]:
    """Which camera the metadata name, and in which words: programs that record for MoSeq have no
    common key for it.
    """
    entries = {
        key.lower().replace("_", "").replace(" ", ""): value for key, value in document.items()
    }
    stated = (entries[key].strip() for key in _CAMERA_KEYS if isinstance(entries.get(key), str))
    name = next(filter(None, stated), "")
    plain = "".join(letter for letter in name.lower() if letter.isalnum())
    known = (camera for word, camera in _CAMERA_WORDS.items() if word in plain)
    return next(known, OTHER if name else None), name


def read_session_stamps(
    files: dict[str, Path],
    cut: bool,
    camera_file: CameraFile,
    problems: list[str],
    doubts: list[str],
) -> Stamps | None:
    """Read the file of time stamps beside the depth.

    depth_ts.txt counts milliseconds and timestamps.csv seconds, unless their first line names a
    column in another unit, or camera.toml does. Of a cut archive, half a number at the end is
    dropped, from the file too.

    Args:
        files: the session's files by name.
        cut: True where their archive is cut.
        camera_file: may state the column of times and its unit.
        problems: sentences, appended to where the stamps are missing or give an unlikely rate.
        doubts: reasons not to rely on the times, appended to.

    Returns:
        The stamps; None where there are none.

    Raises:
        RecordingError: a line has no stamp where one was expected.
    """
    name = next((name for name in STAMPS if name in files), None)
    if name is None:
        return None
    path = files[name]
    if cut:  # the archive may have broken off inside this file: half a number is a wrong number
        text = path.read_bytes()
        path.write_bytes(text[: text.rfind(b"\n") + 1])
    stated = (camera_file.time_column, camera_file.time_unit, STAMPS[name])
    stamps = read_stamps(path, doubts, *stated)
    if not len(stamps):
        problems.append(f"{name} holds no time stamp")
        return None
    return stamps
