"""Where a job of Slurm ends before the study does, another one is asked for, but not for ever."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from liex_lab.pipelines.study.cluster import MOST_IN_VAIN, KeptJobs, queued

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


def jobs(n: int, n_left: int) -> tuple[Cluster, set[str], KeptJobs]:
    cluster = Cluster(n)
    client: Any = SimpleNamespace(
        futures={str(k): SimpleNamespace(status="pending") for k in range(n_left)}
    )
    there = {job.job_id for job in cluster.workers.values()}
    return cluster, there, KeptJobs(client, cluster, n, "logs", lambda: there)


def test_a_job_whose_worker_was_lost_is_asked_for_anew() -> None:
    cluster, there, kept = jobs(2, n_left=5)
    kept.look()
    assert cluster.n_asked == 2
    there.remove(cluster.workers.pop("w1").job_id)  # Dask forgets a worker that was connected
    kept.look()
    assert cluster.n_asked == 3
    assert set(cluster.workers) == {"w0", "w1"}


def test_a_job_that_never_answered_is_replaced_at_the_second_look() -> None:
    cluster, there, kept = jobs(2, n_left=5)
    there.remove(cluster.workers["w0"].job_id)
    kept.look()
    assert cluster.n_asked == 2
    kept.look()
    assert cluster.n_asked == 3


def test_no_more_jobs_than_sessions_are_left() -> None:
    cluster, _, kept = jobs(4, n_left=2)
    for name in ("w0", "w1"):
        cluster.workers.pop(name)
    kept.look()
    assert cluster.n_asked == 4


def test_where_slurm_does_not_answer_nothing_is_changed() -> None:
    cluster, _, kept = jobs(2, n_left=5)
    kept._ask = lambda: None
    cluster.workers.clear()
    kept.look()
    assert not cluster.workers


def test_jobs_that_all_end_at_once_end_the_study_with_a_sentence() -> None:
    cluster, there, kept = jobs(2, n_left=5)
    there.clear()
    for _ in range(3 * MOST_IN_VAIN):
        kept.look()
    assert cluster.n_asked <= 2 * (MOST_IN_VAIN + 2)
    with pytest.raises(StudyError, match="ended before they measured anything"), kept:
        raise StudyError("the Dask scheduler ended")


def test_without_slurm_nobody_knows_what_is_queued(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    assert queued() is None
