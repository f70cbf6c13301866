"""Saves corrections to disk: a queue that one thread processes in batches.

All corrections of a session together determine its tables, so the corrections waiting for one
session are applied in one batch. The report takes longer; it is made again after a while without
corrections.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from liex_lab.errors import LiexError, one_line
from liex_lab.sessions.corrections import Correction, read_log

Correct = Callable[[Path, Sequence[Correction], Sequence[int], str], object]
Report = Callable[[Path], object]

WAITING = "waiting"
SAVING = "saving"
SAVED = "saved"
FAILED = "failed"
_CALM_S = 3.0  # time without a correction before the report is made again


@dataclass
class Ticket:
    """A queued correction, or the request to undo one.

    Attributes:
        folder: the session folder.
        what: the correction; None undoes one.
        author: the author of the request.
        undoes: number of the log entry to undo; 0 for a correction.
        number: its own number in the log, once saved.
        state: waiting, saving, saved or failed.
        said: its effect, or why it failed.
    """

    folder: Path
    what: Correction | None
    author: str
    undoes: int = 0
    number: int = 0
    state: str = WAITING
    said: str = ""


class Saver:
    """Saves corrections in the order in which they are requested.

    Thread-safe.

    Args:
        correct: adds corrections to the session in a folder, or undoes some, with the author.
        report: makes the report of the session in a folder again; None if `correct` does.
        calm_s: time without corrections before a session's report is made again, s.
    """

    def __init__(
        self, correct: Correct, report: Report | None = None, calm_s: float = _CALM_S
    ) -> None:
        self._correct = correct
        self._report = report
        self._calm_s = calm_s
        self._changed = threading.Condition()
        self._tickets: list[Ticket] = []
        self._reports: dict[Path, float] = {}  # due times
        self._reporting: Path | None = None
        self._thread: threading.Thread | None = None

    def add(self, folder: Path, what: Correction, author: str) -> Ticket:
        """Queue a correction by `author` of the session in `folder`."""
        return self._put(Ticket(folder, what, author, said=str(what)))

    def take_back(self, folder: Path, number: int, author: str) -> Ticket:
        """Queue the undoing of the log entry `number`."""
        return self._put(Ticket(folder, None, author, number, said=f"{number} is taken back"))

    def wait(self, ticket: Ticket) -> None:
        """Wait until the correction of a ticket is saved.

        Raises:
            LiexError: it could not be saved.
        """
        with self._changed:
            self._changed.wait_for(lambda: ticket.state in (SAVED, FAILED))
        if ticket.state == FAILED:
            raise LiexError(ticket.said)

    def busy(self, folder: Path) -> tuple[int, bool]:
        """The number of unsaved corrections of a session, and whether its report is out of date."""
        with self._changed:
            unsaved = sum(ticket.folder == folder for ticket in self._tickets)
            return unsaved, folder in self._reports or self._reporting == folder

    def finish(self, folder: Path | None = None) -> None:
        """Return when all corrections are saved and the reports are made.

        Args:
            folder: of this session alone; None waits for all.
        """
        with self._changed:
            for one in self._reports:
                self._reports[one] = 0.0
            self._changed.notify_all()

            def calm() -> bool:
                ours: Iterable[Path] = [
                    *(ticket.folder for ticket in self._tickets),
                    *self._reports,
                    *([] if self._reporting is None else [self._reporting]),
                ]
                return not any(folder in (None, one) for one in ours)

            while not calm():
                for one in self._reports:
                    self._reports[one] = 0.0
                self._changed.notify_all()
                self._changed.wait(0.1)

    def _put(self, ticket: Ticket) -> Ticket:
        with self._changed:
            self._tickets.append(ticket)
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, daemon=True)
                self._thread.start()
            self._changed.notify_all()
        return ticket

    def _work(self) -> None:
        """Save queued corrections for as long as the program runs."""
        while True:
            batch, report = self._next()
            if batch:
                self._save(batch)
            elif report is not None and self._report is not None:
                with suppress(LiexError, OSError):  # `liex report` shows the error
                    self._report(report)
                with self._changed:
                    self._reporting = None
                    self._changed.notify_all()

    def _next(self) -> tuple[list[Ticket], Path | None]:
        """The next task: corrections of one session by one person, or else a report."""
        with self._changed:
            while True:
                if self._tickets:
                    first = self._tickets[0]
                    batch: list[Ticket] = []
                    for ticket in self._tickets:
                        if (ticket.folder, ticket.author) != (first.folder, first.author):
                            break
                        if ticket.what is None and any(one.what for one in batch):
                            break  # a step of the log begins with its undos
                        batch.append(ticket)
                    for ticket in batch:
                        ticket.state = SAVING
                    return batch, None
                now = time.monotonic()
                due = [one for one, at in self._reports.items() if at <= now]
                if due:
                    self._reporting = due[0]
                    del self._reports[due[0]]
                    return [], due[0]
                self._changed.wait(
                    None if not self._reports else min(self._reports.values()) - now + 0.01
                )

    def _save(self, batch: list[Ticket]) -> None:
        """Save a batch of corrections; one by one if the batch fails."""
        try:
            self._once(batch)
        except Exception as error:  # the other corrections must still be saved
            if len(batch) > 1:
                for ticket in batch:
                    self._save([ticket])
                return
            told = str(error) if isinstance(error, LiexError) else one_line(error)
            self._settle(batch, FAILED, told or type(error).__name__)

    def _once(self, batch: list[Ticket]) -> None:
        folder = batch[0].folder
        what = [ticket.what for ticket in batch if ticket.what is not None]
        undo = [ticket.undoes for ticket in batch if ticket.what is None]
        self._correct(folder, what, undo, batch[0].author)
        entries = read_log(folder).entries
        known = {ticket.undoes: ticket for ticket in batch if ticket.what is None}
        rest = [ticket for ticket in batch if ticket.what is not None]
        for entry in reversed(entries):
            if entry.what is None and entry.undoes in known:
                known.pop(entry.undoes).number = entry.number
            elif rest and entry.what == rest[-1].what:
                rest.pop().number = entry.number
            if not known and not rest:
                break
        self._settle(batch, SAVED)

    def _settle(self, batch: list[Ticket], state: str, said: str = "") -> None:
        with self._changed:
            for ticket in batch:
                ticket.state = state
                ticket.said = said or ticket.said
                self._tickets.remove(ticket)
            if state == SAVED and self._report is not None:
                self._reports[batch[0].folder] = time.monotonic() + self._calm_s
            self._changed.notify_all()
