"""Quality report of a recording, `liex doctor`: its contents, and problems that affect the results.

Checks time stamps (rate, jitter, gaps, faults), camera and lens, depth range and unread pixels; in
frames spread over the recording, floor, noise, arena, water and animal; and optionally which plan
fits, the only check that needs models. `FINDINGS` lists every number with its unit; problems are
sentences that state what to do.
"""

import math
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import (
    EstimationError,
    LiexError,
    PlanError,
    SeveralKindsError,
    UnknownCameraError,
    UnknownTimesError,
    printable,
)
from liex_lab.optics import camera
from liex_lab.plan import Plan, sections
from liex_lab.plan.plan import arena_lines
from liex_lab.recordings import rectify, timestamps
from liex_lab.recordings.frame import PLAUSIBLE_MM
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent
from liex_lab.runtime.text_files import read_toml
from liex_lab.scene import background_segmenter, learning, support_plane, zones
from liex_lab.scene.background import (
    has_noise,
    sample_frames,
    sampled,
    sampled_scene,
    stride_for,
)
from liex_lab.scene.floor import Floor, floor_patch
from liex_lab.scene.scene import Arena, Fixture, find_arena
from liex_lab.sessions.folder import megabytes
from liex_lab.tracking.curve import repeat_messages

from .build import (
    animal_of,
    arenas_of,
    build_water,
    build_zones,
    cut_out,
    open_planned,
    propose_arenas,
    region_of,
    session_bytes,
    stated_corners,
    stated_floor,
    target_of,
)
from .choice import USUAL, Proposal, propose_plan

