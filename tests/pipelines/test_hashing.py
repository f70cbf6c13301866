"""A recording's hash is read while its scene is learned."""

from __future__ import annotations

from pathlib import Path
from threading import Event

import pytest
from liex_lab.pipelines.hashing import hashed_ahead

from liex_lab.recordings import open_recording
from liex_lab.recordings.recording import file_digest
from tests.recordings.writers import depth_frames, write_mcap


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_mcap(tmp_path / "r.mcap", depth_frames(20))


def test_it_is_the_hash_of_the_file_and_is_told_of_once_it_is_waited_for(path: Path) -> None:
    told: list[str] = []
    with open_recording(path) as recording:
        with hashed_ahead(
            recording, path.with_suffix(".part"), lambda *at: told.append(at[2])
        ) as w:
            assert not told
            w()
        assert recording.files.has_digest
        assert recording.digest() == file_digest([path])
    assert set(told) <= {"reading the recording's hash (MB)"}


def test_a_block_that_ends_by_an_error_is_not_held_up(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, ended, blocks = Event(), Event(), iter(range(10**9))

    def endless(_: object, folder: object, tell: object) -> None:
        begun.set()
        try:
            for k in blocks:
                tell(k, None, "")  # type: ignore[operator]
        finally:
            ended.set()

    monkeypatch.setattr("liex_lab.sessions.checkpoint.hash_once", endless)

    def fail() -> None:
        with (
            open_recording(path) as recording,
            hashed_ahead(recording, path.with_suffix(".part"), lambda *_: None),
        ):
            assert begun.wait(20)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert ended.wait(20)


def test_what_goes_wrong_is_raised_where_it_is_waited_for(path: Path) -> None:
    with open_recording(path) as recording:
        path.unlink()
        with (
            hashed_ahead(recording, path.with_suffix(".part"), lambda *_: None) as wait,
            pytest.raises(OSError, match=r"r\.mcap"),
        ):
            wait()
