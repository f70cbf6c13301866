"""The verbs of `liex` for sessions that are there: compare their groups, write them for other
programs.
"""

from __future__ import annotations

from math import isnan
from pathlib import Path
from typing import Annotated

import typer

from liex_lab.cli.options import say
from liex_lab.errors import MisfitError, printable
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
        if not isnan(row["effect_size"]):  # of values that are all the same there is none
            numbers += f", g {row['effect_size']:.2g}"
        if not isnan(row["estimate"]):
            say(f"{row['measure']}, {row['contrast']}: {numbers}; {counted_units(row)}")
        if row["test"]:
            say(f"    p {row['p']:.2g}, corrected {row['p_fdr']:.2g}: {row['test']}")
        else:
            refused.setdefault(row["refused"], []).append(row["measure"])
    for why, names in refused.items():  # said once, not once for each measure
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
