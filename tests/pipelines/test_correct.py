"""What people correct in a session is kept beside it, every reader sees it, and it can be taken
back.
"""

import json
import re
import shlex
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from liex_lab.dashboards.report.report import render
from liex_lab.pipelines.correct import correct_session, corrected_track
from liex_lab.pipelines.training.action_model import labelled_sessions
from liex_lab.pipelines.verify import verify_session
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.behaviour.summary import measure_rows, measure_session
from liex_lab.body.pose import Pose
from liex_lab.errors import LiexError, SessionError
from liex_lab.exchange import export
from liex_lab.geometry import SE3
from liex_lab.plan import Plan
from liex_lab.sessions import Session, SessionWriter, correcting
from liex_lab.sessions.correcting import disagreements, flip_span
from liex_lab.sessions.corrections import Correction, FlipSpan, JointMove, Log, LogEntry, read_log
from liex_lab.sessions.evidence import skeleton_of, track_of
from liex_lab.tracking.observations import Observations, reversed_pose
from liex_lab.tracking.track import Subject, Tracked
from tests.golden.test_golden import golden  # noqa: F401
from tests.sessions.walking_mouse import FLOOR_MM, SPINE_MM, WalkingMouse, write

MOUSE = WalkingMouse(np.arange(180) / 30.0, rear_s=(2.0, 3.5), lost=(20, 21))


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return write(
        tmp_path_factory.mktemp("measured") / "circle.liex",
        MOUSE,
        plan_toml=Plan.load("mouse").to_toml(),
    )


@pytest.fixture
def session(measured: Session, tmp_path: Path) -> Session:
    return Session.open(shutil.copytree(measured.path, tmp_path / "circle.liex"))


def corrected(session: Session, *what: Correction, undo: Sequence[int] = ()) -> Session:
    return Session.open(correct_session(session.path, what, author="ada", undo=undo, report=False))


def spans(session: Session) -> list[tuple[str, float, float, str]]:
    rows = session.bouts[["action", "start_s", "stop_s", "source"]].to_dict("records")
    return [
        (str(b["action"]), round(b["start_s"], 3), round(b["stop_s"], 3), str(b["source"]))
        for b in rows
    ]


def contents(folder: Path) -> dict[str, bytes]:
    return {
        p.name: p.read_bytes() for p in folder.iterdir() if p.is_file() and p.name != "report.html"
    }


def test_a_bout_is_renamed_recut_deleted_and_added_and_every_table_follows(
    session: Session,
) -> None:
    before = contents(session.path)
    one = corrected(session, correcting.recut_bout(session, 2.5, 2.2, 3.0))
    assert ("rear", 2.2, 3.0, "human") in spans(one)
    two = corrected(
        one,
        correcting.rename_bout(one, 2.5, "stretch_attend", new_word=True),
        correcting.add_bout(one, "run", 4.0, 4.5),
    )
    assert ("stretch_attend", 2.2, 3.0, "human") in spans(two)
    assert not (two.bouts["action"] == "rear").any()
    assert {"stretch_attend", "run"} <= set(two.metadata["actions"])
    inside = two.bouts[(two.bouts["start_s"] < 4.45) & (two.bouts["stop_s"] > 4.05)]
    assert list(inside["action"]) == ["run"], "what others said of that time is gone"
    assert (two.bouts["stop_s"].to_numpy()[:-1] <= two.bouts["start_s"].to_numpy()[1:] + 1e-9).all()
    summary = two.summary.iloc[0]
    assert (summary["rear_count"], summary["run_count"]) == (0, 1)
    assert summary["stretch_attend_s"] == pytest.approx(0.8, abs=0.01)
    three = corrected(two, correcting.delete_bout(two, 4.2))
    assert not (three.bouts["action"] == "run").any()
    assert contents(session.path) == before, "the session's own files are as they were"


