"""A session's times are put on another instrument's clock, as a correction that can be undone."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pynwb
import pytest
from liex_lab.pipelines import sync
from liex_lab.pipelines.correct import correct_session
from liex_lab.pipelines.sync import sync_session
from liex_lab.pipelines.verify import verify_session
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.errors import LiexError, SessionError
from liex_lab.exchange import export
from liex_lab.plan import Plan
from liex_lab.recordings.recording import Recording
from liex_lab.sessions import Session, correcting
from tests.sessions.walking_mouse import WalkingMouse, write

RNG = np.random.default_rng(3)
# a camera that lost frames: true stamps count, not numbers of frames
MOUSE = WalkingMouse(
    np.delete(np.arange(240) / 30.0, [5, 6, 100, 101, 102, 103]), rear_s=(2.0, 3.5)
)
PULSES = np.cumsum(RNG.uniform(0.2, 0.4, 24))


def other_clock(times: Any) -> Any:
    return 512.0 + 1.0002 * np.asarray(times)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = tmp_path_factory.mktemp("measured") / "circle.liex"
    return write(
        folder,
        MOUSE,
        plan_toml=Plan.load("mouse").to_toml(),
        session_start_time="2026-08-21T10:00:00+02:00",
    )


@pytest.fixture
def session(measured: Session, tmp_path: Path) -> Session:
    folder = Session.open(shutil.copytree(measured.path, tmp_path / "circle.liex"))
    pd.DataFrame({"time_s": PULSES}).to_csv(tmp_path / "ours.csv", index=False)
    np.save(tmp_path / "ephys.npy", other_clock(np.delete(PULSES, 4)))
    return folder


def test_a_session_is_synced_corrected_and_undone(session: Session, tmp_path: Path) -> None:
    rewards = np.arange(1.0, 7.0)
    stated = pd.DataFrame({"event": "reward", "time_s": other_clock(rewards)})
    stated.to_csv(tmp_path / "rewards.csv", index=False)
    arguments = ["--with", str(tmp_path / "ephys.npy"), "--pulses", str(tmp_path / "ours.csv")]
    arguments += ["--events", str(tmp_path / "rewards.csv")]
    done = CliRunner().invoke(cli.app, ["sync", str(session.path), *arguments])
    assert done.exit_code == 0, done.output
    assert "23 events, residual 0.00 ms" in done.output
    assert "1 events of the session and 0 of ephys.npy" in done.output
    with_events = Session.open(session.path)
    events = with_events.table("events")
    np.testing.assert_allclose(events["time_s"], rewards, atol=1e-5)
    np.testing.assert_allclose(events["sync_s"], other_clock(rewards), atol=1e-9)
    assert set(events["event"]) == {"reward"}
    assert "About the events" in (session.path / "report.html").read_text(encoding="utf-8")
    ours = tmp_path / "ours.csv"
    for _ in range(2):  # the second time nothing changes
        sync_session(session.path, tmp_path / "ephys.npy", pulses=ours, report=False)
    synced = Session.open(session.path)
    assert len(synced.log.entries) == 2
    assert not synced.has("events.parquet")
    frames, bouts = synced.frames, synced.bouts
    np.testing.assert_allclose(frames["sync_s"], other_clock(frames["time_s"]), atol=1e-5)
    np.testing.assert_allclose(bouts["sync_stop_s"], other_clock(bouts["stop_s"]), atol=1e-5)
    assert frames["sync_sd_ms"].between(0.0, 1.0).all()
    assert synced.metadata["sync"]["name"] == "ephys.npy"
    assert {"sync_s", "sync_start_s"} <= set(synced.columns["name"])
    assert b"sync_s" in pq.read_schema(synced.file("frames.parquet")).metadata[b"liex_lab"]
    assert (session.path / "figures" / "sync.svg").is_file()
    assert "Clock of ephys.npy" in (session.path / "report.html").read_text(encoding="utf-8")
    assert {one.state for one in verify_session(session.path)} <= {"ok", "note"}
    with pynwb.NWBHDF5IO(export(synced, "nwb", tmp_path), "r") as file:
        series = file.read().processing["behavior"]["sync_s"]
        np.testing.assert_array_equal(series.data[:], frames["sync_s"])
        np.testing.assert_array_equal(series.timestamps[:], frames["time_s"])

    moved = correcting.joint_move(synced, 60, "nose", synced.pose_arrays().xyz_mm[60, -1] + 2.0)
    correct_session(session.path, [moved], report=False)
    corrected = Session.open(session.path)
    assert "corrected" in set(corrected.frames["flag"])
    pd.testing.assert_series_equal(corrected.frames["sync_s"], frames["sync_s"])
    assert (corrected.bouts["sync_start_s"] < corrected.bouts["sync_stop_s"]).all()
    correct_session(session.path, undo=[1, 2, 3], report=False)
    undone = Session.open(session.path)
    assert "sync_s" not in undone.frames
    assert "sync" not in undone.metadata


def test_frames_are_pulses_when_the_first_one_is_stated(session: Session, tmp_path: Path) -> None:
    np.save(tmp_path / "exposures.npy", other_clock(np.arange(240) / 30.0))
    fit = sync_session(session.path, tmp_path / "exposures.npy", first=True, report=False)
    assert fit.n_matched == 234
    assert fit.n_unmatched == (0, 6)
    frames = Session.open(session.path).frames
    np.testing.assert_allclose(frames["sync_s"], other_clock(frames["time_s"]), atol=1e-5)


def test_a_clock_that_jumps_leaves_a_gap_and_events_go_to_nwb(
    session: Session, tmp_path: Path
) -> None:
    ours = np.cumsum(RNG.uniform(0.15, 0.45, 26))
    pd.DataFrame({"time_s": ours}).to_csv(tmp_path / "ours.csv", index=False)
    middle = float(ours[12:14].mean())
    np.save(tmp_path / "ephys.npy", other_clock(ours) + 5.0 * (ours > middle))
    rewards = np.array([1.0, middle + 0.01, 7.0])
    stated = pd.DataFrame(
        {"event": "reward", "time_s": other_clock(rewards) + np.array([0, 2.5, 5])}
    )
    stated.to_csv(tmp_path / "rewards.csv", index=False)
    fit = sync_session(
        session.path,
        tmp_path / "ephys.npy",
        pulses=tmp_path / "ours.csv",
        events=tmp_path / "rewards.csv",
        report=False,
    )
    assert len(fit.breaks) == 1
    assert "a clock jumps" in str(fit)
    synced = Session.open(session.path)
    frames = synced.frames
    wanted = other_clock(frames["time_s"]) + 5.0 * (frames["time_s"] > middle)
    known = frames["sync_s"].notna()
    np.testing.assert_allclose(frames["sync_s"][known], wanted[known], atol=1e-4)
    assert 1 <= (~known).sum() < 30
    assert (frames["time_s"][~known] - middle).abs().max() < 1.0
    np.testing.assert_allclose(synced.table("events")["time_s"], [1.0, np.nan, 7.0], atol=1e-4)
    with pynwb.NWBHDF5IO(export(synced, "nwb", tmp_path), "r") as file:
        table = file.read().intervals["events"].to_dataframe()
    np.testing.assert_allclose(table["start_time"], [1.0, 7.0], atol=1e-4)
    assert set(table["event"]) == {"reward"}


def test_stated_pairs_suffice(session: Session, tmp_path: Path) -> None:
    (tmp_path / "pairs.csv").write_text("time_s;other_s\n1,0;11,0\n7,0;17,0\n")
    assert sync_session(session.path, pairs=tmp_path / "pairs.csv", report=False).sd_s is None
    frames = Session.open(session.path).frames
    np.testing.assert_allclose(frames["sync_s"], frames["time_s"] + 10.0)
    assert frames["sync_sd_ms"].isna().all()
    with pytest.raises(SessionError, match="nothing to align"):
        sync_session(session.path)


def test_a_session_is_whole_if_it_is_not_synced(session: Session, tmp_path: Path) -> None:
    before = sorted(path.name for path in session.path.iterdir())
    np.save(tmp_path / "other.npy", np.cumsum(RNG.uniform(0.2, 0.4, 24)))
    with pytest.raises(LiexError, match=r"fit nowhere|more than one way"):
        sync_session(session.path, tmp_path / "other.npy", pulses=tmp_path / "ours.csv")
    assert sorted(path.name for path in session.path.iterdir()) == before


def test_a_blinking_patch_of_the_recording_gives_the_pulses(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read(row: int) -> np.ndarray:
        image = np.full((80, 107), 700.0, np.float32)
        if ((MOUSE.times_s[row] >= PULSES) & (MOUSE.times_s[row] < PULSES + 0.08)).any():
            image[2:6, 3:9] = 0.0  # the LED blinds the camera
        return image

    images = Recording(
        name="circle", format="images", camera=MOUSE.camera, times_ns=MOUSE.times_ns, read=read
    )
    monkeypatch.setattr(sync, "recording_of", lambda *_: images)
    fit = sync_session(session.path, tmp_path / "ephys.npy", patch=(2, 1, 10, 7), report=False)
    assert fit.n_matched >= 20
    assert fit.rms_ms < 20.0  # of frames every 33 ms
    frames = Session.open(session.path).frames
    np.testing.assert_allclose(frames["sync_s"], other_clock(frames["time_s"]), atol=0.015)
    with pytest.raises(SessionError, match=r"LEFT,TOP,RIGHT,BOTTOM in pixels .* of 107 x 80"):
        sync_session(session.path, tmp_path / "ephys.npy", patch=(2, 1, 200, 7))

    def infrared(where: str, plan: Plan, _: Any) -> Recording:
        assert (where, plan.recording.topic) == ("night.mcap", "/ir/image_raw")
        return Recording(  # bright where depth is unread
            name="circle",
            format="mcap",
            camera=MOUSE.camera,
            times_ns=MOUSE.times_ns,
            read=lambda row: np.asarray(900.0 - read(row), np.float32),
        )

    monkeypatch.setattr(sync, "open_planned", infrared)
    plan = Plan.from_toml(session.plan, "plan.toml")
    monkeypatch.setattr(sync, "recording_of", lambda *_: _[3]("night.mcap", plan, None))
    found = sync_session(
        session.path, tmp_path / "ephys.npy", patch=(2, 1, 10, 7), infrared="/ir/image_raw"
    )
    assert (found.own_ns, found.other_s) == (fit.own_ns, fit.other_s)
    with pytest.raises(SessionError, match="state it"):
        sync_session(session.path, tmp_path / "ephys.npy", infrared="/ir/image_raw")
