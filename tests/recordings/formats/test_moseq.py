"""MoSeq sessions, whole and cut."""

import gzip
import io
import json
import tarfile
from pathlib import Path

import numpy as np
import pytest

from liex_lab.optics.camera import Camera
from liex_lab.recordings import open_recording
from tests.recordings.asking import depths_in, exact, facts_in, refusal
from tests.recordings.writers import (
    cut,
    depth_frames,
    write_archive,
    write_camera,
    write_moseq_folder,
)

STORED = depth_frames(20)
KINECT = depth_frames(3, 512, 424)
FRAME_BYTES = 2 * 64 * 48
STAMPED_FIRST = ("camera.toml", "depth_ts.txt", "metadata.json", "depth.dat")
DEPTH_FIRST = ("depth.dat", "camera.toml", "depth_ts.txt", "metadata.json")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A session of small frames with the camera stated."""
    write_moseq_folder(tmp_path / "session_1", STORED)
    write_camera(tmp_path / "session_1")
    return tmp_path / "session_1"


def test_a_kinect_session_needs_no_camera_file_but_says_so(tmp_path: Path) -> None:
    with open_recording(
        write_moseq_folder(tmp_path / "s", KINECT, ["1000", "1033.3333", "1100.5"])
    ) as recording:
        camera = recording.camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (365.0, 365.0, 255.5, 211.5)
        assert camera.source == "typical Kinect v2"
        assert any("typical Kinect v2" in problem for problem in recording.problems)
        assert recording.times_ns.tolist() == [1_000_000_000, 1_033_333_300, 1_100_500_000]
        assert recording.metadata == {
            "subject_id": "m01",
            "session_name": "a session",
            "session_start_time": "2017-01-25T10:42:07.173469-05:00",
        }
        assert (recording.name, recording.format) == ("s", "moseq")
        for frame in recording:
            np.testing.assert_array_equal(frame.depth, KINECT[frame.index])


def test_metadata_is_often_missing_and_the_depth_file_opens_its_session(tmp_path: Path) -> None:
    path = write_moseq_folder(tmp_path / "s", KINECT)
    (path / "metadata.json").unlink()
    with open_recording(path / "depth.dat") as recording:
        assert (recording.name, len(recording), recording.metadata) == ("s", 3, {})


def test_another_size_than_the_kinects_is_found_out(tmp_path: Path) -> None:
    path = write_moseq_folder(tmp_path / "s", depth_frames(2, 640, 480), metadata={})
    sentence = refusal(path)
    assert '"DepthResolution": [640, 480]' in sentence
    write_moseq_folder(path, depth_frames(2, 640, 480))
    assert "camera.toml" in refusal(path)  # no camera is guessed for it
    write_camera(
        path.parent, Camera(600, 600, 320, 240, 640, 480)
    )  # one file for all the sessions beside it
    assert facts_in(path).camera.fx == 600


def test_big_endian_depth_is_what_metadata_says(folder: Path) -> None:
    STORED.astype(">u2").tofile(folder / "depth.dat")
    (folder / "metadata.json").write_text(
        json.dumps({"DepthResolution": [64, 48], "IsLittleEndian": False})
    )
    np.testing.assert_array_equal(depths_in(folder)[3], STORED[3])


def test_without_stamps_the_usual_rate_is_assumed_and_told(folder: Path) -> None:
    (folder / "depth_ts.txt").unlink()
    with open_recording(folder) as recording:
        assert recording.rate_hz == pytest.approx(30)
        assert any("30 frames/s was assumed" in problem for problem in recording.problems)
    assert facts_in(folder, fps=60).rate_hz == pytest.approx(60)


@pytest.mark.parametrize(
    "n_bytes", [FRAME_BYTES, FRAME_BYTES + 1, 7 * FRAME_BYTES - 1, 19 * FRAME_BYTES + 100]
)
def test_a_cut_depth_file_gives_its_whole_frames(folder: Path, n_bytes: int) -> None:
    content = (folder / "depth.dat").read_bytes()
    (folder / "depth.dat").write_bytes(content[:n_bytes])
    n = n_bytes // FRAME_BYTES
    with open_recording(folder) as recording:
        assert len(recording) == n
        assert recording.truncated == bool(n_bytes % FRAME_BYTES)
        assert any(
            f"{n} frames" in problem and "20 time stamps" in problem
            for problem in recording.problems
        )
        np.testing.assert_array_equal([frame.depth for frame in recording], STORED[:n])
    if n_bytes % FRAME_BYTES:
        assert f"{n} whole frame" in refusal(folder, strict=True)


@pytest.mark.parametrize("n_bytes", [0, 100, FRAME_BYTES - 1])
def test_less_than_a_frame_is_nothing_to_open(folder: Path, n_bytes: int) -> None:
    (folder / "depth.dat").write_bytes(bytes(n_bytes))
    assert f"{n_bytes} bytes" in refusal(folder)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("{", "not JSON"),
        ("[1, 2]", "not JSON"),
        ("\x00", "not JSON"),
        ('{"DepthResolution": "512x424"}', "DepthResolution"),
        ('{"DepthResolution": [0, 424]}', "DepthResolution"),
        ('{"DepthResolution": [NaN, 424]}', "DepthResolution"),
        ('{"DepthResolution": [512.5, 424]}', "DepthResolution"),
    ],
)
def test_wrong_metadata_is_told_in_a_sentence(folder: Path, content: str, says: str) -> None:
    (folder / "metadata.json").write_text(content)
    assert says in refusal(folder)


def test_a_start_without_a_zone_is_left_out_and_told(folder: Path) -> None:
    (folder / "metadata.json").write_text(
        '{"DepthResolution": [64, 48], "StartTime": "2017-01-25T10:42:07"}'
    )
    with open_recording(folder) as recording:
        assert "session_start_time" not in recording.metadata
        assert any("StartTime" in problem for problem in recording.problems)


def test_an_archive_is_unpacked_once_and_cleared_away(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    archive = write_archive(folder, tmp_path / "session_9.tar.gz")
    told: list[tuple[int, int | None, str]] = []
    recording = open_recording(archive, progress=lambda *piece: told.append(piece))
    assert told
    assert len(list(tmp_path.glob("liex-*"))) == 1
    assert recording.name == "session_9"
    recording[2:5].close()
    np.testing.assert_array_equal(recording.frame(4).depth, STORED[4])
    recording.close()
    recording.close()
    assert not list(tmp_path.glob("liex-*"))
    (folder / "metadata.json").write_text("{")
    assert "not JSON" in refusal(write_archive(folder, tmp_path / "bad.tgz"))
    assert not list(tmp_path.glob("liex-*"))


@pytest.mark.parametrize("camera", ["in the archive", "beside it"])
def test_what_an_archive_was_unpacked_to_opens_as_the_same_recording(
    camera: str, folder: Path, tmp_path: Path
) -> None:
    if camera == "beside it":
        (folder / "camera.toml").rename(tmp_path / "camera.toml")
    with open_recording(write_archive(folder, tmp_path / "s.tar.gz")) as recording:
        assert recording.unpacked is not None
        assert recording[2:5].unpacked is None  # rows of the whole are not its rows
        with open_recording(recording.unpacked) as again:
            assert again.camera == recording.camera
            assert again.times_ns.tolist() == recording.times_ns.tolist()
            for frame in again:
                np.testing.assert_array_equal(frame.depth, STORED[frame.index])
    write_camera(folder)
    assert facts_in(folder).unpacked is None


def test_members_may_lie_in_folders_and_a_tar_may_be_unpacked_already(
    folder: Path, tmp_path: Path
) -> None:
    path = tmp_path / "s.tar"
    with tarfile.open(path, "w") as tar:
        tar.add(folder, arcname="./2017/session_1")
    with open_recording(path) as recording:
        assert (len(recording), recording.truncated) == (20, False)


def test_names_cannot_lead_out_of_the_cache(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "s.tar.gz"
    with tarfile.open(path, "w:gz") as tar:
        for file in folder.iterdir():
            tar.add(file, arcname=f"../../{file.name}")
        link = tarfile.TarInfo("timestamps.csv")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        tar.addfile(link)
    assert len(facts_in(path)) == 20
    assert not (tmp_path.parent / "depth.dat").exists()


@pytest.mark.parametrize("share", [0.15, 0.5, 0.985])
@pytest.mark.parametrize("order", [STAMPED_FIRST, DEPTH_FIRST])
def test_a_cut_archive_gives_every_whole_frame(
    folder: Path, tmp_path: Path, share: float, order: tuple[str, ...]
) -> None:
    archive = write_archive(folder, tmp_path / "s.tar.gz", order)
    cut(archive, share)
    if (
        order == DEPTH_FIRST
    ):  # what states the frame size and the camera is lost: one beside the archive serves
        write_camera(tmp_path)
    by_hand = _slow_gunzip(archive)
    at = by_hand.index(b"depth.dat") + 512
    n = min(20, (len(by_hand) - at) // FRAME_BYTES)
    recording = exact(archive, STORED[:n])
    assert recording.truncated
    assert len(recording) == n
    assert f"{n} whole frame" in refusal(archive, strict=True)


@pytest.mark.parametrize("packed", [1, 1000])
def test_an_archive_may_be_several_gzips_one_after_the_other(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, packed: int
) -> None:
    # so that a border of reading meets every border
    monkeypatch.setattr("liex_lab.recordings.formats.moseq._PACKED", packed)
    plain = gzip.decompress(write_archive(folder, tmp_path / "one.tar.gz").read_bytes())
    parts = [plain[i : i + 9000] for i in range(0, len(plain), 9000)]
    (tmp_path / "s.tar.gz").write_bytes(b"".join(map(gzip.compress, parts)) + bytes(700))
    np.testing.assert_array_equal(depths_in(tmp_path / "s.tar.gz", strict=True), STORED)


def test_an_archive_with_a_wrong_checksum_keeps_every_frame_and_is_reported(
    folder: Path, tmp_path: Path
) -> None:
    archive = write_archive(folder, tmp_path / "s.tar.gz")
    content = bytearray(archive.read_bytes())
    content[-8] ^= 1  # gzip ends in a CRC-32 and a size
    archive.write_bytes(content)
    assert exact(archive, STORED).truncated


def _slow_gunzip(archive: Path) -> bytes:
    """All bytes that gzip itself gives, one at a time, before it finds that the file is cut."""
    out = bytearray()
    with gzip.open(io.BytesIO(archive.read_bytes())) as stream:
        try:
            while block := stream.read(1):
                out += block
        except EOFError:
            pass
    return bytes(out)


def test_an_archive_that_is_cut_among_its_stamps_keeps_every_frame(
    folder: Path, tmp_path: Path
) -> None:
    stamps = (folder / "depth_ts.txt").read_text().splitlines()
    (folder / "depth_ts.txt").write_text("\n".join(stamps[:8]) + "\n" + stamps[8][:3])
    plain = gzip.decompress(
        write_archive(
            folder,
            tmp_path / "s.tar.gz",
            ("camera.toml", "metadata.json", "depth.dat", "depth_ts.txt"),
        ).read_bytes()
    )
    end = plain.index(stamps[7].encode()) + len(stamps[7]) + 3  # within the stamp after the eighth
    (tmp_path / "s.tar.gz").write_bytes(
        gzip.compress(plain[:end])[:-8]
    )  # without gzip's trailer: cut
    with open_recording(tmp_path / "s.tar.gz") as recording:
        assert (len(recording), recording.truncated) == (20, True)
        assert recording.times_ns[:8].tolist() == [
            int(float(line.split()[0]) * 1e6 + 0.5) for line in stamps[:8]
        ]
        np.testing.assert_allclose(np.diff(recording.times_ns[7:]), 33_333_300, rtol=1e-5)
        assert any("the last 12 frames are cut off" in problem for problem in recording.problems)


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"\x1f\x8b", b"\x1f\x8b garbage that is no gzip", bytes(2000)]
)
def test_what_is_no_archive_is_told_in_a_sentence(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "s.tar.gz"
    path.write_bytes(content)
    assert "s.tar.gz" in refusal(path)


def test_an_archive_of_something_else_is_told(tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "notes.txt").write_text("no depth here")
    assert "no depth.dat" in refusal(write_archive(tmp_path / "x", tmp_path / "s.tar.gz"))


def test_two_sessions_in_one_archive_are_not_mixed(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "s.tar.gz"
    with tarfile.open(path, "w:gz") as tar:
        tar.add(folder, arcname="a")
        tar.add(folder, arcname="b")
    assert "more than one" in refusal(path)
