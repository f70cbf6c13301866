"""Killed at any moment, a session goes on where it was, and its tables are those of an undisturbed
run.
"""

import errno
import json
import shutil
import time
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader

from liex_lab.errors import SessionError
from liex_lab.sessions import Session, SessionWriter, checkpoint, rrd, rrd_scene
from liex_lab.sessions.checkpoint import Checkpoint, Columns
from tests.sessions.interrupted import CHUNK, MOUSE, start, write_session
from tests.sessions.test_rrd import columns_of

N_KILLS = 2  # tests/campaign does many more


def tables_of(folder: Path) -> dict[str, bytes]:
    """Everything that has to be equal."""
    kinds = {".parquet", ".csv", ".toml"}
    return {
        path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.suffix in kinds
    }


def depth_messages(folder: Path) -> list[tuple[int, bytes]]:
    with (folder / "session.mcap").open("rb") as file:
        return [
            (m.log_time, m.data)
            for _, _, m in make_reader(file).iter_messages(topics=["/camera/depth"])
        ]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("whole") / "circle.liex"
    write_session(str(place), every_s=1000.0)
    return place


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[int]]:
    """A session whose process was killed again and again, and how far it was each time."""
    place = tmp_path_factory.mktemp("killed") / "circle.liex"
    rng = np.random.default_rng(8)
    reached: list[int] = []
    for _ in range(N_KILLS):
        process = start(place, pause_s=0.1)
        part, before = place.with_name("circle.liex.part"), reached[-1] if reached else 0
        deadline = time.monotonic() + 60
        while _frames_in(part) <= before and process.is_alive() and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(float(rng.uniform(0.0, 0.15)))
        process.kill()
        process.join()
        assert not place.exists() or process.exitcode == 0
        reached.append(_frames_in(part))
    process = start(place)
    process.join()
    assert process.exitcode == 0
    return place, reached


def _frames_in(part: Path) -> int:
    try:
        return int(json.loads((part / "checkpoint.json").read_text())["n_frames"])
    except OSError:
        return 0


def test_a_killed_session_goes_on_where_it_was(disturbed: tuple[Path, list[int]]) -> None:
    place, reached = disturbed
    assert reached[0] > 0
    assert reached == sorted(reached)
    assert Session.open(place).metadata["interruptions"] >= N_KILLS - 1
    assert [entry.name for entry in place.parent.iterdir()] == ["circle.liex"]


def test_its_files_are_those_of_an_undisturbed_one(
    disturbed: tuple[Path, list[int]], undisturbed: Path
) -> None:
    place, _ = disturbed
    assert tables_of(place) == tables_of(undisturbed)
    assert {path.name for path in place.iterdir()} == {path.name for path in undisturbed.iterdir()}
    for picture in (undisturbed / "thumbnails").iterdir():
        assert (place / "thumbnails" / picture.name).read_bytes() == picture.read_bytes()


def test_its_logs_are_whole_and_hold_every_frame_once(
    disturbed: tuple[Path, list[int]], undisturbed: Path
) -> None:
    place, _ = disturbed
    assert depth_messages(place) == depth_messages(undisturbed)
    with (place / "session.mcap").open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        reader = make_reader(file, validate_crcs=True)
        found = Counter(channel.topic for _, channel, _ in reader.iter_messages())
    with (undisturbed / "session.mcap").open("rb") as file:
        expected = Counter(channel.topic for _, channel, _ in make_reader(file).iter_messages())
    for topic in {*found, *expected} - {"/camera/calibration", "/tf"}:  # repeated by each run
        assert found[topic] == expected[topic], topic
    assert summary.statistics.message_count == found.total()


@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # what was joined is read as a whole
def test_its_replay_holds_the_rows_of_an_undisturbed_one(
    disturbed: tuple[Path, list[int]], undisturbed: Path
) -> None:
    for entity in (rrd_scene.DEPTH, f"{rrd.SKELETON}/joints", rrd.ACTIONS):
        rows = [columns_of(Session.open(place), entity) for place in (disturbed[0], undisturbed)]
        assert rows[0]["frame"] == rows[1]["frame"], entity
        for name in rows[1]:
            if name != "rerun.controls.RowId":
                assert repr(rows[0][name]) == repr(rows[1][name]), (entity, name)


