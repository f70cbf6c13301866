"""`liex`: the table of commands. Jobs are imported on demand, so that `liex --help` is fast."""

import atexit
import errno
import gc
import os
import shlex
import sys
import traceback
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

import liex_lab
from liex_lab import api
from liex_lab.cli.correct import correct, describe, sync
from liex_lab.cli.models import evaluate, train
from liex_lab.cli.options import (
    MODELS,
    RECORDINGS,
    SESSIONS,
    START,
    STUDIES,
    JsonFile,
    NamesFile,
    OutFolder,
    PlanName,
    RecordingPaths,
    SessionPath,
    Settings,
    TopicName,
    WhichPlan,
    as_one,
    command_group,
    echo,
    load_plan,
    print_numbers,
    print_table,
    region_setting,
    to_json,
    write_numbers,
)
from liex_lab.cli.sessions import (
    cohort,
    compare,
    convert,
    dashboard,
    export,
    figures,
    pack,
    report,
    show,
    verify,
)
from liex_lab.errors import LiexError, MisfitError, RecordingError, printable
from liex_lab.runtime import durable, memory, processes
from liex_lab.runtime.progress import logged, progress_bar

# exit code of internal errors (EX_SOFTWARE); errors that the user can correct are 1, usage errors 2
FAULT = 70
_USERS_TO_MEND = {
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENAMETOOLONG,
    errno.ENOTDIR,
}

app = command_group(
    "Measure animal behaviour in depth recordings: 3D skeletons, a replay and tables.", name="liex"
)
app.add_typer(evaluate, name="evaluate", rich_help_panel=MODELS)
app.add_typer(correct, name="correct", rich_help_panel=SESSIONS)
imports = command_group("Make sessions from the results of other programs.")
app.add_typer(imports, name="import", rich_help_panel=RECORDINGS)
for command, section in (
    (describe, SESSIONS),
    (sync, SESSIONS),
    (report, SESSIONS),
    (figures, SESSIONS),
    (verify, SESSIONS),
    (export, SESSIONS),
    (cohort, STUDIES),
    (compare, STUDIES),
    (dashboard, STUDIES),
    (convert, RECORDINGS),
    (pack, RECORDINGS),
    (train, MODELS),
    (show, START),
):
    app.command(rich_help_panel=section)(command)


def _version(wanted: bool) -> None:
    if wanted:
        echo(f"liex_lab {liex_lab.__version__}")
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
    """Measure animal behaviour in depth recordings: 3D skeletons, a replay and tables."""


@app.command(rich_help_panel=START)
def demo(out: OutFolder = Path()) -> None:
    """Measure the bundled sample recording."""
    with progress_bar() as progress:
        session = api.run_demo(out, progress=progress)
        try:
            video = f"video:   {api.export_video(session, progress=progress)}"
        except LiexError as error:  # the session is complete without it
            video = f"note: there is no video, for {error}"
    raise typer.Exit(_print_session(session, video))


@app.command(rich_help_panel=START)
def run(
    recordings: RecordingPaths,
    plan: WhichPlan = None,
    out: OutFolder = Path(),
    topic: TopicName = None,
    settings: Settings = None,
    no_depth: Annotated[
        bool, typer.Option("--no-depth", help="Omit depth images from the replay.")
    ] = False,
    candidates: Annotated[
        bool,
        typer.Option("--candidates", help="Add all pose hypotheses of each frame to the replay."),
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing session.")
    ] = False,
    workers: Annotated[
        int,
        typer.Option(
            "--workers",
            min=0,
            help="Processes for one long recording; 0: one per two cores, at most four, if it has "
            "more than 6,000 frames. The tables do not depend on it.",
        ),
    ] = 1,
    accept: Annotated[
        bool,
        typer.Option(
            "--accept", help="Measure even if the recording does not show the plan's animal."
        ),
    ] = False,
) -> None:
    """Measure a recording: write poses, behaviour tables, a replay and a report.

    The last line is the verdict; exits with code 4 if the session needs review. What was done is
    logged in NAME.log beside the session.
    Several arenas in one image (`[[arenas]]` of the plan, or --set arenas=auto) become one session
    each, and so do several animals in one arena (--set animal.count=2, or auto).
    """
    asked = [] if topic is None else [f"recording.topic={topic}"]
    asked += ["replay.depth=none"] * no_depth + ["replay.candidates=true"] * candidates
    asked += [*["estimation.accept_misfit=true"] * accept, *(settings or [])]
    # first: report a wrong plan or setting at once
    chosen = load_plan(plan, asked)
    alone = chosen.arenas is None and chosen.animal.count == 1
    measure = api.run_session if alone else api.run_arenas
    log = durable.inside(out, Path(recordings[0]).stem or "recording", ".log")
    title = f"liex_lab {liex_lab.__version__}: liex {shlex.join(sys.argv[1:])}"
    with progress_bar() as bar, logged(bar, log, title) as progress:
        measured = measure(
            as_one(recordings),
            chosen if plan else None,
            out,
            settings=() if plan else asked,
            overwrite=overwrite,
            workers=workers,
            progress=progress,
        )
    if isinstance(measured, Path):
        raise typer.Exit(_print_session(measured))
    codes = [0]
    for one in measured:
        echo(one.name if chosen.arenas is None else f"arena {one.name}")
        if one.error is not None:
            typer.secho(f"liex: {printable(one.error)}", fg=typer.colors.RED, err=True)
            codes.append(one.error.exit_code)
        if one.session is not None:
            codes.append(_print_session(one.session))
    raise typer.Exit(max(codes))


