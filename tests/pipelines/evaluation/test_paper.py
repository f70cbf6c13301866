"""`liex evaluate tables`: every row and figure is there, kept rows serve where they fit, and words
follow numbers.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from liex_lab.dashboards.paper.plates import draw_figures
from liex_lab.pipelines.evaluation import pose
from liex_lab.pipelines.evaluation.paper import cached_results, quick, run, table_text
from liex_lab.pipelines.evaluation.paper.sensitivity import (
    Sweep,
    chosen_values,
    with_value,
    without_void,
)
from liex_lab.pipelines.training.baselines import training_of

from liex_lab.baselines.ablations import PlainMean
from liex_lab.baselines.forest import ForestPlan, train_forests
from liex_lab.body.skeleton import Skeleton
from liex_lab.catalog import bundled_models, kept_results_folder
from liex_lab.errors import LiexError, MissingPackageError, PlanError
from liex_lab.estimation.estimator import PoseEstimator
from liex_lab.estimation.method import METHODS, method_of
from liex_lab.forests.grow import GrowthPlan
from liex_lab.runtime.progress import silent
from liex_lab.simulation import simulator
from liex_lab.simulation.recording import SyntheticSession
from liex_lab.simulation.sensors import PRIMESENSE_QVGA_SENSOR
from liex_lab.simulation.species import MouseSpecies
from tests.estimation.toy import toy_mice, trained, training_set

N_SESSIONS, N_FRAMES = 2, 10
FIGURES = [
    "error_per_joint.png",
    "fig07_sensitivity.png",
    "fig08_cumulative_error.png",
    "fig13_candidates_mouse.png",
    "fig16_convergence_mouse.png",
]


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


def toy_subject(animal: str, variant: str, progress: Any = silent) -> Any:
    if variant == "cnn":
        raise MissingPackageError("the CNN baseline needs torch, which is not installed")
    if variant == "rf":
        return toy_rf()
    base = PoseEstimator(trained("default" if variant == "default" else "paper").model)
    if variant == "paper-no-metric":
        return PlainMean(base)
    return PoseEstimator(base.model, 1) if variant == "paper-one-pose" else base


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `--quick` writes, in a small world with toy models."""
    out = tmp_path_factory.mktemp("tables") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulator, "world_of", lambda skeleton: SmallWorld())
        patch.setattr(quick, "quick_subject", toy_subject)
        patch.setattr(
            quick, "QUICK_SWEEP", Sweep(512, 512, (("initial poses", (1,)), ("metric trees", (2,))))
        )
        patch.setattr(run, "_RATE_FRAMES", 8)
        patch.setattr(run, "_RATE_REPEATS", 1)
        written = run.make_tables(out, ["mouse"], quick=True, n_frames=20, draw=draw_figures)
    assert all(path.is_file() for path in written)
    return out


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_every_row_is_there_for_every_split_with_its_figures_and_where_it_comes_from(made):
    rows = rows_of(made / "table1.csv")
    assert [(r["split"], r["variant"]) for r in rows] == [
        (split, variant) for variant in run.ROWS[:-1] for split in ("clean", "hard")
    ]
    for row in rows:
        assert 0 < float(row["median_joint_error_mm"]) < 60
        assert 0 <= float(row["flip_rate"]) <= 1
        assert int(row["n_frames"]) == N_SESSIONS * N_FRAMES
        assert (row["origin"], row["command"][:20]) == ("measured", "liex evaluate tables")
    published = {r["variant"]: r["published_mean_joint_error_mm"] for r in rows}
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
def test_kept_rows_are_used_where_training_and_test_frames_are_the_same(
    made, monkeypatch, tmp_path
):
    rows = cached_results.kept_results("mouse", made / "kept")["rows"]
    skeleton, world = Skeleton.load("mouse"), SmallWorld()
    tests = {split: world.test_split(split) for split in world.splits}
    row, wanted = rows["rf"], run.made_from("rf", skeleton)
    assert not cached_results.fits(row, wanted, tests)  # a quick row never fits
    row["made"]["from"] = wanted
    assert cached_results.fits(row, wanted, tests)
    assert not cached_results.fits(row, run.made_from("cnn", skeleton), tests)
    assert not cached_results.fits(row, wanted, {**tests, "clean": tests["hard"]})
    assert not cached_results.fits(row, wanted, {**tests, "other-body": tests["hard"]})


def test_kept_results_of_another_schema_are_refused_in_a_sentence(tmp_path):
    assert cached_results.kept_results("mouse", tmp_path) == {"rows": {}, "sensitivity": {}}
    for content in ('{"schema": 99}', "no json"):
        (tmp_path / "mouse.json").write_text(content)
        with pytest.raises(LiexError, match=r"mouse\.json") as told:
            cached_results.kept_results("mouse", tmp_path)
        assert "\n" not in str(told.value)


