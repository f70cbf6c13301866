"""`liex record`: whatever ends a recording, its frames are there. No real camera was there."""

import errno
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines import record as jobs
from liex_lab.pipelines.build import open_planned
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.errors import LiexError
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.recordings.writer import McapDepthWriter
from liex_lab.runtime.processes import Ended
from tests.recordings.fake_cameras import FakeOrbbec, FakeRealSense
from tests.recordings.writers import depth_frames

FRAMES = depth_frames(12, 160, 120, floor_mm=700)
US = [5_000_000 + round(k * 1e6 / 30.09) for k in range(12)]
SENT = [(100 + k, US[k], FRAMES[k]) for k in range(12)]
GAPPED = [one for one in SENT if one[0] not in (103, 104, 108)]


@pytest.fixture
def plug_in(monkeypatch: pytest.MonkeyPatch) -> Any:
    def plug_in(fake: Any) -> str:
        is_realsense = isinstance(fake, FakeRealSense)
        name = "pyrealsense2" if is_realsense else "pyorbbecsdk"
        monkeypatch.setitem(sys.modules, name, fake)
        return "realsense" if is_realsense else "orbbec"

    return plug_in


@pytest.mark.parametrize("fake", [FakeRealSense, FakeOrbbec])
def test_a_recording_holds_depth_calibration_and_times_of_the_camera_and_counts_drops(
    plug_in: Any, tmp_path: Path, fake: Any
) -> None:
    done = jobs.record(plug_in(fake(GAPPED)), tmp_path / "a.mcap")
    assert (done.n_frames, done.n_dropped) == (9, 3)
    assert "sends no more frames" in done.error, "the camera was unplugged"
    with open_recording(tmp_path / "a.mcap") as recording:
        np.testing.assert_array_equal(
            np.stack([frame.depth for frame in recording]), np.stack([one[2] for one in GAPPED])
        )
        steps = np.diff(recording.times_ns)
        np.testing.assert_allclose(steps, 1000 * np.diff([one[1] for one in GAPPED]), atol=300)
        assert [gap.n_frames_missing for gap in recording.gaps] == [2, 1]
        assert recording.camera.fx == pytest.approx(424.2)
        assert (recording.camera.distortion is None) == (fake is FakeRealSense)


def test_seconds_end_it_and_a_fine_unit_is_kept(plug_in: Any, tmp_path: Path) -> None:
    done = jobs.record(plug_in(FakeRealSense(SENT, 0.0001)), tmp_path / "a.mcap", seconds=0.15)
    assert (done.n_frames, done.error) == (5, "")
    with open_recording(tmp_path / "a.mcap") as recording:
        np.testing.assert_allclose(recording.frame(2).depth, 0.1 * FRAMES[2], rtol=1e-6)


def test_a_camera_without_a_clock_is_told(plug_in: Any, tmp_path: Path) -> None:
    done = jobs.record(plug_in(FakeOrbbec([(n, 0, f) for n, _, f in SENT])), tmp_path / "a.mcap")
    assert "those of arrival" in done.notes[0]
    assert done.duration_s == pytest.approx(11 / 30, abs=0.01)
    late = FakeRealSense(SENT, domain="timestamp_domain.system_time")
    assert "time of arrival" in jobs.record(plug_in(late), tmp_path / "b.mcap").notes[0]


def test_ctrl_c_ends_the_file_properly(
    plug_in: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Interrupted(jobs.threading.Thread):
        waited = 0

        def is_alive(self) -> bool:  # it may have ended before anybody waits
            return not Interrupted.waited or super().is_alive()

        def join(self, timeout: float | None = None) -> None:
            super().join(timeout)
            if timeout == 0.1 and not Interrupted.waited:
                Interrupted.waited = 1
                raise Ended(2)

    monkeypatch.setattr(jobs.threading, "Thread", Interrupted)
    done = jobs.record(plug_in(FakeRealSense(SENT)), tmp_path / "a.mcap")
    assert any("complete until then" in note for note in done.notes)
    with open_recording(tmp_path / "a.mcap") as recording:
        assert len(recording) == done.n_frames


def test_a_full_disk_loses_nothing_that_was_written(
    plug_in: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    add = McapDepthWriter.add

    def full(self: McapDepthWriter, frame: Any) -> None:
        if frame.index == 106:
            raise OSError(errno.ENOSPC, "No space left on device")
        add(self, frame)

    monkeypatch.setattr(McapDepthWriter, "add", full)
    name = plug_in(FakeRealSense(SENT))
    out = tmp_path / "a.mcap"
    said = CliRunner().invoke(cli.app, ["record", "--camera", name, "--out", str(out)])
    assert "(6 frames in" in said.output
    assert "accept_truncated" in str(said.exception)
    cut = Plan().with_settings(["recording.accept_truncated=true"])
    with open_planned(out, cut) as recording:
        assert len(recording) >= 4, "only the last 128 kB were not on the disk"


def test_what_cannot_be_recorded_is_refused_with_the_reason(plug_in: Any, tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    for arguments, said in (
        (("kodak", out), "one of orbbec, realsense"),
        (("orbbec", tmp_path / "a.avi"), r"\.mcap"),
        (("orbbec", out), "pip install --no-deps pyorbbecsdk2"),
    ):
        with pytest.raises(LiexError, match=said):
            jobs.record(*arguments)
    name = plug_in(FakeOrbbec(SENT, size=(1024, 1024)))
    with pytest.raises(LiexError, match="lens of images of 1024 x 1024"):
        jobs.record(name, out)
    with pytest.raises(LiexError, match="known are 640x576"):
        jobs.record(name, out, preset="femto-bolt:7x7")
    assert not out.exists()
    out.touch()
    with pytest.raises(LiexError, match="exists"):
        jobs.record(name, out)
