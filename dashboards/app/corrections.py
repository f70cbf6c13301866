"""Corrections from the pages: checked at once, saved in batches by one thread; blinded reviews.

All corrections of a session together determine its tables, so the corrections waiting for one
session are applied in one batch. The report takes longer; it is made again after a while without
corrections. A page polls the state of its corrections.
"""

import math
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from flask import Response, request

from liex_lab.arrays import Array
from liex_lab.errors import LiexError, SessionError, one_line
from liex_lab.sessions import correcting, corrections
from liex_lab.sessions.review import (
    Clip,
    Review,
    checked_name,
    drawn_review,
    read_review,
    review_names,
    write_review,
)

from .data import StudyData
from .desk import Desk, Stretch, coloured_actions

Correct = Callable[..., object]
Report = Callable[[Path], object]

SAVED = "saved"
FAILED = "failed"


@dataclass
class Ticket:
    """A queued correction, or the request to undo one.

    Attributes:
        folder: the session folder.
        what: the correction; None undoes one.
        author: the author of the request.
        message: its effect, or why it failed.
        undoes: number of the log entry to undo; 0 for a correction.
        id: its number in the queue.
        number: its own number in the log, once saved.
        state: waiting, saving, saved or failed.
    """

    folder: Path
    what: corrections.Correction | None
    author: str
    message: str
    undoes: int = 0
    id: int = 0
    number: int = 0
    state: str = "waiting"


class Saver:
    """Saves corrections in the order in which they are requested.

    Thread-safe.

    Args:
        correct: adds corrections to the session in a folder, or undoes some; called with the
            folder, the corrections, and `undo` and `author`.
        report: makes the report of the session in a folder again.
        calm_s: time without corrections before a session's report is made again, s.
    """

    def __init__(self, correct: Correct, report: Report, calm_s: float = 3.0) -> None:
        self._correct = correct
        self._report = report
        self._calm_s = calm_s
        self._changed = threading.Condition()
        self._known: dict[int, Ticket] = {}
        self._waiting: list[Ticket] = []
        self._reports: dict[Path, float] = {}  # due times
        self._reporting: Path | None = None
        self._thread = threading.Thread(target=self._work, daemon=True)

    def add(self, folder: Path, what: corrections.Correction, author: str) -> Ticket:
        """Queue a correction by `author` of the session in `folder`."""
        return self._put(Ticket(folder, what, author, str(what)))

    def take_back(self, folder: Path, number: int, author: str) -> Ticket:
        """Queue the undoing of the log entry `number`."""
        return self._put(Ticket(folder, None, author, f"{number} is taken back", number))

    def wait(self, ticket: Ticket) -> None:
        """Wait until the correction of a ticket is saved.

        Raises:
            LiexError: it could not be saved.
        """
        with self._changed:
            self._changed.wait_for(lambda: ticket.state in (SAVED, FAILED))
        if ticket.state == FAILED:
            raise LiexError(ticket.message)

    def tickets(self, folder: Path) -> dict[int, Ticket]:
        """The tickets of a session by their number, the latest last."""
        with self._changed:
            return {n: ticket for n, ticket in self._known.items() if ticket.folder == folder}

    def busy(self, folder: Path) -> tuple[int, bool]:
        """The number of unsaved corrections of a session, and whether its report is out of date."""
        with self._changed:
            return sum(ticket.folder == folder for ticket in self._waiting), folder in (
                *self._reports,
                self._reporting,
            )

    def finish(self) -> None:
        """Return when all corrections are saved and the reports are made."""
        with self._changed:
            while self._waiting or self._reports or self._reporting is not None:
                self._reports = dict.fromkeys(self._reports, 0.0)
                self._changed.notify_all()
                self._changed.wait(0.1)

    def _put(self, ticket: Ticket) -> Ticket:
        with self._changed:
            ticket.id = max(self._known, default=0) + 1
            self._known[ticket.id] = ticket
            if len(self._known) > 1000:  # the latest thousand tickets are kept
                self._known.pop(min(self._known))
            self._waiting.append(ticket)
            if ticket.id == 1:
                self._thread.start()
            self._changed.notify_all()
        return ticket

    def _work(self) -> None:
        """Save queued corrections for as long as the program runs."""
        while True:
            batch, report = self._next()
            if batch:
                self._save(batch)
            elif report is not None:
                with suppress(LiexError, OSError):  # `liex report` shows the error
                    self._report(report)
                with self._changed:
                    self._reporting = None
                    self._changed.notify_all()

    def _next(self) -> tuple[list[Ticket], Path | None]:
        """The next task: corrections of one session by one person, or else a report."""
        with self._changed:
            while not self._waiting:
                now = time.monotonic()
                folder = min(self._reports, key=self._reports.__getitem__, default=None)
                if folder is not None and self._reports[folder] <= now:
                    self._reporting = folder
                    del self._reports[folder]
                    return [], folder
                self._changed.wait(None if folder is None else self._reports[folder] - now + 0.01)
            first, batch = self._waiting[0], list[Ticket]()
            for ticket in self._waiting:
                if (ticket.folder, ticket.author) != (first.folder, first.author):
                    break
                if ticket.what is None and any(one.what for one in batch):
                    break  # a step of the log begins with its undos
                ticket.state = "saving"
                batch.append(ticket)
            return batch, None

    def _save(self, batch: list[Ticket]) -> None:
        """Save a batch of corrections; one by one if the batch fails."""
        folder = batch[0].folder
        what = [ticket.what for ticket in batch if ticket.what is not None]
        undo = [ticket.undoes for ticket in batch if ticket.what is None]
        try:
            self._correct(folder, what, undo=undo, author=batch[0].author)
            for entry in reversed(corrections.read_log(folder).entries):
                for ticket in reversed(batch):
                    made = (entry.what, entry.undoes) == (ticket.what, ticket.undoes)
                    if made and not ticket.number:
                        ticket.number = entry.number
                        break
        except Exception as error:  # the other corrections must still be saved
            if len(batch) == 1:
                reason = str(error) if isinstance(error, LiexError) else one_line(error)
                self._settle(batch, FAILED, reason or type(error).__name__)
            for ticket in batch if len(batch) > 1 else ():
                self._save([ticket])
        else:
            self._settle(batch, SAVED)

    def _settle(self, batch: list[Ticket], state: str, reason: str = "") -> None:
        with self._changed:
            for ticket in batch:
                ticket.state = state
                ticket.message = reason or ticket.message
                self._waiting.remove(ticket)
            if state == SAVED:
                self._reports[batch[0].folder] = time.monotonic() + self._calm_s
            self._changed.notify_all()


