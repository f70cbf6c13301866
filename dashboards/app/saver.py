"""Corrections on their way to disk: a queue that one thread works off, many at a time.

A session's tables follow from all its corrections together, so those that wait for the same
session are made in one go; its report, which takes longer, is made again when nobody has corrected
it for a while.
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
_CALM_S = 3.0  # without a correction, until the report is made again


@dataclass
class Ticket:
    """One correction on its way, or the request to take one back.

    Attributes:
        folder: the session folder.
        what: the correction; None takes one back.
        author: who asks.
        undoes: number of the entry of the log to take back; 0 for a correction.
        number: its own number in the log, once it is saved.
        state: waiting, saving, saved or failed.
        said: what it does, or why it failed.
    """

    folder: Path
    what: Correction | None
    author: str
    undoes: int = 0
    number: int = 0
    state: str = WAITING
    said: str = ""


class Saver:
    """Saves corrections one after the other, in the order in which they are asked for.

    It may be used from several threads at once.

    Args:
        correct: adds corrections to the session in a folder, or takes some back, by whom.
        report: makes the report of the session in a folder again; None where `correct` does.
        calm_s: for so long nobody may have corrected a session before its report is made, s.
    """

    def __init__(
        self, correct: Correct, report: Report | None = None, calm_s: float = _CALM_S
    ) -> None:
        self._correct = correct
        self._report = report
        self._calm_s = calm_s
        self._changed = threading.Condition()
        self._tickets: list[Ticket] = []
        self._reports: dict[Path, float] = {}  # when each is due
        self._reporting: Path | None = None
        self._thread: threading.Thread | None = None

    def add(self, folder: Path, what: Correction, author: str) -> Ticket:
        """Ask for a correction; it is saved later.

        Args:
            folder: the session folder.
            what: the correction.
            author: who makes it.
        """
        return self._put(Ticket(folder, what, author, said=str(what)))

    def take_back(self, folder: Path, number: int, author: str) -> Ticket:
        """Ask that an entry of the log is taken back.

        Args:
            folder: the session folder.
            number: number of the entry.
            author: who takes it back.
        """
        return self._put(Ticket(folder, None, author, number, said=f"{number} is taken back"))

    def wait(self, ticket: Ticket) -> None:
        """Wait until a correction is saved.

        Args:
            ticket: what `add` or `take_back` returned.

        Raises:
            LiexError: it could not be.
        """
        with self._changed:
            self._changed.wait_for(lambda: ticket.state in (SAVED, FAILED))
        if ticket.state == FAILED:
            raise LiexError(ticket.said)

    def busy(self, folder: Path) -> tuple[int, bool]:
        """How many corrections of a session are not saved yet, and whether its report is old.

        Args:
            folder: the session folder.
        """
        with self._changed:
            unsaved = sum(ticket.folder == folder for ticket in self._tickets)
            return unsaved, folder in self._reports or self._reporting == folder

    def finish(self, folder: Path | None = None) -> None:
        """Return when all is saved and the reports are made.

        Args:
            folder: of this session alone; None of all.
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
        """Save what waits, for as long as the program runs."""
        while True:
            batch, report = self._next()
            if batch:
                self._save(batch)
            elif report is not None and self._report is not None:
                with suppress(LiexError, OSError):  # `liex report` says what is wrong
                    self._report(report)
                with self._changed:
                    self._reporting = None
                    self._changed.notify_all()

    def _next(self) -> tuple[list[Ticket], Path | None]:
        """What to do next: corrections of one session by one person, or else a report."""
        with self._changed:
            while True:
                if self._tickets:
                    first = self._tickets[0]
                    batch: list[Ticket] = []
                    for ticket in self._tickets:
                        if (ticket.folder, ticket.author) != (first.folder, first.author):
                            break
                        if ticket.what is None and any(one.what for one in batch):
                            break  # what is taken back goes first in a log's step
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
        """Save some corrections together; one by one where together they cannot be."""
        try:
            self._once(batch)
        except Exception as error:  # whatever it is, the others are still to be saved
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
