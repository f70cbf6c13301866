"""`liex evaluate tables`: every row and figure is there, kept rows serve where they fit, and words
follow numbers.
"""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from liex_lab.dashboards.paper.confusion import draw_confusions
from liex_lab.dashboards.paper.key_frames import draw_key_frames
from liex_lab.dashboards.paper.nyu_hands import draw_nyu_hands
from liex_lab.dashboards.paper.page import write_page
from liex_lab.dashboards.paper.plates import draw_figures
from liex_lab.dashboards.paper.tracking import draw_tracking
from liex_lab.pipelines.build import plan_of
from liex_lab.pipelines.evaluation import pose
from liex_lab.pipelines.evaluation.paper import (
    common_view,
    examples,
    exhibits,
    illustrations,
    kept,
    quick,
    rows,
    run,
    table_text,
)
from liex_lab.pipelines.evaluation.paper.deviations import DEVIATIONS
from liex_lab.pipelines.evaluation.paper.drawers import Drawers
from liex_lab.pipelines.evaluation.paper.further import PARTS, Further
from liex_lab.pipelines.evaluation.paper.rows import TRAINING_DRAWS
from liex_lab.pipelines.evaluation.paper.sensitivity import (
    Sweep,
    chosen_values,
    with_value,
)
from liex_lab.pipelines.training.baselines import training_of
from liex_lab.pipelines.training.pose_model import recipe_of

from liex_lab.baselines.cnn import CnnPlan
from liex_lab.baselines.forest import ForestPlan, train_forests
from liex_lab.body.skeleton import Skeleton
from liex_lab.catalog import bundled_models, kept_results_folder
from liex_lab.errors import LiexError, MissingPackageError, PlanError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.method import METHODS, method_of
from liex_lab.forests.grow import GrowthPlan
from liex_lab.runtime.progress import silent
from liex_lab.sessions.provenance import package_version
from liex_lab.simulation import simulator
from liex_lab.simulation.recording import SyntheticSession
from liex_lab.simulation.species import PRIMESENSE_QVGA_SENSOR, MouseSpecies
from tests.estimation.toy import toy_mice, trained, training_set

N_SESSIONS, N_FRAMES = 2, 10
FIGURES = [
    "error_per_joint.png",
    "fig07_sensitivity.png",
    "fig08_cumulative_error.png",
    "fig09_poses_mouse.png",
    "fig09_poses_mouse_side.png",
    "fig13_candidates_mouse.png",
    "fig16_convergence_mouse.png",
    "fig17_failures_mouse.png",
]
DRAWERS = Drawers(
    draw_figures, draw_tracking, draw_confusions, draw_key_frames, draw_nyu_hands, write_page
)


class SmallWorld(simulator.MouseSimulator):
    """Two splits of two recordings of ten small frames."""

    def __init__(self) -> None:
        super().__init__(MouseSpecies(Skeleton.load("mouse")), ("clean", "hard"))

    def test_split(
        self, name: str, spine_mm: float | None = None, n_sessions: int = 40
    ) -> list[SyntheticSession]:
        return [
            SyntheticSession.draw(
                [len(name), k], N_FRAMES, sensor=PRIMESENSE_QVGA_SENSOR, name=f"{name}-{k}"
            )
            for k in range(min(n_sessions, N_SESSIONS))
        ]


def toy_rf() -> Any:
    toy, few = toy_mice(300, 1), GrowthPlan(4, 12, 8, 40, 0.5, 0.0, 0.0, 0.63)
    data = training_set(toy, METHODS["paper"])
    return train_forests(
        data, toy.skeleton, ForestPlan(few, few), np.random.default_rng(0), lambda *_: None
    )


