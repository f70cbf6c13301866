"""Crossings: where head and tail, or two animals, were or may have been taken for one another."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from liex_lab.dashboards.app.desk import crossings
from liex_lab.dashboards.figures.animals import session_animals

from liex_lab.errors import SessionError
from liex_lab.sessions import Session
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = WalkingMouse(steady(4.0))
FLIPS = (  # start_s, stop_s, p_flip, applied, source, undone_at
    (0.5, 0.6, 0.97, True, "model", ""),
    (0.7, 0.8, 0.99, True, "model", ""),
    (1.0, 1.2, 0.34, False, "model", ""),
    (2.0, 2.5, 1.0, True, "human", ""),
    (3.0, 3.1, 1.0, True, "human", "2026-01-01T00:00:00Z"),
)


def put_flips(folder: Path, rows: Any = FLIPS) -> None:
    """Let a session say that head and tail were exchanged there."""
    path = folder / "flips.parquet"
    names = ("start_s", "stop_s", "p_flip", "applied", "source", "undone_at")
    table = pd.DataFrame([dict(zip(names, row, strict=True)) for row in rows])
    table["session_id"], table["individual"] = "circle", "mouse_1"
    for name in ("start", "stop"):
        table[f"{name}_frame"] = np.rint(table[f"{name}_s"] * 30.0).astype(np.int64)
    table[pd.read_parquet(path).columns].to_parquet(path)


def found(folder: Path) -> list[dict[str, Any]]:
    session = Session.open(folder)
    return crossings(session, session_animals(session))


def several(folder: Path) -> None:
    """Let a session say that two animals are in view, the second beside the first at 1 to 1.1 s."""
    document = folder / "session.json"
    about = json.loads(document.read_text())
    about["verdict"] = {"n_animals": 2}
    document.write_text(json.dumps(about))
    centre = np.zeros((len(MOUSE.times_s), 4, 3), np.float32)
    centre[:, 2:, 0] = 400.0
    centre[30:33, 2:, 0] = 50.0
    score = np.zeros(centre.shape[:2], np.float32)
    score[:20, 2:], centre[:20, 2:] = np.nan, np.nan
    subject = np.frombuffer(b"{}", np.uint8)
    np.savez_compressed(
        folder / "observations.npz", centroid_mm=centre, score=score, subject=subject
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return write(tmp_path_factory.mktemp("crossings") / "one.liex", MOUSE)


@pytest.fixture
def folder(written: Session, tmp_path: Path) -> Path:
    return Path(shutil.copytree(written.path, tmp_path / "one.liex"))


def test_exchanged_ends_are_reported_in_words_and_near_ones_together(folder: Path) -> None:
    assert found(folder) == []
    put_flips(folder)
    assert [(one["start_s"], one["stop_s"], one["why"]) for one in found(folder)] == [
        (0.5, 0.8, "head and tail were exchanged and are corrected, 2 times (p 0.99)"),
        (1.0, 1.2, "head and tail perhaps exchanged (p 0.34)"),
        (2.0, 2.5, "head and tail exchanged by a person"),
        (3.0, 3.1, "head and tail exchanged by a person and reverted"),
    ]
    assert {(one["kind"], one["individual"]) for one in found(folder)} == {("ends", "mouse_1")}


def test_exchanges_of_measured_animals_come_first_by_their_probability(folder: Path) -> None:
    put_flips(folder)
    met = pd.DataFrame(
        {
            "start_s": [0.4, 1.0, 2.0, 3.0],
            "stop_s": [0.6, 1.2, 2.2, 3.2],
            "animals": "mouse_1;mouse_2",
            "p_swap": [0.05, 0.3, 0.0, 0.001],
            "reviewed_by": ["", "", "ada", ""],
        }
    )
    met.to_parquet(folder / "crossings.parquet")
    (first, second, *others) = found(folder)
    assert (first["start_s"], first["kind"]) == (1.0, "swap")
    assert first["why"] == (
        "mouse_1 and mouse_2 perhaps exchanged (p 0.30): `crossing here` if they are right, "
        "`swap mouse_2 here` if not"
    )
    assert second["start_s"] == 0.4
    assert {one["kind"] for one in others} == {"ends"}
    met.drop(columns="reviewed_by").to_parquet(folder / "crossings.parquet")  # earlier versions
    assert len(found(folder)) == len(others) + 2


def test_a_body_that_jumps_farther_than_it_can_go_may_be_another_object(folder: Path) -> None:
    path = folder / "kinematics.parquet"
    moved = pd.read_parquet(path)
    moved.loc[60, ["x_mm", "y_mm"]] = np.nan
    moved.loc[90:, "x_mm"] += 300.0
    moved.to_parquet(path)
    (jump,) = found(folder)
    assert (jump["start_s"], jump["stop_s"]) == pytest.approx((89 / 30, 3.0))
    assert jump["kind"] == "identity"
    assert "the body jumps" in jump["why"]


def test_of_two_animals_in_view_each_place_where_the_other_may_be_followed_is_told(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "two.liex"
    write(folder, replace(MOUSE, lost=(60, 61)))
    several(folder)
    near, lost = found(folder)
    assert (near["start_s"], near["stop_s"]) == pytest.approx((1.0, 32 / 30))
    assert near["why"] == "two animals come within 50 mm: perhaps the other is followed"
    assert lost["start_s"] == pytest.approx(2.0, abs=0.05)
    assert "perhaps another animal is followed since" in lost["why"]
    (folder / "observations.npz").unlink()  # as of an earlier version
    assert found(folder) == [lost]
    (folder / "observations.npz").write_bytes(b"PK not really")
    with pytest.raises(SessionError, match="damaged"):
        found(folder)


def test_two_animals_of_one_session_may_be_exchanged_where_they_meet(written: Session) -> None:
    session = Session.open(written.path)
    (first,) = session_animals(session)
    second = replace(first, individual="mouse_2")
    second.__dict__["kinematics"] = first.kinematics.assign(
        x_mm=lambda table: table["x_mm"] + np.where(np.arange(len(table)) < 60, 500.0, 40.0)
    )
    meeting = [one for one in crossings(session, [first, second]) if "come within" in one["why"]]
    assert [one["why"] for one in meeting] == [
        "mouse_1 and mouse_2 come within 40 mm: perhaps exchanged"
    ]
    assert meeting[0]["start_s"] == pytest.approx(2.0)
