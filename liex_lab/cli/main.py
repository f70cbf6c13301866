"""`liex`: a table of verbs. Each brings its job along when it is asked for, so that `liex --help`
stays quick.
"""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import traceback
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

import liex_lab
from liex_lab.cli.correct import correct, describe
from liex_lab.cli.evaluate import evaluate
from liex_lab.cli.options import (
    JsonFile,
    OutFolder,
    PlanName,
    RecordingPath,
    SessionPath,
    Settings,
    TopicName,
    VariantName,
    WhichPlan,
    keep_numbers,
    region_setting,
    tell_numbers,
    tell_scores,
    to_json,
)
from liex_lab.cli.results import compare, export, report
from liex_lab.cli.sections import MODELS, RECORDINGS, SESSIONS, START, STUDIES, group_of_verbs
from liex_lab.cli.study import cohort, dashboard, verify
from liex_lab.errors import LiexError, MisfitError
from liex_lab.runtime.disk import is_full, why_full
from liex_lab.runtime.progress import progress_bar

# the exit code of our own faults (EX_SOFTWARE); what the user can put right is 1, a wrong call 2
FAULT = 70
_USERS_TO_MEND = {
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENAMETOOLONG,
    errno.ENOTDIR,
}
# what Rerun's writer says of a full disk is said by our own sentence
_RUST_LOG = "warn,re_log_encoding=off,re_sdk=off"

app = group_of_verbs(
    "Depth recordings of animals in; 3D skeletons, a replay and behaviour tables out.", name="liex"
)
app.add_typer(evaluate, name="evaluate", rich_help_panel=MODELS)
app.add_typer(correct, name="correct", rich_help_panel=SESSIONS)
app.command(rich_help_panel=SESSIONS)(describe)
app.command(rich_help_panel=SESSIONS)(report)
app.command(rich_help_panel=SESSIONS)(verify)
app.command(rich_help_panel=SESSIONS)(export)
app.command(rich_help_panel=STUDIES)(cohort)
app.command(rich_help_panel=STUDIES)(compare)
app.command(rich_help_panel=STUDIES)(dashboard)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"liex_lab {liex_lab.__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which.")
    ] = False,
) -> None:
    """Depth recordings of animals in; 3D skeletons, a replay and behaviour tables out."""


@app.command(rich_help_panel=START)
def demo(out: OutFolder = Path()) -> None:
    """Run the bundled sample recording, to see what comes out."""
    from liex_lab.api import run_demo

    with progress_bar() as progress:
        session = run_demo(out, progress=progress)
    _tell_session(session)


@app.command(rich_help_panel=START)
def run(
    recording: RecordingPath,
    plan: WhichPlan = None,
    out: OutFolder = Path(),
    topic: TopicName = None,
    settings: Settings = None,
    no_depth: Annotated[
        bool, typer.Option("--no-depth", help="A replay without the depth pictures.")
    ] = False,
    candidates: Annotated[
        bool,
        typer.Option(
            "--candidates", help="A replay with every pose that single frames thought possible."
        ),
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a session that is already there.")
    ] = False,
    workers: Annotated[
        int,
        typer.Option(
            "--workers",
            min=1,
            help="Processes that share a long recording; the tables are the same.",
        ),
    ] = 1,
    accept: Annotated[
        bool,
        typer.Option(
            "--accept", help="Measure it although it does not look like the plan's animal."
        ),
    ] = False,
) -> None:
    """Turn a recording into a session folder: poses, behaviour tables, replay, report.

    Ends with a line that says how it went, and with exit code 4 where someone has to look at it.
    """
    from liex_lab.plan import Plan

    asked = [] if topic is None else [f"recording.topic={topic}"]
    asked += ["replay.depth=false"] * no_depth + ["replay.candidates=true"] * candidates
    asked += [*["estimation.accept_misfit=true"] * accept, *(settings or [])]
    # first: a wrong plan or setting is told at once
    chosen = Plan.load(plan or "mouse").with_settings(asked)
    from liex_lab.api import run_session

    with progress_bar() as progress:
        session = run_session(
            recording,
            chosen if plan else None,
            out,
            settings=() if plan else asked,
            overwrite=overwrite,
            workers=workers,
            progress=progress,
        )
    _tell_session(session)


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
            help="Look only inside this polygon, corners in pixels.",
        ),
    ] = None,
    plan: WhichPlan = None,
    settings: Settings = None,
) -> None:
    """Say what is in a recording, what is wrong with it, and which plan fits."""
    from liex_lab.plan import Plan

    asked = [*(settings or []), *region_setting(region)]
    chosen = Plan.load(plan or "mouse").with_settings(asked)
    from liex_lab.pipelines.doctor import examine, print_report

    with progress_bar() as progress:
        findings = examine(
            recording,
            plan=chosen,
            fps=fps,
            topic=topic,
            propose=True,
            named=plan is not None,
            progress=progress,
        )
    if as_json:
        typer.echo(to_json(findings))
    else:
        print_report(findings)


