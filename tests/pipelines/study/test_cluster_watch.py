"""A study whose worker processes are gone for good ends in a sentence and waits for nobody."""

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
    """Workers whose nannies' processes have these numbers; None for none."""
    nannies = {k: Nanny(pid) for k, pid in enumerate(pids)}
    loop = SimpleNamespace(add_callback=lambda do: do())
    local = SimpleNamespace(workers=nannies, loop=loop)
    return local, KeptWorkers(local)


def test_forgotten_workers_are_started_again_while_one_is_alive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cluster, "_NONE_LEFT_S", 0.0)
    local, workers = kept(None, os.getpid(), None)
    local.workers[2].status = Status.closing
    assert workers.inspect() == ""
    assert [nanny.started for nanny in local.workers.values()] == [0, 0, 0]
    monkeypatch.setattr(cluster, "_FORGOTTEN_S", 0.0)
    assert workers.inspect() == ""
    assert [nanny.started for nanny in local.workers.values()] == [1, 0, 0]


def test_workers_that_come_again_in_time_are_waited_for() -> None:
    local, workers = kept(None)
    for pid in (None, os.getpid(), None):  # counted from the last one on
        local.workers[0].pid = pid
        assert workers.inspect() == ""


def test_a_process_that_has_ended_and_is_not_fetched_yet_is_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cluster, "_NONE_LEFT_S", 0.0)
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    _, workers = kept(process.pid)
    assert workers.inspect() == ""
    process.kill()
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    reason = workers.inspect()
    process.wait()
    assert "could not be started again" in reason


@pytest.mark.nightly
def test_a_study_whose_workers_are_gone_for_good_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "_NONE_LEFT_S", 1.0)
    monkeypatch.setattr(cluster, "WORKERS_EVERY_S", 0.2)
    planned: Any = [SimpleNamespace(session=SimpleNamespace(id=name)) for name in ("a", "b")]

    def measure() -> None:
        with cluster.crew_of(2, workers=2) as crew:
            local: Any = crew.client.cluster
            for nanny in local.workers.values():
                nanny.close_gracefully()  # it starts no other one
                os.kill(nanny.pid, signal.SIGKILL)
            crew.measure(planned, print)

    with pytest.raises(StudyError, match="worker processes have ended"):
        measure()
