"""Each format holds the session's own numbers, times and actions, and bad wishes are told in a
sentence.
"""

import errno
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import xarray
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.errors import MissingPackageError, SessionError
from liex_lab.exchange import TARGETS, export
from liex_lab.sessions import Session
from liex_lab.sessions.session import PoseArrays
from liex_lab.tables.rows import Rows
from liex_lab.tables.schema import POSES, to_pandas
from tests.sessions.walking_mouse import WalkingMouse, steady, write


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("out")


def test_every_table_comes_back_from_csv_as_it_was(session, out):
    folder = export(session, "csv", out)
    tables = sorted(path.stem for path in folder.glob("*.csv"))
    assert tables == sorted([*(path.stem for path in session.path.glob("*.parquet")), "summary"])
    for name in ("frames", "poses", "kinematics", "bouts"):
        again = pd.read_csv(folder / f"{name}.csv", keep_default_na=True)
        stored = session.table(name)
        numbers = stored.select_dtypes("number").columns
        np.testing.assert_array_equal(
            again[numbers].to_numpy(float), stored[numbers].to_numpy(float)
        )
    described = {
        (entry["table"], entry["name"])
        for entry in json.loads((folder / "columns.json").read_text())
    }
    assert ("bouts", "path_mm") in described


def test_every_table_is_a_sheet_of_the_workbook_and_texts_are_no_formulas(tmp_path):
    copy = tmp_path / "copy.liex"
    session = write(copy, WalkingMouse(steady(0.5)))
    facts = pd.read_parquet(copy / "sessions.parquet")
    facts.assign(subject_id="=1+1").to_parquet(copy / "sessions.parquet")
    path = export(Session.open(copy), "xlsx", tmp_path)
    sheets = pd.read_excel(path, sheet_name=None)
    names = sorted(file.stem for file in session.path.glob("*.parquet"))
    assert list(sheets) == ["summary", *names, "columns"]
    assert sheets["sessions"].subject_id[0] == "=1+1"
    for name in ("frames", "poses", "kinematics", "bouts"):
        stored = session.table(name)
        numbers = stored.select_dtypes("number").columns
        assert sheets[name].columns.tolist() == stored.columns.tolist()
        np.testing.assert_allclose(  # Excel has 16 digits
            sheets[name][numbers].to_numpy(float), stored[numbers].to_numpy(float), rtol=1e-15
        )
    stamps = sheets["frames"]["time_ns"]
    assert [int(stamp) for stamp in stamps] == session.frames["time_ns"].tolist()
    assert {"table", "name", "unit", "meaning"} <= set(sheets["columns"].columns)


def test_a_table_that_does_not_fit_into_a_workbook_is_refused(session, tmp_path, monkeypatch):
    room = shutil.disk_usage(tmp_path)._replace(free=100_000)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda _: room)
        with pytest.raises(SessionError, match=r"need \d MB in .*, which has 0 MB left; .*TMPDIR"):
            export(session, "xlsx", tmp_path)
    monkeypatch.setattr(import_module("liex_lab.exchange.export"), "MAX_ROWS", 100)
    with pytest.raises(SessionError, match=r"at most 100 rows .* export it as csv"):
        export(session, "xlsx", tmp_path)
    assert not list(tmp_path.iterdir())


_ON_A_FULL_DISK = """
import resource, signal, sys
from liex_lab.exchange import export
from liex_lab.sessions import Session
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
for to in sys.argv[3:]:
    try:
        export(Session.open(sys.argv[1]), to, sys.argv[2])
    except OSError as error:
        print(to, error.strerror)
"""


