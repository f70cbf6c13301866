"""Public Python interface: the CLI commands as Python functions.

`run_session` is `liex run`, `run_demo` is `liex demo`, and so on. Jobs are imported on first use.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import MissingPackageError, how_to_install
from liex_lab.plan.study import Study
from liex_lab.runtime.progress import Board, Progress, progress_board, silent

if TYPE_CHECKING:
    from liex_lab.pipelines.arenas import run_arenas
    from liex_lab.pipelines.compare import compare_groups
    from liex_lab.pipelines.correct import correct_session, describe_session
    from liex_lab.pipelines.drawing import draw_figures, export_video
    from liex_lab.pipelines.live import follow_live
    from liex_lab.pipelines.session import run_demo, run_session
    from liex_lab.pipelines.study.status import SessionStatus
    from liex_lab.pipelines.verify import verify_session
    from liex_lab.sessions.corrections import Correction

_JOBS = {  # function: the module of `pipelines` that defines it
    "run_session": "session",
    "run_arenas": "arenas",
    "compare_groups": "compare",
    "correct_session": "correct",
    "describe_session": "correct",
    "draw_figures": "drawing",
    "export_video": "drawing",
    "follow_live": "live",
    "run_demo": "session",
    "verify_session": "verify",
}

__all__ = [  # noqa: RUF022 - in the order of the manual
    "run_session",
    "run_arenas",
    "correct_session",
    "describe_session",
    "follow_live",
    "run_demo",
    "draw_figures",
    "compare_groups",
    "export_video",
    "run_study",
    "serve_dashboard",
    "verify_session",
    "write_long",
    "run_scale",
    "evaluate_tracking",
    "evaluate_scenes",
    "evaluate_actions",
    "run_tables",
]


def __getattr__(name: str) -> Any:
    if name not in _JOBS:
        raise AttributeError(f"module 'liex_lab.api' has no attribute '{name}'")
    return getattr(import_module(f"liex_lab.pipelines.{_JOBS[name]}"), name)


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
    from liex_lab.pipelines.correct import correct_session
    from liex_lab.pipelines.session import run_session
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
        describe=correct_session,
    )


def serve_dashboard(
    study: str | Path,
    *,
    host: str = "127.0.0.1",
    port: int = 8050,
    told: Callable[[str], None] = print,
    progress: Progress = silent,
) -> None:
    """Serve a study, or a folder that contains sessions, to browsers until interrupted.

    Access requires a token, new for each start, which is part of the address. Replays can be opened
    only if the server listens on this machine alone.

    Args:
        study: a study file, its folder, or a folder that contains sessions.
        host: the network address to listen on; the default is this machine alone.
        port: the port to listen on.
        told: called with the dashboard's address once it is served.
        progress: receives progress while sessions are loaded.

    Raises:
        MissingPackageError: the extra `dashboard` is not installed.
        StudyError: there is no such study.
    """
    import secrets

    from liex_lab.pipelines.study.run import list_sessions

    try:
        from liex_lab.dashboards.app.server import LOOPBACK, address, make_app, serve
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"the dashboard needs {error.name}; {how_to_install('dashboard')}"
        ) from None
    from liex_lab.dashboards.app.data import StudyData
    from liex_lab.dashboards.report.report import write_views
    from liex_lab.pipelines.correct import correct_session
    from liex_lab.pipelines.region_config import StatedRegions
    from liex_lab.pipelines.training.action_model import suggest
    from liex_lab.sessions.review import FOLDER as REVIEWS
    from liex_lab.sessions.viewer import show_replay

    place = Path(study) if Path(study).is_dir() else Path(study).parent
    name, look = list_sessions(study)
    data = StudyData(name, look)
    data.warm(progress)
    alone = host in LOOPBACK
    token = secrets.token_urlsafe(24)

    def correct(folder: Path, what: Sequence[Correction], undo: Sequence[int], author: str) -> None:
        """Correct a session on behalf of the dashboard.

        Args:
            folder: the session folder.
            what: corrections to add.
            undo: numbers of corrections to undo.
            author: author of the corrections.
        """
        correct_session(folder, what, undo=undo, author=author, report=False)

    app = make_app(
        data,
        token=token,
        alone=alone,
        show_replay=show_replay if alone else None,
        correct=correct,
        report=write_views,
        suggest=suggest,
        reviews=place / REVIEWS,
        regions=StatedRegions(study),
    )
    serve(app, host, port, lambda found: told(address(host, found, token)))


def write_long(minutes: float, out: str | Path) -> dict[str, Any]:
    """Write a session of a virtual mouse of any length; returns its cost in memory and time.

    The frames of one short recording are repeated forwards and backwards, so that only costs that
    grow with the length of a recording are measured.

    Args:
        minutes: length of the recording, min, at 30 frames per second.
        out: parent of the session folder long.liex.

    Returns:
        `peak_memory_mb` (None if the system does not report it) and `seconds`.
    """
    from liex_lab.dashboards.report.report import write_report
    from liex_lab.pipelines.evaluation.scale import write_long as job

    return job(minutes, out, write_report)


def run_scale(
    n_frames: int = 3000, minutes: Sequence[float] = (1.0, 10.0), *, progress: Progress = silent
) -> dict[str, Any]:
    """Measure the cost of a study: sessions per hour, memory, and time by step.

    Sessions per hour are given by number of workers (one and two measured, more simulated), memory
    by length of recording.

    Args:
        n_frames: length of each virtual recording, frames of 640 x 480 px.
        minutes: lengths of the recordings whose memory is measured, min.
        progress: receives progress reports.

    Returns:
        Numbers, with their definitions and assumptions as text.
    """
    from liex_lab.pipelines.evaluation.scale import evaluate_scale
    from liex_lab.pipelines.session import run_session

    return evaluate_scale(run_session, n_frames, tuple(minutes), progress)


def evaluate_tracking(
    animal: str = "mouse",
    sequence: str = "hard",
    *,
    model: str | Path | None = None,
    paper: bool = False,
    n_frames: int | None = None,
    figure: Path | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Compare single frames, Lie-X Algorithm 3 and the default tracker on a test sequence.

    Args:
        animal: name of the skeleton: fish, mouse or hand.
        sequence: name of the fixed virtual test sequence.
        model: a pose model by name or path; None uses the animal's bundled one.
        paper: also compare Algorithms 1 and 3 with the parts of the paper's variant.
        n_frames: number of frames of the sequence; None uses all.
        figure: PNG file for the joint error over time; None draws none.
        progress: receives progress reports.

    Returns:
        Results of each row, speed, and the protocol as text.
    """
    from functools import partial

    from liex_lab.dashboards.paper.figures import draw_tracking
    from liex_lab.pipelines.evaluation.tracking import evaluate_tracking as measure

    draw = None if figure is None else partial(draw_tracking, path=figure)
    return measure(
        animal,
        sequence,
        model=model,
        paper=paper,
        n_frames=n_frames,
        draw=draw,
        progress=progress,
    )