def toy_runs(animal: str, variant: str, progress: Any = silent) -> Any:
    if variant == "cnn":
        raise MissingPackageError("the CNN baseline needs torch, which is not installed")
    if variant == "rf":
        return [toy_rf()]
    base = PoseEstimator(trained("default" if variant == "default" else "paper").model)
    return [base] if variant == "default" else rows.runs_of_models(variant, [base])


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `--quick` writes, in a small world with toy models."""
    out = tmp_path_factory.mktemp("tables") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulator, "world_of", lambda skeleton: SmallWorld())
        patch.setattr(quick, "quick_runs", toy_runs)
        patch.setattr(
            quick, "QUICK_SWEEP", Sweep(512, 512, (("initial poses", (1,)), ("metric trees", (2,))))
        )
        patch.setattr(rows, "_RATE_FRAMES", 8)
        patch.setattr(rows, "_RATE_REPEATS", 1)
        written = run.make_tables(
            out, ["mouse"], quick=True, n_frames=20, without=PARTS, drawers=DRAWERS
        )
    assert all(path.is_file() for path in written)
    return out


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_every_row_is_there_for_every_split_with_its_figures_and_where_it_comes_from(made):
    table = rows_of(made / "table1.csv")
    assert [(r["split"], r["variant"]) for r in table] == [
        (split, variant) for variant in run.ROWS[:-1] for split in ("clean", "hard")
    ]
    for row in table:
        assert 0 < float(row["median_joint_error_mm"]) < 60
        assert 0 <= float(row["flip_rate"]) <= 1
        assert int(row["n_frames"]) == N_SESSIONS * N_FRAMES
        assert (row["origin"], row["command"][:20]) == ("measured", "liex evaluate tables")
    published = {r["variant"]: r["published_mean_joint_error_mm"] for r in table}
    assert published["rf"] == "12.24"
    assert published["default"] == ""
    assert not (made / "table2.csv").exists()  # no hand was asked for
    speed = rows_of(made / "table3.csv")
    assert [r["variant"] for r in speed] == list(run.ROWS[:-1])
    assert float(speed[0]["ratio_to_default"]) == 1.0


@pytest.mark.slow
def test_the_text_says_that_a_quick_run_means_nothing_and_why_a_row_is_missing(made):
    text = (made / "tables.md").read_text(encoding="utf-8")
    assert "A quick run" in text
    assert "CNN was not measured: the CNN baseline needs torch" in text
    assert "is ahead of" not in text
    assert "published" in text.lower()


@pytest.mark.slow
def test_every_figure_is_a_picture(made):
    import cv2

    assert sorted(path.name for path in made.glob("*.png")) == FIGURES
    for name in FIGURES:
        picture = np.asarray(cv2.imread(str(made / name)))
        assert min(picture.shape[:2]) > 250
        assert picture.std() > 10


@pytest.mark.slow
def test_the_page_holds_every_table_and_figure_with_a_sentence_and_asks_no_other_machine(made):
    page = (made / "index.html").read_text(encoding="utf-8")
    labels = [*(f"Table {k}" for k in (1, 2, 3)), *(f"Fig. {k}" for k in range(1, 21))]
    assert re.findall(r"<h2>([^<]+)<span>", page) == labels
    sections = page.split("<section ")[1:-1]
    for section in sections:
        (said,) = re.findall(r'<p class="said">(.+?)</p>', section)
        assert len(said) > 20
    assert page.count("data:image/png;base64,") == len(FIGURES) - 1  # error per joint is not theirs
    assert not re.findall(r"""(?:src|href)=["'](?!data:|#)""", page)
    assert "url(" not in page
    assert "A quick run" in page
    told = dict(zip(labels, sections, strict=True))
    assert "Lie-X without the learned metric" in told["Table 1"]
    assert "Not made: the hand was not asked for" in told["Fig. 10"]
    for label, verb in (("Fig. 18", "tracking"), ("Fig. 19", "actions"), ("Fig. 20", "actions")):
        assert f"it was left out; <code>liex evaluate {verb}" in told[label]
    assert "liex evaluate nyu" in told["Table 2"]
    assert "--nyu" in told["Fig. 12"]
    (objects,) = re.findall(r"<tr>(<td[^>]*>another object measured.+?)</tr>", told["Table 1"])
    assert objects.count("0.00 % (0.00 %)") == 2  # on clean and hard, which no row can change
    assert '<td class="text">RF</td>' in told["Table 1"]
    assert re.search(r'<td class="number">\d+\.\d\d \(', told["Table 1"])


