"""Commands for sessions and recordings: compare, report, figures, export, show, convert, pack."""

from __future__ import annotations

import os
import shlex
import socket
import subprocess
import tempfile
import webbrowser
from collections import Counter
from contextlib import ExitStack
from html import escape
from math import isnan
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Literal
from urllib.parse import quote

import typer

import liex_lab
from liex_lab import api
from liex_lab.cli.options import (
    RecordingPath,
    SessionPath,
    Settings,
    TopicName,
    WhichPlan,
    echo,
    load_plan,
    region_setting,
)
from liex_lab.errors import LiexError, MisfitError, printable
from liex_lab.runtime.progress import progress_bar

if TYPE_CHECKING:
    from liex_lab.pipelines.study.status import SessionStatus


def compare(
    places: Annotated[
        list[Path],
        typer.Argument(metavar="PLACE...", help="Study files, sessions, or folders of sessions."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Output folder.")],
    measures: Annotated[
        list[str] | None,
        typer.Option(
            "--measure",
            help="A column of summary.csv to compare; repeatable; default: the common measures.",
        ),
    ] = None,
    reference: Annotated[
        str | None, typer.Option("--reference", help="Compare only with this group.")
    ] = None,
    animals: Annotated[
        Path | None,
        typer.Option(
            "--animals", metavar="CSV", help="Table of subject_id with group, cage, sex or batch."
        ),
    ] = None,
    engine: Annotated[
        str, typer.Option("--engine", help="Test: auto, permutation or mixed.")
    ] = "auto",
    only_trusted: Annotated[
        bool, typer.Option("--only-trusted", help="Exclude sessions that need review.")
    ] = False,
) -> None:
    """Compare groups of animals: tests that the design allows, effect sizes, and sample sizes."""
    from liex_lab.behaviour.cohort import counted_units
    from liex_lab.dashboards.units import counted

    with progress_bar() as progress:
        found = api.compare_groups(
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
            echo(f"{row['measure']}, {row['contrast']}: {numbers}; {counted_units(row)}")
        if row["test"]:
            echo(f"    p {row['p']:.2g}, corrected {row['p_fdr']:.2g}: {row['test']}")
        else:
            refused.setdefault(row["refused"], []).append(row["measure"])
    for why, names in refused.items():  # once, not for each measure
        echo(f"not tested: {', '.join(dict.fromkeys(names))}\n    {why}")
    echo(found["sessions"])
    echo(f"tables: {found['folder']}   (sentences to paste: results.txt, methods.txt)")
    echo(f"figures: {counted(len(found['figures']), 'file')} in {found['folder'] / 'figures'}")
    for one in found["check"]:
        typer.secho(f"check this result: {printable(one)}", fg=typer.colors.YELLOW)
    if found["check"]:
        raise typer.Exit(MisfitError.exit_code)


def report(
    session: SessionPath,
) -> None:
    """Regenerate a session's report.html, with all corrections."""
    from liex_lab.dashboards.report.report import write_report

    echo(f"report: {write_report(session)}")


def figures(
    place: Annotated[
        Path,
        typer.Argument(
            metavar="PLACE", help="A session, a study, a folder of sessions, or a comparison."
        ),
    ],
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="NAME", help="Draw only this figure; repeatable."),
    ] = None,
    formats: Annotated[
        list[str] | None,
        typer.Option(
            "--format",
            metavar="FORMAT",
            help="svg, pdf or png; pages: one PDF with all figures; repeatable.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Output folder; default: PLACE/figures."),
    ] = None,
) -> None:
    """Draw publication figures: occupancy, trajectory, ethogram, transitions, groups and more."""
    from liex_lab.dashboards.units import counted

    with progress_bar() as progress:
        found = api.draw_figures(
            place, only=only or (), formats=formats or ("svg", "pdf"), out=out, progress=progress
        )
    if found["empty"]:
        echo(f"note: there is nothing to draw of {', '.join(found['empty'])}")
    echo(f"figures: {counted(len(found['files']), 'file')} in {found['folder']}")


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
            help="nwb, boris, dlc (deeplabcut), movement, sleap, points, mabe, moseq, csv, xlsx or "
            "video.",
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Output folder; default: the session folder."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing file or folder.")
    ] = False,
    points: Annotated[
        bool,
        typer.Option(
            "--points", help="dlc, movement, sleap: write points on the skin instead of joints."
        ),
    ] = False,
    actions: Annotated[
        list[str] | None,
        typer.Option(
            "--action", metavar="WORD", help="Video: show clips of this action; repeatable."
        ),
    ] = None,
    groups: Annotated[
        list[str] | None,
        typer.Option("--group", metavar="NAME", help="Video: show only this group; repeatable."),
    ] = None,
    start_s: Annotated[
        float | None, typer.Option("--from", metavar="S", min=0.0, help="Video: start time, s.")
    ] = None,
    stop_s: Annotated[
        float | None, typer.Option("--until", metavar="S", min=0.0, help="Video: end time, s.")
    ] = None,
    slower: Annotated[
        float, typer.Option("--slower", metavar="N", help="Video: slow-motion factor.")
    ] = 1.0,
) -> None:
    """Export sessions as NWB, BORIS, DeepLabCut, movement, SLEAP, points, CSV, Excel or a video.

    Sessions of the animals of one arena become individuals of one file.
    """
    from liex_lab.exchange.export import ALIASES, TOGETHER
    from liex_lab.exchange.export import export as job
    from liex_lab.sessions.individuals import by_arena

    if to == "video":
        if points:
            raise typer.BadParameter("--points is for dlc, movement and sleap, a video has none")
        with progress_bar() as progress:
            video = api.export_video(
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
        echo(f"export: {video}")
        return
    if actions or groups or start_s is not None or stop_s is not None or slower != 1.0:
        raise typer.BadParameter(
            "actions, groups and times are chosen for `--to video`; the other formats hold all"
        )
    sessions = [liex_lab.Session.open(place) for place in places]
    joint = ALIASES.get(to, to) in TOGETHER
    for some in by_arena(sessions) if joint else [[one] for one in sessions]:
        echo(f"export: {job(some, to, out, overwrite=overwrite, points=points)}")


# The command `liex show`: a session's replay in Rerun, optionally with full depth images.


_HERE = "127.0.0.1"


def show(
    session: SessionPath,
    web: Annotated[
        bool,
        typer.Option(
            "--web",
            help="Open it in the browser, where Rerun's viewer sends usage data to tel.rerun.io.",
        ),
    ] = False,
    at_s: Annotated[
        float | None, typer.Option("--at", metavar="S", min=0.0, help="Time to start at, s.")
    ] = None,
    depth: Annotated[
        Literal["kept", "all"],
        typer.Option("--depth", help="all: full depth images, read from the recording."),
    ] = "kept",
    recording: Annotated[
        str | None,
        typer.Option(
            "--recording",
            metavar="FILE",
            help="Path of the recording for --depth all, if it has moved.",
        ),
    ] = None,
) -> None:
    """Open a session's replay in Rerun."""
    from liex_lab.sessions.viewer import has_screen

    if web and at_s is not None:
        raise typer.BadParameter("a moment can be shown in a window only; leave out --web or --at")
    if recording is not None and depth != "all":
        raise typer.BadParameter("a recording is read for full depth images only; add --depth all")
    replay = liex_lab.Session.open(session).path / "session.rrd"
    if at_s is None and not web and not has_screen():
        raise LiexError(
            f"Rerun needs a screen, and this computer has no screen; open {replay} on another "
            "computer, or add --web"
        )
    with tempfile.TemporaryDirectory(prefix="liex-show-") as scratch:
        _show(
            replay,
            [] if depth == "kept" else _whole_depth(session, Path(scratch), recording),
            at_s,
            web,
        )


def _whole_depth(session: Path, scratch: Path, recording: str | None) -> list[Path]:
    """A replay of a session's full depth images; empty, with a note, if there is no recording."""
    try:
        with progress_bar() as progress:
            return [api.whole_images(session, scratch / "depth.rrd", recording, progress)]
    except LiexError as error:
        echo(f"note: {error}")
        echo("note: the replay shows what the session keeps of the depth")
        return []


def _show(replay: Path, more: list[Path], at_s: float | None, web: bool) -> None:
    """Open a replay and wait until its viewer is closed."""
    from liex_lab.runtime.processes import own_python
    from liex_lab.sessions.viewer import replays_with, show_replay

    if at_s is not None:
        show_replay(replay, at_s, more)[0].wait()
        return
    # RERUN_ANALYTICS: no usage data leaves the laboratory; the viewer in a browser ignores it
    hosted: list[str] = []
    if web:
        echo(
            "Rerun's viewer in the browser calls tel.rerun.io, its makers' count of uses; the "
            "window does not"
        )
        page, data = _free_ports(2)
        source = quote(f"rerun+http://{_HERE}:{data}/proxy", safe="")
        echo(f"replay: http://{_HERE}:{page}?url={source}   (Ctrl+C ends it)")
        hosted = ["--web-viewer", "--web-viewer-port", str(page), "--port", str(data)]
    command = own_python(
        "-m", "rerun", *[str(file) for file in replays_with(replay, more)], "--bind", _HERE, *hosted
    )
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
        float | None, typer.Option("--fps", help="Frame rate of a recording without timestamps.")
    ] = None,
    topic: TopicName = None,
    step_mm: Annotated[
        float | None,
        typer.Option(
            "--step-mm", min=0.001, help="Round depths to steps of this size; not for MCAP."
        ),
    ] = None,
    ros: Annotated[
        bool, typer.Option("--ros", help="MCAP: write ROS 2 messages instead of Foxglove's.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing file or folder.")
    ] = False,
) -> None:
    """Convert a recording to MCAP (lossless) or to a folder of 16-bit PNG images."""
    with progress_bar() as progress:
        done = api.convert(
            recording,
            to,
            fps=fps,
            topic=topic,
            step_mm=step_mm,
            ros=ros,
            overwrite=overwrite,
            progress=progress,
        )
    echo(f"recording: {done.path} ({done.n_frames} frames)")
    for sentence in (*done.problems, *done.notes):
        echo(f"note: {sentence}")


