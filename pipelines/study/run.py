"""Run of a study, `liex cohort`: measure the pending sessions, write the study's table.

If sessions of one animal share size and shape, these are estimated first (`sharing`).

A lock in the study's cohort folder prevents a second run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from liex_lab.errors import StudyError
from liex_lab.plan.study import PlannedSession, Study
from liex_lab.runtime.durable import locked
from liex_lab.runtime.places import unlinked_below
from liex_lab.runtime.progress import Board
from liex_lab.sessions.corrections import Description

from ..compiling import compile_ahead
from .cluster import SlurmTable, crew_of, is_encrypted
from .crew import Crew, RunSession
from .listing import write_study_table
from .sharing import LookAtSession, look_at, to_be_looked_at, write_look
from .status import SessionStatus, standings

# writes descriptions into a session, with their author: `liex_lab.api.correct_session`
DescribeSession = Callable[..., Path]


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
    describe: DescribeSession,
    look: LookAtSession = look_at,
) -> list[SessionStatus]:
    """Measure the pending sessions of a study; returns every session's status.

    Args:
        study: the study.
        run: measures a recording, `liex_lab.api.run_session`.
        workers: processes on this machine; 0 means one for every two cores.
        scheduler: address of a running Dask scheduler; None starts workers.
        slurm: TOML file with the settings of Slurm jobs; None does not use Slurm.
        retry: measure failed sessions again.
        again: measure all sessions again.
        only: ids of sessions, the others are left out; () means all.
        dry_run: only return the status.
        board: opens the display of so many sessions' progress.
        describe: writes descriptions into a session, `liex_lab.api.correct_session`.
        look: inspects a session's animal.

    Raises:
        StudyError: both scheduler and slurm are given, or no scheduler answers at that address.
        SessionError: another process measures the study.
        LiexError: an id in `only` is not in the study.
    """
    if scheduler and slurm:
        raise StudyError(
            "the workers are found either with --scheduler or with --slurm; leave one of them out"
        )
    if scheduler:
        is_encrypted(scheduler)  # raises an error for an invalid address
    table = SlurmTable.load(slurm) if slurm else None
    ask = partial(standings, study, retry=retry, only=only, again=again)
    before = ask()
    if dry_run:
        return before
    unseen = to_be_looked_at(study, only, retry, again)
    written = [*(one.session.folder for one in before), *(session.folder for session in unseen)]
    for place in (study.cohort_folder, *written):
        unlinked_below(study.results, place)
    study.cohort_folder.mkdir(parents=True, exist_ok=True)
    with locked(
        study.cohort_folder / ".lock",
        f"the study {study.name} is being measured by another process",
    ):
        with _crew(before, unseen, workers=workers, scheduler=scheduler, slurm=table) as crew:
            if unseen and crew:
                _look(unseen, look, crew, board)
                before = ask()
            for one in before:
                if one.described:
                    said = [Description(key, value) for key, value in one.described.items()]
                    describe(one.session.folder, said, author=f"study {study.name}")
            if (todo := _to_measure(before)) and crew:
                _measure(todo, run, crew, board)
        after = standings(study)
        write_study_table(study, after)
    return after


def _to_measure(found: Sequence[SessionStatus]) -> list[SessionStatus]:
    return [one for one in found if one.to_do and not one.described]


@contextmanager
def _crew(
    found: Sequence[SessionStatus], unseen: Sequence[PlannedSession], **where: Any
) -> Iterator[Crew | None]:
    """Workers for the pending sessions; None if there are none."""
    todo = [one.session for one in _to_measure(found)]
    if not todo and not unseen:
        yield None
        return

    if not where["scheduler"] and not where["slurm"]:  # once, instead of in every worker
        for animal in sorted({session.plan.animal.skeleton for session in [*todo, *unseen]}):
            compile_ahead(animal)
    # inspecting one session may make others of its animal pending
    most = sum(one.state != "excluded" for one in found) if unseen else len(todo)
    with crew_of(max(most, len(unseen)), **where) as crew:
        yield crew


def _look(
    sessions: Sequence[PlannedSession],
    look: LookAtSession,
    crew: Crew,
    board: Callable[[int], AbstractContextManager[Board]],
) -> None:
    """Inspect sessions, and store the findings."""
    known = {session.id: session for session in sessions}
    with board(len(sessions)) as shown:

        def finished(found: dict[str, Any]) -> None:
            """Store the findings on a session, and report them to the board."""
            id = found["session_id"]
            write_look(known[id], found)
            failure = found.get("failure")
            sentence = (
                f"could not be looked at: {failure['reason']}"
                if failure
                else f"shows an animal of {found['animal']['spine_mm']:.1f} mm"
            )
            shown.ended(id, sentence, failed=failure is not None)

        crew.look_at(sessions, look, shown.told, finished)


def _measure(
    todo: list[SessionStatus],
    run: RunSession,
    crew: Crew,
    board: Callable[[int], AbstractContextManager[Board]],
) -> None:
    with board(len(todo)) as shown:

        def finished(result: dict[str, Any]) -> None:
            """Report the `result` of a session to the board."""
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

        crew.measure(todo, run, shown.told, finished)
