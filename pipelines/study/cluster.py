"""The Dask cluster of a study: processes of this machine, a running scheduler, or Slurm jobs.

Only this module and `crew` import Dask.
"""

import logging
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from liex_lab.errors import StudyError, expecting, needing
from liex_lab.plan import plans_folder
from liex_lab.runtime import durable, text_files
from liex_lab.runtime.processes import n_cores, worker_environment

from .crew import DEATHS, Crew

_FORGOTTEN_S = 8.0  # a nanny whose process is gone for so long does not start another one by itself
WORKERS_EVERY_S = 5.0  # between two checks of this machine's workers
_NONE_LEFT_S = 60.0  # give up after all worker processes of a study are gone for so long


@contextmanager
def watched(client: Any, inspect: Callable[[], str], every_s: float) -> Iterator[None]:
    """A context in which a thread inspects the cluster periodically.

    Args:
        client: of the cluster; its pending futures are the remaining sessions.
        inspect: repairs what can be repaired; returns why the study has to end, or ''.
        every_s: time between two inspections, s.

    Raises:
        StudyError: this thread ended the study.
    """
    from distributed import Future

    over = threading.Event()
    reasons: list[str] = []

    def watch() -> None:
        while not over.wait(every_s):
            if reason := inspect():
                reasons.append(reason)
                client.cancel([Future(key, client) for key in client.futures])
                return

    thread = threading.Thread(target=watch, name="cluster watch", daemon=True)
    thread.start()
    try:
        yield
    except StudyError:
        if reasons:
            raise StudyError(reasons[0]) from None
        raise
    finally:
        over.set()
        thread.join()


class KeptWorkers:
    """Worker processes of this machine, those of a `distributed.LocalCluster`.

    Dask's nanny restarts a worker that died, unless it died while starting.
    """

    def __init__(self, cluster: Any) -> None:
        self._cluster = cluster
        self._gone_since: dict[Any, float] = {}  # by nanny

    def inspect(self) -> str:
        """Restart workers that their nannies do not; '' unless none is left for a minute."""
        nannies = list(self._cluster.workers.values())
        now = time.monotonic()
        gone = [nanny for nanny in nannies if not _is_alive(nanny)]
        self._gone_since = {nanny: self._gone_since.get(nanny, now) for nanny in gone}
        waited = {nanny: now - since for nanny, since in self._gone_since.items()}
        for nanny, seconds in waited.items():
            if seconds >= _FORGOTTEN_S and not nanny.status.name.startswith("clos"):
                self._cluster.loop.add_callback(nanny.instantiate)
        if len(gone) < len(nannies) or min(waited.values(), default=_NONE_LEFT_S) < _NONE_LEFT_S:
            return ""
        return (
            "the study's worker processes have ended and could not be started again; see "
            "whether the machine has memory left, or use fewer workers; the sessions that were "
            "measured are kept, and the same command goes on with the rest"
        )


def _is_alive(nanny: Any) -> bool:
    """Whether the process of a Dask nanny is running."""
    import psutil

    try:
        return bool(nanny.pid) and psutil.Process(nanny.pid).status() != psutil.STATUS_ZOMBIE
    except psutil.Error:
        return False


# Settings for workers on Slurm: a small TOML file; `pipelines/plans/slurm.toml` is a template.


# one line of a job script each: a value must not start another line
Line = Annotated[str, Field(pattern=r"^[^\r\n\x00]*$", max_length=1000)]
Word = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.:/@+-]+$", max_length=200)]


