"""Public Python interface: the jobs of the command line that scripts ask for.

`run_session` is `liex run`, `run_demo` is `liex demo`, and so on. The folders `pipelines` (jobs)
and `dashboards` (views) do not import each other; this module hands the views, which are the layout
of the Rerun replay and the HTML report, to the job that writes a session. Jobs are imported when
they are called.
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
# what a run needs after its first frames, and takes seconds to import: of the replay, of the table
# `transitions`, of the figures
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

    Background subtraction, pose estimation of single frames by the Lie-X method, association and
    smoothing over the whole recording, kinematics and ethogram, in this order. Nothing half-written
    is left behind where the recording, the plan or the animal in it cannot be used.

    Args:
        recording: path of a recording, or address of a virtual one, or a recording that is open
            already.
        plan: all settings of the run; None takes the bundled plan that fits, that of the mouse
            where it does.
        out: the folder into which the session folder `<recording's name>.liex` is written.
        settings: changes of the plan where none is named, texts like 'animal.spine_mm=65'.
        folder: the session folder itself, where it should have another name.
        overwrite: replace a session that is there already.
        notes: further facts for session.json, see `SessionWriter.note`.
        workers: processes that look at shards of a long recording side by side; 0 takes one for
            every two cores, four at most, for more than 6,000 frames. The tables are the same for
            any number of them. A script that asks for more than one begins its work below
            `if __name__ == "__main__":`, as processes are spawned.
        pool: a worker pool of the caller's own instead of `workers` processes of this machine.
        progress: told how far the work is.

    Returns:
        The session folder.

    Raises:
        LiexError: the recording, the plan or the animal in it cannot be used; the message says what
            to do.
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
    """Measure several arenas in one picture, each as a session of its own, in one pass.

    Args:
        recording: path of a recording, or address of a virtual one, or a recording that is open
            already.
        plan: lists the arenas, `[[arenas]]`, or says `arenas = "auto"`; None takes for each arena
            the bundled plan that fits, with the arenas that `settings` say.
        out: the folder into which the session folders `<recording's name>-<arena>.liex` are
            written.
        settings: changes of the plan where none is named.
        overwrite: replace sessions that are there already.
        notes: further facts for every session.json.
        workers: processes that look at shards of a long recording side by side, each arena by
            itself; 0 or 1 measure all of them in one pass.
        pool: a worker pool of the caller's own instead.
        progress: told how far the work is.

    Returns:
        For each arena its session folder, or why it could not be measured.

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
    """Add corrections to a session, or take some back by their numbers; tables and report follow.

    What was measured stays as it is; see `liex_lab.sessions.corrections`. With neither `what` nor
    `undo`, everything that follows from the corrections is made again.

    Args:
        session: the session folder.
        what: corrections made by the functions of `liex_lab.sessions.correcting`.
        undo: numbers of corrections to take back.
        author: whose corrections they are; "" takes who is logged in.
        report: whether report and figures are made again, too; of many corrections in a row the
            last one is enough.
        progress: told how far the work is.

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
    """Show the skeletons of a recording that goes on in a Rerun viewer; returns measured latencies.

    Args:
        source: a file or folder that is being written, HOST:PORT of a sender, or, with `replay`, a
            recording.
        plan: all settings of the run.
        replay: send a finished recording at its own pace, as if it were live.
        to: 'viewer' starts a viewer on this machine; else the address of one, or a file .rrd.
        patience_s: a file that has not grown for so many seconds is taken for finished.
        progress: told how many frames have been followed.

    Returns:
        Table of numbers: name, n_frames, n_live (frames whose latency was measured),
        latency_median_ms and latency_p95_ms (None where there is none), n_measured, n_bridged.

    Raises:
        LiexError: the source is over before it has a frame, or cannot be read, or there is no
            screen for a viewer.
    """
    from liex_lab.dashboards.replay.layouts import live_blueprint
    from liex_lab.pipelines.live import follow_live as job
    from liex_lab.pipelines.live import open_live
    from liex_lab.sessions.viewer import LiveView, need_screen

    if to == "viewer":  # before minutes are waited for
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

    An earlier session of the demo in the same place is replaced.

    Args:
        out: the folder into which the session folder is written.
        progress: told how far the work is.
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

    They are as wide as one or two columns of a journal, their texts can be edited, and the same
    tables give the same bytes.

    Args:
        place: a session folder; a study file, its folder, or a folder with sessions in it; or the
            folder of a comparison.
        only: names of figures, such as 'occupancy'; of a comparison its measures, too; () takes
            all.
        formats: some of svg, pdf and png; 'pages' is one file figures.pdf of all of them.
        out: the folder for them; None takes `figures` beside what they are of.
        progress: told which figure is drawn.

    Returns:
        `files`: the paths; `empty`: names of figures of which there is nothing to draw; `folder`.

    Raises:
        SessionError: there is no such figure or format, or nothing at all to draw.
        StudyError: there is no such place.
    """
    from liex_lab.dashboards.figures import sets
    from liex_lab.errors import SessionError
    from liex_lab.pipelines.study.listing import list_sessions
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
    """Compare the groups of sessions; writes tables, a text of methods, and figures.

    Args:
        places: study files, session folders, or folders with sessions anywhere in them.
        out: folder of the tables; it is made where it is missing.
        measures: columns of the summary; () takes the usual ones and every action's share.
        reference: compare with this group only; None compares all pairs.
        animals: a CSV with `subject_id` and any of group, cage, sex, batch, which overrules what
            the sessions say.
        engine: `auto`, `permutation` or `mixed`.
        only_trusted: leave out sessions that someone has to look at.
        progress: told session by session and figure by figure.

    Returns:
        `stats`: the table's rows; `folder`: where the files are; `figures`: their paths;
        `sessions`: a sentence that accounts for every session; `check`: sentences on what may be
        wrong.

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

    One session is shown from beginning to end, on its own clock; several stand beside each other,
    by group. With `actions` the clips of their bouts do, aligned at the onsets; the report of a
    session links to those in its folder.

    Args:
        places: a session folder, or several, or folders with sessions anywhere in them.
        out: the folder for it; None takes the session's own, or, of several, this one.
        actions: words, or beginnings of words: rear is rear_supported and rear_unsupported, too.
        groups: only sessions of these groups; () takes all.
        start_s: of one session only what follows this time, s.
        stop_s: and only what is before this one, s.
        slower: so many times slower than it was.
        overwrite: replace what is there under this name.
        progress: told how far it is.

    Returns:
        Path of the video.

    Raises:
        SessionError: a session keeps no depth, no bout has such a name, this PyAV has no encoder,
            or there is such a file already.
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
    """Measure the sessions of a study that are to be done; returns the status of every session.

    A session that fails leaves failed.json in its folder and stops no other. Where the study says
    shared = "subject", sessions of one animal are looked at first, and measured with what they
    agree on. The study's table is written again at the end.

    Args:
        study: the study file, or the folder that holds study.toml.
        workers: processes on this machine; 0 takes one for every two cores.
        scheduler: address of a Dask scheduler whose workers are used instead.
        slurm: TOML file that says how to ask Slurm for workers; not together with `scheduler`.
        retry: try sessions again that failed before.
        again: measure done and failed sessions again, too; excluded ones stay out.
        only: ids of the sessions to measure; () takes all.
        dry_run: measure nothing; return the status of the sessions as they are.
        board: makes, for a number of jobs, the display of all of them (a context manager).

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
    """Say who the animal of a session is; table `sessions` and report follow, nothing is measured.

    It is kept in the log of corrections and can be taken back like one.

    Args:
        session: the session folder.
        facts: any of subject_id, group, cage, sex, batch, species (Latin), age (12 weeks, or P12W)
            and session_start_time (ISO 8601 with a time zone); an empty text is unknown.
        author: who says so; "" takes who is logged in.
        progress: told how far the work is.

    Returns:
        The session folder.

    Raises:
        SessionError: there is no such fact, or another program is correcting the session.
        PlanError: a value cannot be used.
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
    """Serve a study, or a folder with sessions in it, to browsers until interrupted.

    Every visitor has to know a token, new each time, which is part of the address. On a host other
    than this machine alone no replay is opened.

    Args:
        study: a study file, its folder, or a folder with sessions in it.
        host: the network address to listen on; the default is this machine alone.
        port: the port to listen on.
        told: called with the dashboard's address once it is served.
        progress: told how far the loading of the sessions is.

    Raises:
        MissingPackageError: the extra `dashboard` is not installed.
        StudyError: there is no such study.
    """
    import secrets

    from liex_lab.pipelines.study.listing import list_sessions

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
            undo: numbers of corrections to take back.
            author: whose corrections they are.
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
    """Check whether a session is what it was when it was written; returns what was found.

    Compared are the facts in session.json, the files with their SHA-256, the logs, the model and
    the corrections.

    Args:
        session: the session folder.
        recording: its recording, which is then measured again, to see whether it gives the same;
            this takes as long as the first time. None leaves that out.
        progress: told how far the second measurement is.

    Returns:
        One `Finding` per thing that was looked at; its state is ok, wrong or note.

    Raises:
        SessionError: there is no session at all.
    """
    from liex_lab.pipelines.verify import verify_session as job

    return job(session, run_session, None if recording is None else str(recording), progress)


def write_long(minutes: float, out: str | Path) -> dict[str, Any]:
    """Write a session of a virtual mouse of any length; returns its cost in memory and time.

    The frames of one short recording are repeated to and fro, so that only what grows with the
    length of a recording is measured.

    Args:
        minutes: length of the recording, min, at 30 frames per second.
        out: the folder into which the session folder long.liex is written.

    Returns:
        `peak_memory_mb` (None where the system does not tell) and `seconds`.
    """
    from liex_lab.dashboards.report.report import write_report
    from liex_lab.pipelines.evaluation.scale import write_long as job

    return job(minutes, out, write_report)


def run_scale(
    n_frames: int = 3000, minutes: Sequence[float] = (1.0, 10.0), *, progress: Progress = silent
) -> dict[str, Any]:
    """Measure what a study costs: sessions per hour, memory, and where the time goes.

    Sessions per hour are given by number of workers (one and two measured, more simulated), memory
    by length of recording.

    Args:
        n_frames: length of each virtual recording, frames of 640 x 480 px.
        minutes: lengths of recording whose memory is measured, min.
        progress: told how far the work is.

    Returns:
        Table of numbers, with the definitions and assumptions behind them as text.
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
        model: a pose model by name or path; None takes the animal's bundled one.
        paper: also compare Algorithms 1 and 3 with the parts of the paper's variant.
        n_frames: only so many frames of the sequence; None takes all.
        figure: the PNG of joint error over time to draw; None draws none.
        progress: told how far the work is.

    Returns:
        Table of numbers: figures of each row, speed, and the protocol as text.
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
    """Measure rendered scenes as a lab's camera would see them, and score the tables.

    Args:
        only: names of scenes; () takes all.
        n_frames: length of each recording.
        n_recordings: of each scene, each of another animal.
        sealed: measure on the seeds that are not for development.
        pictures: the folder for drawn frames, one PNG a scene; None draws none.
        progress: told how far the work is.

    Returns:
        Table of numbers: `rows` of figures by name, and the protocol as text.

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
    """Score action recognition on cut-out sequences and on uncut virtual recordings.

    Args:
        animal: one for which actions are generated: fish or mouse.
        model: an action model by name or path; None takes the bundled one or, where there is none,
            trains one now.
        pose_model: the pose model that measures the frames; None takes the animal's own.
        minutes: length of the uncut test recordings, min.
        figure: the PNG of the confusion matrices to draw; None draws none.
        progress: told how far the work is.

    Returns:
        Table of numbers: accuracy on sequences, F1 of the timeline, both by frame rate, and the
        protocol as text.

    Raises:
        LiexError: no actions are generated for this animal.
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
        out: the folder that tables and figures are written into.
        animals: names of animals; () takes those with a bundled model.
        n_frames: only so many frames of each split, of which every row is measured, none kept;
            None takes all.
        quick: a few minutes' run whose numbers say only that everything runs.
        fresh: nothing kept is used; every variant is trained again, which takes long.
        rows: these rows are trained and measured anew, or `fig7`, the curves of Fig. 7; the others
            are kept ones. () names none.
        sealed: measure the sealed split, which is done once, when an issue ends.
        without: `tracking` or `actions`, parts of the page that are not measured.
        nyu: folder of the NYU hand data, counted for Table 2; None leaves it out.
        progress: told how far the work is.
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
    """The Rerun layout of a session.json; it is imported when it is wanted."""
    from liex_lab.dashboards.replay.layouts import replay_blueprint

    return replay_blueprint(session)


def _views(folder: Path) -> Path:
    """Report and layouts of a session's folder; they are imported when they are wanted."""
    from liex_lab.dashboards.report.views import write_views

    return write_views(folder)
