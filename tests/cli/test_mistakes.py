"""What a lab gets wrong, told at `liex run`: one sentence that says what to do, exit code 1,
nothing left behind.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from liex_lab import cli
from tests.recordings.writers import (
    cut,
    depth_frames,
    write_archive,
    write_camera,
    write_mcap,
    write_moseq_folder,
    write_png_folder,
)

STORED = depth_frames(12)
Maker = Callable[[Path], Path]


def painted(folder: Path, *shape: int) -> Path:
    """A folder of 8-bit images of this shape."""
    write_png_folder(folder / "r", STORED)
    for path in (folder / "r").glob("*.png"):
        cv2.imwrite(str(path), np.full((48, 64, *shape), 90, np.uint8))
    return folder / "r"


def cut_dat(folder: Path) -> Path:
    cut(write_moseq_folder(folder / "r", STORED) / "depth.dat", 0.6)
    write_camera(folder / "r")
    return folder / "r"


def photograph(folder: Path) -> Path:
    cv2.imwrite(str(folder / "mouse.jpg"), np.full((48, 64, 3), 90, np.uint8))
    return folder / "mouse.jpg"


def packed(folder: Path) -> Path:
    names = ["camera.toml", "metadata.json", "depth.dat"]
    return write_archive(cut_dat(folder), folder / "r.tar.gz", names)


def without(folder: Path, name: str) -> Path:
    (write_png_folder(folder / "r", STORED) / name).unlink()
    return folder / "r"


RECORDINGS: dict[str, tuple[Maker, str]] = {
    "cut .dat": (cut_dat, "7 whole frames can be read from it"),
    "cut archive": (lambda folder: cut(packed(folder), 0.6), "cut short or damaged"),
    "cut image": (
        lambda folder: cut(write_png_folder(folder / "r", STORED) / "frame_7.png", 0.5).parent,
        "11 whole frames can be read from it",
    ),
    "cut .mcap": (
        lambda folder: cut(write_mcap(folder / "r.mcap", STORED), 0.6),
        "accept_truncated=true",
    ),
    "hardly any of an .mcap": (
        lambda folder: cut(write_mcap(folder / "r.mcap", STORED), 0.01),
        "the file is cut or damaged",
    ),
    "empty folder": (lambda folder: folder, "is an empty folder; give a folder of 16-bit PNG"),
    "colour": (lambda folder: painted(folder, 3), "16-bit"),
    "grey": (painted, "16-bit"),
    "photograph": (photograph, "16-bit depth was expected"),
    "no camera": (lambda folder: without(folder, "camera.toml"), "camera.toml"),
    "nothing": (lambda folder: folder / "nothing.mcap", "there is no file or folder"),
}


def whole(folder: Path) -> Path:
    return write_mcap(folder / "r.mcap", STORED)


def refused(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str
) -> str:
    """The sentence with which the command line refuses, in this process: a new one takes
    seconds.
    """
    monkeypatch.setattr(sys, "argv", ["liex", *words])
    with pytest.raises(SystemExit) as left:
        cli.main()
    told = capsys.readouterr()
    assert left.value.code == 1, told.err
    assert told.out == ""
    assert told.err.startswith("liex: ")
    assert len(told.err.strip().splitlines()) == 1, "one line, without a traceback"
    return told.err


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_recording_that_cannot_be_used(
    name: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    make, says = RECORDINGS[name]
    (tmp_path / "in").mkdir()
    recording, out = make(tmp_path / "in"), tmp_path / "results"
    sentence = refused(capsys, monkeypatch, "run", str(recording), "--out", str(out))
    assert says in sentence
    assert str(tmp_path) in sentence
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "content", "says"),
    [
        (["--plan", "moose"], "", "did you mean 'mouse'"),
        (["--plan", "no/such/plan.toml"], "", "bundled are: "),
        (["--set", "animal.spine=65"], "", "nearest one is animal.spine_m"),
        (["--set", "animal.spine_mm=long"], "", "animal.spine_mm should be"),
        (["--set", "spine_mm"], "", "--set takes key=value"),
        (["--set", "estimation.model=rat"], "", "there is no model 'rat'"),
        ([], "[animal]\nspine = 65.0\n", "nearest one is animal.spine_m"),
        ([], "[animl]\nspine_mm = 65.0\n", "[animal]"),
        ([], "[animal\n", "should be a TOML file"),
        ([], "[animal]\nspine_mm = 'long'\n", "animal.spine_mm should be"),
    ],
)
def test_a_plan_that_cannot_be_used(
    words: list[str],
    content: str,
    says: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out, own = tmp_path / "results", tmp_path / "own.toml"
    own.write_text(content)
    words = words or ["--plan", str(own)]
    run = ("run", str(whole(tmp_path)), "--out", str(out), *words)
    assert says in refused(capsys, monkeypatch, *run)
    assert not out.exists()


def test_a_place_that_is_a_file_is_told_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "liex_lab.pipelines.session.fit_plan", lambda *_: pytest.fail("work was begun")
    )
    file = tmp_path / "results"
    file.write_text("mine")
    for out in (file, file / "deeper"):
        assert f"{file} is a file" in refused(
            capsys, monkeypatch, "run", str(whole(tmp_path)), "--out", str(out)
        )
    assert file.read_text() == "mine"
    (tmp_path / "r.liex").write_text("mine")
    sentence = refused(capsys, monkeypatch, "run", str(whole(tmp_path)), "--out", str(tmp_path))
    assert "is not a session, so it is left alone" in sentence