@imports.command("points")
def import_points(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="3D points, .csv, .nc, .mat or .npz.")
    ],
    plan: PlanName = "mouse",
    names: NamesFile = None,
    fps: Annotated[
        float | None, typer.Option("--fps", help="Frame rate of a file without times.")
    ] = None,
    individual: Annotated[
        str | None,
        typer.Option(
            "--individual", metavar="NAME", help="The only animal to read; default: all of them."
        ),
    ] = None,
    out: OutFolder = Path(),
    settings: Settings = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing session.")
    ] = False,
) -> None:
    """Make a session from 3D points of another program (Anipose, DANNCE, movement, CSV).

    It has poses, behaviour tables, a replay and a report; what needs depth is absent. Of a file
    with several animals in one arena, each becomes a session, with the interactions of all.
    """
    with progress_bar() as progress:
        sessions = api.import_animals(
            file,
            load_plan(plan, settings or []),
            out,
            names=names,
            fps=fps,
            individual=individual,
            overwrite=overwrite,
            progress=progress,
        )
    raise typer.Exit(max(_print_session(session) for session in sessions))


@app.command(rich_help_panel=START)
def doctor(
    recordings: RecordingPaths,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
    fps: Annotated[
        float | None, typer.Option("--fps", help="Frame rate of a recording without timestamps.")
    ] = None,
    topic: TopicName = None,
    region: Annotated[
        str | None,
        typer.Option(
            "--region",
            metavar='"X,Y X,Y ..."',
            help="Use only the inside of a polygon (corners in pixels) or of 'circle X,Y R'; "
            "append mm for millimetres on the floor.",
        ),
    ] = None,
    plan: WhichPlan = None,
    settings: Settings = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Also print lens, sensor and scene.")
    ] = False,
) -> None:
    """Report a recording's contents, its problems, and the plan that fits."""
    asked = [*(settings or []), *region_setting(region)]
    chosen = load_plan(plan, asked)
    stated = [*asked, *([] if fps is None else [f"recording.fps={fps}"])]
    options = [] if topic is None else ["--topic", topic]
    options += [word for setting in stated for word in ("--set", setting)]
    with progress_bar() as progress:
        findings = api.examine(
            as_one(recordings),
            plan=chosen,
            fps=fps,
            topic=topic,
            propose=True,
            named=plan is not None,
            typed=(plan, options),
            progress=progress,
        )
    if as_json:
        echo(to_json(findings))
    else:
        api.print_report(findings, verbose)


@app.command(rich_help_panel=SESSIONS)
def suggest(
    session: SessionPath,
    model: Annotated[
        str | None, typer.Option("--actions", metavar="FILE", help="Action model, .skops.")
    ] = None,
    n: Annotated[int, typer.Option("--n", min=1, help="Number of suggestions.")] = 10,
    video: Annotated[
        bool, typer.Option("--video", help="Write a video clip of each suggestion.")
    ] = False,
) -> None:
    """List the parts of a session to label next: those the recogniser is least sure of."""
    from liex_lab.sessions.session import found_video, stretch

    suggestions = list(api.suggest(session, model=model, n=n).itertuples())
    if video:
        for one in suggestions:
            api.export_video(session, start_s=one.start_s, stop_s=one.stop_s, overwrite=True)
    opened = liex_lab.Session.open(session)
    rows = []
    for one in suggestions:
        clip = found_video(opened, stretch(one.start_s, one.stop_s))
        span = (f"{one.start_s:.2f}", f"{one.stop_s:.2f}")
        rows.append(
            (
                *span,
                one.guess,
                one.or_else,
                f"{one.uncertainty:.2f}",
                "" if clip is None else clip.name,
            )
        )
    print_table(rows, "from (s)", "to (s)", "taken for", "or else", "doubt", "clip")


