"""Pictures by a file's own index are those of a walk over it, and a file without one says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from liex_lab.dashboards.app.frames import Frames

from liex_lab.errors import RecordingError
from liex_lab.sessions import Session
from liex_lab.sessions.cutouts import open_pictures
from liex_lab.sessions.seeking import SeekablePictures
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = WalkingMouse(np.delete(steady(3.0), slice(40, 46)))


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return write(tmp_path_factory.mktemp("seek") / "a.liex", MOUSE)


def test_every_picture_is_the_one_of_the_walk(session: Session) -> None:
    pictures = SeekablePictures(session.path / "session.mcap", session.camera)
    recording = open_pictures(session)
    rows = np.random.default_rng(1).permutation(len(session.frames))
    for row in rows:
        found = pictures.at(int(session.frames["time_ns"].iloc[row]))
        np.testing.assert_array_equal(found, recording.frame(int(row)).depth)
    assert pictures.at(int(session.frames["time_ns"].iloc[0]) + 1) is None
    pictures.close()


@pytest.mark.parametrize("left", [0, 7, 4000, -1, -30])
def test_a_file_that_is_cut_has_no_index_but_its_pictures_are_found(
    session: Session, tmp_path: Path, left: int
) -> None:
    whole = (session.path / "session.mcap").read_bytes()
    cut = tmp_path / "session.mcap"
    cut.write_bytes(whole[:left] if left else b"")
    with pytest.raises(RecordingError, match="no index"):
        SeekablePictures(cut, session.camera)


def test_a_damaged_index_never_gives_another_picture(session: Session, tmp_path: Path) -> None:
    whole = bytearray((session.path / "session.mcap").read_bytes())
    rng = np.random.default_rng(4)
    times = session.frames["time_ns"].to_numpy()
    true = open_pictures(session)
    for trial in range(60):
        bad = bytearray(whole)
        for at in rng.integers(len(whole) - 6000, len(whole), 3):
            bad[at] = int(rng.integers(256))
        path = tmp_path / f"{trial}.mcap"
        path.write_bytes(bad)
        try:
            pictures = SeekablePictures(path, session.camera)
        except RecordingError:
            continue
        for row in (0, 40, 80):
            found = pictures.at(int(times[row]))
            if found is not None:
                np.testing.assert_array_equal(found, true.frame(row).depth)
        pictures.close()


def test_frames_fall_back_to_the_walk(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(path: Path, camera: object) -> SeekablePictures:
        raise RecordingError("no index")

    monkeypatch.setattr("liex_lab.dashboards.app.frames.SeekablePictures", none)
    frames = Frames()
    found = frames.depth("a", session, 50)
    np.testing.assert_array_equal(found, open_pictures(session).frame(50).depth)
    frames.close()
