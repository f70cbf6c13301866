"""The job `liex doctor`: what is in a recording, and what a lab should know before it trusts it. Needs no model."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from liex_lab.camera import Camera
from liex_lab.errors import LiexError
from liex_lab.progress import Progress, silent
from liex_lab.recordings import Recording, open_recording

FINDINGS: Final = {  # key of the JSON: (how the report calls it, unit)
    "format": ("format", ""),
    "n_frames": ("frames", ""),
    "duration_s": ("duration", "s"),
    "rate_hz": ("rate", "frames/s"),
    "n_gaps": ("gaps in time", ""),
    "width": ("width", "px"),
    "height": ("height", "px"),
    "fx": ("focal length fx", "px"),
    "fy": ("focal length fy", "px"),
    "cx": ("optical axis cx", "px"),
    "cy": ("optical axis cy", "px"),
    "intrinsics_source": ("intrinsics from", ""),
    "depth_min_mm": ("nearest depth", "mm"),
    "depth_max_mm": ("farthest depth", "mm"),
    "floor_mm": ("camera above the floor", "mm"),
    "problems": ("problems", ""),
}
_N_SAMPLED = 64  # frames looked at, spread over the recording
_MUCH_UNREAD = 0.4  # share of the pixels
_PLAUSIBLE_MM = (
    100.0,
    10_000.0,
)  # median depth: nearer than any depth camera reads, farther than any animal is watched
_PLAUSIBLE_FLOOR_MM = (150.0, 3000.0)


def examine(
    path: str | Path,
    *,
    camera: Camera | None = None,
    fps: float | None = None,
    topic: str | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Look at a recording; the result has the keys of `FINDINGS`, in their order, and only JSON's own types.

    A number that cannot be told is None. A recording that is cut short is looked at as far as it goes; one that cannot
    be opened at all raises a RecordingError.
    """
    with open_recording(path, camera=camera, fps=fps, topic=topic, progress=progress) as recording:
        depth = _sample_depth(recording, progress)
        floor_mm, no_floor = _floor(recording) if depth.median_mm is not None else (None, [])
        lens = recording.camera
        return {
            "format": recording.format,
            "n_frames": len(recording),
            "duration_s": _finite(recording.duration_s),
            "rate_hz": _finite(recording.rate_hz),
            "n_gaps": len(recording.gaps),
            "width": recording.width,
            "height": recording.height,
            **{name: float(getattr(lens, name)) for name in ("fx", "fy", "cx", "cy")},
            "intrinsics_source": lens.source,
            "depth_min_mm": depth.min_mm,
            "depth_max_mm": depth.max_mm,
            "floor_mm": floor_mm,
            "problems": [*recording.problems, *_time_problems(recording), *depth.problems(), *no_floor],
        }


def print_report(findings: dict[str, Any]) -> None:
    """The findings as a table to read, and the problems below it."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, pad_edge=False)
    for key, (name, unit) in FINDINGS.items():
        if key != "problems":
            value = findings[key]
            table.add_row(name, Text(_readable(value)), unit if value is not None else "")
    console = Console()
    console.print(table)
    if not findings["problems"]:
        console.print("no problems found", style="green")
    for problem in findings["problems"]:
        console.print(Text(f"- {problem}", style="yellow"), soft_wrap=True)


class _Depths:
    """What the sampled frames hold, added up frame by frame so that memory does not grow."""

    def __init__(self) -> None:
        self.n_frames = self.n_empty = self.n_pixels = self.n_unread = 0
        self.low, self.high = math.inf, 0.0
        self._medians: list[float] = []

    def add(self, depth: NDArray[np.float32]) -> None:
        read = depth[depth > 0]
        self.n_frames += 1
        self.n_pixels += depth.size
        self.n_unread += depth.size - read.size
        if not read.size:
            self.n_empty += 1
            return
        self.low, self.high = min(self.low, float(read.min())), max(self.high, float(read.max()))
        self._medians.append(float(np.median(read)))

    @property
    def min_mm(self) -> float | None:
        return self.low if self._medians else None

    @property
    def max_mm(self) -> float | None:
        return self.high if self._medians else None

    @property
    def median_mm(self) -> float | None:
        return float(np.median(self._medians)) if self._medians else None

    def problems(self) -> list[str]:
        """Sentences about what the depths themselves say."""
        if self.median_mm is None:
            return [f"none of the {self.n_frames} frames looked at holds any depth; check the camera and unit_mm"]
        found = []
        if self.n_empty:
            found.append(f"{self.n_empty} of the {self.n_frames} frames looked at hold no depth at all")
        share = (self.n_unread - self.n_empty * self.n_pixels / self.n_frames) / self.n_pixels
        if share > _MUCH_UNREAD:
            found.append(
                f"{share:.0%} of the pixels are unread, more than {_MUCH_UNREAD:.0%}; check the camera's range, "
                "sunlight and shiny surfaces"
            )
        if not _PLAUSIBLE_MM[0] <= self.median_mm <= _PLAUSIBLE_MM[1]:
            found.append(
                f"the median depth is {self.median_mm:.4g} mm, which no animal is watched from; the depths are "
                "probably not in mm, so state the true unit_mm (millimetres per stored step) in camera.toml"
            )
        return found


def _sample_depth(recording: Recording, progress: Progress) -> _Depths:
    depths = _Depths()
    chosen = np.unique(np.linspace(0, len(recording) - 1, min(_N_SAMPLED, len(recording))).astype(int))
    for done, index in enumerate(chosen, start=1):
        depths.add(recording.frame(int(index)).depth)
        progress(done, len(chosen), "looking at frames")
    return depths


def _time_problems(recording: Recording) -> list[str]:
    found = []
    jumps = [gap for gap in recording.gaps if gap.reason == "clock_jumped"]
    if jumps:
        found.append(
            f"the camera was stopped, or its clock set, in {len(jumps)} places, the first before frame "
            f"{jumps[0].start_frame}; nothing is measured across them"
        )
    if gaps := [gap for gap in recording.gaps if gap.reason != "clock_jumped"]:
        missing = sum(gap.n_frames_missing for gap in gaps)
        share = missing / (len(recording) + missing)
        longest_s = max(gap.stop_ns - recording.times_ns[gap.start_frame - 1] for gap in gaps) / 1e9
        places = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
        found.append(
            f"the camera left out about {missing} frames ({share:.1%}) in {places}; the longest time between two "
            f"frames is {longest_s:.2f} s"
        )
    if len(recording) == 1:
        found.append("a single frame has no rate and no duration")
    return found


def _floor(recording: Recording) -> tuple[float | None, list[str]]:
    """Distance from the camera to the floor plane, mm; or None and the reason."""
    from liex_lab.recordings.arena import find_floor
    from liex_lab.recordings.foreground import learn_background

    try:
        background, *_ = learn_background(recording)
        distance = _finite(find_floor(background, recording.camera).distance_mm)
    except LiexError as error:
        return None, [f"no floor: {error}"]
    if distance is None:
        return None, ["no floor: the plane that was found has no finite distance"]
    low, high = _PLAUSIBLE_FLOOR_MM
    if not low <= distance <= high:
        return distance, [
            f"the floor lies {distance:.0f} mm from the camera, outside the usual {low:.0f} to {high:.0f} mm; check "
            "the unit and the camera's height"
        ]
    return distance, []


def _finite(value: float) -> float | None:
    """A number JSON can hold, or None."""
    return float(value) if math.isfinite(value) else None


def _readable(value: Any) -> str:
    if value is None:
        return "unknown"
    return f"{value:.2f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)
