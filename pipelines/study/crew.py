"""The workers of a study: they inspect and measure sessions, each as one task.

A task may run twice (a worker dies, and another takes over): it stores its results on disk, resumes
where it stopped, and a second run gives the same result. Sessions are measured in parallel, each by
one worker; if fewer sessions than workers are left, the workers share the shards of each. A session
during which more than three workers died is quarantined.
"""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from liex_lab.errors import RecordingError, StudyError
from liex_lab.plan.study import PlannedSession
from liex_lab.runtime import processes, text_files
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import corrections, folder

from ..arenas import run_arenas
from .status import (
    INSPECTING,
    MeasuringStage,
    SessionStatus,
    about,
    input_stamp,
    review_note,
)

# measures a recording into a session folder, which it returns: `liex_lab.api.run_session`
RunSession = Callable[..., Path]


def measure_one(
    session: PlannedSession,
    run: RunSession,
    progress: Progress = silent,
    run_id: str = "",
    pool: processes.WorkerPool | None = None,
) -> dict[str, Any]:
    """Measure a session with those of its arena, or quarantine them, and report the result.

    It may safely run twice: an interrupted session resumes, and an existing one is replaced once
    the new one is complete.

    Args:
        session: recording, plan and folder.
        run: measures the recording.
        progress: called frame by frame.
        run_id: of the study's run; a session that ended in this run is not measured again.
        pool: workers for the session's shards.

    Returns:
        `id`, `state` (`done` or `failed`), `seconds`, `failure` (None if done); of a session that
        was measured also `corrections_taken_from` (the outdated session whose manual corrections
        were copied; "" for none), and `review` (why it needs review; "" for nothing).
    """
    if run_id and (ended := _ended(session, run_id)):
        return ended
    began = time.perf_counter()
    stage = MeasuringStage(progress)
    try:
        if not session.recording_exists:
            raise RecordingError(
                f"there is no recording {session.recording}; correct its path, or copy it there"
            )

        notes = {
            "input": {"stamp": input_stamp(session.recording)},
            "run_id": run_id,
            **({"problems": [session.remark]} if session.remark else {}),
        }
        common: dict[str, Any] = {
            "overwrite": True,
            "notes": notes,
            "pool": pool,
            "progress": stage,
        }
        if session.arena:
            named = [(one.folder, one.plan.session) for one in session.arena]
            run_arenas(session.recording, session.plan, animals=named, **common)
        else:
            run(session.recording, session.plan, folder=session.folder, **common)
    except Exception as error:
        failure = folder.describe_failure(error, stage.name, stage.frame) | {"run_id": run_id}
        return quarantine(session, failure) | {"seconds": round(time.perf_counter() - began, 3)}
    reviews = [review_note(corrections.read_verdict(one.folder)) for one in session.together]
    return {
        **_result(session, "done"),
        "seconds": round(time.perf_counter() - began, 3),
        "corrections_taken_from": folder.taken_from(session.folder),
        "review": "; ".join(dict.fromkeys(filter(None, reviews))),
    }


def _result(
    session: PlannedSession, state: str, failure: dict[str, Any] | None = None
) -> dict[str, Any]:
    return {"id": session.id, "state": state, "seconds": 0.0, "failure": failure}


def _ended(session: PlannedSession, run_id: str) -> dict[str, Any] | None:
    """The session's result if it ended in this run already, before its worker could report it."""
    failure = folder.read_failure(session.folder)
    if failure and failure.get("run_id") == run_id:
        return _result(session, "failed", failure)
    same = text_files.loose_json(session.folder / "session.json").get("run_id") == run_id
    return _result(session, "done") if same else None


def quarantine(session: PlannedSession, failure: dict[str, Any]) -> dict[str, Any]:
    """Write failed.json into the folders of the sessions that are measured with it, and set older
    results aside.

    The file contains plan and input, to detect changes. Returns the session's result.
    """
    for one in session.together:
        known = {
            "session_id": one.id,
            **failure,
            "plan": one.plan.model_dump(exclude_none=True),
            "input": {"stamp": input_stamp(one.recording)},
        }
        folder.set_outdated(one.folder)
        folder.write_failure(one.folder, known)
    return _result(session, "failed", failure)


TOPIC = "liex-progress"
DEATHS = 3  # deaths of workers that are tolerated before a session is blamed

# session, pieces done, pieces in total, current step
Report = Callable[[str, int, int | None, str], None]
Finished = Callable[[dict[str, Any]], None]  # the result of `measure_one`


