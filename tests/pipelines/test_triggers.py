"""Triggers of a live recording: sent, logged, kept in the session and compared with it."""

import json
import socket
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines.triggers import Triggers, TriggerWatch
from typer.testing import CliRunner

from liex_lab import Session, cli
from liex_lab.behaviour.triggers import values_of
from liex_lab.errors import LiexError
from liex_lab.exchange.senders import Sender
from liex_lab.plan import Plan
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.streaming import Arrival
from liex_lab.tracking.track import Track

SOURCE = "synthetic:walk?seed=3&frames=120&sensor=primesense-qvga&spine_mm=70"
LIVE = ["live", SOURCE, "--replay", "--to", "none", "--set", "animal.spine_mm=70"]
RULE = "speed_mm_s > 30 until speed_mm_s < 15"


@pytest.fixture(scope="module")
def triggered(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a live session with two rules, and what was printed."""
    out = tmp_path_factory.mktemp("live")
    rules = ["--trigger", RULE, "--trigger", "walk", "--send", "udp://127.0.0.1:9"]
    result = CliRunner().invoke(cli.app, [*LIVE, *rules, "--out", str(out)])
    assert result.exit_code == 0, result.output
    return out, result.output


def test_every_event_is_in_the_log_and_in_the_session(triggered: tuple[Path, str]) -> None:
    out, printed = triggered
    session = Session.open(next(out.glob("*.liex")))
    table = session.table("triggers")
    (log,) = out.glob("*.triggers.jsonl")
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [line["count"] for line in lines] == table["count"].tolist()
    assert len(table) > 0
    assert set(table["outcome"]) <= {"sent", "late"}
    about = session.metadata["triggers"]
    assert about["stated"]["rules"] == [RULE, "walk"]
    for one in about["rules"]:
        own = table[table["rule"] == one["rule"]]
        assert one["n_events"] == len(own)
        matched = int(own["session_offset_ms"].notna().sum())
        assert matched == one["n_session"] - len(one["missed_s"])
        if len(own):
            assert one["precision"] == pytest.approx(matched / len(own))
    assert printed.rstrip().splitlines()[-1].startswith("trigger 'walk': ")
    assert "precision" in printed
    page = (session.path / "report.html").read_text()
    assert "speed_mm_s &gt; 30 until" in page


def test_what_cannot_be_used_is_refused_before_the_recording_is_opened(tmp_path: Path) -> None:
    for options, why in (
        (["--trigger", "fly"], "fly is no column, action or zone"),
        (["--trigger", "in nest"], "the plan draws none"),
        (["--trigger", "walk", "--send", "ftp://a"], "a trigger is sent to udp://"),
        (["--send", "udp://127.0.0.1:9"], "names a receiver, but no rule"),
    ):
        found = CliRunner().invoke(cli.app, ["live", "no/such/file", "--to", "none", *options])
        assert isinstance(found.exception, LiexError)
        assert why in str(found.exception)
    found = CliRunner().invoke(
        cli.app, ["live", "127.0.0.1:9", "--to", "none", "--out", str(tmp_path)]
    )
    assert "leaves no recording" in str(found.exception)


def _fired(watch: TriggerWatch, monkeypatch: pytest.MonkeyPatch, n: int = 400) -> list[Any]:
    """Outcomes of n events in n pairs of frames."""
    row = Track.empty(watch_skeleton(), np.zeros(1, np.int64))
    holds = iter(np.tile([1.0, 0.0], n).tolist())
    watch.follow(["animal"])
    monkeypatch.setattr(watch, "_values", lambda _: {"walk": np.array([next(holds)])})
    for k in range(2 * n):
        row.times_ns[:] = k * 10**9
        frame = DepthFrame(k, k * 10**9, np.zeros((1, 1), np.float32))
        watch.add(Arrival(frame, time.perf_counter() if k < 2 * n - 2 else 0.0), [row])
    watch.close()
    return [event["outcome"] for event in watch.events]


def watch_skeleton() -> Any:
    from liex_lab.body.skeleton import Skeleton

    return Skeleton.load("mouse")


def test_a_share_is_withheld_by_the_seed_and_a_dead_receiver_stops_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = Plan.load("mouse")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        address = f"udp://127.0.0.1:{receiver.getsockname()[1]}"
        stated = Triggers(("walk",), (address,), duration_s=0.0, probability=0.25)
        watch = TriggerWatch(stated, plan)
        outcomes = _fired(watch, monkeypatch)
        assert json.loads(receiver.recv(4096))["rule"] == "walk"
    assert outcomes[-1] == "late", "a frame that waited long is not sent"
    assert len(outcomes) == 400
    assert 70 < outcomes.count("sent") < 130
    assert _fired(TriggerWatch(stated, plan), monkeypatch) == outcomes

    def refuse(line: str) -> None:
        raise OSError("unplugged")

    watch = TriggerWatch(replace(stated, addresses=()), plan)
    monkeypatch.setattr(watch, "_senders", {address: Sender(refuse, lambda: None)})
    assert _fired(watch, monkeypatch).count("failed") == outcomes.count("sent")
    assert watch.problems == {address: "unplugged"}


def test_zones_joints_and_columns_have_values_where_something_was_measured() -> None:
    from liex_lab.scene.zones import Zone
    from liex_lab.tables.rows import Rows

    track = Track.empty(watch_skeleton(), np.arange(2, dtype=np.int64))
    track.joints_mm[0] = 5.0
    track.centroid_mm[0] = 1.0
    rows = Rows(track, np.arange(2), "a", "b", zones=[Zone("nest", (0.0, 0.0, 9.0))])
    found = values_of(
        ["in_nest", "nose_z_mm", "walk", "speed_mm_s", "wall_distance_mm"],
        rows,
        {"speed_mm_s": [1.0, 2.0]},
        {"walk": True},
    )
    expected = {"in_nest": 1.0, "nose_z_mm": 5.0, "walk": 1.0, "speed_mm_s": 1.0}
    for name, value in expected.items():
        assert found[name][0] == value
    assert np.isnan([found[name][1] for name in ("in_nest", "nose_z_mm", "walk")]).all()
