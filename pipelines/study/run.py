"""Run of a study, `liex cohort`: measure the sessions that are to be done, write its table.

A lock in the study's cohort folder keeps a second run out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol

from liex_lab.errors import StudyError
from liex_lab.plan.study import Study
from liex_lab.runtime.lock import locked
from liex_lab.runtime.places import unlinked_below
from liex_lab.runtime.progress import Board
from liex_lab.sessions.corrections import Description

from ..compiling import compile_ahead
from ..correct import correct_session
from .one_session import RunSession
from .slurm import SlurmTable
from .status import SessionStatus, standings
from .table import write_study_table


class DescribeSession(Protocol):
    """What writes descriptions into a session: `liex_lab.api.correct_session`."""

    def __call__(self, session: str | Path, what: Sequence[Description], *, author: str) -> Path:
        """Write them; returns the session folder.

        Args:
            session: the session folder.
            what: the descriptions.
            author: whose they are.
        """


def run_study(
    study: Study,
    run: RunSession,
    *,
    workers: int,
    scheduler: str | None,
    slurm: str | Path | None,
    retry: bool,
    again: bool,
    only: Sequence[str],
    dry_run: bool,
    board: Callable[[int], AbstractContextManager[Board]],
    describe: DescribeSession = correct_session,
) -> list[SessionStatus]:
    """Measure the sessions of a study that are to be done; returns every session's status.

    Args:
        study: the study.
        run: measures a recording, `liex_lab.api.run_session`.
        workers: processes on this machine; 0 takes one for every two cores.
        scheduler: address of a running Dask scheduler; None starts workers.
        slurm: TOML file that says how to ask Slurm for workers; None does not.
        retry: measure failed sessions again.
        again: measure all sessions again.
        only: ids of sessions, the others are left out; () takes all.
        dry_run: only look.
        board: opens the display of so many sessions' progress.
        describe: writes descriptions into a session, `liex_lab.api.correct_session`.

    Raises:
        StudyError: both scheduler and slurm are given, or no scheduler answers at that address.
        SessionError: another process measures the study.
        LiexError: an id in `only` is none of the study's.
    """
    if scheduler and slurm:
        raise StudyError(
            "the workers are found either with --scheduler or with --slurm; leave one of them out"
        )
    if scheduler:
        from .dask_cluster import is_encrypted

        is_encrypted(scheduler)  # an address that is none ends here
    table = SlurmTable.load(slurm) if slurm else None
    before = standings(study, retry=retry, only=only, again=again)
    if dry_run:
        return before
    for place in (study.cohort_folder, *(one.session.folder for one in before)):
        unlinked_below(study.results, place)
    study.cohort_folder.mkdir(parents=True, exist_ok=True)
    with locked(
        study.cohort_folder / ".lock",
        f"the study {study.name} is being measured by another process",
    ):
        for one in before:
            if one.described:
                said = [Description(key, value) for key, value in one.described.items()]
                describe(one.session.folder, said, author=f"study {study.name}")
        todo = [one for one in before if one.to_do and not one.described]
        if todo:
            _measure(todo, run, board, workers=workers, scheduler=scheduler, slurm=table)
        after = standings(study)
        write_study_table(study, after)
    return after


def _measure(
    todo: list[SessionStatus],
    run: RunSession,
    board: Callable[[int], AbstractContextManager[Board]],
    **where: Any,
) -> None:
    from .dask_cluster import measure_cohort

    with board(len(todo)) as shown:

        def finished(result: dict[str, Any]) -> None:
            """Tell the board how a session went: its `result`."""
            failure = result["failure"]
            copy = result.get("corrections_taken_from")
            taken = f", with the corrections of {copy}" if copy else ""
            look = f"; {why}" if (why := result.get("look_at_it")) else ""
            sentence = (
                f"failed: {failure['reason']}"
                if failure
                else f"is done, in {result['seconds']:.0f} s{taken}{look}"
            )
            shown.ended(result["id"], sentence, failed=failure is not None)

        if not where["scheduler"] and not where["slurm"]:  # once, and not in every worker
            for animal in sorted({one.session.plan.animal.skeleton for one in todo}):
                compile_ahead(animal)
        measure_cohort(todo, run, told=shown.told, finished=finished, **where)
