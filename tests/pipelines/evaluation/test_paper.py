"""`liex evaluate tables`: every row and figure is there, kept rows are used, and the notes follow
the numbers.
"""

import csv
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
from liex_lab.dashboards.paper import page
from liex_lab.pipelines.build import plan_of
from liex_lab.pipelines.evaluation.paper import rows, run
from liex_lab.pipelines.evaluation.paper.rows import Sweep, chosen_values, with_value
from liex_lab.pipelines.evaluation.paper.run import PARTS, Budget, keep_results, kept_results

from liex_lab.baselines.baseline import ForestPlan, train_forests
from liex_lab.body.skeleton import Skeleton
from liex_lab.catalog import kept_results_folder
from liex_lab.errors import LiexError, MissingPackageError, PlanError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.method import METHODS, method_of
from liex_lab.forests.grow import GrowthPlan
from liex_lab.runtime.progress import silent
from liex_lab.sessions.provenance import package_version
from liex_lab.simulation import simulator
from liex_lab.simulation.recording import SPLITS, RenderedRecording
from liex_lab.simulation.sensors import PRIMESENSE_QVGA_SENSOR
from liex_lab.simulation.species import MouseSpecies
from tests.estimation.toy import toy_mice, trained, training_set

N_FRAMES = 6
MEASURED = list(rows.ROWS[:-1])  # all but the CNN
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


class SmallWorld(MouseSpecies):
    """Two splits of two recordings of a few small frames."""

    splits: ClassVar = {name: SPLITS[name] for name in ("clean", "hard")}

    def test_split(
        self, name: str, spine_mm: float | None = None, n_sessions: int = 2
    ) -> list[RenderedRecording]:
        return [
            self.film([len(name), k], N_FRAMES, sensor=PRIMESENSE_QVGA_SENSOR, name=f"{name}-{k}")
            for k in range(min(n_sessions, 2))
        ]


def toy_runs(animal: str, variant: str, progress: Any = silent) -> Any:
    if variant == "cnn":
        raise MissingPackageError("the CNN baseline needs torch, which is not installed")
    if variant == "rf":
        toy, few = toy_mice(200, 1), GrowthPlan(4, 12, 8, 40, 0.5, 0.0, 0.0, 0.63)
        data = training_set(toy, METHODS["paper"])
        plan, rng = ForestPlan(few, few), np.random.default_rng(0)
        return [train_forests(data, toy.skeleton, plan, rng, lambda *_: None)]
    base = PoseEstimator(trained("default" if variant == "default" else "paper").model)
    return [base] if variant == "default" else rows.runs_of_models(variant, [base])


