"""Measurement of a study on a Dask cluster: local processes, a running scheduler, or Slurm jobs.

A session is one task. It may run twice (a worker dies, and another takes over): it leaves its
results on disk, goes on where it was, and done twice it does the same. Sessions are measured side
by side, each by one worker; where fewer are left than there are workers, these share the shards of
each. A session that more than three workers died of is quarantined. Dask is imported here alone.
"""

from __future__ import annotations

import logging
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import MissingPackageError, StudyError, how_to_install
from liex_lab.plan.study import PlannedSession
from liex_lab.runtime.progress import Progress
from liex_lab.runtime.scratch import Scratch
from liex_lab.sessions.failure import describe_failure

from ..workers import Done, Work, n_cores, worker_environment
from .cluster_watch import KeptWorkers
from .one_session import RunSession, measure_one, quarantine
from .sharing import LOOKING, LookAtSession, about
from .slurm import SlurmTable
from .slurm_jobs import KeptJobs
from .status import SessionStatus

if TYPE_CHECKING:
    from distributed import Client
    from distributed.deploy.cluster import Cluster

TOPIC = "liex-progress"
_DEATHS = 3  # of workers, before a session is held to be what kills them
_TOLD_EVERY_S = 0.5
_ENCRYPTED, _OPEN = ("tls", "wss"), ("tcp", "ws", "ucx")  # how a scheduler can be spoken to

Told = Callable[
    [str, int, int | None, str], None
]  # session, pieces done, pieces in all, what is being done
Finished = Callable[[dict[str, Any]], None]  # what `measure_one` returns


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


class Crew:
    """The workers of a study.

    Args:
        client: of their cluster.
        n_jobs: how many of them are to come; 0 where they are there.
    """

    def __init__(self, client: Client, n_jobs: int = 0) -> None:
        self._client, self._n_jobs = client, n_jobs
        self._told: Told = lambda *_: None
        client.subscribe_topic(TOPIC, lambda event: self._told(*event[1]))

    def measure(
        self,
        todo: Sequence[SessionStatus],
        run: RunSession,
        told: Told = lambda *_: None,
        finished: Finished = lambda _: None,
    ) -> list[dict[str, Any]]:
        """Measure sessions; returns how each went, as `measure_one` does.

        Args:
            todo: the sessions.
            run: measures a recording, `liex_lab.api.run_session`.
            told: is told id, pieces done, pieces in all, and what is being done.
            finished: is given each result as soon as it is there.
        """
        self._told = told
        count = self._n_jobs or len(self._client.nthreads())
        shared = n_shared(len(todo), count)
        task = partial(_on_worker, run)
        planned = [one.session for one in todo]
        return list(_results(self._client, planned, task, _died, finished, shared))

    def look_at(
        self,
        sessions: Sequence[PlannedSession],
        look: LookAtSession,
        told: Told = lambda *_: None,
        finished: Finished = lambda _: None,
    ) -> list[dict[str, Any]]:
        """Look at sessions; returns what was found of each animal, see `sharing.look_at`.

        Args:
            sessions: the sessions.
            look: looks at one, `sharing.look_at`.
            told: is told id, pieces done, pieces in all, and what is being done.
            finished: is given each look as soon as it is there.
        """
        self._told = told
        task = partial(_look_on_worker, look)
        return list(_results(self._client, sessions, task, _died_looking, finished))


def n_shared(n: int, n_workers: int) -> int:
    """How many of n sessions, the last ones, are cut into shards for all workers to measure.

    As many as would leave workers idle if each were measured by one. Cutting costs: what each
    worker wrote is copied into one.

    Args:
        n: number of sessions.
        n_workers: number of workers.
    """
    return n % max(n_workers, 1)


