"""Where jobs and views meet: what `liex run` and `liex demo` do, for Python as for the command
line.

`pipelines` and `dashboards` do not know each other; this module hands the views to the job that
writes a session.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import MissingPackageError
from liex_lab.plan import Plan
from liex_lab.plan.study import Study
from liex_lab.runtime.progress import Board, Progress, progress_board, silent, telling_of_compiling

if TYPE_CHECKING:
    from liex_lab.pipelines.study.status import Standing
    from liex_lab.pipelines.verify import Finding
    from liex_lab.pipelines.workers import Crew
    from liex_lab.recordings.recording import Recording
    from liex_lab.sessions.corrections import Correction

DEMO = "mouse_walk.mcap"


def run_session(
    recording: str | Path | Recording,
    plan: Plan | None = None,
    out: str | Path = ".",
    *,
    folder: Path | None = None,
    overwrite: bool = False,
    notes: Mapping[str, Any] | None = None,
    workers: int = 1,
    crew: Crew | None = None,
    progress: Progress = silent,
) -> Path:
    """Measure every frame of a recording and write the session folder `out/<recording's
    name>.liex`; returns it.

    recording: a path, or a recording that is open already; plan: None takes the mouse's; folder:
    the session folder itself, where it should have another name; notes: what session.json is to
    hold besides; workers: processes that look at stretches of a long recording side by side, or a
    crew of others; the tables are the same. Raises a LiexError that says what to do, and leaves
    nothing half-written, where the recording, the plan or the animal in it cannot be used.
    """
    from liex_lab.dashboards.replay.rerun_blueprint import replay_blueprint
    from liex_lab.dashboards.report.views import write_views
    from liex_lab.pipelines.session import measure_session
    from liex_lab.pipelines.workers import Processes

    plan = plan or Plan.load("mouse")
    if workers > 1 and crew is None:
        crew = Processes(workers)
    with telling_of_compiling(progress) as progress:
        return measure_session(
            recording,
            plan,
            out,
            folder=folder,
            overwrite=overwrite,
            notes=notes,
            blueprint=replay_blueprint,
            report=write_views,
            crew=crew,
            progress=progress,
        )


def correct_session(
    session: str | Path,
    what: Sequence[Correction] = (),
    *,
    undo: Sequence[int] = (),
    author: str = "",
    progress: Progress = silent,
) -> Path:
    """Add corrections to a session, or take some back by their numbers; tables and report follow.

    what: made by the functions of `liex_lab.sessions.correcting`; with neither `what` nor `undo`,
    everything is made again. author: "" takes who is logged in. What was measured stays as it is;
    see `liex_lab.sessions.corrections`.
    """
    from liex_lab.dashboards.replay.rerun_blueprint import replay_blueprint
    from liex_lab.dashboards.report.views import write_views
    from liex_lab.pipelines.correct import correct_session as job

    return job(
        session,
        what,
        undo=undo,
        author=author,
        blueprint=replay_blueprint,
        report=write_views,
        progress=progress,
    )


def follow_live(
    source: str,
    plan: Plan,
    *,
    replay: bool = False,
    to: str = "viewer",
    patience_s: float = 3.0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Skeletons of a recording that goes on, in a Rerun viewer; returns counts and measured
    latencies.
    """
    from liex_lab.pipelines.live import follow_live as job
    from liex_lab.pipelines.live import open_live
    from liex_lab.sessions.live import LiveView

    arriving = open_live(source, plan, replay=replay, patience_s=patience_s)
    numbers, _ = job(
        arriving,
        plan,
        progress=progress,
        viewer=lambda tracker, arriving: LiveView(
            arriving.name,
            arriving.camera,
            tracker.subject.T_arena_camera,
            tracker.subject.skeleton,
            to,
        ),
    )
    return numbers


def run_demo(out: str | Path = ".", *, progress: Progress = silent) -> Path:
    """The bundled sample recording as a session; an earlier session of the demo is replaced."""
    from liex_lab.catalog import find_sample

    return run_session(
        find_sample(DEMO), Plan.load("mouse"), out, overwrite=True, progress=progress
    )


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
) -> list[Standing]:
    """Measure what is to be done of a study; returns where every session stands then.

    workers: processes on this machine, 0 one for every two cores; scheduler: the address of a Dask
    scheduler; slurm: a file that says how to ask Slurm; retry: try failed sessions again; again:
    all sessions; only: ids of sessions; dry_run: only look. A session that fails leaves failed.json
    and stops no other.
    """
    from liex_lab.pipelines.study.run import run_study as job

    return job(
        Study.load(study),
        run_session,
        workers=workers,
        scheduler=scheduler,
        slurm=slurm,
        retry=retry,
        again=again,
        only=only,
        dry_run=dry_run,
        board=board,
    )


