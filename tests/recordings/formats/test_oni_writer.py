"""Writing .oni: nothing is lost without a word, and nothing half-written stays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera
from liex_lab.recordings import open_recording
from liex_lab.recordings.formats.oni import writer
from liex_lab.recordings.formats.oni.writer import Codec, OniWriter, write_oni
from tests.recordings.writers import (
    SMALL,
    depth_frames,
    even_times,
    in_memory,
    write_mcap,
    write_oni_file,
)

STORED = depth_frames(6)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Where to write the recording."""
    return tmp_path / "r.oni"


def sentence(path: Path, depth: np.ndarray, **how: object) -> str:
    """The refusal to write, which leaves nothing behind."""
    before = {entry.name: entry.read_bytes() for entry in path.parent.iterdir()}
    with pytest.raises(RecordingError) as error:
        write_oni(in_memory(depth), path, **how)  # type: ignore[arg-type]
    assert {entry.name: entry.read_bytes() for entry in path.parent.iterdir()} == before
    return str(error.value)


@pytest.mark.parametrize("codec", ["16zT", "16zP", "NONE"])
def test_what_is_written_is_read_again(path: Path, codec: Codec) -> None:
    times = even_times(6)
    write_oni_file(path, STORED, SMALL, times, codec)
    with open_recording(path, strict=True) as recording:
        assert recording.problems == []
        np.testing.assert_array_equal([frame.depth for frame in recording], STORED)
        assert np.abs(recording.times_ns - np.array(times)).max() <= 500
        assert [
            getattr(recording.camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")
        ] == [60.0, 61.0, 31.5, 23.5, 64, 48]
        assert "liexIntrinsics" in recording.camera.source
    assert [entry.name for entry in path.parent.iterdir()] == ["r.oni"]


def test_a_recording_goes_from_another_format_into_oni(path: Path) -> None:
    with open_recording(write_mcap(path.with_name("r.mcap"), STORED)) as recording:
        seen: list[tuple[int, int | None]] = []
        assert (
            write_oni(
                recording, path, progress=lambda done, total, what: seen.append((done, total))
            )
            == path
        )
    assert seen == [(k + 1, 6) for k in range(6)]
    with open_recording(path) as recording:
        np.testing.assert_array_equal([frame.depth for frame in recording], STORED)


def test_writing_twice_gives_the_same_bytes(path: Path) -> None:
    first = write_oni_file(path, STORED).read_bytes()
    assert write_oni_file(path, STORED).read_bytes() == first


def test_only_a_whole_file_has_its_name(path: Path) -> None:
    def read(index: int) -> np.ndarray:
        assert not path.exists()
        if index == 4:
            raise RecordingError("frame 4 cannot be read")
        return STORED[index].astype(np.float32)

    recording = in_memory(STORED)
    recording._read = read
    with pytest.raises(RecordingError, match="frame 4"):
        write_oni(recording, path)
    assert list(path.parent.iterdir()) == []


def test_finer_depths_are_refused_unless_they_may_be_rounded(path: Path) -> None:
    fine = STORED + np.float32(0.3)
    assert "frame 0 holds depths between steps of 1 mm" in sentence(path, fine)
    write_oni(in_memory(fine), path, exact=False)
    with open_recording(path) as recording:
        np.testing.assert_array_equal([frame.depth for frame in recording], np.rint(fine))


def test_tenths_of_a_millimetre_are_kept(path: Path) -> None:
    tenths = STORED * np.float32(0.1)
    write_oni(in_memory(tenths), path, unit_mm=0.1)
    with open_recording(path) as recording:
        np.testing.assert_array_equal([frame.depth for frame in recording], tenths)
    with pytest.raises(ValueError, match="a step of an"):
        write_oni(in_memory(tenths), path, unit_mm=0.5, overwrite=True)


def test_depths_too_large_for_the_code_are_refused(path: Path) -> None:
    far = STORED.copy()
    far[2, 0, 0] = 40_000
    assert "frame 2 holds depths up to 40000 mm, and 16zP holds up to 32767 mm" in sentence(
        path, far, codec="16zP"
    )
    assert "steps of 0.1 mm" in sentence(path, far, unit_mm=0.1, codec="NONE")
    write_oni(in_memory(far), path)
    with open_recording(path) as recording:
        np.testing.assert_array_equal([frame.depth for frame in recording], far)


def test_more_depths_than_a_table_has_room_for_are_refused(path: Path) -> None:
    camera = Camera(256.0, 256.0, 127.5, 127.5, 256, 256)
    every = np.arange(1 << 16).astype(np.uint16).reshape(1, 256, 256)
    with pytest.raises(RecordingError, match="code NONE"):
        write_oni(in_memory(every, camera), path)
    write_oni_file(path, every, camera, codec="NONE")
    with open_recording(path) as recording:
        np.testing.assert_array_equal(recording.frame(0).depth, every[0])


def test_a_file_that_is_there_is_not_overwritten(path: Path) -> None:
    path.write_bytes(b"precious")
    assert "is there already" in sentence(path, STORED)
    write_oni(in_memory(STORED), path, overwrite=True)
    with open_recording(path) as recording:
        assert len(recording) == 6


def test_a_place_that_cannot_be_written_is_told(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(RecordingError, match="there is no folder"):
        write_oni(in_memory(STORED), path / "in" / "r.oni")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writer.OniWriter, "_write", full)
    assert "No space left" in sentence(path, STORED)


def test_times_before_zero_begin_at_zero(path: Path) -> None:
    write_oni_file(path, STORED, times_ns=even_times(6, start_ns=-50_000_000))
    with open_recording(path) as recording:
        assert int(recording.times_ns[0]) == 0
        assert recording.rate_hz == pytest.approx(30, rel=1e-4)


def test_a_long_file_has_no_seek_table(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # OpenNI2's player has a buffer of fixed size for it, and refuses the file if it is too long
    monkeypatch.setattr(writer, "_MOST_IN_SEEK_TABLE", 5)
    write_oni_file(path, STORED)
    with open_recording(path, strict=True) as recording:
        np.testing.assert_array_equal([frame.depth for frame in recording], STORED)


@pytest.mark.parametrize("unit_mm", [0.5, 10.0])
def test_a_step_that_the_format_does_not_have_is_refused_and_leaves_no_file(
    path: Path, unit_mm: float
) -> None:
    with pytest.raises(ValueError, match=r"1 mm or 0\.1 mm"):
        OniWriter(path, SMALL, unit_mm=unit_mm)
    with pytest.raises(ValueError, match=r"1 mm or 0\.1 mm"):
        write_oni(in_memory(STORED), path, unit_mm=unit_mm)
    assert not list(path.parent.iterdir())
