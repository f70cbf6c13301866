"""Commands for sessions and recordings: compare, report, figures, export, show, convert, pack."""

from __future__ import annotations

import os
import socket
import subprocess
import tempfile
from contextlib import ExitStack
from math import isnan
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import quote

import typer

from liex_lab.cli.options import (
    RecordingPath,
    SessionPath,
    Settings,
    TopicName,
    WhichPlan,
    region_setting,
    say,
)
from liex_lab.errors import LiexError, MisfitError, printable
from liex_lab.runtime.progress import progress_bar


def compare(
    places: Annotated[
        list[Path],
        typer.Argument(metavar="PLACE...", help="Study files, sessions, or folders of sessions."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="The folder for the tables.")],
    measures: Annotated[
        list[str] | None,
        typer.Option(
            "--measure", help="A column of summary.csv; repeatable; by default the usual ones."
        ),
    ] = None,
    reference: Annotated[
        str | None, typer.Option("--reference", help="Compare with this group only.")
    ] = None,
    animals: Annotated[
        Path | None,
        typer.Option("--animals", metavar="CSV", help="subject_id with group, cage, sex or batch."),
    ] = None,
    engine: Annotated[str, typer.Option("--engine", help="auto, permutation or mixed.")] = "auto",
    only_trusted: Annotated[
        bool, typer.Option("--only-trusted", help="Leave out sessions marked 'look at it'.")
    ] = False,
) -> None:
    """Compare groups of animals: the test that the design allows, effect sizes, and n at every
    level.
    """
    from liex_lab.api import compare_groups
    from liex_lab.behaviour.cohort import counted_units
    from liex_lab.dashboards.units import counted

    with progress_bar() as progress:
        found = compare_groups(
            places,
            out,
            measures or (),
            reference=reference,
            animals=animals,
            engine=engine,
            only_trusted=only_trusted,
            progress=progress,
        )
    refused: dict[str, list[str]] = {}
    for row in found["stats"].to_dict("records"):
        numbers = f"{row['estimate']:.4g}"
        if not isnan(row["ci_low"]):
            numbers += f" [{row['ci_low']:.3g}, {row['ci_high']:.3g}]"
        if not isnan(row["effect_size"]):  # identical values have none
            numbers += f", g {row['effect_size']:.2g}"
        if not isnan(row["estimate"]):
            say(f"{row['measure']}, {row['contrast']}: {numbers}; {counted_units(row)}")
        if row["test"]:
            say(f"    p {row['p']:.2g}, corrected {row['p_fdr']:.2g}: {row['test']}")
        else:
            refused.setdefault(row["refused"], []).append(row["measure"])
    for why, names in refused.items():  # once, not for each measure
        say(f"not tested: {', '.join(dict.fromkeys(names))}\n    {why}")
    say(found["sessions"])
    say(f"tables: {found['folder']}   (sentences to paste: results.txt, methods.txt)")
    say(f"figures: {counted(len(found['figures']), 'file')} in {found['folder'] / 'figures'}")
    for one in found["check"]:
        typer.secho(f"check this result: {printable(one)}", fg=typer.colors.YELLOW)
    if found["check"]:
        raise typer.Exit(MisfitError.exit_code)


def report(
    session: Annotated[
        Path, typer.Argument(metavar="SESSION", help="A session folder, NAME.liex.")
    ],
) -> None:
    """Write a session's report.html again, with all corrections."""
    from liex_lab.dashboards.report.report import write_report

    say(f"report: {write_report(session)}")


def figures(
    place: Annotated[
        Path,
        typer.Argument(
            metavar="PLACE", help="A session, a study, a folder with sessions, or a comparison."
        ),
    ],
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="NAME", help="Only this figure; repeatable."),
    ] = None,
    formats: Annotated[
        list[str] | None,
        typer.Option(
            "--format",
            metavar="FORMAT",
            help="svg, pdf or png, or pages: one PDF of all; repeatable.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="The folder for them; by default PLACE/figures."),
    ] = None,
) -> None:
    """Draw figures for a paper: occupancy, trajectory, ethogram, transitions, groups and others."""
    from liex_lab.api import draw_figures
    from liex_lab.dashboards.units import counted

    with progress_bar() as progress:
        found = draw_figures(
            place, only=only or (), formats=formats or ("svg", "pdf"), out=out, progress=progress
        )
    if found["empty"]:
        say(f"note: there is nothing to draw of {', '.join(found['empty'])}")
    say(f"figures: {counted(len(found['files']), 'file')} in {found['folder']}")


