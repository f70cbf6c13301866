"""Archives of recordings: what they hold, how small they are, and what is refused."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines import convert as job
from liex_lab.pipelines.convert import convert, pack

from liex_lab.api import DEMO, run_session
from liex_lab.catalog import find_sample
from liex_lab.errors import RecordingError
from liex_lab.plan import Plan
from liex_lab.recordings import Recording, open_recording
from liex_lab.recordings.formats.messages.statements import PackFacts, hash_note
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.writer import McapDepthWriter
from liex_lab.sessions import Session
from tests.recordings.writers import write_oni_file
from tests.sessions.walking_mouse import WalkingMouse, steady

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
def recording(tmp_path: Path) -> Path:
    return recorded(tmp_path / "walk.mcap")


def depths(opened: Recording) -> np.ndarray:
    return np.stack([frame.depth for frame in opened])


def test_an_archive_holds_every_picture_time_and_fact_bit_for_bit(recording: Path) -> None:
    done = pack(recording, plan=PLAN, whole=True, verify=True)
    assert done.path == recording.with_name("walk.pack.mcap")
    assert done.verified
    assert done.kept == 1.0
    with open_recording(recording) as one, open_recording(done.path, strict=True) as other:
        np.testing.assert_array_equal(depths(one), depths(other))
        assert depths(other).dtype == np.float32
        np.testing.assert_array_equal(one.times_ns, other.times_ns)
        assert one.camera == other.camera
        assert other.name == "walk", "its tables carry the recording's name"
        assert other.metadata["subject_id"] == "m07"
        assert other.metadata["packed"]["source"]["sha256"] == one.digest()
    assert done.n_bytes < 0.85 * done.source_bytes


def test_an_archive_is_known_by_its_content_under_any_name(recording: Path) -> None:
    done = pack(recording, plan=PLAN, whole=True)
    other = done.path.rename(recording.with_name("archive of tuesday.bin"))
    with open_recording(other) as opened:
        assert len(opened) == len(MOUSE.times_s)


def test_outside_of_a_region_that_was_named_pixels_are_unread(recording: Path) -> None:
    plan = PLAN.with_settings(["arena.region=[[10, 10], [60, 10], [60, 50], [10, 50]]"])
    done = pack(recording, plan=plan, verify=True)
    with open_recording(recording) as one, open_recording(done.path) as other:
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


def test_a_cut_archive_is_refused_and_its_whole_frames_can_be_read(recording: Path) -> None:
    done = pack(recording, plan=PLAN, whole=True)
    data = done.path.read_bytes()
    done.path.write_bytes(data[: len(data) * 6 // 10])
    with pytest.raises(RecordingError, match=r"cut short or damaged, \d+ whole frames can be read"):
        pack(done.path, plan=PLAN, verify=True)
    with open_recording(done.path) as part, open_recording(recording) as whole:
        assert 10 < len(part) < len(whole)
        np.testing.assert_array_equal(depths(part), depths(whole)[: len(part)])
    accepting = PLAN.with_settings(["recording.accept_truncated=true"])
    with pytest.raises(RecordingError, match="have another hash than it states"):
        pack(done.path, plan=accepting, verify=True)


def test_a_changed_byte_is_found_on_opening(recording: Path) -> None:
    done = pack(recording, plan=PLAN, whole=True)
    data = bytearray(done.path.read_bytes())
    data[len(data) // 2] ^= 0x10
    done.path.write_bytes(data)
    with pytest.raises(RecordingError, match="cut short or damaged"):
        pack(done.path, plan=PLAN, verify=True)


def test_a_picture_that_was_exchanged_is_found_by_the_hash(recording: Path) -> None:
    done = pack(recording, plan=PLAN, whole=True)
    assert not pack(done.path, plan=PLAN, verify=True).written
    with open_recording(done.path) as opened:
        stated = opened.metadata["packed"]
        forged = recording.with_name("forged.pack.mcap")
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


def test_facts_that_make_no_sense_are_told(recording: Path) -> None:
    with (
        open_recording(recording) as opened,
        McapDepthWriter(
            recording.with_name("bad.mcap"),
            opened.camera,
            messages="ros",
            packing="rvl",
            metadata={"packed": '{"step_mm": "none"}'},
        ) as writer,
    ):
        writer.add(opened.frame(0))
    with pytest.raises(RecordingError, match="the facts of this archive are damaged"):
        open_recording(recording.with_name("bad.mcap"))


def test_the_original_goes_only_when_asked_and_after_it_was_compared(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = hashlib.sha256(recording.read_bytes()).hexdigest()
    pack(recording, plan=PLAN, whole=True, verify=True)
    assert hashlib.sha256(recording.read_bytes()).hexdigest() == before
    monkeypatch.setattr(job, "_within", _faulty)
    with pytest.raises(RecordingError, match="it was removed and the recording stays"):
        pack(recording, plan=PLAN, whole=True, delete_original=True, overwrite=True)
    assert hashlib.sha256(recording.read_bytes()).hexdigest() == before
    monkeypatch.undo()
    done = pack(recording, plan=PLAN, whole=True, delete_original=True, overwrite=True)
    assert done.verified
    assert done.deleted == [recording]
    assert not recording.exists()
    with open_recording(done.path) as opened:
        np.testing.assert_array_equal(opened.frame(3).depth, MOUSE.frame(3).depth)


_CALLS = [0]


def _faulty(mask: object) -> object:
    """A change of pictures that is another one each time it is made: a writer gone wrong."""
    _CALLS[0] += 1
    off = np.float32(_CALLS[0] % 2)
    return lambda depth: depth + off * (depth > 0)


def test_what_cannot_be_removed_is_told_before_any_work(tmp_path: Path, recording: Path) -> None:
    folder = tmp_path / "pictures"
    convert(recording, folder)
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
def test_a_place_that_cannot_be_is_told(recording: Path, to: str, says: str) -> None:
    recording.with_name("there.mcap").write_bytes(b"")
    with pytest.raises(RecordingError, match=says):
        pack(recording, recording.parent / to, plan=PLAN, whole=True)


def test_an_archive_is_not_packed_again(recording: Path) -> None:
    done = pack(recording, plan=PLAN, whole=True)
    with pytest.raises(RecordingError, match="is an archive of `liex pack` already"):
        pack(done.path, recording.with_name("again.mcap"), plan=PLAN)


def test_a_run_on_an_archive_gives_the_same_tables(tmp_path: Path) -> None:
    sample = find_sample(DEMO)
    done = pack(sample, tmp_path / f"{sample.stem}.pack.mcap", plan=PLAN)
    sessions = [
        Session.open(run_session(path, PLAN, tmp_path / name))
        for path, name in ((sample, "one"), (done.path, "other"))
    ]
    names = sorted(path.name for path in sessions[0].path.glob("*.parquet"))
    assert len(names) > 8
    for name in names:
        one, other = ((session.path / name).read_bytes() for session in sessions)
        assert one == other, name


def test_of_several_arenas_whole_pictures_are_kept(recording: Path) -> None:
    done = pack(recording, plan=PLAN.with_settings(["arenas=auto"]))
    assert done.kept == 1.0
    assert any("several arenas" in note for note in done.notes)