@app.command(rich_help_panel=RECORDINGS)
def convert(
    recording: RecordingPath,
    to: Annotated[
        Path,
        typer.Option(
            "--to", metavar="TARGET", help="NAME.mcap, NAME.oni, or a folder for PNG pictures."
        ),
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
        bool, typer.Option("--ros", help="MCAP with ROS 2's messages instead of Foxglove's.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace what is there under this name.")
    ] = False,
) -> None:
    """Write a recording as MCAP (which keeps every depth), as .oni, or as a folder of 16-bit PNG
    pictures.
    """
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
    typer.echo(f"recording: {done.path} ({done.n_frames} frames)")
    for sentence in (*done.problems, *done.notes):
        typer.echo(f"note: {sentence}")


@app.command(rich_help_panel=MODELS)
def train(
    animal: Annotated[
        str,
        typer.Argument(
            metavar="ANIMAL", help="fish, mouse, hand, a skeleton's .toml; or: actions, tracking."
        ),
    ],
    variant: VariantName = "default",
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="The model file, .npz (of actions: .skops)."),
    ] = None,
    workers: Annotated[
        int, typer.Option("--workers", min=0, help="CPU cores to use; 0: all of them.")
    ] = 0,
    n_images: Annotated[
        int | None,
        typer.Option("--images", min=512, help="Pictures to train on, for a quick look."),
    ] = None,
    of: Annotated[
        str, typer.Option("--animal", help="Of `train actions` and `tracking`: which animal.")
    ] = "mouse",
    sessions: Annotated[
        list[Path] | None,
        typer.Option("--session", help="Of `train actions`: a labelled session; repeatable."),
    ] = None,
    labels: Annotated[
        list[Path] | None,
        typer.Option(
            "--labels",
            metavar="FILE",
            help="Of `train actions`: .csv, .parquet, or .boris; repeatable.",
        ),
    ] = None,
    pose_model: Annotated[
        str | None,
        typer.Option(
            "--model", metavar="FILE", help="Of `train actions`: the model that measures poses."
        ),
    ] = None,
    particles: Annotated[
        bool,
        typer.Option(
            "--particles",
            help="Of `train tracking`: search the noise of the paper's Algorithm 3 instead.",
        ),
    ] = False,
    json_file: JsonFile = None,
) -> None:
    """Make an animal's model from rendered pictures, the same again, byte for byte, whenever it is
    run.

    `liex train actions` makes the model that names actions: from sessions that people labelled, or,
    without any, from virtual animals that act. `liex train tracking` measures how far off an
    animal's tracks may be (tunings.toml).
    """
    if animal == "actions":
        from liex_lab.pipelines.training.action_model import train_actions

        with progress_bar() as progress:
            model, report = train_actions(
                out or Path(f"{of}-actions.skops"),
                animal=of,
                sessions=sessions or (),
                labels=labels or (),
                pose_model=pose_model,
                progress=progress,
            )
        if json_file is not None:
            keep_numbers(report, json_file)
        tell_scores(report)
        typer.echo(f"model: {model}")
        return
    if animal == "tracking" and particles:
        from liex_lab.pipelines.evaluation.paper.algorithm3 import search_noise

        with progress_bar() as progress:
            found = search_noise(of, progress=progress)
        tell_numbers(found, json_file or out)
        return
    if animal == "tracking":
        from liex_lab.pipelines.training.motion_model import train_tracking

        with progress_bar() as progress:
            table = train_tracking(
                of, out or Path("tunings.toml"), workers=workers, progress=progress
            )
        typer.echo(f"tunings: {table}")
        return
    from liex_lab.pipelines.training.pose_model import train_model

    with progress_bar() as progress:
        path = out or Path(f"{Path(animal).stem}.npz")
        model = train_model(
            animal, variant, path, workers=workers, n_images=n_images, progress=progress
        )
    typer.echo(f"model: {model}")


@app.command(rich_help_panel=SESSIONS)
def suggest(
    session: SessionPath,
    model: Annotated[
        str | None, typer.Option("--actions", metavar="FILE", help="An action model, .skops.")
    ] = None,
    n: Annotated[int, typer.Option("--n", min=1, help="How many stretches.")] = 10,
) -> None:
    """List the stretches of a session most worth labelling next: where the recogniser is least
    sure.
    """
    from rich.console import Console
    from rich.table import Table

    from liex_lab.pipelines.training.action_model import suggest as job

    table = Table("from (s)", "to (s)", "taken for", "or else", "doubt")
    for row in job(session, model=model, n=n).itertuples():
        numbers = (f"{row.start_s:.2f}", f"{row.stop_s:.2f}", f"{row.uncertainty:.2f}")
        table.add_row(*numbers[:2], str(row.guess), str(row.or_else), numbers[2])
    Console().print(table)