def pack(
    recording: RecordingPath,
    to: Annotated[
        Path | None,
        typer.Option(
            "--to",
            metavar="NAME.mcap",
            help="The archive; default: NAME.pack.mcap next to the recording.",
        ),
    ] = None,
    plan: WhichPlan = None,
    region: Annotated[
        str | None,
        typer.Option(
            "--region", metavar='"X,Y X,Y ..."', help="Keep only the inside of this polygon."
        ),
    ] = None,
    whole: Annotated[bool, typer.Option("--whole", help="Keep the whole images.")] = False,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify",
            help="Compare the archive with the recording; of an existing archive, check its hash.",
        ),
    ] = False,
    delete_original: Annotated[
        bool,
        typer.Option(
            "--delete-original", help="Delete the recording once the archive is verified."
        ),
    ] = False,
    topic: TopicName = None,
    settings: Settings = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing file or folder.")
    ] = False,
) -> None:
    """Pack a recording into a lossless archive of half its size, which all commands read."""
    if whole and region is not None:
        raise typer.BadParameter("--whole keeps every pixel; leave out --region or --whole")
    chosen = load_plan(
        plan,
        [
            *region_setting(region),
            *([] if topic is None else [f"recording.topic={topic}"]),
            *(settings or []),
        ],
    )
    with progress_bar() as progress:
        done = api.pack(
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
        echo(f"archive: {done.path} ({done.n_frames} frames) is as it was packed")
        return
    n_bytes = done.path.stat().st_size
    size = f"{n_bytes / 1e6:.1f} MB"
    if done.source_bytes:
        share = 100 * n_bytes / done.source_bytes
        size += f", {share:.0f}% of the recording's {done.source_bytes / 1e6:.1f} MB"
    echo(f"archive: {done.path} ({done.n_frames} frames, {size})")
    echo(f"kept:    {100 * done.kept:.0f}% of an image's pixels, bit for bit")
    if done.verified:
        echo("checked: every image and time equals the recording's")
    for path in done.deleted:
        echo(f"removed: {path}")
    for sentence in (*done.problems, *done.notes):
        echo(f"note: {sentence}")


# The commands of `liex` for studies.


def cohort(
    study: Annotated[
        str, typer.Argument(metavar="STUDY|init", help="A study's .toml file; init creates one.")
    ],
    folder: Annotated[
        Path | None,
        typer.Argument(metavar="[FOLDER]", help="With init: the folder of the recordings."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the status of each session without measuring.")
    ] = False,
    retry: Annotated[bool, typer.Option("--retry", help="Measure failed sessions again.")] = False,
    again: Annotated[
        bool,
        typer.Option("--again", help="Measure all sessions again, including those that are done."),
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option("--only", metavar="ID", help="Measure only this session; repeatable."),
    ] = None,
    workers: Annotated[
        int, typer.Option("--workers", min=0, help="Number of processes; 0: one per two cores.")
    ] = 0,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help="Address of a running Dask scheduler.")
    ] = None,
    slurm: Annotated[
        str | None,
        typer.Option("--slurm", metavar="FILE", help="Settings of Slurm jobs, .toml."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="With init: replace an existing study file.")
    ] = False,
) -> None:
    """Measure the pending sessions of a study; exits with code 3 if a session failed."""
    if study == "init":
        with progress_bar() as progress:
            file = api.begin_study(folder or Path(), overwrite, echo=echo, progress=progress)
        echo(f"study: {file}")
        return
    if folder is not None:
        raise typer.BadParameter(
            "a folder is named only after init, as in `liex cohort init FOLDER`"
        )
    if scheduler is not None:
        from liex_lab.pipelines.study.cluster import is_encrypted

        if not is_encrypted(scheduler):
            echo(f"what goes to and from {scheduler} is not encrypted, and each side runs what the")
            echo("other sends: a scheduler for a network that you trust, or tls://")
    standings = api.run_study(
        study,
        workers=workers,
        scheduler=scheduler,
        slurm=slurm,
        retry=retry,
        again=again,
        only=only or (),
        dry_run=dry_run,
    )
    if _print_study(standings, dry_run):
        echo(f"to try what failed again: liex cohort {shlex.quote(study)} --retry")
        # the exit code of a study in which a session failed
        raise typer.Exit(3)


