"""libOpenNI2 reads what we write, and we read what it writes, bit by bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from liex_lab.optics.camera import Camera
from liex_lab.recordings import open_recording
from tests.recordings.oni_files import depth_builder, plain_payload
from tests.recordings.openni2 import play, record
from tests.recordings.writers import depth_frames, write_oni_file

XTION = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
QVGA = Camera(285.0, 287.0, 159.5, 119.5, 320, 240)


def noisy_frames(n: int = 6, seed: int = 0) -> np.ndarray:
    """(n, 240, 320) uint16: like a camera's, and one of plain noise; the last pixels of each
    change.
    """
    frames = depth_frames(n, 320, 240, seed)
    frames[1] = np.random.default_rng(seed).integers(0, 10_000, (240, 320))
    frames[2, -1, -40:] = frames[2, -1, -41] + 1
    return frames


@pytest.mark.parametrize("codec", ["16zT", "16zP", "NONE"])
@pytest.mark.parametrize(("old", "table"), [(False, True), (True, True), (True, False)])
def test_openni2_and_we_read_the_same_from_files_of_any_version(
    tmp_path: Path, codec: str, old: bool, table: bool
) -> None:
    payloads = [plain_payload(frame, codec) for frame in depth_frames(3)]
    path = depth_builder(payloads, codec, old=old, table=table).write(tmp_path / "r.oni")
    played = play(path)
    with open_recording(path) as recording:
        np.testing.assert_array_equal([frame.depth for frame in recording], played.frames)
        assert recording.times_ns.tolist() == (played.times_us * 1000).tolist()
        fov = (2 * np.arctan(32 / recording.camera.fx), 2 * np.arctan(24 / recording.camera.fy))
        assert played.fov == pytest.approx(fov, abs=1e-6)


def test_we_read_what_openni2_records_of_its_dummy_device(tmp_path: Path) -> None:
    handed_out = record("Dummy", tmp_path / "r.oni", 5)
    with open_recording(tmp_path / "r.oni", strict=True) as recording:
        # the recorder may begin a frame late and end one later
        seen = [frame.tobytes() for frame in handed_out.frames]
        ours = [frame.depth.astype(np.uint16).tobytes() for frame in recording]
        first = seen.index(ours[0])
        shared = min(len(seen) - first, len(ours))
        assert shared >= 4
        assert ours[:shared] == seen[first : first + shared]
        assert set(np.diff(recording.times_ns).tolist()) == {33_000_000}
        # the device has no optics
        assert recording.camera.source == "typical PrimeSense"


@pytest.mark.parametrize("seed", [1, 2])
def test_we_read_what_openni2_packs_as_it_reads_it_itself(tmp_path: Path, seed: int) -> None:
    source = write_oni_file(tmp_path / "source.oni", noisy_frames(6, seed), QVGA, codec="NONE")
    handed_out = record(source, tmp_path / "r.oni", 6)
    np.testing.assert_array_equal(handed_out.frames, noisy_frames(6, seed))
    played = play(tmp_path / "r.oni")
    with open_recording(tmp_path / "r.oni", strict=True) as recording:
        assert recording.problems == []
        ours = np.stack([frame.depth for frame in recording])
        assert recording.camera.source == "field of view in the .oni file (xnFOV)"
        assert [recording.camera.fx, recording.camera.fy] == pytest.approx(
            [QVGA.fx, QVGA.fy], rel=1e-6
        )
    np.testing.assert_array_equal(ours, played.frames)
    # its encoder changes some of the last pixels of a frame, and only those
    np.testing.assert_array_equal(ours[:, :-1], handed_out.frames[:, :-1])
