"""Run of a study, `liex cohort`: measure the pending sessions, write the study's table.

If sessions of one animal share size and shape, these are estimated first (`sharing`).

A lock in the study's cohort folder prevents a second run.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from liex_lab.errors import LiexError, StudyError
from liex_lab.plan.study import STUDY_FILE, PlannedSession, Study
from liex_lab.runtime import durable, text_files
from liex_lab.runtime.progress import Board, progress_board
from liex_lab.sessions import Session, corrections, verdict
from liex_lab.sessions.folder import FAILED_FILE, read_failure
from liex_lab.tables.schema import dictionary, table_columns, write_table

from ..compare import find_sessions
from ..compiling import compile_ahead
from ..correct import correct_session
from ..session import run_session
from .cluster import SlurmTable, crew_of, is_encrypted
from .crew import Crew
from .status import (
    SessionStatus,
    inspect_animal,
    pending_inspections,
    review_note,
    standings,
    write_inspection,
)


def list_sessions(place: str | Path) -> tuple[str, Callable[[], Sequence[verdict.Entry]]]:
    """The name of a study, and a function that lists its sessions from disk at each call.

    `place` is a study's .toml file, a folder with a study.toml, or a folder with sessions in it.

    Raises:
        StudyError: there is no such file or folder.
        SessionError: the folder contains no session.
    """
    path = Path(place)
    if path.is_file() or (path / STUDY_FILE).is_file():
        study = Study.load(path)
        return study.name, lambda: [_of_study(one) for one in standings(Study.load(study.path))]
    if not path.is_dir():
        raise StudyError(
            f"there is no study {path}; name a study's .toml file, or a folder with sessions in it"
        )
    find_sessions([path])  # raises an error if it has no sessions
    return path.resolve().name, lambda: _of_folder(path)


def _of_study(one: SessionStatus) -> verdict.Entry:
    session, failure = one.session, one.failure or {}
    subject = {name: getattr(session.animal, name) for name in verdict.SUBJECT[1:]}
    return verdict.Entry(
        session.id,
        one.state,
        one.reason or session.remark,
        str(failure.get("remedy", "")),
        session.folder if (session.folder / "session.json").is_file() else None,
        {"subject_id": session.animal.id, **subject},
    )


def _of_folder(path: Path) -> list[verdict.Entry]:
    """Every session in a folder, measured or failed.

    Keys are session names, or relative paths where names recur.
    """
    entries = [_measured(folder) for folder in find_sessions([path])]
    for file in sorted(path.rglob(FAILED_FILE)):
        failure = read_failure(file.parent) or {}
        reason, remedy = (str(failure.get(name, "")) for name in ("reason", "remedy"))
        name = file.parent.relative_to(path).as_posix()
        entries.append(verdict.Entry(name, "failed", reason, remedy))
    names = [entry.key for entry in entries]
    return [
        entry
        if names.count(entry.key) == 1 or entry.folder is None
        else replace(entry, key=entry.folder.relative_to(path.resolve()).as_posix())
        for entry in entries
    ]


def _measured(folder: Path) -> verdict.Entry:
    try:
        session = Session.open(folder)
        known = session.table("sessions").iloc[0].reindex([*verdict.SUBJECT]).to_dict()
        reason = review_note(verdict.verdict_in(session.metadata))
    except LiexError as error:
        return verdict.Entry(folder.name, "failed", str(error))
    subject = {
        str(name): value for name, value in known.items() if isinstance(value, str) and value
    }
    return verdict.Entry(session.name, "done", reason, folder=folder, subject=subject)


# The study's table: every session with its status, as CSV for spreadsheets and Parquet for
# programs.


TABLE = "study"
STUDY_SESSIONS = table_columns(TABLE)


def write_study_table(study: Study, standings: Sequence[SessionStatus]) -> Path:
    """Write study.parquet, study.csv and study_columns.json; returns the path of the CSV."""
    folder = study.cohort_folder
    durable.unlinked_below(study.results, folder).mkdir(parents=True, exist_ok=True)
    rows = study_rows(study, standings)
    names = [column.name for column in STUDY_SESSIONS]
    block = {name: [row[name] for row in rows] for name in names}
    with durable.replacing(folder / f"{TABLE}.parquet") as part:
        write_table(part, STUDY_SESSIONS, [block], {"study": study.name})
    table = pd.DataFrame(rows, columns=names, dtype=object).map(text_files.harmless)
    csv = table.to_csv(index=False, lineterminator="\n", na_rep="nan")
    durable.write_whole(folder / f"{TABLE}.csv", csv)
    entries = [entry for entry in dictionary(STUDY_SESSIONS) if entry["table"] == TABLE]
    text = json.dumps(entries, indent=1, ensure_ascii=False)
    durable.write_whole(folder / f"{TABLE}_columns.json", text + "\n")
    return folder / f"{TABLE}.csv"


def study_rows(study: Study, standings: Sequence[SessionStatus]) -> list[dict[str, Any]]:
    """One row per session with the columns of `STUDY_SESSIONS`; paths are relative to the study."""
    rows = []
    for one in standings:
        session, failure = one.session, one.failure or {}
        document = (
            text_files.loose_json(session.folder / "session.json") if one.state == "done" else {}
        )
        counted = document.get("frames")
        frames = counted if isinstance(counted, dict) else {}
        row = {
            "session_id": session.id,
            "subject_id": session.animal.id,
            **{name: getattr(session.animal, name) for name in ("group", "cage", "sex", "batch")},
            "state": one.state,
            "reason": one.reason,
            "shared": _shared(session),
            "remedy": str(failure.get("remedy", "")),
            "stage": str(failure.get("stage") or ""),
            "frame": _count(failure.get("frame"), -1),
            "n_frames": _count(frames.get("n_frames"), 0),
            "n_frames_observed": _count(frames.get("n_observed"), 0),
            "observed_s": _number(frames.get("observed_s")),
            "frames_per_s": _number(document.get("frames_per_s")),
            "peak_memory_mb": _number(document.get("peak_memory_mb")),
            "recording": _below(study, session.recording),
            "folder": _below(study, str(session.folder)),
        }
        rows.append(row)
    return rows


def _shared(session: PlannedSession) -> str:
    shared = session.plan.animal.shared
    if shared is None:
        return session.remark
    length = "" if shared.spine_mm is None else f"{shared.spine_mm:.1f} mm long, "
    shape = "the average shape" if shared.shape is None else "a shape of its own"
    return f"{length}{shape}, by {shared.by}"


def _below(study: Study, path: str) -> str:
    inside = Path(path).is_relative_to(study.folder)
    return Path(path).relative_to(study.folder).as_posix() if inside else path


def _count(value: Any, otherwise: int) -> int:
    return value if isinstance(value, int) else otherwise


def _number(value: Any) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def run_study(
    study: str | Path,
    *,
    workers: int = 0,
    scheduler: str | None = None,
    slurm: str | Path | None = None,
    retry: bool = False,
    again: bool = False,
    only: Sequence[str] = (),
    dry_run: bool = False,
    board: Callable[[int], AbstractContextManager[Board]] = progress_board,
) -> list[SessionStatus]:
    """Measure the pending sessions of a study; returns the status of every session.

    A session that fails leaves failed.json in its folder and does not stop the others. If the study
    has shared = "subject", the sessions of each animal are analysed first, and measured with the
    size and shape they agree on. The study's table is rewritten at the end.

    Args:
        study: the study file, or the folder that contains study.toml.
        workers: local processes; 0 uses one for every two cores.
        scheduler: address of a Dask scheduler whose workers are used instead.
        slurm: TOML file that configures Slurm workers; not together with `scheduler`.
        retry: repeat sessions that failed.
        again: repeat done and failed sessions; excluded ones stay excluded.
        only: ids of the sessions to measure; () measures all.
        dry_run: measure nothing; return the current status.
        board: creates the progress display for a number of jobs (a context manager).

    Returns:
        One `SessionStatus` per session, in the order of the study file.

    Raises:
        StudyError: the study file or its settings cannot be used, or another process is measuring
            the study.
    """
    planned = Study.load(study)
    if scheduler and slurm:
        raise StudyError(
            "the workers are found either with --scheduler or with --slurm; leave one of them out"
        )
    if scheduler:
        is_encrypted(scheduler)  # raises an error for an invalid address
    table = SlurmTable.load(slurm) if slurm else None
    ask = partial(standings, planned, retry=retry, only=only, again=again)
    before = ask()
    if dry_run:
        return before
    pending = pending_inspections(planned, only, retry, again)
    written = [
        *(one.session.folder for one in before),
        *(session.folder for session in pending),
    ]
    for place in (planned.cohort_folder, *written):
        durable.unlinked_below(planned.results, place)
    planned.cohort_folder.mkdir(parents=True, exist_ok=True)
    with durable.locked(
        planned.cohort_folder / ".lock",
        f"the study {planned.name} is being measured by another process",
    ):
        with _crew(before, pending, workers=workers, scheduler=scheduler, slurm=table) as crew:
            if pending and crew:
                _inspect(pending, crew, board)
                before = ask()
            for one in before:
                if one.described:
                    descriptions = [
                        corrections.Description(key, value) for key, value in one.described.items()
                    ]
                    correct_session(
                        one.session.folder, descriptions, author=f"study {planned.name}"
                    )
            if (todo := to_measure(before)) and crew:
                _measure(todo, crew, board)
        after = standings(planned)
        write_study_table(planned, after)
    return after


def to_measure(found: Sequence[SessionStatus]) -> list[SessionStatus]:
    """The sessions to measure; of those that are measured together, one.

    Args:
        found: the status of every session.
    """
    todo = [one for one in found if one.to_do and not one.described]
    return list({one.session.together[0].id: one for one in reversed(todo)}.values())[::-1]


@contextmanager
def _crew(
    found: Sequence[SessionStatus], pending: Sequence[PlannedSession], **where: Any
) -> Iterator[Crew | None]:
    """Workers for the pending sessions; None if there are none."""
    todo = [one.session for one in to_measure(found)]
    if not todo and not pending:
        yield None
        return

    if not where["scheduler"] and not where["slurm"]:  # once, instead of in every worker
        compile_ahead(*sorted({session.plan.animal.skeleton for session in [*todo, *pending]}))
    # inspecting one session may make others of its animal pending
    most = sum(one.state != "excluded" for one in found) if pending else len(todo)
    with crew_of(max(most, len(pending)), **where) as crew:
        yield crew


def _inspect(
    sessions: Sequence[PlannedSession],
    crew: Crew,
    board: Callable[[int], AbstractContextManager[Board]],
) -> None:
    """Inspect sessions, and store the findings."""
    known = {session.id: session for session in sessions}
    with board(len(sessions)) as shown:

        def finished(found: dict[str, Any]) -> None:
            write_inspection(known[found["session_id"]], found)
            failure = found.get("failure")
            done = failure or f"shows an animal of {found['animal']['spine_mm']:.1f} mm"
            _ended(shown, found["session_id"], "could not be inspected", done)

        crew.inspect(sessions, inspect_animal, shown.report, finished)


def _ended(shown: Board, id: str, failed: str, done: str | dict[str, Any]) -> None:
    """Show that the work on a session ended: a sentence, or the failure that ended it."""
    sentence = done if isinstance(done, str) else f"{failed}: {done['reason']}"
    shown.finish(id, sentence, failed=not isinstance(done, str))


def _measure(
    todo: list[SessionStatus],
    crew: Crew,
    board: Callable[[int], AbstractContextManager[Board]],
) -> None:
    with board(len(todo)) as shown:

        def finished(result: dict[str, Any]) -> None:
            """Report the `result` of a session to the board."""
            copy = result.get("corrections_taken_from")
            taken = f", with the corrections of {copy}" if copy else ""
            review = f"; {why}" if (why := result.get("review")) else ""
            done = f"is done, in {result['seconds']:.0f} s{taken}{review}"
            _ended(shown, result["id"], "failed", result["failure"] or done)

        crew.measure(todo, run_session, shown.report, finished)
