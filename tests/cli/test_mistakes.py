"""What a lab gets wrong, told at `liex run`: one sentence that says what to do, exit code 1,
nothing left behind.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from liex_lab import cli
from tests.cli.test_cli import liex
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


def cut_dat(folder: Path) -> Path:
    cut(write_moseq_folder(folder / "r", STORED) / "depth.dat", 0.6)
    write_camera(folder / "r")
    return folder / "r"


def cut_archive(folder: Path) -> Path:
    archive = write_archive(
        cut_dat(folder), folder / "r.tar.gz", ["camera.toml", "metadata.json", "depth.dat"]
    )
    return cut(archive, 0.6)


def cut_png(folder: Path) -> Path:
    cut(write_png_folder(folder / "r", STORED) / "frame_7.png", 0.5)
    return folder / "r"


def cut_mcap(folder: Path) -> Path:
    return cut(write_mcap(folder / "r.mcap", STORED), 0.6)


def cut_at_once(folder: Path) -> Path:
    return cut(write_mcap(folder / "r.mcap", STORED), 0.01)


def empty_folder(folder: Path) -> Path:
    (folder / "r").mkdir()
    return folder / "r"


def colour_folder(folder: Path) -> Path:
    write_png_folder(folder / "r", STORED)
    for path in (folder / "r").glob("*.png"):
        cv2.imwrite(str(path), np.full((48, 64, 3), 90, np.uint8))
    return folder / "r"


def grey_folder(folder: Path) -> Path:
    write_png_folder(folder / "r", STORED)
    for path in (folder / "r").glob("*.png"):
        cv2.imwrite(str(path), np.full((48, 64), 90, np.uint8))
    return folder / "r"


def photograph(folder: Path) -> Path:
    cv2.imwrite(str(folder / "mouse.jpg"), np.full((48, 64, 3), 90, np.uint8))
    return folder / "mouse.jpg"


def no_camera(folder: Path) -> Path:
    (write_png_folder(folder / "r", STORED) / "camera.toml").unlink()
    return folder / "r"


def missing(folder: Path) -> Path:
    return folder / "nothing.mcap"


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


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (cut_dat, "7 whole frames can be read from it"),
        (cut_archive, "cut short or damaged"),
        (cut_png, "11 whole frames can be read from it"),
        (cut_mcap, "accept_truncated=true"),
        (cut_at_once, "the file is cut or damaged"),
        (empty_folder, "is an empty folder; give a folder of 16-bit PNG"),
        (colour_folder, "16-bit"),
        (grey_folder, "16-bit"),
        (photograph, "16-bit depth was expected"),
        (no_camera, "camera.toml"),
        (missing, "there is no file or folder"),
    ],
)
def test_a_recording_that_cannot_be_used(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    make: Maker,
    says: str,
) -> None:
    recording, out = make(tmp_path), tmp_path / "results"
    sentence = refused(capsys, monkeypatch, "run", str(recording), "--out", str(out))
    assert says in sentence
    assert str(tmp_path) in sentence
    assert not out.exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--plan", "moose"], "did you mean 'mouse'"),
        (["--plan", "no/such/plan.toml"], "bundled are: "),
        (["--set", "animal.spine=65"], "nearest one is animal.spine_m"),
        (["--set", "animal.spine_mm=long"], "animal.spine_mm should be"),
        (["--set", "spine_mm"], "--set takes key=value"),
        (["--set", "estimation.model=rat"], "there is no model 'rat'"),
    ],
)
def test_a_plan_that_cannot_be_used(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
    says: str,
) -> None:
    out = tmp_path / "results"
    assert says in refused(
        capsys, monkeypatch, "run", str(whole(tmp_path)), "--out", str(out), *words
    )
    assert not out.exists()


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("[animal]\nspine = 65.0\n", "nearest one is animal.spine_m"),
        ("[animl]\nspine_mm = 65.0\n", "[animal]"),
        ("[animal\n", "should be a TOML file"),
        ("[animal]\nspine_mm = 'long'\n", "animal.spine_mm should be"),
    ],
)
def test_a_plan_of_ones_own_with_a_slip(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    content: str,
    says: str,
) -> None:
    own, out = tmp_path / "own.toml", tmp_path / "results"
    own.write_text(content)
    assert says in refused(
        capsys, monkeypatch, "run", str(whole(tmp_path)), "--plan", str(own), "--out", str(out)
    )
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


def test_a_mistake_in_a_process_of_its_own(tmp_path: Path) -> None:
    ran = liex("run", str(cut_mcap(tmp_path)), "--out", str(tmp_path / "results"))
    assert (ran.returncode, ran.stdout) == (1, "")
    assert "whole frames can be read from it; copy it again" in ran.stderr
    assert len(ran.stderr.strip().splitlines()) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r.mcap"]
