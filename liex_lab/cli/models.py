"""Commands that train and evaluate models: `liex train` and `liex evaluate`."""

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer

from liex_lab import api
from liex_lab.cli.options import (
    AnimalName,
    JsonFile,
    NamesFile,
    SessionPath,
    command_group,
    echo,
    print_numbers,
    print_rows,
    print_scores,
    write_numbers,
)
from liex_lab.dashboards.paper.published import DEVIATIONS, HAND
from liex_lab.errors import LiexError, refuse
from liex_lab.runtime.progress import Progress, progress_bar


def train(
    animal: Annotated[
        str,
        typer.Argument(
            metavar="ANIMAL",
            help="fish, mouse, hand or a skeleton's .toml; or actions, tracking or shape.",
        ),
    ],
    variant: Annotated[
        str,
        typer.Option(
            "--variant",
            help="default or paper; `liex evaluate tables --help` lists the differences.",
        ),
    ] = "default",
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Model file, .npz (.skops for actions)."),
    ] = None,
    workers: Annotated[int, typer.Option("--workers", min=0, help="CPU cores to use; 0: all.")] = 0,
    n_images: Annotated[
        int | None,
        typer.Option("--images", min=512, help="Number of training images, for a quick trial."),
    ] = None,
    of: Annotated[
        str,
        typer.Option("--animal", help="Animal of `train actions`, `tracking` and `shape`."),
    ] = "mouse",
    sessions: Annotated[
        list[Path] | None,
        typer.Option("--session", help="`train actions`: a labelled session; repeatable."),
    ] = None,
    labels: Annotated[
        list[Path] | None,
        typer.Option(
            "--labels",
            metavar="FILE",
            help="`train actions`: labels, .csv, .parquet or .boris; repeatable.",
        ),
    ] = None,
    pose_model: Annotated[
        str | None,
        typer.Option("--model", metavar="FILE", help="`train actions`: pose model."),
    ] = None,
    particles: Annotated[
        bool,
        typer.Option(
            "--particles",
            help="`train tracking`: search the noise of the paper's Algorithm 3 instead.",
        ),
    ] = False,
    n_frames: Annotated[
        int | None,
        typer.Option(
            "--frames",
            min=40,
            help="`train tracking --particles`: number of frames of each sequence.",
        ),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Train a model on rendered depth images; training is deterministic.

    `liex train actions` makes the model that names actions: from sessions that people labelled, or,
    without any, from virtual animals that act. `liex train tracking` measures how far off an
    animal's tracks may be (tunings.toml), `liex train shape` how the build of an animal shows, and
    how its poses err with it.
    """
    report: Result = {}
    what = {"actions": "model", "tracking": "tunings", "shape": "shapes"}.get(animal, "model")
    with progress_bar() as progress:
        how: Result = {"workers": workers, "progress": progress}
        if animal == "actions":
            made, report = api.train_actions(
                out or Path(f"{of}-actions.skops"),
                animal=of,
                sessions=sessions or (),
                labels=labels or (),
                pose_model=pose_model,
                progress=progress,
            )
        elif animal == "tracking" and particles:
            report = api.search_noise(of, n_frames=n_frames, progress=progress)
        elif animal == "tracking":
            made = api.train_tracking(of, out or Path("tunings.toml"), **how)
        elif animal == "shape":
            made = api.train_shape(of, out or Path(f"{of}-shapes.npz"), **how)
        else:
            file = out or Path(f"{Path(animal).stem}.npz")
            made = api.train_model(animal, variant, file, n_images=n_images, **how)
    if animal == "tracking" and particles:
        print_numbers(report, json_file or out)
        return
    if animal == "actions":
        if json_file is not None:
            write_numbers(report, json_file)
        print_scores(report)
    echo(f"{what}: {made}")


# `liex evaluate`: reproduces every published number.


evaluate = command_group("Measure accuracy and speed; --json FILE saves the numbers.")
Result = dict[str, Any]
OwnModel = Annotated[
    str | None, typer.Option("--model", metavar="FILE", help="Your own model, .npz.")
]


def benchmark(
    name: str, show: Callable[[Result], None] = print_numbers
) -> Callable[[Callable[..., Result]], Callable[..., Result]]:
    """Register a function as the command `liex evaluate NAME`; its parameters are the options.

    Args:
        name: of the command.
        show: prints a selection of the numbers.
    """

    def register(measure: Callable[..., Result]) -> Callable[..., Result]:
        @wraps(measure)
        def verb(*, json_file: Path | None, **options: Any) -> None:
            with progress_bar() as progress:
                result = measure(**options, progress=progress)
            if json_file is not None:
                write_numbers(result, json_file)
            show(result)

        own = inspect.signature(measure, eval_str=True).parameters
        kind = inspect.Parameter.KEYWORD_ONLY
        shown = [p.replace(kind=kind) for p in own.values() if p.name != "progress"]
        shown.append(inspect.Parameter("json_file", kind, default=None, annotation=JsonFile))
        verb.__annotations__ = {p.name: p.annotation for p in shown}
        vars(verb)["__signature__"] = inspect.Signature(shown)
        evaluate.command(name)(verb)
        return measure

    return register


def show_poses(result: Result) -> None:
    """Print the numbers of a split; a row for each kind of build, or for each foreign body."""
    rows: Result = {kind: result[kind] for kind in ("other", "usual") if kind in result}
    if "summary" in result:
        rows = {**result["rows"], "median over bodies": result["summary"]}
    if rows:
        print_rows(
            {
                name: {k: v for k, v in row.items() if isinstance(v, int | float)}
                for name, row in rows.items()
            }
        )
        echo("\n".join(result.get("skipped", [])))
    else:
        print_numbers(result)


@benchmark("pose", show_poses)
def evaluate_pose(
    animal: AnimalName = "mouse",
    split: Annotated[
        str,
        typer.Option(
            "--split", help="clean, hard, other-body, other-camera, other-build or foreign."
        ),
    ] = "clean",
    variant: Annotated[
        str,
        typer.Option(
            "--variant", help="default, paper, paper-one-pose, paper-no-metric, rf or cnn."
        ),
    ] = "default",
    model: OwnModel = None,
    n_frames: Annotated[
        int | None,
        typer.Option("--frames", min=1, help="Number of frames of the split; default: all."),
    ] = None,
    spine_mm: Annotated[
        float | None,
        typer.Option(
            "--spine-mm", min=1.0, help="Render animals of this size instead of the split's."
        ),
    ] = None,
    sealed: Annotated[
        bool,
        typer.Option(
            "--sealed",
            help="Use the held-out part of other-build or foreign; not for development.",
        ),
    ] = False,
    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth",
            metavar="PATH",
            help="Folder of recordings with truth files NAME_truth.npz, or one such file, for the "
            "split foreign; default: the project's own bodies.",
        ),
    ] = None,
    *,
    progress: Progress,
) -> Result:
    """Measure joint errors on a split (other-build and foreign: whole tracks)."""
    tracks = {"other-build": "evaluate_builds", "foreign": "evaluate_foreign"}.get(split)
    refuse(
        LiexError,
        (
            tracks and (variant != "default" or model or spine_mm),
            f"{split} is measured with the bundled model and sizes of its own",
        ),
        (truth and split != "foreign", "--truth belongs to the split foreign; leave it out"),
        (sealed and not tracks, "--sealed belongs to other-build and foreign; leave it out"),
    )
    if tracks:
        more = {"truth": truth} if split == "foreign" else {}
        measure: Callable[..., Result] = getattr(api, tracks)
        return measure(animal, n_frames=n_frames, sealed=sealed, progress=progress, **more)
    return api.evaluate_pose(
        animal,
        split,
        variant,
        model=model,
        n_frames=n_frames,
        spine_mm=spine_mm,
        progress=progress,
    )


@benchmark("speed")
def evaluate_speed(
    animal: AnimalName = "mouse",
    recordings: Annotated[
        bool,
        typer.Option("--recordings", help="Measure the reading speed of each format instead."),
    ] = False,
    *,
    progress: Progress,
) -> Result:
    """Measure frames per second by stage on one and two cores, relative to the paper's variant."""
    if recordings:
        return api.evaluate_recordings(progress=progress)
    return api.evaluate_speed(animal, progress=progress)


@benchmark("sizes")
def evaluate_sizes(
    animal: AnimalName = "mouse",
    n_frames: Annotated[
        int | None, typer.Option("--frames", min=1, help="Number of frames per size; default: all.")
    ] = None,
    *,
    progress: Progress,
) -> Result:
    """Measure joint errors of animals 45 to 100 mm long, with estimated sizes."""
    return api.evaluate_sizes(animal, n_frames=n_frames, progress=progress)


@evaluate.command("tables", epilog="\n\n".join(["What differs from the paper:", *DEVIATIONS, HAND]))
def evaluate_tables(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Output folder.")],
    animals: Annotated[
        list[str] | None,
        typer.Option(
            "--animal", help="fish, mouse or hand; repeatable; default: all with a model."
        ),
    ] = None,
    n_frames: Annotated[
        int | None,
        typer.Option(
            "--frames",
            min=1,
            help="Only this many frames of each split; every row is then trained and measured, "
            "for kept rows are of all frames.",
        ),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option("--quick", help="Test the code within minutes; the numbers are meaningless."),
    ] = False,
    fresh: Annotated[
        bool,
        typer.Option(
            "--fresh",
            help="Measure every row again, with models that this version trains or has trained, "
            "which takes long; use no kept result.",
        ),
    ] = False,
    rows: Annotated[
        list[str] | None,
        typer.Option(
            "--row",
            help="Train and measure this row again, besides the default, and take the others from "
            "kept results: paper, paper-one-pose, paper-no-metric, rf, cnn, or fig7 for the curves "
            "of Fig. 7; repeatable.",
        ),
    ] = None,
    sealed: Annotated[
        bool,
        typer.Option(
            "--sealed",
            help="Measure the sealed split instead: recordings that no test, training or "
            "development uses. Run it once per release.",
        ),
    ] = False,
    without: Annotated[
        list[str] | None,
        typer.Option("--without", help="Skip tracking or actions; repeatable."),
    ] = None,
    nyu: Annotated[
        Path | None,
        typer.Option("--nyu", metavar="FOLDER", help="Include the NYU hand data in this folder."),
    ] = None,
) -> None:
    """Write all tables and figures of the paper to one page, DIR/index.html."""
    with progress_bar() as progress:
        written = api.run_tables(
            out,
            animals or (),
            n_frames=n_frames,
            quick=quick,
            fresh=fresh,
            rows=rows or (),
            sealed=sealed,
            without=without or (),
            nyu=nyu,
            progress=progress,
        )
    for path in written:
        echo(path)


def show_actions(result: Result) -> None:
    """Print the numbers; of people's words, a row for all animals and for each of them."""
    if "per_animal" in result:
        rows = {"all animals": result, **result["per_animal"]}
        print_rows(
            {
                name: {k: v for k, v in of.items() if isinstance(v, float)}
                for name, of in rows.items()
            }
        )
    else:
        print_numbers(result)


@benchmark("actions", show_actions)
def evaluate_actions(
    animal: AnimalName = "fish",
    model: Annotated[
        str | None, typer.Option("--actions", metavar="FILE", help="Action model, .skops.")
    ] = None,
    pose_model: Annotated[
        str | None,
        typer.Option("--model", metavar="FILE", help="Pose model, .npz."),
    ] = None,
    minutes: Annotated[
        float,
        typer.Option("--minutes", min=1.0, help="Length of the uncut test recordings, minutes."),
    ] = 30.0,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Draw confusion matrices into this folder."),
    ] = None,
    tracks: Annotated[
        Path | None,
        typer.Option(
            "--tracks",
            metavar="FOLDER",
            help="Score rules and recognisers against people's words in 3D points of real mice.",
        ),
    ] = None,
    names: NamesFile = None,
    *,
    progress: Progress,
) -> Result:
    """Score the paper's action recogniser and ours on cut sequences and uncut recordings.

    The recordings are rendered and measured first, which takes about half an hour for all 30
    minutes on two cores. Measured recordings are kept in the cache folder (LIEX_CACHE), so that a
    stopped job resumes where it was. With --tracks nothing is rendered, and all other options but
    --names are ignored.
    """
    if tracks is not None:
        return api.evaluate_tracks(tracks, names=names, progress=progress)
    return api.evaluate_actions(
        animal,
        model=model,
        pose_model=pose_model,
        minutes=minutes,
        figure=out and out / f"{animal}_confusion.png",
        progress=progress,
    )