def export(
    places: Annotated[
        list[Path],
        typer.Argument(metavar="SESSION...", help="Session folders, NAME.liex."),
    ],
    to: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="FORMAT",
            help="nwb, boris, dlc (or deeplabcut), movement, sleap, csv, xlsx or video.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="The folder for it; by default the session's own."
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace what is there under this name.")
    ] = False,
    actions: Annotated[
        list[str] | None,
        typer.Option("--action", metavar="WORD", help="Video: clips of this action; repeatable."),
    ] = None,
    groups: Annotated[
        list[str] | None,
        typer.Option("--group", metavar="NAME", help="Video: only this group; repeatable."),
    ] = None,
    start_s: Annotated[
        float | None, typer.Option("--from", metavar="S", min=0.0, help="Video: from this time on.")
    ] = None,
    stop_s: Annotated[
        float | None, typer.Option("--until", metavar="S", min=0.0, help="Video: until this time.")
    ] = None,
    slower: Annotated[
        float, typer.Option("--slower", metavar="N", help="Video: this many times slower.")
    ] = 1.0,
) -> None:
    """Write sessions as NWB, BORIS, DeepLabCut, movement, SLEAP, CSV or Excel files, or as a video,
    several side by side.
    """
    from liex_lab.exchange import export as job
    from liex_lab.sessions import Session

    if to == "video":
        from liex_lab.api import export_video

        with progress_bar() as progress:
            video = export_video(
                places,
                out,
                actions=actions or (),
                groups=groups or (),
                start_s=start_s,
                stop_s=stop_s,
                slower=slower,
                overwrite=overwrite,
                progress=progress,
            )
        say(f"export: {video}")
        return
    if actions or groups or start_s is not None or stop_s is not None or slower != 1.0:
        raise typer.BadParameter(
            "actions, groups and times are chosen for `--to video`; the other formats hold all"
        )
    for place in places:
        say(f"export: {job(Session.open(place), to, out, overwrite=overwrite)}")


# The command `liex show`: a session's replay in Rerun, optionally with full depth images.


_HERE = "127.0.0.1"


def show(
    session: SessionPath,
    web: Annotated[
        bool,
        typer.Option(
            "--web", help="Open it in the browser; Rerun's viewer there calls tel.rerun.io."
        ),
    ] = False,
    at_s: Annotated[
        float | None, typer.Option("--at", metavar="S", min=0.0, help="Open it at this time.")
    ] = None,
    depth: Annotated[
        Literal["kept", "all"],
        typer.Option("--depth", help="all: whole depth pictures, read from the recording."),
    ] = "kept",
    recording: Annotated[
        str | None,
        typer.Option(
            "--recording", metavar="FILE", help="The recording, for --depth all if it has moved."
        ),
    ] = None,
) -> None:
    """Open a session's replay in Rerun."""
    from liex_lab.sessions import Session
    from liex_lab.sessions.viewer import has_screen

    if web and at_s is not None:
        raise typer.BadParameter("a moment can be shown in a window only; leave out --web or --at")
    if recording is not None and depth != "all":
        raise typer.BadParameter("a recording is read for whole pictures only; add --depth all")
    replay = Session.open(session).path / "session.rrd"
    if at_s is None and not web and not has_screen():
        raise LiexError(
            f"Rerun needs a screen and there is none here; open {replay} on a computer with a "
            "screen, or add --web"
        )
    with tempfile.TemporaryDirectory(prefix="liex-show-") as scratch:
        more = [] if depth == "kept" else _whole_depth(session, Path(scratch), recording)
        _show(replay, more, at_s, web)


def _whole_depth(session: Path, scratch: Path, recording: str | None) -> list[Path]:
    """A replay of a session's full depth images; empty, with a note, if there is no recording."""
    from liex_lab.pipelines.show import whole_pictures

    try:
        with progress_bar() as progress:
            return [whole_pictures(session, scratch / "depth.rrd", recording, progress)]
    except LiexError as error:
        say(f"note: {error}")
        say("note: the replay shows what the session keeps of the depth")
        return []


def _show(replay: Path, more: list[Path], at_s: float | None, web: bool) -> None:
    """Open a replay and wait until its viewer is closed."""
    from liex_lab.runtime.processes import own_python
    from liex_lab.sessions.viewer import replays_with, show_replay

    if at_s is not None:
        show_replay(replay, at_s, more).wait()
        return
    # RERUN_ANALYTICS: no usage data leaves the laboratory; the viewer in a browser ignores it
    hosted: list[str] = []
    if web:
        say(
            "Rerun's viewer in the browser calls tel.rerun.io, its makers' count of uses; the "
            "window does not"
        )
        page, data = _free_ports(2)
        source = quote(f"rerun+http://{_HERE}:{data}/proxy", safe="")
        say(f"replay: http://{_HERE}:{page}?url={source}   (Ctrl+C ends it)")
        hosted = ["--web-viewer", "--web-viewer-port", str(page), "--port", str(data)]
    shown = [str(file) for file in replays_with(replay, more)]
    command = own_python("-m", "rerun", *shown, "--bind", _HERE, *hosted)
    quiet = {"RUST_LOG": "warn"} if web else {}  # its log would hide the address
    around = {**quiet, **os.environ, "RERUN_ANALYTICS": "0"}
    raise typer.Exit(subprocess.run(command, env=around, check=False).returncode)


