"""A disk that takes no more ends a session within seconds, in one sentence, and loses nothing that
a checkpoint was made of.

A limit on the size of files stands for the full disk: it needs no account of its own.
"""

from __future__ import annotations

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
from liex_lab.runtime.places import is_full, why_full
from liex_lab.sessions import SessionWriter
from tests.sessions.interrupted import MOUSE, forked, write_session

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def limited(place: str, limit: int, told: str) -> None:
    """Write the session where no file may be larger; what is said goes to a file."""
    os.dup2(os.open(told, os.O_WRONLY | os.O_CREAT), 2)
    replay._PATIENCE_S = 3.0  # no probe meets a limit above its own size
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    try:
        write_session(place)
    except LiexError as error:
        os.write(2, f"{error}\n".encode())
        sys.exit(1)


# the last four after the last frame: the track is put into the replay, and then its index
@pytest.mark.parametrize(
    "limit", [20_000, 100_000, 300_000, 1_125_000, 1_265_000, 1_322_000, 1_380_000]
)
def test_a_session_that_meets_a_limit_ends_in_a_sentence_and_goes_on_later(
    tmp_path: Path, limit: int
) -> None:
    place = tmp_path / "walk.liex"
    process = forked(limited, str(place), limit, str(tmp_path / "told"))
    process.join(90)
    told = (tmp_path / "told").read_text()
    assert process.exitcode == 1, told
    assert len(told.splitlines()) == 1, told
    assert str(tmp_path) in told
    assert "full" in told or "was not written whole" in told
    assert "run the same command again" in told
    assert not place.exists()
    kept = (tmp_path / "walk.liex.part").is_dir()
    if "full" in told:
        assert kept == ("goes on after" in told)
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


def test_a_replay_whose_thread_is_dead_is_let_go_within_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replay, "_TURN_S", 0.2)
    monkeypatch.setattr(replay.atexit, "unregister", lambda _: None)
    writer = SessionWriter(tmp_path / "walk.liex", MOUSE.provenance())
    writer._replay._stream.disconnect()
    monkeypatch.setattr(writer._replay, "_stream", _Dead())
    monkeypatch.setattr(replay, "probe_full", lambda _: FULL)
    began = time.monotonic()

    def write() -> None:
        with writer:
            frames, track = next(iter(MOUSE.chunks(16)))
            writer.add(frames, seen=track)
            writer._save_checkpoint()

    with pytest.raises(SessionError, match=r"is full \(No space left on device\)"):
        write()
    assert time.monotonic() - began < 10.0
    writer._replay.abandon()  # at once: nothing waits for it any more


def test_a_replay_that_stands_still_on_a_disk_with_room_is_given_up_as_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replay, "_TURN_S", 0.1)
    monkeypatch.setattr(replay, "_PATIENCE_S", 0.5)
    monkeypatch.setattr(replay.atexit, "unregister", lambda _: None)
    writer = replay.ReplayWriter(tmp_path / "session.rrd", MOUSE.provenance())
    writer._stream.disconnect()
    writer._stream = _Dead()
    with pytest.raises(SessionError, match=r"session\.rrd was not written whole"):
        writer.flushed()
    writer.abandon()


def test_which_errors_tell_of_a_full_disk() -> None:
    assert is_full(FULL)
    assert not is_full(PermissionError(errno.EACCES, "no"))
    assert not is_full(ValueError())
    said = why_full(OSError(errno.ENOSPC, "No space left on device", "/data/x"))
    assert said == "the disk that holds /data/x is full (No space left on device)"