class Crew:
    """The workers of a study.

    Attributes:
        client: of their cluster.
    """

    def __init__(self, client: Any, n_jobs: int = 0) -> None:
        """`n_jobs` workers are yet to connect; 0 if all are connected."""
        self.client, self._n_jobs = client, n_jobs
        self._report: Report = lambda *_: None
        client.subscribe_topic(TOPIC, lambda event: self._report(*event[1]))

    def measure(
        self,
        todo: Sequence[SessionStatus],
        run: RunSession,
        report: Report = lambda *_: None,
        finished: Finished = lambda _: None,
    ) -> list[dict[str, Any]]:
        """Measure sessions; returns a result per session, see `measure_one`.

        Args:
            todo: the sessions.
            run: measures a recording, `liex_lab.api.run_session`.
            report: called with id, pieces done, pieces in total, and the current step.
            finished: called with each result as it arrives.
        """
        shared = n_shared(len(todo), self._n_jobs or len(self.client.nthreads()))
        task = partial(measure_one, run=run, run_id=f"{os.getpid()}-{time.monotonic_ns()}")
        planned = [one.session for one in todo]
        return self._each(planned, task, "measuring", quarantine, report, finished, shared)

    def inspect(
        self,
        sessions: Sequence[PlannedSession],
        inspect: Callable[[PlannedSession, Progress], dict[str, Any]],
        report: Report = lambda *_: None,
        finished: Finished = lambda _: None,
    ) -> list[dict[str, Any]]:
        """Inspect sessions; returns the findings on each animal, see `status.inspect_animal`.

        Args:
            sessions: the sessions.
            inspect: inspects one session, `status.inspect_animal`.
            report: called with id, pieces done, pieces in total, and the current step.
            finished: called with each result as it arrives.
        """
        return self._each(
            sessions,
            inspect,
            INSPECTING,
            lambda session, failure: about(session) | {"failure": failure},
            report,
            finished,
        )

    def _each(
        self,
        planned: Sequence[PlannedSession],
        task: Callable[..., dict[str, Any]],
        stage: str,
        died: Callable[[PlannedSession, dict[str, Any]], dict[str, Any]],
        report: Report,
        finished: Finished,
        shared: int = 0,
    ) -> list[dict[str, Any]]:
        """Result of the task for each session, or of `died` if its workers ended in this stage."""
        from distributed import CancelledError, as_completed

        self._report = report
        alone = len(planned) - shared
        sessions = {f"{one.id}-{os.getpid()}-{time.monotonic_ns()}": one for one in planned}
        submitted = [
            self.client.submit(_on_worker, task, session, k >= alone, key=key, pure=False)
            for k, (key, session) in enumerate(sessions.items())
        ]
        completed = as_completed(submitted, loop=self.client.loop)
        del submitted
        results = []
        for future in completed:
            session = sessions[future.key]
            try:  # waits until a result lost with its worker is computed again
                error = future.exception()
                result = (
                    future.result() if error is None else died(session, _why_died(error, stage))
                )
            except CancelledError:  # by the client, as nothing here cancels a session
                raise StudyError(
                    "the Dask scheduler ended before the study did; the sessions that were "
                    "measured are kept, and the same command goes on with the rest once a "
                    "scheduler answers"
                ) from None
            future.release()  # otherwise it would be computed again if the worker died
            finished(result)
            results.append(result)
        return results


def n_shared(n: int, n_workers: int) -> int:
    """How many of n sessions, the last ones, are cut into shards for all workers to measure.

    These would leave workers idle if each were measured by one. Sharding has a cost: the workers'
    outputs are copied into one.
    """
    return n % max(n_workers, 1)


def _why_died(error: BaseException, stage: str) -> dict[str, Any]:
    failure = folder.describe_failure(error, stage, None)
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
    task: Callable[..., dict[str, Any]], session: PlannedSession, shared: bool
) -> dict[str, Any]:
    """The task: measure one session and report to the client; `shared` uses all workers."""
    return task(session, progress=_reporter(session), **({"pool": Workers()} if shared else {}))


def _reporter(session: PlannedSession) -> Progress:
    """A progress callback that reports to the client of the study, at most twice a second."""
    from distributed import get_worker

    worker = get_worker()
    last = 0.0

    def send(done: int, total: int | None, what: str) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last > 0.5:
            last = now
            worker.log_event(TOPIC, [session.id, done, total, what])

    return send


class Workers:
    """All workers of the current task's cluster, as a pool for the shards of its session.

    Attributes:
        fewest: 0, so any session of more than two shards is shared, as workers would otherwise be
            idle.
        here: False, as they may be on other machines, without this one's temporary files.
    """

    fewest = 0
    here = False

    def each(
        self, do: Callable[[processes.Work], processes.Done], works: Sequence[processes.Work]
    ) -> Iterator[processes.Done]:
        """Results of a task per shard, as they arrive; see `workers.WorkerPool`.

        The calling task yields its worker meanwhile, which measures shards like the others.
        """
        from distributed import as_completed, worker_client

        with worker_client() as client:
            # priority over other sessions, otherwise all of them would be started at once
            futures = [client.submit(do, work, priority=10, pure=False) for work in works]
            for future in as_completed(futures, loop=client.loop):
                yield future.result()