class SlurmTable(BaseModel):
    """Every setting of the file, as explained in slurm.toml.

    Attributes:
        jobs: maximum number of jobs; each measures one session after the other.
        cores_per_job: cores of a job.
        memory: memory of a job, in Slurm's notation.
        walltime: time after which Slurm ends a job, HH:MM:SS.
        partition: the partition, optional.
        account: the account, optional.
        interface: network interface between the jobs and the command.
        shared_folder: folder that all nodes can access, for the keys of this run.
        local_folder: folder on the nodes for temporary files.
        log_folder: folder for the jobs' own logs.
        prologue: lines of the job script before the worker starts.
        directives: further #SBATCH lines.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    jobs: int = Field(8, ge=1, le=10_000)
    cores_per_job: int = Field(2, ge=1, le=256)
    memory: Word = "4GB"
    walltime: Word = "12:00:00"
    partition: Word | None = None
    account: Word | None = None
    interface: Word | None = None
    shared_folder: Line = "~/.liex_lab"
    local_folder: Line | None = None
    log_folder: Line | None = None
    prologue: list[Line] = []
    directives: list[Line] = []

    @staticmethod
    def load(path: str | Path) -> "SlurmTable":
        """Read the settings from a TOML file; `slurm` is the bundled one.

        Raises:
            StudyError: there is no such file, or a setting is not valid.
        """
        file = plans_folder() / "slurm.toml" if str(path) == "slurm" else Path(path)
        if not file.is_file():
            raise StudyError(
                f"there is no file {file}; copy {plans_folder() / 'slurm.toml'} and change the copy"
            )
        with expecting(
            StudyError,
            f"{file} should be a TOML file like the bundled slurm.toml",
            ValueError,
            advice="correct it",
        ):
            return SlurmTable.model_validate(text_files.read_toml(file))


# Jobs of a Slurm cluster, requested again if one ends before the study does.


# between two checks: longer than the 15 s after which Dask forgets a lost worker, so that a new job
# never has the name of one that is still being forgotten
EVERY_S = 20.0
# limit, per requested job, of jobs that end before their worker has connected
MOST_IN_VAIN = 3


def queued() -> set[str] | None:
    """Numbers of this account's waiting or running jobs; None if Slurm does not answer."""
    try:
        listed = subprocess.run(  # nosec B607: Slurm is on the cluster's PATH
            ["squeue", "--me", "--noheader", "--format=%A"],
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return set(listed.stdout.split())


class KeptJobs:
    """As many jobs of a `dask_jobqueue.SLURMCluster` as sessions are left, up to a number."""

    def __init__(self, client: Any, cluster: Any, n_jobs: int, log_folder: str | None) -> None:
        """Keep up to `n_jobs` jobs, whose logs are in `log_folder`."""
        self._client, self._cluster, self._n_jobs = client, cluster, n_jobs
        self._logs = log_folder or "the folder where the command was started"
        self._missing: set[str] = set()  # jobs that were not queued at the last check
        self._in_vain = 0

    def inspect(self) -> str:
        """Forget jobs that ended without connecting, and request others if needed."""
        cluster = self._cluster
        there = queued()
        if there is None:
            return ""
        if cluster.scheduler_info["workers"]:
            self._in_vain = 0
        numbers = {name: str(job.job_id) for name, job in dict(cluster.workers).items()}
        gone = {name for name, number in numbers.items() if number not in there}
        # Dask forgets a job whose worker was connected before the next check
        silent = gone & self._missing
        self._missing = gone - silent
        self._in_vain += len(silent)
        for name in silent:
            cluster.loop.add_callback(cluster.workers.pop, name, None)
        if self._in_vain > MOST_IN_VAIN * self._n_jobs:
            return (
                f"{self._in_vain} jobs of Slurm ended before they measured anything; their logs "
                f"are in {self._logs}; the sessions that were measured are kept, and the same "
                "command goes on with the rest"
            )
        left = sum(state.status == "pending" for state in dict(self._client.futures).values())
        if len(numbers) - len(silent) < min(self._n_jobs, left):
            cluster.scale(self._n_jobs)
        return ""


_ENCRYPTED, _OPEN = ("tls", "wss"), ("tcp", "ws", "ucx")  # protocols of a scheduler's address


def is_encrypted(scheduler: str) -> bool:
    """Whether traffic to a scheduler's address, as in tcp://10.0.0.1:8786, is encrypted.

    Raises:
        StudyError: it is not the address of a scheduler.
    """
    kind, found, place = scheduler.rpartition("://")  # tcp if not stated
    if not place or (found and kind not in _ENCRYPTED + _OPEN):
        raise StudyError(
            f"{scheduler!r} is no address of a Dask scheduler; expected one as in "
            "tcp://10.0.0.1:8786 or tls://10.0.0.1:8786, which `dask scheduler` prints"
        )
    return kind in _ENCRYPTED


@contextmanager
def crew_of(
    n_tasks: int,
    *,
    workers: int = 0,
    threads: int = 0,
    scheduler: str | None = None,
    slurm: SlurmTable | None = None,
) -> Iterator[Crew]:
    """A context with workers for the sessions of a study.

    Args:
        n_tasks: the largest number of sessions to process at once.
        workers: processes on this machine; 0 means one for every two cores.
        threads: cores of each; 0 means an equal share.
        scheduler: address of a running Dask scheduler.
        slurm: how to request workers from a Slurm cluster.

    Raises:
        StudyError: no scheduler answers, or it ends before the study does.
        MissingPackageError: workers on Slurm need dask-jobqueue, which is not installed.
    """
    import dask
    from distributed import Client

    # lost sessions are reported by `Crew`
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    # one session at a worker at a time: Dask would also blame sessions that wait there for its
    # death
    settings = {
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.logging.distributed": "critical",
        "distributed.worker.memory.terminate": False,
        # a machine that is busy or asleep is not dead
        "distributed.scheduler.worker-ttl": "3600s",
        "distributed.comm.timeouts.connect": "120s",
        # plain HTTP, which would expose ids and paths to every account of the machine
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
    }
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(settings))
        if scheduler is not None:
            try:
                client = Client(scheduler, timeout="20s", set_as_default=False)
                yield Crew(stack.enter_context(client))
            except (OSError, ValueError, TypeError) as error:
                raise StudyError(
                    f"no Dask scheduler answers at {scheduler} ({error}); start one with `dask "
                    "scheduler`, or leave --scheduler out"
                ) from None
            return
        scratch = str(stack.enter_context(closing(durable.Scratch())).folder)
        stack.enter_context(dask.config.set({"temporary-directory": scratch}))
        cluster = (
            slurm_cluster(slurm, scratch)
            if slurm
            else local_cluster(n_tasks, workers, threads, scratch)
        )
        stack.enter_context(cluster)
        client = stack.enter_context(Client(cluster, set_as_default=False))
        if slurm:
            n_jobs = min(slurm.jobs, n_tasks)  # a job is one worker
            cluster.scale(n_jobs)
            jobs = KeptJobs(client, cluster, n_jobs, slurm.log_folder)
            stack.enter_context(watched(client, jobs.inspect, EVERY_S))
        else:
            stack.enter_context(watched(client, KeptWorkers(cluster).inspect, WORKERS_EVERY_S))
        try:
            yield Crew(client, slurm.jobs if slurm else 0)
        except BaseException:
            # a request to end would wait for a kernel; sessions resume from their checkpoints
            for nanny in () if slurm else cluster.workers.values():
                nanny.close_gracefully()  # otherwise it starts another one
                if nanny.pid:
                    with suppress(ProcessLookupError):
                        os.kill(nanny.pid, signal.SIGKILL)
            raise


