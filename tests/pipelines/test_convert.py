"""`liex convert`: the same recording in another format, or nothing at all."""

import hashlib
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import tifffile
from liex_lab.pipelines import convert as job
from liex_lab.pipelines.convert import convert, pack
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.errors import RecordingError
from liex_lab.optics.camera import PRIMESENSE_QVGA
from liex_lab.plan import Plan
from liex_lab.recordings import Recording, open_recording
from liex_lab.recordings.formats.messages.messages import PackFacts, hash_note
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.writer import McapDepthWriter
from liex_lab.sessions import Session
from tests.pipelines.conftest import measure
from tests.recordings.ros_writers import write_bag
from tests.recordings.writers import (
    cut,
    depth_frames,
    even_times,
    write_camera,
    write_mcap,
    write_moseq_folder,
    write_oni_file,
    write_png_folder,
    write_tiff_stack,
    write_times,
)
from tests.sessions.walking_mouse import WalkingMouse, steady

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


@pytest.mark.parametrize(("source", "target"), list(zip(SOURCES, TARGETS * 2, strict=True)))
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
    with pytest.raises(RecordingError, match="leave out --step-mm"):
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


@pytest.mark.nightly
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


# Archives of recordings: what they hold, how small they are, and what is refused.


MOUSE = WalkingMouse(steady(2.0))
PLAN = Plan.load("mouse")


def recorded(path: Path, times_ns: Sequence[int] | None = None, step_mm: float = 1.0) -> Path:
    """The walking mouse as an MCAP recording."""
    with McapDepthWriter(path, MOUSE.camera, metadata={"subject_id": "m07"}) as writer:
        for row in range(len(MOUSE.times_s)):
            frame = MOUSE.frame(row)
            time_ns = frame.time_ns if times_ns is None else times_ns[row]
            writer.add(DepthFrame(row, int(time_ns), frame.depth * np.float32(step_mm)))
    return path


@pytest.fixture
def walking(tmp_path: Path) -> Path:
    return recorded(tmp_path / "walk.mcap")


def depths(opened: Recording) -> np.ndarray:
    return np.stack([frame.depth for frame in opened])


def test_an_archive_holds_every_picture_time_and_fact_bit_for_bit(walking: Path) -> None:
    done = pack(walking, plan=PLAN, whole=True, verify=True)
    assert done.path == walking.with_name("walk.pack.mcap")
    assert done.verified
    assert done.kept == 1.0
    with open_recording(walking) as one, open_recording(done.path, strict=True) as other:
        np.testing.assert_array_equal(depths(one), depths(other))
        assert depths(other).dtype == np.float32
        np.testing.assert_array_equal(one.times_ns, other.times_ns)
        assert one.camera == other.camera
        assert other.name == "walk", "its tables carry the recording's name"
        assert other.metadata["subject_id"] == "m07"
        assert other.metadata["packed"]["source"]["sha256"] == one.digest()
    assert done.path.stat().st_size < 0.85 * done.source_bytes
    with open_recording(done.path.rename(walking.with_name("of tuesday.bin"))) as renamed:
        assert len(renamed) == len(MOUSE.times_s), "an archive is known by its content"


def test_outside_of_a_region_that_was_named_pixels_are_unread(walking: Path) -> None:
    plan = PLAN.with_settings(["arena.region=[[10, 10], [60, 10], [60, 50], [10, 50]]"])
    done = pack(walking, plan=plan, verify=True)
    with open_recording(walking) as one, open_recording(done.path) as other:
        whole = depths(one)
        kept = depths(other)
    np.testing.assert_array_equal(kept[:, 10:51, 10:61], whole[:, 10:51, 10:61])
    kept[:, 10:51, 10:61] = 0
    assert not kept.any()
    assert done.kept == pytest.approx(41 * 51 / whole[0].size)


def test_stamps_that_were_moved_are_told_as_of_the_recording(tmp_path: Path) -> None:
    times = MOUSE.times_ns.copy()
    times[20] = times[19]
    done = pack(
        recorded(tmp_path / "walk.mcap", times.tolist()), plan=PLAN, whole=True, verify=True
    )
    with open_recording(tmp_path / "walk.mcap") as one, open_recording(done.path) as other:
        assert one.faults
        assert other.faults == one.faults
        assert other.gaps == one.gaps
        assert set(one.problems) <= set(other.problems)


def test_tenths_of_a_millimetre_are_kept(tmp_path: Path) -> None:
    with open_recording(recorded(tmp_path / "fine.mcap", step_mm=0.1)) as fine:
        steps = np.rint(depths(fine) / 0.1).astype(np.uint16)
        write_oni_file(
            tmp_path / "fine.oni", steps, fine.camera, fine.times_ns.tolist(), tenths=True
        )
    done = pack(tmp_path / "fine.oni", plan=PLAN, whole=True, verify=True)
    with open_recording(tmp_path / "fine.oni") as one, open_recording(done.path) as other:
        np.testing.assert_array_equal(depths(one), depths(other))


def test_depths_that_are_no_steps_are_refused_and_nothing_is_left(tmp_path: Path) -> None:
    path = recorded(tmp_path / "odd.mcap", step_mm=1.0 / 3.0)
    with pytest.raises(RecordingError, match="no whole steps of 16 bits"):
        pack(path, plan=PLAN, whole=True)
    assert [entry.name for entry in tmp_path.iterdir()] == ["odd.mcap"]