@app.command(rich_help_panel=RECORDINGS)
def live(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="A file or folder being written, or HOST:PORT.")
    ],
    plan: PlanName = "mouse",
    settings: Settings = None,
    replay: Annotated[
        bool, typer.Option("--replay", help="Send a whole recording at its own pace.")
    ] = False,
    to: Annotated[
        str, typer.Option("--to", help="viewer, the address of one, or a file .rrd.")
    ] = "viewer",
    patience_s: Annotated[
        float, typer.Option("--patience-s", min=0.1, help="It is over after so long a wait.")
    ] = 3.0,
    json_file: JsonFile = None,
) -> None:
    """Show skeletons while a recording goes on, in Rerun, and say how late they were."""
    from liex_lab.plan import Plan

    chosen = Plan.load(plan).with_settings(settings or [])
    from liex_lab.api import follow_live

    with progress_bar() as progress:
        result = follow_live(
            source, chosen, replay=replay, to=to, patience_s=patience_s, progress=progress
        )
    tell_numbers(result, json_file)


@app.command(rich_help_panel=START)
def show(
    session: SessionPath,
    web: Annotated[
        bool, typer.Option("--web", help="In the browser, where Rerun calls tel.rerun.io.")
    ] = False,
    at_s: Annotated[
        float | None, typer.Option("--at", metavar="S", min=0.0, help="Open it at this time.")
    ] = None,
) -> None:
    """Open a session's replay in Rerun."""
    from liex_lab.sessions import Session
    from liex_lab.sessions.viewer import has_screen, replays_with, show_replay

    replay = Session.open(session).path / "session.rrd"
    if at_s is not None:
        if web:
            raise typer.BadParameter(
                "a moment can be shown in a window only; leave out --web or --at"
            )
        show_replay(replay, at_s).wait()
        return
    if not web and not has_screen():
        raise LiexError(
            f"Rerun needs a screen and there is none here; open {replay} on a computer that has "
            "one, or add --web"
        )
    # RERUN_ANALYTICS: what a laboratory looks at is nobody else's business; the viewer in a browser
    # does not heed it
    if web:
        typer.echo(
            "Rerun's viewer in the browser calls tel.rerun.io, its makers' count of uses; the "
            "window does not"
        )
    shown = [str(file) for file in replays_with(replay)]
    command = [
        sys.executable,
        "-m",
        "rerun",
        *shown,
        "--bind",
        "127.0.0.1",
        *(["--web-viewer"] if web else []),
    ]
    raise typer.Exit(
        subprocess.run(command, env={**os.environ, "RERUN_ANALYTICS": "0"}, check=False).returncode
    )


@app.command(rich_help_panel=MODELS)
def info(
    plan: Annotated[
        str | None, typer.Option("--plan", help="Print this plan, to copy and change it.")
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Every package, and every line of the models' cards.")
    ] = False,
) -> None:
    """Versions, bundled plans and models; `liex info --plan mouse > my-plan.toml` makes a plan of
    your own.
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
        typer.echo("`liex info --all` lists every package and how the models were made")
        return
    facts |= {
        f"model {name}: {key}": value
        for name, card in models.items()
        for key, value in card.items()
    }
    tell_numbers(facts, None)


def main() -> None:
    """The command line. What the user can put right is one sentence and exit code 1; a fault of
    ours shows itself.
    """
    os.environ.setdefault("RUST_LOG", _RUST_LOG)
    try:
        app()
    except LiexError as error:
        _fail(str(error), error.exit_code)
    except OSError as error:
        if is_full(error):
            _fail(f"{why_full(error)}; make room there and run the same command again")
        if error.errno not in _USERS_TO_MEND:
            _fault()
        where = f" {error.filename}" if error.filename else ""
        _fail(
            f"the system refused{where}: {error.strerror}; make room, correct the permissions or "
            "name another place"
        )
    except Exception:
        _fault()


def _fail(sentence: str, code: int = 1) -> NoReturn:
    typer.secho(f"liex: {sentence}", fg=typer.colors.RED, err=True)
    sys.exit(code)


def _fault() -> NoReturn:
    traceback.print_exc()
    _fail("this is a fault of liex_lab and not of yours; please report the lines above", FAULT)


def _tell_session(session: Path) -> None:
    """Where the session is, and how it went; exit code 4 where someone has to look at it."""
    from liex_lab.sessions.older import taken_from
    from liex_lab.sessions.verdict import read_verdict

    typer.echo(f"session: {session}")
    if copy := taken_from(session):
        typer.echo(f"note: the corrections of {copy} were taken over; see `liex correct list`")
    report = session / "report.html"
    if report.is_file():
        typer.echo(f"report:  {report}")
    typer.echo(f"replay:  liex show {session}")
    verdict = read_verdict(session)
    if verdict["sentence"]:
        colour = typer.colors.YELLOW if verdict["look_at_it"] else None
        typer.secho(f"result:  {verdict['sentence']}", fg=colour)
    if verdict["look_at_it"] and not verdict["accepted"]:
        raise typer.Exit(MisfitError.exit_code)