def local_cluster(n_tasks: int, workers: int, threads: int, scratch: str) -> Any:
    """Worker processes on this machine, reachable only from it, with keys for this run.

    Args:
        n_tasks: sessions to measure, and the maximum number of workers.
        workers: processes; 0 means one for every two cores.
        threads: cores of each; 0 means an equal share.
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
            "dashboard_address": "127.0.0.1:0",  # any port: another study may use the default one
        },
        memory_limit=0,
        local_directory=scratch,
        silence_logs=50,
        security=Security.temporary(),
        env=worker_environment(threads or max(1, cores // count)),
    )


def slurm_cluster(table: SlurmTable, scratch: str) -> Any:
    """A cluster whose workers are Slurm jobs; the scheduler is this process.

    Args:
        table: how to request jobs.
        scratch: folder for temporary files if the table names none.

    Raises:
        MissingPackageError: dask-jobqueue is not installed.
    """
    with needing("slurm", "measuring by workers on Slurm"):
        from dask_jobqueue import SLURMCluster
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
    """The options of one job: a worker that measures a session at a time on all its cores."""
    threads = worker_environment(table.cores_per_job)
    exports = [f"export {name}={value}" for name, value in threads.items()]
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
        "job_script_prologue": [
            *table.prologue,
            *exports,
        ],
        "job_extra_directives": list(table.directives),
        "local_directory": table.local_folder or scratch,
        "log_directory": table.log_folder,
        "worker_extra_args": ["--no-dashboard"],
    }
