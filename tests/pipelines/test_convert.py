"""`liex convert`: the same recording in another format, or nothing at all."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from liex_lab.pipelines.convert import convert
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.errors import RecordingError
from liex_lab.optics.camera import PRIMESENSE_QVGA
from liex_lab.recordings import open_recording
from tests.recordings.ros_writers import write_bag
from tests.recordings.writers import (
    cut,
    depth_frames,
    even_times,
    write_camera,
    write_mcap,
    write_moseq_folder,
    write_png_folder,
    write_tiff_stack,
    write_times,
)

STORED = depth_frames(12)
SOURCES: dict[str, Callable[[Path], Path]] = {
    "pictures": lambda folder: write_png_folder(folder / "r", STORED, subject_id="m 01"),
    "mcap": lambda folder: write_mcap(folder / "r.mcap", STORED),
    "bag": lambda folder: write_bag(folder / "r.bag", STORED),
    "tiff": lambda folder: write_tiff_stack(folder / "r" / "r.tif", STORED),
}
TARGETS = ["new.mcap", "new"]


def listing(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


@pytest.mark.parametrize("source", SOURCES)
@pytest.mark.parametrize("target", TARGETS)
def test_a_recording_is_the_same_in_every_format(tmp_path: Path, source: str, target: str) -> None:
    path = SOURCES[source](tmp_path)
    told: list[tuple[int, int | None, str]] = []
    done = convert(path, tmp_path / target, progress=lambda *facts: told.append(facts))
    assert (done.path, done.n_frames, done.problems) == (tmp_path / target, 12, [])
    assert told[-1] == (12, 12, f"writing {target}")
    with open_recording(path) as before, open_recording(tmp_path / target, strict=True) as after:
        np.testing.assert_array_equal([f.depth for f in after], [f.depth for f in before])
        assert after.camera.matrix.tolist() == before.camera.matrix.tolist()
        assert (after.camera.width, after.camera.height) == (64, 48)
        assert after.times_ns.tolist() == before.times_ns.tolist()
        assert after.metadata == before.metadata


def test_an_mcap_file_may_hold_the_messages_of_ros(tmp_path: Path) -> None:
    source = write_png_folder(tmp_path / "a", STORED)
    convert(source, tmp_path / "b.mcap", ros=True)
    with open_recording(tmp_path / "b.mcap", strict=True) as recording:
        np.testing.assert_array_equal([f.depth for f in recording], STORED)
        assert recording.times_ns.tolist() == even_times(12)
    with pytest.raises(RecordingError, match="leave out --ros"):
        convert(source, tmp_path / "c", ros=True)
    write_times(source, even_times(12, start_ns=3_000_000_000 * 10**9))
    with pytest.raises(RecordingError, match="end in 2038"):
        convert(source, tmp_path / "c.mcap", ros=True)


def test_there_and_back_again_is_what_it_was(tmp_path: Path) -> None:
    source = write_png_folder(tmp_path / "a", STORED, subject_id="m01")
    convert(source, tmp_path / "b.mcap")
    convert(tmp_path / "b.mcap", tmp_path / "c")
    convert(tmp_path / "c", tmp_path / "d.mcap")
    convert(tmp_path / "b.mcap", tmp_path / "e.mcap")
    with open_recording(tmp_path / "a") as first, open_recording(tmp_path / "d.mcap") as last:
        np.testing.assert_array_equal([f.depth for f in first], [f.depth for f in last])
        assert first.times_ns.tolist() == last.times_ns.tolist()
        assert (first.camera, first.metadata) == (last.camera, last.metadata)
    with open_recording(tmp_path / "e.mcap") as again:
        assert again.camera.source == "camera.toml", "where the numbers came from first"


def test_a_virtual_recording_and_one_that_is_open_can_be_written(tmp_path: Path) -> None:
    convert("synthetic:walk?frames=3&sensor=primesense-qvga", tmp_path / "r.mcap")
    with open_recording(tmp_path / "r.mcap") as recording:
        assert len(recording) == 3
        convert(recording[1:], tmp_path / "part")
    with open_recording(tmp_path / "part") as part:
        assert len(part) == 2


def float_pictures(folder: Path, step_mm: float | None) -> Path:
    """TIFF pictures of float depth: whole steps of a size, or anything."""
    depth = STORED.astype(np.float32) * np.float32(step_mm or 1.0)
    if step_mm is None:
        depth = depth * np.float32(1.0 + 1e-4 * np.pi)
    folder.mkdir()
    for k, picture in enumerate(depth):
        tifffile.imwrite(folder / f"{k}.tif", picture)
    write_camera(folder)
    write_times(folder, even_times(len(depth)))
    return folder


@pytest.mark.parametrize("step_mm", [0.5, 0.1, 0.01])
def test_finer_steps_than_a_millimetre_are_found(tmp_path: Path, step_mm: float) -> None:
    source = float_pictures(tmp_path / "r", step_mm)
    assert convert(source, tmp_path / "new").notes == []
    assert f"unit_mm = {step_mm}" in (tmp_path / "new" / "camera.toml").read_text()
    with open_recording(source) as before, open_recording(tmp_path / "new") as after:
        np.testing.assert_array_equal([f.depth for f in after], [f.depth for f in before])


def test_depth_that_16_bits_do_not_keep_is_refused_rounded_or_kept_as_floats(
    tmp_path: Path,
) -> None:
    source = float_pictures(tmp_path / "r", None)
    with pytest.raises(RecordingError, match=r"--step-mm 0\.1"):
        convert(source, tmp_path / "new")
    done = convert(source, tmp_path / "new", step_mm=0.1)
    assert any("rounded to whole steps of 0.1 mm" in note for note in done.notes)
    with open_recording(source) as before, open_recording(tmp_path / "new") as after:
        np.testing.assert_allclose([f.depth for f in after], [f.depth for f in before], atol=0.0501)
    done = convert(source, tmp_path / "new.mcap")
    assert any("32-bit metres" in note for note in done.notes)
    with open_recording(source) as before, open_recording(tmp_path / "new.mcap") as after:
        np.testing.assert_allclose([f.depth for f in after], [f.depth for f in before], rtol=1.2e-7)
    with pytest.raises(RecordingError, match="leave it out"):
        convert(source, tmp_path / "other.mcap", step_mm=0.1)


def test_what_is_whole_of_a_cut_recording_is_written_and_told(tmp_path: Path) -> None:
    path = cut(write_mcap(tmp_path / "r.mcap", STORED), 0.6)
    done = convert(path, tmp_path / "repaired.mcap")
    assert 4 <= done.n_frames < 12
    assert any("cut or damaged" in problem for problem in done.problems)
    with open_recording(tmp_path / "repaired.mcap", strict=True) as recording:
        assert len(recording) == done.n_frames


@pytest.mark.parametrize("target", TARGETS)
def test_nothing_is_overwritten_unasked(tmp_path: Path, target: str) -> None:
    source = write_moseq_folder(tmp_path / "m", depth_frames(2, 512, 424))
    convert(source, tmp_path / target)
    before = {
        name: (tmp_path / name).read_bytes()
        for name in listing(tmp_path)
        if (tmp_path / name).is_file()
    }
    with pytest.raises(RecordingError, match="--overwrite"):
        convert(source, tmp_path / target)
    other = write_png_folder(tmp_path / "other", STORED)
    convert(other, tmp_path / target, overwrite=True)
    with open_recording(tmp_path / target) as recording:
        assert len(recording) == 12
    assert all(
        (tmp_path / name).read_bytes() == data
        for name, data in before.items()
        if not name.startswith("new")
    )


def test_a_folder_with_anything_else_in_it_is_never_replaced(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "r.mcap", STORED)
    convert(source, tmp_path / "out")
    (tmp_path / "out" / "thesis.txt").write_text("irreplaceable")
    for overwrite in (False, True):
        with pytest.raises(RecordingError, match=r"thesis\.txt"):
            convert(source, tmp_path / "out", overwrite=overwrite)
    assert (tmp_path / "out" / "thesis.txt").read_text() == "irreplaceable"


@pytest.mark.parametrize(
    ("target", "says"),
    [
        ("new.bag", "NAME.mcap, or a folder"),
        ("new.oni", "NAME.mcap, or a folder"),
        ("new.TIFF", "NAME.mcap, or a folder"),
        ("no/such/new.mcap", "make it first"),
        ("folder.mcap", "is a folder"),
        ("file", "is a file"),
        ("r.mcap", "is the recording itself"),
    ],
)
def test_a_target_that_cannot_be_is_told_before_anything_is_read(
    tmp_path: Path, target: str, says: str
) -> None:
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "file").write_text("")
    source = write_mcap(tmp_path / "r.mcap", STORED)
    with pytest.raises(RecordingError, match=says):
        convert(source, tmp_path / target, overwrite=True)


@pytest.mark.parametrize("target", TARGETS)
def test_nothing_half_written_stays_behind(
    tmp_path: Path, target: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = write_mcap(tmp_path / "r.mcap", STORED)

    def interrupted(done: int, total: int | None, what: str) -> None:
        if what.startswith("writing") and done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        convert(source, tmp_path / target, progress=interrupted)
    assert listing(tmp_path) == ["r.mcap"]


@pytest.mark.parametrize("target", TARGETS)
def test_a_full_disk_is_a_sentence_and_leaves_nothing(tmp_path: Path, target: str) -> None:
    source = write_mcap(tmp_path / "r.mcap", depth_frames(12, 320, 240), PRIMESENSE_QVGA)

    def bounded() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (9_000, 9_000))

    command = [
        sys.executable,
        "-m",
        "liex_lab",
        "convert",
        str(source),
        "--to",
        str(tmp_path / target),
    ]
    ran = subprocess.run(command, capture_output=True, text=True, preexec_fn=bounded)
    assert ran.returncode == 1, ran.stderr
    assert len(ran.stderr.strip().splitlines()) == 1
    assert "File too large" in ran.stderr
    assert listing(tmp_path) == ["r.mcap"]


def test_the_command_line_says_what_it_did(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "r.mcap", STORED, topics=("/left/depth", "/right/depth"))
    command = ["convert", str(source), "--to", str(tmp_path / "new"), "--topic", "/right/depth"]
    result = CliRunner().invoke(cli.app, command)
    assert result.exit_code == 0, result.output
    assert f"recording: {tmp_path / 'new'} (12 frames)" in result.output
