"""`liex`: a table of verbs. Each brings its job along when it is asked for, so that `liex --help` stays quick."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import traceback
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

import liex_lab
from liex_lab.cli_correct import correct
from liex_lab.cli_results import compare, export, report
from liex_lab.cli_study import cohort, dashboard, scale, verify
from liex_lab.errors import LiexError
from liex_lab.progress import progress_bar

FAULT = 70  # the exit code of our own faults (EX_SOFTWARE); what the user can put right is 1, a wrong call 2
_USERS_TO_MEND = {errno.EACCES, errno.EPERM, errno.ENOSPC, errno.EROFS, errno.EDQUOT, errno.ENAMETOOLONG, errno.ENOTDIR}

app = typer.Typer(
    name="liex",
    help="Depth recordings of animals in; 3D skeletons, a replay and behaviour tables out.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
evaluate = typer.Typer(help="Measure the method; --json FILE keeps the numbers.", no_args_is_help=True)
app.add_typer(evaluate, name="evaluate")
app.add_typer(correct, name="correct")
app.command()(cohort)
app.command()(dashboard)
app.command()(verify)
evaluate.command("scale")(scale)
app.command()(compare)
app.command()(export)
app.command()(report)

RecordingPath = Annotated[Path, typer.Argument(metavar="RECORDING", help="A file, a folder, or synthetic:walk.")]
SessionPath = Annotated[Path, typer.Argument(metavar="SESSION", help="A session folder, NAME.liex.")]
PlanName = Annotated[str, typer.Option("--plan", help="A bundled plan (`liex info` lists them), or a .toml file.")]
OutFolder = Annotated[Path, typer.Option("--out", metavar="DIR", help="The folder in which NAME.liex is made.")]
TopicName = Annotated[
    str | None, typer.Option("--topic", help="The topic of an MCAP file or ROS bag, where several hold depth.")
]
Settings = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a value of the plan; repeatable.")
]
AnimalName = Annotated[str, typer.Option("--animal", help="fish, mouse, hand, or a skeleton's .toml file.")]
VariantName = Annotated[str, typer.Option("--variant", help="default, or paper: as the paper describes it.")]
RowName = Annotated[str, typer.Option("--variant", help="default, paper, paper-one-pose, paper-no-metric, rf or cnn.")]
JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the numbers into this file.")]


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"liex_lab {liex_lab.__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which.")] = False,
) -> None:
    """Depth recordings of animals in; 3D skeletons, a replay and behaviour tables out."""


@app.command()
def demo(out: OutFolder = Path()) -> None:
    """Run the bundled sample recording, to see what comes out."""
    from liex_lab.api import run_demo

    with progress_bar() as progress:
        session = run_demo(out, progress=progress)
    _tell_session(session)


@app.command()
def run(
    recording: RecordingPath,
    plan: PlanName = "mouse",
    out: OutFolder = Path(),
    topic: TopicName = None,
    settings: Settings = None,
    no_depth: Annotated[bool, typer.Option("--no-depth", help="A replay without the depth pictures.")] = False,
    candidates: Annotated[
        bool, typer.Option("--candidates", help="A replay with every pose that single frames thought possible.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a session that is already there.")] = False,
    workers: Annotated[
        int, typer.Option("--workers", min=1, help="Processes that share a long recording; the tables are the same.")
    ] = 1,
) -> None:
    """Turn a recording into a session folder: poses, behaviour tables, replay, report."""
    from liex_lab.plan import Plan

    asked = [] if topic is None else [f"recording.topic={topic}"]
    asked += ["replay.depth=false"] * no_depth + ["replay.candidates=true"] * candidates
    chosen = Plan.load(plan).with_settings([*asked, *(settings or [])])  # first: a wrong plan is told at once
    from liex_lab.api import run_session

    with progress_bar() as progress:
        session = run_session(recording, chosen, out, overwrite=overwrite, workers=workers, progress=progress)
    _tell_session(session)


@app.command()
def doctor(
    recording: RecordingPath,
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
    fps: Annotated[float | None, typer.Option("--fps", help="Frames per second, where the file has no times.")] = None,
    topic: TopicName = None,
    plan: PlanName = "mouse",
    settings: Settings = None,
) -> None:
    """Say what is in a recording and what is wrong with it. Needs no model."""
    from liex_lab.plan import Plan

    chosen = Plan.load(plan).with_settings(settings or [])
    from liex_lab.pipelines.doctor import examine, print_report

    with progress_bar() as progress:
        findings = examine(recording, plan=chosen, fps=fps, topic=topic, progress=progress)
    if as_json:
        typer.echo(_json(findings))
    else:
        print_report(findings)


@app.command()
def convert(
    recording: RecordingPath,
    to: Annotated[
        Path, typer.Option("--to", metavar="TARGET", help="NAME.mcap, NAME.oni, or a folder for PNG pictures.")
    ],
    fps: Annotated[float | None, typer.Option("--fps", help="Frames per second, where the file has no times.")] = None,
    topic: TopicName = None,
    step_mm: Annotated[
        float | None, typer.Option("--step-mm", min=0.001, help="Round depth to steps of this size; not for MCAP.")
    ] = None,
    ros: Annotated[bool, typer.Option("--ros", help="MCAP with ROS 2's messages instead of Foxglove's.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is there under this name.")] = False,
) -> None:
    """Write a recording as MCAP (which keeps every depth), as .oni, or as a folder of 16-bit PNG pictures."""
    from liex_lab.pipelines.convert import convert as job

    with progress_bar() as progress:
        done = job(
            recording, to, fps=fps, topic=topic, step_mm=step_mm, ros=ros, overwrite=overwrite, progress=progress
        )
    typer.echo(f"recording: {done.path} ({done.n_frames} frames)")
    for sentence in (*done.problems, *done.notes):
        typer.echo(f"note: {sentence}")


@app.command()
def train(
    animal: Annotated[
        str, typer.Argument(metavar="ANIMAL", help="fish, mouse, hand, a skeleton's .toml; or: actions, tracking.")
    ],
    variant: VariantName = "default",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="The model file, .npz (of actions: .skops).")
    ] = None,
    workers: Annotated[int, typer.Option("--workers", min=0, help="CPU cores to use; 0: all of them.")] = 0,
    n_images: Annotated[
        int | None, typer.Option("--images", min=512, help="Pictures to train on, for a quick look.")
    ] = None,
    of: Annotated[str, typer.Option("--animal", help="Of `train actions` and `tracking`: which animal.")] = "mouse",
    sessions: Annotated[
        list[Path] | None, typer.Option("--session", help="Of `train actions`: a labelled session; repeatable.")
    ] = None,
    labels: Annotated[
        list[Path] | None,
        typer.Option("--labels", metavar="FILE", help="Of `train actions`: .csv, .parquet, or .boris; repeatable."),
    ] = None,
    pose_model: Annotated[
        str | None, typer.Option("--model", metavar="FILE", help="Of `train actions`: the model that measures poses.")
    ] = None,
) -> None:
    """Make an animal's model from rendered pictures, the same again, byte for byte, whenever it is run.

    `liex train actions` makes the model that names actions: from sessions that people labelled, or, without any, from
    virtual animals that act. `liex train tracking` finds what the tracker believes of an animal.
    """
    if animal == "actions":
        from liex_lab.pipelines.actions import train_actions

        with progress_bar() as progress:
            model, report = train_actions(
                out or Path(f"{of}-actions.skops"), animal=of, sessions=sessions or (), labels=labels or (),
                pose_model=pose_model, progress=progress,
            )  # fmt: skip
        if report:
            _tell_numbers(report, None)
        typer.echo(f"model: {model}")
        return
    if animal == "tracking":
        from liex_lab.pipelines.tracking_fit import train_tracking

        with progress_bar() as progress:
            table = train_tracking(of, out or Path(f"{of}-tracking.toml"), progress=progress)
        typer.echo(f"table for tunings.toml: {table}")
        return
    from liex_lab.pipelines.train import train_model

    with progress_bar() as progress:
        path = out or Path(f"{Path(animal).stem}.npz")
        model = train_model(animal, variant, path, workers=workers, n_images=n_images, progress=progress)
    typer.echo(f"model: {model}")


@evaluate.command("pose")
def evaluate_pose(
    animal: AnimalName = "mouse",
    split: Annotated[str, typer.Option("--split", help="clean, hard or other-body.")] = "clean",
    variant: RowName = "default",
    model: Annotated[str | None, typer.Option("--model", metavar="FILE", help="A model of your own, .npz.")] = None,
    n_frames: Annotated[int | None, typer.Option("--frames", min=1, help="Only this many frames of the split.")] = None,
    spine_mm: Annotated[
        float | None, typer.Option("--spine-mm", min=1.0, help="Render animals of this size instead of the split's.")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Joint errors on a fixed split of rendered test frames."""
    from liex_lab.pipelines.evaluate import evaluate_pose as measure

    with progress_bar() as progress:
        result = measure(animal, split, variant, model=model, n_frames=n_frames, spine_mm=spine_mm, progress=progress)
    _tell_numbers(result, json_file)


