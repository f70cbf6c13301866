"""`liex evaluate motion`: a real mouse's points beside the virtual mouse."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines.evaluation import motion
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError

MOUSE = Skeleton.load("mouse")
NAMES = ("TTI", "Trunk", "Spine", "Neck", "Nose")


def back(bend: float = 0.0, rise: float = 0.0, turn: float = 0.0, nod: float = 0.0) -> np.ndarray:
    """Five points, bones of 10 mm: the trunk bends and rises by so many degrees, the head turns."""
    points = [np.zeros(3)]
    bends = np.radians([0.0, 0.0, bend, bend + turn])
    rises = np.radians([rise, rise, rise, rise + nod])
    for azimuth, up in zip(bends, rises, strict=True):
        step = [np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)]
        points.append(points[-1] + 10.0 * np.array(step))
    return np.array(points)


def test_a_straight_animal_bends_nowhere_and_a_bent_one_by_what_it_was_bent() -> None:
    straight = motion.PointMotion(back()[None]).posture()
    assert all(
        straight[name] == pytest.approx(0.0, abs=1e-9) for name in straight if name != "stretch"
    )
    bent = motion.PointMotion(back(bend=30.0, turn=20.0)[None]).posture()
    # the middle of the second and third point lies on the first bone's line, half a bone before
    # the bend
    front = np.degrees(
        np.arctan2(10.0 * np.sin(np.radians(30.0)), 5.0 + 10.0 * np.cos(np.radians(30.0)))
    )
    assert bent["trunk_bend"][0] == pytest.approx(front)
    reared = motion.PointMotion(back(rise=40.0, nod=-25.0)[None]).posture()
    assert reared["pitch"][0] == pytest.approx(40.0)
    assert reared["head_pitch"][0] == pytest.approx(-25.0)
    assert reared["trunk_arch"][0] == pytest.approx(0.0, abs=1e-9)


def test_speeds_are_those_that_were_walked_and_stop_at_a_break() -> None:
    n, rate = 120, 60.0
    points = np.repeat(back()[None], n, axis=0)
    points[:, :, 0] += 40.0 * np.arange(n)[:, None] / rate  # one length a second
    points[60:] += 500.0  # a jump
    clips = np.arange(n) // 60
    change = motion.PointMotion(points, clips, rate).change()
    np.testing.assert_allclose(change["speed"], 1.0)
    assert len(change["speed"]) == n - 4
    np.testing.assert_allclose(change["turning"], 0.0, atol=1e-9)
    assert motion.PointMotion(points, clips, None).change() == {}


def test_a_lean_of_the_points_is_told_and_taken_off() -> None:
    rng = np.random.default_rng(1)
    bends = rng.normal(12.0, 6.0, 400)
    real = motion.PointMotion(np.stack([back(bend=b) for b in bends]))
    virtual = motion.PointMotion(np.stack([back(bend=b) for b in rng.normal(0.0, 6.0, 400)]))
    told = motion.motion_figures(real, {"drawn": virtual})
    assert told["lean_degrees"]["trunk_bend"] > 5.0
    bent, about = (told["quantiles"][f"trunk_bend{also}"] for also in ("", "_about_lean"))
    assert bent["real"][1] > 1.5 * bent["drawn"][1]
    assert about["real"][1] == pytest.approx(about["drawn"][1], rel=0.2)
    assert told["outside"]["drawn"]["trunk_bend"] > 0.02


def test_the_nearest_posture_may_be_a_mirror_image() -> None:
    left, right = (
        motion.PointMotion(np.stack([back(bend=s * 20.0, turn=s * 10.0)] * 2)) for s in (1.0, -1.0)
    )
    np.testing.assert_allclose(motion.nearest(left, right), 0.0, atol=1e-9)
    opposed = motion.PointMotion(np.stack([back(bend=20.0, turn=-60.0)] * 2))
    assert motion.nearest(left, opposed).min() > 10.0


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer virtual mice."""
    monkeypatch.setattr(motion, "_SEEDS", range(300, 302))
    monkeypatch.setattr(motion, "_PER_RECORDING", 30)
    monkeypatch.setattr(motion, "_N_POSTURES", 1600)


