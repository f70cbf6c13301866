"""Shards of a recording measured in parallel: the tables are those of one process, also after an
error.
"""

import pickle
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines import session as job
from liex_lab.pipelines.build import build_provenance, build_recording, build_tracker
from liex_lab.pipelines.verify import verify_session

from liex_lab.api import run_session
from liex_lab.errors import SessionError
from liex_lab.plan import Plan
from liex_lab.recordings.formats import moseq
from liex_lab.runtime import processes
from liex_lab.runtime.processes import Processes
from liex_lab.sessions import Session
from liex_lab.sessions.evidence import linked_recording
from tests.pipelines.conftest import KEPT, TIMES_NS, measure
from tests.recordings.writers import (
    write_archive,
    write_camera,
    write_mcap_parts,
    write_moseq_folder,
)
from tests.sessions.test_checkpoint import depth_messages, tables_of

LENGTH = 8  # frames of a shard here


class InTurn:
    """A pool of this process alone, which takes the last shard first and may fail."""

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
    monkeypatch.setattr(job, "LENGTH", LENGTH)


def run(folder: Path, out: Path, pool: Any = None) -> Path:
    return measure(folder, Plan.load("mouse"), out, pool=pool)


@pytest.mark.nightly
def test_processes_make_the_same_session(walked: Session, walk: Path, tmp_path: Path) -> None:
    shared = run_session(walk, Plan.load("mouse"), tmp_path, pool=Processes(2))
    assert tables_of(shared) == tables_of(walked.path)
    assert depth_messages(shared) == depth_messages(walked.path)
    assert Session.open(shared).metadata["interruptions"] == 0
    assert sorted(path.name for path in shared.iterdir()) == sorted(
        path.name for path in walked.path.iterdir()
    )
    assert not [one.sentence for one in verify_session(shared) if one.state == "wrong"]


@pytest.mark.parametrize("pooled", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_complete_shards_are_kept_after_an_error(
    pooled: bool, walked: Session, walk: Path, tmp_path: Path
) -> None:
    with pytest.raises(SessionError, match="without a word"):
        run(walk, tmp_path, InTurn(accident_after=3))
    assert not list(tmp_path.glob("*.liex"))
    pool = InTurn()
    done = run(walk, tmp_path, pool if pooled else None)
    assert pool.n_done == (-(-len(KEPT) // LENGTH) - 3 if pooled else 0)
    assert tables_of(done) == tables_of(walked.path)
    assert depth_messages(done) == depth_messages(walked.path)
    assert not list(tmp_path.glob("*.part"))


def test_a_recording_in_parts_gives_the_tables_of_the_whole(
    images: np.ndarray, mouse: Any, tmp_path: Path
) -> None:
    whole, split = (tmp_path / name for name in ("whole", "split"))
    for folder, cuts in ((whole, ()), (split, (9, 22))):
        folder.mkdir()
        write_mcap_parts(folder, images, cuts, TIMES_NS, mouse.camera)
    light = ["light.on=07:00", "light.off=19:00", "light.zone=Europe/Berlin"]
    plan = Plan.load("mouse").with_settings(light)
    single = (whole / "cam1_0.mcap").rename(whole / "cam1.mcap")
    at_once = measure(single, plan, tmp_path / "once")
    parts, out = split / "cam1_*.mcap", tmp_path / "parts"
    with pytest.raises(SessionError, match="without a word"):
        measure(parts, plan, out, pool=InTurn(accident_after=2))
    again = measure(parts, plan, out)
    assert list(Session.open(again).hours["clock"]) == ["2025-10-09T10:53:20+02:00"]
    assert tables_of(again) == tables_of(at_once)
    assert depth_messages(again) == depth_messages(at_once)
    assert linked_recording(Session.open(again)) == str(parts)
    assert not [one.sentence for one in verify_session(again) if one.state == "wrong"]


@pytest.mark.nightly
def test_workers_of_this_machine_read_what_an_archive_was_unpacked_to(
    images: np.ndarray, mouse: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packed = write_moseq_folder(tmp_path / "walk", images, [t / 1e6 for t in TIMES_NS])
    archive = write_archive(packed, tmp_path / "walk.tar.gz")
    write_camera(tmp_path, mouse.camera)
    unpacked: list[Any] = []
    unpack = moseq.unpack

    def unpack_and_note(*what: Any) -> Any:
        unpacked.append(what[0])
        return unpack(*what)

    monkeypatch.setattr(moseq, "unpack", unpack_and_note)
    made = {}
    for here in (True, False):
        unpacked.clear()
        job._opened.cache_clear()
        pool = InTurn()
        pool.here = here
        made[here] = run(archive, tmp_path / str(here), pool)
        assert pool.n_done > 2
        assert len(unpacked) == (1 if here else 2)
        assert linked_recording(Session.open(made[here])) == str(archive)
    assert tables_of(made[True]) == tables_of(made[False])


def test_the_number_of_processes_suits_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "n_cores", lambda: 6)
    assert processes.processes_for(1) is None
    assert processes.processes_for(3) == Processes(3)
    chosen = processes.processes_for(0)
    assert chosen is not None
    assert (chosen.n, chosen.fewest) == (3, 6000)
    monkeypatch.setattr(processes, "n_cores", lambda: 64)
    assert processes.processes_for(0) == Processes(4, fewest=6000)
    for few in (1, 2, 3):  # one process keeps them busy
        monkeypatch.setattr(processes, "n_cores", lambda few=few: few)
        assert processes.processes_for(0) is None


def test_cuts_are_the_same_wherever_a_run_resumes() -> None:
    assert list(job._cuts(0, 20)) == [(0, 8), (8, 16), (16, 20)]
    assert list(job._cuts(11, 20)) == [(11, 16), (16, 20)]
    assert list(job._cuts(20, 20)) == []


def test_a_shard_is_sent_without_its_model_and_arrives_with_it(
    mouse: Any,
    tmp_path: Path,
) -> None:
    plan = Plan.load("mouse")
    with build_recording(mouse, plan) as opened:
        tracker = build_tracker(opened, plan)
        origin = build_provenance(opened, plan, tracker)
    sent = pickle.dumps(job.Shard("recording", plan, tracker, origin, tmp_path, 0, 8))
    assert len(sent) < 0.2 * len(pickle.dumps(tracker))
    assert pickle.loads(sent).tracker.estimator is tracker.estimator  # of the same process