@benchmark("cameras", lambda result: print_rows(result["rows"]))
def evaluate_cameras(
    cameras: Annotated[
        str | None,
        typer.Option("--only", metavar="NAME,...", help="Measure only these cameras."),
    ] = None,
    distances: Annotated[
        str, typer.Option("--mm", metavar="MM,...", help="Heights above the floor, mm.")
    ] = "500,750,1000",
    n_frames: Annotated[
        int, typer.Option("--frames", min=20, help="Number of frames of each recording.")
    ] = 120,
    n_recordings: Annotated[
        int, typer.Option("--recordings", min=1, help="Recordings per camera and distance.")
    ] = 4,
    *,
    progress: Progress,
) -> Result:
    """Measure joint errors of a mouse by camera and distance, in simulation."""
    named = {} if cameras is None else {"cameras": cameras.split(",")}
    try:
        mm = [float(one) for one in distances.split(",")]
    except ValueError:
        raise LiexError(f"--mm takes numbers such as 500,750, got '{distances}'") from None
    return api.evaluate_cameras(
        **named,
        distances_mm=mm,
        n_frames=n_frames,
        n_recordings=n_recordings,
        progress=progress,
    )


@benchmark("tracking")
def evaluate_tracking(
    animal: AnimalName = "mouse",
    sequence: Annotated[
        str, typer.Option("--sequence", help="Test sequence: easy or hard.")
    ] = "hard",
    model: OwnModel = None,
    n_frames: Annotated[
        int | None, typer.Option("--frames", min=40, help="Number of frames of the sequence.")
    ] = None,
    paper: Annotated[
        bool,
        typer.Option(
            "--paper",
            help="Also the paper's own comparison, Algorithm 1 and 3 on the parts of its variant, "
            "which is trained first if it has not been (minutes).",
        ),
    ] = False,
    figure: Annotated[
        Path | None, typer.Option("--figure", metavar="PNG", help="Draw the error over time.")
    ] = None,
    *,
    progress: Progress,
) -> Result:
    """Measure joint errors over a sequence: single frames, Algorithm 3, and the default tracker."""
    return api.evaluate_tracking(
        animal,
        sequence,
        model=model,
        paper=paper,
        n_frames=n_frames,
        figure=figure,
        progress=progress,
    )


