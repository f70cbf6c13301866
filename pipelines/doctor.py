"""Quality report of a recording, `liex doctor`: its contents, and problems that affect the results.

Checks time stamps (rate, jitter, gaps, faults), camera and lens, depth range and unread pixels; in
frames spread over the recording, floor, noise, arena, water and animal; and optionally which plan
fits, the only check that needs models. `FINDINGS` lists every number with its unit; problems are
sentences that state what to do.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import (
    LiexError,
    SeveralKindsError,
    UnknownCameraError,
    UnknownTimesError,
    printable,
)
from liex_lab.optics.camera import SensorCard, of_size, preset, unusual_centre, unusual_lens
from liex_lab.plan import Plan
from liex_lab.plan.plan import arena_lines
from liex_lab.plan.sections import SeveralArenas
from liex_lab.recordings.frame import PLAUSIBLE_MM
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.rectify import rectified
from liex_lab.recordings.timestamps import (
    DROPPED,
    Gap,
    frames_apart,
    median_step,
    unwritable_times,
)
from liex_lab.runtime.progress import Progress, silent
from liex_lab.runtime.text_files import read_toml
from liex_lab.scene.background import has_noise, sample_frames, sampled, stride_for
from liex_lab.scene.scene import Arena, Fixture
from liex_lab.scene.zones import masks_apart
from liex_lab.sessions.folder import megabytes
from liex_lab.tracking.curve import repeat_messages

from .build import build_water, open_planned
from .choice import USUAL, Proposal, propose_plan
from .doctor_scene import SceneLook
from .origin import animal_of, session_bytes
from .regions import arenas_of, cut_out, propose_arenas, stated_corners

_USUAL_HZ = 30.0
_USUAL_FOCAL = 0.9  # of the image's width: depth cameras have a field of view of 55 to 65 degrees
_GUESS = ["camera.fx=1.0", "camera.fy=1.0", "camera.cx=0.0", "camera.cy=0.0"]


def open_anyhow(
    path: str | Path, plan: Plan, progress: Progress = silent
) -> tuple[Recording, list[str]]:
    """Open a recording, with guesses for missing camera or times.

    Args:
        path: a file, folder or address of a recording.
        plan: how it is opened.
        progress: called while an archive is unpacked or an index made.

    Returns:
        The recording, and sentences that state what is missing and the lines to write.

    Raises:
        RecordingError: it contains nothing that can be read.
    """
    missing: list[str] = []
    guessed = plan
    pattern = None
    unknown_camera = False
    for _ in range(4):  # one more guess each time
        try:
            recording = open_planned(path, guessed, progress, pattern)
        except UnknownCameraError:
            if unknown_camera:
                raise
            unknown_camera = True
            guessed = guessed.with_settings(_GUESS)
        except UnknownTimesError:
            missing.append(
                f"the times of the pictures are not known, and {_USUAL_HZ:g} frames/s were assumed "
                f"here; write fps = {_USUAL_HZ:g} (your camera's rate) under [camera] in "
                "camera.toml, or timestamps.csv with a line time_ns and then one time per picture"
            )
            guessed = guessed.with_settings([f"recording.fps={_USUAL_HZ}"])
        except SeveralKindsError as error:
            pattern = error.pattern
            missing.append(
                f"pictures of several kinds lie here, and {pattern} was looked at; choose with the "
                f'line pattern = "{pattern}" under [camera] in camera.toml'
            )
        else:
            break
    else:
        recording = open_planned(path, guessed, progress, pattern)
    if unknown_camera:
        missing.insert(0, _guess_camera(recording))
    return recording, missing


def _guess_camera(recording: Recording) -> str:
    """Set the likeliest camera for the recording's image size; returns what to write."""
    width = recording.width
    height = recording.height
    names = of_size(width, height)
    focal = preset(names[0], width, height).fx if names else round(_USUAL_FOCAL * width, 1)
    like = f"those of a {names[0]}" if names else "those of many a depth camera"
    cx = (width - 1) / 2
    cy = (height - 1) / 2
    recording.camera = replace(
        recording.camera, fx=focal, fy=focal, cx=cx, cy=cy, source="assumed: not stated"
    )
    choice = f"say --set camera.preset={'|'.join(names)}, or " if names else ""
    return (
        f"the camera is not known, so all lengths here are guesses with {like}; {choice}write "
        f"camera.toml with the lines [camera], fx = {focal:g}, fy = {focal:g}, cx = {cx:g}, "
        f"cy = {cy:g} (your camera's numbers, in pixels) and unit_mm = 1.0 (millimetres per stored "
        "step)"
    )


def next_command(
    path: str | Path,
    proposal: Proposal,
    missing: list[str],
    n_arenas: int = 0,
    plan: str | None = None,
    options: Sequence[str] = (),
) -> str:
    """The command to run next; empty if no plan was searched for.

    Args:
        path: the recording.
        proposal: which plan fits.
        missing: facts that the files lack, to be written first.
        n_arenas: arenas found in the image, each a session of its own.
        plan: the given plan, as typed; None if none was given.
        options: further given options that a run accepts too.
    """
    if not proposal.says:
        return ""
    where = shlex.quote(str(path))
    if missing or proposal.plan is None:
        given = shlex.join([*(["--plan", plan] if plan else []), *options])
        again = f"liex doctor {where} {given}".rstrip()
        if missing:
            return f"write what is missing, then {again}"
        return f"{again} again, once what is said above is corrected"
    named = plan if plan and proposal.is_given else proposal.plan
    chosen = ["--plan", named] if plan or named != USUAL else []
    several = ["--set", "arenas=auto"] if n_arenas > 1 else []
    return shlex.join(["liex", "run", str(path), *chosen, *several, *options])


