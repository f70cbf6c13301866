"""A disk that takes no more ends a session within seconds, in one sentence, and loses nothing that
a checkpoint was made of.

A limit on the size of files stands for the full disk: it needs no account of its own.
"""

import errno
import os
import resource
import signal
import sys
import time
from pathlib import Path
from typing import Any

import pytest

import liex_lab.sessions.rrd as replay
from liex_lab.errors import LiexError, SessionError
from liex_lab.runtime.durable import is_full, why_full
from liex_lab.sessions import SessionWriter
from tests.sessions.interrupted import MOUSE, forked, write_session

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def limited(place: str, limit: int, report: str) -> None:
    """Write the session where no file may be larger; the error's message goes to a file."""
    os.dup2(os.open(report, os.O_WRONLY | os.O_CREAT), 2)
    replay._TURN_S, replay._PATIENCE_S = 0.3, 0.6  # no probe meets a limit above its own size
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    try:
        write_session(place)
    except LiexError as error:
        os.write(2, f"{error}\n".encode())
        sys.exit(1)


# the last four after the last frame: the track is put into the replay, and then its index
@pytest.mark.parametrize(
    "limit",
    [
        300_000,
        *(
            pytest.param(limit, marks=pytest.mark.nightly)
            for limit in (20_000, 100_000, 1_125_000, 1_265_000, 1_322_000, 1_380_000)
        ),
    ],
)
def test_a_session_that_meets_a_limit_ends_in_a_sentence_and_resumes_later(
    tmp_path: Path, limit: int
) -> None:
    place = tmp_path / "walk.liex"
    process = forked(limited, str(place), limit, str(tmp_path / "report"))
    process.join(90)
    report = (tmp_path / "report").read_text()
    assert process.exitcode == 1, report
    assert len(report.splitlines()) == 1, report
    assert str(tmp_path) in report
    assert "full" in report or "was not written whole" in report
    assert "run the same command again" in report
    assert not place.exists()
    if "full" in report:
        assert (tmp_path / "walk.liex.part").is_dir() == ("resumes after" in report)
    write_session(str(place))
    assert (place / "session.json").is_file()


class _Dead:
    """A Rerun stream whose thread is dead: a flush waits as long as it may, closing for ever."""

    def flush(self, *, timeout_sec: float = 1e38) -> None:
        time.sleep(timeout_sec)
        raise RuntimeError("Flush timed out")

    def disconnect(self) -> None:
        time.sleep(1e9)

    def __getattr__(self, name: str) -> Any:
        return lambda *_what, **_how: None


@pytest.mark.parametrize("full", [True, False])
def test_a_replay_whose_thread_is_dead_is_abandoned_within_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, full: bool
) -> None:
    monkeypatch.setattr(replay, "_TURN_S", 0.1)
    monkeypatch.setattr(replay, "_PATIENCE_S", 60.0 if full else 0.5)
    monkeypatch.setattr(replay.atexit, "unregister", lambda _: None)
    writer = SessionWriter(tmp_path / "walk.liex", MOUSE.provenance())
    writer._replay._stream.disconnect()
    monkeypatch.setattr(writer._replay, "_stream", _Dead())
    monkeypatch.setattr(replay.durable, "probe_full", lambda _: FULL if full else None)
    began = time.monotonic()

    def write() -> None:
        with writer:
            frames, track = next(iter(MOUSE.chunks(16)))
            writer.add(frames, observations=track)
            writer._save_checkpoint()

    said = r"is full \(No space left on device\)" if full else r"session\.rrd was not written whole"
    with pytest.raises(SessionError, match=said):
        write()
    assert time.monotonic() - began < 10.0
    writer._replay.abandon()  # at once: nothing waits for it any more


def test_which_errors_tell_of_a_full_disk() -> None:
    assert is_full(FULL)
    assert not is_full(PermissionError(errno.EACCES, "no"))
    assert not is_full(ValueError())
    said = why_full(OSError(errno.ENOSPC, "No space left on device", "/data/x"))
    assert said == "the disk that holds /data/x is full (No space left on device)"
