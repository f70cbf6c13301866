"""Progress reports of long jobs: a callable, passed down from the command line.

A job calls it with the number of completed pieces, the total, and a description; a bar or a board
shows it to the user.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Protocol

from liex_lab.errors import printable


class Progress(Protocol):
    """A callable that receives progress reports."""

    def __call__(self, done: int, total: int | None, what: str) -> None:
        """Report progress, after every piece of work.

        Args:
            done: completed pieces.
            total: total pieces; None if unknown.
            what: the current activity.
        """


def silent(done: int, total: int | None, what: str) -> None:
    """Ignore progress reports: the default of every job."""


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A progress bar on standard error, removed when the block ends.

    Nothing is shown if standard error is not a terminal.

    Yields:
        The progress to pass to a job.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        SpinnerColumn,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.progress import Progress as Bars

    console = Console(stderr=True)
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    with Bars(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as display:
        task = display.add_task("", total=None)
        last: tuple[int, int | None] = (0, None)

        def report(done: int, total: int | None, what: str) -> None:
            """Show completed and total pieces and the activity; a new total, or a
            smaller count, starts a new stage and resets the remaining time.
            """
            nonlocal last
            if total != last[1] or done < last[0]:
                display.reset(task, total=total)  # a new stage has its own remaining time
            last = (done, total)
            display.update(task, completed=done, total=total, description=printable(what))

        yield report


@contextmanager
def logged(progress: Progress, path: Path, title: str) -> Iterator[Progress]:
    """The same progress, which within the block also appends its stages to a log.

    Each stage is a line with its time, and each tenth of a long one; the last line is the error
    that ended it, or "done". A job that ends before its first stage leaves no log, nor does one
    that is refused before there is a folder.

    Args:
        progress: receives the reports.
        path: of the log, UTF-8 text; its lines are held back until its folder exists.
        title: first line, such as the command.
    """
    last = ("", 0)
    held: list[str] = []

    def line(text: object) -> None:
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        held.append(f"{now} {printable(text)}\n")
        if path.parent.is_dir():
            with path.open("a", encoding="utf-8") as file:
                file.writelines(held)
            held.clear()

    def report(done: int, total: int | None, what: str) -> None:
        nonlocal last
        reached = (what, 10 * done // total if total else 0)
        if reached != last:
            if not last[0]:
                line(title)
            last = reached
            line(f"{what}: {done} of {total}" if total else what)
        progress(done, total, what)

    try:
        yield report
    except BaseException as error:
        if last[0]:
            line(f"ended: {error or type(error).__name__}")
        raise
    if last[0]:
        line("done")


COMPILING = "compiling, once on this machine: a minute or two"


@contextmanager
def reporting_compilation(progress: Progress) -> Iterator[Progress]:
    """The same progress, which within the block also reports compilations of numba kernels.

    After the last compilation, the latest report of the job is repeated.

    Args:
        progress: receives the reports.

    Yields:
        The progress to pass to the job.
    """
    from numba.core import event

    last: tuple[int, int | None, str] = (0, None, "beginning")
    n_compiling = 0

    def forward(done: int, total: int | None, what: str) -> None:
        """Forward a report, and keep it."""
        nonlocal last
        last = (done, total, what)
        progress(done, total, what)

    class CompilationListener(event.Listener):
        """Listener of numba's compilations."""

        def on_start(self, started: object) -> None:
            """Report that a compilation began."""
            nonlocal n_compiling
            n_compiling += 1
            progress(0, None, COMPILING)

        def on_end(self, ended: object) -> None:
            """A compilation ended: after the last one, repeat the latest report."""
            nonlocal n_compiling
            n_compiling -= 1
            if not n_compiling:
                progress(*last)

    with event.install_listener("numba:compile", CompilationListener()):
        yield forward


class Board:
    """Counts the progress of concurrent jobs and prints a line for each finished one.

    `progress_board` draws the bars.

    Attributes:
        n_ended: finished jobs.
        n_failed: finished jobs that failed.
    """

    def __init__(self, n_jobs: int, write_line: Callable[[str], None]) -> None:
        """Create a board on which no job has begun.

        Args:
            n_jobs: total number of jobs.
            write_line: prints a line.
        """
        self._n = n_jobs
        self._write_line = write_line
        self._began = time.monotonic()
        self._running: dict[str, float] = {}  # job -> completed fraction
        self.n_ended = self.n_failed = 0

    def report(self, name: str, done: int, total: int | None, what: str) -> None:
        """Receive a progress report of one job.

        Args:
            name: the job.
            done: completed pieces.
            total: total pieces; None if unknown.
            what: not shown; accepted as in any progress report.
        """
        self._running[name] = min(done / total, 1.0) if total else self._running.get(name, 0.0)

    def finish(self, name: str, sentence: str, failed: bool) -> None:
        """Count a finished job and print a line with the time left.

        Args:
            name: the job.
            sentence: how it ended; follows the name.
            failed: whether it failed.
        """
        self._running.pop(name, None)
        self.n_ended = self.n_ended + 1
        self.n_failed = self.n_failed + failed
        left = self.left_s
        wait = f", about {_span(left)} left" if left is not None and self.n_ended < self._n else ""
        self._write_line(f"{self.n_ended} of {self._n}: {name} {sentence}{wait}")

    @property
    def share(self) -> float:
        """Completed fraction of all jobs, 0 to 1."""
        return min((self.n_ended + sum(self._running.values())) / self._n, 1.0) if self._n else 1.0

    @property
    def left_s(self) -> float | None:
        """Estimated seconds until all jobs are done; None before any progress."""
        share = self.share
        spent = time.monotonic() - self._began
        return spent * (1.0 - share) / share if share > 0 else None

    @property
    def running_shares(self) -> list[tuple[str, float]]:
        """Name and completed fraction (0 to 1) of each running job, sorted by name."""
        return sorted(self._running.items())


def _span(seconds: float) -> str:
    """A duration with a suitable unit."""
    minutes = seconds / 60
    if minutes < 1.5:
        return f"{seconds:.0f} s"
    if minutes < 90:
        return f"{minutes:.0f} min"
    return f"{minutes / 60:.1f} h" if minutes < 2880 else f"{minutes / 1440:.1f} days"


@contextmanager
def progress_board(n_jobs: int) -> Iterator[Board]:
    """A board on standard error; lines are always printed, bars only on a terminal.

    Yields:
        The board to report to.
    """
    from rich.console import Console
    from rich.live import Live
    from rich.table import Table
    from rich.text import Text

    console = Console(stderr=True)
    board = Board(
        n_jobs, lambda line: console.print(Text(printable(line)), highlight=False, soft_wrap=True)
    )

    def draw() -> Table:
        grid = Table.grid(padding=(0, 2))
        for name, share in [*board.running_shares, ("all", board.share)]:
            filled = round(30 * share)
            grid.add_row(
                Text(printable(name)),
                Text("█" * filled + "·" * (30 - filled)),
                Text(f"{100 * share:.0f} %"),
            )
        left = board.left_s
        grid.add_row(Text("" if left is None else f"about {_span(left)} left"))
        return grid

    if not console.is_terminal:
        yield board
        return
    with Live(get_renderable=draw, console=console, refresh_per_second=4, transient=True):
        yield board
