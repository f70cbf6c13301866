"""Jobs of a Slurm cluster, asked for anew where one has ended before the study has.

Slurm ends a job at its time limit, with its node, or because somebody says so. Dask forgets the
worker and asks for no other: the last job's end would leave the command waiting for ever. So the
queue is looked at while sessions are left.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from .cluster_watch import Watch

if TYPE_CHECKING:
    from distributed import Client

# between two looks: longer than the 15 s after which Dask forgets a worker that is gone, so that a
# new job never bears the name of one that is still being forgotten
EVERY_S = 20.0
# jobs that end before their worker has answered, for each that was asked for: something is wrong
MOST_IN_VAIN = 3


def queued() -> set[str] | None:
    """Numbers of this account's jobs that wait or run; None where Slurm does not say."""
    try:
        told = subprocess.run(  # nosec B607: Slurm is where the cluster put it
            ["squeue", "--me", "--noheader", "--format=%A"],
            capture_output=True,
            text=True,
            timeout=60,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return set(told.stdout.split())


class KeptJobs(Watch):
    """Within the block, as many jobs as sessions are left, but not more than were asked for."""

    def __init__(
        self,
        client: Client,
        cluster: Any,
        n_jobs: int,
        log_folder: str | None,
        ask: Callable[[], set[str] | None] = queued,
    ) -> None:
        """Look at the jobs of a cluster.

        Args:
            client: of the cluster; its pending futures are the sessions that are left.
            cluster: a `dask_jobqueue.SLURMCluster`.
            n_jobs: how many jobs it was asked for.
            log_folder: where the jobs' logs are, if a folder was named.
            ask: what tells the jobs that wait or run.
        """
        super().__init__(client, EVERY_S)
        self._cluster, self._n_jobs = cluster, n_jobs
        self._logs = log_folder or "the folder where the command was started"
        self._ask = ask
        self._missing: set[str] = set()  # jobs that were in no queue at the last look
        self._in_vain = 0

    def look(self) -> None:
        """Forget jobs that have ended without a word, and ask for others where some are wanted."""
        cluster = self._cluster
        there = self._ask()
        if there is None:
            return
        if cluster.scheduler_info["workers"]:
            self._in_vain = 0
        numbers = {name: str(job.job_id) for name, job in dict(cluster.workers).items()}
        gone = {name for name, number in numbers.items() if number not in there}
        # one whose worker was connected is forgotten by Dask between two looks
        silent = gone & self._missing
        self._missing = gone - silent
        self._in_vain += len(silent)
        for name in silent:
            cluster.loop.add_callback(cluster.workers.pop, name, None)
        if self._in_vain > MOST_IN_VAIN * self._n_jobs:
            self.gave_up = (
                f"{self._in_vain} jobs of Slurm ended before they measured anything; their logs "
                f"are in {self._logs}; the sessions that were measured are kept, and the same "
                "command goes on with the rest"
            )
            return
        left = sum(state.status == "pending" for state in dict(self._client.futures).values())
        if len(numbers) - len(silent) < min(self._n_jobs, left):
            cluster.scale(self._n_jobs)