@evaluate.command("speed")
def evaluate_speed(
    animal: AnimalName = "mouse",
    recordings: Annotated[
        bool, typer.Option("--recordings", help="Measure how fast recordings of each format are read instead.")
    ] = False,
    json_file: JsonFile = None,
) -> None:
    """Frames per second on one and two cores, stage by stage, and the ratio to the paper's variant."""
    with progress_bar() as progress:
        if recordings:
            from liex_lab.pipelines.evaluate_recordings import evaluate_recordings

            result = evaluate_recordings(progress=progress)
        else:
            from liex_lab.pipelines.speed import evaluate_speed as measure

            result = measure(animal, progress=progress)
    _tell_numbers(result, json_file)


@evaluate.command("sizes")
def evaluate_sizes(
    animal: AnimalName = "mouse",
    n_frames: Annotated[
        int | None, typer.Option("--frames", min=1, help="Only this many frames for each size.")
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Joint errors of animals between 45 and 100 mm long, their size estimated and not given."""
    from liex_lab.pipelines.evaluate import evaluate_sizes as measure

    with progress_bar() as progress:
        result = measure(animal, n_frames=n_frames, progress=progress)
    _tell_numbers(result, json_file)


@evaluate.command("tables")
def evaluate_tables(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="The folder for tables and figures.")],
    animals: Annotated[
        list[str] | None, typer.Option("--animal", help="fish, mouse or hand; repeatable; all that have a model.")
    ] = None,
    n_frames: Annotated[
        int | None, typer.Option("--frames", min=1, help="Only this many frames of each split.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="See within minutes that everything runs; the numbers mean nothing.")
    ] = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Train and measure every row anew, which takes hours; use no kept result.")
    ] = False,
) -> None:
    """Every row of the paper's Tables 1 to 3 and its figures, measured now or kept from earlier."""
    from liex_lab.api import run_tables

    with progress_bar() as progress:
        written = run_tables(out, animals or (), n_frames=n_frames, quick=quick, fresh=fresh, progress=progress)
    for path in written:
        typer.echo(path)


@evaluate.command("actions")
def evaluate_actions(
    animal: AnimalName = "fish",
    model: Annotated[str | None, typer.Option("--actions", metavar="FILE", help="An action model, .skops.")] = None,
    pose_model: Annotated[
        str | None, typer.Option("--model", metavar="FILE", help="The model that measures poses, .npz.")
    ] = None,
    minutes: Annotated[float, typer.Option("--minutes", min=1.0, help="Of uncut test recordings.")] = 30.0,
    out: Annotated[Path | None, typer.Option("--out", metavar="DIR", help="Draw the confusion matrices there.")] = None,
    json_file: JsonFile = None,
) -> None:
    """Actions named: the paper's recogniser and ours, on cut-out sequences and on uncut recordings.

    The recordings are rendered and measured first, which takes about half an hour for all 30 minutes on two cores. What
    has been measured is kept in the cache folder (LIEX_CACHE), so that a job that was stopped goes on where it was.
    """
    from liex_lab.api import evaluate_actions as measure

    figure = None if out is None else out / f"{animal}_confusion.png"
    with progress_bar() as progress:
        result = measure(
            animal, model=model, pose_model=pose_model, minutes=minutes, figure=figure, progress=progress
        )
    _tell_numbers(result, json_file)


@evaluate.command("tracking")
def evaluate_tracking(
    animal: AnimalName = "mouse",
    sequence: Annotated[str, typer.Option("--sequence", help="easy or hard.")] = "hard",
    model: Annotated[str | None, typer.Option("--model", metavar="FILE", help="A model of your own, .npz.")] = None,
    n_frames: Annotated[int | None, typer.Option("--frames", min=40, help="A sequence of this many frames.")] = None,
    figure: Annotated[Path | None, typer.Option("--figure", metavar="PNG", help="Draw error over time.")] = None,
    json_file: JsonFile = None,
) -> None:
    """Joint errors over a sequence: single frames, Algorithm 3, and the default tracker online and smoothed."""
    from liex_lab.api import evaluate_tracking as measure

    with progress_bar() as progress:
        result = measure(animal, sequence, model=model, n_frames=n_frames, figure=figure, progress=progress)
    _tell_numbers(result, json_file)


@evaluate.command("live")
def evaluate_live(
    animal: AnimalName = "fish",
    n_frames: Annotated[int, typer.Option("--frames", min=200, help="So many are sent at the camera's pace.")] = 1500,
    json_file: JsonFile = None,
) -> None:
    """How late skeletons are while a virtual animal is filmed."""
    from liex_lab.pipelines.evaluate_live import evaluate_live as measure

    with progress_bar() as progress:
        result = measure(animal, n_frames=n_frames, progress=progress)
    _tell_numbers(result, json_file)


@evaluate.command("statistics")
def evaluate_statistics(
    n_studies: Annotated[int, typer.Option("--studies", min=20, help="Simulated studies of each kind.")] = 2000,
    effect: Annotated[
        float, typer.Option("--effect", help="Of the studies for the power, in sd between animals.")
    ] = 1.0,
    json_file: JsonFile = None,
) -> None:
    """How often the comparison of groups is wrong on studies without an effect, and how often it finds one."""
    from liex_lab.pipelines.evaluate_statistics import evaluate_statistics as measure

    with progress_bar() as progress:
        result = measure(n_studies, effect, progress=progress)
    _tell_numbers(result, json_file)


@evaluate.command("report")
def evaluate_report(
    session: SessionPath,
    minutes: Annotated[float, typer.Option("--minutes", min=1.0, help="Of the long session.")] = 60.0,
    json_file: JsonFile = None,
) -> None:
    """How long the report of a long session takes, and its memory: SESSION repeated until it is so long."""
    from liex_lab.pipelines.evaluate_report import evaluate_report as measure

    with progress_bar() as progress:
        result = measure(session, minutes, progress=progress)
    _tell_numbers(result, json_file)


@evaluate.command("nyu")
def evaluate_nyu(
    reference: Annotated[
        Path, typer.Option("--reference", metavar="DIR", help="Labels, published answers and frames of the NYU data.")
    ],
    model: Annotated[str | None, typer.Option("--model", help="A hand model of your own, .npz.")] = None,
    json_file: JsonFile = None,
) -> None:
    """Hands by the NYU protocol: 14 points, the root given and estimated; published answers and ours."""
    from liex_lab.pipelines.nyu import evaluate_nyu as measure
    from liex_lab.pipelines.nyu import in_short

    with progress_bar() as progress:
        result = measure(reference, model=model, progress=progress)
    _tell_numbers(in_short(result), None)
    if json_file is not None:
        _keep_numbers(result, json_file)


@evaluate.command("reference")
def evaluate_reference(
    session: SessionPath,
    reference: Annotated[
        Path, typer.Option("--reference", metavar="CSV", help="The reference's table, one row a frame.")
    ],
    json_file: JsonFile = None,
) -> None:
    """Compare a session with what another program measured in the same recording."""
    from liex_lab.pipelines.evaluate import evaluate_reference as measure

    _tell_numbers(measure(session, reference), json_file)


@app.command()
def suggest(
    session: SessionPath,
    model: Annotated[str | None, typer.Option("--actions", metavar="FILE", help="An action model, .skops.")] = None,
    n: Annotated[int, typer.Option("--n", min=1, help="How many stretches.")] = 10,
) -> None:
    """List the stretches of a session most worth labelling next: where the recogniser is least sure."""
    from liex_lab.pipelines.actions import suggest as job

    table = Table("from (s)", "to (s)", "taken for", "or else", "doubt")
    for row in job(session, model=model, n=n).itertuples():
        numbers = (f"{row.start_s:.2f}", f"{row.stop_s:.2f}", f"{row.uncertainty:.2f}")
        table.add_row(*numbers[:2], str(row.guess), str(row.or_else), numbers[2])
    Console().print(table)


@app.command()
def live(
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="A file or folder being written, or HOST:PORT.")],
    plan: PlanName = "mouse",
    settings: Settings = None,
    replay: Annotated[bool, typer.Option("--replay", help="Send a whole recording at its own pace.")] = False,
    to: Annotated[str, typer.Option("--to", help="viewer, the address of one, or a file .rrd.")] = "viewer",
    patience_s: Annotated[float, typer.Option("--patience-s", min=0.1, help="It is over after so long a wait.")] = 3.0,
    json_file: JsonFile = None,
) -> None:
    """Show skeletons while a recording goes on, in Rerun, and say how late they were."""
    from liex_lab.plan import Plan

    chosen = Plan.load(plan).with_settings(settings or [])
    from liex_lab.api import follow_live

    with progress_bar() as progress:
        result = follow_live(source, chosen, replay=replay, to=to, patience_s=patience_s, progress=progress)
    _tell_numbers(result, json_file)


