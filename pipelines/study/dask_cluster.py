"""The Dask cluster of a study: processes of this machine, a running scheduler, or Slurm jobs.

Dask is imported here, in `crew` and in `cluster_watch` alone.
"""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import MissingPackageError, StudyError, how_to_install
from liex_lab.runtime.durable import Scratch

from ..workers import n_cores, worker_environment
from .cluster_watch import KeptWorkers
from .crew import DEATHS, Crew, Finished, Told
from .one_session import RunSession
from .slurm import SlurmTable
from .slurm_jobs import KeptJobs
from .status import SessionStatus

if TYPE_CHECKING:
    from distributed import Client
    from distributed.deploy.cluster import Cluster

_ENCRYPTED, _OPEN = ("tls", "wss"), ("tcp", "ws", "ucx")  # how a scheduler can be spoken to


def measure_cohort(
    todo: Sequence[SessionStatus],
    run: RunSession,
    *,
    workers: int = 0,
    threads: int = 0,
    scheduler: str | None = None,
    slurm: SlurmTable | None = None,
    told: Told = lambda *_: None,
    finished: Finished = lambda _: None,
) -> list[dict[str, Any]]:
    """Measure the sessions of a study; returns how each went, as `measure_one` does.

    Args:
        todo: the sessions that are to be measured.
        run: measures a recording, `liex_lab.api.run_session`.
        workers: processes on this machine; 0 takes one for every two cores.
        threads: cores of each; 0 takes an equal share.
        scheduler: address of a running Dask scheduler.
        slurm: how to ask a Slurm cluster for workers.
        told: is told id, pieces done, pieces in all, and what is being done.
        finished: is given each result as soon as it is there.

    Raises:
        StudyError: no scheduler answers, or it ends before the study does.
        MissingPackageError: Slurm is asked for and dask-jobqueue is not installed.
    """
    if not todo:
        return []
    with crew_of(len(todo), workers=workers, threads=threads, scheduler=scheduler, slurm=slurm) as (
        crew
    ):
        return crew.measure(todo, run, told, finished)


@contextmanager
def crew_of(
    n_tasks: int,
    *,
    workers: int = 0,
    threads: int = 0,
    scheduler: str | None = None,
    slurm: SlurmTable | None = None,
) -> Iterator[Crew]:
    """Workers for the sessions of a study, within the block.

    Args:
        n_tasks: the most sessions that there are to do at once.
        workers: processes on this machine; 0 takes one for every two cores.
        threads: cores of each; 0 takes an equal share.
        scheduler: address of a running Dask scheduler.
        slurm: how to ask a Slurm cluster for workers.

    Raises:
        StudyError: no scheduler answers, or it ends before the study does.
        MissingPackageError: Slurm is asked for and dask-jobqueue is not installed.
    """
    with _client(n_tasks, workers, threads, scheduler, slurm) as client:
        yield Crew(client, slurm.jobs if slurm else 0)


def is_encrypted(scheduler: str) -> bool:
    """Whether what is sent to a scheduler is encrypted.

    Args:
        scheduler: its address, as in tcp://10.0.0.1:8786.

    Raises:
        StudyError: it is no address of a scheduler.
    """
    kind, found, place = scheduler.rpartition("://")  # tcp where it says nothing
    if not place or (found and kind not in _ENCRYPTED + _OPEN):
        raise StudyError(
            f"{scheduler!r} is no address of a Dask scheduler; expected one as in "
            "tcp://10.0.0.1:8786 or tls://10.0.0.1:8786, which `dask scheduler` prints"
        )
    return kind in _ENCRYPTED


