"""The whole line on a swimming fish with the bundled model, held against the truth it was rendered
from.
"""

import numpy as np
import pytest

from liex_lab import catalog
from liex_lab.api import run_session
from liex_lab.estimation.model import Model
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.sessions import Session

N_FRAMES, SPINE_MM = 24, 34.0


def test_a_fish_is_measured_with_the_bundled_model(tmp_path):
    swim = open_recording(f"synthetic:swim?seed=11&frames={N_FRAMES}&spine_mm={SPINE_MM}")
    session = Session.open(run_session(swim, Plan.load("fish"), tmp_path, report=False))
    joints = session.poses[["x_mm", "y_mm", "z_mm"]].to_numpy().reshape(N_FRAMES, -1, 3)
    true = swim.joints_camera  # type: ignore[attr-defined]
    off = np.linalg.norm(session.T_arena_camera.inverse() @ joints - true, axis=-1).mean(axis=1)
    assert np.isfinite(off).mean() > 0.95
    assert np.nanmean(off) < 0.03 * SPINE_MM
    assert 0.4 < np.nanmedian(session.frames["predicted_error_mm"]) / np.nanmedian(off) < 2.5
    assert session.metadata["animal"]["joints"][0] == "head"
    assert session.metadata["animal"]["spine_mm"] == pytest.approx(SPINE_MM, rel=0.05)
    assert set(session.poses["joint"]) >= {"head", "tail_tip"}
    assert (session.frames["flag"].fillna("") == "").mean() > 0.8


def test_the_bundled_model_is_a_fish_s_and_small():
    model = Model.load(catalog.find_model("fish"))
    assert (model.skeleton.name, model.skeleton.dof, model.skeleton.n_joints) == ("fish", 25, 21)
    assert model.card["variant"] == "default"
    assert catalog.find_model("fish").stat().st_size < 15e6