@app.command()
def show(
    session: SessionPath,
    web: Annotated[bool, typer.Option("--web", help="Show it in the browser instead of a window.")] = False,
    at_s: Annotated[float | None, typer.Option("--at", metavar="S", min=0.0, help="Open it at this time.")] = None,
) -> None:
    """Open a session's replay in Rerun."""
    from liex_lab.sessions import Session
    from liex_lab.sessions.viewer import has_screen, replays_with, show_replay

    replay = Session.open(session).path / "session.rrd"
    if at_s is not None:
        if web:
            raise typer.BadParameter("a moment can be shown in a window only; leave out --web or --at")
        show_replay(replay, at_s).wait()
        return
    if not web and not has_screen():
        raise LiexError(
            f"Rerun needs a screen and there is none here; open {replay} on a computer that has one, or add --web"
        )
    # RERUN_ANALYTICS: what a laboratory looks at is nobody else's business
    shown = [str(file) for file in replays_with(replay)]
    command = [sys.executable, "-m", "rerun", *shown, "--bind", "127.0.0.1", *(["--web-viewer"] if web else [])]
    raise typer.Exit(subprocess.run(command, env={**os.environ, "RERUN_ANALYTICS": "0"}, check=False).returncode)


@app.command()
def info(
    plan: Annotated[str | None, typer.Option("--plan", help="Print this plan, to copy and change it.")] = None,
) -> None:
    """Versions, bundled plans and models; `liex info --plan mouse > my-plan.toml` makes a plan of your own."""
    from liex_lab.plan import Plan, known_plans

    if plan is not None:
        typer.echo(Plan.load(plan).to_toml(), nl=False)
        return
    from liex_lab.catalog import bundled_models
    from liex_lab.sessions.provenance import versions

    facts: dict[str, Any] = versions()
    facts["plans"] = ", ".join(known_plans())
    models = bundled_models()
    facts["models"] = ", ".join(models) or "none"
    facts |= {f"model {name}: {key}": value for name, card in models.items() for key, value in card.items()}
    _tell_numbers(facts, None)


