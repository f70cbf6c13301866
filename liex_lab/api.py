"""Public Python interface: the CLI commands as Python functions.

`run_session` is `liex run`, `run_demo` is `liex demo`, and so on. The packages `pipelines` (jobs)
and `dashboards` (views) do not import each other; this module passes the views (the layout of the
Rerun replay and the HTML report) to the job that writes a session. Jobs are imported on first use.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from liex_lab.errors import MissingPackageError, how_to_install
from liex_lab.plan import Plan
from liex_lab.plan.study import Study
from liex_lab.runtime.memory import check_limits
from liex_lab.runtime.progress import Board, Progress, progress_board, silent, telling_of_compiling
from liex_lab.runtime.threads import imported_ahead

if TYPE_CHECKING:
    from liex_lab.pipelines.arenas import ArenaOutcome
    from liex_lab.pipelines.study.status import SessionStatus
    from liex_lab.pipelines.verify import Finding
    from liex_lab.pipelines.workers import WorkerPool
    from liex_lab.recordings.recording import Recording
    from liex_lab.sessions.corrections import Correction

DEMO = "mouse_walk.mcap"
# modules that take seconds to import and are needed only after the first frames: for the replay,
# the table `transitions` and the figures
_HEAVY = (
    "pandas",
    "rerun",
    "scipy.special",
    "matplotlib.figure",
    "matplotlib.backends.backend_pdf",
)


def run_session(
    recording: str | Path | Recording,
    plan: Plan | None = None,
    out: str | Path = ".",
    *,
    settings: Sequence[str] = (),
    folder: Path | None = None,
    overwrite: bool = False,
    notes: Mapping[str, Any] | None = None,
    workers: int = 1,
    pool: WorkerPool | None = None,
    progress: Progress = silent,
) -> Path:
    """Measure every frame of a depth recording and write a session folder; returns its path.

    The steps are background subtraction, single-frame pose estimation by the Lie-X method,
    association and smoothing over the whole recording, kinematics and ethogram. If the recording,
    the plan or the animal cannot be used, no partial output remains.

    Args:
        recording: path of a recording, address of a virtual one, or an open recording.
        plan: all settings of the run; None selects the bundled plan that fits, the mouse's if it
            does.
        out: parent of the session folder `<recording's name>.liex`.
        settings: overrides when no plan is given, texts like 'animal.spine_mm=65'.
        folder: the session folder, to use another name.
        overwrite: replace an existing session.
        notes: additional facts for session.json, see `SessionWriter.note`.
        workers: processes for parallel shards of a long recording; 0 uses one for every two cores,
            four at most, for more than 6,000 frames. The tables are the same for any number.
            Scripts that use more than one must guard their entry point with `if __name__ ==
            "__main__":`, as processes are spawned.
        pool: a worker pool to use instead of `workers` local processes.
        progress: receives progress reports.

    Returns:
        The session folder.

    Raises:
        LiexError: the recording, the plan or the animal in it cannot be used; the message gives
            advice.
    """
    from liex_lab.pipelines.session import measure_session
    from liex_lab.pipelines.workers import processes_for

    check_limits()
    with imported_ahead(*_HEAVY), telling_of_compiling(progress) as progress:
        return measure_session(
            recording,
            plan,
            out,
            settings=settings,
            folder=folder,
            overwrite=overwrite,
            notes=notes,
            blueprint=_layout,
            report=_views,
            pool=pool or processes_for(workers),
            progress=progress,
        )


def run_arenas(
    recording: str | Path | Recording,
    plan: Plan | None = None,
    out: str | Path = ".",
    *,
    settings: Sequence[str] = (),
    overwrite: bool = False,
    notes: Mapping[str, Any] | None = None,
    workers: int = 1,
    pool: WorkerPool | None = None,
    progress: Progress = silent,
) -> list[ArenaOutcome]:
    """Measure several arenas in one image, each as a separate session, in one pass.

    Args:
        recording: path of a recording, address of a virtual one, or an open recording.
        plan: lists `[[arenas]]`, or has `arenas = "auto"`; None selects the bundled plan that fits
            each arena, with the arenas in `settings`.
        out: parent of the session folders `<recording's name>-<arena>.liex`.
        settings: overrides when no plan is given.
        overwrite: replace existing sessions.
        notes: additional facts for every session.json.
        workers: processes for parallel shards of a long recording, one arena at a time; 0 or 1
            measures all arenas in one pass.
        pool: a worker pool to use instead.
        progress: receives progress reports.

    Returns:
        For each arena its session folder, or the reason why it could not be measured.

    Raises:
        LiexError: the recording or the plan cannot be used, or arenas overlap.
    """
    from liex_lab.pipelines.arenas import measure_arenas
    from liex_lab.pipelines.workers import processes_for

    with imported_ahead(*_HEAVY), telling_of_compiling(progress) as progress:
        return measure_arenas(
            recording,
            plan,
            out,
            settings=settings,
            overwrite=overwrite,
            notes=notes,
            blueprint=_layout,
            report=_views,
            pool=pool or processes_for(workers or 1),
            progress=progress,
        )


def correct_session(
    session: str | Path,
    what: Sequence[Correction] = (),
    *,
    undo: Sequence[int] = (),
    author: str = "",
    report: bool = True,
    progress: Progress = silent,
) -> Path:
    """Add corrections to a session, or undo some by number; updates tables and report.

    The measured data are unchanged; see `liex_lab.sessions.corrections`. Without `what` and `undo`,
    everything derived from the corrections is regenerated.

    Args:
        session: the session folder.
        what: corrections made by the functions of `liex_lab.sessions.correcting`.
        undo: numbers of corrections to undo.
        author: author of the corrections; "" uses the current account.
        report: whether to regenerate report and figures; for a series of corrections, the last call
            is enough.
        progress: receives progress reports.

    Returns:
        The session folder.

    Raises:
        SessionError: a correction cannot be applied, or another program is correcting the session.
    """
    from liex_lab.pipelines.correct import correct_session as job

    return job(
        session,
        what,
        undo=undo,
        author=author,
        blueprint=_layout,
        report=_views if report else None,
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
    """Show the skeletons of an ongoing recording in a Rerun viewer; returns measured latencies.

    Args:
        source: a file or folder that is being written, HOST:PORT of a sender, or, with `replay`, a
            recording.
        plan: all settings of the run.
        replay: play back a finished recording at its own pace, as if it were live.
        to: 'viewer' starts a viewer on this machine; else a viewer's address, or an .rrd file.
        patience_s: time without growth after which a file counts as finished, s.
        progress: receives the number of processed frames.

    Returns:
        Numbers: name, n_frames, n_live (frames whose latency was measured), latency_median_ms and
            latency_p95_ms (None if absent), n_measured, n_bridged.

    Raises:
        LiexError: the source ends before its first frame, cannot be read, or there is no screen for
            a viewer.
    """
    from liex_lab.dashboards.replay.layouts import live_blueprint
    from liex_lab.pipelines.live import follow_live as job
    from liex_lab.pipelines.live import open_live
    from liex_lab.sessions.viewer import LiveView, need_screen

    if to == "viewer":  # fail early, before a wait of minutes
        need_screen("write a file with --to NAME.rrd, which any viewer opens")
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
            live_blueprint(tracker.subject.length_mm / 1000.0),
        ),
    )
    return numbers


def run_demo(out: str | Path = ".", *, progress: Progress = silent) -> Path:
    """Measure the bundled sample recording; returns its session folder.

    An earlier demo session in the same folder is replaced.

    Args:
        out: parent of the session folder.
        progress: receives progress reports.
    """
    from liex_lab.catalog import find_sample

    return run_session(
        find_sample(DEMO), Plan.load("mouse"), out, overwrite=True, progress=progress
    )


def draw_figures(
    place: str | Path,
    *,
    only: Sequence[str] = (),
    formats: Sequence[str] = ("svg", "pdf"),
    out: str | Path | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Draw the figures of a session, a study or a comparison as files.

    Figures are one or two journal columns wide, texts are editable, and the same tables give the
    same bytes.

    Args:
        place: a session folder; a study file, its folder, or a folder that contains sessions; or
            the folder of a comparison.
        only: names of figures, such as 'occupancy', or measures of a comparison; () draws all.
        formats: some of svg, pdf and png; 'pages' is a single file figures.pdf with all figures.
        out: the output folder; None uses `figures` next to the data.
        progress: receives the name of each figure.

    Returns:
        `files`: the paths; `empty`: names of figures without data; `folder`.

    Raises:
        SessionError: there is no such figure or format, or no data to draw.
        StudyError: there is no such session, study or comparison.
    """
    from liex_lab.dashboards.figures import sets
    from liex_lab.errors import SessionError
    from liex_lab.pipelines.study.run import list_sessions
    from liex_lab.sessions import Session

    path = Path(place)
    folder = path if path.is_dir() else path.parent
    sets.check_kinds(formats)
    if (path / "session.json").is_file():
        sets.check_names(only, list(sets.OF_SESSION))
        drawn = sets.session_figures(Session.open(path), only)
    elif (path / sets.COMPARISON_FILE).is_file():
        table, stats, sessions = sets.read_comparison(path)
        measures = [str(name) for name in dict.fromkeys(stats["measure"])]
        sets.check_names(only, ["effects", *measures, *sets.OF_STUDY])
        drawn = sets.comparison_figures(table, stats, sessions, only)
        sets.remove_others(path / sets.FOLDER, measures)
    else:
        sets.check_names(only, list(sets.OF_STUDY))
        _, look = list_sessions(path)
        folders = [entry.folder for entry in look() if entry.folder is not None]
        if not folders:
            raise SessionError(
                f"no session of {path} has been measured; `liex cohort` measures them"
            )
        drawn = sets.study_figures([Session.open(one) for one in folders], only)
    target = folder / sets.FOLDER if out is None else Path(out)
    files, empty = sets.write_figures(drawn, target, formats, progress)
    if not files:
        raise SessionError(
            f"{path} holds nothing to draw of {', '.join(empty)}: no pose was found, or too few "
            "actions; its report says why"
        )
    return {"files": files, "empty": empty, "folder": target}


