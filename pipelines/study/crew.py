"""The workers of a study: sessions are looked at and measured by them, each as one task.

A task may run twice (a worker dies, and another takes over): it leaves its results on disk, goes on
where it was, and done twice it does the same. Sessions are measured side by side, each by one
worker; where fewer are left than there are workers, these share the shards of each. A session that
more than three workers died of is quarantined.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from liex_lab.errors import StudyError
from liex_lab.plan.study import PlannedSession
from liex_lab.runtime.progress import Progress
from liex_lab.sessions.folder import describe_failure

from ..workers import Done, Work
from .one_session import RunSession, measure_one, quarantine
from .sharing import LOOKING, LookAtSession, about
from .status import SessionStatus

if TYPE_CHECKING:
    from distributed import Client

TOPIC = "liex-progress"
DEATHS = 3  # of workers, before a session is held to be what kills them
_TOLD_EVERY_S = 0.5

Told = Callable[
    [str, int, int | None, str], None
]  # session, pieces done, pieces in all, what is being done
Finished = Callable[[dict[str, Any]], None]  # what `measure_one` returns


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
            "reason": f"the worker process died {DEATHS + 1} times while it measured this session",
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
    """All workers of the cluster that a task runs on, as a pool for the shards of its session.

    Attributes:
        fewest: any session of more than two shards is shared, as workers would be idle else.
        here: they may be on other machines, without this one's temporary files.
    """

    fewest = 0
    here = False

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
