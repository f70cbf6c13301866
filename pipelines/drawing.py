"""Figures, videos and whole images: `liex figures`, `liex export --to video`, `liex show`."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from liex_lab.dashboards.figures import sets
from liex_lab.dashboards.report.report import write_report
from liex_lab.dashboards.video.video import write_clips, write_session

from liex_lab.errors import LiexError, SessionError, refuse
from liex_lab.plan import Plan
from liex_lab.recordings.depth_kernels import to_millimetres
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.durable import is_there
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Session, cutouts, evidence, rrd
from liex_lab.sessions.individuals import arena_name, by_arena
from liex_lab.sessions.session import stretch, video_path

from .build import build_recording
from .compare import comparison_figures, find_sessions
from .study.run import list_sessions


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
    path = Path(place)
    folder = path if path.is_dir() else path.parent
    if unknown := [kind for kind in formats if kind not in sets.KINDS]:
        raise SessionError(
            f"figures are written as {', '.join(sets.KINDS)}, got '{unknown[0]}'; name one of these"
        )
    if (path / "session.json").is_file():
        sets.check_names(only, list(sets.OF_SESSION))
        drawn = sets.session_figures(Session.open(path), only)
    elif (path / sets.COMPARISON_FILE).is_file():
        drawn = comparison_figures(path, only)
    else:
        sets.check_names(only, list(sets.OF_STUDY))
        _, entries = list_sessions(path)
        folders = [entry.folder for entry in entries() if entry.folder is not None]
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
            "actions; its report states why"
        )
    return {"files": files, "empty": empty, "folder": target}


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

    One session is shown from beginning to end, on its own clock, and the animals of one arena over
    one depth image; several are shown side by side, by group. With `actions`, the video contains
    clips of these bouts, aligned at the onsets; a session's report links to the videos in its
    folder.

    Args:
        places: a session folder, several, or folders that contain sessions at any depth.
        out: the output folder; None uses the session's own, of animals of one arena the folder
            of the first, or the current folder for several.
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
    given = [places] if isinstance(places, str | Path) else list(places)
    opened = [Session.open(folder) for folder in find_sessions(given)]
    named = [(some, _group_of(some)) for some in by_arena(opened)]
    chosen = [pair for pair in named if not groups or pair[1] in groups]
    if not chosen:
        there = ", ".join(sorted({group for _, group in named} - {""})) or "none"
        raise SessionError(f"no session is of {' or '.join(groups)}; their groups are {there}")
    part = start_s is not None or stop_s is not None
    refuse(
        SessionError,
        (
            part and (len(chosen) > 1 or actions),
            "a stretch of time is shown of one session or arena, without actions",
        ),
        (not slower > 0, f"slower is a number above 0, such as 4, got {slower:g}"),
    )
    first, *others = chosen[0][0]
    beside = first.path.parent if others else first.path
    folder = Path(out) if out is not None else beside if len(chosen) == 1 else Path()
    what = stretch(start_s, stop_s) if part else "+".join(actions)
    named_as = arena_name(first) if others else first.name
    path = video_path(folder, named_as if len(chosen) == 1 else "sessions", what)
    if path.exists() and not overwrite:
        raise SessionError(
            f"{path} exists already; name another place with --out, or use --overwrite (in Python "
            "out= and overwrite=True)"
        )
    if len(chosen) == 1 and not actions:
        return write_session(
            [first, *others], path, start_s=start_s, stop_s=stop_s, slower=slower, progress=progress
        )
    write_clips(chosen, path, actions, slower=slower, progress=progress)
    if folder == first.path:
        write_report(folder)  # which links to it
    return path


def _group_of(sessions: Sequence[Session]) -> str:
    """The group of the animals of one arena; all of them if they differ."""
    groups = [str(one.table("sessions")["group"].iloc[0] or "") for one in sessions]
    return " and ".join(dict.fromkeys(group for group in groups if group))


# Whole depth images for a session's replay, `liex show --depth all`.


def whole_images(
    session: str | Path, out: Path, recording: str | None = None, progress: Progress = silent
) -> Path:
    """Write the whole depth images of a session's recording into a replay.

    Args:
        session: the session folder.
        out: the .rrd file to write.
        recording: path of the recording, if it has moved since the session was measured.
        progress: called while the recording is hashed and read.

    Returns:
        `out`.

    Raises:
        SessionError: the session does not link to its recording, the recording is missing, or it
            has another hash.
        RecordingError: the recording cannot be read.
    """
    opened = Session.open(session, raw=True)
    origin = replace(
        evidence.provenance_of(opened, evidence.skeleton_of(opened)), replay_depth=cutouts.ALL
    )
    with recording_of(opened, recording, progress) as images:
        replay = rrd.ReplayWriter(out, origin)
        try:
            # frames in memory at a time
            for frames in images.chunks(32):
                replay.add(
                    [frame.index for frame in frames],
                    [frame.time_ns for frame in frames],
                    [to_millimetres(frame.depth) for frame in frames],
                )
                progress(frames[-1].index + 1, len(images), "reading whole images")
            replay.flushed()
        finally:
            replay.abandon()
    return out


def recording_of(
    session: Session,
    stated: str | None,
    progress: Progress,
    build: Callable[[str, Plan, Progress], Recording] = build_recording,
) -> Recording:
    """The recording of a session, opened with the session's plan; its hash is checked.

    Args:
        session: the session.
        stated: path of the recording, if it has moved.
        progress: called while it is hashed.
        build: opens a path with a plan.

    Raises:
        SessionError: the recording is not linked, missing, or another one.
    """
    where = stated or evidence.linked_recording(session)
    if where is None:
        raise SessionError(
            f"{session.path} does not link to its recording, like sessions of earlier versions; "
            "name it with --recording"
        )
    if not where.startswith("synthetic:") and not is_there(where):
        raise SessionError(
            f"full depth images are missing: the recording of {session.path.name} is not at "
            f"{where} any more; name it with --recording"
        )
    recording = build(where, Plan.from_toml(session.plan, "plan.toml"), progress)
    try:
        if recording.digest(progress) != session.metadata["input"]["sha256"]:
            raise SessionError(
                f"full depth images are missing: {where} is not the recording that "
                f"{session.path.name} was made of, its hash is another one; name the right one "
                "with --recording"
            )
    except LiexError:
        recording.close()
        raise
    return recording
