"""An NWB file holds the session's own poses, actions and animal, and archives would take it."""

import json
import subprocess
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pynwb import NWBHDF5IO, validate

from liex_lab.errors import SessionError
from liex_lab.exchange import export
from liex_lab.exchange.nwb import build, observed_spans
from liex_lab.sessions import Session
from liex_lab.sessions.corrections import BoutEdit, Log, LogEntry
from tests.sessions.walking_mouse import WalkingMouse, steady, write

BEGINNING = "2026-08-21T10:00:00+02:00"


@pytest.fixture(scope="module")
def nwb(session: Session, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return export(session, "nwb", tmp_path_factory.mktemp("nwb"))


def test_pynwb_reads_poses_times_rotations_and_actions(session, nwb):
    poses = session.pose_arrays()
    with NWBHDF5IO(nwb, "r") as file:
        read = file.read()
        module = read.processing["behavior"]
        estimate = module["PoseEstimation"]
        assert list(estimate.skeleton.nodes[:]) == list(poses.joints)
        for k, joint in enumerate(poses.joints):
            series = estimate.pose_estimation_series[joint]
            np.testing.assert_array_equal(series.data[:], poses.xyz_mm[:, k].astype(np.float32))
            np.testing.assert_array_equal(series.timestamps[:], poses.time_s)
            assert series.unit == "millimeters"
        assert module["rotation_root"].data.shape == (116, 3)
        actions = read.intervals["actions"].to_dataframe()
        np.testing.assert_array_equal(actions["start_time"], session.bouts["start_s"])
        np.testing.assert_array_equal(actions["stop_time"], session.bouts["stop_s"])
        assert list(actions["label"]) == list(session.bouts["action"])
        assert read.session_start_time == datetime.fromisoformat(BEGINNING)


def test_nwb_is_refused_without_a_beginning(tmp_path):
    session = write(tmp_path / "c.liex", WalkingMouse(steady(0.5)))
    with pytest.raises(SessionError, match="session_start_time=2026"):
        export(session, "nwb", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["c.liex"]  # nothing half-written


def test_actions_are_an_ethogram_of_ndx_ethogram_made_of_these_poses(session, nwb):
    with NWBHDF5IO(nwb, "r") as file:
        read = file.read()
        actions = read.intervals["actions"]
        assert actions.neurodata_type == "EthogramBouts"
        assert actions.labeling_method == "automated"
        assert actions.source_software.startswith("liex_lab ")
        assert actions.annotator is None
        assert json.loads(actions.parameters) == {"rules": session.metadata["rules"]}
        assert actions.source_pose is read.processing["behavior"]["PoseEstimation"]
        assert list(actions["named_by"][:]) == list(session.bouts["source"])
        words = actions.ethogram.to_dataframe().set_index("behavior")
        assert words["definition"].to_dict() == session.metadata["actions"]
        assert set(words["behavior_type"]) == {"state"}
        assert actions.ethogram is read.processing["behavior"]["Ethogram"]
        assert actions.ethogram.exclusive


_WITHOUT_THE_EXTENSION = """
import sys
from pynwb import NWBHDF5IO
with NWBHDF5IO(sys.argv[1], "r") as file:
    print(file.read().intervals["actions"].to_dataframe()["label"].tolist())
print("ndx_ethogram" in sys.modules)
"""


@pytest.mark.nightly
def test_actions_are_read_where_ndx_ethogram_is_not_known(session, nwb):
    done = subprocess.run(
        [sys.executable, "-c", _WITHOUT_THE_EXTENSION, nwb],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert done.stdout.splitlines() == [str(session.bouts["action"].tolist()), "False"]


def test_bouts_lie_where_actions_could_be_named(session, nwb):
    with NWBHDF5IO(nwb, "r") as file:
        actions = file.read().intervals["actions"]
        seen = actions.observation_intervals.to_dataframe()
        bouts = actions.to_dataframe()
    gap = session.gaps.iloc[0]
    assert ((seen["stop_time"] <= gap["start_s"]) | (seen["start_time"] >= gap["stop_s"])).all()
    for start, stop in zip(bouts["start_time"], bouts["stop_time"], strict=True):
        assert ((seen["start_time"] <= start) & (stop <= seen["stop_time"])).any()


def test_a_recording_without_gaps_was_observed_throughout(tmp_path):
    session = write(tmp_path / "c.liex", WalkingMouse(steady(2.0)), session_start_time=BEGINNING)
    spans = observed_spans(session.pose_arrays())
    np.testing.assert_allclose(spans, [[0.0, 2.0]])
    made = build(session)
    assert set(made.intervals) == {"actions"}
    assert made.intervals["actions"].observation_intervals is None


def test_an_ethogram_that_people_corrected_names_them(session):
    edit = BoutEdit("rename", "run", 1, 2)
    log = Log("", (LogEntry(1, "ada", BEGINNING, edit), LogEntry(2, "bob", BEGINNING, edit)))
    actions = build(Session(session.path, session.metadata, log)).intervals["actions"]
    assert (actions.labeling_method, actions.annotator) == ("curated", "ada, bob")
    assert build(session).identifier == build(session).identifier


def test_all_that_is_known_of_the_animal_stands_in_the_file(nwb):
    with NWBHDF5IO(nwb, "r") as file:
        read = file.read()
        animal = read.subject
        known = (animal.subject_id, animal.species, animal.sex, animal.age)
        assert known == ("m01", "Mus musculus", "F", "P12W")
        assert animal.description == "mouse, group control, cage c3, batch b2"
        assert dict(line.split(": ", 1) for line in read.notes.splitlines()) == {
            "individual": "mouse_1",
            "subject_id": "m01",
            "group": "control",
            "cage": "c3",
            "sex": "female",
            "batch": "b2",
            "age": "P12W",
        }


def refused_by(path: Path) -> set[str]:
    """Checks for which DANDI's validator would refuse a file."""
    from nwbinspector import Importance, inspect_nwbfile, load_config

    found: list[Any] = list(inspect_nwbfile(nwbfile_path=path, config=load_config("dandi")))
    light = Importance.BEST_PRACTICE_SUGGESTION.value
    return {one.check_function_name for one in found if one.importance.value > light}


@pytest.mark.nightly
def test_a_file_is_valid(nwb):
    assert validate(path=nwb) in ([], ([], 0))


def other_animal(session: Session) -> Session:
    subject = {"subject_id": "c3/1", "sex": "male", "species": "Rattus norvegicus"}
    return Session(session.path, {**session.metadata, "subject": subject})


def test_an_id_with_a_slash_and_a_species_of_ones_own_are_stored(session):
    made = build(other_animal(session))
    assert (made.subject.subject_id, made.subject.species) == ("c3-1", "Rattus norvegicus")
    assert "subject_id: c3/1" in made.notes.splitlines()


@pytest.mark.nightly
def test_dandi_accepts_an_animal_that_is_described_and_requires_nothing_but_the_age(
    session, nwb, tmp_path
):
    assert refused_by(nwb) == set()
    other = export(other_animal(session), "nwb", tmp_path)
    assert validate(path=other) in ([], ([], 0))
    assert refused_by(other) == {"check_subject_age"}
