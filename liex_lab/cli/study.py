"""The commands of `liex` for studies."""

from __future__ import annotations

import shlex
import webbrowser
from contextlib import ExitStack
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from liex_lab.cli.options import say
from liex_lab.runtime.progress import progress_bar

if TYPE_CHECKING:
    from liex_lab.pipelines.study.status import SessionStatus

SOME_FAILED = 3  # the exit code of a study in which a session failed

StudyOrInit = Annotated[
    str, typer.Argument(metavar="STUDY|init", help="A study's .toml file; or init, to begin one.")
]
InitFolder = Annotated[
    Path | None, typer.Argument(metavar="[FOLDER]", help="With init: where the recordings are.")
]
OnlyIds = Annotated[
    list[str] | None, typer.Option("--only", metavar="ID", help="Only this session; repeatable.")
]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", help="Address of a running Dask scheduler.")
]
SlurmFile = Annotated[
    str | None,
    typer.Option("--slurm", metavar="FILE", help="A .toml file with the settings of Slurm jobs."),
]


def cohort(
    study: StudyOrInit,
    folder: InitFolder = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only print what would be done, and why.")
    ] = False,
    retry: Annotated[bool, typer.Option("--retry", help="Try the failed sessions again.")] = False,
    again: Annotated[
        bool, typer.Option("--again", help="Do every session again, also those that are done.")
    ] = False,
    only: OnlyIds = None,
    workers: Annotated[
        int, typer.Option("--workers", min=0, help="Processes; 0: one for every two cores.")
    ] = 0,
    scheduler: Scheduler = None,
    slurm: SlurmFile = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="With init: replace a study file.")
    ] = False,
) -> None:
    """Measure every session of a study that is not done; one that fails stops no other (exit
    code 3).
    """
    if study == "init":
        from liex_lab.pipelines.study.init import begin_study

        with progress_bar() as progress:
            file = begin_study(folder or Path(), overwrite, say=say, progress=progress)
        say(f"study: {file}")
        return
    if folder is not None:
        raise typer.BadParameter(
            "a folder is named only after init, as in `liex cohort init FOLDER`"
        )
    from liex_lab.api import run_study

    if scheduler is not None:
        from liex_lab.pipelines.study.cluster import is_encrypted

        if not is_encrypted(scheduler):
            say(f"what goes to and from {scheduler} is not encrypted, and each side runs what the")
            say("other sends: a scheduler for a network that you trust, or tls://")
    standings = run_study(
        study,
        workers=workers,
        scheduler=scheduler,
        slurm=slurm,
        retry=retry,
        again=again,
        only=only or (),
        dry_run=dry_run,
    )
    if _tell_study(standings, dry_run):
        say(f"to try what failed again: liex cohort {shlex.quote(study)} --retry")
        raise typer.Exit(SOME_FAILED)


def dashboard(
    study: Annotated[
        Path,
        typer.Argument(
            metavar="STUDY", help="A study's .toml file, or a folder with sessions in it."
        ),
    ],
    host: Annotated[
        str,
        typer.Option("--host", help="The address to listen on; traffic is not encrypted."),
    ] = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="The port; 0: any free one.")
    ] = 8050,
    open_browser: Annotated[bool, typer.Option("--open", help="Open it in the browser.")] = False,
) -> None:
    """Open a study in the browser: sessions, ethograms, groups, any frame; Ctrl+C ends it."""
    from liex_lab.api import serve_dashboard

    with progress_bar() as progress, ExitStack() as stack:

        def told(address: str) -> None:
            """Print the dashboard's `address`, and open it if requested."""
            say(f"dashboard: {address}   (Ctrl+C ends it)")
            if open_browser:  # by a file: other accounts can read a program's arguments
                folder = stack.enter_context(TemporaryDirectory(prefix="liex-"))
                webbrowser.open(page_that_opens(address, Path(folder)).as_uri())

        serve_dashboard(study, host=host, port=port, told=told, progress=progress)


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
    session: Annotated[
        Path, typer.Argument(metavar="SESSION", help="A session folder, NAME.liex.")
    ],
    recording: Annotated[
        Path | None,
        typer.Option("--recording", help="Measure this recording again and compare the tables."),
    ] = None,
) -> None:
    """Check a session: its hashes, its origin and, with --recording, whether measuring again gives
    the same tables.
    """
    from liex_lab.api import verify_session

    with progress_bar() as progress:
        findings = verify_session(session, recording, progress=progress)
    for finding in findings:
        say(f"{finding.state:6}{finding.sentence}")
    if any(finding.state == "wrong" for finding in findings):
        raise typer.Exit(1)


def _tell_study(standings: list[SessionStatus], all_of_them: bool) -> int:
    """Print sessions that are not done, and the number in each state.

    Returns the number of sessions that failed or whose recording is missing.
    """
    from liex_lab.pipelines.study.status import to_check

    counts: dict[str, int] = {}
    for one in standings:
        counts[one.in_words] = counts.get(one.in_words, 0) + 1
        if one.missing:
            gone = (
                f"there is no recording {one.session.recording}; correct its path, or copy it there"
            )
            say(f"{'missing':9}{one.session.id}  {gone}")
        elif one.state == "done" and one.reason:
            say(f"{'done':9}{one.session.id}  {one.reason}")
        elif all_of_them or one.state not in ("done", "excluded"):
            remedy = f"; {one.failure['remedy']}" if one.failure and one.state == "failed" else ""
            say(f"{one.state:9}{one.session.id}  {one.reason}{remedy}".rstrip())
    remarks = [one.session.remark for one in standings if one.state not in ("failed", "excluded")]
    for remark in dict.fromkeys(filter(None, [*remarks, *to_check(standings)])):
        say(remark)
    say(
        f"{len(standings)} session{'' if len(standings) == 1 else 's'}: "
        + ", ".join(f"{n} {state}" for state, n in sorted(counts.items()))
    )
    return counts.get("failed", 0) + counts.get("recording missing", 0)