def dashboard(
    study: Annotated[
        Path,
        typer.Argument(metavar="STUDY", help="A study's .toml file, or a folder of sessions."),
    ],
    host: Annotated[
        str,
        typer.Option("--host", help="Address to listen on; traffic is not encrypted."),
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port to listen on; 0: any free port.")
    ] = 8050,
    open_browser: Annotated[
        bool, typer.Option("--open", help="Open the page in the browser.")
    ] = False,
) -> None:
    """Open a study in the browser; Ctrl+C stops the server."""
    with progress_bar() as progress, ExitStack() as stack:

        def announce(address: str) -> None:
            """Print the dashboard's `address`, and open it if requested."""
            echo(f"dashboard: {address}   (Ctrl+C ends it)")
            if open_browser:  # by a file: other accounts can read a program's arguments
                folder = stack.enter_context(TemporaryDirectory(prefix="liex-"))
                webbrowser.open(page_that_opens(address, Path(folder)).as_uri())

        api.serve_dashboard(study, host=host, port=port, echo=announce, progress=progress)


def page_that_opens(address: str, folder: Path) -> Path:
    """Write a page that redirects to an address; returns its path.

    Args:
        address: the target, which includes a secret.
        folder: a folder that only this account can read.
    """
    page = folder / "dashboard.html"
    page.write_text(f'<meta http-equiv="refresh" content="0;url={escape(address)}">')
    return page


