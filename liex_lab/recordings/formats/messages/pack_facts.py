"""What an archive made by `liex pack` says of the recording that it was made of.

They are texts in the metadata record `liex_lab` of an MCAP file, so that any other reader of MCAP
still finds the pictures, which are in ROS's compressedDepth messages.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.recordings.timestamps import FAULTS

SUFFIX = ".pack"  # of the name before .mcap; it is no part of the recording's name
_FACTS = "packed"
_HASH = "depth_sha256"


@dataclass(frozen=True)
class PackFacts:
    """The facts; all at their defaults for a file that is no archive.

    Attributes:
        step_mm: mm of a stored step.
        problems: sentences about the recording.
        doubts: reasons not to rely on its times.
        moved: frames whose stamps were moved, and why: index into `FAULTS` by row.
        source: name, format and SHA-256 of the recording.
        region_px: (u, v) corners of the polygon that the pixels kept lie in; empty for the whole
            picture, or where it was found and is no polygon.
        n_px: pixels of a picture that are kept; 0 where all are.
        depth_sha256: SHA-256 of times (int64 ns) and pictures (uint16 steps), little endian, in
            order; empty where it is not known.
        packed: whether the file is an archive.
    """

    step_mm: float = 1.0
    problems: list[str] = field(default_factory=list)
    moved: dict[int, int] = field(default_factory=dict)
    source: dict[str, str] = field(default_factory=dict)
    region_px: list[list[float]] = field(default_factory=list)
    n_px: int = 0
    depth_sha256: str = ""
    packed: bool = False
    doubts: list[str] = field(default_factory=list)

    @staticmethod
    def of(notes: Mapping[str, str]) -> PackFacts:
        """The facts in a file's notes.

        Args:
            notes: texts by name.

        Raises:
            RecordingError: they are not what `liex pack` writes.
        """
        if _FACTS not in notes:
            return PackFacts()
        try:
            told = json.loads(notes[_FACTS])
            moved = {int(row): int(why) for row, why in told["moved"].items()}
            facts = PackFacts(
                float(told["step_mm"]),
                [str(problem) for problem in told["problems"]],
                moved,
                {str(key): str(value) for key, value in told["source"].items()},
                [[float(u), float(v)] for u, v in told["region_px"]],
                int(told["n_px"]),
                notes.get(_HASH, ""),
                True,
                [str(doubt) for doubt in told.get("doubts", ())],
            )
            sound = 0.0 < facts.step_mm < 1000.0 and all(
                0 < why < len(FAULTS) for why in moved.values()
            )
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            sound = False
        if not sound:
            raise RecordingError(
                "the facts of this archive are damaged, so that its depth would have no unit; "
                "pack the recording again"
            )
        return facts

    def to_notes(self) -> dict[str, str]:
        """The facts as texts for the file's notes, but for the hash, see `hash_note`."""
        told = {
            "step_mm": self.step_mm,
            "problems": self.problems,
            "moved": {str(row): why for row, why in self.moved.items()},
            "source": self.source,
            "region_px": self.region_px,
            "n_px": self.n_px,
            "doubts": self.doubts,
        }
        return {_FACTS: json.dumps(told)}

    def name(self, stem: str) -> str:
        """Name of the recording.

        Args:
            stem: name of the file without .mcap.
        """
        return stem.removesuffix(SUFFIX) if self.packed else stem

    @property
    def metadata(self) -> dict[str, Any]:
        """What the open recording says of being an archive; nothing of another file."""
        if not self.packed:
            return {}
        told = {"source": self.source, "step_mm": self.step_mm, "depth_sha256": self.depth_sha256}
        return {"packed": told}

    def faults(self, found: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Why the stamps of the recording's frames were moved.

        Args:
            found: (n,) what the archive's own stamps say.

        Returns:
            (n,) index into `FAULTS`.
        """
        faults = found.copy()
        for row, why in self.moved.items():
            if 0 <= row < len(faults):
                faults[row] = why
        return faults


def hash_note(depth_sha256: str) -> dict[str, str]:
    """The text that closes an archive.

    Args:
        depth_sha256: see `PackFacts`.
    """
    return {_HASH: depth_sha256}