_USUAL_HZ = 30.0


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
            guessed = guessed.with_settings(
                ["camera.fx=1.0", "camera.fy=1.0", "camera.cx=0.0", "camera.cy=0.0"]
            )
        except UnknownTimesError:
            missing.append(
                f"the images have no timestamps, and {_USUAL_HZ:g} frames/s were assumed "
                f"here; write fps = {_USUAL_HZ:g} (your camera's rate) under [camera] in "
                "camera.toml, or timestamps.csv with a line time_ns and then one time per image; "
                "cameras differ from the rate on their label (Femto Bolt 30.03 to 30.14 frames/s)"
            )
            guessed = guessed.with_settings([f"recording.fps={_USUAL_HZ}"])
        except SeveralKindsError as error:
            pattern = error.pattern
            missing.append(
                f"the folder holds images of several kinds, and {pattern} was inspected; choose "
                f'with the line pattern = "{pattern}" under [camera] in camera.toml'
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
    width, height = recording.width, recording.height
    names = camera.of_size(width, height)
    # of the image's width: depth cameras have a field of view of 55 to 65 degrees
    focal = camera.preset(names[0], width, height).fx if names else round(0.9 * width, 1)
    like = f"those of a {names[0]}" if names else "those of many a depth camera"
    cx, cy = (width - 1) / 2, (height - 1) / 2
    recording.camera = replace(
        recording.camera, fx=focal, fy=focal, cx=cx, cy=cy, source="assumed: not stated"
    )
    choice = f"use --set camera.preset={'|'.join(names)}, or " if names else ""
    return (
        f"the camera is not known, so all lengths here are guesses with {like}; {choice}write "
        f"camera.toml with the lines [camera], fx = {focal:g}, fy = {focal:g}, cx = {cx:g}, "
        f"cy = {cy:g} (your camera's numbers, in pixels) and unit_mm = 1.0 (millimetres per stored "
        "step); `liex record` stores the calibration in the camera with the recording"
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
    if not proposal.summary:
        return ""
    where = shlex.quote(str(path))
    if missing or proposal.plan is None:
        given = shlex.join([*(["--plan", plan] if plan else []), *options])
        again = f"liex doctor {where} {given}".rstrip()
        if missing:
            return f"write what is missing, then {again}"
        return f"{again} again, once the problems above are corrected"
    named = plan if plan and proposal.is_given else proposal.plan
    chosen = ["--plan", named] if plan or named != USUAL else []
    several = ["--set", "arenas=auto"] if n_arenas > 1 else []
    return shlex.join(["liex", "run", str(path), *chosen, *several, *options])


_TEXT = read_toml(Path(__file__).with_name("doctor.toml"))
FINDINGS: Final[dict[str, str]] = _TEXT["findings"]  # key of the JSON: its meaning
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

    Of a cut recording, all whole frames count. Missing camera or times are guessed and listed.

    Args:
        path: a file, folder or address of a recording.
        plan: camera, water surface, expected sizes; None uses the default plan.
        fps: frame rate of recordings without stamps, before the plan's.
        topic: depth topic of a message log, before the plan's.
        propose: check which bundled plan fits, which needs their models.
        named: whether the user named the plan; if so, the report states when it does not fit.
        typed: the plan as typed, None if absent, and further options for the run.
        progress: called while an archive is unpacked or an index made.
    """
    asked = plan if named else None
    stated = {"fps": fps, "topic": topic, "accept_truncated": "true"}
    settings = [f"recording.{key}={value}" for key, value in stated.items() if value is not None]
    plan = (plan or Plan()).with_settings(settings)
    water = build_water(plan)
    recording, missing = open_anyhow(path, plan, progress)
    with recording as opened:
        progress(0, None, "inspecting frames spread over the recording")
        ideal = rectify.rectified(opened, water)
        misplaced: list[str] = []
        try:
            ideal = cut_out(ideal, plan)
        except LiexError as error:
            misplaced.append(str(error))
            plan = plan.with_settings(["arena.region="])
        stride = stride_for(ideal, animal_of(plan).spine_min_mm)
        # sampled frames, spread over the recording; as many as a run learns its scene from
        sample = sample_frames(ideal, 96, stride)
        raw = sample if ideal is opened else sample_frames(opened, 16)
        facts, unlikely, median_mm = _depth_facts(raw)
        scene: list[str] = []
        arenas: list[sections.SeveralArenas] = []
        proposal = Proposal(None, "")
        if median_mm is not None:
            found, scene = scene_facts(ideal, plan, water, sample, stride)
            facts |= found
            if (length_mm := found.get("animal_length_mm")) is not None:
                needed = session_bytes(ideal, plan, length_mm, median_mm)
                facts["session_mb"] = round(needed / 1e6, 1)
            progress(0, None, "checking which plan fits")
            if propose or plan.arenas is not None:
                arenas = _several(ideal, plan, misplaced)
            if propose:
                regions = [stated_corners(ideal, plan, one.region) for one in arenas[:1]]
                first = ideal.masked(regions[0], lent=True) if regions else ideal
                proposal = propose_plan(first, asked)
        lens = opened.camera
        unusual = ("" if water else camera.unusual_lens(lens), camera.unusual_centre(lens)[0])
        problems = [
            *ideal.problems,
            *filter(None, [timestamps.unwritable_times(opened.times_ns)]),
            *filter(None, () if missing else unusual),
            *_time_problems(opened),
            *_repeated_images(opened, sample),
            *unlikely,
            *_preset_problems(plan.camera.preset, lens, median_mm, facts.get("scene")),
            *misplaced,
            *scene,
            *proposal.problems,
        ]
    n_arenas = len(arenas) if asked is None else 0
    facts |= {
        **_time_facts(opened),
        **{name: getattr(lens, name) for name in ("width", "height")},
        **{name: float(getattr(lens, name)) for name in ("fx", "fy", "cx", "cy")},
        "intrinsics_source": lens.source,
        "distortion": None if lens.distortion is None else lens.distortion.to_dict(),
        "water": None if water is None else water.to_dict(),
        "arenas": [line for one in arenas for line in arena_lines(one)],
        "plan": proposal.plan,
        "plan_says": proposal.summary,
        "n_animals": proposal.n_animals,
        "missing": missing,
        "problems": problems,
        "next": next_command(path, proposal, missing, n_arenas, *typed),
    }
    return {key: facts.get(key) for key in FINDINGS}


def _several(ideal: Recording, plan: Plan, misplaced: list[str]) -> list[sections.SeveralArenas]:
    """Several arenas in an image, listed or proposed; errors in listed ones go to `misplaced`."""
    try:
        if plan.arenas is None:
            return propose_arenas(ideal, plan)
        found = arenas_of(ideal, plan)
        corners = {one.name: stated_corners(ideal, plan, one.region) for one in found}
        zones.masks_apart(corners, ideal.width, ideal.height)
    except LiexError as error:
        if plan.arenas is not None:
            misplaced.append(str(error))
        return []
    return found


def _repeated_images(recording: Recording, sample: NDArray[np.float32]) -> list[str]:
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
    return [f"{sentence}{some}" for part in found for sentence in part]


def _preset_problems(
    name: str | None, lens: camera.Camera, median_mm: float | None, scene: dict[str, Any] | None
) -> list[str]:
    """Depths that the named camera does not deliver: in another unit, or cut to coarser steps."""
    size = (lens.width, lens.height)
    fitting = [
        mode
        for mode in camera.DEPTH_MODES
        if mode.name == name and (mode.camera.width, mode.camera.height) == size
    ]
    problems = []
    for mode in fitting:
        near, far = mode.range_mm or (0.0, math.inf)
        if median_mm is not None and not near / 2 <= median_mm <= 3 * far:
            problems.append(
                f"the median depth is {median_mm:.0f} mm, but a {name} reads {near:g} to {far:g} "
                f"mm, in steps of {mode.unit_mm:g} mm; the recorder wrote another unit, so state "
                "the true unit_mm (millimetres per stored step) in camera.toml"
            )
        step = ((scene or {}).get("sensor") or {}).get("step_mm")
        if step is not None and step > 3 * mode.unit_mm:
            problems.append(
                f"depth is in steps of {step:.2g} mm, but a {name} delivers {mode.unit_mm:g} mm: "
                "the recorder cut its depth to coarser steps, which puts it too near by up to one "
                "of them; keep the camera's own steps, as `liex record` does"
            )
    return problems


_LABELS_HZ: Final = (5, 6, 15, 25, 30, 60, 90)


def _label_hz(rate_hz: float) -> int | None:
    """The rate on a camera's label that its true rate differs from by 0.03 to 1 per cent."""
    near = min(_LABELS_HZ, key=lambda hz: abs(hz - rate_hz))
    return near if 3e-4 < abs(rate_hz / near - 1.0) < 1e-2 else None


def _time_facts(recording: Recording) -> dict[str, Any]:
    step = np.diff(recording.times_ns) / 1e6
    dropped = _dropped(recording)
    usual = step[
        timestamps.frames_apart(recording.times_ns, timestamps.median_step(recording.times_ns)) == 1
    ]
    return {
        "format": recording.format,
        "n_frames": len(recording),
        "duration_s": _finite(recording.duration_s),
        "rate_hz": _finite(recording.rate_hz),
        "label_hz": _label_hz(recording.rate_hz),
        "jitter_ms": float(usual.std()) if len(usual) > 1 else None,
        "n_gaps": len(dropped),
        "n_missing": sum(gap.n_frames_missing for gap in dropped),
        "n_time_faults": len(recording.faults) + len(recording.gaps) - len(dropped),
    }


def _dropped(recording: Recording) -> list[timestamps.Gap]:
    """The gaps in which the camera dropped frames while its clock continued."""
    return [gap for gap in recording.gaps if gap.reason == timestamps.DROPPED]


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


def _depth_facts(
    frames: NDArray[np.float32],
) -> tuple[dict[str, Any], list[str], float | None]:
    """Facts and problems of the readings of sampled frames (n, H, W) mm, and their median, mm."""
    readings = (frame[frame > 0] for frame in frames)
    known = np.array([(r.size, r.min(), r.max(), np.median(r)) for r in readings if r.size], float)
    if not len(known):
        return (
            {"unread_share": 1.0},
            [
                f"none of the {len(frames)} inspected frames has any depth; check the camera and "
                "unit_mm"
            ],
            None,
        )
    n_pixels = len(known) * frames[0].size
    facts = {
        "depth_min_mm": float(known[:, 1].min()),
        "depth_max_mm": float(known[:, 2].max()),
        "unread_share": float((n_pixels - known[:, 0].sum()) / n_pixels),
    }
    problems = []
    if n_empty := len(frames) - len(known):
        problems.append(
            f"{n_empty} of the {len(frames)} inspected frames have no depth at all; check the "
            "camera's cable and what covers its lens"
        )
    median_mm = float(np.median(known[:, 3]))
    if not PLAUSIBLE_MM[0] <= median_mm <= PLAUSIBLE_MM[1]:
        problems.append(
            f"the median depth is {median_mm:.4g} mm, which is implausible for an animal; the "
            "depths are probably not in mm, so state the true unit_mm (millimetres per stored "
            "step) in camera.toml"
        )
    return facts, problems, median_mm


def _finite(value: float) -> float | None:
    """The number, or None if JSON cannot represent it."""
    return float(value) if math.isfinite(value) else None


# The scene: floor, noise, arena, water and animal in the sampled frames.


_MUCH_UNREAD = 0.2  # share of the pixels on the floor


def scene_facts(
    ideal: Recording,
    plan: Plan,
    water: camera.Water | None,
    sample: NDArray[np.float32],
    stride: int,
) -> tuple[dict[str, Any], list[str]]:
    """Facts and problems of the still background and the animal; without a floor, no facts.

    The floor is a plane fitted to the learned background. The animal is found by background
    subtraction as in a run, or else among objects up to 20 times smaller or larger.

    Args:
        ideal: the recording, rectified.
        plan: expected sizes, thresholds, zones.
        water: the water surface; None if absent.
        sample: (n, H, W) float32 depth, mm, of every `stride`-th pixel.
        stride: image pixels per sample pixel, along an axis.
    """
    grid = ideal.camera.every(stride)
    try:
        region = region_of(ideal, plan)
        stated = stated_floor(ideal.camera, plan)
    except (PlanError, EstimationError) as error:
        return {}, [str(error)]
    if region is not None:
        region = region[::stride, ::stride]
        sample = sample * region
    scene = sampled_scene(sample, grid, target_of(plan))
    background = scene.background
    try:
        support = support_plane.find_support_plane(
            scene, None if stated is None else stated.for_camera(grid)
        )
    except EstimationError as error:
        return {}, [f"no floor: {error}"]
    if support.region is not None:
        background = np.where(support.region, background, np.float32(0))
    facts, problems = _floor_facts(ideal, plan, sample, background, support, grid)
    lift = None if water is None else water.lift_mm
    distance = support.floor.lens_distance_mm(lift)
    facts |= {"floor_mm": distance, "floor_tilt_rad": support.floor.tilt_rad}
    problems += support.floor.unusual(lift)
    if water is not None:
        deep, tilted = _water_depth(water, support.floor, distance)
        facts["water_depth_mm"] = deep
        problems += tilted
    found, doubts = _animal_facts(ideal, plan, sample, background, grid, stated, region)
    return facts | found, [*problems, *doubts]


def _animal_facts(
    ideal: Recording,
    plan: Plan,
    sample: NDArray[np.float32],
    background: NDArray[np.float32],
    grid: camera.Camera,
    stated: Floor | None,
    region: NDArray[np.bool_] | None,
) -> tuple[dict[str, Any], list[str]]:
    """The animal as a run would find it, or else an object of another size that moves.

    Args:
        ideal: the recording, rectified.
        plan: expected sizes and thresholds.
        sample: (n, H, W) depth, mm.
        background: (H, W) depth, mm, 0 outside the region.
        grid: camera of the sample.
        stated: the floor that the plan states.
        region: (H, W) pixels of the plan's region.
    """
    animal = animal_of(plan)
    sizes = (animal.spine_min_mm, animal.spine_max_mm)
    min_height_mm = plan.foreground.min_height_mm
    view = Skeleton.load(animal.skeleton).view
    memory = Recording(
        name=ideal.name,
        format="sample",
        camera=grid,
        times_ns=ideal.times_ns[sampled(len(ideal), len(sample))],
        read=lambda k: sample[k],
    )
    missing = ""
    # sizes outside the plan's range are searched down to and up to this factor
    for wider in (1.0, 20.0):
        within = (sizes[0] / wider, sizes[1] * wider)
        try:
            scene, frames = learning.learn_scene(
                memory, within, len(sample), min_height_mm, view, stated, region
            )
        except EstimationError as error:
            missing = missing or str(error)
            continue
        if wider != 1.0 and scene.support_plane is not None and not scene.support_plane.moves:
            continue  # a still object of another size is not an animal
        crops = scene.extract(frames, 1.0)
        length = 4.0 * float(np.median(crops.blobs.sd_along[crops.found]))
        if wider == 1.0:
            share = float(crops.found.mean())
            facts, doubts = _size_facts(scene, background, length, share, min_height_mm)
            return facts | {"scene": scene.described().to_dict()}, [*scene.doubts, *doubts]
        factor = length / math.sqrt(sizes[0] * sizes[1])
        missing = (
            f"what moves is about {length:.0f} mm long, but the plan expects an animal with a "
            f"spine of {sizes[0]:g} to {sizes[1]:g} mm; if the animal is of that size, the "
            f"millimetres are wrong by a factor of about {factor:.2g} (check unit_mm and the focal "
            "lengths), else set animal.spine_min_mm and animal.spine_max_mm or name another --plan"
        )
    return {}, [missing]


def _floor_facts(
    ideal: Recording,
    plan: Plan,
    sample: NDArray[np.float32],
    background: NDArray[np.float32],
    support: support_plane.SupportPlane,
    grid: camera.Camera,
) -> tuple[dict[str, Any], list[str]]:
    """Noise and unread pixels on the floor, the arena's outline, and errors in the zones."""
    problems = [support.doubt] if support.doubt else []
    floor = support.floor
    noise = _noise(sample, floor_patch(background, floor.depth(grid.width, grid.height)))
    read = [frame[support.on_floor] > 0 for frame in sample if frame.any()]
    unread = 1.0 - float(np.mean(read))
    arena = find_arena(background, floor, grid)
    whole = floor.for_camera(ideal.camera)
    try:
        for zone in build_zones(plan):
            zone.placed(ideal.camera, whole, arena)
    except PlanError as error:
        problems.append(str(error))
    if unread > _MUCH_UNREAD:
        problems.append(
            f"{unread:.0%} of the pixels on the floor are unread, more than {_MUCH_UNREAD:.0%}; "
            "check the camera's range, sunlight, and surfaces that shine or swallow infrared light"
        )
    least = plan.foreground.min_height_mm
    # of the height from which a pixel counts as the animal
    if noise is not None and noise > 0.5 * least:
        problems.append(
            f"the floor's depth varies by {noise:.1f} mm from frame to frame, and a pixel counts "
            f"as the animal from {least:g} mm above it; bring the camera nearer, keep sunlight "
            "out, or raise foreground.min_height_mm"
        )
    return {"noise_mm": noise, "floor_unread_share": unread, "arena": arena.to_dict()}, problems


def _water_depth(water: camera.Water, floor: Floor, distance_mm: float) -> tuple[float, list[str]]:
    """Depth of the water below the lens, mm, and whether its surface contradicts the floor."""
    cosine = float(floor.normal @ water.normal)
    deep = distance_mm / cosine - water.height_mm
    if deep <= 0:
        return deep, [
            f"the plan puts the water's surface {water.height_mm:.0f} mm below the lens, but the "
            "floor is not below it; measure water.height_mm again, or leave it out if there is no "
            "water"
        ]
    angle = math.acos(min(1.0, cosine))
    # largest angle between a tank's floor and its water surface
    if angle <= math.radians(3.0):
        return deep, []
    tilts = np.arctan2(-floor.normal[:2], floor.normal[2])
    return deep, [
        f"the floor is tilted by {math.degrees(angle):.1f} degrees against the water's surface; if "
        f"the tank's floor is level, the camera is tilted: set water.tilt_x_rad={tilts[0]:.3f} and "
        f"water.tilt_y_rad={tilts[1]:.3f}, and run `liex doctor` again"
    ]


def _size_facts(
    scene: background_segmenter.BackgroundSubtraction,
    background: NDArray[np.float32],
    length: float,
    share: float,
    min_height_mm: float,
) -> tuple[dict[str, Any], list[str]]:
    """The animal's size, and how often and where it is found."""
    raised = scene.background - background[:: scene.stride, :: scene.stride]
    covered = scene.on_floor & (raised > min_height_mm) & (raised < scene.background)
    area = (scene.background[covered].astype(float) ** 2).sum() / (scene.grid.fx * scene.grid.fy)
    still = bool(area > 0.4 * scene.area_mm2)  # so much of the animal was in the background
    problems = []
    if still:
        problems.append(
            "the animal hardly leaves its place, so that it is a part of the background; it was "
            "separated from the bare floor instead, so check its outline in the replay, or add "
            "some seconds of the empty arena"
        )
    if share < 0.8:
        problems.append(
            f"the animal was found in only {share:.0%} of the inspected frames; cut off the time "
            "before it came and after it left, and check that the whole arena is in view"
        )
    return {
        "animal_length_mm": length,
        "animal_area_mm2": scene.area_mm2,
        "animal_share": share,
        "animal_sits_still": still,
    }, problems


def _noise(sample: NDArray[np.float32], where: NDArray[np.bool_]) -> float | None:
    """Standard deviation, mm, of pixels over the sample (n, H, W) mm; None if unknown.

    Two thirds of the differences are below one standard deviation of theirs, whatever moves through
    the remaining third.
    """
    changes = [
        np.abs(after - before)[(before > 0) & (after > 0)]
        for before, after in zip(sample[:-1:4, where], sample[1::4, where], strict=False)
    ]
    known = np.concatenate(changes) if changes else np.empty(0)
    return float(np.percentile(known, 68.3)) / math.sqrt(2.0) if len(known) else None


# Findings of `liex doctor` as lines of text.


def print_report(findings: dict[str, Any], verbose: bool = True) -> None:
    """Print the findings of `examine` on one screen, and the problems below.

    If not `verbose`, only lines that determine whether a run makes sense.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, pad_edge=False)
    for name, value in lines(findings):
        # lines that determine whether a run makes sense
        if verbose or name in (
            "frames",
            "rate",
            "gaps",
            "intrinsics from",
            "floor",
            "arena",
            "animal",
            "plan",
        ):
            table.add_row(name, Text(printable(value)))
    console = Console()
    console.print(table)
    if not findings["problems"] and not findings["missing"]:
        console.print("no problems found", style="green")
    for problem in (*findings["missing"], *findings["problems"]):
        console.print(Text(printable(f"- {problem}"), style="yellow"), soft_wrap=True)
    several = "several arenas are found; lines for a plan, with subject_id and group to be added:"
    arenas = [several, *findings["arenas"]] if findings["arenas"] else []
    next_line = [printable(f"next: {findings['next']}")] if findings["next"] else []
    for line in (*arenas, *next_line):
        console.print(Text(line), soft_wrap=True)


def lines(findings: dict[str, Any]) -> list[tuple[str, str]]:
    """The findings of `examine` as (name, text), in the order in which they are printed."""
    from jinja2 import Environment

    environment = Environment()  # nosec B701: plain text for a terminal
    environment.filters |= {
        "unit": lambda value, unit, digits=0: (
            "unknown" if value is None else f"{value:.{digits}f} {unit}"
        ),
        "megabytes": megabytes,
    }
    scene = findings["scene"] or {}
    fixtures = [Fixture.from_dict(one) for one in scene.get("fixtures", [])]
    values = findings | {
        "shape": findings["arena"] and Arena.from_dict(findings["arena"]),
        "fixtures": fixtures,
        "passing": [one for one in fixtures if (one.since_s, one.until_s) != (None, None)],
        "sensor": ""
        if scene.get("sensor") is None
        else camera.SensorCard.from_dict(scene["sensor"]),
    }
    texts = {
        name: " ".join(environment.from_string(template).render(values).split())
        for name, template in _TEXT["lines"].items()
    }
    return [(name, text) for name, text in texts.items() if text]
