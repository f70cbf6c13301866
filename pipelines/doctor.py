"""Quality report of a recording, `liex doctor`: what is in it, and what to know before trusting it.

Looks at stamps (rate, jitter, gaps, faults), camera and lens, depth range and
unread pixels, in frames spread over the recording at floor, noise, arena, water and animal, and
where asked at which plan fits, which alone needs models.
`FINDINGS` lists every number with its unit; problems are sentences that say what to do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError
from liex_lab.optics.camera import unusual_centre, unusual_lens
from liex_lab.plan import Plan
from liex_lab.plan.plan import arena_lines
from liex_lab.recordings.frame import PLAUSIBLE_MM
from liex_lab.recordings.timestamps import (
    DROPPED,
    Gap,
    frames_apart,
    median_step,
    unwritable_times,
)
from liex_lab.runtime.progress import Progress, silent

from .build import build_water
from .choice import Proposal, propose_plan
from .doctor_files import next_command, open_anyhow
from .doctor_scene import SceneLook
from .origin import animal_of, session_bytes
from .regions import arenas_of, cut_out, propose_arenas, stated_corners

if TYPE_CHECKING:
    from liex_lab.plan.sections import SeveralArenas
    from liex_lab.recordings.recording import Recording

FINDINGS: Final = {  # key of the JSON: what it says; numbers that cannot be told are None
    "format": "how the recording is stored",
    "n_frames": "frames that can be read",
    "duration_s": "from the first frame to the last",
    "rate_hz": "one over the usual step from frame to frame",
    "jitter_ms": "standard deviation of the steps, without those across a gap",
    "n_gaps": "places where the camera left out frames",
    "n_missing": "frames that it left out there",
    "n_time_faults": "stamps that were moved, for they repeat or run back, and jumps of the clock",
    "width": "pixels in a row",
    "height": "rows",
    "fx": "focal length along a row, px",
    "fy": "focal length along a column, px",
    "cx": "column of the optical axis, px",
    "cy": "row of the optical axis, px",
    "intrinsics_source": "where these four come from",
    "distortion": "of the lens, which is undone on reading; None: there is none",
    "water": "the surface of the plan, whose refraction is undone on reading; None: there is none",
    "depth_min_mm": "nearest reading",
    "depth_max_mm": "farthest reading",
    "unread_share": "of the pixels, in frames that hold any depth",
    "floor_unread_share": "the same, of the pixels on the floor and on what stands there",
    "noise_mm": "standard deviation of a pixel of the floor over time",
    "floor_mm": "from the lens to the floor, perpendicular to it",
    "floor_tilt_rad": "angle between the optical axis and the floor's perpendicular",
    "water_depth_mm": "of the water over the floor, below the lens",
    "arena": "shape of the floor, mm in the arena frame: see session.json",
    "scene": "floor, region, fixtures, and how many animals move: see session.json",
    "animal_length_mm": (
        "of its outline from above, four standard deviations along the long axis; median"
    ),
    "animal_area_mm2": "seen from above",
    "animal_share": "of the frames looked at, in which it was found",
    "animal_sits_still": "whether it had become a part of the background",
    "session_mb": "what a session of it takes on disk, MB, within a factor of two",
    "arenas": "lines of a plan for several arenas in the picture; empty where one is seen",
    "plan": "the bundled plan that fits, or the one that was named; None where none does",
    "plan_says": "how it fits, or what contradicts each plan",
    "n_animals": "things of the animal's size in view at once that its body fits",
    "missing": "what the files do not say, and the lines to write; empty where they say it",
    "problems": "what is wrong, and what to do about it",
    "next": "the command to run next",
}
# frames looked at, spread over the recording; as many as a run learns its scene from
_N_SAMPLED = 96
_N_RAW = 16
# frames compared with the one before, and how many in a row of a recording that has more
_N_COMPARED = 400
_WINDOW = 8


def examine(
    path: str | Path,
    plan: Plan | None = None,
    *,
    fps: float | None = None,
    topic: str | None = None,
    propose: bool = False,
    named: bool = True,
    typed: tuple[str | None, Sequence[str]] = (None, ()),
    progress: Progress = silent,
) -> dict[str, Any]:
    """The findings of a recording: the keys of `FINDINGS`, in types that JSON can hold.

    A recording that is cut short is looked at as far as it goes. One that does not say what camera
    took it or when is looked at with a guess, and the lines that say it are told.

    Args:
        path: a file, folder or address of a recording.
        plan: camera, water surface, expected sizes; None takes the default plan.
        fps: frame rate of recordings without stamps, before the plan's.
        topic: depth topic of a message log, before the plan's.
        propose: hold the bundled plans against the recording, which takes their models: the given
            or the usual one first, and others only where it does not fit.
        named: whether someone named the plan, who is told then if it does not fit.
        typed: the plan as it was typed, None where none was, and further options that a run is to
            have, too.
        progress: told while an archive is unpacked or an index made.

    Raises:
        RecordingError: the recording cannot be opened at all.
    """
    from liex_lab.recordings.rectify import rectified
    from liex_lab.scene.background import sample_frames, stride_for

    asked = plan if named else None
    plan = _asked(plan or Plan(), fps, topic)
    water = build_water(plan)
    recording, missing = open_anyhow(path, plan, progress)
    with recording as opened:
        progress(0, None, "looking at frames spread over the recording")
        seen = rectified(opened, water)
        misplaced: list[str] = []
        try:
            seen = cut_out(seen, plan)
        except LiexError as error:
            misplaced.append(str(error))
            plan = plan.with_settings(["arena.region="])
        stride = stride_for(seen, animal_of(plan).spine_min_mm)
        sample = sample_frames(seen, _N_SAMPLED, stride)
        depth = _Depths(sample if seen is opened else sample_frames(opened, _N_RAW))
        scene = SceneLook(seen, plan, water, sample, stride)
        if depth.median_mm is not None:
            scene.at_scene()
        proposal = Proposal(None, "")
        arenas: list[SeveralArenas] = []
        if depth.median_mm is not None and (propose or plan.arenas is not None):
            progress(0, None, "looking for several arenas")
            arenas = _several(seen, plan, misplaced)
        if propose and depth.median_mm is not None:
            progress(0, None, "looking which plan fits")
            first = arenas[0] if arenas else None
            one = (
                seen
                if first is None
                else seen.masked(stated_corners(seen, plan, first.region), lent=True)
            )
            proposal = propose_plan(one, asked)
        lens = opened.camera
        found = {
            **_time_facts(opened),
            **{name: getattr(lens, name) for name in ("width", "height")},
            **{name: float(getattr(lens, name)) for name in ("fx", "fy", "cx", "cy")},
            "intrinsics_source": lens.source,
            "distortion": None if lens.distortion is None else lens.distortion.to_dict(),
            "water": None if water is None else water.to_dict(),
            **depth.facts(),
            **scene.facts,
            "session_mb": _session_mb(seen, plan, scene.facts["animal_length_mm"], depth.median_mm),
            "arenas": [line for one in arenas for line in arena_lines(one)],
            "plan": proposal.plan,
            "plan_says": proposal.says,
            "n_animals": proposal.n_animals,
            "missing": missing,
            "problems": [
                *seen.problems,
                *filter(None, [unwritable_times(opened.times_ns)]),
                *filter(None, [unusual_lens(lens) if water is None and not missing else ""]),
                *filter(None, [unusual_centre(lens)[0] if not missing else ""]),
                *_time_problems(opened),
                *_copies_told(opened, sample),
                *depth.problems(),
                *misplaced,
                *scene.problems,
                *proposal.problems,
            ],
            "next": next_command(
                path, proposal, missing, len(arenas) if asked is None else 0, *typed
            ),
        }
    return {key: found[key] for key in FINDINGS}


def _session_mb(
    seen: Recording, plan: Plan, length_mm: float | None, distance_mm: float | None
) -> float | None:
    """What a session takes on disk, MB; None where no animal is found."""
    if length_mm is None or distance_mm is None:
        return None
    return round(session_bytes(seen, plan, length_mm, distance_mm) / 1e6, 1)


def _several(seen: Recording, plan: Plan, misplaced: list[str]) -> list[SeveralArenas]:
    """The several arenas of a picture, listed or proposed; what is wrong with them is told."""
    from liex_lab.scene.region import masks_apart

    try:
        if plan.arenas is None:
            return propose_arenas(seen, plan)
        found = arenas_of(seen, plan)
        corners = {one.name: stated_corners(seen, plan, one.region) for one in found}
        masks_apart(corners, seen.width, seen.height)
    except LiexError as error:
        if plan.arenas is not None:
            misplaced.append(str(error))
        return []
    return found


def _asked(plan: Plan, fps: float | None, topic: str | None) -> Plan:
    """The plan with what the command line asks for; a recording that is cut short is accepted."""
    settings = ["recording.accept_truncated=true"]
    settings += [f"recording.fps={fps!r}"] if fps is not None else []
    settings += [f"recording.topic={topic}"] if topic is not None else []
    return plan.with_settings(settings)


def _copies_told(recording: Recording, sample: NDArray[np.float32]) -> list[str]:
    """Sentences on frames that repeat the depth image before them, of a long recording in windows
    spread over it.
    """
    from liex_lab.scene.background import has_noise, sampled
    from liex_lab.tracking.offline import copies_told

    if recording.format == "synthetic":  # rendered when asked for
        return []
    n = len(recording)
    starts = [0] if n <= _N_COMPARED else sampled(n - _WINDOW, _N_COMPARED // _WINDOW).tolist()
    compared = [
        (frame.time_ns, frame.repeats)
        for start in starts
        for frame in recording.frames(start, start + _WINDOW if len(starts) > 1 else None)
    ]
    times_ns, repeats = (np.array(column) for column in zip(*compared, strict=True))
    some = f", of {len(compared):,} frames compared" if len(compared) < n else ""
    found = copies_told(times_ns, repeats, has_noise(sample))
    return [f"{told}{some}" for part in found for told in part]


def _time_facts(recording: Recording) -> dict[str, Any]:
    step = np.diff(recording.times_ns) / 1e6
    dropped = _dropped(recording)
    usual = step[frames_apart(recording.times_ns, median_step(recording.times_ns)) == 1]
    return {
        "format": recording.format,
        "n_frames": len(recording),
        "duration_s": _finite(recording.duration_s),
        "rate_hz": _finite(recording.rate_hz),
        "jitter_ms": float(usual.std()) if len(usual) > 1 else None,
        "n_gaps": len(dropped),
        "n_missing": sum(gap.n_frames_missing for gap in dropped),
        "n_time_faults": len(recording.faults) + len(recording.gaps) - len(dropped),
    }


def _dropped(recording: Recording) -> list[Gap]:
    """The gaps that the camera left while its clock went on."""
    return [gap for gap in recording.gaps if gap.reason == DROPPED]


def _time_problems(recording: Recording) -> list[str]:
    found = list(recording.clock_doubts)
    gaps = _dropped(recording)
    if jumps := [gap for gap in recording.gaps if gap not in gaps]:
        found.append(
            f"the camera was stopped, or its clock set, in {len(jumps)} places, the first before "
            f"frame {jumps[0].start_frame}; no speed or distance is measured across them"
        )
    if gaps:
        missing = sum(gap.n_frames_missing for gap in gaps)
        share = missing / (len(recording) + missing)
        longest_s = max(gap.stop_ns - recording.times_ns[gap.start_frame - 1] for gap in gaps) / 1e9
        places = "1 gap" if len(gaps) == 1 else f"{len(gaps)} gaps"
        found.append(
            f"the camera left out about {missing} frames ({share:.1%}) in {places}; the longest "
            f"time between two frames is {longest_s:.2f} s; no speed or distance is measured "
            "across a gap, but if there are many, record to a faster disk or with fewer cameras on "
            "one USB controller"
        )
    if len(recording) == 1:
        found.append("a single frame has no rate and no duration; give the whole recording")
    return found


class _Depths:
    """What the sampled frames hold, frame by frame so that memory does not grow."""

    def __init__(self, frames: NDArray[np.float32]) -> None:
        """Frames (n, H, W) mm as the camera gave them."""
        self.n_frames = len(frames)
        self.n_empty = 0
        self.low = math.inf
        self.high = 0.0
        n_unread = 0
        n_pixels = 0
        medians = []
        for frame in frames:
            read = frame[frame > 0]
            if not read.size:
                self.n_empty += 1
                continue
            n_unread = n_unread + frame.size - read.size
            n_pixels = n_pixels + frame.size
            self.low = min(self.low, float(read.min()))
            self.high = max(self.high, float(read.max()))
            medians.append(float(np.median(read)))
        self.median_mm = float(np.median(medians)) if medians else None
        self.unread_share = n_unread / n_pixels if n_pixels else 1.0

    def facts(self) -> dict[str, Any]:
        """The depth part of `FINDINGS`."""
        known = self.median_mm is not None
        return {
            "depth_min_mm": self.low if known else None,
            "depth_max_mm": self.high if known else None,
            "unread_share": self.unread_share,
        }

    def problems(self) -> list[str]:
        """Sentences about what the depths themselves say."""
        if self.median_mm is None:
            return [
                f"none of the {self.n_frames} frames looked at holds any depth; check the camera "
                "and unit_mm"
            ]
        found = []
        if self.n_empty:
            found.append(
                f"{self.n_empty} of the {self.n_frames} frames looked at hold no depth at all; "
                "check the camera's cable and what covers its lens"
            )
        if not PLAUSIBLE_MM[0] <= self.median_mm <= PLAUSIBLE_MM[1]:
            found.append(
                f"the median depth is {self.median_mm:.4g} mm, which no animal is watched from; "
                "the depths are probably not in mm, so state the true unit_mm (millimetres per "
                "stored step) in camera.toml"
            )
        return found


def _finite(value: float) -> float | None:
    """A number JSON can hold, or None."""
    return float(value) if math.isfinite(value) else None