@dataclass(frozen=True)
class Clerk:
    """Answers the correction page: a session's data, and its corrections.

    Attributes:
        desk: finds the desk of a session by its key.
        saver: saves the corrections.
    """

    desk: Callable[[str], Desk]
    saver: Saver

    def about(self, key: str) -> dict[str, Any]:
        """Facts about the session `key`; for a session without poses, the reason and no n."""
        try:
            return self.desk(key).about()
        except LiexError as error:
            return {"message": str(error)}

    def times(self, key: str) -> Response:
        """The frame times of the session `key`, s; empty without poses."""
        try:
            return binary(self.desk(key).time_s)
        except LiexError:  # the page shows the reason
            return binary(np.zeros(0))

    def doubts(self, key: str) -> list[Stretch]:
        """The doubtful stretches of the session `key`: of poses, or with ?of=actions of actions."""
        desk = self.desk(key)
        return desk.suggested if request.args.get("of") == "actions" else desk.doubts()

    def frame(self, key: str, row: int) -> Response:
        """The part ?box=left,top,width,height of the frame in a `row` of the session `key`."""
        return frame_part(self.desk(key), row, cached_s=3600)  # the address names the session

    def state(self, key: str) -> dict[str, Any]:
        """The state of a session's corrections: unsaved, report, tickets, and the log.

        Raises:
            SessionError: there is no such session.
        """
        desk = self.desk(key)
        unsaved, old = self.saver.busy(desk.session.path)
        return {
            "unsaved": unsaved,
            "report_old": old,
            "tickets": {
                str(n): {"state": one.state, "message": one.message, "number": one.number}
                for n, one in self.saver.tickets(desk.session.path).items()
            },
            "log": desk.log(),
            "redo": desk.redo(),
            "notes": desk.notes,
        }

    def correct(self, key: str) -> Any:
        """Check a correction of the session `key` and queue it; returns its ticket and its effect.

        The request is JSON with by, at_s (the displayed moment), and one of: sentence, optionally
        with try; undo with a number or a ticket; redo. While a joint is dragged, its correction is
        only checked (try) and not queued.

        Raises:
            LiexError: the request is invalid.
        """
        asked = request.get_json(silent=True)  # another site's form cannot send JSON
        saver = self.saver
        if not isinstance(asked, dict):
            return {"message": "no correction is taken here"}, 400
        desk = self.desk(key)
        folder = desk.session.path
        author = _text(asked, "by")
        if asked.get("undo"):
            ticket = saver.take_back(folder, _number_of(saver, folder, asked), author)
        elif asked.get("redo"):
            return _redo(saver, folder, author)
        else:
            what = correction_in(desk, _text(asked, "sentence"), _number(asked, "at_s"))
            if asked.get("try"):
                return {"ticket": None, "message": str(what), **vars(what)}
            ticket = saver.add(folder, what, author)
        return {"ticket": ticket.id, "message": ticket.message}


