"""`liex verify` believes a session that is what it was, and says what is not."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from liex_lab.pipelines.verify import Finding, verify_session
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.errors import SessionError
from liex_lab.plan import Plan
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


def never(*_: Any, **__: Any) -> Path:
    raise AssertionError("nobody asked for another run")


def wrong(findings: list[Finding]) -> list[str]:
    return [finding.sentence for finding in findings if finding.state == "wrong"]


def test_an_untouched_session_is_what_it_was(whole: Path) -> None:
    findings = verify_session(whole, never)
    assert wrong(findings) == []
    assert [finding.state for finding in findings] == ["ok"] * 4, findings


@pytest.mark.parametrize("name", ["frames.parquet", "summary.csv", "columns.json", "plan.toml"])
def test_a_changed_file_is_found(copy: Path, name: str) -> None:
    content = (copy / name).read_bytes()
    (copy / name).write_bytes(
        content.replace(b"a", b"b", 1) if name != "plan.toml" else content + b"\n"
    )
    assert f"{name} was changed" in wrong(verify_session(copy, never))
    result = CliRunner().invoke(cli.app, ["verify", str(copy)])
    assert result.exit_code == 1
    assert f"wrong {name} was changed" in result.output


def test_a_missing_table_and_cut_logs_are_found(copy: Path) -> None:
    (copy / "summary.csv").unlink()
    for name in ("session.rrd", "session.mcap"):
        data = (copy / name).read_bytes()
        (copy / name).write_bytes(data[: len(data) // 2])
    said = " ".join(wrong(verify_session(copy, never)))
    for what in (
        "summary.csv is missing",
        "session.rrd was changed",
        "session.mcap was changed",
        "not written whole",
    ):
        assert what in said


def test_another_plan_than_the_one_in_session_json_is_found(copy: Path) -> None:
    (copy / "plan.toml").write_text(Plan().with_settings(["seed=9"]).to_toml())
    assert "plan.toml is not the plan in session.json" in wrong(verify_session(copy, never))


def test_what_an_older_session_does_not_say_is_only_noted(copy: Path) -> None:
    document = json.loads((copy / "session.json").read_text())
    del document["files"], document["machine"]
    (copy / "session.json").write_text(json.dumps(document))
    findings = verify_session(copy, never)
    assert wrong(findings) == []
    assert "does not say machine, files" in findings[0].sentence


def test_the_recording_is_measured_again_where_asked(
    whole: Path, recording: Path, tmp_path: Path
) -> None:
    def run(path: str, plan: Plan, out: str, **_: Any) -> Path:
        assert plan.session.name == "circle"
        return write_like(Path(out) / "circle.liex", "")

    assert "all 15 tables are the same" in verify_session(whole, run, str(recording))[
        -1
    ].sentence.replace(
        f"{len([*whole.glob('*.parquet'), *whole.glob('*.csv')])} tables", "15 tables"
    )

    def run_otherwise(path: str, plan: Plan, out: str, **_: Any) -> Path:
        return write_like(Path(out) / "circle.liex", "", speed=210.0)

    assert "other rows in" in wrong(verify_session(whole, run_otherwise, str(recording)))[0]
    other = write_png_folder(
        tmp_path / "other", MOUSE.frame(1).depth.astype("u2")[None], MOUSE.camera
    )
    assert "is not the recording" in wrong(verify_session(whole, never, str(other)))[0]


def test_no_session_is_told(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="is a folder that"):
        verify_session(tmp_path, never)