def main() -> None:
    """The command line. What the user can put right is one sentence and exit code 1; a fault of ours shows itself."""
    try:
        app()
    except LiexError as error:
        _fail(str(error))
    except OSError as error:
        if error.errno not in _USERS_TO_MEND:
            _fault()
        where = f" {error.filename}" if error.filename else ""
        _fail(f"the system refused{where}: {error.strerror}; make room, correct the permissions or name another place")
    except Exception:
        _fault()


def _fail(sentence: str, code: int = 1) -> NoReturn:
    typer.secho(f"liex: {sentence}", fg=typer.colors.RED, err=True)
    sys.exit(code)


def _fault() -> NoReturn:
    traceback.print_exc()
    _fail("this is a fault of liex_lab and not of yours; please report the lines above", FAULT)


def _tell_session(session: Path) -> None:
    typer.echo(f"session: {session}")
    report = session / "report.html"
    if report.is_file():
        typer.echo(f"report:  {report}")
    typer.echo(f"replay:  liex show {session}")


def _tell_numbers(result: dict[str, Any], json_file: Path | None) -> None:
    """The numbers as a table on the screen, and as JSON where a file was named."""
    if json_file is not None:
        _keep_numbers(result, json_file)
    table = Table(show_header=False)
    for name, value in result.items():
        shown = f"{value:.4g}" if isinstance(value, float) else _json(value) if isinstance(value, dict) else str(value)
        table.add_row(name, Text(shown))
    Console().print(table)


def _keep_numbers(result: dict[str, Any], json_file: Path) -> None:
    json_file.parent.mkdir(parents=True, exist_ok=True)
    json_file.write_text(_json(result) + "\n", encoding="utf-8")


def _json(result: Any) -> str:
    from liex_lab.evaluation import plain

    return json.dumps(plain(result), indent=2, allow_nan=False, ensure_ascii=False)