def compare_groups(
    places: Sequence[str | Path],
    out: str | Path,
    measures: Sequence[str] = (),
    *,
    reference: str | None = None,
    animals: str | Path | None = None,
    engine: str = "auto",
    only_trusted: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Compare groups of sessions; writes tables, a methods text, and figures.

    Args:
        places: study files, session folders, or folders that contain sessions at any depth.
        out: output folder; created if needed.
        measures: columns of the summary; () uses the default ones and every action's share.
        reference: compare with this group only; None compares all pairs.
        animals: a CSV with `subject_id` and any of group, cage, sex, batch; it overrides the
            sessions' own facts.
        engine: `auto`, `permutation` or `mixed`.
        only_trusted: exclude sessions that need review.
        progress: receives progress by session and figure.

    Returns:
        `stats`: the table's rows; `folder`: the output folder; `figures`: their paths; `sessions`:
            a sentence that accounts for every session; `check`: warnings.

    Raises:
        SessionError: there are no two groups, or a folder, column, engine or CSV cannot be used.
    """
    from liex_lab.pipelines.compare import compare_sessions

    found = compare_sessions(
        places,
        out,
        measures,
        reference=reference,
        animals=animals,
        engine=engine,
        only_trusted=only_trusted,
        progress=progress,
    )
    return {**found, "figures": draw_figures(found["folder"], progress=progress)["files"]}


def export_video(
    places: str | Path | Sequence[str | Path],
    out: str | Path | None = None,
    *,
    actions: Sequence[str] = (),
    groups: Sequence[str] = (),
    start_s: float | None = None,
    stop_s: float | None = None,
    slower: float = 1.0,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Path:
    """Write a video (H.264): height above the floor, skeleton, trail, action and time.

    One session is shown from beginning to end, on its own clock; several are shown side by side, by
    group. With `actions`, the video contains clips of these bouts, aligned at the onsets; a
    session's report links to the videos in its folder.

    Args:
        places: a session folder, several, or folders that contain sessions at any depth.
        out: the output folder; None uses the session's own, or the current folder for several.
        actions: actions, or prefixes of them: rear includes rear_supported and rear_unsupported.
        groups: only sessions of these groups; () includes all.
        start_s: start of a stretch of one session, s.
        stop_s: end of that stretch, s.
        slower: slow-motion factor.
        overwrite: replace an existing file.
        progress: receives progress reports.

    Returns:
        Path of the video.

    Raises:
        SessionError: a session has no depth, no bout has such a name, this PyAV has no encoder, or
            the file exists.
    """
    from liex_lab.dashboards.report.report import write_report
    from liex_lab.dashboards.video.video import write_clips, write_session
    from liex_lab.errors import SessionError
    from liex_lab.pipelines.compare import find_sessions
    from liex_lab.sessions import Session
    from liex_lab.sessions.session import stretch, video_path

    given = [places] if isinstance(places, str | Path) else list(places)
    opened = [Session.open(folder) for folder in find_sessions(given)]
    named = [(session, str(session.table("sessions")["group"].iloc[0] or "")) for session in opened]
    chosen = [pair for pair in named if not groups or pair[1] in groups]
    if not chosen:
        there = ", ".join(sorted({group for _, group in named} - {""})) or "none"
        raise SessionError(f"no session is of {' or '.join(groups)}; their groups are {there}")
    part = start_s is not None or stop_s is not None
    if part and (len(chosen) > 1 or actions):
        raise SessionError("a stretch of time is shown of one session, without actions")
    if not slower > 0:
        raise SessionError(f"slower is a number above 0, such as 4, got {slower:g}")
    alone = chosen[0][0]
    folder = Path(out) if out is not None else alone.path if len(chosen) == 1 else Path()
    what = stretch(start_s, stop_s) if part else "+".join(actions)
    path = video_path(folder, alone.name if len(chosen) == 1 else "sessions", what)
    if path.exists() and not overwrite:
        raise SessionError(
            f"{path} exists already; name another place with --out, or say --overwrite (in Python "
            "out= and overwrite=True)"
        )
    if len(chosen) == 1 and not actions:
        return write_session(
            alone, path, start_s=start_s, stop_s=stop_s, slower=slower, progress=progress
        )
    write_clips(chosen, path, actions, slower=slower, progress=progress)
    if folder == alone.path:
        write_report(folder)  # which links to it
    return path


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


def describe_session(
    session: str | Path,
    facts: Mapping[str, str],
    *,
    author: str = "",
    progress: Progress = silent,
) -> Path:
    """Set facts about the animal of a session; updates table `sessions` and the report.

    Nothing is measured again. The facts are part of the log of corrections and can be undone.

    Args:
        session: the session folder.
        facts: any of subject_id, group, cage, sex, batch, species (Latin), age (12 weeks, or P12W)
            and session_start_time (ISO 8601 with a time zone); an empty text means unknown.
        author: author of the change; "" uses the current account.
        progress: receives progress reports.

    Returns:
        The session folder.

    Raises:
        SessionError: there is no such fact, or another program is correcting the session.
        PlanError: a value is invalid.
    """
    from liex_lab.sessions.correcting import descriptions

    return correct_session(session, descriptions(facts), author=author, progress=progress)


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
        from liex_lab.dashboards.app.guard import LOOPBACK
        from liex_lab.dashboards.app.server import address, make_app, serve
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"the dashboard needs {error.name}; {how_to_install('dashboard')}"
        ) from None
    from liex_lab.dashboards.app.data import StudyData
    from liex_lab.dashboards.report.views import write_views
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


def verify_session(
    session: str | Path, recording: str | Path | None = None, *, progress: Progress = silent
) -> list[Finding]:
    """Check whether a session is unchanged since it was written; returns the findings.

    Compares the facts in session.json, the files with their SHA-256, the logs, the model and the
    corrections.

    Args:
        session: the session folder.
        recording: its recording, to check whether re-running reproduces the session, which takes as
            long as the first run. None skips this.
        progress: receives progress of the second run.

    Returns:
        One `Finding` per check; its state is ok, wrong or note.

    Raises:
        SessionError: there is no session.
    """
    from liex_lab.pipelines.verify import verify_session as job

    return job(session, run_session, None if recording is None else str(recording), progress)


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


def _layout(session: dict[str, Any]) -> Any:
    """The Rerun layout of a session.json; imported on first use."""
    from liex_lab.dashboards.replay.layouts import replay_blueprint

    return replay_blueprint(session)


def _views(folder: Path) -> Path:
    """Report and layouts of a session's folder; imported on first use."""
    from liex_lab.dashboards.report.views import write_views

    return write_views(folder)
