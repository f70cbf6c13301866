"""The verbs of `liex` that write recordings: for other programs, and as archives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from liex_lab.cli.options import (
    RecordingPath,
    Settings,
    TopicName,
    WhichPlan,
    region_setting,
    say,
)
from liex_lab.runtime.progress import progress_bar


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
