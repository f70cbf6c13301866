"""`liex evaluate pose --split foreign`: known errors are found, and a truth that does not fit its
recording is refused in one sentence.
"""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines.convert import convert
from liex_lab.pipelines.evaluation import foreign
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.evaluation.scores import MeasuredIndividual
from liex_lab.optics.camera import Camera
from liex_lab.plan import Plan
from tests.conftest import ABSENT, REFERENCE_DATA

MOUSE = Skeleton.load("mouse")
SHARES = MOUSE.reach / MOUSE.length
CAMERA = Camera(365.0, 365.0, 256.0, 212.0, 512, 424)
N, LENGTH_MM = 40, 65.0
FOREIGN = REFERENCE_DATA / "foreign"


def arrays(n_joints: int = 9) -> dict[str, Any]:
    """The truth of a straight body that turns around, 20 mm thick, its joints near the belly."""
    yaw = np.linspace(0.0, 3.0, N)[:, None]
    s = np.linspace(-0.5, 0.5, n_joints) * LENGTH_MM
    joints = np.stack([s * np.cos(yaw), s * np.sin(yaw), np.full((N, n_joints), 640.0)], axis=-1)
    shape = joints.shape[:2]
    return {
        "joints": joints,
        "surface_mm": np.full(shape, 623.0),
        "thickness_mm": np.full(shape, 20.0),
    }


class Recorded:
    """What `truth_of` uses of a recording."""

    camera = CAMERA

    def __init__(self, n: int = N) -> None:
        self.n = n

    def __len__(self) -> int:
        return self.n


def truth(**changed: np.ndarray):
    return foreign.truth_of(arrays() | changed, "a_truth.npz", Recorded(), SHARES)


def measured(across: float = 0.0, along: float = 0.0, deep: float = 0.0) -> MeasuredIndividual:
    """Our poses, off by known distances."""
    true = truth().joints_camera
    way = (true[:, -1] - true[:, 0])[:, None, :2] / LENGTH_MM
    joints = true + np.array([0.0, 0.0, deep])
    joints[..., :2] += along * way + across * np.stack([way[..., 1], -way[..., 0]], axis=-1)
    joints += np.random.default_rng(0).normal(0.0, 1e-3, joints.shape)
    sd = np.full(joints.shape, 1.0)
    return MeasuredIndividual(joints, np.ones(N, np.bool_), sd, np.full(N, 3.0))


def test_the_curve_is_resampled_at_our_joints_in_the_middle_of_the_body():
    found = truth()
    assert found.spine_mm == pytest.approx(LENGTH_MM)
    np.testing.assert_allclose(found.joints_camera[..., 2], 633.0)
    arc = np.linalg.norm(np.diff(found.joints_camera[..., :2], axis=1), axis=-1)
    np.testing.assert_allclose(np.cumsum(arc, axis=1), LENGTH_MM * SHARES[1:][None].repeat(N, 0))
    coarse = foreign.truth_of(arrays(2), "b", Recorded(), SHARES)
    np.testing.assert_allclose(coarse.joints_camera, found.joints_camera)


def test_errors_across_along_and_in_depth_are_found_apart():
    figures = foreign.body_figures(truth(), measured(2.0, -5.0, 4.0), MOUSE)
    assert figures["across_mm"] == pytest.approx(2.0, abs=0.01)
    assert figures["depth_mm"] == pytest.approx(4.0, abs=0.01)
    assert figures["depth_bias_mm"] == pytest.approx(4.0, abs=0.01)
    assert figures["along_mm"] == pytest.approx(0.0, abs=0.01)
    assert list(figures["along_constant_mm"]) == list(MOUSE.names)
    assert figures["along_constant_mm"]["nose"] == pytest.approx(-5.0, abs=0.01)
    assert figures["error_mm"] == pytest.approx(np.hypot(2.0, 4.0), abs=0.01)
    assert figures["expected_over_true"] == pytest.approx(3.0 / np.hypot(2.0, 4.0), abs=0.01)
    assert figures["size_percent"] == pytest.approx(0.0, abs=0.1)
    assert (figures["interval90_z"], figures["flips"]) == (0.0, 0.0)
    assert (figures["found"], figures["trusted"], figures["trusted_and_wrong"]) == (1.0, 1.0, 0.0)


