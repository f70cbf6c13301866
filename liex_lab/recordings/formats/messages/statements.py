"""Statements of known programs about their recordings: RealSense's, and `liex pack`.

A RealSense `.bag` (until 2025) has depth unit, camera and sensor times in numbers, KeyValues and a
CameraInfo; a `.db3` (since 2026) has all of them in strings such as "fx=287.9;ppx=159.5". Both use
the same topics, of a sensor or of one of its streams, and converters keep these. In a `.db3` a
depth image's header has the time of arrival, counted from the beginning of the recording; the
sensor's time is in the metadata of its frame.
"""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError

from liex_lab.errors import RecordingError
from liex_lab.recordings.formats.messages.messages import (
    STATES,
    Calibration,
    Envelope,
    MessagePlace,
    Statement,
)
from liex_lab.recordings.timestamps import FAULTS, LIMIT_NS, start_of_clock

_OF_PROGRAM = re.compile(r"^/device_\d+/sensor_\d+/")
_LENS = ("width", "height", "fx", "ppx", "fy", "ppy")


def calibration_in(statement: Statement) -> Calibration | None:
    """The intrinsics of a stream in a statement; None if it states something else.

    Args:
        statement: the statement.

    Raises:
        ValueError: one of them is not a number.
    """
    if not set(_LENS) <= set(statement.facts):
        return None
    width, height, fx, cx, fy, cy = (float(statement.facts[name]) for name in _LENS)
    bent = tuple(float(c) for c in statement.facts.get("coeffs", "").split(",") if c)
    k = (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
    return Calibration("", int(width), int(height), statement.facts.get("model", ""), bent, k, ())


@dataclass
class Statements:
    """Statements of a file about its sensors and streams, each named by the beginning of its
    topics.

    Attributes:
        units_mm: mm of a stored step, as a sensor's option or in the metadata of a stream's frames,
            with the number of times each was stated.
        times_ns: by message of a stream: time of logging and time of the sensor, ns.
        began_ns: the computer's clock at the first frame of a stream, ns.
    """

    units_mm: defaultdict[str, Counter[float]] = field(default_factory=lambda: defaultdict(Counter))
    times_ns: defaultdict[str, dict[MessagePlace, tuple[int, int]]] = field(
        default_factory=lambda: defaultdict(dict)
    )
    began_ns: dict[str, int] = field(default_factory=dict)

    def add(self, message: Envelope, statement: Statement) -> bool:
        """Record a statement.

        Args:
            message: its message.
            statement: the statement.

        Returns:
            False if further messages of the channel add nothing.

        Raises:
            ValueError: a value is not a number.
        """
        topic, facts = message.channel.topic, statement.facts
        of = STATES.sub("/", topic)
        unit_mm = (
            float(facts.get("value" if topic.endswith("/value") else "depth_units", 0)) * 1000.0
        )
        if 0.0 < unit_mm < np.inf:
            self.units_mm[of][float(f"{unit_mm:.9g}")] += 1
        if "system_time" in facts:
            self.began_ns.setdefault(of, _ms_as_ns(facts["system_time"]))
        if "timestamp" in facts:
            sensor_ns = _ms_as_ns(facts["timestamp"])
            self.times_ns[of][message.place] = (message.log_time_ns, sensor_ns)
        # a .bag has one message per fact and frame, and the times are in its headers
        return message.channel.schema.endswith("String") or of not in self.began_ns

    def step_mm(
        self, topic: str, settled: bool, problems: list[str], doubts: list[str]
    ) -> float | None:
        """Millimetres of a stored step on a topic.

        The unit in the frames' metadata (the longest matching topic prefix) overrides the
        sensor's option.

        Args:
            topic: name of the depth topic.
            settled: whether a camera.toml states the unit.
            problems: appended to if a recording of these programs states none.
            doubts: appended to if it states several.

        Returns:
            mm; None if the file does not state it, or states several and a camera.toml decides.
        """
        stated = {of: units for of, units in self.units_mm.items() if topic.startswith(of)}
        if not stated and _OF_PROGRAM.search(topic) and not settled:
            problems.append(
                "the recording states no depth unit, so 1 mm was assumed; state the true unit_mm "
                "in camera.toml if it differs"
            )
        every = sorted({unit for units in stated.values() for unit in units})
        # units are written with six decimals of a metre
        differ = bool(every) and every[-1] - every[0] > 1e-3
        if not every or (differ and settled):
            return None
        step_mm, _ = stated[max(stated, key=len)].most_common(1)[0]
        if differ:
            listed = " and ".join(f"{unit:g}" for unit in every[:4])
            doubts.append(
                f"the recording states depth units of {listed} mm; {step_mm:g} mm was used, and "
                "lengths are wrong by the ratio where another one is true: state unit_mm in "
                "camera.toml"
            )
        return step_mm

    def start(self, topic: str) -> str | None:
        """Start time of a topic, ISO 8601, by the computer's clock; None if absent.

        Args:
            topic: name of the depth topic.
        """
        began = [start_of_clock(ns) for of, ns in self.began_ns.items() if topic.startswith(of)]
        return began[0] if began else None

    def sensor_times(
        self,
        topic: str,
        logged_ns: NDArray[np.int64],
        arrived_ns: NDArray[np.int64],
        problems: list[str],
    ) -> NDArray[np.int64]:
        """The sensor's times of the depth images on a topic, from the metadata of their frames.

        An image and its metadata have the same time of logging, or else the same number.

        Args:
            topic: name of the depth topic.
            logged_ns: (n,) times of logging, ns, in order.
            arrived_ns: (n,) stamps in their headers, ns.
            problems: appended to if images have no metadata.

        Returns:
            (n,) ns; the stamps of the headers if the file has no metadata.
        """
        times = next((t for of, t in self.times_ns.items() if topic.startswith(of)), {})
        if not times:
            return arrived_ns
        by_log = dict(times.values())
        found = [by_log.get(ns) for ns in logged_ns.tolist()]
        if None in found and len(times) == len(found):
            found = [ns for _, ns in times.values()]
        if None in found:
            problems.append(
                f"{found.count(None)} of {len(found)} depth images have no metadata with the "
                "sensor's time; their times of arrival are used"
            )
        known = np.array([ns is not None for ns in found])
        sensor_ns = np.array([ns or 0 for ns in found])
        delay = int(np.median((sensor_ns - arrived_ns)[known])) if known.any() else 0
        return np.where(known, sensor_ns, arrived_ns + delay)


def _ms_as_ns(text: str) -> int:
    """Milliseconds as decimal text, in ns; a float64 would only be precise to 200 ns."""
    if not abs(float(text)) * 1e6 < LIMIT_NS:
        raise ValueError(f"a time in the metadata is {text}")
    return int((Decimal(text.strip()) * 1_000_000).to_integral_value())


# Facts in an archive of `liex pack` about its source recording.


SUFFIX = ".pack"  # before .mcap; not part of the recording's name
_FACTS = "packed"
_HASH = "depth_sha256"


class PackFacts(BaseModel):
    """Facts about the source of an archive; defaults for a file that is not an archive.

    Attributes:
        step_mm: mm of a stored step.
        problems: sentences about the recording.
        moved: frames whose stamps were moved, and why: index into `FAULTS` by row.
        source: name, format and SHA-256 of the recording.
        region_px: (u, v) corners of the polygon of kept pixels; empty for the whole image, or for a
            region that is not a polygon.
        n_px: number of kept pixels per image; 0 for all.
        doubts: reasons why its times are unreliable.
        depth_sha256: SHA-256 of times (int64 ns) and images (uint16 steps), little endian, in
            order; empty if unknown.
        packed: whether the file is an archive.
    """

    step_mm: Annotated[float, Field(gt=0, lt=1000)] = 1.0
    problems: list[str] = []
    moved: dict[int, Annotated[int, Field(gt=0, lt=len(FAULTS))]] = {}
    source: dict[str, str] = {}
    region_px: list[list[float]] = []
    n_px: int = 0
    doubts: list[str] = []
    depth_sha256: Annotated[str, Field(exclude=True)] = ""
    packed: Annotated[bool, Field(exclude=True)] = False

    @staticmethod
    def of(notes: Mapping[str, str]) -> PackFacts:
        """The facts in a file's notes.

        Args:
            notes: texts by name.

        Raises:
            RecordingError: they were not written by `liex pack`, or are damaged.
        """
        if _FACTS not in notes:
            return PackFacts()
        with suppress(ValidationError):
            facts = PackFacts.model_validate_json(notes[_FACTS])
            if facts.model_fields_set >= {"step_mm", "problems", "moved", "source", "region_px"}:
                return facts.model_copy(
                    update={"depth_sha256": notes.get(_HASH, ""), "packed": True}
                )
        raise RecordingError(
            "the facts of this archive are damaged, so that its depth would have no unit; "
            "pack the recording again"
        )

    def to_notes(self) -> dict[str, str]:
        """The facts as texts for the file's notes, except for the hash, see `hash_note`."""
        return {_FACTS: json.dumps(self.model_dump(mode="json"))}

    @property
    def metadata(self) -> dict[str, Any]:
        """Metadata of the recording about its archive; empty for other files."""
        if not self.packed:
            return {}
        table = {"source": self.source, "step_mm": self.step_mm, "depth_sha256": self.depth_sha256}
        return {"packed": table}

    def faults(self, found: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Why the stamps of the recording's frames were moved.

        Args:
            found: (n,) faults of the archive's own stamps.

        Returns:
            (n,) index into `FAULTS`.
        """
        faults = found.copy()
        for row, why in self.moved.items():
            if 0 <= row < len(faults):
                faults[row] = why
        return faults


def hash_note(depth_sha256: str) -> dict[str, str]:
    """The note at the end of an archive.

    Args:
        depth_sha256: see `PackFacts`.
    """
    return {_HASH: depth_sha256}
