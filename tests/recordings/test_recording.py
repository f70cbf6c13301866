"""What a recording is by itself: frames, slices, times, digests. What every format promises is in
test_laws.py.
"""

import hashlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.errors import RecordingError
from liex_lab.recordings import DepthFrame, Recording, open_recording
from liex_lab.recordings.frame import depth_mm, has_readings
from liex_lab.recordings.recording import file_digest
from tests.recordings.asking import facts_in, refusal
from tests.recordings.writers import (
    SMALL,
    depth_frames,
    even_times,
    write_archive,
    write_camera,
    write_mcap,
    write_moseq_folder,
    write_png_folder,
)

N = 7
STORED = depth_frames(N)


def in_memory(n: int = N, times_ns: list[int] | None = None, **more: Any) -> Recording:
    return Recording(
        name="memory",
        format="synthetic",
        camera=SMALL,
        times_ns=np.array(even_times(n) if times_ns is None else times_ns),
        read=lambda index: np.full((48, 64), float(index), np.float32),
        **more,
    )


def test_chunks_hold_every_frame_once() -> None:
    sizes = [[frame.index for frame in chunk] for chunk in in_memory(7).chunks(3)]
    assert sizes == [[0, 1, 2], [3, 4, 5], [6]]
    with pytest.raises(ValueError, match="at least one"):
        next(in_memory(7).chunks(0))


@given(
    st.slices(12).filter(lambda s: s.step is None or s.step > 0),
    st.slices(5).filter(lambda s: s.step in (None, 1)),
)
def test_a_slice_of_a_slice_holds_the_frames_a_list_would(first: slice, second: slice) -> None:
    recording = in_memory(12)
    expected = list(range(12))[first]
    if not expected:
        with pytest.raises(RecordingError, match="no frame"):
            recording[first]
        return
    part = recording[first]
    assert [int(f.depth[0, 0]) for f in part] == expected
    assert [f.index for f in part] == list(range(len(expected)))
    np.testing.assert_array_equal(part.times_ns, recording.times_ns[expected])
    if again := expected[second]:
        assert [int(f.depth[0, 0]) for f in part[second]] == again


def test_a_short_slice_keeps_the_rate_and_so_sees_its_gap() -> None:
    recording = in_memory(times_ns=[0, 10, 20, 60, 70, 80], n=6)
    (gap,) = recording[2:4].gaps
    assert gap.n_frames_missing == 3
    assert recording[2:4].rate_hz == recording.rate_hz
    assert recording[::2].rate_hz == pytest.approx(recording.rate_hz / 2)


def test_a_doubt_is_a_problem_too_and_every_view_shares_it() -> None:
    recording = in_memory(5, doubts=["the lens is another one"])
    views = (recording, recording[1:4], recording.remembering(10**6)[::2])
    for view in views:
        assert view.problems == view.doubts == ["the lens is another one"]


def test_one_frame_is_taken_by_name_not_by_index() -> None:
    recording = in_memory()
    with pytest.raises(TypeError, match="frame"):
        recording[3]  # type: ignore[index]
    with pytest.raises(IndexError, match="7 of a recording of 7"):
        recording.frame(7)
    with pytest.raises(RecordingError, match="order of time"):
        recording[::-1]
    assert isinstance(recording.frame(3), DepthFrame)


def test_a_recording_holds_frames_and_its_times_increase() -> None:
    with pytest.raises(RecordingError, match="no frame"):
        in_memory(0)
    with pytest.raises(RecordingError, match="strictly"):
        in_memory(times_ns=[0, 5, 5], n=3)
    with pytest.raises(ValueError, match="read-only"):
        in_memory().times_ns[0] = 1


def test_a_single_frame_has_no_rate_and_no_gap() -> None:
    recording = in_memory(1)
    assert np.isnan(recording.rate_hz)
    assert (recording.duration_s, recording.gaps) == (0.0, [])


def test_the_digest_of_one_file_is_its_own(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "r.mcap", STORED)
    with open_recording(path) as recording:
        assert recording.digest() == hashlib.sha256(path.read_bytes()).hexdigest()
        assert recording[2:4].digest() == recording.digest()


