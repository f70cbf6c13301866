"""Sessions of the animals of one arena become individuals of one file, in every format."""

from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pynwb
import pytest
import xarray
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.actions.vocabulary import INTERACTIONS
from liex_lab.errors import SessionError
from liex_lab.exchange import export
from liex_lab.exchange.nwb import build
from liex_lab.sessions import Session
from tests.sessions.pair import NAMES, write_pair
from tests.sessions.walking_mouse import WalkingMouse, steady, write


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> list[Session]:
    folder = tmp_path_factory.mktemp("individuals")
    return write_pair(folder, session_start_time="2026-08-21T10:00:00+02:00")


def test_deeplabcut_s_tables_have_the_level_individuals(pair, tmp_path):
    folder = export([pair[1], pair[0]], "dlc", tmp_path)
    assert folder.name == "pair_dlc"
    for file, values in (("poses_3d.csv", "xyz_mm"), ("poses_2d.csv", "uv_px")):
        table = pd.read_csv(folder / file, header=[0, 1, 2, 3], index_col=0)
        assert table.columns.names == ["scorer", "individuals", "bodyparts", "coords"]
        for session in pair:
            poses = session.pose_arrays()
            own = table["liex_lab"][poses.individual]["nose"].iloc[:, : poses.xyz_mm.shape[-1]]
            stored = getattr(poses, values)[:, -1]
            np.testing.assert_array_equal(own.iloc[:, : stored.shape[1]], stored)
    assert set(pd.read_csv(folder / "bouts.csv")["individual"]) <= set(NAMES)


def test_sleap_has_a_track_and_movement_an_individual_of_each(pair, tmp_path):
    with h5py.File(export(pair, "sleap", tmp_path)) as file:
        assert file["track_names"].asstr()[:].tolist() == list(NAMES)
        for k, session in enumerate(pair):
            stored = session.pose_arrays().uv_px
            np.testing.assert_array_equal(file["tracks"][k].transpose(2, 1, 0), stored)
        assert file["track_occupancy"][20].tolist() == [1, 0]
        assert np.isnan(file["instance_scores"][1, 20])
    data = xarray.load_dataset(export(pair, "movement", tmp_path), engine="h5netcdf")
    assert data["individuals"].values.tolist() == list(NAMES)
    assert data["position"].dims == ("time", "space", "keypoints", "individuals")
    for session in pair:
        own = data.sel(individuals=[session.metadata["individual"]]).drop_attrs()
        xarray.testing.assert_equal(own, session.to_xarray().drop_attrs())


def test_points_and_interactions_number_the_animals_as_mabe_does(pair, tmp_path):
    folder = export(pair, "points", tmp_path)
    points = pd.read_parquet(folder / "points.parquet")
    assert points["individual"].unique().tolist() == list(NAMES)
    assert pd.read_csv(folder / "mabe.csv")["mouse_id"].unique().tolist() == [1, 2]
    table = pd.read_csv(export(pair, "mabe", tmp_path))
    assert list(table) == ["agent_id", "target_id", "action", "start_frame", "stop_frame"]
    ours = pair[0].interactions.query("target != ''")
    assert len(table) == len(ours) > 0
    assert [NAMES[k - 1] for k in table["agent_id"]] == ours["agent"].tolist()
    words = [INTERACTIONS[word].mabe or word for word in ours["action"]]
    assert table["action"].tolist() == words
    alone = pd.read_csv(export(pair[1], "mabe", tmp_path))  # one session holds those of all
    pd.testing.assert_frame_equal(alone, table)


def test_csv_and_workbook_hold_the_rows_of_all(pair, tmp_path):
    folder = export(pair, "csv", tmp_path)
    sheets = pd.read_excel(export(pair, "xlsx", tmp_path), sheet_name=None)
    for name in ("frames", "poses", "summary", "sessions"):
        for table in (pd.read_csv(folder / f"{name}.csv"), sheets[name]):
            assert table["individual"].drop_duplicates().tolist() == list(NAMES)
            own = table.query("individual == 'animal2'")
            stored = pair[1].summary if name == "summary" else pair[1].table(name)
            assert len(own) == len(stored)
    events = pd.read_csv(folder / "interactions.csv")
    assert len(events) == len(pair[0].interactions)
    assert set(events["session_id"]) == {"pair"}


def test_nwb_has_one_subject_a_file_and_names_the_other(pair, tmp_path):
    with pytest.raises(SessionError, match="nwb holds one animal a file, and there are 2"):
        export(pair, "nwb", tmp_path)
    words = [*map(str, (one.path for one in pair)), "--to", "nwb", "--out", str(tmp_path)]
    ran = CliRunner().invoke(cli.app, ["export", *words])
    assert ran.exit_code == 0, ran.output
    other = build(pair[0])
    with pynwb.NWBHDF5IO(tmp_path / "pair-animal2.nwb", "r") as file:
        read = file.read()
        assert read.subject.subject_id == "animal2"
        assert f"together with animal1: pair-animal1.nwb, identifier {other.identifier}" in (
            read.notes
        )
        events = read.intervals["interactions"].to_dataframe()
        stored = pair[1].interactions
        np.testing.assert_array_equal(events["start_time"], stored["start_s"])
        for name in ("agent", "target", "action"):
            assert list(events[name]) == list(stored[name])
    assert (tmp_path / "pair-animal1.nwb").is_file()


def test_the_verb_joins_the_animals_of_an_arena_and_no_others(pair, tmp_path):
    alone = write(tmp_path / "alone.liex", WalkingMouse(steady(0.5)))
    words = [str(pair[1].path), str(alone.path), str(pair[0].path), "--to", "deeplabcut"]
    ran = CliRunner().invoke(cli.app, ["export", *words, "--out", str(tmp_path / "out")])
    assert ran.exit_code == 0, ran.output
    assert sorted(one.name for one in (tmp_path / "out").iterdir()) == ["circle_dlc", "pair_dlc"]
    with pytest.raises(SessionError, match="pair-animal1 and circle are not of one recording"):
        export([pair[0], alone], "csv", tmp_path)
    with pytest.raises(SessionError, match="of one animal, which has no interactions"):
        export(alone, "mabe", tmp_path)
    with pytest.raises(SessionError, match="several of animal2"):
        export([pair[1], pair[1]], "csv", tmp_path)


def test_animals_with_other_frames_are_refused(pair, tmp_path):
    short = write_pair(tmp_path, 1.0)[1]
    with pytest.raises(SessionError, match="those of pair-animal2 are not those of pair-animal1"):
        export([pair[0], short], "csv", Path(tmp_path))
