"""Routes of the correction page: JSON and images of a session, and its corrections.

A correction is checked at once and saved by the queue of `saver`; the page polls its state.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from flask import Flask, Response, jsonify, make_response, request

from liex_lab.errors import LiexError, SessionError
from liex_lab.sessions import correcting
from liex_lab.sessions.corrections import Correction, read_log

from .desk import Desk, Desks
from .saver import Saver, Ticket

_KEPT_TICKETS = 1000
_PICTURE_S = 3600  # browser cache time of an image; its address identifies the session


class Clerk:
    """Accepts corrections from the page and keeps their tickets by number.

    Args:
        desks: the study's sessions.
        saver: saves the corrections.
    """

    def __init__(self, desks: Desks, saver: Saver) -> None:
        self._desks = desks
        self._saver = saver
        self._lock = threading.Lock()
        self._tickets: dict[int, tuple[str, Ticket]] = {}

    def take(self, key: str, asked: dict[str, Any]) -> dict[str, Any]:
        """Check a request and queue it; returns its ticket and its effect.

        While a joint is dragged, its correction is only checked and not queued.

        Args:
            key: the session's name in the study.
            asked: by, at_s (the displayed moment), and one of: sentence, optionally with try; undo
                with a number or a ticket; redo.

        Raises:
            LiexError: the request is invalid.
        """
        desk = self._desks.of(key)
        author = _text(asked, "by")
        if asked.get("undo"):
            return self._undo(key, desk, asked, author)
        if asked.get("redo"):
            return self._redo(key, desk, author)
        what = correction_in(desk, _text(asked, "sentence"), _number(asked, "at_s"))
        if asked.get("try"):
            return {"ticket": None, "said": str(what), **vars(what)}
        return self._kept(key, self._saver.add(desk.session.path, what, author))

    def state(self, key: str) -> dict[str, Any]:
        """The state of a session's corrections: unsaved, report, tickets, and the log.

        Raises:
            SessionError: there is no such session.
        """
        desk = self._desks.of(key)
        unsaved, old = self._saver.busy(desk.session.path)
        with self._lock:
            ours = {n: one for n, (of, one) in self._tickets.items() if of == key}
        return {
            "unsaved": unsaved,
            "report_old": old,
            "tickets": {
                str(n): {"state": one.state, "said": one.said, "number": one.number}
                for n, one in ours.items()
            },
            "log": desk.log(),
            "redo": desk.redo(),
            "notes": desk.notes,
        }

    def _undo(self, key: str, desk: Desk, asked: dict[str, Any], author: str) -> dict[str, Any]:
        """Undo a correction by its ticket or its number in the log."""
        folder = desk.session.path
        number = asked.get("number")
        if "ticket" in asked:
            with self._lock:
                of, ticket = self._tickets.get(int(_number(asked, "ticket")), ("", None))
            if ticket is None or of != key:
                raise SessionError("that correction is not known here; take it back from the list")
            self._saver.wait(ticket)
            number = ticket.number
        if not isinstance(number, int) or isinstance(number, bool):
            raise SessionError(f"a correction is taken back by its number, got {number!r}")
        return self._kept(key, self._saver.take_back(folder, number, author))

    def _redo(self, key: str, desk: Desk, author: str) -> dict[str, Any]:
        """Repeat the last undone correction, once the queue is saved; returns its number."""
        with self._lock:
            ours = [ticket for of, ticket in self._tickets.values() if of == key]
        if ours:
            self._saver.wait(ours[-1])
        log = read_log(desk.session.path)
        if log.redoable is None:
            raise SessionError("nothing was taken back since the last new correction")
        number, what = log.redoable
        kept = self._kept(key, self._saver.take_back(desk.session.path, number, author))
        return {**kept, "said": f"made again: {what}", "number": log.undos[number]}

    def _kept(self, key: str, ticket: Ticket) -> dict[str, Any]:
        with self._lock:
            number = max(self._tickets, default=0) + 1
            self._tickets[number] = (key, ticket)
            while len(self._tickets) > _KEPT_TICKETS:
                self._tickets.pop(next(iter(self._tickets)))
        return {"ticket": number, "said": ticket.said}


def correction_in(desk: Desk, sentence: str, at_s: float) -> Correction:
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
    row = desk.row_at(at_s)
    after_s = desk.time_s[row + 1] if row + 1 < len(desk.time_s) else desk.time_s[row] + 1.0
    start_s, stop_s = float(desk.time_s[row]), float(after_s)
    flips = desk.session.flips
    here = flips[(flips["start_s"] <= at_s) & (at_s <= flips["stop_s"])]
    if len(here):
        start_s, stop_s = float(here["start_s"].iloc[0]), max(float(here["stop_s"].iloc[0]), stop_s)
    return correcting.flip_span(desk.session, start_s, stop_s)


def add_routes(server: Flask, desks: Desks, clerk: Clerk | None) -> None:
    """Add the routes of the correction page; they are protected by the server's guard.

    Without a `clerk`, no corrections are accepted.
    """

    def told(make: Callable[[], Any], refused: int = 400) -> Response:
        """JSON of the result of `make`, or a message with the status `refused`."""
        try:
            return jsonify(make())
        except LiexError as error:
            return make_response({"said": str(error)}, refused)

    @server.before_request
    def ahead() -> None:
        """Prepare the image of a requested session page before the browser asks for it."""
        if request.path.startswith("/session/"):
            desks.open_ahead(request.path.removeprefix("/session/"))

    @server.get("/desk/<path:key>/about")
    def desk_about(key: str) -> Response:
        """Facts about the session `key`; for a session without poses, the reason and no n."""
        return told(lambda: {**desks.of(key).about(), "may_correct": clerk is not None}, 200)

    @server.get("/desk/<path:key>/times")
    def desk_times(key: str) -> Response:
        """The frame times of the session `key`, s: little-endian float64; empty without poses."""
        try:
            times = desks.of(key).time_s
        except LiexError:  # the page shows the reason
            times = np.zeros(0)
        return Response(times.astype("<f8").tobytes(), mimetype="application/octet-stream")

    @server.get("/desk/<path:key>/rows/<int:first>/<int:stop>")
    def desk_rows(key: str, first: int, stop: int) -> Response:
        """The overlay of the rows from `first` to before `stop` of the session `key`."""
        return told(lambda: desks.of(key).rows(first, stop))

    @server.get("/desk/<path:key>/bouts")
    def desk_bouts(key: str) -> Response:
        """The bouts of the session `key`."""
        return told(lambda: desks.of(key).bouts())

    @server.get("/desk/<path:key>/doubts")
    def desk_doubts(key: str) -> Response:
        """The doubtful stretches of the session `key`: of poses, or with ?of=actions of actions."""
        if request.args.get("of") == "actions":
            return told(lambda: desks.suggested(key))
        return told(lambda: desks.of(key).doubts())

    @server.get("/desk/<path:key>/crossings")
    def desk_crossings(key: str) -> Response:
        """Where ends or animals of the session `key` may have been exchanged."""
        return told(lambda: desks.of(key).crossings())

    @server.get("/desk/<path:key>/frame/<int:row>.png")
    def desk_frame(key: str, row: int) -> Response:
        """The part ?box=left,top,width,height of the frame in a `row` of the session `key`."""
        try:
            box = [int(one) for one in request.args.get("box", "").split(",")]
            if len(box) != 4 or max(map(abs, box)) > 1 << 16:
                raise SessionError("a part of a picture is left, top, width and height in pixels")
            png = desks.of(key).picture(row, box)
        except (LiexError, ValueError) as error:
            return Response(str(error), 400, mimetype="text/plain")
        answer = Response(png, mimetype="image/png")
        answer.headers["Cache-Control"] = f"private, max-age={_PICTURE_S}"
        return answer

    @server.get("/desk/<path:key>/state")
    def desk_state(key: str) -> Response:
        """The state of the corrections of the session `key`."""
        if clerk is None:
            return told(lambda: {"unsaved": 0, "report_old": False, "tickets": {}, "log": []})
        return told(lambda: clerk.state(key))

    @server.post("/desk/<path:key>/correct")
    def desk_correct(key: str) -> Response:
        """Accept a correction of the session `key`, as JSON for `Clerk.take`."""
        asked = request.get_json(silent=True)  # another site's form cannot send JSON
        if clerk is None or not isinstance(asked, dict):
            said = {"said": "no correction is taken here"}
            return make_response(said, 403 if clerk is None else 400)
        return told(lambda: clerk.take(key, asked))


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