def test_the_digest_of_a_folder_sees_names_bytes_and_nothing_else(tmp_path: Path) -> None:
    folder = write_png_folder(tmp_path / "images", STORED)
    digest = open_recording(folder).digest()
    (folder / "notes.txt").write_text("mouse 7")
    assert open_recording(folder).digest() == digest
    (folder / "frame_3.png").rename(folder / "frame_33.png")
    renamed = open_recording(folder).digest()
    write_camera(folder, SMALL, unit_mm=2.0)
    assert len({digest, renamed, open_recording(folder).digest()}) == 3


def test_a_boundary_between_files_is_part_of_the_digest(tmp_path: Path) -> None:
    digests = set()
    for contents in ((b"12", b"3"), (b"1", b"23")):
        for name, content in zip("ab", contents, strict=True):
            (tmp_path / name).write_bytes(content)
        digests.add(file_digest([tmp_path / "a", tmp_path / "b"]))
    assert len(digests) == 2


def test_what_happens_to_a_file_while_it_is_measured_is_known(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "r.mcap", STORED)
    content = path.read_bytes()
    with open_recording(path) as recording:
        files = recording[1:3].files
        assert (files.rewritten(), files.grown()) == ((), ())
        path.write_bytes(content + b"more")
        assert files.rewritten() == ()
        assert "r.mcap grew while the recording was measured" in files.grown()[0]
        path.write_bytes(content[:-1] + b"x")
        os.utime(path, ns=(0, 0))
        assert "r.mcap changed while the recording was measured" in files.rewritten()[0]
        assert files.grown() == ()
        path.write_bytes(content[:-9])
        assert files.rewritten()
        path.unlink()
        assert (files.rewritten(), files.grown()) == ((), ()), "what is open goes on being read"
    folder = write_png_folder(tmp_path / "images", STORED)
    with open_recording(folder) as recording:
        for picture in sorted(folder.glob("*.png"))[:2]:
            os.utime(picture, ns=(0, 0))
        assert "2 files changed" in recording.files.rewritten()[0]


def test_a_recording_without_a_file_is_known_by_its_content() -> None:
    assert in_memory().digest() == in_memory().digest()
    assert in_memory().digest() != in_memory(6).digest()
    assert in_memory()[1:4].digest() == in_memory().digest()


@given(
    st.sampled_from(["<u2", ">u2", "<f4"]),
    st.lists(st.sampled_from([0.0, 1.0, 700.0, 2047.0, 65535.0]), min_size=1, max_size=6),
    st.sampled_from([1.0, 0.2, -1.0, 1000.0]),
    st.lists(st.sampled_from([0.0, 2047.0, 65535.0, float("nan")]), max_size=3),
)
def test_unread_is_told_by_the_stored_value(
    kind: str, values: list[float], unit: float, unread: list[float]
) -> None:
    stored = np.array([values], kind)
    by_hand = [0.0 if v == 0 or v in unread or v * unit < 0 else v * unit for v in values]
    depth = depth_mm(stored, unit, unread)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth[0], by_hand, rtol=1e-6)


def test_one_reading_anywhere_is_enough() -> None:
    depth = np.zeros((40, 50), np.float32)
    assert not has_readings(depth)
    depth[-1, -3] = 900.0
    assert has_readings(depth)


def test_depth_is_finite_whatever_is_stored() -> None:
    stored = np.array([[np.nan, np.inf, -np.inf, -5.0, 3e38]], np.float32)
    np.testing.assert_array_equal(depth_mm(stored), np.array([[0, 0, 0, 0, 3e38]], np.float32))
    np.testing.assert_array_equal(depth_mm(stored, 1000.0), np.zeros((1, 5)))


# The one door: what it takes, and the sentence for what it does not.


FOUR_FRAMES = depth_frames(4)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("fish.ray", "Raytrix's own format"),
        ("fish.rays", "save the depth map of every frame as 32-bit TIFF"),
        ("cloud.ply", "raytrix.toml"),
        ("empty.pgm", "is empty"),
        ("empty.pclzf", "is empty"),
        ("empty.avi", "is empty"),
        ("empty.mkv", "is empty"),
        ("colour.JPG", "16-bit depth was expected"),
        ("colour.mp4", "16-bit depth was expected"),
        ("session.zip", "unpack it"),
        ("session.tar.xz", "unpack it"),
        ("mice.sqlite", "tracks but without depth"),
        ("kinect.xef", "16-bit PNG"),
        ("xtion.oni", "is empty"),
        ("session.bag", "is empty"),
        ("notes.txt", "a folder of 16-bit PNG, TIFF"),
        ("noextension", "a folder of 16-bit PNG, TIFF"),
        ("empty.png", "is empty"),
        ("empty.tif", "is empty"),
        ("empty.dat", "is empty"),
        ("empty.tar.gz", "empty.tar.gz"),
        ("empty.mcap", "is empty"),
    ],
)
def test_a_file_that_cannot_be_read_is_told_in_a_sentence(
    tmp_path: Path, name: str, says: str
) -> None:
    (tmp_path / name).write_bytes(b"")
    sentence = refusal(tmp_path / name)
    assert says in sentence
    assert name in sentence