def toy_curve(skeleton: Skeleton, variant: str, sweep: Sweep, progress: Any) -> dict[str, Any]:
    points = [{"value": k, "mean_mm": 9.0 / k, "median_mm": 8.0 / k} for k in (1, 3)]
    return {"curves": {"rounds": points}, "chosen": {"rounds": 3}, "left_out": {}}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `--quick` writes, in a small world with toy models."""
    out = tmp_path_factory.mktemp("tables") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "world_of", lambda skeleton: SmallWorld())
        patch.setattr(run, "quick_runs", toy_runs)
        patch.setattr(run, "_QUICK_ILLUSTRATED", 4)
        patch.setattr(rows, "sensitivity", toy_curve)
        patch.setattr(rows, "_RATE_FRAMES", 4)
        patch.setattr(rows, "_RATE_REPEATS", 1)
        written = run.run_tables(out, ["mouse"], quick=True, n_frames=2 * N_FRAMES, without=PARTS)
    assert all(path.is_file() for path in written)
    return out


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_every_row_is_there_for_every_split_with_its_figures_and_origin(made):
    table = rows_of(made / "table1.csv")
    assert [(r["variant"], r["split"]) for r in table] == [
        (variant, split) for variant in MEASURED for split in ("clean", "hard")
    ]
    for row in table:
        assert 0 < float(row["median_joint_error_mm"]) < 90
        assert (row["n_frames"], row["origin"]) == (str(2 * N_FRAMES), "measured")
        assert row["command"].startswith("liex evaluate tables")
    published = {r["variant"]: r["published_mean_joint_error_mm"] for r in table}
    assert (published["rf"], published["default"]) == ("12.24", "")
    assert not (made / "table2.csv").exists()  # no hand was asked for
    speed = rows_of(made / "table3.csv")
    assert [r["variant"] for r in speed] == MEASURED
    assert float(speed[0]["ratio_to_default"]) == 1.0
    flat = json.loads((made / "tables.json").read_text())["mouse"]
    for split in (flat["clean"], flat["hard"]):
        assert list(split) == MEASURED
        shares = {(row["wrong_object"], row["wrong_object_alone"]) for row in split.values()}
        assert len(shares) == 1  # every row measured the same objects
        for row in split.values():
            assert row["interval95"][0] <= row["median_mm"] <= row["interval95"][1]
        draws = split["paper-one-pose"]["run_median_mm"]
        assert len(draws) == rows.START_DRAWS > 1 < len(set(draws))  # draws are not one draw


@pytest.mark.slow
def test_the_page_has_every_table_and_figure_with_a_sentence_and_loads_nothing(made):
    for name in FIGURES:
        drawn = np.asarray(cv2.imread(str(made / name)))
        assert min(drawn.shape[:2]) > 200
        assert drawn.std() > 10
    assert sorted(path.name for path in made.glob("*.png")) == FIGURES
    html = (made / "index.html").read_text(encoding="utf-8")
    labels = [*(f"Table {k}" for k in (1, 2, 3)), *(f"Fig. {k}" for k in range(1, 21))]
    assert re.findall(r"<h2>([^<]+)<span>", html) == labels
    sections = dict(zip(labels, html.split("<section ")[1:-1], strict=True))
    for label, section in sections.items():
        (said,) = re.findall(r'<p class="comment">(.+?)</p>', section)
        assert said.endswith(".")
        assert "Same" in said or "drawing" in said or label in ("Fig. 14", "Fig. 15")
        assert ("Not made" in section) == (label in _NOT_MADE), label
    assert html.count("data:image/png;base64,") == len(FIGURES) - 1  # error per joint is not theirs
    assert not re.findall(r"""(?:src|href)=["'](?!data:|#)""", html)
    assert "url(" not in html
    assert "Lie-X without the learned metric" in sections["Table 1"]
    assert "the hand was not asked for" in sections["Fig. 10"]
    for label, verb in (("Fig. 18", "tracking"), ("Fig. 20", "actions"), ("Table 2", "nyu")):
        assert f"<code>liex evaluate {verb}" in sections[label]
    assert '<td class="text">RF</td>' in sections["Table 1"]
    assert re.search(r'<td class="number">\d+\.\d\d \(', sections["Table 1"])
    for text in (html, (made / "tables.md").read_text(encoding="utf-8")):
        assert "A quick run" in text
        assert "CNN was not measured: the CNN baseline needs torch" in text
        assert "is ahead of" not in text


_NOT_MADE = {f"Fig. {k}" for k in (10, 11, 12, 13, 15, 18, 19, 20)}


@pytest.mark.slow
def test_kept_rows_keep_their_poses_and_numbers_are_those_of_the_frames(made):
    kept_rows = kept_results("mouse", made / "kept")["rows"]
    assert sorted(kept_rows) == sorted(MEASURED[1:])
    recordings = {split: SmallWorld().test_split(split) for split in ("clean", "hard")}
    places = [
        {"split": split, "recording": k, "frame": i}
        for split, some in recordings.items()
        for k, i in rows.example_frames(some)
    ]
    poses = {name: row["examples"] for name, row in kept_rows.items()}
    for name, shown in rows.shown_poses(places, poses, recordings).items():
        assert [{key: one[key] for key in places[0]} for one in poses[name]] == places
        for one in shown:
            assert "pose" in one
            uv = one["camera"].project(one["truth"]).round().astype(int)
            assert (one["depth"][uv[:, 1], uv[:, 0]] > 0).mean() > 0.5
    worst = kept_rows["paper"]["failures"][0]
    assert worst["error_mm"] >= kept_rows["paper"]["splits"]["clean"]["median_mm"]
    results = json.loads((made / "results.json").read_text())["mouse"]
    numbers = results["rows"]["rf"]["splits"]["hard"]
    middle = numbers["error_quantiles_mm"][50]
    assert middle == pytest.approx(numbers["median_joint_error_mm"], abs=2e-3)
    shown = results["illustration"]
    assert shown["ranked"]["score_mm"] == sorted(shown["ranked"]["score_mm"])
    assert shown["steps"]["example_mm"][-1] == pytest.approx(shown["ranked"]["error_mm"][0])