def _free_ports(n: int) -> list[int]:
    """Unused ports of this machine."""
    with ExitStack() as held:
        sockets = [held.enter_context(socket.socket()) for _ in range(n)]
        for one in sockets:
            one.bind((_HERE, 0))
        return [int(one.getsockname()[1]) for one in sockets]


# The commands of `liex` that write recordings: for other programs, and as archives.


def convert(
    recording: RecordingPath,
    to: Annotated[
        Path,
        typer.Option("--to", metavar="TARGET", help="NAME.mcap, or a folder for PNG images."),
    ],
    fps: Annotated[
        float | None, typer.Option("--fps", help="Frames per second, where the file has no times.")
    ] = None,
    topic: TopicName = None,
    step_mm: Annotated[
        float | None,
        typer.Option(
            "--step-mm", min=0.001, help="Round depth to steps of this size; not for MCAP."
        ),
    ] = None,
    ros: Annotated[
        bool, typer.Option("--ros", help="Write ROS 2 messages instead of Foxglove's (MCAP).")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace what is there under this name.")
    ] = False,
) -> None:
    """Write a recording as MCAP (which keeps every depth) or as a folder of 16-bit PNG images."""
    from liex_lab.pipelines.convert import convert as job

    with progress_bar() as progress:
        done = job(
            recording,
            to,
            fps=fps,
            topic=topic,
            step_mm=step_mm,
            ros=ros,
            overwrite=overwrite,
            progress=progress,
        )
    say(f"recording: {done.path} ({done.n_frames} frames)")
    for sentence in (*done.problems, *done.notes):
        say(f"note: {sentence}")


def pack(
    recording: RecordingPath,
    to: Annotated[
        Path | None,
        typer.Option(
            "--to",
            metavar="NAME.mcap",
            help="The archive; by default NAME.pack.mcap beside the recording.",
        ),
    ] = None,
    plan: WhichPlan = None,
    region: Annotated[
        str | None,
        typer.Option("--region", metavar='"X,Y X,Y ..."', help="Keep what is in this polygon."),
    ] = None,
    whole: Annotated[bool, typer.Option("--whole", help="Keep whole pictures.")] = False,
    verify: Annotated[
        bool,
        typer.Option("--verify", help="Read it again and compare; an archive with its own hash."),
    ] = False,
    delete_original: Annotated[
        bool,
        typer.Option("--delete-original", help="Remove the recording after it was verified."),
    ] = False,
    topic: TopicName = None,
    settings: Settings = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace what is there under this name.")
    ] = False,
) -> None:
    """Pack a recording without loss: its arena in 16 bits, half as large, read by every verb."""
    from liex_lab.pipelines.convert import pack as job
    from liex_lab.plan import Plan

    if whole and region is not None:
        raise typer.BadParameter("--whole keeps every pixel; leave out --region or --whole")
    asked = [*region_setting(region), *([] if topic is None else [f"recording.topic={topic}"])]
    chosen = Plan.load(plan or "mouse").with_settings([*asked, *(settings or [])])
    with progress_bar() as progress:
        done = job(
            recording,
            to,
            plan=chosen,
            whole=whole,
            verify=verify,
            delete_original=delete_original,
            overwrite=overwrite,
            progress=progress,
        )
    if not done.written:
        say(f"archive: {done.path} ({done.n_frames} frames) is as it was packed")
        return
    size = f"{done.n_bytes / 1e6:.1f} MB"
    if done.source_bytes:
        share = 100 * done.n_bytes / done.source_bytes
        size += f", {share:.0f}% of the recording's {done.source_bytes / 1e6:.1f} MB"
    say(f"archive: {done.path} ({done.n_frames} frames, {size})")
    say(f"kept:    {100 * done.kept:.0f}% of a picture's pixels, bit for bit")
    if done.verified:
        say("checked: every picture and time is that of the recording")
    for path in done.deleted:
        say(f"removed: {path}")
    for sentence in done.notes:
        say(f"note: {sentence}")