_TEXT = read_toml(Path(__file__).with_name("doctor.toml"))
FINDINGS: Final[dict[str, str]] = _TEXT["findings"]  # key of the JSON: its meaning
# sampled frames, spread over the recording; as many as a run learns its scene from
_N_SAMPLED = 96
_N_RAW = 16
# frames compared with their predecessors, and the length of a window in a longer recording
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
    """The findings of a recording: the keys of `FINDINGS`, in JSON's types.

    A recording that is cut short is inspected as far as it can be read. Missing camera or times are
    guessed, and the report lists the lines that state them.

    Args:
        path: a file, folder or address of a recording.
        plan: camera, water surface, expected sizes; None uses the default plan.
        fps: frame rate of recordings without stamps, before the plan's.
        topic: depth topic of a message log, before the plan's.
        propose: check which bundled plan fits, which needs their models: the given or the usual one
            first, others only if it does not fit.
        named: whether the user named the plan; if so, the report states when it does not fit.
        typed: the plan as typed, None if absent, and further options for the run.
        progress: called while an archive is unpacked or an index made.

    Raises:
        RecordingError: the recording cannot be opened at all.
    """
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
    """Size of a session on disk, MB; None if no animal is found."""
    if length_mm is None or distance_mm is None:
        return None
    return round(session_bytes(seen, plan, length_mm, distance_mm) / 1e6, 1)


def _several(seen: Recording, plan: Plan, misplaced: list[str]) -> list[SeveralArenas]:
    """Several arenas in an image, listed or proposed; errors in listed ones go to `misplaced`."""
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
    """The plan with the command line's settings; a recording that is cut short is accepted."""
    settings = ["recording.accept_truncated=true"]
    settings += [f"recording.fps={fps!r}"] if fps is not None else []
    settings += [f"recording.topic={topic}"] if topic is not None else []
    return plan.with_settings(settings)


def _copies_told(recording: Recording, sample: NDArray[np.float32]) -> list[str]:
    """Sentences on frames that repeat the depth image before them.

    A long recording is compared in windows spread over it.
    """
    if recording.format == "synthetic":  # rendered on demand
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
    found = repeat_messages(times_ns, repeats, has_noise(sample))
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
    """The gaps in which the camera dropped frames while its clock continued."""
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
            f"the camera dropped about {missing} frames ({share:.1%}) in {places}; the longest "
            f"time between two frames is {longest_s:.2f} s; no speed or distance is measured "
            "across a gap, but if there are many, record to a faster disk or with fewer cameras on "
            "one USB controller"
        )
    if len(recording) == 1:
        found.append("a single frame has no rate and no duration; give the whole recording")
    return found


class _Depths:
    """Depth statistics of the sampled frames, one frame at a time to bound memory."""

    def __init__(self, frames: NDArray[np.float32]) -> None:
        """Frames (n, H, W) mm as recorded."""
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
        """Sentences about missing or implausible depths."""
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
    """The number, or None if JSON cannot represent it."""
    return float(value) if math.isfinite(value) else None


# Findings of `liex doctor` as lines of text.


# lines that determine whether a run makes sense
_FIRST = ("frames", "rate", "gaps", "intrinsics from", "floor", "arena", "animal", "plan")


def print_report(findings: dict[str, Any], verbose: bool = True) -> None:
    """Print the findings of `examine` on one screen, and the problems below.

    If not `verbose`, only lines that determine whether a run makes sense.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, pad_edge=False)
    for name, value in lines(findings):
        if verbose or name in _FIRST:
            table.add_row(name, Text(printable(value)))
    console = Console()
    console.print(table)
    if not findings["problems"] and not findings["missing"]:
        console.print("no problems found", style="green")
    for problem in (*findings["missing"], *findings["problems"]):
        console.print(Text(printable(f"- {problem}"), style="yellow"), soft_wrap=True)
    if findings["arenas"]:
        told = "several arenas are seen; lines for a plan, with subject_id and group to be added:"
        console.print(Text(told), soft_wrap=True)
        for line in findings["arenas"]:
            console.print(Text(line), soft_wrap=True)
    if findings["next"]:
        console.print(Text(printable(f"next: {findings['next']}")), soft_wrap=True)


def lines(findings: dict[str, Any]) -> list[tuple[str, str]]:
    """The findings of `examine` as (name, text), in the order in which they are printed."""
    from jinja2 import Environment

    environment = Environment()  # nosec B701: plain text for a terminal
    environment.filters |= {"unit": _in_unit, "megabytes": megabytes}
    scene = findings["scene"] or {}
    fixtures = [Fixture.from_dict(one) for one in scene.get("fixtures", [])]
    values = findings | {
        "shape": findings["arena"] and Arena.from_dict(findings["arena"]),
        "fixtures": fixtures,
        "passing": [one for one in fixtures if (one.since_s, one.until_s) != (None, None)],
        "sensor": "" if scene.get("sensor") is None else SensorCard.from_dict(scene["sensor"]),
    }
    texts = {
        name: " ".join(environment.from_string(template).render(values).split())
        for name, template in _TEXT["lines"].items()
    }
    return [(name, text) for name, text in texts.items() if text]


def _in_unit(value: float | None, unit: str, digits: int = 0) -> str:
    return "unknown" if value is None else f"{value:.{digits}f} {unit}"