@pytest.mark.slow
def test_every_row_measures_the_object_that_the_default_chooses():
    recording = SmallWorld().test_split("hard")[0]
    chooser = PoseEstimator.load("mouse")
    scene, frames, view = rows.common_view(recording, plan_of("mouse"), chooser)
    assert not view.wrong.any()
    told, *_ = rows.measured(chooser, frames, scene, view, {})
    alone = chooser.estimate(frames, scene, view.size).chosen.pose.joints(chooser.skeleton)
    np.testing.assert_array_equal(told, alone)


def test_a_part_or_row_that_does_not_exist_is_refused_before_anything_is_measured(tmp_path):
    with pytest.raises(PlanError, match=r"no part 'speed'.*tracking, actions"):
        run.run_tables(tmp_path / "out", ["mouse"], without=["speed"])
    with pytest.raises(PlanError, match="no row 'knn'"):
        run.run_tables(tmp_path / "out", ["mouse"], rows=["knn"])
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "kept", "curves", "fresh"),
    [
        ((None, False, False, (), False), True, False, ("default",)),
        ((100, False, False, (), False), False, False, rows.ROWS),
        ((None, False, False, (), True), False, False, rows.ROWS),
        ((None, False, True, (), False), False, True, rows.ROWS),
        ((100, False, True, (), False), False, False, rows.ROWS),
        ((None, False, False, ("rf",), False), True, False, ("default", "rf")),
        ((None, False, True, ("rf",), False), True, False, ("default", "rf")),
        ((None, False, False, ("fig7",), False), True, True, ("default",)),
    ],
)
def test_kept_rows_serve_where_nothing_else_is_asked_for(options, kept, curves, fresh):
    budget = Budget.of(*options)
    assert (budget.kept, budget.curves, budget.fresh) == (kept, curves, fresh)


def results_with(medians: dict[str, float], half: float = 0.2) -> dict[str, Any]:
    def numbers(median: float) -> dict[str, Any]:
        return {"median_mm": median, "interval95": [median - half, median + half]}

    told = {
        variant: {"splits": {"clean": numbers(median), "hard": numbers(median + 1)}}
        for variant, median in medians.items()
    }
    none = {"missing": {}, "sensitivity": {}, "test_postures": ""}
    return {"animal": "mouse", "splits": ["clean", "hard"], "rows": told, **none}


def test_notes_follow_the_numbers():
    order = {"default": 2.0, "paper": 3.0, "cnn": 4.0, "paper-no-metric": 5.0, "rf": 6.0}
    order["paper-one-pose"] = 7.0
    (sentence,) = page.notes_of(results_with(order), quick=False)
    assert "No two methods rank differently" in sentence
    (turned,) = page.notes_of(results_with(order | {"rf": 4.5}), quick=False)
    assert "on the same object" in turned
    where = "clean (median 4.50 against 5.00 mm), hard (median 5.50 against 6.00 mm)."
    assert turned.endswith(f"RF is ahead on {where}")
    ahead, other = page.notes_of(results_with(order | {"cnn": 1.5}), quick=False)
    assert ahead.startswith("CNN is ahead of the default on clean (median 1.50 against 2.00 mm)")
    assert "the paper's variant" in other
    (unsure,) = page.notes_of(results_with(order | {"rf": 4.5}, half=0.6), quick=False)
    assert "ahead" not in unsure  # the intervals overlap