def evaluate_scenes(
    only: Sequence[str] = (),
    *,
    n_frames: int = 300,
    n_recordings: int = 1,
    sealed: bool = False,
    pictures: Path | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Measure rendered scenes that mimic lab recordings, and score the tables.

    Args:
        only: names of scenes; () uses all.
        n_frames: length of each recording.
        n_recordings: recordings of each scene, each of another animal.
        sealed: use the held-out seeds, which are not for development.
        pictures: folder for drawn frames, one PNG per scene; None draws none.
        progress: receives progress reports.

    Returns:
        `rows` of results by name, and the protocol as text.

    Raises:
        LiexError: there is no such scene.
    """
    from functools import partial

    from liex_lab.dashboards.paper.figures import draw_scene
    from liex_lab.pipelines.evaluation.scenes import evaluate_scenes as measure

    draw = None if pictures is None else partial(draw_scene, folder=pictures)
    return measure(
        only,
        n_frames=n_frames,
        n_recordings=n_recordings,
        sealed=sealed,
        draw=draw,
        progress=progress,
    )


def evaluate_actions(
    animal: str = "fish",
    *,
    model: str | Path | None = None,
    pose_model: str | Path | None = None,
    minutes: float = 30.0,
    figure: Path | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Score action recognition on cut sequences and on uncut virtual recordings.

    Args:
        animal: an animal with simulated actions: fish or mouse.
        model: an action model by name or path; None uses the bundled one or, if there is none,
            trains one.
        pose_model: the pose model for the frames; None uses the animal's own.
        minutes: length of the uncut test recordings, min.
        figure: PNG file for the confusion matrices; None draws none.
        progress: receives progress reports.

    Returns:
        Accuracy on sequences, F1 of the timeline, both by frame rate, and the protocol as text.

    Raises:
        LiexError: there are no simulated actions for this animal.
    """
    from functools import partial

    from liex_lab.dashboards.paper.figures import draw_confusions
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
    rows: Sequence[str] = (),
    sealed: bool = False,
    without: Sequence[str] = (),
    nyu: Path | None = None,
    progress: Progress = silent,
) -> list[Path]:
    """Make every table and figure of the Lie-X paper on one page; returns the files written.

    Args:
        out: the output folder for tables and figures.
        animals: names of animals; () uses those with a bundled model.
        n_frames: number of frames of each split; every row is then measured and none is stored.
            None uses all frames.
        quick: a run of a few minutes that only tests the code; its numbers are meaningless.
        fresh: ignore stored rows; every variant is trained again, which takes long.
        rows: rows to train and measure again, or `fig7`, the curves of Fig. 7; the others are
            stored ones. () measures none.
        sealed: measure the held-out split, which is evaluated once per release.
        without: `tracking` or `actions`, parts of the page to skip.
        nyu: folder of the NYU hand data, counted for Table 2; None leaves it out.
        progress: receives progress reports.
    """
    from liex_lab.catalog import bundled_models
    from liex_lab.dashboards.paper.page import write_paper
    from liex_lab.pipelines.evaluation.paper.run import measure_paper

    results, further, kept = measure_paper(
        out,
        animals or list(bundled_models()),
        n_frames=n_frames,
        quick=quick,
        fresh=fresh,
        rows=rows,
        sealed=sealed,
        without=without,
        nyu=nyu,
        progress=progress,
    )
    return [*kept, *write_paper(Path(out), results, further, quick)]
