"""`liex doctor`: the facts of a recording, and what is wrong with it."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from liex_lab.pipelines import choice
from liex_lab.pipelines.build import open_planned
from liex_lab.pipelines.choice import PlanFit, Proposal, propose_plan
from liex_lab.pipelines.doctor import (
    FINDINGS,
    _preset_problems,
    examine,
    lines,
    next_command,
    open_anyhow,
    print_report,
)

from liex_lab.errors import LiexError, RecordingError
from liex_lab.optics.camera import (
    PRESETS,
    Camera,
    Distortion,
    Water,
    of_size,
    preset,
    unusual_centre,
    unusual_lens,
)
from liex_lab.plan import Plan
from liex_lab.plan.sections import CameraName
from liex_lab.scene.floor import Floor
from tests.oracles.plate import Plate, bent_down
from tests.oracles.refraction import seen
from tests.pipelines.test_choice import FISH, GOOD, RECORDING
from tests.recordings.oni_files import depth_builder
from tests.recordings.ros_writers import write_bag
from tests.recordings.writers import (
    Frames,
    cut,
    depth_frames,
    even_times,
    write_camera,
    write_mcap,
    write_moseq_folder,
    write_oni_file,
    write_png_folder,
)

KEYS = [
    "format",
    "n_frames",
    "duration_s",
    "rate_hz",
    "label_hz",
    "jitter_ms",
    "n_gaps",
    "n_missing",
    "n_time_faults",
    "width",
    "height",
    "fx",
    "fy",
    "cx",
    "cy",
    "intrinsics_source",
    "distortion",
    "water",
    "depth_min_mm",
    "depth_max_mm",
    "unread_share",
    "floor_unread_share",
    "noise_mm",
    "floor_mm",
    "floor_tilt_rad",
    "water_depth_mm",
    "arena",
    "scene",
    "animal_length_mm",
    "animal_area_mm2",
    "animal_share",
    "animal_sits_still",
    "session_mb",
    "arenas",
    "plan",
    "plan_says",
    "n_animals",
    "missing",
    "problems",
    "next",
]
CAMERA = Camera(140.0, 141.0, 79.5, 59.5, 160, 120)


def frames(n: int = 12, floor_mm: int = 700) -> Frames:
    return depth_frames(n, 160, 120, floor_mm=floor_mm)


def examined(path: Path, *settings: str) -> dict[str, Any]:
    """The findings, which JSON must be able to hold as they are."""
    findings = examine(path, Plan().with_settings(settings))
    assert list(findings) == KEYS == list(FINDINGS)
    assert json.loads(json.dumps(findings, allow_nan=False)) == findings
    assert all("\n" not in problem for problem in findings["problems"])
    return findings


def problems(path: Path, *settings: str) -> str:
    return " | ".join(examined(path, *settings)["problems"])


def plates(
    folder: Path,
    plates: list[Plate],
    water: Water | None = None,
    camera: Camera = CAMERA,
    **more: Any,
) -> Path:
    """A recording of a square plate that goes from place to place, with a little noise."""
    rng = np.random.default_rng(0)
    pictures = [
        plate.depth(camera, water) + rng.normal(0, 0.7, (camera.height, camera.width))
        for plate in plates
    ]
    return write_png_folder(folder, np.rint(pictures).astype(np.uint16), camera, **more)


def walk(side_mm: float = 60.0, floor_mm: float = 600.0, n: int = 20) -> list[Plate]:
    return [Plate(floor_mm, side_mm, 25.0, (9.0 * k - 90.0, 40.0 * np.sin(k))) for k in range(n)]


def test_a_sound_recording_has_its_facts_told_and_no_problem(tmp_path: Path) -> None:
    findings = examined(write_mcap(tmp_path / "r.mcap", frames(), CAMERA))
    assert (
        findings["format"],
        findings["n_frames"],
        findings["n_gaps"],
        findings["n_missing"],
    ) == ("mcap", 12, 0, 0)
    assert (findings["width"], findings["height"], findings["fx"], findings["cy"]) == (
        160,
        120,
        140.0,
        59.5,
    )
    assert findings["rate_hz"] == pytest.approx(30, rel=1e-4)
    assert findings["duration_s"] == pytest.approx(11 / 30, rel=1e-4)
    assert findings["jitter_ms"] == pytest.approx(0, abs=1e-3)
    assert (findings["depth_min_mm"], findings["depth_max_mm"]) == (669.0, 701.0)
    assert findings["unread_share"] == pytest.approx(0.03, abs=0.005)
    assert findings["floor_mm"] == pytest.approx(700, abs=1)
    assert findings["floor_tilt_rad"] == pytest.approx(0, abs=0.01)
    assert findings["intrinsics_source"] == "CameraCalibration on /camera/calibration"
    assert (findings["distortion"], findings["water"], findings["water_depth_mm"]) == (
        None,
        None,
        None,
    )
    assert findings["arena"]["kind"] == "open"
    assert findings["problems"] == []


def test_the_animal_is_measured_without_a_model(tmp_path: Path) -> None:
    findings = examined(plates(tmp_path / "r", walk(60.0)))
    assert findings["animal_length_mm"] == pytest.approx(4 * 60 / np.sqrt(12), rel=0.03)
    assert findings["animal_area_mm2"] == pytest.approx(3600, rel=0.1)
    assert findings["animal_share"] == 1.0
    assert findings["animal_sits_still"] is False
    assert findings["noise_mm"] == pytest.approx(0.7, abs=0.1)
    assert findings["floor_unread_share"] == 0.0
    assert findings["problems"] == []


def images(stored: Frames | None = None, **more: Any) -> Callable[[Path], Path]:
    return lambda folder: write_png_folder(folder, frames() if stored is None else stored, **more)


def moseq(stored: Frames, without: str = "", cut_to: float = 1.0) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        write_moseq_folder(folder, stored)
        if without:
            (folder / without).unlink()
        if cut_to < 1.0:
            write_camera(folder, CAMERA)
            cut(folder / "depth.dat", cut_to)
        return folder

    return write


def times(n: int = 30, shift_from: int = 0, by_ns: int = 0) -> list[int]:
    found = even_times(n)
    return [t + by_ns * (k >= shift_from) for k, t in enumerate(found)]


def masked(where: Any, stored: Frames) -> Frames:
    stored[where] = 0
    return stored


RNG = np.random.default_rng(0)
SIDE = Floor.from_plane(np.array([np.sin(0.4), 0.0, np.cos(0.4)]), 600.0, CAMERA).depth(160, 120)
JITTER = np.array(times(20, 10, 100_000_000)) + RNG.integers(-3_000_000, 3_000_000, 20)
CLOCK = times(30, 15, 3600 * 10**9)
CLOCK[7] = CLOCK[6]
BENT = {"distortion": [-0.15, 0.02]}
LENS = replace(CAMERA, distortion=Distortion.of("plumb_bob", [-0.15, 0.02]))
NOISE = RNG.normal(0, 6.0, (40, 120, 160))
ROUGH = RNG.integers(400, 4000, (1, 120, 160)).repeat(4, axis=0)
LENGTH_MM = pytest.approx(4 * 60 / np.sqrt(12), rel=0.05)  # of a plate of 60 mm
# name: recording, settings of the plan, what the problems say (or do not, "not: "), facts
CASES: dict[str, tuple[Callable[[Path], Path], list[str], list[str], dict[str, Any]]] = {
    "a still animal": (
        lambda folder: plates(folder, walk(60.0)[:1] * 20),
        [],
        ["hardly leaves its place"],
        {"animal_sits_still": True, "animal_length_mm": LENGTH_MM},
    ),
    "focal lengths ten times too short": (
        lambda folder: plates(folder, walk(60.0)),
        ["camera.fx=14", "camera.fy=14.1"],
        ["what moves is about 6", "wrong by a factor of about 10", "--plan"],
        {},
    ),
    "an empty arena": (
        lambda folder: plates(folder, [Plate(600.0, 60.0, 0.0)] * 12),
        [],
        ["no animal was found"],
        {"animal_length_mm": None},
    ),
    "jitter and a gap": (
        images(frames(20), camera=CAMERA, times_ns=JITTER.tolist()),
        [],
        [],
        {"n_gaps": 1, "n_missing": 3, "jitter_ms": pytest.approx(2.4, rel=0.4)},
    ),
    "a clock that was set": (
        images(frames(30), camera=CAMERA, times_ns=CLOCK),
        [],
        ["1 of 30 are repeated or out of order", "in 1 places, the first before frame 15"],
        {"n_gaps": 0, "n_time_faults": 2},
    ),
    "dropped frames": (
        images(camera=CAMERA, times_ns=[*even_times(15)[:5], *even_times(15)[8:]]),
        [],
        ["dropped about 3 frames (20.0%) in 1 gap; the longest time between two frames is 0.13 s"],
        {"n_gaps": 1},
    ),
    "guesses": (
        moseq(depth_frames(3, 512, 424), without="depth_ts.txt"),
        [],
        ["typical Kinect v2", "30 frames/s was assumed"],
        {"intrinsics_source": "typical Kinect v2"},
    ),
    "a unit too small": (
        images(camera=CAMERA, unit_mm=0.001),
        [],
        ["the median depth is 0.7 mm", "unit_mm"],
        {},
    ),
    "a unit too large": (
        images(camera=CAMERA, unit_mm=100.0),
        [],
        ["the median depth is 7e+04 mm", "unit_mm"],
        {},
    ),
    "unread pixels beside the floor": (
        images(masked((slice(None), slice(60)), frames()), camera=CAMERA),
        [],
        ["not: unread"],
        {},
    ),
    "unread pixels on the floor": (
        images(masked(RNG.random((12, 120, 160)) < 0.3, frames()), camera=CAMERA),
        [],
        ["of the pixels on the floor are unread"],
        {},
    ),
    "a bent lens": (
        lambda folder: plates(folder, walk(), None, LENS, **BENT),
        [],
        [],
        {"floor_mm": pytest.approx(600, abs=1), "problems": []},
    ),
    "a tilted camera": (
        images(np.rint(SIDE)[None].repeat(6, axis=0).astype("u2"), camera=CAMERA),
        [],
        ["tilted by 23 degrees from the vertical"],
        {"floor_tilt_rad": pytest.approx(0.4, abs=0.01)},
    ),
    "a noisy camera": (
        images(np.rint(700 + NOISE).astype("u2"), camera=CAMERA),
        [],
        ["from frame to frame"],
        {"noise_mm": pytest.approx(6.0, rel=0.1)},
    ),
    "nothing": (
        images(np.zeros((3, 120, 160), np.uint16), camera=CAMERA),
        [],
        ["none of the 3 inspected frames"],
        {"depth_min_mm": None, "depth_max_mm": None, "floor_mm": None},
    ),
    "empty frames": (
        images(masked(slice(None, None, 2), frames()), camera=CAMERA),
        [],
        ["6 of the 12 inspected frames have no depth", "not: of the pixels are unread"],
        {},
    ),
    "no floor": (images(ROUGH.astype("u2"), camera=CAMERA), [], ["no floor"], {"floor_mm": None}),
    "one frame": (
        images(frames(1), camera=CAMERA),
        [],
        ["single frame"],
        {"n_frames": 1, "rate_hz": None, "duration_s": 0.0},
    ),
    "a cut recording": (
        moseq(frames(), cut_to=0.55),
        [],
        ["ends in the middle of frame 6", "12 time stamps"],
        {"n_frames": 6},
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_facts_and_problems(case: str, tmp_path: Path) -> None:
    write, settings, says, facts = CASES[case]
    findings = examined(write(tmp_path / "r"), *settings)
    assert {name: findings[name] for name in facts} == facts
    problems = " | ".join(findings["problems"])
    for text in says:
        absent = text.startswith("not: ")
        assert (text.removeprefix("not: ") in problems) is not absent, text


def test_a_slip_in_the_zones_is_told(tmp_path: Path) -> None:
    (tmp_path / "zones.toml").write_text(
        '[[zones]]\nname = "a"\ncircle = { centre = [0, 0], radius = -1 }'
    )
    path = plates(tmp_path / "r", walk(60.0))
    assert "radius should be greater than 0, got -1" in problems(
        path, f"arena.zones={tmp_path / 'zones.toml'}"
    )
    assert "there is no file" in problems(path, "arena.zones=none.toml")


def test_a_primesense_recording_says_where_its_intrinsics_come_from(tmp_path: Path) -> None:
    findings = examined(write_oni_file(tmp_path / "r.oni", frames(), CAMERA))
    assert (findings["format"], findings["n_frames"], findings["problems"]) == ("oni", 12, [])
    assert findings["rate_hz"] == pytest.approx(30, rel=1e-4)
    assert findings["floor_mm"] == pytest.approx(700, abs=1)
    assert findings["intrinsics_source"] == "intrinsics in the .oni file (liexIntrinsics)"
    # as another program writes it
    payloads = [frame.tobytes() for frame in frames()]
    findings = examined(depth_builder(payloads, "NONE", 160, 120).write(tmp_path / "theirs.oni"))
    assert findings["intrinsics_source"] == "field of view in the .oni file (xnFOV)"
    assert findings["fx"] == pytest.approx(80 / np.tan(0.5))
    cut(tmp_path / "theirs.oni", 0.5)
    assert "cut or damaged" in problems(tmp_path / "theirs.oni")


def test_water_is_told_and_undone(tmp_path: Path) -> None:
    water = Water(400.0, 1.333)
    path = plates(tmp_path / "r", walk(), water)
    findings = examined(path, "water.height_mm=400")
    assert findings["water"] == water.to_dict()
    assert findings["water_depth_mm"] == pytest.approx(200, abs=2)
    assert findings["floor_mm"] == pytest.approx(600, abs=2)
    assert findings["fx"] == CAMERA.fx
    assert findings["problems"] == []
    assert "the floor is not below it" in problems(path, "water.height_mm=700")


@pytest.mark.nightly
def test_a_camera_tilted_against_the_water_is_told_how_to_say_so(tmp_path: Path) -> None:
    """A level tank under a tilted camera: the floor comes out tilted against the surface until the
    plan says it.
    """
    water = Water(400.0, 1.333, 0.1, -0.06)
    n = water.normal
    v, u = np.mgrid[0:120, 0:160].astype(float)
    start, way = bent_down(CAMERA.unproject(np.stack([u, v], -1), 1.0), water)
    floor = start + way * ((560.0 - start @ n) / (way @ n))[..., None]
    depth = seen(floor, n, 400.0, 1.333, "light_field", 0.01)[1]
    rng = np.random.default_rng(0)
    path = write_png_folder(
        tmp_path / "r", np.rint(depth + rng.normal(0, 0.5, (8, 120, 160))).astype(np.uint16), CAMERA
    )
    told = problems(path, "water.height_mm=400")
    x, y = re.findall(r"water\.tilt_[xy]_rad=(-?\d\.\d+)", told)
    assert float(x) == pytest.approx(0.1, abs=0.04)
    assert float(y) == pytest.approx(-0.06, abs=0.03)
    settings = ("water.height_mm=400", f"water.tilt_x_rad={x}", f"water.tilt_y_rad={y}")
    assert "against the water's surface" not in problems(path, *settings)


def test_what_cannot_be_opened_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="empty folder"):
        examine(tmp_path)


def test_the_report_names_everything_in_lines_that_can_be_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    findings = examine(write_png_folder(tmp_path / "r", frames(1), CAMERA))
    print_report(findings)
    printed = capsys.readouterr().out
    assert len(printed.splitlines()) < 24, "one screen"
    for name, value in lines(findings):
        assert name in printed
        assert value[:40] in printed
    assert "unknown" in printed  # the rate of a single frame
    assert "nan" not in printed.lower().split()
    assert "- a single frame has no rate" in printed
    print_report(findings | {"problems": []})
    assert "no problems found" in capsys.readouterr().out


def test_a_real_session(reference_data: Path) -> None:
    findings = examined(reference_data / "mouse_kinect2" / "session_20170125.tar.gz")
    assert (findings["n_frames"], findings["n_gaps"]) == (300, 3)
    assert findings["floor_mm"] == pytest.approx(673.5, abs=10)
    assert findings["arena"]["kind"] == "round"
    assert 40 < findings["animal_length_mm"] < 110
    assert (findings["animal_share"], findings["animal_sits_still"]) == (1.0, False)


def test_a_principal_point_at_the_edge_is_reported(tmp_path: Path) -> None:
    edge = replace(CAMERA, cx=159.5, cy=119.5)
    told = problems(write_png_folder(tmp_path / "r", frames(), edge))
    assert "the principal point (159.5, 119.5) is far" in told


@pytest.mark.parametrize("kind", ["16UC1", "32FC1"])
def test_the_unit_that_doctor_asks_for_is_used(tmp_path: Path, kind: str) -> None:
    """Depth in tenths of a millimetre, or floats in millimetres."""
    stored, unit_mm = (frames() * 25, 0.04) if kind == "16UC1" else (frames().astype("f4"), 1.0)
    path = write_bag(tmp_path / "r.bag", stored, camera=CAMERA, kind=kind)
    assert any("state the true unit_mm" in problem for problem in examined(path)["problems"])
    (tmp_path / "camera.toml").write_text(f"[camera]\nunit_mm = {unit_mm}\n")
    found = examined(path)
    assert not any("unit_mm" in problem for problem in found["problems"])
    assert found["depth_max_mm"] == pytest.approx(701.0, abs=0.01)


# Doctor refuses nothing that it can read: what is missing is guessed and told, and cameras have
# names.


def pictures(folder: Path, width: int = 512, height: int = 424, n: int = 6) -> Path:
    """A folder of pictures and nothing else."""
    write_png_folder(folder, depth_frames(n, width, height, floor_mm=700))
    for more in ("camera.toml", "timestamps.csv"):
        (folder / more).unlink(missing_ok=True)
    return folder


def test_pictures_alone_get_a_diagnosis_and_the_lines_to_write(tmp_path: Path) -> None:
    found = examine(pictures(tmp_path / "p"))
    camera, times = found["missing"]
    assert "the camera is not known" in camera
    assert "--set camera.preset=kinect-v2" in camera
    assert "fx = 365" in camera
    assert "fps = 30" in times
    assert found["intrinsics_source"] == "assumed: not stated"
    assert found["fx"] == 365.0
    assert found["floor_mm"] == pytest.approx(700, abs=2)


def test_a_picture_of_an_unusual_size_is_looked_at_with_a_usual_field_of_view(
    tmp_path: Path,
) -> None:
    recording, missing = open_anyhow(pictures(tmp_path / "p", 200, 150), Plan())
    with recording:
        assert recording.camera.fx == 180.0
        assert (recording.camera.cx, recording.camera.cy) == (99.5, 74.5)
    assert "preset" not in missing[0]


def test_a_run_still_refuses_what_a_diagnosis_guesses(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="the camera is not known"):
        open_planned(pictures(tmp_path / "p"), Plan())


def test_a_named_camera_makes_pictures_readable_and_its_size_is_checked(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "p")
    named = Plan().with_settings(["camera.preset=kinect-v2", "recording.fps=30.0"])
    with open_planned(folder, named) as recording:
        assert recording.camera.fx == 365.0
        assert recording.camera.source == "preset kinect-v2"
    with open_planned(folder, named.with_settings(["camera.fx=364.0"])) as recording:
        assert recording.camera.fx == 364.0, "what is stated goes before the preset"
    wrong = named.with_settings(["camera.preset=azure-nfov"])
    with pytest.raises(LiexError, match="640 x 576 or 320 x 288 px, but these have 512 x 424"):
        open_planned(folder, wrong)


def test_every_camera_that_a_plan_may_name_is_there_and_sees_as_wide_as_it_should() -> None:
    assert set(get_args(CameraName)) == set(PRESETS)
    for name, cameras in PRESETS.items():
        for camera in cameras:
            found = preset(name, camera.width, camera.height)
            assert replace(found, source=camera.source) == camera
            assert name in of_size(camera.width, camera.height)
            assert unusual_centre(camera) == ("", False)
            view = np.degrees(2 * np.arctan(camera.width / 2 / camera.fx))
            assert 20 < view < 95
            corner = camera.unproject([0.0, 0.0], 1000.0)
            np.testing.assert_allclose(camera.project(corner), [0.0, 0.0], atol=0.05)


def test_a_camera_that_has_no_preset_is_told() -> None:
    with pytest.raises(LiexError, match=r"camera\.preset is one of kinect-v2"):
        preset("kodak", 640, 480)


@pytest.mark.parametrize("factor", [1.3, 1 / 1.3])
def test_a_focal_length_that_no_known_camera_has_is_told(tmp_path: Path, factor: float) -> None:
    for name in ("kinect-v2", "primesense", "azure-nfov"):
        for camera in PRESETS[name]:
            for scale in (0.92, 1.0, 1.08):
                usual = replace(camera, fx=scale * camera.fx, fy=scale * camera.fy)
                assert not unusual_lens(usual)
            wrong = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
            assert f"{name} {camera.fx:.0f}" in unusual_lens(wrong)
    assert not unusual_lens(Camera(2000.0, 2000.0, 700.0, 500.0, 1400, 1000)), "not known at all"

    lens = {"fx": 365.0 * factor, "fy": 365.0 * factor, "cx": 255.5, "cy": 211.5}
    stated = [*(f"camera.{name}={value!r}" for name, value in lens.items()), "recording.fps=30.0"]
    found = examine(pictures(tmp_path / "p"), Plan().with_settings(stated))
    assert any("differs from all preset cameras" in one for one in found["problems"])


def test_doctor_proposes_the_plan_and_says_what_to_run_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    long = PlanFit("mouse", replace(GOOD, spine_mm=300.0), ("it is 300 mm long",))
    fits = {
        "mouse": long,
        "fish": PlanFit("fish", FISH),
        "hand": PlanFit("hand", None, ("no hand",)),
    }

    def try_plan(_: object, plan: Plan | str) -> PlanFit:
        return fits[plan if isinstance(plan, str) else plan.animal.name]

    monkeypatch.setattr(choice, "try_plan", try_plan)
    unnamed = propose_plan(RECORDING)
    assert (unnamed.plan, unnamed.problems) == ("fish", ())
    assert next_command("a b.mcap", unnamed, []) == "liex run 'a b.mcap' --plan fish"
    assert next_command("a.mcap", unnamed, ["x"]).startswith("write what is missing")
    named = propose_plan(RECORDING, Plan.load("mouse"))
    assert "it is 300 mm long; use --plan fish" in named.problems[0]
    fits["fish"] = PlanFit("fish", None, ("no fish",))
    none = propose_plan(RECORDING)
    assert none.plan is None
    assert none.summary == "none fits. mouse: it is 300 mm long. fish: no fish. hand: no hand"
    fits["mouse"] = PlanFit("mouse", replace(GOOD, n_animals=2))
    two = propose_plan(RECORDING)
    assert "2 animals are in view" in two.problems[0]
    assert next_command("a.mcap", two, []) == "liex run a.mcap"
    assert next_command("a.mcap", Proposal(None, ""), []) == ""


def test_the_next_command_keeps_the_plan_and_the_options_that_were_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fits = {"mouse": PlanFit("mouse", GOOD), "fish": PlanFit("fish", None, ("no fish",))}
    fits["hand"] = PlanFit("hand", None, ("no hand",))
    monkeypatch.setattr(
        choice,
        "try_plan",
        lambda _, plan: fits[plan if isinstance(plan, str) else plan.animal.name],
    )
    typed = ("my plans/plan.toml", ["--topic", "/depth", "--set", "recording.fps=30.0"])
    right = propose_plan(RECORDING, Plan.load("mouse"))
    assert next_command("a.mcap", right, [], 0, *typed) == (
        "liex run a.mcap --plan 'my plans/plan.toml' --topic /depth --set recording.fps=30.0"
    )
    assert next_command("a.mcap", right, [], 0, "mouse") == "liex run a.mcap --plan mouse"
    assert next_command("a.mcap", right, ["x"], 0, *typed) == (
        "write what is missing, then liex doctor a.mcap --plan 'my plans/plan.toml' --topic /depth "
        "--set recording.fps=30.0"
    )
    wrong = propose_plan(RECORDING, Plan.load("fish"))
    assert "use --plan mouse" in wrong.problems[0]
    assert next_command("a.mcap", wrong, [], 0, "fish") == "liex run a.mcap --plan mouse"
    fits["mouse"] = PlanFit("mouse", None, ("no mouse",))
    none = propose_plan(RECORDING, Plan.load("fish"))
    assert next_command("a.mcap", none, [], 0, "fish").startswith("liex doctor a.mcap --plan fish")


DEPTH = (
    "hand_kinect2",
    "depth_files/primesense_pcl",
    "depth_files/realsense_bag/single_depth_color_640x480.bag",
    "depth_files/xtion_open3d",
    "depth_files/other_formats",
    "depth_files/other_formats/NYU_depth.pgm",
    "depth_files/other_formats/SUN_depth.png",
    "depth_files/other_formats/TUM_depth.png",
    "mouse_kinect2/first_frame.png",
    "mouse_kinect2/background.png",
    "hand_nyu",
    "hand_nyu/depth_1_0000001.png",
)


@pytest.mark.nightly
@pytest.mark.parametrize("name", DEPTH)
def test_every_genuine_file_that_holds_depth_gets_a_diagnosis(
    reference_data: Path, name: str
) -> None:
    found = examine(reference_data / name)
    assert found["n_frames"] >= 1
    assert found["depth_max_mm"] is not None
    assert all("write" in sentence or "choose" in sentence for sentence in found["missing"])


@pytest.mark.parametrize(
    ("cx", "cy", "said", "at_edge"),
    [
        (159.5, 119.5, False, False),
        (97.0, 165.0, False, False),
        (95.0, 119.5, True, False),
        (159.5, 170.0, True, False),
        (319.5, 119.5, True, True),
        (159.5, -0.5, True, True),
        (600.0, 400.0, True, True),
    ],
)
def test_a_principal_point_far_from_the_middle_is_reported(
    cx: float, cy: float, said: bool, at_edge: bool
) -> None:
    sentence, edge = unusual_centre(Camera(287.9, 287.9, cx, cy, 320, 240))
    assert (f"({cx:.1f}, {cy:.1f})" in sentence, edge) == (said, at_edge)


# faults of known recorders


def test_a_rate_that_is_not_the_one_on_the_label_is_told(tmp_path: Path) -> None:
    for hz, label in ((30.14, 30), (30.0, None), (29.0, None)):
        stamps = [round(k * 1e9 / hz) for k in range(12)]
        found = examine(write_png_folder(tmp_path / f"{hz}", frames(), CAMERA, stamps))
        assert found["label_hz"] == label
        rate = dict(lines(found))["rate"]
        assert ("off by 16.8 s in an hour" in rate) == (label == 30)


def test_stamps_of_dropped_images_are_explained(tmp_path: Path) -> None:
    stamps = [f"{1000.0 + k * 33.3333:.4f}" for k in range(15)]
    folder = write_moseq_folder(
        tmp_path / "session", depth_frames(12, 512, 424, floor_mm=700), stamps
    )
    said = problems(folder)
    assert "12 frames but depth_ts.txt holds 15" in said
    assert "without one and keep its stamp, so times may be early by up to 3 frames" in said


@pytest.mark.parametrize(
    ("median_mm", "step_mm", "said"),
    [
        (420.0, 0.1, ""),
        (4200.0, 0.1, "reads 70 to 500 mm, in steps of 0.1 mm; the recorder wrote another unit"),
        (420.0, 1.0, "in steps of 1 mm, but a d405 delivers 0.1 mm"),
    ],
)
def test_depth_that_the_named_camera_does_not_deliver_is_told(
    median_mm: float, step_mm: float, said: str
) -> None:
    scene = {"sensor": {"step_mm": step_mm}}
    (camera, _) = PRESETS["d405"]
    found = _preset_problems("d405", camera, median_mm, scene)
    assert len(found) == bool(said)
    assert said in " | ".join(found)
    assert not _preset_problems(None, camera, median_mm, scene)
