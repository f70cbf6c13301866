"""`liex train`: models of poses and actions, tunings of the tracker, tables of shapes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from liex_lab.cli.options import (
    JsonFile,
    VariantName,
    keep_numbers,
    say,
    tell_numbers,
    tell_scores,
)
from liex_lab.runtime.progress import progress_bar


def train(
    animal: Annotated[
        str,
        typer.Argument(
            metavar="ANIMAL",
            help="fish, mouse, hand, a skeleton's .toml; or: actions, tracking, shape.",
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
        str,
        typer.Option("--animal", help="Of `train actions`, `tracking` and `shape`: which animal."),
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
    n_frames: Annotated[
        int | None,
        typer.Option(
            "--frames",
            min=40,
            help="Of `train tracking --particles`: the first frames of each sequence alone.",
        ),
    ] = None,
    json_file: JsonFile = None,
) -> None:
    """Train an animal's model on rendered depth images; every run gives the same model, byte for
    byte.

    `liex train actions` makes the model that names actions: from sessions that people labelled, or,
    without any, from virtual animals that act. `liex train tracking` measures how far off an
    animal's tracks may be (tunings.toml), `liex train shape` how the build of an animal shows, and
    how its poses err with it.
    """
    if animal == "actions":
        _train_actions(of, out, sessions or (), labels or (), pose_model, json_file)
    elif animal == "tracking" and particles:
        _search_particles(of, n_frames, json_file or out)
    elif animal == "tracking":
        _train_tracking(of, out or Path("tunings.toml"), workers)
    elif animal == "shape":
        _train_shape(of, out or Path(f"{of}-shapes.npz"), workers)
    else:
        _train_pose(animal, variant, out or Path(f"{Path(animal).stem}.npz"), workers, n_images)


def _train_actions(
    animal: str,
    out: Path | None,
    sessions: Sequence[Path],
    labels: Sequence[Path],
    pose_model: str | None,
    json_file: Path | None,
) -> None:
    from liex_lab.pipelines.training.action_model import train_actions

    with progress_bar() as progress:
        model, report = train_actions(
            out or Path(f"{animal}-actions.skops"),
            animal=animal,
            sessions=sessions,
            labels=labels,
            pose_model=pose_model,
            progress=progress,
        )
    if json_file is not None:
        keep_numbers(report, json_file)
    tell_scores(report)
    say(f"model: {model}")


def _search_particles(animal: str, n_frames: int | None, json_file: Path | None) -> None:
    from liex_lab.pipelines.evaluation.tracking import search_noise

    with progress_bar() as progress:
        found = search_noise(animal, n_frames=n_frames, progress=progress)
    tell_numbers(found, json_file)


def _train_tracking(animal: str, out: Path, workers: int) -> None:
    from liex_lab.pipelines.training.motion_model import train_tracking

    with progress_bar() as progress:
        table = train_tracking(animal, out, workers=workers, progress=progress)
    say(f"tunings: {table}")


def _train_shape(animal: str, out: Path, workers: int) -> None:
    from liex_lab.pipelines.training.shape_model import train_shape

    with progress_bar() as progress:
        shapes = train_shape(animal, out, workers=workers, progress=progress)
    say(f"shapes: {shapes}")


def _train_pose(animal: str, variant: str, out: Path, workers: int, n_images: int | None) -> None:
    from liex_lab.pipelines.training.pose_model import train_model

    with progress_bar() as progress:
        model = train_model(
            animal, variant, out, workers=workers, n_images=n_images, progress=progress
        )
    say(f"model: {model}")
