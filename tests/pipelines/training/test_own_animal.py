"""An animal of the user's own, as docs/tutorials/own-animal.md has it: train, evaluate, run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.build import plan_of
from liex_lab.pipelines.evaluation.pose import evaluate_pose, sizes_of
from liex_lab.pipelines.training import pose_model

from liex_lab.api import run_session
from liex_lab.body.skeleton import Skeleton
from liex_lab.catalog import find_sample
from liex_lab.errors import PlanError
from liex_lab.estimation import method as methods
from liex_lab.estimation.model import Model
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.sessions import Session
from liex_lab.simulation import training_patches
from liex_lab.simulation.species import Species

SNAKE = str(find_sample("snake.toml"))


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few shallow trees."""
    default = methods.METHODS["default"]
    small = replace(
        default,
        rounds=2,
        n_candidates=6,
        training_candidates=4,
        survivors=0,
        pruner=None,
        corrector=None,
        regressors=default.regressors._replace(n_trees=5, max_depth=12, n_tests=50),
        metric=default.metric._replace(n_trees=16, max_depth=7, n_tests=40),
    )
    monkeypatch.setitem(methods.METHODS, "default", small)


def run(model: Path, folder: Path, n_frames: int) -> tuple[Session, np.ndarray]:
    """A session by the plan of the tutorial, and the x coordinates of its joints, mm."""
    plan = folder / "plan.toml"
    plan.write_text(f'[animal]\nskeleton = "{SNAKE}"\n\n[estimation]\nmodel = "{model}"\n')
    recording = open_recording(
        f"synthetic:move?animal={SNAKE}&seed=2&frames={n_frames}&spine_mm=250"
    )
    used = Plan.load(plan)
    if n_frames < 40:  # of a model from few images the expected error is large
        used = used.with_settings(["estimation.accept_misfit=true"])
    session = Session.open(run_session(recording, used, folder))
    joints = session.poses.pivot(index="frame_index", columns="joint", values="x_mm")
    assert joints.shape == (n_frames, 9)
    assert (session.path / "report.html").is_file()
    off = joints.to_numpy().mean(axis=1) - recording.joints_arena[..., 0].mean(axis=1)  # type: ignore[attr-defined]
    return session, off


@pytest.mark.usefixtures("small")
def test_a_model_is_trained_and_runs_with_the_plan_of_the_tutorial(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_patches, "BLOCK", 64)
    model = pose_model.train_model(SNAKE, "default", tmp_path / "snake.npz", n_images=256)
    made = Model.load(model)
    assert made.skeleton.name == "snake"
    assert made.skeleton.view == Skeleton.load(SNAKE).view
    assert made.card["recipe"]["n_images"] == 256
    assert made.method.reach_mm == pytest.approx(22.0 * 240.0 / 52.834, rel=1e-5)
    assert made.calibration.area_mm2 == pytest.approx(4000.0, rel=0.3)
    session, off = run(model, tmp_path, 20)
    assert session.metadata["animal"]["name"] == "snake"
    assert np.isfinite(off).any()
    plan = plan_of(SNAKE).with_settings(["estimation.model=mouse"])
    with pytest.raises(PlanError, match="made for the skeleton mouse"):
        run_session(f"synthetic:move?animal={SNAKE}&frames=3", plan, tmp_path)


@pytest.mark.nightly
@pytest.mark.usefixtures("small")
def test_a_whole_model_finds_rendered_snakes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = pose_model.train_model(SNAKE, "default", tmp_path / "snake.npz", n_images=1024)
    drawn = Species.test_split
    monkeypatch.setattr(
        Species, "test_split", lambda world, name, spine_mm: drawn(world, name, spine_mm, 2)
    )
    result = evaluate_pose(SNAKE, "clean", model=model)
    assert result["n_frames"] == 100
    assert result["lost_rate"] < 0.05
    assert result["median_joint_error_mm"] < 30.0  # of 240; a model from 1,024 images
    session, off = run(model, tmp_path, 40)
    assert np.isfinite(off).mean() > 0.9
    assert np.nanmedian(np.abs(off)) < 12.0
    assert session.metadata["animal"]["spine_mm"] == pytest.approx(250.0, rel=0.15)


def test_the_plan_of_an_own_animal_follows_from_its_toml():
    plan = plan_of(SNAKE)
    assert (plan.animal.spine_min_mm, plan.animal.spine_max_mm) == (144.0, 432.0)
    assert (plan.animal.name, plan.estimation.model) == ("snake", "snake.npz")
    assert plan_of("mouse") == Plan.load("mouse")
    assert sizes_of(SNAKE) == (180.0, 240.0, 300.0, 360.0)
    assert sizes_of("fish") == (18.0, 25.0, 32.0, 45.0)