def test_a_cut_archive_is_refused_and_its_whole_frames_can_be_read(walking: Path) -> None:
    done = pack(walking, plan=PLAN, whole=True)
    data = done.path.read_bytes()
    done.path.write_bytes(data[: len(data) * 6 // 10])
    with pytest.raises(RecordingError, match=r"cut short or damaged, \d+ whole frames can be read"):
        pack(done.path, plan=PLAN, verify=True)
    with open_recording(done.path) as part, open_recording(walking) as whole:
        assert 10 < len(part) < len(whole)
        np.testing.assert_array_equal(depths(part), depths(whole)[: len(part)])
    accepting = PLAN.with_settings(["recording.accept_truncated=true"])
    with pytest.raises(RecordingError, match="have another hash than it states"):
        pack(done.path, plan=accepting, verify=True)


def test_a_picture_that_was_exchanged_is_found_by_the_hash(walking: Path) -> None:
    done = pack(walking, plan=PLAN, whole=True)
    assert not pack(done.path, plan=PLAN, verify=True).written
    with open_recording(done.path) as opened:
        stated = opened.metadata["packed"]
        forged = walking.with_name("forged.pack.mcap")
        facts = PackFacts(source=stated["source"]).to_notes()
        with McapDepthWriter(
            forged, opened.camera, messages="ros", packing="rvl", metadata=facts
        ) as writer:
            for frame in opened:
                depth = frame.depth.copy()
                depth[5, 5] += frame.index == 30
                writer.add(DepthFrame(frame.index, frame.time_ns, depth))
            writer.note(hash_note(stated["depth_sha256"]))
    with pytest.raises(RecordingError, match="have another hash than it states"):
        pack(forged, plan=PLAN, verify=True)


def test_facts_that_make_no_sense_are_told(walking: Path) -> None:
    with (
        open_recording(walking) as opened,
        McapDepthWriter(
            walking.with_name("bad.mcap"),
            opened.camera,
            messages="ros",
            packing="rvl",
            metadata={"packed": '{"step_mm": "none"}'},
        ) as writer,
    ):
        writer.add(opened.frame(0))
    with pytest.raises(RecordingError, match="the facts of this archive are damaged"):
        open_recording(walking.with_name("bad.mcap"))


def test_the_original_goes_only_when_asked_and_after_it_was_compared(
    walking: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = hashlib.sha256(walking.read_bytes()).hexdigest()
    pack(walking, plan=PLAN, whole=True, verify=True)
    assert hashlib.sha256(walking.read_bytes()).hexdigest() == before
    monkeypatch.setattr(job, "_within", _faulty)
    with pytest.raises(RecordingError, match="it was removed and the recording stays"):
        pack(walking, plan=PLAN, whole=True, delete_original=True, overwrite=True)
    assert hashlib.sha256(walking.read_bytes()).hexdigest() == before
    monkeypatch.undo()
    done = pack(walking, plan=PLAN, whole=True, delete_original=True, overwrite=True)
    assert done.verified
    assert done.deleted == [walking]
    assert not walking.exists()
    with open_recording(done.path) as opened:
        np.testing.assert_array_equal(opened.frame(3).depth, MOUSE.frame(3).depth)


_CALLS = [0]


def _faulty(mask: object) -> object:
    """A change of pictures that is another one each time it is made: a writer gone wrong."""
    _CALLS[0] += 1
    off = np.float32(_CALLS[0] % 2)
    return lambda depth: depth + off * (depth > 0)


def test_what_cannot_be_removed_is_told_before_any_work(tmp_path: Path, walking: Path) -> None:
    folder = tmp_path / "pictures"
    convert(walking, folder)
    with pytest.raises(RecordingError, match=r"one whole file, and pictures is \d+ files"):
        pack(folder, tmp_path / "p.mcap", plan=PLAN, whole=True, delete_original=True)
    assert not (tmp_path / "p.mcap").exists()
    with pytest.raises(RecordingError, match="is in no file"):
        pack(
            "synthetic:walk?seed=1&frames=3",
            tmp_path / "s.mcap",
            plan=PLAN,
            whole=True,
            delete_original=True,
        )


@pytest.mark.parametrize(
    ("to", "says"),
    [
        ("archive.oni", "an archive is an MCAP file; give --to NAME.mcap"),
        ("nowhere/a.mcap", "there is no folder"),
        ("walk.mcap", "is the recording itself"),
        ("there.mcap", "is there already"),
    ],
)
def test_a_place_that_cannot_be_is_told(walking: Path, to: str, says: str) -> None:
    walking.with_name("there.mcap").write_bytes(b"")
    with pytest.raises(RecordingError, match=says):
        pack(walking, walking.parent / to, plan=PLAN, whole=True)


def test_an_archive_is_not_packed_again(walking: Path) -> None:
    done = pack(walking, plan=PLAN, whole=True)
    with pytest.raises(RecordingError, match="is an archive of `liex pack` already"):
        pack(done.path, walking.with_name("again.mcap"), plan=PLAN)


@pytest.mark.nightly
def test_a_run_on_an_archive_gives_the_same_tables(
    walk: Path, walked: Session, tmp_path: Path
) -> None:
    done = pack(walk, tmp_path / "walk.pack.mcap", plan=PLAN)
    session = Session.open(measure(done.path, PLAN, tmp_path))
    names = sorted(path.name for path in walked.path.glob("*.parquet"))
    assert len(names) > 8
    for name in names:
        assert (session.path / name).read_bytes() == (walked.path / name).read_bytes(), name


def test_of_several_arenas_whole_pictures_are_kept(walking: Path) -> None:
    done = pack(walking, plan=PLAN.with_settings(["arenas=auto"]))
    assert done.kept == 1.0
    assert any("several arenas" in note for note in done.notes)
