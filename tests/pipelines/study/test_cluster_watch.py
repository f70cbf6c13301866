"""A study whose worker processes are gone for good ends in a sentence and waits for nobody."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest
from distributed.core import Status
from liex_lab.pipelines.study import cluster
from liex_lab.pipelines.study.cluster import KeptWorkers

from liex_lab.errors import StudyError


class Nanny:
    """Looks after a process; `started` counts how often it was told to start another one."""

    def __init__(self, pid: int | None) -> None:
        self.pid = pid
        self.status = Status.running
        self.started = 0

    def instantiate(self) -> None:
        self.started += 1


def kept(*pids: int | None) -> tuple[Any, KeptWorkers]:
    """A watch over nannies whose processes have these numbers; None for none."""
    nannies = {k: Nanny(pid) for k, pid in enumerate(pids)}
    loop = SimpleNamespace(add_callback=lambda do: do())
    cluster = SimpleNamespace(workers=nannies, loop=loop)
    client: Any = SimpleNamespace(futures={})
    return cluster, KeptWorkers(client, cluster)


def test_one_living_worker_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_NONE_LEFT_S", 0.0)
    _, watch = kept(None, os.getpid())
    watch.look()
    assert watch.gave_up == ""


def test_a_worker_that_its_nanny_has_forgotten_is_started_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    local, watch = kept(None, os.getpid(), None)
    local.workers[2].status = Status.closing
    watch.look()
    assert [nanny.started for nanny in local.workers.values()] == [0, 0, 0]
    monkeypatch.setattr(cluster, "_FORGOTTEN_S", 0.0)
    watch.look()
    assert [nanny.started for nanny in local.workers.values()] == [1, 0, 0]


def test_workers_that_come_again_in_time_are_waited_for() -> None:
    cluster, watch = kept(None)
    watch.look()
    cluster.workers[0].pid = os.getpid()
    watch.look()
    cluster.workers[0].pid = None
    watch.look()  # counted from now on
    assert watch.gave_up == ""


def test_a_process_that_has_ended_and_is_not_fetched_yet_is_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cluster, "_NONE_LEFT_S", 0.0)
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    _, watch = kept(process.pid)
    watch.look()
    assert watch.gave_up == ""
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    watch.look()
    process.wait()
    assert "could not be started again" in watch.gave_up


def test_a_study_whose_workers_are_gone_for_good_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    begin = cluster.local_cluster

    def gone(*given: Any) -> Any:
        cluster: Any = begin(*given)
        for nanny in cluster.workers.values():
            nanny.close_gracefully()  # it starts no other one
            os.kill(nanny.pid, signal.SIGKILL)
        return cluster

    monkeypatch.setattr(cluster, "local_cluster", gone)
    monkeypatch.setattr(cluster, "_NONE_LEFT_S", 1.0)
    monkeypatch.setattr(cluster, "KeptWorkers", lambda *given: KeptWorkers(*given, 0.2))
    planned: Any = [SimpleNamespace(session=SimpleNamespace(id=name)) for name in ("a", "b")]
    with pytest.raises(StudyError, match="worker processes have ended"):
        cluster.measure_cohort(planned, print, workers=2)
