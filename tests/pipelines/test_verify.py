"""`liex verify` believes a session that is what it was, and says what is not."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import rerun.chunk
from liex_lab.pipelines import verify
from liex_lab.pipelines.drawing import whole_images
from liex_lab.pipelines.verify import Finding, verify_session
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.cli import sessions as verb
from liex_lab.cli.main import app
from liex_lab.errors import SessionError
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.recordings.writer import McapDepthWriter
from liex_lab.sessions import Session
from liex_lab.sessions.evidence import link_to
from liex_lab.sessions.rrd_scene import DEPTH
from tests.recordings.writers import write_png_folder
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = WalkingMouse(steady(1.0))


def write_like(folder: Path, sha256: str, speed: float = 200.0) -> Path:
    """A session as `liex run` would write it."""
    mouse = WalkingMouse(steady(1.0), speed_mm_s=speed)
    from liex_lab.catalog import find_model
    from liex_lab.catalog import sha256 as hash_of

    model = {"name": "mouse", "sha256": hash_of(find_model("mouse"))}
    return write(folder, mouse, plan_toml=Plan().to_toml(), input_sha256=sha256, model=model).path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    frames = MOUSE.frame(0).depth.astype("u2")[None].repeat(3, axis=0)
    return write_png_folder(tmp_path_factory.mktemp("recording") / "circle", frames, MOUSE.camera)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, recording: Path) -> Path:
    from liex_lab.recordings import open_recording

    with open_recording(recording) as opened:
        return write_like(tmp_path_factory.mktemp("whole") / "circle.liex", opened.digest())


@pytest.fixture
def copy(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "circle.liex"))


def wrong(findings: list[Finding]) -> list[str]:
    return [finding.sentence for finding in findings if finding.state == "wrong"]


def test_an_untouched_session_is_what_it_was(whole: Path) -> None:
    findings = verify_session(whole)
    assert wrong(findings) == []
    assert [finding.state for finding in findings] == ["ok"] * 4, findings


@pytest.mark.parametrize("name", ["frames.parquet", "plan.toml"])
def test_a_changed_file_is_found(copy: Path, name: str) -> None:
    content = (copy / name).read_bytes()
    (copy / name).write_bytes(
        content.replace(b"a", b"b", 1) if name != "plan.toml" else content + b"\n"
    )
    assert f"{name} was changed" in wrong(verify_session(copy))
    result = CliRunner().invoke(cli.app, ["verify", str(copy)])
    assert result.exit_code == 1
    assert f"wrong {name} was changed" in result.output


def test_a_missing_table_and_cut_logs_are_found(copy: Path) -> None:
    (copy / "summary.csv").unlink()
    for name in ("session.rrd", "session.mcap"):
        data = (copy / name).read_bytes()
        (copy / name).write_bytes(data[: len(data) // 2])
    said = " ".join(wrong(verify_session(copy)))
    for what in (
        "summary.csv is missing",
        "session.rrd was changed",
        "session.mcap was changed",
        "not written whole",
    ):
        assert what in said


def test_another_plan_than_the_one_in_session_json_is_found(copy: Path) -> None:
    (copy / "plan.toml").write_text(Plan().with_settings(["seed=9"]).to_toml())
    assert "plan.toml is not the plan in session.json" in wrong(verify_session(copy))


def test_what_an_older_session_does_not_say_is_only_noted(copy: Path) -> None:
    document = json.loads((copy / "session.json").read_text())
    del document["files"], document["machine"]
    (copy / "session.json").write_text(json.dumps(document))
    findings = verify_session(copy)
    assert wrong(findings) == []
    assert "lacks machine, files" in findings[0].sentence


@pytest.mark.nightly
def test_the_recording_is_measured_again_where_asked(
    whole: Path, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(path: str, plan: Plan, out: str, **_: Any) -> Path:
        assert plan.session.name == "circle"
        return write_like(Path(out) / "circle.liex", "")

    monkeypatch.setattr(verify, "run_session", run)
    assert "all 15 tables are the same" in verify_session(whole, recording)[-1].sentence.replace(
        f"{len([*whole.glob('*.parquet'), *whole.glob('*.csv')])} tables", "15 tables"
    )

    def run_otherwise(path: str, plan: Plan, out: str, **_: Any) -> Path:
        return write_like(Path(out) / "circle.liex", "", speed=210.0)

    monkeypatch.setattr(verify, "run_session", run_otherwise)
    assert "other rows in" in wrong(verify_session(whole, recording))[0]
    other = write_png_folder(
        tmp_path / "other", MOUSE.frame(1).depth.astype("u2")[None], MOUSE.camera
    )
    assert "is not the recording" in wrong(verify_session(whole, other))[0]


# Whole depth pictures beside a session's replay, read from the recording it is linked to.


SHOWN = WalkingMouse(steady(1.0))


@pytest.fixture
def linked(tmp_path: Path) -> Session:
    """A session that says where its recording is."""
    recording = tmp_path / "raw" / "circle.mcap"
    recording.parent.mkdir()
    with McapDepthWriter(recording, SHOWN.camera) as writer:
        for row in range(len(SHOWN.times_s)):
            writer.add(SHOWN.frame(row))
    with open_recording(recording) as opened:
        digest = opened.digest()
    place = tmp_path / "circle.liex"
    write(place, SHOWN, plan_toml=Plan().to_toml(), input_sha256=digest, replay_depth="none")
    facts = place / "session.json"
    document = json.loads(facts.read_text())
    document["input"] |= link_to(recording, place)
    facts.write_text(json.dumps(document))
    return Session.open(place)


def test_every_picture_comes_from_the_recording_into_the_sessions_replay(
    linked: Session, tmp_path: Path
) -> None:
    out = whole_images(linked.path, tmp_path / "depth.rrd")
    chunks = [
        chunk.to_record_batch()
        for chunk in rerun.chunk.RrdReader(out).stream().filter(content=f"/{DEPTH}")
    ]
    n = sum(len(chunk.column("frame")) for chunk in chunks if "frame" in chunk.schema.names)
    assert n == len(SHOWN.times_s)
    ids = {
        str(recording.recording_id)
        for file in (out, linked.path / "session.rrd")
        for recording in rerun.chunk.RrdReader(file).recordings()
    }
    assert len(ids) == 1, "Rerun shows them as one"


def test_a_recording_that_moved_is_named_and_the_cut_outs_are_shown_all_the_same(
    linked: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "raw").rename(tmp_path / "elsewhere")
    with pytest.raises(SessionError, match=r"is not at .*circle\.mcap any more"):
        whole_images(linked.path, tmp_path / "depth.rrd")
    stated = str(tmp_path / "elsewhere" / "circle.mcap")
    assert whole_images(linked.path, tmp_path / "depth.rrd", stated).is_file()
    shown: list[list[Path]] = []
    monkeypatch.setattr(verb, "_show", lambda replay, more, at_s, web: shown.append(list(more)))
    told = CliRunner().invoke(app, ["show", str(linked.path), "--web", "--depth", "all"])
    assert told.exit_code == 0
    assert shown == [[]]
    assert "full depth images are missing" in told.output
    assert "shows what the session keeps" in told.output


def test_another_recording_is_refused_by_its_hash(linked: Session, tmp_path: Path) -> None:
    other = tmp_path / "raw" / "circle.mcap"
    with McapDepthWriter(other, SHOWN.camera) as writer:
        writer.add(SHOWN.frame(0))
    with pytest.raises(SessionError, match="its hash is another one"):
        whole_images(linked.path, tmp_path / "depth.rrd")


def test_a_session_that_does_not_say_where_its_recording_is_asks_for_it(
    linked: Session, tmp_path: Path
) -> None:
    facts = linked.path / "session.json"
    document = json.loads(facts.read_text())
    del document["input"]["path"]
    facts.write_text(json.dumps(document))
    with pytest.raises(SessionError, match="name it with --recording"):
        whole_images(linked.path, tmp_path / "depth.rrd")


def test_a_recording_without_whole_pictures_asked_for_is_a_wrong_call(linked: Session) -> None:
    told = CliRunner().invoke(app, ["show", str(linked.path), "--recording", "x.mcap"])
    assert told.exit_code == 2
    assert "--depth all" in told.output