@benchmark("scenes", lambda result: print_rows(result["rows"]))
def evaluate_scenes(
    only: Annotated[
        str | None, typer.Option("--only", metavar="NAME,...", help="Measure only these scenes.")
    ] = None,
    n_frames: Annotated[
        int, typer.Option("--frames", min=20, help="Number of frames of each recording.")
    ] = 300,
    n_recordings: Annotated[
        int,
        typer.Option("--recordings", min=1, help="Recordings per scene, each of another animal."),
    ] = 1,
    sealed: Annotated[
        bool,
        typer.Option("--sealed", help="Use the held-out split; not for development."),
    ] = False,
    figures: Annotated[
        Path | None,
        typer.Option(
            "--figures", metavar="DIR", help="Draw frames of each scene into this folder."
        ),
    ] = None,
    *,
    progress: Progress,
) -> Result:
    """Measure rendered lab scenes: found frames, joint errors, and errors not flagged."""
    return api.evaluate_scenes(
        [name.strip() for name in only.split(",")] if only else [],
        n_frames=n_frames,
        n_recordings=n_recordings,
        sealed=sealed,
        figures=figures,
        progress=progress,
    )


@benchmark("several", lambda result: print_rows(flat_rows(result["rows"])))
def evaluate_several(
    animals: Annotated[
        int, typer.Option("--animals", min=2, max=4, help="Number of animals in each recording.")
    ] = 2,
    animal: AnimalName = "mouse",
    n_frames: Annotated[
        int, typer.Option("--frames", min=300, help="Number of frames of each recording.")
    ] = 1800,
    n_recordings: Annotated[
        int, typer.Option("--recordings", min=1, max=48, help="Number of recordings.")
    ] = 6,
    sealed: Annotated[
        bool,
        typer.Option("--sealed", help="Use the held-out split; not for development."),
    ] = False,
    courses: Annotated[
        Path | None,
        typer.Option(
            "--courses",
            exists=True,
            help="Pose file of JABS with identities (HDF5): virtual mice go where real ones went.",
        ),
    ] = None,
    *,
    progress: Progress,
) -> Result:
    """Measure rendered groups of animals: identity, errors in contact, and interactions."""
    return api.evaluate_several(
        animals,
        animal=animal,
        n_frames=n_frames,
        n_recordings=n_recordings,
        sealed=sealed,
        courses=courses,
        progress=progress,
    )


