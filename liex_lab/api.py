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
from liex_lab.runtime.progress import Board, Progress, progress_board, silent

if TYPE_CHECKING:
    from liex_lab.pipelines.arenas import run_arenas
    from liex_lab.pipelines.compare import compare_groups
    from liex_lab.pipelines.correct import correct_session, describe_session
    from liex_lab.pipelines.drawing import draw_figures, export_video
    from liex_lab.pipelines.evaluation.actions import evaluate_actions
    from liex_lab.pipelines.evaluation.paper.run import run_tables
    from liex_lab.pipelines.evaluation.scale import run_scale, write_long
    from liex_lab.pipelines.evaluation.scenes import evaluate_scenes
    from liex_lab.pipelines.evaluation.several import evaluate_several
    from liex_lab.pipelines.evaluation.tracking import evaluate_tracking
    from liex_lab.pipelines.live import follow_live
    from liex_lab.pipelines.points import import_animals, import_points
    from liex_lab.pipelines.session import run_demo, run_session
    from liex_lab.pipelines.study.status import SessionStatus
    from liex_lab.pipelines.sync import sync_session
    from liex_lab.pipelines.triggers import Triggers
    from liex_lab.pipelines.verify import verify_session

_JOBS = {  # function: the module of `pipelines` that defines it
    "run_session": "session",
    "run_arenas": "arenas",
    "compare_groups": "compare",
    "correct_session": "correct",
    "describe_session": "correct",
    "draw_figures": "drawing",
    "export_video": "drawing",
    "follow_live": "live",
    "Triggers": "triggers",
    "import_animals": "points",
    "import_points": "points",
    "run_demo": "session",
    "sync_session": "sync",
    "verify_session": "verify",
    "write_long": "evaluation.scale",
    "run_scale": "evaluation.scale",
    "evaluate_tracking": "evaluation.tracking",
    "evaluate_scenes": "evaluation.scenes",
    "evaluate_several": "evaluation.several",
    "evaluate_actions": "evaluation.actions",
    "evaluate_tracks": "evaluation.actions",
    "run_tables": "evaluation.paper.run",
    # used by the command line only
    "evaluate_pose": "evaluation.pose",
    "evaluate_builds": "evaluation.pose",
    "evaluate_foreign": "evaluation.foreign",
    "evaluate_sizes": "evaluation.pose",
    "evaluate_reference": "evaluation.pose",
    "evaluate_speed": "evaluation.speed",
    "evaluate_recordings": "evaluation.speed",
    "evaluate_live": "evaluation.live",
    "evaluate_report": "evaluation.scale",
    "evaluate_statistics": "evaluation.statistics",
    "evaluate_sync": "evaluation.sync",
    "evaluate_cameras": "evaluation.cameras",
    "evaluate_motion": "evaluation.motion",
    "motion_in_short": "evaluation.motion",
    "evaluate_nyu": "evaluation.nyu",
    "hands_in_short": "evaluation.nyu",
    "search_noise": "evaluation.tracking",
    "train_actions": "training.action_model",
    "train_model": "training.pose_model",
    "train_shape": "training.shape_model",
    "train_tracking": "training.motion_model",
    "convert": "convert",
    "pack": "convert",
    "record": "record",
    "examine": "doctor",
    "print_report": "doctor",
    "whole_images": "drawing",
    "begin_study": "study.init",
    "read_any_labels": "training.action_model",
    "suggest": "training.action_model",
}

__all__ = [  # noqa: RUF022 - in the order of the manual
    "run_session",
    "run_arenas",
    "correct_session",
    "describe_session",
    "sync_session",
    "follow_live",
    "Triggers",
    "import_points",
    "import_animals",
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
    "evaluate_several",
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
    from liex_lab.plan.study import Study

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
    echo: Callable[[str], None] = print,
    progress: Progress = silent,
) -> None:
    """Serve a study, or a folder that contains sessions, to browsers until interrupted.

    Access requires a token, new for each start, which is part of the address. Replays can be opened
    only if the server listens on this machine alone.

    Args:
        study: a study file, its folder, or a folder that contains sessions.
        host: the network address to listen on; the default is this machine alone.
        port: the port to listen on.
        echo: called with the dashboard's address once it is served.
        progress: receives progress while sessions are loaded.

    Raises:
        MissingPackageError: the extra `dashboard` is not installed.
        StudyError: there is no such study.
    """
    import secrets
    from functools import partial

    from liex_lab.pipelines.study.run import list_sessions

    try:
        from liex_lab.dashboards.app.server import LOOPBACK, address, make_app, serve
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"the dashboard needs {error.name}; {how_to_install('dashboard')}"
        ) from None
    from liex_lab.dashboards.app.data import StudyData
    from liex_lab.dashboards.report.report import write_views
    from liex_lab.pipelines.bench import Bench
    from liex_lab.pipelines.correct import correct_session
    from liex_lab.pipelines.region_config import StatedRegions
    from liex_lab.pipelines.training.action_model import suggest
    from liex_lab.sessions.review import FOLDER as REVIEWS
    from liex_lab.sessions.viewer import show_replay

    place = Path(study) if Path(study).is_dir() else Path(study).parent
    data = StudyData(*list_sessions(study))
    data.warm(progress)
    alone = host in LOOPBACK
    token = secrets.token_urlsafe(24)
    app = make_app(
        data,
        token=token,
        alone=alone,
        show_replay=show_replay if alone else None,
        correct=partial(correct_session, report=False),
        report=write_views,
        suggest=suggest,
        reviews=place / REVIEWS,
        regions=StatedRegions(study),
        measuring=Bench(place.resolve()) if alone else None,
    )
    serve(app, host, port, lambda found: echo(address(host, found, token)))