def test_a_joint_that_is_moved_takes_the_chain_along_and_bones_keep_their_lengths(
    session: Session,
) -> None:
    row, target = (
        100,
        session.poses.loc[100 * 5 + 4, ["x_mm", "y_mm", "z_mm"]].to_numpy(float)
        + np.array([0, 0, 12.0]),
    )
    found = corrected(session, correcting.joint_move(session, row, "nose", target))
    was, now = track_of(session), track_of(found)
    assert np.linalg.norm(now.joints_mm[row, -1] - target) < 1.0
    others = np.r_[0 : row - 20, row + 21 : 180]
    np.testing.assert_array_equal(now.joints_mm[others], was.joints_mm[others])
    away = np.linalg.norm(now.joints_mm - was.joints_mm, axis=-1)[:, -1]
    assert (np.diff(away[row : row + 4]) < 0).all()  # the frames around follow, less and less
    assert (np.diff(away[row - 3 : row + 1]) > 0).all()
    seen = found.camera.project(found.T_arena_camera.inverse() @ now.joints_mm)
    np.testing.assert_allclose(now.uv_px, seen, atol=1e-6)
    bones = np.linalg.norm(np.diff(now.joints_mm[row], axis=0), axis=1)
    np.testing.assert_allclose(
        bones, np.linalg.norm(np.diff(was.joints_mm[row], axis=0), axis=1), rtol=1e-9
    )
    pose = Pose(now.root, now.angles_rad, now.scale)[np.array([row])]
    np.testing.assert_allclose(pose.joints(now.skeleton)[0], now.joints_mm[row], atol=1e-6)

    limits = now.skeleton.limits
    assert (now.angles_rad[row] >= limits[..., 0] - 1e-9).all()
    assert (now.angles_rad[row] <= limits[..., 1] + 1e-9).all()
    assert found.frames["flag"][row] == "corrected"
    assert found.metadata["frames"]["flags"]["corrected"] == 1
    raised = found.kinematics["nose_height_mm"][row] - session.kinematics["nose_height_mm"][row]
    assert raised == pytest.approx(12.0, abs=1.0)


def test_a_joint_under_a_pixel_lies_as_deep_under_the_skin_as_it_usually_does(
    session: Session,
) -> None:
    row, chest = 60, 60 * 5 + 2
    uv = session.poses.loc[chest, ["u_px", "v_px"]].to_numpy(float)
    move = correcting.joint_move_at_pixel(session, row, "chest", float(uv[0]), float(uv[1]))
    where = session.poses.loc[chest, ["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    assert (
        np.linalg.norm(np.array([move.x_mm, move.y_mm, move.z_mm]) - where) < 6.0
    )  # the pixels are 7 mm wide


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from([0, 60, 75, 90, 104]), st.integers(-8, 8), st.integers(-8, 8))
def test_a_joint_put_off_the_animal_keeps_its_height_and_none_is_put_below_the_floor(
    measured: Session, row: int, du: int, dv: int
) -> None:
    nose = measured.poses.iloc[5 * row + 4]
    uv = np.round(nose[["u_px", "v_px"]].to_numpy(float)) + np.array([du, dv])
    frame = int(nose["frame_index"])
    move = correcting.joint_move_at_pixel(measured, frame, "nose", *uv)
    seen = MOUSE.frame(row).depth[int(uv[1]), int(uv[0])]
    if seen > FLOOR_MM - 3.0:  # the floor, whose height is 0
        assert move.note == correcting.OFF_THE_ANIMAL
    if move.note:
        assert move.z_mm == pytest.approx(nose["z_mm"], abs=1e-3)
        assert str(move).endswith("height kept: the pixel is not on the animal")
    assert move.z_mm >= 0.0
    place = np.array([move.x_mm, move.y_mm, move.z_mm])
    under = measured.camera.project(measured.T_arena_camera.inverse() @ place)
    np.testing.assert_allclose(under, uv, atol=1e-3)


def test_frames_around_a_joint_that_is_put_on_the_floor_stay_above_it(
    session: Session,
) -> None:
    x, y = session.poses.iloc[5 * 75 + 4][["x_mm", "y_mm"]]
    found = corrected(session, correcting.joint_move(session, 75, "nose", (x, y, 2.0)))
    z = found.poses["z_mm"].to_numpy(float).reshape(-1, 5)
    assert np.nanmin(np.delete(z, 75, axis=0)) >= 0.0
    assert z[75].min() > -1.0  # bones keep their lengths
    with pytest.raises(SessionError, match=r"below the floor; give a height z of 0 mm or more"):
        correcting.joint_move(session, 75, "nose", (x, y, -2.0))