def flat_rows(rows: Result) -> Result:
    """Rows whose tables of scores are columns of their own."""
    return {
        name: {
            key if column == key else f"{key} {column.removeprefix('interactions_')}": number
            for column, value in row.items()
            for key, number in (value if isinstance(value, dict) else {column: value}).items()
            if not isinstance(number, dict)
        }
        for name, row in rows.items()
    }


@benchmark("live")
def evaluate_live(
    animal: AnimalName = "fish",
    n_frames: Annotated[
        int, typer.Option("--frames", min=200, help="Number of frames, sent at the camera's rate.")
    ] = 1500,
    rate_hz: Annotated[
        float | None,
        typer.Option("--fps", min=1.0, max=1000.0, help="Frame rate, instead of the recording's."),
    ] = None,
    n_cameras: Annotated[
        int, typer.Option("--cameras", min=1, max=16, help="Number of simultaneous cameras.")
    ] = 1,
    n_animals: Annotated[
        int, typer.Option("--animals", min=1, max=4, help="Number of mice in one arena.")
    ] = 1,
    rules: Annotated[
        list[str] | None,
        typer.Option(
            "--trigger",
            metavar="RULE",
            help="Also measure a trigger of one camera, see `liex live`; repeatable.",
        ),
    ] = None,
    *,
    progress: Progress,
) -> Result:
    """Measure the latency of live tracking of a virtual animal."""
    return api.evaluate_live(
        animal,
        n_frames=n_frames,
        rate_hz=rate_hz,
        n_cameras=n_cameras,
        n_animals=n_animals,
        rules=rules or (),
        progress=progress,
    )