def test_two_processes_do_not_write_one_session(tmp_path: Path) -> None:
    place = tmp_path / "circle.liex"
    with SessionWriter(place, MOUSE.provenance()) as writer:
        with pytest.raises(SessionError, match="another process is writing the session"):
            SessionWriter(place, MOUSE.provenance())
        frames, track = next(MOUSE.chunks(10))
        writer.add(frames)
        writer.track = track
        writer.close()
    assert len(Session.open(place).frames) == 10


def broken_at(
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    n: int,
    error: Exception,
    told: type[Exception] | None = None,
) -> None:
    """Write until a log breaks at its n-th batch; told: the kind of error that comes of it."""
    from liex_lab.sessions.mcap import McapWriter

    add, calls = McapWriter.add, []

    def breaks(self: McapWriter, *batch: object) -> None:
        calls.append(1)
        if len(calls) == n:
            raise error
        add(self, *batch)  # type: ignore[arg-type]

    monkeypatch.setattr(McapWriter, "add", breaks)
    with pytest.raises(told or type(error)):
        write_session(str(place))
    monkeypatch.undo()


def test_after_making_room_on_a_full_disk_the_work_resumes(
    tmp_path: Path, undisturbed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "circle.liex"
    broken_at(place, monkeypatch, 6, OSError(errno.ENOSPC, "No space left"), SessionError)
    assert not place.exists()
    assert _frames_in(tmp_path / "circle.liex.part") == 5 * CHUNK
    write_session(str(place))
    assert tables_of(place) == tables_of(undisturbed)


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a session whose process was interrupted after three chunks."""
    place = tmp_path_factory.mktemp("begun") / "circle.liex"
    with pytest.MonkeyPatch.context() as patch:
        broken_at(place, patch, 4, RuntimeError("the power went out"))
    return place.with_name("circle.liex.part")


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("checkpoint.json", {"key": "0"}),
        ("checkpoint.json", {"seconds": 10**400}),  # found by `python -m tests.campaign fuzz`
        ("checkpoint.json", "{"),
        ("session.mcap", ""),
        ("seen/root_mm.bin", ""),
    ],
)
def test_a_damaged_unfinished_session_is_started_again(
    tmp_path: Path, undisturbed: Path, begun: Path, file: str, content: str | dict[str, object]
) -> None:
    place, part = tmp_path / "circle.liex", tmp_path / "circle.liex.part"
    shutil.copytree(begun, part)
    if isinstance(content, dict):
        content = json.dumps({**json.loads((part / file).read_text()), **content})
    (part / file).write_text(content)
    write_session(str(place), every_s=1000.0)
    assert tables_of(place) == tables_of(undisturbed)
    assert Session.open(place).metadata["interruptions"] == 0


def test_an_accident_before_the_first_checkpoint_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ZeroDivisionError):  # noqa: SIM117
        with SessionWriter(tmp_path / "circle.liex", MOUSE.provenance()) as writer:
            writer.add([MOUSE.frame(1 // 0)])
    assert list(tmp_path.iterdir()) == []


def test_columns_grow_and_are_cut_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    blocks = [
        {"a": rng.normal(size=(n, 2, 3)), "b": rng.integers(0, 9, n), "c": np.array(["x"] * n)}
        for n in (3, 5, 1)
    ]
    columns = Columns(tmp_path)
    for block in blocks:
        columns.append(block)

    for name, values in columns.read().items():
        np.testing.assert_array_equal(values, np.concatenate([block[name] for block in blocks]))
    columns.close()
    assert Columns.cut(tmp_path, 4)
    assert not Columns.cut(tmp_path, 5)
    again = Columns(tmp_path)
    again.append(blocks[2])
    assert len(again.read()["a"]) == 5
    with pytest.raises(ValueError, match="appended"):
        again.append({"a": np.zeros(1)})
    again.close()


def test_checkpoints_are_taken_by_a_clock_that_never_jumps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [5.0]
    monkeypatch.setattr(checkpoint, "time", SimpleNamespace(monotonic=lambda: now[0]))
    held = Checkpoint(tmp_path / "x.part", {})
    due = [held.due]
    now[0] += checkpoint.EVERY_S
    due.append(held.due)
    held.begin_shards()
    due.append(held.due)
    assert due == [False, True, False]
    held.leave(keep=False)
    assert not (tmp_path / "x.part").exists()


@pytest.mark.skipif(not Path("/proc/1").is_dir(), reason="there is no /proc")
def test_a_folder_that_the_system_does_not_make_is_a_sentence() -> None:
    with pytest.raises(SessionError, match="name another place"):
        Checkpoint(Path("/proc/1/none/x.part"), {})