def _number_of(saver: Saver, folder: Path, asked: dict[str, Any]) -> int:
    """The log's number of the correction to undo, from that number or from its ticket."""
    number = asked.get("number")
    if "ticket" in asked:
        ticket = saver.tickets(folder).get(int(_number(asked, "ticket")))
        if ticket is None:
            raise SessionError("that correction is not known here; take it back from the list")
        saver.wait(ticket)
        number = ticket.number
    if not isinstance(number, int) or isinstance(number, bool):
        raise SessionError(f"a correction is taken back by its number, got {number!r}")
    return number


def _redo(saver: Saver, folder: Path, author: str) -> dict[str, Any]:
    """Repeat the last undone correction, once the queue is saved; returns its number."""
    for ticket in [*saver.tickets(folder).values()][-1:]:
        saver.wait(ticket)
    log = corrections.read_log(folder)
    if log.redoable is None:
        raise SessionError("nothing was taken back since the last new correction")
    number, what = log.redoable
    ticket = saver.take_back(folder, number, author)
    return {"ticket": ticket.id, "message": f"made again: {what}", "number": log.undos[number]}


def correction_in(desk: Desk, sentence: str, at_s: float) -> corrections.Correction:
    """The correction in a sentence, see `correcting.parse_correction`.

    `flip` alone exchanges head and tail in the doubtful stretch at the moment, else in its frame.

    Args:
        desk: the session's current state.
        sentence: the sentence.
        at_s: the displayed moment, s since the first frame.

    Raises:
        LiexError: the correction is invalid.
    """
    if sentence != "flip":
        return correcting.parse_correction(desk.session, sentence, at_s)
    row = int(np.abs(desk.time_s - at_s).argmin())
    start_s, stop_s = np.append(desk.time_s, desk.time_s[-1] + 1.0)[row : row + 2].tolist()
    flips = desk.session.flips
    here = flips[(flips["start_s"] <= at_s) & (at_s <= flips["stop_s"])]
    if len(here):
        start_s, stop_s = float(here["start_s"].iloc[0]), max(float(here["stop_s"].iloc[0]), stop_s)
    return correcting.flip_span(desk.session, start_s, stop_s)


def _number(asked: dict[str, Any], name: str) -> float:
    value = asked.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise SessionError(f"this needs a number for {name}, got {value!r}")
    return float(value)


def _text(asked: dict[str, Any], name: str) -> str:
    value = asked.get(name, "")
    if not isinstance(value, str) or len(value) > 200:
        raise SessionError(f"this needs a text of up to 200 letters for {name}")
    return value.strip()


def binary(times: Array) -> Response:
    """Times for a page: little-endian float64."""
    return Response(times.astype("<f8").tobytes(), mimetype="application/octet-stream")


def frame_part(desk: Desk, row: int, cached_s: int) -> Response:
    """PNG of the requested part ?box=left,top,width,height of a frame.

    Args:
        desk: the session.
        row: the frame's row.
        cached_s: how long a browser keeps the image, s.

    Raises:
        SessionError: there is no such frame or part.
    """
    try:
        box = [int(one) for one in request.args.get("box", "").split(",")]
    except ValueError:
        box = []
    if len(box) != 4 or max(map(abs, box)) > 1 << 16:
        raise SessionError("a part of an image is left, top, width and height in pixels")
    answer = Response(desk.image(row, box), mimetype="image/png")
    answer.headers["Cache-Control"] = f"private, max-age={cached_s}"
    return answer


# Blinded review: clips in random order, without group, subject or session. A browser only receives
# a clip's number; other labels are sent after the rater's last answer.


