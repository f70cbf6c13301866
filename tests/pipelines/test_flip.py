"""A human says where head and tail are exchanged: everything in the session follows, and nothing is lost."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from liex_lab.api import flip_session, run_session
from liex_lab.errors import SessionError
from liex_lab.plan import Plan
from liex_lab.sessions import Session

ADDRESS = "synthetic:walk?seed=3&frames=30&sensor=primesense-qvga&spine_mm=70"
SPAN = slice(9, 18)
FROM_S, TO_S = 0.3, 0.6


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Session:
    plan = Plan.load("mouse").with_settings(["animal.spine_mm=70"])
    return Session.open(run_session(ADDRESS, plan, tmp_path_factory.mktemp("tracked")))


@pytest.fixture(scope="module")
def flipped(tracked: Session, tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = Path(shutil.copytree(tracked.path, tmp_path_factory.mktemp("flipped") / tracked.path.name))
    return Session.open(flip_session(folder, FROM_S, TO_S))


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
    assert flipped.metadata["plan"] == tracked.metadata["plan"]
    assert flipped.metadata["camera"] == tracked.metadata["camera"]
    assert flipped.metadata["input"] == tracked.metadata["input"]
    for name in ("frame_index", "time_ns", "gap_before"):
        pd.testing.assert_series_equal(flipped.frames[name], tracked.frames[name])


def test_the_correction_is_a_row_and_the_tables_as_tracked_stay_beside(tracked, flipped):
    (row,) = flipped.flips[flipped.flips["source"] == "human"].itertuples()
    assert (row.start_frame, row.stop_frame, row.applied, row.undone_at) == (SPAN.start, SPAN.stop, True, "")
    before = flipped.path / "as_tracked"
    pd.testing.assert_frame_equal(pd.read_parquet(before / "poses.parquet"), tracked.poses)
    assert (before / "session.json").is_file()
    assert not list(flipped.path.parent.glob(".flip*"))


def test_taken_back_it_is_as_before_and_the_row_says_when(tracked, flipped, tmp_path):
    folder = Path(shutil.copytree(flipped.path, tmp_path / flipped.path.name))
    again = Session.open(flip_session(folder, 0.0, 1.0, undo=True))
    pd.testing.assert_frame_equal(again.poses, tracked.poses)
    (row,) = again.flips[again.flips["source"] == "human"].itertuples()
    assert str(row.undone_at).startswith("20")
    with pytest.raises(SessionError, match="no correction that a human made lies within"):
        flip_session(folder, 0.0, 1.0, undo=True)


@pytest.mark.parametrize(("start", "stop"), [(0.5, 0.5), (0.6, 0.2), (50.0, 60.0)])
def test_a_span_without_frames_is_refused(tracked, start, stop):
    with pytest.raises(SessionError, match="a span to flip is from a time to a later one"):
        flip_session(tracked.path, start, stop)


def test_a_session_of_an_earlier_version_says_what_to_do(tracked, tmp_path):
    folder = Path(shutil.copytree(tracked.path, tmp_path / "old.liex"))
    (folder / "observations.npz").unlink()
    with pytest.raises(SessionError, match=r"run `liex run` on the recording again"):
        flip_session(folder, FROM_S, TO_S)
    (folder / "observations.npz").write_bytes(b"PK not really")
    with pytest.raises(SessionError, match="damaged"):
        flip_session(folder, FROM_S, TO_S)