@pytest.mark.nightly
def test_no_library_of_another_format_writes_to_a_full_disk(session, tmp_path):
    # HDF5 used to try again at the exit, with its own tracebacks and a crash
    targets = ("nwb", "movement", "sleap")
    done = subprocess.run(
        [sys.executable, "-c", _ON_A_FULL_DISK, session.path, tmp_path, *targets],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.stdout.splitlines() == [f"{to} File too large" for to in targets]
    assert (done.stderr, done.returncode) == ("", 0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("target", ["movement", "sleap"])
def test_a_full_disk_is_an_ordinary_error_of_the_only_write(session, tmp_path, monkeypatch, target):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        export(session, target, tmp_path)
    assert not list(tmp_path.iterdir())


def test_deeplabcut_s_tables_have_its_header_and_a_row_for_every_frame(session, out):
    folder = export(session, "dlc", out)
    lines = (folder / "poses_3d.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines[:3]] == ["scorer", "bodyparts", "coords"]
    solid = pd.read_csv(folder / "poses_3d.csv", header=[0, 1, 2], index_col=0)
    flat = pd.read_csv(folder / "poses_2d.csv", header=[0, 1, 2], index_col=0)
    poses = session.pose_arrays()
    np.testing.assert_array_equal(solid["liex_lab"]["nose"].to_numpy(), poses.xyz_mm[:, -1])
    np.testing.assert_array_equal(
        flat["liex_lab"]["nose"][["x", "y"]].to_numpy(), poses.uv_px[:, -1]
    )
    assert list(flat["liex_lab"]["nose"].columns) == ["x", "y", "likelihood"]
    assert solid["liex_lab"]["rump"].iloc[20].isna().all()
    times = pd.read_csv(folder / "times.csv")
    np.testing.assert_allclose(times["time_s"], session.frames["time_s"], atol=1e-9)
    assert len(solid) == len(flat) == len(times) == 116
    np.testing.assert_array_equal(times["pulse_index"], session.frames["pulse_index"])


def test_the_usual_cut_at_a_likelihood_keeps_what_is_trusted_and_nothing_else(tmp_path):
    rng = np.random.default_rng(3)
    mouse = WalkingMouse(steady(4.0), sd_mm=8.0)
    made = mouse.track()
    flags = rng.choice(["", "doubtful", "corrected", "hidden"], 120)
    bridged = rng.random(120) < 0.2
    sd = np.geomspace(0.1, 60.0, 120)[:, None] * rng.uniform(0.7, 1.3, made.sd_mm.shape)
    track = replace(made, flag=flags, bridged=bridged, sd_xy_mm=sd, sd_z_mm=sd)
    table = Rows(track, np.arange(120), "s", "m")
    about = {"individual": "m", "animal": {"joints": track.skeleton.names, "bones": []}}
    joints = pd.concat([to_pandas(POSES, block) for block in table.poses()])
    poses = PoseArrays.of(about, joints, table.frames_table)
    trusted = np.isin(flags, ["", "corrected"]) & ~bridged
    np.testing.assert_array_equal(poses.likelihood >= 0.6, np.repeat(trusted[:, None], 5, axis=1))
    np.testing.assert_array_equal(  # in a file of single precision, too
        poses.likelihood.astype(np.float32) >= 0.6, np.repeat(trusted[:, None], 5, axis=1)
    )
    for some in (trusted, ~trusted):
        worse = np.argsort(sd[some], axis=None)
        assert (np.diff(poses.likelihood[some].ravel()[worse]) <= 1e-12).all()
    assert len(repr(poses)) < 120


def test_every_table_of_a_session_is_an_attribute_and_arrays_need_xarray(session, monkeypatch):
    tables = {"transitions": "transitions", "activity": "activity", "zone_visits": "zones"}
    for attribute, name in tables.items():
        pd.testing.assert_frame_equal(getattr(session, attribute), session.table(name))
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(MissingPackageError, match="labelled data set needs xarray"):
        session.to_xarray()


def test_movement_s_data_set_has_the_true_times_and_the_actions(session, out):
    data = xarray.load_dataset(export(session, "movement", out), engine="h5netcdf")
    xarray.testing.assert_equal(data, session.to_xarray())
    np.testing.assert_array_equal(data["time"], session.frames["time_s"])
    assert data["position"].dims == ("time", "space", "keypoints", "individuals")
    nose = data["position"].sel(keypoints="nose", individuals="mouse_1", space="z")
    np.testing.assert_array_equal(nose, session.poses.query("joint == 'nose'")["z_mm"])
    for axis, column in (("x", "sd_xy_mm"), ("y", "sd_xy_mm"), ("z", "sd_z_mm")):
        spread = data["sd_mm"].sel(keypoints="nose", individuals="mouse_1", space=axis)
        np.testing.assert_array_equal(spread, session.poses.query("joint == 'nose'")[column])
    assert data.attrs["ds_type"] == "poses"
    np.testing.assert_array_equal(data["pulse_index"], session.frames["pulse_index"])
    np.testing.assert_array_equal(
        data["confidence"] >= 0.6, data["position"].notnull().all("space")
    )
    rear = session.bouts[session.bouts["action"] == "rear"].iloc[0]
    inside = (data["time"] >= rear["start_s"]) & (data["time"] < rear["stop_s"])
    np.testing.assert_array_equal((data["action"][:, 0] == "rear").to_numpy(), inside.to_numpy())


def test_sleap_s_arrays_have_its_shapes(session, out):
    path = export(session, "sleap", out)
    poses = session.pose_arrays()
    with h5py.File(path) as file:
        assert file["tracks"].shape == (1, 2, 5, 116)
        np.testing.assert_array_equal(file["tracks"][0].transpose(2, 1, 0), poses.uv_px)
        assert list(file["node_names"].asstr()) == list(poses.joints)
        assert file["track_occupancy"][:, 0].sum() == 114
        assert file["edge_names"].asstr()[0].tolist() == ["rump", "loin"]
        np.testing.assert_array_equal(file["time_s"], session.frames["time_s"])


def test_boris_gets_two_rows_for_every_bout(session, out):
    project = json.loads(export(session, "boris", out).read_text(encoding="utf-8"))
    (observation,) = project["observations"].values()
    codes = {entry["code"] for entry in project["behaviors_conf"].values()}
    events = observation["events"]
    assert len(events) == 2 * len(session.bouts)
    assert [event[0] for event in events] == sorted(event[0] for event in events)
    assert {event[1] for event in events} == {
        entry["name"] for entry in project["subjects_conf"].values()
    }
    assert {event[2] for event in events} <= codes
    found = [
        (start[0], stop[0], code)
        for code in codes
        for own in [[event for event in events if event[2] == code]]
        for start, stop in zip(own[::2], own[1::2], strict=True)
    ]
    stored = session.bouts[["start_s", "stop_s", "action"]].to_numpy().tolist()
    for one, other in zip(sorted(found), stored, strict=True):
        assert one[:2] == pytest.approx(other[:2], abs=1e-6)
        assert one[2] == other[2]
    media = observation["file"]["1"][0]
    assert set(observation["media_info"]["length"]) == {media}
    assert project["project_format_version"] == "7.0"


def test_a_wish_that_cannot_be_met_is_told(session, tmp_path):
    with pytest.raises(SessionError, match="did you mean 'boris'"):
        export(session, "borris", tmp_path)
    path = export(session, "boris", tmp_path)
    with pytest.raises(SessionError, match="exists already"):
        export(session, "boris", tmp_path)
    assert export(session, "boris", tmp_path, overwrite=True) == path
    with pytest.raises(SessionError, match="is a file"):
        export(session, "csv", path)


def test_missing_packages_are_named(session, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, "liex_lab.exchange.nwb", raising=False)
    monkeypatch.setitem(sys.modules, "pynwb", None)
    with pytest.raises(SessionError, match=r"pynwb is missing.*pip install '.\[exchange\]'"):
        export(session, "nwb", tmp_path)


def test_the_verb_writes_beside_the_session_or_where_it_is_told(session, tmp_path):
    words = ["export", str(session.path), "--to", "dlc", "--out", str(tmp_path)]
    ran = CliRunner().invoke(cli.app, words)
    assert ran.exit_code == 0, ran.output
    assert (tmp_path / "circle_dlc" / "poses_3d.csv").is_file()


def test_a_session_without_any_pose_can_be_exported(tmp_path):
    session = write(
        tmp_path / "lost.liex",
        WalkingMouse(steady(0.5), lost=tuple(range(15))),
        session_start_time="2026-08-21T10:00:00+02:00",
    )
    # a workbook takes longer than all others, and mabe is of several animals
    for target in TARGETS.keys() - {"xlsx", "mabe"}:
        assert export(session, target, tmp_path).exists()