@pytest.mark.slow
def test_kept_rows_keep_their_poses_in_the_examples(made):
    kept_rows = kept.kept_results("mouse", made / "kept")["rows"]
    assert kept_rows
    recordings = {split: SmallWorld().test_split(split) for split in ("clean", "hard")}
    places = [
        {"split": split, "recording": k, "frame": i}
        for split, some in recordings.items()
        for k, i in examples.example_frames(some)
    ]
    assert len(places) == 4
    for name, row in kept_rows.items():
        assert [{key: one[key] for key in places[0]} for one in row["examples"]] == places
        shown = examples.shown_poses(places, {name: row["examples"]}, recordings)
        for one in shown:
            recording = recordings[one["split"]][one["recording"]]
            np.testing.assert_array_equal(one["truth"], recording.joints_camera[one["frame"]])
            uv = one["camera"].project(one["truth"]).round().astype(int)
            assert (one["depth"][uv[:, 1], uv[:, 0]] > 0).mean() > 0.5
    worst = kept_rows["paper"]["failures"][0]
    assert worst["error_mm"] >= max(0.0, kept_rows["paper"]["splits"]["clean"]["median_mm"])


def test_every_figure_of_the_paper_is_made_or_said_to_be_a_drawing():
    told = exhibits.exhibits([], Further(), [], quick=False)
    assert len(told) == 23
    for one in told:
        drawing = one["title"] == "Drawing"
        assert drawing == (one["label"].removeprefix("Fig. ") in exhibits.DRAWINGS)
        assert one["said"].endswith(".")
        assert drawing or "Same" in one["said"] or one["label"] in ("Fig. 14", "Fig. 15")


def test_a_part_that_is_none_is_refused_before_anything_is_measured(tmp_path):
    with pytest.raises(PlanError, match=r"no part 'speed'.*tracking, actions"):
        run.make_tables(tmp_path / "out", ["mouse"], without=["speed"])
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_numbers_of_the_json_are_those_of_the_frames_and_the_way_of_the_candidates_ends_at_them(
    made,
):
    results = json.loads((made / "results.json").read_text())["mouse"]
    for row in results["rows"].values():
        for numbers in row["splits"].values():
            quantiles = numbers["error_quantiles_mm"]
            assert quantiles == sorted(quantiles)
            assert quantiles[50] == pytest.approx(numbers["median_joint_error_mm"], abs=2e-3)
            assert np.mean(numbers["joint_mm"]) == pytest.approx(
                numbers["mean_joint_error_mm"], abs=2e-3
            )
    shown = results["illustration"]
    assert shown["ranked"]["score_mm"] == sorted(shown["ranked"]["score_mm"])
    assert shown["steps"]["example_mm"][-1] == pytest.approx(shown["ranked"]["error_mm"][0])
    assert (
        shown["steps"]["best_mm"][-1] < 0.75 * shown["steps"]["median_mm"][0]
    )  # a model of next to no trees
    curves = results["sensitivity"]["paper"]["curves"]
    assert [p["value"] for p in curves["initial poses"]] == [1, 40]
    assert curves["initial poses"][-1] == curves["metric trees"][-1] | {
        "value": 40
    }  # the method itself, both times
    assert curves["initial poses"][0]["mean_mm"] > curves["initial poses"][-1]["mean_mm"]


@pytest.mark.slow
def test_tables_json_has_every_figure_by_split_and_method(made):
    flat = json.loads((made / "tables.json").read_text())["mouse"]
    assert list(flat) == ["clean", "hard"]
    for split in flat.values():
        assert list(split) == list(run.ROWS[:-1])
        shares = {(row["wrong_object"], row["wrong_object_alone"]) for row in split.values()}
        assert len(shares) == 1  # every row measured the same objects
        for row in split.values():
            low, high = row["interval95"]
            assert low <= row["median_mm"] <= high
            assert row["mean_interval95"][0] <= row["mean_mm"] <= row["mean_interval95"][1]
            assert (row["n_frames"], row["n_recordings"]) == (N_SESSIONS * N_FRAMES, N_SESSIONS)
            assert {"training_images", "seeds"} <= set(row)
        assert len(split["paper-one-pose"]["run_median_mm"]) == rows.START_DRAWS
        assert len(set(split["paper-one-pose"]["run_median_mm"])) > 1  # draws are not one draw


def test_with_fewer_frames_or_the_sealed_split_nothing_kept_is_used():
    assert run.Budget.of(None, False, False, (), False).fresh == ("default",)
    assert run.Budget.of(None, False, False, (), False).kept
    for budget in (
        run.Budget.of(100, False, False, (), False),
        run.Budget.of(None, False, False, (), True),
        run.Budget.of(None, False, True, (), False),
    ):
        assert not budget.kept
        assert budget.fresh == run.ROWS
    for fresh in (False, True):  # to name a row is to ask for it anew
        one = run.Budget.of(None, False, fresh, ("rf",), False)
        assert one.kept
        assert one.fresh == ("default", "rf")
        assert not one.curves
    with pytest.raises(PlanError, match="no row 'knn'"):
        run.Budget.of(None, False, True, ("knn",), False)


