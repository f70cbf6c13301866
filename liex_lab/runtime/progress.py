"""Progress reports of long jobs: one callable, handed down from the command line.

A job calls it with pieces done, pieces in all, and what is being done; a bar or a board shows it to
the person who waits.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from liex_lab.errors import printable


class Progress(Protocol):
    """Whoever wants to know how far a job is."""

    def __call__(self, done: int, total: int | None, what: str) -> None:
        """Take a report, after every piece of work.

        Args:
            done: pieces done.
            total: pieces in all; None where nobody knows.
            what: what is being done.
        """


def silent(done: int, total: int | None, what: str) -> None:
    """The progress nobody looks at: the default of every job.

    Args:
        done: pieces done.
        total: pieces in all, or None.
        what: what is being done.
    """


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A progress bar on standard error, gone when the block ends.

    Nothing is shown where that is not a terminal.

    Yields:
        The progress to hand to a job.
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
            """Show done out of total pieces and what is being done; a new total resets the time."""
            nonlocal last
            if total != last[1] or done < last[0]:
                display.reset(task, total=total)  # a new stage: its remaining time is its own
            last = (done, total)
            display.update(task, completed=done, total=total, description=printable(what))

        yield report


COMPILING = "compiling, once on this machine: a minute or two"


@contextmanager
def telling_of_compiling(progress: Progress) -> Iterator[Progress]:
    """The same progress, which within the block also hears of numba kernels being compiled.

    After the last compilation it hears again what it heard last.

    Args:
        progress: who is told.

    Yields:
        The progress to hand to the job.
    """
    from numba.core import event

    last: tuple[int, int | None, str] = (0, None, "beginning")
    under_way = 0

    def tell(done: int, total: int | None, what: str) -> None:
        """Pass on done, total and what, and keep them."""
        nonlocal last
        last = (done, total, what)
        progress(done, total, what)

    class Compiles(event.Listener):
        """Listener of numba's compilations."""

        def on_start(self, event: object) -> None:
            """A compilation began (event): say so."""
            nonlocal under_way
            under_way += 1
            progress(0, None, COMPILING)

        def on_end(self, event: object) -> None:
            """A compilation ended (event): after the last one, say again what was said before."""
            nonlocal under_way
            under_way -= 1
            if not under_way:
                progress(*last)

    with event.install_listener("numba:compile", Compiles()):
        yield tell


class Board:
    """How far many jobs are that run at once.

    A bar for each that runs, one for all, and a line for each that ended.

    Attributes:
        n_ended: jobs that are over.
        n_failed: those of them that failed.
    """

    def __init__(
        self, n_jobs: int, say: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """A board on which no job has begun.

        Args:
            n_jobs: jobs in all.
            say: takes the lines.
            clock: seconds that only go on, whatever the computer's clock is set to.
        """
        self._n = n_jobs
        self._say = say
        self._clock = clock
        self._began = clock()
        self._running: dict[str, float] = {}  # job -> share of it that is done
        self.n_ended = self.n_failed = 0

    def told(self, name: str, done: int, total: int | None, what: str) -> None:
        """Take the report of one job.

        Args:
            name: of the job.
            done: pieces done.
            total: pieces in all; None where nobody knows.
            what: what is being done.
        """
        self._running[name] = min(done / total, 1.0) if total else self._running.get(name, 0.0)

    def ended(self, name: str, sentence: str, failed: bool) -> None:
        """A job is over: count it and say a line, with the time left.

        Args:
            name: of the job.
            sentence: how it ended, to follow the name.
            failed: whether it failed.
        """
        self._running.pop(name, None)
        self.n_ended = self.n_ended + 1
        self.n_failed = self.n_failed + failed
        left = self.left_s
        wait = f", about {_span(left)} left" if left is not None and self.n_ended < self._n else ""
        self._say(f"{self.n_ended} of {self._n}: {name} {sentence}{wait}")

    @property
    def share(self) -> float:
        """How much of the whole is done, 0 to 1."""
        return min((self.n_ended + sum(self._running.values())) / self._n, 1.0) if self._n else 1.0

    @property
    def left_s(self) -> float | None:
        """Seconds until all are done if it goes on like this; None where nothing is known yet."""
        share = self.share
        spent = self._clock() - self._began
        return spent * (1.0 - share) / share if share > 0 else None

    @property
    def lines(self) -> list[tuple[str, float]]:
        """The names of the jobs that run, in order, and the share (0 to 1) of each that is done."""
        return sorted(self._running.items())


def _span(seconds: float) -> str:
    """A time as people say it."""
    minutes = seconds / 60
    if minutes < 1.5:
        return f"{seconds:.0f} s"
    if minutes < 90:
        return f"{minutes:.0f} min"
    return f"{minutes / 60:.1f} h" if minutes < 2880 else f"{minutes / 1440:.1f} days"


@contextmanager
def progress_board(n_jobs: int) -> Iterator[Board]:
    """A board on standard error; bars only where that is a terminal, the lines always.

    Args:
        n_jobs: jobs in all.

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
        for name, share in [*board.lines, ("all", board.share)]:
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
