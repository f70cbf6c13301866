"""A human says where head and tail are exchanged: everything in the session follows, and nothing is
lost.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from liex_lab.api import correct_session, run_session
from liex_lab.errors import SessionError
from liex_lab.plan import Plan
from liex_lab.sessions import Session
from liex_lab.sessions.correcting import flip_span

ADDRESS = "synthetic:walk?seed=3&frames=30&sensor=primesense-qvga&spine_mm=70"
SPAN = slice(9, 18)
FROM_S, TO_S = 0.3, 0.6


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Session:
    plan = Plan.load("mouse").with_settings(["animal.spine_mm=70"])
    return Session.open(run_session(ADDRESS, plan, tmp_path_factory.mktemp("tracked")))


@pytest.fixture(scope="module")
def flipped(tracked: Session, tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = Path(
        shutil.copytree(tracked.path, tmp_path_factory.mktemp("flipped") / tracked.path.name)
    )
    return Session.open(correct_session(folder, [flip_span(tracked, FROM_S, TO_S)]))


def along(session: Session) -> np.ndarray:
    """From rump to nose (n, 3)."""
    poses = session.poses.set_index("joint")[["x_mm", "y_mm", "z_mm"]]
    return poses.loc["nose"].to_numpy() - poses.loc["rump"].to_numpy()


def test_the_span_points_the_other_way_and_what_lies_far_from_it_stays(tracked, flipped):
    agree = np.sum(along(tracked) * along(flipped), axis=1)
    assert (agree[SPAN.start + 1 : SPAN.stop - 1] < 0).all()
    assert (agree[: SPAN.start - 3] > 0).all()
    assert (agree[SPAN.stop + 3 :] > 0).all()


def test_every_table_follows(tracked, flipped):
    middle = SPAN.start + 4
    turned = flipped.kinematics["heading_rad"][middle] - tracked.kinematics["heading_rad"][middle]
    assert abs(np.cos(turned) + 1.0) < 0.5
    assert not np.allclose(flipped.rotations["wz_rad"], tracked.rotations["wz_rad"], equal_nan=True)
    for name in ("plan", "camera", "input", "files"):
        assert flipped.metadata[name] == tracked.metadata[name]
    for name in ("frame_index", "time_ns", "gap_before"):
        pd.testing.assert_series_equal(flipped.frames[name], tracked.frames[name])
    (row,) = flipped.flips[flipped.flips["source"] == "human"].itertuples()
    assert (row.start_frame, row.stop_frame, row.applied) == (SPAN.start, SPAN.stop, True)


def test_what_was_measured_is_as_it_was_and_the_correction_can_be_taken_back(
    tracked, flipped, tmp_path
):
    folder = Path(shutil.copytree(flipped.path, tmp_path / flipped.path.name))
    pd.testing.assert_frame_equal(Session.open(folder, raw=True).poses, tracked.poses)
    assert (folder / "poses.parquet").read_bytes() == (tracked.path / "poses.parquet").read_bytes()
    again = Session.open(correct_session(folder, undo=[1]))
    pd.testing.assert_frame_equal(again.poses, tracked.poses)
    pd.testing.assert_frame_equal(again.bouts, tracked.bouts)


def test_a_session_without_what_its_frames_said_tells_what_to_do(tracked, tmp_path):
    folder = Path(shutil.copytree(tracked.path, tmp_path / "old.liex"))
    flip = flip_span(tracked, FROM_S, TO_S)
    (folder / "observations.npz").unlink()
    with pytest.raises(SessionError, match=r"run `liex run` on the recording again"):
        correct_session(folder, [flip])
    (folder / "observations.npz").write_bytes(b"PK not really")
    with pytest.raises(SessionError, match="damaged"):
        correct_session(folder, [flip])
    assert not (folder / "corrected").exists()