def test_the_curves_of_fig_7_are_measured_where_they_are_asked_for():
    curves = run.Budget.of(None, False, False, ("fig7",), False)
    assert (curves.curves, curves.kept, curves.fresh) == (True, True, ("default",))
    assert run.Budget.of(None, False, True, (), False).curves
    for other in (
        run.Budget.of(None, False, False, (), False),
        run.Budget.of(100, False, True, (), False),  # `--frames` says nothing of them
        run.Budget.of(None, False, True, (), True),
    ):
        assert not other.curves


@pytest.mark.slow
def test_every_row_measures_the_object_that_the_default_chooses():

    recording = SmallWorld().test_split("hard")[0]
    chooser = PoseEstimator.load("mouse")
    scene, frames, view = common_view.common_view(recording, plan_of("mouse"), chooser)
    assert not view.wrong.any()
    told, *_ = common_view.measured(chooser, frames, scene, view, {})
    alone = chooser.estimate(frames, scene, view.size).chosen.pose.joints(chooser.skeleton)
    np.testing.assert_array_equal(told, alone)


def results_with(medians: dict[str, float], half: float = 0.2) -> run.Results:
    def numbers(median: float) -> dict[str, Any]:
        return {"median_mm": median, "interval95": [median - half, median + half]}

    told = {
        variant: {"splits": {"clean": numbers(median), "hard": numbers(median + 1)}}
        for variant, median in medians.items()
    }
    return run.Results("mouse", [], ["clean", "hard"], told)


def test_words_follow_the_numbers():
    order = {
        "default": 2.0,
        "paper": 3.0,
        "cnn": 4.0,
        "paper-no-metric": 5.0,
        "rf": 6.0,
        "paper-one-pose": 7.0,
    }
    (sentence,) = table_text.words(results_with(order), quick=False)
    assert "in another order" in sentence
    (turned,) = table_text.words(results_with(order | {"rf": 4.5}), quick=False)
    assert "on the same object" in turned
    assert (
        "RF is ahead on clean (median 4.50 against 5.00 mm), hard (median 5.50 against 6.00 mm)."
        in turned
    )
    ahead, *others = table_text.words(results_with(order | {"cnn": 1.5}), quick=False)
    assert ahead == (
        "CNN is ahead of the default on clean (median 1.50 against 2.00 mm), hard (median 2.50 "
        "against 3.00 mm)."
    )
    assert len(others) == 1  # and of the paper's variant
    (unsure,) = table_text.words(results_with(order | {"rf": 4.5}, half=0.6), quick=False)
    assert "ahead" not in unsure  # the intervals overlap


def test_what_differs_from_the_paper_is_what_the_methods_say():
    told = " ".join(DEVIATIONS)
    cnn = CnnPlan()
    assert f"half its width, hidden layers of {cnn.connected:,} " in told
    assert cnn.width == 0.5
    several = {name for name, n in TRAINING_DRAWS.items() if n == 3}
    assert several == {"paper", "paper-one-pose", "paper-no-metric"}
    for animal in ("fish", "mouse", "hand"):
        skeleton = Skeleton.load(animal)
        method = method_of("paper", skeleton)
        recipe = recipe_of("paper", skeleton)
        k, images = {
            "fish": (40, 95_104), "mouse": (40, 104_096), "hand": (20, 72_757)
        }[animal]  # fmt: skip
        n_examples = method.training_candidates * recipe.n_images
        assert f"{n_examples:,} ({animal})" in told
        assert re.search(rf"\b{k * images / n_examples:.0f}\b[\w, ]* times fewer", told)
        assert f"K is {method.training_candidates} " in told
        assert f"{method_of('default', skeleton).training_candidates} (" in told
        for one in (recipe, recipe_of("default", skeleton)):
            for amount in (one.n_images, one.n_correction, one.n_calibration):
                assert f"{amount:,}" in told or not amount
        assert f"m: {method.regressors.n_tests};" in told
        assert f"{recipe.n_images:,} ({animal})" in told
        for plan in (method.regressors, method.metric):
            assert (plan.max_leaf, plan.min_leaf) == (5, 1)
        assert (method.rounds, method.n_candidates) == {
            "fish": (7, 40),
            "mouse": (3, 40),
            "hand": (3, 20),
        }[animal]


