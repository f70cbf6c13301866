"""How a long job tells the person who waits how far it is: one callable, handed down from the command line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol


class Progress(Protocol):
    """Whoever wants to know how far a job is."""

    def __call__(self, done: int, total: int | None, what: str) -> None:
        """Told after every piece of work: pieces done, pieces in all (None: nobody knows), what is being done."""


def silent(done: int, total: int | None, what: str) -> None:
    """The progress nobody looks at: the default of every job."""


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A progress bar on standard error, gone when the block ends; nothing at all where that is not a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, SpinnerColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    console = Console(stderr=True)
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    with Bars(*columns, console=console, transient=True, disable=not console.is_terminal) as display:
        task = display.add_task("", total=None)
        last: tuple[int, int | None] = (0, None)

        def report(done: int, total: int | None, what: str) -> None:
            nonlocal last
            if total != last[1] or done < last[0]:
                display.reset(task, total=total)  # a new stage: its remaining time is its own
            last = (done, total)
            display.update(task, completed=done, total=total, description=what)

        yield report
