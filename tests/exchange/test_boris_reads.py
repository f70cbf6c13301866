"""BORIS's own reader opens our projects and finds nothing wrong; collected where it is there."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from liex_lab.exchange import export
from liex_lab.sessions import Session
from liex_lab.sessions.session import video_path

READER = Path(__file__).with_name("boris_reader.py")


def read_by_boris(project: Path) -> dict[str, Any]:
    """What BORIS says of a project; in a machine whose own encoding is not UTF-8."""
    done = subprocess.run(
        [sys.executable, READER, project],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={
            **os.environ,
            "QT_QPA_PLATFORM": "offscreen",
            "LC_ALL": "C",
            "PYTHONUTF8": "0",
            "PYTHONCOERCECLOCALE": "0",
        },
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def paired(events: list[list[Any]]) -> list[tuple[float, float, str, str]]:
    """Start, stop (s), action and subject of each bout that BORIS pairs."""
    begun: dict[tuple[str, str], float] = {}
    bouts = []
    for time, subject, code, *_, state in events:
        if state == "START":
            begun[subject, code] = float(time)
        else:
            bouts.append((begun.pop((subject, code)), float(time), code, subject))
    assert not begun
    return sorted(bouts)


def test_boris_reads_every_bout_of_our_project(session, tmp_path):
    found = read_by_boris(export(session, "boris", tmp_path))
    assert (found["changed"], found["message"]) == (False, "")
    (events,) = found["observations"].values()
    stored = session.bouts[["start_s", "stop_s", "action", "individual"]].to_numpy().tolist()
    assert len(stored) >= 3
    for one, other in zip(paired(events), stored, strict=True):
        assert one[:2] == pytest.approx(other[:2], abs=1e-3)  # BORIS keeps milliseconds
        assert list(one[2:]) == other[2:]


def test_boris_misses_nothing_but_the_video_of_a_session_without_one(session, tmp_path):
    found = read_by_boris(export(session, "boris", tmp_path))
    assert found["media"] == {session.name: [""]}
    assert found["faults"].endswith("was not found")


@pytest.mark.parametrize("beside", [True, False], ids=["beside the project", "in the session"])
def test_boris_finds_the_video_that_was_exported(session, tmp_path, beside):
    copy = tmp_path / "circle.liex"
    shutil.copytree(session.path, copy)
    out = tmp_path / "forms"
    out.mkdir()
    video = video_path(out if beside else copy, session.name)
    video.write_bytes(b"frames")
    found = read_by_boris(export(Session.open(copy), "boris", out))
    assert found["faults"] == ""
    assert [Path(path).resolve() for path in found["media"][session.name]] == [video.resolve()]


def test_boris_reads_words_of_any_language_on_any_machine(session, tmp_path):
    copy = tmp_path / "circle.liex"
    shutil.copytree(session.path, copy)
    document = json.loads((copy / "session.json").read_text(encoding="utf-8"))
    document["actions"]["rear"] = "sich aufrichten – Männchen 立"
    (copy / "session.json").write_text(json.dumps(document), encoding="utf-8")
    project = export(Session.open(copy), "boris", tmp_path)
    assert "error" not in read_by_boris(project)
    words = json.loads(project.read_text(encoding="utf-8"))["behaviors_conf"].values()
    assert "sich aufrichten – Männchen 立" in {word["description"] for word in words}