def test_every_variant_that_can_be_named_is_known_and_any_other_is_refused(monkeypatch):
    monkeypatch.setattr(pose, "estimator_of", lambda animal, variant, progress: f"{variant} model")
    assert pose.subject_of("mouse", "paper") == "paper model"
    with pytest.raises(PlanError, match=r"no variant 'knn'.*paper-no-metric, rf, cnn"):
        pose.subject_of("mouse", "knn")


def test_all_that_learns_beside_ours_learns_from_the_same_pictures_with_our_noise():
    for animal in bundled_models():
        skeleton = Skeleton.load(animal)
        ours, papers = recipe_of("default", skeleton), recipe_of("paper", skeleton)
        assert papers.degraded_share == ours.degraded_share
        assert papers.n_images >= 0.8 * ours.n_images
        for variant in ("rf", "cnn"):
            theirs = training_of(variant, skeleton).recipe
            assert replace(theirs, n_calibration=0) == replace(papers, n_calibration=0)


def test_a_sweep_changes_one_number_of_a_method_and_nothing_else():
    method = method_of("default", Skeleton.load("mouse"))
    for number, own in chosen_values(method).items():
        assert with_value(method, number, own) == method
        changed = chosen_values(with_value(method, number, own + 7))
        assert changed == chosen_values(method) | {number: own + 7}


def test_a_kept_file_reads_as_what_was_kept_in_it(tmp_path):
    row = {
        "made": {"version": "0.1.0", "command": "liex evaluate tables", "seeds": [0, 1]},
        "splits": {"clean": {"median_mm": 1.23456789, "flip_rate": None}},
        "rate": {"frames_per_s": 123456.789, "cores": 2},
        "examples": [{"frame": k, "joints_mm": [[0.1, -2.25, 300.0]] * 9} for k in range(3)],
        "failures": [{"frame": 7, "joints_mm": None, "error_mm": 9.5}],
    }
    curves = {"paper": {"curves": {"rounds": [{"value": 1, "mean_mm": 14.712345678}]}}}
    path = kept.keep_results(tmp_path, "mouse", {"default": row, "paper": row}, curves)
    told = kept.kept_results("mouse", tmp_path)
    rounded = {
        "splits": {"clean": {"median_mm": 1.23457, "flip_rate": None}},
        "rate": {"frames_per_s": 123457.0, "cores": 2},
    }
    assert told == {"rows": {"paper": row | rounded}, "sensitivity": curves}
    assert sum("joints_mm" in line for line in path.read_text().splitlines()) == 4  # a pose a line


@pytest.mark.parametrize(
    "content",
    [
        "no json",
        "[]",
        "{}",
        '{"schema": 3, "rows": {}, "sensitivity": {}}',
        '{"schema": 4, "rows": 3}',
        b"\xff",
    ],
)
def test_damaged_or_older_kept_results_are_refused_in_one_sentence(content, tmp_path):
    assert kept.kept_results("mouse", tmp_path) == {"rows": {}, "sensitivity": {}}
    data = content if isinstance(content, bytes) else content.encode()
    (tmp_path / "mouse.json").write_bytes(data)
    with pytest.raises(LiexError, match=r"mouse\.json.*--fresh$") as told:
        kept.kept_results("mouse", tmp_path)
    assert "\n" not in str(told.value)


def test_a_row_of_another_version_or_of_other_postures_is_named_as_such():
    made = {"version": "0.0.9", "command": "liex evaluate tables --row=rf", "test_postures": "old"}
    results = results_with({"rf": 1.0})
    results.test_postures = "drawn"
    results.rows["rf"] |= {"made": made, "origin": "kept"}
    results.sensitivity = {"paper": {"made": made | {"test_postures": ""}, "origin": "kept"}}
    assert table_text.words(results, quick=True)[1:] == [
        "RF was measured by version 0.0.9 with `liex evaluate tables --row=rf`.",
        "RF was measured with test postures old.",
        "Fig. 7, paper, was measured by version 0.0.9 with `liex evaluate tables --row=rf`.",
    ]
    made |= {"version": package_version("liex_lab"), "test_postures": "drawn"}
    results.sensitivity = {}
    assert table_text.words(results, quick=True) == ["Test postures are drawn."]


