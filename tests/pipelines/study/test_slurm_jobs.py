"""Where a job of Slurm ends before the study does, another one is asked for, but not for ever."""

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from liex_lab.pipelines.study import cluster
from liex_lab.pipelines.study.cluster import MOST_IN_VAIN, KeptJobs

from liex_lab.errors import StudyError


class Cluster:
    """Jobs by name, as dask-jobqueue keeps them."""

    def __init__(self, n: int) -> None:
        self.n_asked = 0
        self.workers: dict[str, Any] = {}
        self.scheduler_info: dict[str, Any] = {"workers": {}}
        self.loop = SimpleNamespace(add_callback=lambda do, *given: do(*given))
        self.scale(n)

    def scale(self, n: int) -> None:
        for name in (f"w{k}" for k in range(n)):
            if name not in self.workers:
                self.n_asked += 1
                self.workers[name] = SimpleNamespace(job_id=str(100 + self.n_asked))


@pytest.fixture
def jobs(monkeypatch: pytest.MonkeyPatch) -> Callable[[int, int], tuple[Cluster, set[str], Any]]:
    """A cluster of n jobs, the numbers that Slurm knows, and what keeps the jobs."""

    def begun(n: int, n_left: int) -> tuple[Cluster, set[str], KeptJobs]:
        asked = Cluster(n)
        left = {str(k): SimpleNamespace(status="pending") for k in range(n_left)}
        client: Any = SimpleNamespace(futures=left, cancel=lambda _: None)
        there = {job.job_id for job in asked.workers.values()}
        monkeypatch.setattr(cluster, "queued", lambda: there)
        return asked, there, KeptJobs(client, asked, n, "logs")

    return begun


def test_a_job_whose_worker_was_lost_is_asked_for_again(jobs: Any) -> None:
    asked, there, kept = jobs(2, 5)
    assert (kept.inspect(), asked.n_asked) == ("", 2)
    there.remove(asked.workers.pop("w1").job_id)  # Dask forgets a worker that was connected
    assert (kept.inspect(), asked.n_asked) == ("", 3)
    assert set(asked.workers) == {"w0", "w1"}


def test_a_job_that_never_answered_is_replaced_at_the_second_check(jobs: Any) -> None:
    asked, there, kept = jobs(2, 5)
    there.remove(asked.workers["w0"].job_id)
    assert (kept.inspect(), asked.n_asked) == ("", 2)
    assert (kept.inspect(), asked.n_asked) == ("", 3)


def test_no_more_jobs_than_sessions_are_left(jobs: Any) -> None:
    asked, _, kept = jobs(4, 2)
    for name in ("w0", "w1"):
        asked.workers.pop(name)
    assert (kept.inspect(), asked.n_asked) == ("", 4)


def test_where_slurm_does_not_answer_nothing_is_changed(
    jobs: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", "")
    assert cluster.queued() is None
    asked, _, kept = jobs(2, 5)
    monkeypatch.setattr(cluster, "queued", lambda: None)
    asked.workers.clear()
    assert kept.inspect() == ""
    assert not asked.workers


def test_jobs_that_all_end_at_once_end_the_study_with_a_sentence(jobs: Any) -> None:
    asked, there, kept = jobs(2, 5)
    there.clear()
    reasons = [kept.inspect() for _ in range(3 * MOST_IN_VAIN)]
    assert asked.n_asked <= 2 * (MOST_IN_VAIN + 2)
    assert "ended before they measured anything" in reasons[-1]

    def study() -> None:
        ended = threading.Event()
        client: Any = SimpleNamespace(futures={}, cancel=lambda _: ended.set())
        with cluster.watched(client, lambda: reasons[-1], 0.01):
            assert ended.wait(10.0)
            raise StudyError("the Dask scheduler ended")

    with pytest.raises(StudyError, match="ended before they measured"):
        study()