def results_with(means: dict[str, float]) -> run.Results:
    rows = {
        variant: {
            "splits": {
                "clean": {"mean_joint_error_mm": mean},
                "hard": {"mean_joint_error_mm": mean + 1},
            }
        }
        for variant, mean in means.items()
    }
    return run.Results("mouse", [], ["clean", "hard"], rows)


def test_words_follow_the_numbers():
    order = {
        "default": 2.0,
        "paper": 3.0,
        "cnn": 4.0,
        "paper-no-metric": 5.0,
        "rf": 6.0,
        "paper-one-pose": 7.0,
    }
    (sentence,) = table_text._words(results_with(order), quick=False)
    assert sentence == "The methods come out in the paper's order on every split."
    (turned,) = table_text._words(results_with(order | {"rf": 4.5}), quick=False)
    assert (
        "here, RF is ahead on clean (4.50 against 5.00 mm), hard (5.50 against 6.00 mm)." in turned
    )
    ahead, *others = table_text._words(results_with(order | {"cnn": 1.5}), quick=False)
    assert ahead == (
        "CNN is ahead of the default on clean (1.50 against 2.00 mm), hard (2.50 against 3.00 mm)."
    )
    assert len(others) == 1  # and of the paper's variant


def test_every_variant_that_can_be_named_is_known_and_any_other_is_refused(monkeypatch):
    monkeypatch.setattr(pose, "estimator_of", lambda animal, variant, progress: f"{variant} model")
    assert pose.subject_of("mouse", "paper") == "paper model"
    with pytest.raises(PlanError, match=r"no variant 'knn'.*paper-no-metric, rf, cnn"):
        pose.subject_of("mouse", "knn")


def test_the_baselines_learn_from_images_of_the_same_kind_as_our_own_model():
    for animal in bundled_models():
        skeleton = Skeleton.load(animal)
        ours = run.made_from("default", skeleton)["recipe"]
        for variant in ("rf", "cnn"):
            theirs = training_of(variant, skeleton).to_dict()["recipe"]
            assert theirs["degraded_share"] == ours["degraded_share"]
            assert theirs["n_images"] >= 0.8 * ours["n_images"]


def test_a_sweep_changes_one_number_of_a_method_and_nothing_else():
    method = method_of("default", Skeleton.load("mouse"))
    for number, own in chosen_values(method).items():
        assert with_value(method, number, own) == method
        changed = chosen_values(with_value(method, number, own + 7))
        assert changed == chosen_values(method) | {number: own + 7}


def test_what_is_kept_says_how_it_was_made_and_is_of_the_training_and_test_frames_of_today():
    for path in sorted(kept_results_folder().glob("*.json")):
        check_kept(path)


def check_kept(path: Path) -> None:
    skeleton = Skeleton.load(path.stem)
    world, results = simulator.world_of(skeleton), cached_results.kept_results(path.stem)
    tests = {split: world.test_split(split, n_sessions=1) for split in world.splits}
    assert path.stat().st_size < 200_000
    assert set(results["rows"]) == set(run.ROWS)
    for variant, row in results["rows"].items():
        made = row["made"]
        assert made["command"].startswith("liex evaluate tables")
        assert made["version"]
        assert made["code"]
        assert isinstance(made["from"]["recipe"]["seed"], int)
        assert row["rate"]["frames_per_s"] > 0
        assert cached_results.fits(row, run.made_from(variant, skeleton), tests), (
            f"{variant}: refresh with --fresh"
        )
        for numbers in row["splits"].values():
            assert numbers["n_frames"] >= 2000
            assert len(numbers["joint_mm"]) == skeleton.n_joints


def test_a_variant_whose_initial_poses_are_proposed_has_no_number_of_them_to_vary():
    """Curves of it that were kept say the same for every number; they are left out with why."""
    hand, mouse = Skeleton.load("hand"), Skeleton.load("mouse")
    proposed, drawn = method_of("default", hand), method_of("paper", mouse)
    curve = [{"value": n, "mean_mm": 14.7, "median_mm": 8.2} for n in (10, 20)]
    kept = {
        "curves": {"initial poses": curve, "trees": curve},
        "chosen": {"initial poses": 20, "trees": 10},
    }
    told = without_void(kept, proposed)
    assert list(told["curves"]) == list(told["chosen"]) == ["trees"]
    assert "a forest proposes" in told["left_out"]["initial poses"]
    assert without_void(kept, drawn) == {**kept, "left_out": {}}


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
        run.rates_of("mouse", {"default": Failing()}, [Still()])
    assert len(asked) == 2
    assert asked[-1] == before