@pytest.mark.parametrize(
    "name",
    [
        "a.png",
        "a.tif",
        "a.pgm",
        "a.pclzf",
        "depth.dat",
        "depth.avi",
        "a.mkv",
        "a.tar.gz",
        "a.tgz",
        "a.mcap",
        "a.oni",
        "a.tar",
        "camera.toml",
        "raytrix.toml",
        "a.xyz",
        "a.ply",
        "depth_1_0000001.png",
    ],
)
@pytest.mark.parametrize("seed", range(3))
def test_noise_is_refused_whatever_it_is_called(tmp_path: Path, name: str, seed: int) -> None:
    noise = np.random.default_rng(seed).integers(0, 256, 5000).astype(np.uint8).tobytes()
    (tmp_path / name).write_bytes(noise)
    assert str(tmp_path) in refusal(tmp_path / name)
    assert str(tmp_path) in refusal(tmp_path)


def test_folders_that_hold_no_recording(tmp_path: Path) -> None:
    assert "empty folder" in refusal(tmp_path)
    assert "no file or folder" in refusal(tmp_path / "nothing")
    (tmp_path / "depth").mkdir()
    (tmp_path / "colour").mkdir()
    assert "colour/, depth/" in refusal(tmp_path)
    (tmp_path / "a.jpg").write_bytes(b"")
    assert "8-bit" in refusal(tmp_path)
    (tmp_path / "session.json").write_text("{}")
    assert "liex show" in refusal(tmp_path)


def test_a_folder_around_one_file_is_that_file(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", FOUR_FRAMES)
    recording = facts_in(tmp_path)
    assert (recording.name, recording.format) == ("a", "mcap")
    write_mcap(tmp_path / "b.mcap", FOUR_FRAMES)
    assert "a.mcap, b.mcap" in refusal(tmp_path)


def test_names_come_from_the_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_png_folder(tmp_path / "m01.day2", FOUR_FRAMES)
    monkeypatch.chdir(folder)
    assert facts_in(".").name == "m01.day2"
    session = write_moseq_folder(tmp_path / "s", depth_frames(1, 512, 424))
    assert (
        facts_in(write_archive(session, tmp_path / "session_20170125.tar.gz")).name
        == "session_20170125"
    )


def test_what_may_not_be_read_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_png_folder(tmp_path / "r", FOUR_FRAMES)

    def locked(self: Path, *_: object, **__: object) -> object:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", locked)
    assert "Permission denied" in refusal(folder)


def test_a_full_disk_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = write_archive(write_moseq_folder(tmp_path / "s", FOUR_FRAMES), tmp_path / "s.tar.gz")
    genuine = Path.open

    class Full:
        def __enter__(self) -> "Full":
            return self

        def __exit__(self, *_: object) -> None: ...

        def write(self, _: bytes) -> int:
            raise OSError(28, "No space left on device")

    def open_full(self: Path, mode: str = "r", *rest: object, **more: object) -> object:
        return Full() if mode == "wb" else genuine(self, mode, *rest, **more)  # type: ignore[call-overload]

    monkeypatch.setattr(Path, "open", open_full)
    assert "TMPDIR" in refusal(archive)


def test_a_format_brings_only_its_own_libraries(tmp_path: Path) -> None:
    folder = write_moseq_folder(tmp_path / "s", depth_frames(1, 512, 424))
    code = (
        "import sys; from liex_lab.recordings import open_recording\nwith "
        f"open_recording({str(folder)!r}) as recording: recording.frame(0)\nprint({{'av', 'cv2', "
        "'tifffile', 'mcap', 'foxglove', 'numba', 'pandas', 'google', 'scipy'} & "
        "set(sys.modules))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "set()"
