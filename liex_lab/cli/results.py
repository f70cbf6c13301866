"""The verbs of `liex` for sessions that are there: compare their groups, write them for other
programs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from liex_lab.runtime.progress import progress_bar


def compare(
    places: Annotated[
        list[Path],
        typer.Argument(metavar="FOLDER...", help="Sessions, or folders with sessions in."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="The folder for the tables.")],
    measures: Annotated[
        list[str] | None,
        typer.Option("--measure", help="A column of summary.csv; repeatable; the usual ones."),
    ] = None,
    reference: Annotated[
        str | None, typer.Option("--reference", help="Compare with this group only.")
    ] = None,
    animals: Annotated[
        Path | None,
        typer.Option("--animals", metavar="CSV", help="subject_id with group, cage, sex or batch."),
    ] = None,
    engine: Annotated[str, typer.Option("--engine", help="auto, permutation or mixed.")] = "auto",
) -> None:
    """Compare groups of animals: the test that the design allows, effect sizes, and n at every
    level.
    """
    from liex_lab.pipelines.compare import compare_sessions

    with progress_bar() as progress:
        found = compare_sessions(
            places,
            out,
            measures or (),
            reference=reference,
            animals=animals,
            engine=engine,
            progress=progress,
        )
    for row in found["stats"].to_dict("records"):
        numbers = (
            f"{row['estimate']:.4g} [{row['ci_low']:.3g}, {row['ci_high']:.3g}], g "
            f"{row['effect_size']:.2g}"
        )
        p = (
            f"p {row['p']:.2g}, corrected {row['p_fdr']:.2g}: {row['test']}"
            if row["test"]
            else row["refused"]
        )
        n = f"{row['n_units_first']} and {row['n_units_second']} units ({row['unit'] or 'none'})"
        typer.echo(f"{row['measure']}, {row['contrast']}: {numbers}; {n}\n    {p}")
    typer.echo(f"tables: {found['folder']}")


def report(
    session: Annotated[
        Path, typer.Argument(metavar="SESSION", help="A session folder, NAME.liex.")
    ],
) -> None:
    """Write a session's report.html again, with what people corrected since."""
    from liex_lab.dashboards.report.report import write_report

    typer.echo(f"report: {write_report(session)}")


def export(
    session: Annotated[
        Path, typer.Argument(metavar="SESSION", help="A session folder, NAME.liex.")
    ],
    to: Annotated[
        str,
        typer.Option(
            "--to", metavar="FORMAT", help="nwb, boris, dlc, movement, sleap, csv or xlsx."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="The folder for it; the session's own if not named."
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace what is there under this name.")
    ] = False,
) -> None:
    """Write a session for another program: NWB, BORIS, DeepLabCut, movement, SLEAP, or every table
    as CSV or in one Excel workbook.
    """
    from liex_lab.exchange import export as job
    from liex_lab.sessions import Session

    typer.echo(f"export: {job(Session.open(session), to, out, overwrite=overwrite)}")
