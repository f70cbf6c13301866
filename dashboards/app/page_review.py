"""The dashboard's blinded review: clips in random order, without group, subject or session.

A rater's browser only receives a clip's number and requests images and joints by that number. The
labels of the program and of other raters are sent after the rater's last answer.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from flask import Flask, Response, jsonify, request

from liex_lab.actions.vocabulary import action_colours
from liex_lab.errors import LiexError, SessionError
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
from .desk import Desk, Desks

_PICTURE_S = 600


class Reviews:
    """The reviews of a study, one file each.

    Args:
        data: the study.
        desks: its sessions.
        folder: of the review files.
    """

    def __init__(self, data: StudyData, desks: Desks, folder: Path) -> None:
        self._data = data
        self._desks = desks
        self._folder = folder
        self._lock = threading.Lock()

    def names(self) -> list[str]:
        """Names of the reviews."""
        return list(review_names(self._folder))

    def begin(self, asked: dict[str, Any]) -> str:
        """Resume the named review, or draw a new one; returns its name.

        Args:
            asked: name, rater, n (clips) and seed.

        Raises:
            SessionError: one of these is invalid.
        """
        name = checked_name(str(asked.get("name", "")), "a review")
        checked_name(str(asked.get("rater", "")), "a rater")
        with self._lock:
            if name in self.names():
                return name
            n, seed = (asked.get(key) for key in ("n", "seed"))
            if type(n) is not int or type(seed) is not int or not 0 <= seed < 1 << 53:
                raise SessionError("a review needs a number of clips and a seed, a whole number")
            sessions = {entry.key: self._data.session(entry.key) for entry in self._data.done}
            write_review(self._folder, drawn_review(name, sessions, n, seed))
        return name

    def told(self, name: str, rater: str) -> dict[str, Any]:
        """What a rater may see: the words, the order and own answers; at the end the agreement.

        Raises:
            SessionError: there is no such review.
        """
        review = read_review(self._folder, name)
        rater = checked_name(rater, "a rater")
        colours = action_colours(review.words)
        own = review.answers.get(rater, {})
        found = {
            "words": [
                {"word": word, "title": word.replace("_", " "), "colour": colours[word]}
                for word in review.words
            ],
            "order": review.order(rater),
            "answers": {str(k): word for k, word in own.items()},
            "done": review.done_by(rater),
        }
        return found | ({"agreements": _agreements(review)} if found["done"] else {})

    def answer(self, name: str, asked: dict[str, Any]) -> dict[str, Any]:
        """Save an answer; returns the new state as `told` does.

        Args:
            name: the review.
            asked: rater, clip and word.

        Raises:
            SessionError: one of these is invalid.
        """
        clip, word = asked.get("clip"), asked.get("word")
        rater = str(asked.get("rater", ""))
        if type(clip) is not int or not isinstance(word, str):
            raise SessionError("an answer is the number of a clip and a word")
        with self._lock:
            review = read_review(self._folder, name).answered(rater, clip, word)
            write_review(self._folder, review)
        return self.told(name, rater)

    def clip(self, name: str, number: int) -> tuple[Clip, Desk, int, int]:
        """A clip, the desk of its session, its first row and the row after its last one.

        Raises:
            SessionError: there is no such clip.
        """
        review = read_review(self._folder, name)
        if not 0 <= number < len(review.clips):
            raise SessionError(f"there is no clip {number}")
        clip = review.clips[number]
        desk = self._desks.of(clip.session)
        first, stop = np.searchsorted(desk.time_s, [clip.start_s - 5e-4, clip.stop_s + 5e-4])
        return clip, desk, int(first), max(int(stop), int(first) + 1)

    def about(self, name: str, number: int) -> dict[str, Any]:
        """Facts for drawing a clip: size, joints and the moment to be named.

        Raises:
            SessionError: there is no such clip.
        """
        clip, desk, first, stop = self.clip(name, number)
        told = desk.about()
        shown = ("frame_s", "width", "height", "joints", "bones")
        return {
            **{key: told[key] for key in shown},
            "n": stop - first,
            "duration_s": float(desk.time_s[stop - 1] - desk.time_s[first]),
            "moment_s": float(clip.at_s - desk.time_s[first]),
            "animals": [{"name": "", "half_px": one["half_px"]} for one in told["animals"]],
        }


def _agreements(review: Review) -> list[dict[str, Any]]:
    return [
        {
            "first": a,
            "second": b,
            "n": found.n,
            **{
                key: None if math.isnan(value) else round(value, 4)
                for key, value in (
                    ("observed", found.observed),
                    ("kappa", found.kappa),
                    ("low", found.low),
                    ("high", found.high),
                )
            },
        }
        for a, b, found in review.agreements()
    ]


def add_reviews(server: Flask, reviews: Reviews) -> None:
    """Add the routes of blinded reviews; they are protected by the server's guard."""

    def told(make: Callable[[], Any]) -> Response:
        """JSON of the result of `make`, or status 400 with a message."""
        try:
            return jsonify(make())
        except (LiexError, OSError) as error:
            answer = jsonify({"said": str(error)})
            answer.status_code = 400
            return answer

    def asked() -> dict[str, Any]:
        """The JSON of the request; another site's form cannot send JSON."""
        sent = request.get_json(silent=True)
        if not isinstance(sent, dict):
            raise SessionError("this takes JSON")
        return sent

    @server.get("/reviews")
    def review_list() -> Response:
        """Names of the reviews."""
        return told(reviews.names)

    @server.post("/reviews")
    def review_begin() -> Response:
        """Begin or resume a review."""
        return told(lambda: {"name": reviews.begin(asked())})

    @server.get("/reviews/<path:name>/state")
    def review_state(name: str) -> Response:
        """What ?rater= may see of the review `name`."""
        return told(lambda: reviews.told(name, request.args.get("rater", "")))

    @server.post("/reviews/<path:name>/answer")
    def review_answer(name: str) -> Response:
        """Save an answer in the review `name`."""
        return told(lambda: reviews.answer(name, asked()))

    @server.get("/reviews/<path:name>/clip/<int:number>/about")
    def clip_about(name: str, number: int) -> Response:
        """Facts for drawing the clip `number` of the review `name`."""
        return told(lambda: reviews.about(name, number))

    @server.get("/reviews/<path:name>/clip/<int:number>/times")
    def clip_times(name: str, number: int) -> Response:
        """Times of the clip's frames since its first one, s: little-endian float64."""
        try:
            _, desk, first, stop = reviews.clip(name, number)
        except LiexError as error:
            return Response(str(error), 400, mimetype="text/plain")
        times = desk.time_s[first:stop] - desk.time_s[first]
        return Response(times.astype("<f8").tobytes(), mimetype="application/octet-stream")

    @server.get("/reviews/<path:name>/clip/<int:number>/rows/<int:start>/<int:end>")
    def clip_rows(name: str, number: int, start: int, end: int) -> Response:
        """Joints and middles of the clip's frames from `start` to before `end`."""

        def rows() -> dict[str, Any]:
            """The rows, counted from the clip's first one."""
            _, desk, first, stop = reviews.clip(name, number)
            found = desk.rows(min(first + start, stop), min(first + end, stop))
            n = len(found["flag"])
            return {**found, "first": start, "frame": [0] * n, "flag": [""] * n}

        return told(rows)

    @server.get("/reviews/<path:name>/clip/<int:number>/frame/<int:row>.png")
    def clip_frame(name: str, number: int, row: int) -> Response:
        """The part ?box=left,top,width,height of a frame of the clip."""
        try:
            _, desk, first, stop = reviews.clip(name, number)
            box = [int(one) for one in request.args.get("box", "").split(",")]
            if len(box) != 4 or max(map(abs, box)) > 1 << 16 or not 0 <= row < stop - first:
                raise SessionError("a part of a picture is left, top, width and height in pixels")
            png = desk.picture(first + row, box)
        except (LiexError, ValueError) as error:
            return Response(str(error), 400, mimetype="text/plain")
        answer = Response(png, mimetype="image/png")
        answer.headers["Cache-Control"] = f"private, max-age={_PICTURE_S}"
        return answer