@app.command(rich_help_panel=RECORDINGS)
def live(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE", help="A file or folder that is being written, or HOST:PORT."
        ),
    ],
    plan: PlanName = "mouse",
    settings: Settings = None,
    replay: Annotated[
        bool, typer.Option("--replay", help="Play back a finished recording at its own pace.")
    ] = False,
    to: Annotated[
        str, typer.Option("--to", help="viewer, none, the address of a viewer, or an .rrd file.")
    ] = "viewer",
    patience_s: Annotated[
        float,
        typer.Option(
            "--patience-s", min=0.1, help="Stop after this many seconds without a new frame."
        ),
    ] = 3.0,
    rules: Annotated[
        list[str] | None,
        typer.Option(
            "--trigger",
            metavar="RULE",
            help="An action, in ZONE, or a condition on columns, as "
            '"speed_mm_s > 200 until speed_mm_s < 150"; repeatable.',
        ),
    ] = None,
    send: Annotated[
        list[str] | None,
        typer.Option(
            "--send",
            metavar="ADDRESS",
            help="Receiver of triggers: udp://HOST:PORT, zmq://HOST:PORT, lsl://NAME or "
            "serial:///dev/NAME; repeatable.",
        ),
    ] = None,
    for_s: Annotated[
        float | None,
        typer.Option(
            "--for-s",
            min=0.0,
            help="Trigger after the rule held so long, s; default: 0.1 for actions, else 0.",
        ),
    ] = None,
    refractory_s: Annotated[
        float,
        typer.Option("--refractory-s", min=0.0, help="Least time between two triggers, s."),
    ] = 0.0,
    probability: Annotated[
        float,
        typer.Option(
            "--probability", min=0.0, max=1.0, help="Share of triggers that are sent, at random."
        ),
    ] = 1.0,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Make sessions here when the recording is over."),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Show skeletons in Rerun during a recording, trigger on rules, and measure the latency.

    With several animals (--set animal.count=2, or auto) their names are provisional, as only the
    past is known; --out identifies them over the whole recording.
    """
    chosen = load_plan(plan, settings or [])
    if send and not rules:
        raise LiexError("--send names a receiver, but no rule: state one with --trigger")
    triggers = api.Triggers(tuple(rules or ()), tuple(send or ()), for_s, refractory_s, probability)
    with progress_bar() as progress:
        result = api.follow_live(
            source,
            chosen,
            replay=replay,
            to=to,
            patience_s=patience_s,
            triggers=triggers if rules else None,
            out=out,
            progress=progress,
        )
    about, failed = result.pop("triggers", []), result.pop("failed_receivers", {})
    print_numbers(result)
    if json_file is not None:
        write_numbers({**result, "triggers": about, "failed_receivers": failed}, json_file)
    if not result["n_live"]:
        echo(
            "no latency: frames that came while background, floor and size were learned were still "
            "being made up for when the recording was over"
        )
    if to.endswith(".rrd"):
        echo(f"replay: {to}; Rerun's viewer opens it: rerun {to}")
    for address, why in failed.items():
        echo(f"{address} did not take every message: {why}")
    for one in about:
        echo(_trigger_sentence(one, f" of {one['individual']}" if result["n_animals"] > 1 else ""))
    if result["n_animals"] > 1:
        final = "--out identifies" if out is None else "the sessions identify"
        echo(
            f"{result['n_animals']} animals, whose names are provisional, as only the past was "
            f"known: they may have been exchanged at {result['n_unclear']} of "
            f"{result['n_crossings']} crossings; {final} them over the whole recording"
        )


def _trigger_sentence(about: dict[str, Any], whose: str) -> str:
    """What became of the events of one rule."""
    counts = (f"{about[f'n_{one}']} {one}" for one in ("sent", "withheld", "late", "failed"))
    text = f"trigger '{about['rule']}'{whose}: {about['n_events']} events ({', '.join(counts)})"
    if about["latency_p95_ms"] is not None:
        text += f", 95 % sent within {about['latency_p95_ms']:.1f} ms of their frame"
    if "n_session" not in about:
        return f"{text}; --out compares them with the finished session"
    shares = (
        f"{name} {'–' if about[name] is None else format(about[name], '.2f')}"
        for name in ("precision", "recall")
    )
    return (
        f"{text}; the finished session has {about['n_session']}: {', '.join(shares)} "
        f"(within {about['tolerance_s']:g} s)"
    )


@app.command(rich_help_panel=RECORDINGS)
def record(
    camera: Annotated[str, typer.Option("--camera", metavar="MAKER", help="orbbec or realsense.")],
    out: Annotated[Path, typer.Option("--out", metavar="NAME.mcap", help="The recording.")],
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", min=0.1, help="Its length; default: until Ctrl-C."),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            "--preset",
            metavar="NAME",
            help="Ask for the image size of this camera, such as femto-bolt or d435:640x480.",
        ),
    ] = None,
) -> None:
    """Record a depth camera as MCAP, with its calibration, its own times and counted drops."""
    with progress_bar() as progress:
        done = api.record(camera, out, seconds=seconds, preset=preset, progress=progress)
    echo(
        f"recording: {done.path} ({done.n_frames} frames in {done.duration_s:.1f} s, "
        f"{done.n_dropped} dropped)"
    )
    for sentence in done.notes:
        echo(f"note: {sentence}")
    if done.error:
        raise RecordingError(done.error)


@app.command(rich_help_panel=MODELS)
def info(
    plan: Annotated[str | None, typer.Option("--plan", help="Print this plan as TOML.")] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Show all package versions and model cards.")
    ] = False,
) -> None:
    """Show versions, bundled plans and models; `liex info --plan mouse` prints a plan."""
    from liex_lab.plan import known_plans

    if plan is not None:
        typer.echo(liex_lab.Plan.load(plan).to_toml(), nl=False)
        return
    from liex_lab.catalog import bundled_models
    from liex_lab.sessions.provenance import versions

    models, packages = bundled_models(), versions()
    shown = packages if everything else ("liex_lab", "python")
    facts: dict[str, Any] = {name: packages[name] for name in shown}
    facts |= {"plans": ", ".join(known_plans()), "models": ", ".join(models) or "none"}
    for name, card in models.items():
        if everything:
            facts |= {f"model {name}: {key}": value for key, value in card.items()}
        else:
            facts[f"model {name}"] = f"sha256 {str(card.get('sha256', 'unknown'))[:16]}"
    print_numbers(facts)
    if not everything:
        echo("`liex info --all` lists every package and how the models were made")


def main() -> None:
    """Run the command line.

    Errors that the user can correct are one sentence with exit code 1; internal errors show a
    traceback.
    """
    # hide Rerun's messages about a full disk, as ours replaces them
    os.environ.setdefault("RUST_LOG", "warn,re_log_encoding=off,re_sdk=off")
    atexit.register(gc.freeze)  # else two collections at exit take a second
    if notice := liex_lab._KERNELS_NOTICE:
        typer.echo(f"note: {printable(notice)}", err=True)
    try:
        with processes.ending():
            app()
    except processes.Ended as ended:
        _fail(str(ended), ended.exit_code)
    except LiexError as error:
        _fail(str(error), error.exit_code)
    except OSError as error:
        if durable.is_full(error):
            _fail(f"{durable.why_full(error)}; make room there and run the same command again")
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
    if short := memory.why_short(error):
        _fail(short)
    traceback.print_exc()
    _fail("this is a fault of liex_lab and not of yours; please report the lines above", FAULT)


def _print_session(session: Path, further: str = "") -> int:
    """Print a session's path and result; returns the exit code, 4 if it needs review."""
    from liex_lab.sessions.corrections import read_verdict
    from liex_lab.sessions.folder import folder_bytes, megabytes, taken_from

    echo(f"session: {session}")
    if copy := taken_from(session):
        echo(f"note: the corrections of {copy} were taken over; see `liex correct list`")
    report = session / "report.html"
    if report.is_file():
        echo(f"report:  {report}")
        echo(f"figures: {session / 'figures'}")
    echo(f"replay:  liex show {shlex.quote(str(session))}")
    echo(f"on disk: {megabytes(folder_bytes(session))}")
    if further:
        echo(further)
    verdict = read_verdict(session)
    if verdict["sentence"]:
        typer.secho(
            f"result:  {printable(verdict['sentence'])}",
            fg=typer.colors.YELLOW if verdict["look_at_it"] else None,
        )
    return MisfitError.exit_code if verdict["look_at_it"] and not verdict["accepted"] else 0