def own_mouse(path: Path, above: float = 0.4, **also: Any) -> Path:
    """The points of a virtual mouse, as a file of a real one."""
    pose, girth, shape = (part[:400] for part in motion._postures(MOUSE))
    points = motion.on_back(
        MOUSE, (pose, girth, shape), np.array([0.0, 0.3, 0.55, 0.7, 1.0]), above
    )
    feet = points[:, :1] - [0.0, 0.0, 9.0]
    np.savez(path, points_mm=np.concatenate([points, feet], axis=1), names=[*NAMES, "Foot"], **also)
    return path


@pytest.mark.usefixtures("few")
def test_a_mouse_that_is_drawn_like_the_virtual_one_is_like_it(tmp_path: Path) -> None:
    file, told = own_mouse(tmp_path / "mouse.npz"), tmp_path / "told.json"
    words = ["evaluate", "motion", "--reference", str(file), "--json", str(told)]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 0, result.output
    assert "trunk_bend" in result.output
    figures = json.loads(told.read_text())
    assert figures["above"] == pytest.approx(0.4, abs=0.06)
    for measure in ("trunk_bend", "head_turn", "pitch"):
        own, drawn = (figures["quantiles"][measure][whose] for whose in ("real", "training"))
        np.testing.assert_allclose(own, drawn, rtol=0.2, atol=2.0)
        assert figures["outside"]["training"][measure] < 0.03
    assert figures["nearest_degrees"]["training"][0] < 1.0
    assert "speed" not in figures["quantiles"]  # nobody said how fast the frames come


@pytest.mark.usefixtures("few")
def test_a_stated_rate_tells_speeds(tmp_path: Path) -> None:
    file = own_mouse(tmp_path / "mouse.npz", clip_frames=100)
    figures = motion.evaluate_motion(file, rate_hz=30.0)
    assert set(figures["quantiles"]["speed"]) == {"real", "walk"}


@pytest.mark.usefixtures("few")
def test_what_cannot_be_read_is_told(tmp_path: Path) -> None:
    file = own_mouse(tmp_path / "mouse.npz")
    for words, expected in (
        (["--up", "-z"], "mm below the other points"),
        (["--up", "w"], "up should be"),
        (["--points", "TTI,Nose"], "five points are needed"),
        (["--points", "TTI,Trunk,Spine,Neck,Snout"], "has no point Snout"),
    ):
        result = CliRunner().invoke(
            cli.app, ["evaluate", "motion", "--reference", str(file), *words]
        )
        assert isinstance(result.exception, LiexError)
        assert expected in str(result.exception)
    other = tmp_path / "other.npz"
    np.savez(other, x=np.zeros(3))
    for path in (other, tmp_path / "absent.npz", own_mouse(tmp_path / "m.npz", clip_frames=0)):
        with pytest.raises(LiexError, match=str(path)):
            motion.read_motion(path, NAMES, "z", None)


@pytest.mark.usefixtures("few")
def test_frames_without_a_point_are_left_out_and_are_a_break(tmp_path: Path) -> None:
    file = own_mouse(tmp_path / "mouse.npz")
    with np.load(file) as held:
        points = held["points_mm"]
        points[100:110, 2] = np.nan
        np.savez(file, points_mm=points, names=held["names"])
    read = motion.read_motion(file, NAMES, "z", 30.0)
    assert len(read.points_mm) == 390
    assert read.clips is not None
    assert (np.diff(read.clips) != 0).nonzero()[0].tolist() == [99]
    points[:360, 2] = np.nan
    np.savez(file, points_mm=points, names=[*NAMES, "Foot"])
    with pytest.raises(LiexError, match="40 frames have all five points"):
        motion.read_motion(file, NAMES, "z", None)


@pytest.mark.nightly
def test_postures_of_training_hold_those_of_a_real_mouse(reference_data: Path) -> None:
    file = reference_data / "mouse_motion_3d" / "mouse_motion_3d.npz"
    figures = motion.evaluate_motion(file, up="-y")
    outside = figures["outside"]["training"]
    for measure in ("trunk_bend", "trunk_arch", "head_turn", "head_pitch", "stretch"):
        assert outside[measure] < 0.02
    assert outside["pitch"] < 0.12  # this one goes with its neck lower than the virtual mouse does
    about = figures["quantiles"]["trunk_bend_about_lean"]
    assert about["training"][1] > about["real"][1]
    assert figures["nearest_degrees"]["training"][0] < 3.0