def test_intervals_are_of_the_arenas_axes():
    one = measured(deep=4.0)
    turned = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    figures = foreign.body_figures(truth(), replace(one, R_arena_camera=turned), MOUSE)
    assert [figures[f"interval90_{axis}"] for axis in "xyz"] == [0.0, 1.0, 1.0]


def test_exchanged_ends_do_not_shift_the_constant_and_are_wrong_where_trusted():
    one = measured(along=2.0)
    one.joints_camera[:10] = one.joints_camera[:10, ::-1]
    one.trusted[5:] = False
    figures = foreign.body_figures(truth(), one, MOUSE)
    assert figures["flips"] == pytest.approx(10 / N)
    assert figures["along_constant_mm"]["nose"] == pytest.approx(2.0, abs=0.01)
    assert (figures["trusted"], figures["trusted_and_wrong"]) == (5 / N, 1.0)


def test_hidden_frames_and_joints_without_a_surface_count_for_nothing():
    surface = arrays()["surface_mm"]
    surface[:, -2:] = np.nan
    visible = np.where(np.arange(N) < 8, 0.1, 1.0)
    one = measured(across=1.0)
    one.joints_camera[:8] += 300.0
    one.trusted[:8] = False
    figures = foreign.body_figures(truth(surface_mm=surface, visible_fraction=visible), one, MOUSE)
    assert figures["error_mm"] == pytest.approx(1.0, abs=0.01)
    assert figures["trusted_and_wrong"] == 0.0


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"joints": np.zeros((N, 9))}, r"frames x joints x \(x, y, z\).*got \(40, 9\)"),
        ({"joints": np.zeros((N, 1, 3))}, "at least two joints"),
        ({name: one[:-1] for name, one in arrays().items()}, "39 frames and its recording 40"),
        ({"thickness_mm": np.zeros((N, 5))}, r"\(40, 9\), got \(40, 9\) and \(40, 5\)"),
        ({"surface_mm": np.full((N, 9), np.nan)}, "no joint has finite"),
        ({"joints": arrays()["joints"] + [900.0, 0.0, 0.0]}, "outside the view"),
        ({"surface_mm": arrays()["surface_mm"] - 600.0}, "more than a body length"),
    ],
)
def test_a_truth_that_does_not_fit_its_recording_is_refused(changed, expected):
    with pytest.raises(LiexError, match=expected) as error:
        truth(**changed)
    assert "\n" not in str(error.value)
    assert "a_truth.npz" in str(error.value)


def test_a_missing_array_is_named():
    some = {name: one for name, one in arrays().items() if name == "joints"}
    with pytest.raises(LiexError, match="lacks the array surface_mm, thickness_mm"):
        foreign.truth_of(some, "a_truth.npz", Recorded(), SHARES)