def test_a_row_of_another_processor_is_marked_and_one_of_an_unknown_one_is_not(monkeypatch):
    monkeypatch.setattr(table_text, "processor", lambda: "znver4")
    for made, told in (
        ({"processor": "znver4"}, "kept"),
        ({"processor": "znver5"}, "kept, another processor"),
        ({}, "kept"),
    ):
        assert table_text._origin({"origin": "kept", "made": made}) == told


@pytest.fixture(scope="module")
def from_kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the verb makes of the kept rows; in place of the default, which is measured, RF."""

    def instead(animal: str, *_: object) -> dict[str, Any]:
        return {"default": kept.kept_results(animal)["rows"]["rf"]}

    def no_recordings(skeleton: Skeleton, _: object) -> dict[str, list[Any]]:
        return {split: [] for split in simulator.world_of(skeleton).splits}

    out = tmp_path_factory.mktemp("tables") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rows, "measured_rows", instead)
        patch.setattr(run, "_tests", no_recordings)
        patch.setattr(illustrations, "illustrate", lambda *_: {})
        patch.setattr(examples, "shown_poses", lambda *_: [])
        run.make_tables(out, ["mouse", "fish", "hand"])
    return out


def test_the_tables_of_the_kept_rows_are_those_that_the_manual_publishes(from_kept):
    page = (Path(__file__).parents[3] / "docs" / "evidence.md").read_text(encoding="utf-8")
    names = {
        "paper": "the paper's variant",
        "paper-one-pose": "without multiple initial poses",
        "paper-no-metric": "without the learned metric",
        "rf": "RF",
        "cnn": "CNN",
    }
    cells: dict[tuple[str, str], list[str]] = {}
    for row in rows_of(from_kept / "table1.csv") + rows_of(from_kept / "table2.csv"):
        numbers = map(float, (row["median_mm"], *json.loads(row["interval95"]), row["mean_mm"]))
        text = [f"{x:.1f}" if row["animal"] == "hand" else f"{x:.2f}" for x in numbers]
        cell = "{} ({} to {}); {}".format(*text)
        cells.setdefault((row["animal"], row["variant"]), []).append(cell)
    assert len(cells) == 3 * len(rows.ROWS)
    for (animal, variant), line in cells.items():
        if variant != "default":
            assert f"| {animal}, {names[variant]} | {' | '.join(line)} |\n" in page


def test_kept_rows_are_written_as_they_were_read_with_what_made_them(from_kept):
    for path in sorted(kept_results_folder().glob("*.json")):
        assert (from_kept / "kept" / path.name).read_bytes() == path.read_bytes()
        skeleton = Skeleton.load(path.stem)
        splits = set(simulator.world_of(skeleton).splits)
        told = kept.kept_results(path.stem)
        assert list(told["rows"]) == sorted(rows.ROWS[1:])
        for row in told["rows"].values():
            assert row["made"]["command"].startswith("liex evaluate tables")
            assert {"version", "date", "machine", "seed", "seeds"} <= set(row["made"])
            assert set(row["splits"]) == splits
            for numbers in row["splits"].values():
                assert (numbers["n_frames"], numbers["n_recordings"]) == (2000, 40)
                assert len(numbers["joint_mm"]) == skeleton.n_joints


class Still:
    """Two empty frames."""

    width = 4

    def __len__(self) -> int:
        return 2

    def depths(self, start: int, stop: int) -> np.ndarray:
        return np.ones((stop - start, 4, 4), np.float32)


class Failing:
    """Runs out of memory."""

    skeleton = Skeleton.load("mouse")

    def find_size(self, *_: object) -> float:
        raise MemoryError


def test_the_number_of_threads_is_put_back_where_timing_fails(monkeypatch):
    before = numba.get_num_threads()
    asked: list[int] = []
    monkeypatch.setattr(numba, "set_num_threads", asked.append)
    monkeypatch.setattr("liex_lab.pipelines.build.build_scene", lambda *_: (None, None))
    with pytest.raises(MemoryError):
        rows.rates_of("mouse", {"default": Failing()}, [Still()])
    assert len(asked) == 2
    assert asked[-1] == before