def verify(
    session: SessionPath,
    recording: Annotated[
        Path | None,
        typer.Option("--recording", help="Measure this recording again and compare the tables."),
    ] = None,
) -> None:
    """Check a session's files and, with --recording, whether re-running reproduces its tables."""
    with progress_bar() as progress:
        findings = api.verify_session(session, recording, progress=progress)
    for finding in findings:
        echo(f"{finding.state:6}{finding.sentence}")
    if any(finding.state == "wrong" for finding in findings):
        raise typer.Exit(1)


def _print_study(standings: list[SessionStatus], all_of_them: bool) -> int:
    """Print sessions that are not done, and the number in each state.

    Returns the number of sessions that failed or whose recording is missing.
    """
    from liex_lab.pipelines.study.status import to_check

    counts = Counter(one.in_words for one in standings)
    for one in standings:
        if one.missing:
            gone = (
                f"there is no recording {one.session.recording}; correct its path, or copy it there"
            )
            echo(f"{'missing':9}{one.session.id}  {gone}")
        elif one.state == "done" and one.reason:
            echo(f"{'done':9}{one.session.id}  {one.reason}")
        elif all_of_them or one.state not in ("done", "excluded"):
            remedy = f"; {one.failure['remedy']}" if one.failure and one.state == "failed" else ""
            echo(f"{one.state:9}{one.session.id}  {one.reason}{remedy}".rstrip())
    remarks = [one.session.remark for one in standings if one.state not in ("failed", "excluded")]
    for remark in dict.fromkeys(filter(None, [*remarks, *to_check(standings)])):
        echo(remark)
    echo(
        f"{len(standings)} session{'' if len(standings) == 1 else 's'}: "
        + ", ".join(f"{n} {state}" for state, n in sorted(counts.items()))
    )
    return counts["failed"] + counts["recording missing"]