def test_a_row_of_another_version_postures_or_processor_is_named_as_such():
    made = {"version": "0.0.9", "command": "liex evaluate tables --row=rf", "test_postures": "old"}
    results = results_with({"rf": 1.0}) | {"test_postures": "drawn"}
    results["rows"]["rf"] |= {"made": made, "origin": "kept", "other_processor": "znver5"}
    results["sensitivity"] = {"paper": {"made": made | {"test_postures": ""}, "origin": "kept"}}
    assert page.notes_of(results, quick=True)[1:] == [
        "RF was measured by version 0.0.9 with `liex evaluate tables --row=rf`.",
        "RF was measured with test postures old.",
        "Fig. 7, paper, was measured by version 0.0.9 with `liex evaluate tables --row=rf`.",
    ]
    splits = results["rows"]["rf"]["splits"].values()
    for numbers in splits:
        numbers |= {"wrong_object": 0.0, "wrong_object_alone": 0.0}
    assert page.error_table(results)[4]["row"] == "kept, another processor"
    made |= {"version": package_version("liex_lab"), "test_postures": "drawn"}
    results["sensitivity"] = {}
    assert page.notes_of(results, quick=True) == ["Test postures are drawn."]


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
    told = {"default": row, "paper": row | {"origin": "measured", "other_processor": None}}
    path = keep_results(tmp_path, {"animal": "mouse", "rows": told, "sensitivity": curves})
    rounded = {
        "splits": {"clean": {"median_mm": 1.23457, "flip_rate": None}},
        "rate": {"frames_per_s": 123457.0, "cores": 2},
    }
    expected = {"rows": {"paper": row | rounded}, "sensitivity": curves}
    assert kept_results("mouse", tmp_path) == expected
    assert sum("joints_mm" in line for line in path.read_text().splitlines()) == 4  # a pose a line


@pytest.mark.parametrize(
    "content",
    [
        b"no json",
        b"[]",
        b"{}",
        b'{"schema": 3, "rows": {}, "sensitivity": {}}',
        b'{"schema": 4, "rows": 3}',
        b"\xff",
    ],
)
def test_damaged_or_older_kept_results_are_refused_in_one_sentence(content, tmp_path):
    assert kept_results("mouse", tmp_path) == {"rows": {}, "sensitivity": {}}
    (tmp_path / "mouse.json").write_bytes(content)
    with pytest.raises(LiexError, match=r"mouse\.json.*--fresh$") as told:
        kept_results("mouse", tmp_path)
    assert "\n" not in str(told.value)


@pytest.fixture(scope="module")
def from_kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the verb makes of the kept rows; in place of the default, which is measured, RF."""

    def instead(animal: str, *_: object) -> dict[str, Any]:
        return {"default": kept_results(animal)["rows"]["rf"]}

    def no_recordings(skeleton: Skeleton, _: object) -> dict[str, list[Any]]:
        return {split: [] for split in simulator.world_of(skeleton).splits}

    out = tmp_path_factory.mktemp("tables") / "out"
    with pytest.MonkeyPatch.context() as patch:
        default = SimpleNamespace(model=None)
        patch.setattr(rows, "runs_of", lambda *_: [default])
        patch.setattr(rows, "measured_rows", instead)
        patch.setattr(run, "_tests", no_recordings)
        patch.setattr(rows, "illustrate", lambda *_: {})
        patch.setattr(rows, "shown_poses", lambda _, poses, __: {name: [] for name in poses})
        patch.setattr(page, "draw_paper", lambda *_: [])
        run.run_tables(out, ["mouse", "fish", "hand"], without=PARTS)
    return out


def test_the_tables_of_the_kept_rows_are_those_that_the_manual_publishes(from_kept):
    text = (Path(__file__).parents[3] / "docs" / "evidence.md").read_text(encoding="utf-8")
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
        told = [f"{x:.1f}" if row["animal"] == "hand" else f"{x:.2f}" for x in numbers]
        cell = "{} ({} to {}); {}".format(*told)
        cells.setdefault((row["animal"], row["variant"]), []).append(cell)
    assert len(cells) == 3 * len(rows.ROWS)
    for (animal, variant), line in cells.items():
        if variant != "default":
            assert f"| {animal}, {names[variant]} | {' | '.join(line)} |\n" in text


def test_kept_rows_are_written_as_they_were_read_with_what_made_them(from_kept):
    for path in sorted(kept_results_folder().glob("*.json")):
        assert (from_kept / "kept" / path.name).read_bytes() == path.read_bytes()
        kept = kept_results(path.stem)["rows"]
        assert list(kept) == sorted(rows.ROWS[1:])
        made = [row["made"] for row in kept.values()]
        assert all(
            {"command", "version", "date", "machine", "seed", "seeds"} <= set(m) for m in made
        )
