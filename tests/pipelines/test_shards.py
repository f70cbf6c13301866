"""A recording looked at in stretches, side by side: the tables are those of one process, also after
an accident.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines import session as job
from liex_lab.pipelines import shards, workers
from liex_lab.pipelines.build import build_recording, build_tracker
from liex_lab.pipelines.origin import build_provenance
from liex_lab.pipelines.verify import verify_session
from liex_lab.pipelines.workers import Processes

from liex_lab.api import run_session
from liex_lab.errors import RecordingError, SessionError
from liex_lab.plan import Plan
from liex_lab.recordings.formats import moseq
from liex_lab.recordings.recording import Recording
from liex_lab.sessions import Session
from liex_lab.sessions.evidence import linked_recording
from tests.pipelines.test_session import N_RENDERED, folder, mouse, pictures, session, times_ns  # noqa: F401
from tests.recordings.writers import write_archive, write_camera, write_moseq_folder
from tests.sessions.test_checkpoint import depth_messages, tables_of

LENGTH = 8  # frames of a stretch here


class InTurn:
    """A pool of this process alone, which takes the last stretch first and may meet with an
    accident.
    """

    here = True

    def __init__(self, accident_after: int = 1000, fewest: int = 0) -> None:
        self.left, self.n_done, self.fewest = accident_after, 0, fewest

    def each(self, do: Callable[[Any], Any], works: Sequence[Any]) -> Iterator[Any]:
        for work in reversed(works):
            if self.left == 0:
                raise SessionError(
                    "a worker process ended without a word; run the same command again"
                )
            self.left -= 1
            self.n_done += 1
            yield do(work)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "LENGTH", LENGTH)
    monkeypatch.setattr(job, "LENGTH", LENGTH)


def run(folder: Path, out: Path, **how: Any) -> Path:  # noqa: F811
    return run_session(folder, Plan.load("mouse"), out, **how)


@pytest.mark.parametrize("n", [2, 4])
def test_tables_do_not_depend_on_the_number_of_workers(
    n: int,
    session: Session,  # noqa: F811
    folder: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    shared = run(folder, tmp_path, pool=Processes(n))
    assert tables_of(shared) == tables_of(session.path)
    assert depth_messages(shared) == depth_messages(session.path)
    assert Session.open(shared).metadata["interruptions"] == 0
    assert sorted(path.name for path in shared.iterdir()) == sorted(
        path.name for path in session.path.iterdir()
    )
    assert not [one.sentence for one in verify_session(shared, run_session) if one.state == "wrong"]


@pytest.mark.parametrize("then", ["with a pool", "alone"])
def test_after_an_accident_what_is_whole_is_not_done_again(
    then: str,
    session: Session,  # noqa: F811
    folder: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    with pytest.raises(SessionError, match="without a word"):
        run(folder, tmp_path, pool=InTurn(accident_after=3))
    assert not list(tmp_path.glob("*.liex"))
    n_stretches = -(-(N_RENDERED - 3) // LENGTH)
    pool = InTurn()
    done = run(folder, tmp_path, pool=pool if then == "with a pool" else None)
    assert pool.n_done == (n_stretches - 3 if then == "with a pool" else 0)
    assert tables_of(done) == tables_of(session.path)
    assert depth_messages(done) == depth_messages(session.path)
    assert not list(tmp_path.glob("*.part"))


def test_a_frame_that_cannot_be_read_is_told_and_a_whole_recording_goes_on(
    session: Session,  # noqa: F811
    folder: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frame = Recording.frame

    def torn(self: Recording, row: int) -> Any:
        if row == 21 and shards.CHUNK:
            raise RecordingError("frame 21 cannot be read; copy the recording again")
        return frame(self, row)

    def torn_shard(work: Any) -> Any:
        with monkeypatch.context() as patch:
            patch.setattr(Recording, "frame", torn)
            return measure_shard(work)

    measure_shard = shards.measure_shard
    monkeypatch.setattr(shards, "measure_shard", torn_shard)
    with pytest.raises(RecordingError, match="frame 21"):
        run(folder, tmp_path, pool=InTurn())
    monkeypatch.setattr(shards, "measure_shard", measure_shard)
    assert tables_of(run(folder, tmp_path)) == tables_of(session.path)


def test_a_short_recording_and_one_that_is_open_are_looked_at_by_one(
    session: Session,  # noqa: F811
    folder: Path,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(job, "LENGTH", 1000)
    pool = InTurn()
    assert tables_of(run(folder, tmp_path, pool=pool)) == tables_of(session.path)
    assert pool.n_done == 0


def test_what_takes_longer_to_share_than_to_do_is_done_by_one(
    session: Session,  # noqa: F811
    folder: Path,  # noqa: F811
    tmp_path: Path,
) -> None:
    pool = InTurn(fewest=1000)
    assert tables_of(run(folder, tmp_path, pool=pool)) == tables_of(session.path)
    assert pool.n_done == 0


@pytest.mark.parametrize("here", [True, False])
def test_workers_of_this_machine_read_what_an_archive_was_unpacked_to(
    here: bool,
    pictures: np.ndarray,  # noqa: F811
    mouse: Any,  # noqa: F811
    times_ns: list[int],  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stamps = [t / 1e6 for t in times_ns]
    packed = write_moseq_folder(tmp_path / "walk", pictures, stamps)
    archive = write_archive(packed, tmp_path / "walk.tar.gz")
    write_camera(tmp_path, mouse.camera)
    told: list[Any] = []
    unpack = moseq.unpack

    def unpack_and_tell(*what: Any) -> Any:
        told.append(what[0])
        return unpack(*what)

    monkeypatch.setattr(moseq, "unpack", unpack_and_tell)
    shards._opened.cache_clear()
    pool = InTurn()
    pool.here = here
    shared = run(archive, tmp_path / "shared", pool=pool)
    assert pool.n_done > 2
    assert len(told) == (1 if here else 2)
    assert tables_of(shared) == tables_of(run(archive, tmp_path / "alone"))
    assert linked_recording(Session.open(shared)) == str(archive)


def test_as_many_processes_as_pay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "n_cores", lambda: 6)
    assert workers.processes_for(1) is None
    assert workers.processes_for(3) == Processes(3)
    chosen = workers.processes_for(0)
    assert chosen is not None
    assert (chosen.n, chosen.fewest) == (3, 6000)
    monkeypatch.setattr(workers, "n_cores", lambda: 64)
    assert workers.processes_for(0) == Processes(4, fewest=6000)
    for few in (1, 2, 3):  # one process keeps them busy
        monkeypatch.setattr(workers, "n_cores", lambda few=few: few)
        assert workers.processes_for(0) is None


def test_cuts_are_at_the_same_places_wherever_the_work_goes_on() -> None:
    assert list(shards._cuts(0, 20)) == [(0, 8), (8, 16), (16, 20)]
    assert list(shards._cuts(11, 20)) == [(11, 16), (16, 20)]
    assert list(shards._cuts(20, 20)) == []


def test_a_stretch_is_sent_without_its_model_and_arrives_with_it(
    mouse: Any,  # noqa: F811
    tmp_path: Path,
) -> None:
    plan = Plan.load("mouse")
    with build_recording(mouse, plan) as opened:
        tracker = build_tracker(opened, plan)
        origin = build_provenance(opened, plan, tracker)
    sent = pickle.dumps(shards.Shard("recording", plan, tracker, origin, tmp_path, 0, 8))
    assert len(sent) < 0.2 * len(pickle.dumps(tracker))
    assert pickle.loads(sent).tracker.estimator is tracker.estimator  # of the same process
