"""`liex`: the table of commands. Jobs are imported on demand, so that `liex --help` is fast."""

from __future__ import annotations

import atexit
import errno
import gc
import os
import shlex
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

import liex_lab
from liex_lab.cli.correct import correct, describe
from liex_lab.cli.models import evaluate, train
from liex_lab.cli.options import (
    MODELS,
    RECORDINGS,
    SESSIONS,
    START,
    STUDIES,
    JsonFile,
    OutFolder,
    PlanName,
    RecordingPath,
    SessionPath,
    Settings,
    TopicName,
    WhichPlan,
    group_of_verbs,
    region_setting,
    say,
    tell_numbers,
    to_json,
)
from liex_lab.cli.sessions import compare, convert, export, figures, pack, report, show
from liex_lab.cli.study import cohort, dashboard, verify
from liex_lab.errors import LiexError, MisfitError, printable
from liex_lab.runtime.memory import why_short
from liex_lab.runtime.places import is_full, why_full
from liex_lab.runtime.processes import Ended, ending
from liex_lab.runtime.progress import progress_bar

if TYPE_CHECKING:
    from liex_lab.pipelines.arenas import ArenaOutcome

# exit code of internal errors (EX_SOFTWARE); errors that the user can correct are 1, usage errors 2
FAULT = 70
_USERS_TO_MEND = {
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENAMETOOLONG,
    errno.ENOTDIR,
}
# hide Rerun's messages about a full disk, as ours replaces them
_RUST_LOG = "warn,re_log_encoding=off,re_sdk=off"

app = group_of_verbs(
    "Depth recordings of animals in; 3D skeletons, a replay and behaviour tables out.", name="liex"
)
app.add_typer(evaluate, name="evaluate", rich_help_panel=MODELS)
app.add_typer(correct, name="correct", rich_help_panel=SESSIONS)
app.command(rich_help_panel=SESSIONS)(describe)
app.command(rich_help_panel=SESSIONS)(report)
app.command(rich_help_panel=SESSIONS)(figures)
app.command(rich_help_panel=SESSIONS)(verify)
app.command(rich_help_panel=SESSIONS)(export)
app.command(rich_help_panel=STUDIES)(cohort)
app.command(rich_help_panel=STUDIES)(compare)
app.command(rich_help_panel=STUDIES)(dashboard)


def _version(wanted: bool) -> None:
    if wanted:
        say(f"liex_lab {liex_lab.__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Depth recordings of animals in; 3D skeletons, a replay and behaviour tables out."""


@app.command(rich_help_panel=START)
def demo(out: OutFolder = Path()) -> None:
    """Measure the bundled sample recording, to see the results."""
    from liex_lab.api import export_video, run_demo

    with progress_bar() as progress:
        session = run_demo(out, progress=progress)
        try:
            video = f"video:   {export_video(session, progress=progress)}"
        except LiexError as error:  # the session is complete without it
            video = f"note: there is no video, for {error}"
    _tell_session(session, video)


@app.command(rich_help_panel=START)
def run(
    recording: RecordingPath,
    plan: WhichPlan = None,
    out: OutFolder = Path(),
    topic: TopicName = None,
    settings: Settings = None,
    no_depth: Annotated[
        bool, typer.Option("--no-depth", help="Leave depth images out of the replay.")
    ] = False,
    candidates: Annotated[
        bool,
        typer.Option(
            "--candidates", help="Put every candidate pose of single frames into the replay."
        ),
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a session that is already there.")
    ] = False,
    workers: Annotated[
        int,
        typer.Option(
            "--workers",
            min=0,
            help="Processes that share a long recording; 0: one for every two cores, four at most, "
            "for more than 6,000 frames. The tables are the same.",
        ),
    ] = 1,
    accept: Annotated[
        bool,
        typer.Option(
            "--accept", help="Measure even if the recording does not fit the plan's animal."
        ),
    ] = False,
) -> None:
    """Turn a recording into a session folder: poses, behaviour tables, replay, report.

    Ends with one line on how it went; exit code 4 means: check this result.
    Several arenas in one picture (`[[arenas]]` of the plan, or --set arenas=auto) become a session
    each.
    """
    from liex_lab.plan import Plan

    asked = [] if topic is None else [f"recording.topic={topic}"]
    asked += ["replay.depth=none"] * no_depth + ["replay.candidates=true"] * candidates
    asked += [*["estimation.accept_misfit=true"] * accept, *(settings or [])]
    # first: report a wrong plan or setting at once
    chosen = Plan.load(plan or "mouse").with_settings(asked)
    from liex_lab.api import run_arenas, run_session

    measure = run_session if chosen.arenas is None else run_arenas
    with progress_bar() as progress:
        measured = measure(
            recording,
            chosen if plan else None,
            out,
            settings=() if plan else asked,
            overwrite=overwrite,
            workers=workers,
            progress=progress,
        )
    if isinstance(measured, Path):
        _tell_session(measured)
    else:
        _tell_arenas(measured)


@app.command(rich_help_panel=START)
def doctor(
    recording: RecordingPath,
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
    fps: Annotated[
        float | None, typer.Option("--fps", help="Frames per second, where the file has no times.")
    ] = None,
    topic: TopicName = None,
    region: Annotated[
        str | None,
        typer.Option(
            "--region",
            metavar='"X,Y X,Y ..."',
            help="Use only the inside of this polygon, corners in pixels, or 'circle X,Y R'; a "
            "last word mm: millimetres on the floor.",
        ),
    ] = None,
    plan: WhichPlan = None,
    settings: Settings = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Print lens, sensor and scene as well.")
    ] = False,
) -> None:
    """Report what a recording contains, what is wrong with it, and which plan fits."""
    from liex_lab.plan import Plan

    asked = [*(settings or []), *region_setting(region)]
    chosen = Plan.load(plan or "mouse").with_settings(asked)
    stated = [*asked, *([] if fps is None else [f"recording.fps={fps}"])]
    options = [] if topic is None else ["--topic", topic]
    options += [word for setting in stated for word in ("--set", setting)]
    from liex_lab.pipelines.doctor import examine, print_report

    with progress_bar() as progress:
        findings = examine(
            recording,
            plan=chosen,
            fps=fps,
            topic=topic,
            propose=True,
            named=plan is not None,
            typed=(plan, options),
            progress=progress,
        )
    if as_json:
        say(to_json(findings))
    else:
        print_report(findings, verbose)


