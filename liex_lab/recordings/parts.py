"""A recording in several files, as of a camera that begins a new file every hour.

The parts are joined in the order of their true times; a time between two of them is a gap as any
other. They must be of one camera, format and animal, and must not overlap. The times of all parts
are read once; afterwards the last two parts that were read from are open.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, takewhile
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.formats.images.folder import natural_key
from liex_lab.recordings.frame import Depth
from liex_lab.recordings.recording import Recording, SourceFiles
from liex_lab.recordings.timestamp_files import name_numbers
from liex_lab.recordings.timestamps import CLOCK_JUMP_NS
from liex_lab.runtime.progress import Progress, silent

Opener = Callable[[Path], Recording]

_N_OPEN = 2  # frames may be read ahead in the next part while others are read in this one
_ROLLOVER_NS = 2 * 10**9  # no camera takes longer to begin its next file


@dataclass(frozen=True)
class _Part:
    """One file, closed, with all that the whole recording takes from it."""

    path: Path
    format: str
    camera: Camera
    times_ns: NDArray[np.int64]
    faults: NDArray[np.uint8]
    problems: tuple[str, ...]
    doubts: tuple[str, ...]
    truncated: bool
    metadata: dict[str, Any]
    files: SourceFiles
    reopen: Callable[[], Recording] | None

    @staticmethod
    def read(path: Path, open_part: Opener) -> "_Part":
        """Read everything but depth."""
        with open_part(path) as one:
            return _Part(
                path,
                one.format,
                one.camera,
                one.times_ns,
                one.stamp_faults,
                tuple(one.problems),
                tuple(one.doubts),
                one.truncated,
                one.metadata,
                one.files,
                one.reopen,
            )


class _OpenParts:
    """The parts that were read from last, open."""

    def __init__(self, parts: Sequence[_Part], open_part: Opener) -> None:
        self._parts = parts
        self._open_part = open_part
        self._starts = np.cumsum([0, *(len(part.times_ns) for part in parts)])
        self._open: dict[int, Recording] = {}
        self._lock = Lock()
        self.problems = _messages(parts, "problems")

    def read(self, number: int) -> Depth:
        """Depth of a frame by its number in the whole recording."""
        k = int(np.searchsorted(self._starts, number, side="right")) - 1
        part = self._at(k)
        depth = part.frame(number - int(self._starts[k])).depth
        for sentence in part.problems[len(self._parts[k].problems) :]:  # found while reading
            named = f"{self._parts[k].path.name}: {sentence}"
            if named not in self.problems:
                self.problems.append(named)
        return depth

    def _at(self, k: int) -> Recording:
        with self._lock:
            if k not in self._open:
                known = self._parts[k]
                reopen = known.reopen if known.files.stamp == known.files.stamp_at_opening else None
                try:
                    part = reopen() if reopen else self._open_part(known.path)
                except (RecordingError, OSError) as error:
                    raise RecordingError(
                        f"{known.path.name} can be read no more: {error}"
                    ) from None
                if not np.array_equal(part.times_ns, known.times_ns):
                    part.close()
                    raise RecordingError(
                        f"{known.path} changed while it was measured; run the same command again"
                    )
                if len(self._open) == _N_OPEN:  # a part closes when nobody reads from it any more
                    del self._open[next(iter(self._open))]
                self._open[k] = part
            return self._open[k]

    def close(self) -> None:
        """Close all parts."""
        while self._open:
            self._open.popitem()[1].close()


def join_parts(
    paths: Sequence[Path],
    open_part: Opener,
    *,
    unbroken: bool = False,
    progress: Progress = silent,
) -> Recording:
    """Join recordings of one camera to one recording, in the order of their times.

    Frames keep their true times and are numbered over all parts. A time between two parts is a gap.

    Args:
        paths: the parts, in any order.
        open_part: opens one of them.
        unbroken: refuse parts with more than two seconds between them, which may be recordings of
            their own.
        progress: counts the parts while their times are read.

    Returns:
        The recording; it has the name that the parts have in common.

    Raises:
        RecordingError: a part cannot be opened, is of another camera, format or animal, or overlaps
            another one.
    """
    parts: list[_Part] = []
    for path in paths:
        progress(len(parts), len(paths), "reading the times of the parts")
        parts.append(_Part.read(path, open_part))
    parts.sort(key=lambda part: int(part.times_ns[0]))
    try:
        _check_alike(parts)
        _check_times(parts, unbroken)
    except RecordingError as error:
        if not unbroken:
            raise
        offer = ", ".join(path.name for path in paths[:6])
        raise RecordingError(
            f"{paths[0].parent} holds several recordings: {error}; give one of these in it: {offer}"
        ) from None
    times_ns = np.concatenate([part.times_ns for part in parts])
    ends = np.cumsum([len(part.times_ns) for part in parts])
    parts = [  # a day has the times in memory once
        replace(part, times_ns=own)
        for part, own in zip(parts, np.split(times_ns, ends[:-1]), strict=True)
    ]
    opened = _OpenParts(parts, open_part)
    doubts = [*_messages(parts, "doubts"), *_order_doubt(parts)]
    opened.problems += _pauses(parts)
    return Recording(
        name=_common_name(paths),
        format=parts[0].format,
        camera=parts[0].camera,
        times_ns=times_ns,
        read=opened.read,
        sources=[file for part in parts for file in part.files.paths],
        problems=opened.problems,
        truncated=any(part.truncated for part in parts),
        metadata=parts[0].metadata,
        close=opened.close,
        faults=np.concatenate([part.faults for part in parts]),
        doubts=doubts,
    )


def _check_alike(parts: Sequence[_Part]) -> None:
    """Raise RecordingError for a part of another camera, format or animal than the first."""

    def kind(part: _Part) -> dict[str, object]:
        lens = part.camera
        optics = f"fx {lens.fx:.6g}, fy {lens.fy:.6g}, cx {lens.cx:.6g}, cy {lens.cy:.6g}"
        return {
            "format": part.format,
            "camera": f"{lens.width} x {lens.height} pixels, {optics}",
            "lens distortion": lens.distortion,
            "animal": part.metadata.get("subject_id", ""),
        }

    first = kind(parts[0])
    for part in parts[1:]:
        for what, stated in kind(part).items():
            if stated != first[what]:
                raise RecordingError(
                    f"{part.path.name} has another {what} than {parts[0].path.name}: {stated}, not "
                    f"{first[what]}; the files of one session are of one camera and one animal, so "
                    "name only these"
                )


def _check_times(parts: Sequence[_Part], unbroken: bool) -> None:
    """Raise RecordingError for parts that overlap or, if `unbroken`, do not continue each other."""
    for one, after in pairwise(parts):
        pause_ns = int(after.times_ns[0] - one.times_ns[-1])
        if pause_ns <= 0:
            raise RecordingError(
                f"{after.path.name} begins {-pause_ns * 1e-9:.3f} s before the end of "
                f"{one.path.name}: they are of two cameras, one is a copy, or the clock was set "
                "back; files of one session follow each other in time, so name only these"
            )
        if unbroken and pause_ns > _ROLLOVER_NS:
            raise RecordingError(
                f"{pause_ns * 1e-9:.1f} s lie between {one.path.name} and {after.path.name}; if "
                f"they are parts of one recording, give all of them as "
                f"'{one.path.parent / f'*{one.path.suffix}'}' in quotes"
            )


def _order_doubt(parts: Sequence[_Part]) -> list[str]:
    """A sentence if numbered files are in another order by their times; else []."""
    names = [part.path.name for part in parts]
    if name_numbers(names) is None:
        return []
    wrong = [two for two in pairwise(names) if natural_key(two[0]) > natural_key(two[1])]
    return [
        f"by its times {one} comes before {after}, and by its name after it: the clock may have "
        "been set back"
        for one, after in wrong[:1]
    ]


def _pauses(parts: Sequence[_Part]) -> list[str]:
    """A sentence on the times between parts that are no dropped frames; else []."""
    pauses = [
        (int(after.times_ns[0] - one.times_ns[-1]), one.path.name, after.path.name)
        for one, after in pairwise(parts)
    ]
    long = [pause for pause in pauses if pause[0] > CLOCK_JUMP_NS]
    if not long:
        return []
    longest, one, after = max(long)
    total_h = sum(pause[0] for pause in long) / 3.6e12
    return [
        f"nothing was recorded for {total_h:.2f} h in {len(long)} of {len(pauses)} places between "
        f"files; the longest pause, {longest / 3.6e12:.2f} h, is between {one} and {after}"
    ]


def _messages(parts: Sequence[_Part], what: str) -> list[str]:
    """The sentences of all parts, each once, with the part's name unless all state it."""
    by: dict[str, list[str]] = {}
    for part in parts:
        for sentence in getattr(part, what):
            by.setdefault(sentence, []).append(part.path.name)
    return [
        sentence
        if len(names) == len(parts)
        else f"{names[0]}{f' and {len(names) - 1} more' if names[1:] else ''}: {sentence}"
        for sentence, names in by.items()
    ]


def _common_name(paths: Sequence[Path]) -> str:
    """The beginning that all names share, without the counter; else the folder's name."""
    letters = zip(*(path.name for path in paths), strict=False)
    shared = "".join(one[0] for one in takewhile(lambda one: len(set(one)) == 1, letters))
    return re.sub(r"[\W_]*\d*$", "", shared) or paths[0].resolve().parent.name