def _results(
    client: Client,
    planned: Sequence[PlannedSession],
    task: Callable[[PlannedSession, str, bool], dict[str, Any]],
    died: Callable[[PlannedSession, BaseException], dict[str, Any]],
    finished: Finished,
    shared: int = 0,
) -> Iterator[dict[str, Any]]:
    """What the task makes of every session, or `died` of one whose workers ended without a word."""
    from distributed import CancelledError, as_completed

    run_id = f"{os.getpid()}-{time.monotonic_ns()}"
    submitted = [
        client.submit(
            task,
            session,
            run_id,
            k >= len(planned) - shared,
            key=f"{session.id}-{run_id}",
            pure=False,
        )
        for k, session in enumerate(planned)
    ]
    sessions = {future.key: session for future, session in zip(submitted, planned, strict=True)}
    completed = as_completed(submitted, loop=client.loop)
    del submitted
    for future in completed:
        session = sessions[future.key]
        try:  # a result that a dying worker took with it is waited for until it is made again
            error = future.exception()
            result = died(session, error) if error is not None else future.result()
        except CancelledError:  # by the client, as nobody here takes a session back
            raise StudyError(
                "the Dask scheduler ended before the study did; the sessions that were measured "
                "are kept, and the same command goes on with the rest once a scheduler answers"
            ) from None
        future.release()  # what a worker holds would be made again if it died
        finished(result)
        yield result


def _died(session: PlannedSession, error: BaseException) -> dict[str, Any]:
    """The outcome of a session whose workers ended without a word."""
    failure = _why_died(error, "measuring")
    quarantine(session, failure)
    return {"id": session.id, "state": "failed", "seconds": 0.0, "failure": failure}


def _died_looking(session: PlannedSession, error: BaseException) -> dict[str, Any]:
    """The look at a session whose workers ended without a word."""
    return about(session) | {"failure": _why_died(error, LOOKING)}


def _why_died(error: BaseException, stage: str) -> dict[str, Any]:
    failure = describe_failure(error, stage, None)
    if type(error).__name__ == "KilledWorker":
        failure |= {
            "reason": f"the worker process died {_DEATHS + 1} times while it measured this session",
            "remedy": (
                "give workers more memory or run fewer at a time, see the system's log, and try "
                "it again"
            ),
        }
        failure.pop("traceback", None)
    return failure


def _on_worker(
    run: RunSession, session: PlannedSession, run_id: str, shared: bool
) -> dict[str, Any]:
    """The task: one session, its progress sent to whoever started the study. shared: by all
    workers.
    """
    return measure_one(session, run, _teller(session), run_id, Workers() if shared else None)


def _look_on_worker(
    look: LookAtSession, session: PlannedSession, run_id: str, shared: bool
) -> dict[str, Any]:
    """The task of a look, which is short: no other worker has a share in it."""
    return look(session, _teller(session))


def _teller(session: PlannedSession) -> Progress:
    """What a task tells its progress; it is sent to whoever started the study."""
    from distributed import get_worker

    worker = get_worker()
    last = 0.0

    def tell(done: int, total: int | None, what: str) -> None:
        """Send `done`, `total` and `what` to whoever started the study, at most twice a second."""
        nonlocal last
        now = time.monotonic()
        if now - last > _TOLD_EVERY_S:
            last = now
            worker.log_event(TOPIC, [session.id, done, total, what])

    return tell


class Workers:
    """All workers of the cluster that a task runs on, as a pool for the shards of its session."""

    def each(self, do: Callable[[Work], Done], works: Sequence[Work]) -> Iterator[Done]:
        """Results of a task per shard as they come; see `workers.WorkerPool`.

        The calling task steps aside meanwhile, and its worker measures shards like the others.

        Args:
            do: the task.
            works: its arguments, one a task.
        """
        from distributed import as_completed, worker_client

        with worker_client() as client:
            # before any other session, or all of them would be begun at once
            futures = [client.submit(do, work, priority=10, pure=False) for work in works]
            for future in as_completed(futures, loop=client.loop):
                yield future.result()


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
        "distributed.scheduler.allowed-failures": _DEATHS,
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