@contextmanager
def _client(
    n_tasks: int, workers: int, threads: int, scheduler: str | None, slurm: SlurmTable | None
) -> Iterator[Client]:
    """A client of the cluster that was asked for."""
    import dask
    from distributed import Client

    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # we say what is lost
    # one session at a worker at a time: what waits there is held to have killed it, too
    settings = {
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.logging.distributed": "critical",
        "distributed.worker.memory.terminate": False,
        # a machine that is busy or was put to sleep is not a dead one
        "distributed.scheduler.worker-ttl": "3600s",
        "distributed.comm.timeouts.connect": "120s",
        # plain HTTP that would tell ids and paths to every account of the machine
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
    }
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(settings))
        if scheduler is not None:
            try:
                yield stack.enter_context(Client(scheduler, timeout="20s", set_as_default=False))
            except (OSError, ValueError, TypeError) as error:
                raise StudyError(
                    f"no Dask scheduler answers at {scheduler} ({error}); start one with `dask "
                    "scheduler`, or leave --scheduler out"
                ) from None
            return
        scratch = str(stack.enter_context(closing(Scratch())).folder)
        stack.enter_context(dask.config.set({"temporary-directory": scratch}))
        cluster = (
            slurm_cluster(slurm, scratch)
            if slurm
            else local_cluster(n_tasks, workers, threads, scratch)
        )
        stack.enter_context(cluster)
        client = stack.enter_context(Client(cluster, set_as_default=False))
        if not slurm:
            stack.enter_context(KeptWorkers(client, cluster))
        else:
            n_jobs = min(slurm.jobs, n_tasks)  # a job is one worker
            cluster.scale(n_jobs)
            stack.enter_context(KeptJobs(client, cluster, n_jobs, slurm.log_folder))
        try:
            yield client
        except BaseException:
            if not slurm:
                _end_workers(cluster)
            raise


def _end_workers(cluster: Any) -> None:
    """Kill the worker processes of this machine: asked to end, they would first finish a kernel,
    and a session goes on from its checkpoint either way.
    """
    for nanny in cluster.workers.values():
        nanny.close_gracefully()  # or it would start another one
        if nanny.pid:
            with suppress(ProcessLookupError):
                os.kill(nanny.pid, signal.SIGKILL)


def local_cluster(n_tasks: int, workers: int, threads: int, scratch: str) -> Cluster:
    """Worker processes on this machine, reached through this machine alone, with keys for this run.

    Args:
        n_tasks: sessions to measure; there are no more workers than that.
        workers: processes; 0 takes one for every two cores.
        threads: cores of each; 0 takes an equal share.
        scratch: folder for temporary files.
    """
    from distributed import LocalCluster, Security

    cores = n_cores()
    count = max(1, min(workers or (cores + 1) // 2, n_tasks))
    return LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address=None,
        scheduler_kwargs={
            "dashboard": False,
            "dashboard_address": "127.0.0.1:0",  # any port: another study's may have the usual one
        },
        memory_limit=0,
        local_directory=scratch,
        silence_logs=50,
        security=Security.temporary(),
        env=worker_environment(threads or max(1, cores // count)),
    )


def slurm_cluster(table: SlurmTable, scratch: str) -> Any:
    """A cluster whose workers are jobs of Slurm; the scheduler is this process.

    Args:
        table: how to ask for jobs.
        scratch: folder for temporary files where the table names none.

    Raises:
        MissingPackageError: dask-jobqueue is not installed.
    """
    try:
        from dask_jobqueue import SLURMCluster
    except ImportError:
        raise MissingPackageError(
            f"workers on Slurm need the package dask-jobqueue; {how_to_install('slurm')}"
        ) from None
    from distributed import Security

    shared = Path(table.shared_folder).expanduser()
    shared.mkdir(mode=0o700, parents=True, exist_ok=True)
    return SLURMCluster(
        **slurm_options(table, scratch),
        scheduler_options={"dashboard": False, "dashboard_address": None},
        security=Security.temporary(),
        shared_temp_directory=str(shared),
        silence_logs=50,
    )


def slurm_options(table: SlurmTable, scratch: str) -> dict[str, Any]:
    """The options of one job: a worker that measures a session at a time on all its cores.

    Args:
        table: how to ask for jobs.
        scratch: folder for temporary files where the table names none.
    """
    exports = [
        f"export {name}={value}" for name, value in worker_environment(table.cores_per_job).items()
    ]
    exports.append("export DASK_DISTRIBUTED__WORKER__HTTP__ROUTES='[]'")
    return {
        "queue": table.partition,
        "account": table.account,
        "cores": 1,
        "processes": 1,
        "memory": table.memory,
        "job_cpu": table.cores_per_job,
        "walltime": table.walltime,
        "interface": table.interface,
        "job_script_prologue": [*table.prologue, *exports],
        "job_extra_directives": list(table.directives),
        "local_directory": table.local_folder or scratch,
        "log_directory": table.log_folder,
        "worker_extra_args": ["--no-dashboard"],
    }