@settings(max_examples=25)
@given(st.lists(st.sampled_from(["new", "undo", "redo"]), max_size=14))
def test_redo_makes_again_what_was_taken_back_until_something_new_is_done(steps: list[str]) -> None:
    log, done, undone = Log("m"), [], []  # type: tuple[Log, list[object], list[object]]
    for k, step in enumerate(steps):
        if step == "new":
            what = correcting.JointMove(k, "nose", 0.0, 0.0, 1.0)
            log, undone = log.added([what]), []
            done.append(what)
        elif step == "undo" and done:
            log = log.added([], [log.standing[-1].number])
            undone.append(done.pop())
        elif step == "redo":
            assert (log.redoable is not None) == bool(undone)
            if log.redoable is not None:
                number, again = log.redoable
                assert again == undone[-1]
                log = log.added([], [number])
                done.append(undone.pop())
        assert [entry.what for entry in log.standing] == done
    stated = json.loads(log.to_json())
    assert [LogEntry.from_dict(entry) for entry in stated["entries"]] == list(log.entries)
    redone = "redo" in steps and len(log.undos) < sum(e.what is None for e in log.entries)
    assert stated["schema_version"] == (3 if redone else 2)


def test_logs_of_earlier_versions_are_read(session: Session) -> None:
    place = session.poses.iloc[4][["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    corrected(session, correcting.joint_move(session, 0, "nose", place + 2.0))
    entry = read_log(session.path).entries[0].to_dict()
    del entry["note"]
    assert LogEntry.from_dict(entry) == read_log(session.path).entries[0]


def test_taken_back_everything_reads_as_measured_and_the_log_says_who_and_when(
    session: Session,
) -> None:
    raw = session.poses
    place = raw.loc[4, ["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    found = corrected(
        session,
        correcting.joint_move(session, 0, "nose", place + 5.0),
        correcting.add_bout(session, "run", 4.0, 4.5),
    )
    assert not found.poses.equals(raw)
    pd.testing.assert_frame_equal(Session.open(session.path, raw=True).poses, raw)
    back = corrected(found, undo=[1, 2])
    pd.testing.assert_frame_equal(back.poses, raw)
    pd.testing.assert_frame_equal(back.bouts, session.bouts)
    log = json.loads((session.path / "corrected" / "corrections.json").read_text())
    assert [(e["number"], e["kind"], e["author"]) for e in log["entries"]] == [
        (1, "joint", "ada"),
        (2, "bout", "ada"),
        (3, "undo", "ada"),
        (4, "undo", "ada"),
    ]
    assert all(e["made_at"].startswith("20") for e in log["entries"])
    with pytest.raises(
        SessionError, match="there is no correction 1 to take back; those that stand are none"
    ):
        corrected(back, undo=[1])


def test_an_edit_of_bouts_alone_leaves_no_copy_of_the_poses_and_measures_as_the_run_did(
    session: Session,
) -> None:
    found = corrected(session, correcting.rename_bout(session, 2.5, "rear"))  # which confirms it
    names = {path.name for path in (session.path / "corrected").iterdir()}
    assert "poses.parquet" not in names
    assert "kinematics.parquet" not in names
    measures = [c for c in session.bouts.columns if c not in ("source", "score", "model_hash")]
    pd.testing.assert_frame_equal(found.bouts[measures], session.bouts[measures])
    pd.testing.assert_frame_equal(found.summary, session.summary)


def test_a_corrected_session_is_no_damaged_one_and_damage_to_its_corrections_is_told(
    session: Session,
) -> None:
    corrected(session, correcting.add_bout(session, "run", 4.0, 4.5))

    def said() -> list[tuple[str, str]]:
        return [(f.state, f.sentence) for f in verify_session(session.path)]

    assert not [sentence for state, sentence in said() if state == "wrong"]
    assert any("1 corrections (ada) stand beside it" in sentence for _, sentence in said())
    (session.path / "corrected" / "bouts.parquet").write_bytes(b"PAR1")
    assert any(
        state == "wrong" and "bouts.parquet was changed" in sentence for state, sentence in said()
    )
    correct_session(session.path, report=False)  # makes them again
    assert not [sentence for state, sentence in said() if state == "wrong"]
    log = session.path / "corrected" / "corrections.json"
    whole = json.loads(log.read_text())
    wrong = {
        "facts": {"frames": {"n_frames": "x"}},
        "entries": [7],
        "files": None,
        "schema_version": 1e999,
        "sum": "0",
    }
    for name, value in wrong.items():
        log.write_text(json.dumps({**whole, name: value}))
        with pytest.raises(SessionError, match="is damaged"):
            Session.open(session.path)
    log.write_text("{")
    with pytest.raises(SessionError, match="is damaged"):
        Session.open(session.path)
    Session.open(session.path, raw=True)


def test_interrupted_at_any_point_the_session_reads_as_before_or_after(session: Session) -> None:
    corrected(session, correcting.add_bout(session, "run", 4.0, 4.5))
    folder = session.path / "corrected"
    folder.rename(session.path / "corrected.old")  # between the two renames
    assert "run" in set(Session.open(session.path).bouts["action"])
    again = corrected(Session.open(session.path), correcting.add_bout(session, "run", 5.0, 5.3))
    assert (again.bouts["action"] == "run").sum() == 2
    assert not (session.path / "corrected.old").exists()
    (session.path / "corrected.part").mkdir()  # left by one that was killed
    corrected(again, undo=[1])
    assert not (session.path / "corrected.part").exists()


def test_exports_and_training_take_what_people_say(session: Session, tmp_path: Path) -> None:
    found = corrected(session, correcting.add_bout(session, "run", 4.0, 4.5))
    folder = export(found, "csv", tmp_path)
    assert "run" in set(pd.read_csv(folder / "bouts.csv")["action"])
    (one,) = labelled_sessions([session.path], [])
    assert set(one.words[120:135]) == {"run"}
    assert set(np.delete(one.words, np.arange(120, 135))) == {""}


def test_a_session_measured_again_keeps_what_people_said(session: Session) -> None:
    corrected(session, correcting.add_bout(session, "run", 4.0, 4.5))
    toml = Plan.load("mouse").to_toml()
    same = write(session.path, MOUSE, plan_toml=toml, overwrite=True)
    assert "run" in set(same.bouts["action"]), "its poses came out the same"
    faster = WalkingMouse(MOUSE.times_s, speed_mm_s=150.0)
    other = write(session.path, faster, plan_toml=toml, overwrite=True)
    assert "run" not in set(other.bouts["action"])
    with pytest.raises(SessionError, match=r"made on another measurement .*liex correct apply"):
        corrected(other, correcting.add_bout(other, "walk", 1.0, 2.0))
    correct_session(session.path, report=False)
    assert "run" in set(Session.open(session.path).bouts["action"])


def test_sessions_of_earlier_versions_can_be_corrected(golden: Session) -> None:  # noqa: F811
    nose = golden.poses[golden.poses["joint"] == "nose"].iloc[3]
    place = nose[["x_mm", "y_mm", "z_mm"]].to_numpy(float) + np.array([3.0, 0.0, 0.0])
    move = correcting.joint_move(golden, int(nose["frame_index"]), "nose", place)
    found = corrected(golden, move, correcting.add_bout(golden, "walk", 0.1, 0.3))
    moved = found.poses[found.poses["joint"] == "nose"].iloc[3]
    assert moved["x_mm"] == pytest.approx(place[0], abs=0.5)
    assert ("walk", "human") in {(b[0], b[3]) for b in spans(found)}


MISTAKES: dict[str, tuple[Callable[[Session], object], str]] = {
    "a word that is none": (
        lambda s: correcting.add_bout(s, "raer", 1.0, 2.0),
        "did you mean 'rear'",
    ),
    "no word": (lambda s: correcting.add_bout(s, "  ", 1.0, 2.0), "an action is a word"),
    "a span backwards": (
        lambda s: correcting.add_bout(s, "rear", 2.0, 1.0),
        "from a time to a later one",
    ),
    "no time": (
        lambda s: correcting.add_bout(s, "rear", float("nan"), 1.0),
        "from a time to a later one",
    ),
    "no bout there": (
        lambda s: correcting.rename_bout(s, 99.0, "rear"),
        r"no bout holds 99 s; the nearest are",
    ),
    "no such frame": (
        lambda s: correcting.joint_move(s, 999, "nose", [0, 0, 0]),
        "there is no frame 999",
    ),
    "no such joint": (lambda s: correcting.joint_move(s, 1, "snout", [0, 0, 0]), "known are rump"),
    "no pose": (lambda s: correcting.joint_move(s, 20, "nose", [0, 0, 0]), "frame 20 has no pose"),
    "far away": (
        lambda s: correcting.joint_move(s, 1, "nose", [900, 0, 0]),
        "the animal is 90 mm long",
    ),
    "no place": (lambda s: correcting.joint_move(s, 1, "nose", [1, 2]), "x, y and z in mm"),
    "beside the picture": (
        lambda s: correcting.joint_move_at_pixel(s, 1, "nose", -3, 5),
        "a pixel is a column and a row",
    ),
    "no frames": (
        lambda s: correcting.flip_span(s, 50, 60),
        "a span to flip is from a time to a later one",
    ),
    "no pose to exchange": (
        lambda s: correcting.flip_span(s, 0.66, 0.72),
        "has a pose, so there is nothing to exchange",
    ),
    "nothing to do again": (
        lambda s: correct_session(s.path, report=False),
        "has no corrections to apply",
    ),
}


def test_a_sentence_makes_the_same_correction_as_its_function(measured: Session) -> None:
    x, y, z = np.round(measured.poses.loc[24, ["x_mm", "y_mm", "z_mm"]].to_numpy(float) + 4.0, 3)
    u, v = measured.poses.loc[24, ["u_px", "v_px"]].to_numpy(float)
    time_s = measured.frames["time_s"].iloc[4]
    nose = correcting.joint_move_at_pixel(measured, 4, "nose", float(u), float(v))
    same = {
        "flip 1.0 1.5": correcting.flip_span(measured, 1.0, 1.5),
        f"joint nose 4 {u} {v}": nose,
        f"joint nose here {u} {v}": nose,
        f"joint nose 4 {x} {y} {z}": correcting.joint_move(measured, 4, "nose", (x, y, z)),
        "rename 2.5 run": correcting.rename_bout(measured, 2.5, "run"),
        "recut 2.5 2.2 3": correcting.recut_bout(measured, 2.5, 2.2, 3.0),
        "delete 2.5": correcting.delete_bout(measured, 2.5),
        "add 'tail rattle' here 4.5 new": correcting.add_bout(
            measured, "tail rattle", time_s, 4.5, new_word=True
        ),
    }
    for sentence, what in same.items():
        assert correcting.parse_correction(measured, sentence, time_s) == what


@pytest.mark.parametrize(
    "sentence", ["", "joint nose", "joint nose 4 here x", "flip 1 2 new", "add 'run 1 2", "fly 1 2"]
)
def test_a_sentence_of_no_form_is_answered_with_the_forms(measured: Session, sentence: str) -> None:
    with pytest.raises(SessionError, match="written as one of: flip FROM TO; joint NAME FRAME U V"):
        correcting.parse_correction(measured, sentence)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_cannot_be_is_refused_with_a_sentence(measured: Session, mistake: str) -> None:
    ask_for, sentence = MISTAKES[mistake]
    with pytest.raises(LiexError, match=sentence):
        ask_for(measured)
    assert not (measured.path / "corrected").exists()


def test_the_command_line_corrects_lists_and_takes_back(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("liex_lab.pipelines.correct.write_views", lambda _: None)

    def liex(*words: object) -> str:
        ran = CliRunner().invoke(cli.app, ["correct", *map(str, words)], env={"COLUMNS": "200"})
        if ran.exception and not isinstance(ran.exception, SystemExit):
            raise ran.exception
        return ran.output

    place = session.path
    assert "corrected: rear of" in liex(
        "bout", place, "--at", 2.5, "--action", "run", "--by", "ada"
    )
    x, y, z = session.poses.loc[24, ["x_mm", "y_mm", "z_mm"]] + 4.0
    assert "corrected: nose of frame 4" in liex(
        "joint", place, "--frame", 4, "--joint", "nose", "--to-mm", x, y, z
    )
    labels = place.parent / "labels.csv"
    pd.DataFrame({"action": ["stroll"], "start_s": [1.0], "stop_s": [2.0]}).to_csv(
        labels, index=False
    )
    liex("bout", place, "--labels", labels)
    assert spans(Session.open(place)) == [("stroll", 1.0, 2.0, "human")]
    liex("undo", place, 3, 4, 5)
    listed = liex("list", place)
    assert "ada" in listed
    assert listed.count("taken back") >= 3
    assert "run" in set(Session.open(place).bouts["action"])
    assert "again:     stroll" in liex("redo", place)
    assert ("stroll", 1.0, 2.0, "human") in spans(Session.open(place))
    liex("apply", place)
    assert "corrections were made by hand by ada" in render(Session.open(place))
    for words in (("bout", place, "--at", 2.5), ("joint", place, "--frame", 4, "--joint", "nose")):
        with pytest.raises(LiexError, match=r"one edit at a time|given in one way"):
            liex(*words)


def test_who_the_animal_is_can_be_said_afterwards_and_taken_back(session: Session) -> None:
    before = contents(session.path)
    invoked = CliRunner().invoke(
        cli.app,
        ["describe", str(session.path), "subject_id=m07", "group=drug", "--by", "ada"],
    )
    assert invoked.exit_code == 0, invoked.output
    told = Session.open(session.path)
    assert (
        told.metadata["subject"] | {"subject_id": "m07", "group": "drug"}
        == told.metadata["subject"]
    )
    row = told.table("sessions").iloc[0]
    assert (row["subject_id"], row["group"]) == ("m07", "drug")
    assert pd.read_parquet(told.file("sessions.parquet"))["group"].iloc[0] == "drug"
    assert set(told.log.files) == {"sessions.parquet"}, "nothing was measured again"
    assert "corrections" not in told.metadata
    assert "drug" in (session.path / "report.html").read_text(encoding="utf-8")
    after = contents(session.path)
    assert {name: after[name] for name in before} == before, "what was written stays as it was"
    assert Session.open(session.path, raw=True).metadata["subject"] == session.metadata["subject"]
    assert all(finding.state != "wrong" for finding in verify_session(session.path))
    again = corrected(told, *correcting.descriptions({"group": ""}))
    assert "group" not in again.metadata["subject"]
    assert again.table("sessions")["group"].iloc[0] == ""
    back = corrected(again, undo=[3])
    assert back.metadata["subject"]["group"] == "drug"


@pytest.mark.parametrize(
    ("facts", "said"),
    [
        ({"grup": "drug"}, "did you mean group"),
        ({"weight": "20"}, "subject_id, group, cage"),
        ({}, "nothing to describe"),
        ({"session_start_time": "yesterday"}, "time zone"),
        ({"age": "grown up"}, "12 weeks"),
        ({"age": "P"}, "12 weeks"),
        ({"species": "rat"}, "Latin name such as Rattus norvegicus"),
    ],
)
def test_a_fact_that_cannot_be_said_is_refused(facts: dict[str, str], said: str) -> None:
    with pytest.raises(LiexError, match=said):
        correcting.descriptions(facts)


# A human says where head and tail are exchanged: everything in the session follows, and nothing is
# lost.


SPAN = slice(9, 18)
FROM_S, TO_S = 0.3, 0.6


@pytest.fixture(scope="module")
def tracked(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """The first second, whose frames allow both ends to be the head."""
    mouse = WalkingMouse(MOUSE.times_s[:30])
    track, seen = mouse.track(), Observations.empty(mouse.skeleton, mouse.times_ns)
    pose = Pose(SE3(track.root_rotation, track.root_mm), track.angles_rad, track.scale)
    for h, either in enumerate((pose, reversed_pose(mouse.skeleton, pose))):
        seen.put_pose(h, either)
        seen.score[:, h], seen.error_mm[:, h], seen.n_px[:, h] = 1.0, 2.0, 100
        seen.centroid_mm[:, h] = track.joints_mm.mean(axis=1)
    subject = Subject(
        mouse.skeleton, mouse.camera, mouse.T_arena_camera, SPINE_MM, 9.0, 0.5, (1.0,) * 5
    )
    origin = mouse.provenance(plan_toml=Plan.load("mouse").to_toml())
    with SessionWriter(tmp_path_factory.mktemp("tracked") / "circle.liex", origin) as writer:
        for frames, _ in mouse.chunks(30):
            writer.add(frames, seen)
        writer.take(Tracked(track, ()), seen, subject)
        return writer.close(**measure_rows(writer.rows).for_session())


@pytest.fixture(scope="module")
def flipped(tracked: Session, tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = Path(
        shutil.copytree(tracked.path, tmp_path_factory.mktemp("flipped") / tracked.path.name)
    )
    return Session.open(correct_session(folder, [flip_span(tracked, FROM_S, TO_S)], report=False))


def along(session: Session) -> np.ndarray:
    """From rump to nose (n, 3)."""
    poses = session.poses.set_index("joint")[["x_mm", "y_mm", "z_mm"]]
    return poses.loc["nose"].to_numpy() - poses.loc["rump"].to_numpy()


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


def test_only_the_frames_of_the_span_change_and_no_flag_does(tracked, flipped):
    was, now = (one.poses["x_mm"].to_numpy().reshape(30, -1) for one in (tracked, flipped))
    changed = np.flatnonzero((was != now).any(axis=1))
    assert changed.tolist() == list(range(SPAN.start, SPAN.stop))
    assert (np.sum(along(tracked) * along(flipped), axis=1)[SPAN] < 0).all()
    pd.testing.assert_series_equal(flipped.frames["flag"], tracked.frames["flag"])
    assert flipped.kinematics["heading_rad"].notna().all()


def test_nothing_is_measured_across_the_ends_of_an_exchange(tracked, flipped):
    for name in ("yaw_rate_rad_s", "speed_mm_s"):
        most = tracked.kinematics[name].abs().max()
        assert flipped.kinematics[name].abs().max() < 1.3 * most
    again = measure_session(flipped)
    stored = flipped.kinematics
    pd.testing.assert_frame_equal(again.kinematics.astype(stored.dtypes), stored)


def test_an_exchange_that_disagrees_names_its_half_turns_and_the_command_that_agrees(
    flipped, tmp_path
):
    (sentence,) = disagreements(flipped)
    assert re.search(
        r"turn of 1[5-8]\d degrees at frame 9 and 1[5-8]\d degrees at frame 18", sentence
    )
    folder = Path(shutil.copytree(flipped.path, tmp_path / "obeyed.liex"))
    commands = re.findall(r"`liex (.*?)`", sentence.replace(str(flipped.path), str(folder)))
    for command in commands:
        ran = CliRunner().invoke(cli.app, shlex.split(command))
        assert ran.exit_code == 0, ran.output
    obeyed = Session.open(folder)
    assert disagreements(obeyed) == []
    assert (np.sum(along(tracked_of(obeyed)) * along(obeyed), axis=1) < 0).all()


def tracked_of(session: Session) -> Session:
    return Session.open(session.path, raw=True)


def test_a_joint_placed_before_its_frame_was_exchanged_is_of_the_other_end(tracked, tmp_path):
    skeleton, row = skeleton_of(tracked), 12
    nose = track_of(tracked, skeleton).joints_mm[row, -1] + np.array([2.0, -2.0, 1.0])
    move = JointMove(row, "nose", *nose.tolist())
    flip = FlipSpan(SPAN.start, SPAN.stop)
    entries = [LogEntry(1, "", "", move), LogEntry(2, "", "", flip)]
    found = corrected_track(tracked, Log("", tuple(entries)), skeleton).track
    assert np.linalg.norm(found.joints_mm[row, 0] - nose) < 1.5, "its rump is there now"
    later = corrected_track(tracked, Log("", tuple(entries[::-1])), skeleton)
    assert np.linalg.norm(later.track.joints_mm[row, -1] - nose) < 20.0, "what was said last holds"


def test_a_session_without_what_its_frames_said_tells_what_to_do(tracked, tmp_path):
    folder = Path(shutil.copytree(tracked.path, tmp_path / "old.liex"))
    flip = flip_span(tracked, FROM_S, TO_S)
    (folder / "observations.npz").unlink()
    with pytest.raises(SessionError, match=r"run `liex run` on the recording again"):
        correct_session(folder, [flip], report=False)
    (folder / "observations.npz").write_bytes(b"PK not really")
    with pytest.raises(SessionError, match="damaged"):
        correct_session(folder, [flip], report=False)
    assert not (folder / "corrected").exists()