def serve_dashboard(
    study: str | Path,
    *,
    host: str = "127.0.0.1",
    port: int = 8050,
    told: Callable[[str], None] = print,
    progress: Progress = silent,
) -> None:
    """Serve a study, or a folder with sessions in it, to browsers until interrupted; `told` hears
    the address.

    On a host other than this machine alone, every visitor has to know a token, which is part of the
    address. Raises MissingPackageError where the extra `dashboard` is not installed.
    """
    import secrets

    from liex_lab.pipelines.study.listing import list_sessions

    try:
        from liex_lab.dashboards.app.server import LOOPBACK, address, make_app, serve
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"the dashboard needs {error.name}, which is not installed; pip install "
            "'liex_lab[dashboard]'"
        ) from None
    from liex_lab.dashboards.app.data import StudyData
    from liex_lab.sessions.viewer import show_replay

    name, look = list_sessions(study)
    data = StudyData(name, look)
    data.warm(progress)
    alone = host in LOOPBACK
    token = "" if alone else secrets.token_urlsafe(24)

    def correct(folder: Path, what: Sequence[Correction], undo: Sequence[int], author: str) -> None:
        correct_session(folder, what, undo=undo, author=author)

    app = make_app(data, token=token, show_replay=show_replay if alone else None, correct=correct)
    serve(app, host, port, lambda found: told(address(host, found, token)))


def verify_session(
    session: str | Path, recording: str | Path | None = None, *, progress: Progress = silent
) -> list[Finding]:
    """Whether a session is what it was when it was written; with its recording, whether that gives
    the same again.
    """
    from liex_lab.pipelines.verify import verify_session as job

    return job(session, run_session, None if recording is None else str(recording), progress)


def write_long(minutes: float, out: str | Path) -> dict[str, Any]:
    """A session of so many minutes of a virtual mouse, made of few pictures over and over; what it
    cost in memory.
    """
    from liex_lab.dashboards.report.report import write_report
    from liex_lab.pipelines.evaluation.long_sessions import write_long as job

    return job(minutes, out, write_report)


def run_scale(
    n_frames: int = 3000, minutes: Sequence[float] = (1.0, 10.0), *, progress: Progress = silent
) -> dict[str, Any]:
    """What a study costs: sessions per hour by workers, memory by length of recording, and where
    the time goes.
    """
    from liex_lab.pipelines.evaluation.scale import evaluate_scale

    return evaluate_scale(run_session, n_frames, tuple(minutes), progress)


def evaluate_tracking(
    animal: str = "mouse",
    sequence: str = "hard",
    *,
    model: str | Path | None = None,
    n_frames: int | None = None,
    figure: Path | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Single frames, Algorithm 3 and the default tracker on a test sequence; figure: a PNG of error
    over time.
    """
    from functools import partial

    from liex_lab.dashboards.paper.tracking import draw_tracking
    from liex_lab.pipelines.evaluation.tracking import evaluate_tracking as measure

    draw = None if figure is None else partial(draw_tracking, path=figure)
    return measure(animal, sequence, model=model, n_frames=n_frames, draw=draw, progress=progress)


def evaluate_actions(
    animal: str = "fish",
    *,
    model: str | Path | None = None,
    pose_model: str | Path | None = None,
    minutes: float = 30.0,
    figure: Path | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Actions named on cut-out sequences and on uncut recordings; figure: a PNG of the confusion
    matrices.
    """
    from functools import partial

    from liex_lab.dashboards.paper.confusion import draw_confusions
    from liex_lab.pipelines.evaluation.actions import evaluate_actions as measure

    draw = None if figure is None else partial(draw_confusions, path=figure)
    return measure(
        animal, model=model, pose_model=pose_model, minutes=minutes, draw=draw, progress=progress
    )


def run_tables(
    out: str | Path,
    animals: Sequence[str] = (),
    *,
    n_frames: int | None = None,
    quick: bool = False,
    fresh: bool = False,
    progress: Progress = silent,
) -> list[Path]:
    """Every row of the paper's Tables 1-3 and its figures, written into `out`; returns what was
    written.

    animals: () takes those with a bundled model. n_frames: only so many of each split. quick: a few
    minutes' run whose numbers say only that everything runs. fresh: nothing kept is used, which
    takes hours.
    """
    from liex_lab.catalog import bundled_models
    from liex_lab.dashboards.paper.plates import draw_figures
    from liex_lab.pipelines.evaluation.paper.run import make_tables

    return make_tables(
        out,
        animals or list(bundled_models()),
        n_frames=n_frames,
        quick=quick,
        fresh=fresh,
        draw=draw_figures,
        progress=progress,
    )
