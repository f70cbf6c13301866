"""Recordings that the dashboard examines and measures: below its folder only, one at a time."""

import sys
import time
from pathlib import Path

import pytest
from liex_lab.pipelines import bench as jobs
from liex_lab.pipelines.bench import Bench

from liex_lab.errors import LiexError


@pytest.fixture
def place(tmp_path: Path) -> Path:
    for name in ("day1/a.mcap", "b.bag", "notes.txt", ".hidden.mcap", "old.liex/session.json"):
        (tmp_path / "study" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "study" / name).touch()
    (tmp_path / "elsewhere.mcap").touch()
    (tmp_path / "study" / "link.mcap").symlink_to(tmp_path / "elsewhere.mcap")
    return tmp_path / "study"


def runs(monkeypatch: pytest.MonkeyPatch, program: str) -> None:
    """Let a program stand for `liex`; its arguments are those of liex."""
    monkeypatch.setattr(
        jobs, "own_python", lambda *words: [sys.executable, "-c", program, *words[2:]]
    )


def ended(bench: Bench) -> dict[str, object]:
    for _ in range(200):
        if not bench.state()["running"]:
            time.sleep(0.1)  # the last lines
            return bench.state()
        time.sleep(0.05)
    raise AssertionError("it still runs")


def test_only_what_is_below_the_folder_is_listed_and_started(place: Path) -> None:
    bench = Bench(place)
    listed = bench.listed("")
    assert (listed["folders"], listed["files"]) == (["day1"], ["b.bag"])
    assert bench.listed("day1")["files"] == ["a.mcap"]
    for at in ("..", "../elsewhere.mcap", "/etc", "link.mcap", "day1/../../x", "gone.mcap"):
        with pytest.raises(LiexError):
            bench.start("doctor", at, "")
        with pytest.raises(LiexError):
            bench.listed(at)
    with pytest.raises(LiexError, match="examined or measured"):
        bench.start("train", "b.bag", "")
    with pytest.raises(LiexError, match="examined or measured"):
        bench.start("run", "b.bag", "--overwrite")
    assert bench.state() == {}


def test_a_run_shows_its_log_and_what_it_printed_and_writes_into_the_folder(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / "a.log").write_text("of an earlier run\n")
    program = (
        "import sys, pathlib; print(sys.argv[1:]); "
        "log = pathlib.Path(sys.argv[-1]) / 'a.log'; "
        "log.open('a').write('t title\\nt measuring: 1 of 2\\n'); sys.exit(4)"
    )
    runs(monkeypatch, program)
    bench = Bench(place)
    bench.start("run", "day1/a.mcap", "mouse")
    state = ended(bench)
    assert state["code"] == 4
    assert state["stages"] == ["measuring: 1 of 2"]
    recording, out = str(place / "day1/a.mcap"), str(place)
    assert state["lines"] == [str(["run", recording, "--plan", "mouse", "--out", out])]


def test_one_job_at_a_time_and_it_can_be_stopped(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs(monkeypatch, "import time; print('begun', flush=True); time.sleep(60)")
    bench = Bench(place)
    bench.start("doctor", "b.bag", "")
    with pytest.raises(LiexError, match=r"b\.bag is being worked on"):
        bench.start("doctor", "day1/a.mcap", "")
    bench.stop()
    assert ended(bench)["code"] not in (0, None)
