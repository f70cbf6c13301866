"""The one door: what it takes, and the sentence for what it does not."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import liex_lab
from liex_lab.recordings import open_recording
from tests.recordings.asking import refusal
from tests.recordings.writers import (
    SMALL,
    depth_frames,
    write_archive,
    write_mcap,
    write_moseq_folder,
    write_png_folder,
)

STORED = depth_frames(4)


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


def test_a_session_is_no_recording(tmp_path: Path) -> None:
    (tmp_path / "session.json").write_text("{}")
    assert "liex show" in refusal(tmp_path)


def test_a_folder_around_one_file_is_that_file(tmp_path: Path) -> None:
    write_mcap(tmp_path / "a.mcap", STORED)
    with open_recording(tmp_path) as recording:
        assert (recording.name, recording.format) == ("a", "mcap")
    write_mcap(tmp_path / "b.mcap", STORED)
    assert "a.mcap, b.mcap" in refusal(tmp_path)


def test_names_come_from_the_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_png_folder(tmp_path / "m01.day2", STORED)
    monkeypatch.chdir(folder)
    with open_recording(".") as recording:
        assert recording.name == "m01.day2"
    session = write_moseq_folder(tmp_path / "s", depth_frames(1, 512, 424))
    with open_recording(write_archive(session, tmp_path / "session_20170125.tar.gz")) as recording:
        assert recording.name == "session_20170125"


def test_what_may_not_be_read_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_png_folder(tmp_path / "r", STORED)

    def locked(self: Path, *_: object, **__: object) -> object:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", locked)
    assert "Permission denied" in refusal(folder)


def test_a_full_disk_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = write_archive(write_moseq_folder(tmp_path / "s", STORED), tmp_path / "s.tar.gz")
    genuine = Path.open

    class Full:
        def __enter__(self) -> Full:
            return self

        def __exit__(self, *_: object) -> None: ...

        def write(self, _: bytes) -> int:
            raise OSError(28, "No space left on device")

    def open_full(self: Path, mode: str = "r", *rest: object, **more: object) -> object:
        return Full() if mode == "wb" else genuine(self, mode, *rest, **more)  # type: ignore[call-overload]

    monkeypatch.setattr(Path, "open", open_full)
    assert "TMPDIR" in refusal(archive)


def test_the_package_hands_out_the_same_door() -> None:
    assert liex_lab.open_recording is open_recording


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


def test_the_camera_of_a_recording_is_for_its_pictures(tmp_path: Path) -> None:
    with open_recording(write_png_folder(tmp_path / "r", STORED)) as recording:
        assert (recording.camera.width, recording.camera.height) == recording.frame(0).depth.shape[
            ::-1
        ]
        assert recording.camera.fx == SMALL.fx