app.command(rich_help_panel=RECORDINGS)(convert)
app.command(rich_help_panel=RECORDINGS)(pack)


app.command(rich_help_panel=MODELS)(train)


@app.command(rich_help_panel=SESSIONS)
def suggest(
    session: SessionPath,
    model: Annotated[
        str | None, typer.Option("--actions", metavar="FILE", help="An action model, .skops.")
    ] = None,
    n: Annotated[int, typer.Option("--n", min=1, help="Number of suggestions.")] = 10,
    video: Annotated[bool, typer.Option("--video", help="Make a clip of each.")] = False,
) -> None:
    """List the parts of a session that are most worth labelling: where the recogniser is least
    certain.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from liex_lab.pipelines.training.action_model import suggest as job
    from liex_lab.sessions import Session
    from liex_lab.sessions.session import found_video, stretch

    rows = list(job(session, model=model, n=n).itertuples())
    if video:
        from liex_lab.api import export_video

        for row in rows:
            export_video(session, start_s=row.start_s, stop_s=row.stop_s, overwrite=True)
    opened = Session.open(session)
    table = Table("from (s)", "to (s)", "taken for", "or else", "doubt", "clip")
    for row in rows:
        numbers = (f"{row.start_s:.2f}", f"{row.stop_s:.2f}", f"{row.uncertainty:.2f}")
        words = (Text(printable(row.guess)), Text(printable(row.or_else)))
        clip = found_video(opened, stretch(row.start_s, row.stop_s))
        name = Text("" if clip is None else printable(clip.name))
        table.add_row(*numbers[:2], *words, numbers[2], name)
    Console().print(table)


@app.command(rich_help_panel=RECORDINGS)
def live(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="A file or folder being written, or HOST:PORT.")
    ],
    plan: PlanName = "mouse",
    settings: Settings = None,
    replay: Annotated[
        bool, typer.Option("--replay", help="Send a finished recording at its own pace.")
    ] = False,
    to: Annotated[
        str, typer.Option("--to", help="viewer, the address of one, or a file .rrd.")
    ] = "viewer",
    patience_s: Annotated[
        float,
        typer.Option(
            "--patience-s", min=0.1, help="Stop after this many seconds without a new frame."
        ),
    ] = 3.0,
    json_file: JsonFile = None,
) -> None:
    """Show skeletons in Rerun during a recording, and measure their latency."""
    from liex_lab.plan import Plan

    chosen = Plan.load(plan).with_settings(settings or [])
    from liex_lab.api import follow_live

    with progress_bar() as progress:
        result = follow_live(
            source, chosen, replay=replay, to=to, patience_s=patience_s, progress=progress
        )
    tell_numbers(result, json_file)
    if not result["n_live"]:
        say(
            "no latency: frames that came while background, floor and size were learned were still "
            "being made up for when the recording was over"
        )
    if to.endswith(".rrd"):
        say(f"replay: {to}; Rerun's viewer opens it: rerun {to}")


app.command(rich_help_panel=START)(show)


@app.command(rich_help_panel=MODELS)
def info(
    plan: Annotated[
        str | None, typer.Option("--plan", help="Print this plan, to copy and change it.")
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Show every package, and every line of the models' cards.")
    ] = False,
) -> None:
    """Show versions, bundled plans and models; `liex info --plan mouse > my-plan.toml` copies a
    plan.
    """
    from liex_lab.plan import Plan, known_plans

    if plan is not None:
        typer.echo(Plan.load(plan).to_toml(), nl=False)
        return
    from liex_lab.catalog import bundled_models
    from liex_lab.sessions.provenance import versions

    facts: dict[str, Any] = versions()
    if not everything:
        facts = {name: facts[name] for name in ("liex_lab", "python")}
    facts["plans"] = ", ".join(known_plans())
    models = bundled_models()
    facts["models"] = ", ".join(models) or "none"
    if not everything:
        facts |= {
            f"model {name}": f"sha256 {str(card.get('sha256', 'unknown'))[:16]}"
            for name, card in models.items()
        }
        tell_numbers(facts, None)
        say("`liex info --all` lists every package and how the models were made")
        return
    facts |= {
        f"model {name}: {key}": value
        for name, card in models.items()
        for key, value in card.items()
    }
    tell_numbers(facts, None)


def main() -> None:
    """Run the command line.

    Errors that the user can correct are one sentence with exit code 1; internal errors show a
    traceback.
    """
    os.environ.setdefault("RUST_LOG", _RUST_LOG)
    atexit.register(gc.freeze)  # else two collections at exit take a second
    if told := liex_lab._KERNELS_TOLD:
        typer.echo(f"note: {printable(told)}", err=True)
    try:
        with ending():
            app()
    except Ended as ended:
        _fail(str(ended), ended.exit_code)
    except LiexError as error:
        _fail(str(error), error.exit_code)
    except OSError as error:
        if is_full(error):
            _fail(f"{why_full(error)}; make room there and run the same command again")
        if error.errno not in _USERS_TO_MEND:
            _fault(error)
        where = f" {error.filename}" if error.filename else ""
        _fail(
            f"the system refused{where}: {error.strerror}; make room, correct the permissions or "
            "name another place"
        )
    except Exception as error:
        _fault(error)


def _fail(sentence: str, code: int = 1) -> NoReturn:
    typer.secho(f"liex: {printable(sentence)}", fg=typer.colors.RED, err=True)
    sys.exit(code)


def _fault(error: Exception) -> NoReturn:
    if short := why_short(error):
        _fail(short)
    traceback.print_exc()
    _fail("this is a fault of liex_lab and not of yours; please report the lines above", FAULT)


def _tell_arenas(outcomes: Sequence[ArenaOutcome]) -> None:
    """Print the result of each arena; exits with the largest of their exit codes."""
    code = 0
    for one in outcomes:
        say(f"arena {one.name}")
        if one.error is not None:
            typer.secho(f"liex: {printable(one.error)}", fg=typer.colors.RED, err=True)
            code = max(code, one.error.exit_code)
        if one.session is not None:
            code = max(code, _told_session(one.session))
    if code:
        raise typer.Exit(code)


def _tell_session(session: Path, further: str = "") -> None:
    """Print the session's path and result; exits with code 4 if the session needs review."""
    if code := _told_session(session, further):
        raise typer.Exit(code)


def _told_session(session: Path, further: str = "") -> int:
    """Print the session's path and result; returns the exit code."""
    from liex_lab.sessions.folder import folder_bytes, megabytes, taken_from
    from liex_lab.sessions.verdict import read_verdict

    say(f"session: {session}")
    if copy := taken_from(session):
        say(f"note: the corrections of {copy} were taken over; see `liex correct list`")
    report = session / "report.html"
    if report.is_file():
        say(f"report:  {report}")
        say(f"figures: {session / 'figures'}")
    say(f"replay:  liex show {shlex.quote(str(session))}")
    say(f"on disk: {megabytes(folder_bytes(session))}")
    if further:
        say(further)
    verdict = read_verdict(session)
    if verdict["sentence"]:
        colour = typer.colors.YELLOW if verdict["look_at_it"] else None
        typer.secho(f"result:  {printable(verdict['sentence'])}", fg=colour)
    return MisfitError.exit_code if verdict["look_at_it"] and not verdict["accepted"] else 0