# folders of recordings


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings with truths beside them, one of these of two animals."""
    folder = tmp_path_factory.mktemp("given")
    convert("synthetic:walk?frames=3&sensor=primesense-qvga", folder / "b1.mcap")
    shutil.copy(folder / "b1.mcap", folder / "two.mcap")
    (folder / "b1.toml").write_text("")
    for name in ("b1_truth", "two_truth_a", "two_truth_b"):
        np.savez(folder / f"{name}.npz", **{of: one[:3] for of, one in arrays().items()})
    return folder


def test_recordings_with_a_truth_file_are_scored_and_others_named(given, monkeypatch):
    monkeypatch.setattr(foreign, "run_product", lambda *_: ([], ["no floor was found"], 1))
    result = foreign.evaluate_foreign("mouse", truth=given)
    assert list(result["rows"]) == ["b1", "two a", "two b"]
    row = result["rows"]["b1"]
    assert (row["found"], row["said"], row["exit_code"]) == (0.0, ["no floor was found"], 1)
    skipped = [sentence.split(":")[0] for sentence in result["skipped"]]
    assert skipped == ["b1", "two"]
    assert (result["bodies"], result["summary"]["n_bodies"]) == ("given", 3)


def test_of_several_animals_each_is_scored_against_its_own_truth(
    given: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    aside = np.array([80.0, 0.0, 0.0])
    truths = {name: one[:3].copy() for name, one in arrays().items()}
    for letter in ("a", "b"):
        np.savez(tmp_path / f"two_truth_{letter}.npz", **truths)
        truths["joints"] += aside
    shutil.copy(given / "b1.mcap", tmp_path / "two.mcap")
    joints = measured().joints_camera[:3]
    exchanged = np.array([joints[0], joints[1] + aside, joints[2]])
    ours = [
        MeasuredIndividual(one, np.ones(3, np.bool_), np.ones(joints.shape), np.full(3, 3.0))
        for one in (joints + aside, exchanged)
    ]
    counts = []

    def pretend(recording: object, plan: Plan) -> tuple[list[MeasuredIndividual], list[str], int]:
        counts.append(plan.animal.count)
        return ours, [], 0

    monkeypatch.setattr(foreign, "run_product", pretend)
    rows = foreign.evaluate_foreign("mouse", truth=tmp_path)["rows"]
    assert counts == [2]
    assert rows["two b"]["across_mm"] < 0.1
    assert (rows["two a"]["exchanged"], rows["two b"]["exchanged"]) == (pytest.approx(1 / 3), 0.0)


def test_a_body_of_another_length_than_the_plans_is_left_out(given):
    with pytest.raises(LiexError, match=r"65 mm long, and a fish has 18 to .*--animal"):
        foreign.evaluate_foreign("fish", truth=given)


def test_files_that_are_no_truth_are_refused_in_one_sentence(given, tmp_path):
    (tmp_path / "b1.mcap").symlink_to(given / "b1.mcap")
    file = tmp_path / "b1_truth.npz"
    np.savez(file, joints=np.array(["a"]), surface_mm=0.0, thickness_mm=0.0)
    bad = [(file.read_bytes(), "should be a truth file"), (b"PK", "should be a truth file")]
    for content, expected in (*bad, (b"", "should be a truth file")):
        file.write_bytes(content)
        with pytest.raises(LiexError, match=expected) as error:
            foreign.evaluate_foreign("fish", truth=file)
        assert "\n" not in str(error.value)
    (tmp_path / "b1.mcap").unlink()
    with pytest.raises(LiexError, match="no recording beside"):
        foreign.evaluate_foreign("fish", truth=file)
    with pytest.raises(LiexError, match="check the path"):
        foreign.evaluate_foreign("fish", truth=tmp_path / "absent")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("--split foreign --animal hand", "joints are one chain"),
        ("--split foreign --truth . --frames 3", "belong to the project's own bodies"),
        ("--split foreign --spine-mm 65", "sizes of its own"),
        ("--split clean --truth .", "--truth belongs to the split foreign"),
    ],
)
def test_options_that_do_not_belong_together_are_refused(words, expected):
    result = CliRunner().invoke(cli.app, ["evaluate", "pose", *words.split()])
    assert isinstance(result.exception, LiexError)
    assert expected in str(result.exception)


def test_own_bodies_are_scored_and_sealed_ones_are_others(monkeypatch):
    taken = []

    def pretend(recording, plan):
        taken.append(recording.name)
        joints = foreign.truth_of(recording.truth, "", recording, SHARES).joints_camera
        joints = np.nan_to_num(joints, nan=600.0) + 0.01
        sd = np.full(joints.shape, 1.0)
        return [MeasuredIndividual(joints, np.ones(2, np.bool_), sd, np.ones(2))], [], 0

    monkeypatch.setattr(foreign, "run_product", pretend)
    monkeypatch.setitem(foreign.KINDS["mouse"], "n_bodies", 2)
    result = foreign.evaluate_foreign("mouse", n_frames=2)
    assert result["summary"]["depth_mm"] == pytest.approx(0.01)
    assert result["summary"]["depth_mm95"] is not None
    assert foreign.evaluate_foreign("mouse", n_frames=2, sealed=True)["bodies"] == "sealed"
    assert len(set(taken)) == 4


@pytest.mark.nightly
@pytest.mark.skipif(not FOREIGN.is_dir(), reason=ABSENT)
def test_given_foreign_bodies_are_measured():
    result = foreign.evaluate_foreign("fish", truth=FOREIGN / "fish28_truth.npz")
    assert result["rows"]["fish28"]["found"] > 0.9
    assert result["rows"]["fish28"]["across_mm"] < 2.0