@benchmark("statistics")
def evaluate_statistics(
    n_studies: Annotated[
        int, typer.Option("--studies", min=20, help="Number of simulated studies of each kind.")
    ] = 2000,
    effect: Annotated[
        float,
        typer.Option("--effect", help="Effect size for the power, in SD between animals."),
    ] = 1.0,
    *,
    progress: Progress,
) -> Result:
    """Measure false positives and power of group comparisons on simulated studies."""
    return api.evaluate_statistics(n_studies, effect, progress=progress)


@benchmark("sync", lambda result: print_rows(result["trains"]))
def evaluate_sync(
    n_pairs: Annotated[
        int, typer.Option("--pairs", min=8, help="Number of simulated pairs of clocks.")
    ] = 1000,
    *,
    progress: Progress,
) -> Result:
    """Measure errors of aligned clocks, and how many are refused, on simulated pulse trains."""
    return api.evaluate_sync(n_pairs, progress=progress)


@benchmark("nyu", lambda result: print_numbers(api.hands_in_short(result)))
def evaluate_nyu(
    reference: Annotated[
        Path,
        typer.Option(
            "--reference",
            metavar="DIR",
            help="Folder with labels, published results and frames of the NYU data.",
        ),
    ],
    model: Annotated[str | None, typer.Option("--model", help="Your own hand model, .npz.")] = None,
    *,
    progress: Progress,
) -> Result:
    """Compare published results and ours on hands by the NYU protocol (14 points)."""
    return api.evaluate_nyu(reference, model=model, progress=progress)


@benchmark("reference")
def evaluate_reference(
    session: SessionPath,
    reference: Annotated[
        Path,
        typer.Option("--reference", metavar="CSV", help="Reference table, one row per frame."),
    ],
    *,
    progress: Progress,
) -> Result:
    """Compare a session with another program's measurement of the recording."""
    return api.evaluate_reference(session, reference)


@benchmark("scale")
def evaluate_scale(
    n_frames: Annotated[
        int, typer.Option("--frames", min=2000, help="Number of frames of each virtual recording.")
    ] = 3000,
    *,
    progress: Progress,
) -> Result:
    """Measure the cost of a study: sessions per hour, memory, and time by step.

    Takes some minutes on two cores, and needs a machine without other work.
    """
    return api.run_scale(n_frames, progress=progress)
