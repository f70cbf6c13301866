"""The job `liex cohort`: look where every session stands, measure what is to be done, write the
study's table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from liex_lab.errors import StudyError
from liex_lab.plan.study import Study
from liex_lab.runtime.progress import Board
from liex_lab.sessions.lock import locked

from .one_session import RunSession
from .slurm import SlurmTable
from .status import Standing, standings
from .table import write_study_table


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
) -> list[Standing]:
    """Measure what is to be done; returns where every session stands then. See
    `liex_lab.api.run_study`.
    """
    if scheduler and slurm:
        raise StudyError(
            "the workers are found either with --scheduler or with --slurm; leave one of them out"
        )
    table = SlurmTable.load(slurm) if slurm else None
    before = standings(study, retry=retry, only=only, again=again)
    if dry_run:
        return before
    study.cohort_folder.mkdir(parents=True, exist_ok=True)
    with locked(
        study.cohort_folder / ".lock",
        f"the study {study.name} is being measured by another process",
    ):
        todo = [one for one in before if one.to_do]
        if todo:
            _measure(todo, run, board, workers=workers, scheduler=scheduler, slurm=table)
        after = standings(study)
        write_study_table(study, after)
    return after


def _measure(
    todo: list[Standing],
    run: RunSession,
    board: Callable[[int], AbstractContextManager[Board]],
    **where: Any,
) -> None:
    from .dask_cluster import measure_cohort

    with board(len(todo)) as shown:

        def finished(result: dict[str, Any]) -> None:
            failure = result["failure"]
            sentence = (
                f"failed: {failure['reason']}"
                if failure
                else f"is done, in {result['seconds']:.0f} s"
            )
            shown.ended(result["id"], sentence, failed=failure is not None)

        measure_cohort(todo, run, told=shown.told, finished=finished, **where)
