"""Whole depth pictures beside a session's replay, read from the recording it is linked to."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
import rerun.chunk
from liex_lab.pipelines.show import whole_pictures
from typer.testing import CliRunner

from liex_lab.cli import sessions as verb
from liex_lab.cli.main import app
from liex_lab.errors import SessionError
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.recordings.writer import McapDepthWriter
from liex_lab.sessions import Session
from liex_lab.sessions.evidence import link_to
from liex_lab.sessions.rrd_scene import DEPTH
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = WalkingMouse(steady(1.0))


@pytest.fixture
def session(tmp_path: Path) -> Session:
    """A session that says where its recording is."""
    recording = tmp_path / "raw" / "circle.mcap"
    recording.parent.mkdir()
    with McapDepthWriter(recording, MOUSE.camera) as writer:
        for row in range(len(MOUSE.times_s)):
            writer.add(MOUSE.frame(row))
    with open_recording(recording) as opened:
        digest = opened.digest()
    place = tmp_path / "circle.liex"
    write(place, MOUSE, plan_toml=Plan().to_toml(), input_sha256=digest, replay_depth="none")
    facts = place / "session.json"
    document = json.loads(facts.read_text())
    document["input"] |= link_to(recording, place)
    facts.write_text(json.dumps(document))
    return Session.open(place)


def test_every_picture_comes_from_the_recording_into_the_sessions_replay(
    session: Session, tmp_path: Path
) -> None:
    out = whole_pictures(session.path, tmp_path / "depth.rrd")
    chunks = [
        chunk.to_record_batch()
        for chunk in rerun.chunk.RrdReader(out).stream().filter(content=f"/{DEPTH}")
    ]
    n = sum(len(chunk.column("frame")) for chunk in chunks if "frame" in chunk.schema.names)
    assert n == len(MOUSE.times_s)
    ids = {
        str(recording.recording_id)
        for file in (out, session.path / "session.rrd")
        for recording in rerun.chunk.RrdReader(file).recordings()
    }
    assert len(ids) == 1, "Rerun shows them as one"


def test_a_recording_that_moved_is_named_and_the_cut_outs_are_shown_all_the_same(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "raw").rename(tmp_path / "elsewhere")
    with pytest.raises(SessionError, match=r"is not at .*circle\.mcap any more"):
        whole_pictures(session.path, tmp_path / "depth.rrd")
    stated = str(tmp_path / "elsewhere" / "circle.mcap")
    assert whole_pictures(session.path, tmp_path / "depth.rrd", stated).is_file()
    shown: list[list[Path]] = []
    monkeypatch.setattr(verb, "_show", lambda replay, more, at_s, web: shown.append(list(more)))
    told = CliRunner().invoke(app, ["show", str(session.path), "--web", "--depth", "all"])
    assert told.exit_code == 0
    assert shown == [[]]
    assert "whole depth pictures are missing" in told.output
    assert "shows what the session keeps" in told.output


def test_the_address_in_the_browser_stands_on_a_line_of_its_own(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[list[str]] = []

    def run(command: list[str], **_: object) -> SimpleNamespace:
        asked.append(command)
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(verb.subprocess, "run", run)
    told = CliRunner().invoke(app, ["show", str(session.path), "--web"])
    assert told.exit_code == 0
    (line,) = [line for line in told.output.splitlines() if "http" in line]
    found = re.fullmatch(
        r"replay: http://127\.0\.0\.1:(\d+)\?url=rerun%2Bhttp%3A%2F%2F127\.0\.0\.1%3A(\d+)"
        r"%2Fproxy   \(Ctrl\+C ends it\)",
        line,
    )
    assert found is not None
    (command,) = asked
    assert command[command.index("--web-viewer-port") + 1] == found[1]
    assert command[command.index("--port") + 1] == found[2]


def test_another_recording_is_refused_by_its_hash(session: Session, tmp_path: Path) -> None:
    other = tmp_path / "raw" / "circle.mcap"
    with McapDepthWriter(other, MOUSE.camera) as writer:
        writer.add(MOUSE.frame(0))
    with pytest.raises(SessionError, match="its hash is another one"):
        whole_pictures(session.path, tmp_path / "depth.rrd")


def test_a_session_that_does_not_say_where_its_recording_is_asks_for_it(
    session: Session, tmp_path: Path
) -> None:
    facts = session.path / "session.json"
    document = json.loads(facts.read_text())
    del document["input"]["path"]
    facts.write_text(json.dumps(document))
    with pytest.raises(SessionError, match="name it with --recording"):
        whole_pictures(session.path, tmp_path / "depth.rrd")


def test_a_recording_without_whole_pictures_asked_for_is_a_wrong_call(session: Session) -> None:
    told = CliRunner().invoke(app, ["show", str(session.path), "--recording", "x.mcap"])
    assert told.exit_code == 2
    assert "--depth all" in told.output