@dataclass(frozen=True)
class Reviews:
    """The reviews of a study, one file each.

    Attributes:
        data: the study.
        desk: finds the desk of a session by its key.
        folder: of the review files.
        lock: held while a file is written.
    """

    data: StudyData
    desk: Callable[[str], Desk]
    folder: Path
    lock: threading.Lock = field(default_factory=threading.Lock)

    def names(self) -> list[str]:
        """Names of the reviews."""
        return list(review_names(self.folder))

    def begin(self) -> dict[str, str]:
        """Resume the named review, or draw a new one; returns its name.

        The request is JSON with name, rater, n (clips) and seed.

        Raises:
            SessionError: one of these is invalid.
        """
        asked = _asked()
        name = checked_name(str(asked.get("name", "")), "a review")
        checked_name(str(asked.get("rater", "")), "a rater")
        with self.lock:
            if name not in self.names():
                n, seed = (asked.get(key) for key in ("n", "seed"))
                if type(n) is not int or type(seed) is not int or not 0 <= seed < 1 << 53:
                    raise SessionError(
                        "a review needs a number of clips and a seed, a whole number"
                    )
                self._write(
                    drawn_review(
                        name,
                        {entry.key: self.data.session(entry.key) for entry in self.data.done},
                        n,
                        seed,
                    )
                )
        return {"name": name}

    def state(self, name: str, rater: str | None = None) -> dict[str, Any]:
        """What a rater may see: the words, the order and own answers; at the end the agreement.

        Args:
            name: the review.
            rater: the rater; None takes ?rater=.

        Raises:
            SessionError: there is no such review.
        """
        review = read_review(self.folder, name)
        rater = checked_name(rater or request.args.get("rater", ""), "a rater")
        done = review.done_by(rater)
        return {
            "words": coloured_actions(review.words),
            "order": review.order(rater),
            "answers": {str(k): word for k, word in review.answers.get(rater, {}).items()},
            "done": done,
            **({"agreements": _agreements(review)} if done else {}),
        }

    def answer(self, name: str) -> dict[str, Any]:
        """Save an answer, JSON with rater, clip and word; returns the new state.

        Raises:
            SessionError: one of these is invalid.
        """
        asked = _asked()
        clip, word, rater = asked.get("clip"), asked.get("word"), str(asked.get("rater", ""))
        if type(clip) is not int or not isinstance(word, str):
            raise SessionError("an answer is the number of a clip and a word")
        with self.lock:
            self._write(read_review(self.folder, name).answered(rater, clip, word))
        return self.state(name, rater)

    def _write(self, review: Review) -> None:
        try:
            write_review(self.folder, review)
        except OSError as error:
            raise SessionError(f"the review cannot be saved: {error}") from None

    def clip(self, name: str, number: int) -> tuple[Clip, Desk, int, int]:
        """A clip, the desk of its session, its first row and the row after its last one.

        Raises:
            SessionError: there is no such clip.
        """
        review = read_review(self.folder, name)
        if not 0 <= number < len(review.clips):
            raise SessionError(f"there is no clip {number}")
        clip = review.clips[number]
        desk = self.desk(clip.session)
        first, stop = np.searchsorted(desk.time_s, [clip.start_s - 5e-4, clip.stop_s + 5e-4])
        return clip, desk, int(first), max(int(stop), int(first) + 1)

    def about(self, name: str, number: int) -> dict[str, Any]:
        """Facts for drawing a clip: size, joints and the moment to be named.

        Raises:
            SessionError: there is no such clip.
        """
        clip, desk, first, stop = self.clip(name, number)
        facts = desk.about()
        shown = ("frame_s", "width", "height", "joints", "bones")
        return {
            **{key: facts[key] for key in shown},
            "n": stop - first,
            "duration_s": float(desk.time_s[stop - 1] - desk.time_s[first]),
            "moment_s": float(clip.at_s - desk.time_s[first]),
            "animals": [{"name": "", "half_px": one["half_px"]} for one in facts["animals"]],
        }

    def times(self, name: str, number: int) -> Response:
        """Times of a clip's frames since its first one."""
        _, desk, first, stop = self.clip(name, number)
        return binary(desk.time_s[first:stop] - desk.time_s[first])

    def rows(self, name: str, number: int, start: int, end: int) -> dict[str, Any]:
        """Joints and middles of a clip's frames from `start` to before `end`."""
        _, desk, first, stop = self.clip(name, number)
        found = desk.rows(min(first + start, stop), min(first + end, stop))
        n = len(found["flag"])
        return {**found, "first": start, "frame": [0] * n, "flag": [""] * n}

    def frame(self, name: str, number: int, row: int) -> Response:
        """The part ?box=left,top,width,height of a frame of a clip."""
        _, desk, first, stop = self.clip(name, number)
        return frame_part(desk, first + row if row < stop - first else -1, cached_s=600)


def _asked() -> dict[str, Any]:
    """The JSON of the request; another site's form cannot send JSON."""
    sent = request.get_json(silent=True)
    if not isinstance(sent, dict):
        raise SessionError("this takes JSON")
    return sent


def _agreements(review: Review) -> list[dict[str, Any]]:
    found = []
    for first, second, agreement in review.agreements():
        numbers = {name: getattr(agreement, name) for name in ("observed", "kappa", "low", "high")}
        rounded = {k: None if math.isnan(v) else round(v, 4) for k, v in numbers.items()}
        found.append({"first": first, "second": second, "n": agreement.n, **rounded})
    return found
