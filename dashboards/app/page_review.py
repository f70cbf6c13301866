"""The dashboard's blinded review: clips in random order, without group, subject or session.

A rater's browser only receives a clip's number and requests images and joints by that number. The
labels of the program and of other raters are sent after the rater's last answer.
"""

import math
import threading
from pathlib import Path
from typing import Any

import numpy as np
from flask import Response, request

from liex_lab.errors import SessionError
from liex_lab.sessions.review import (
    Clip,
    Review,
    checked_name,
    drawn_review,
    read_review,
    review_names,
    write_review,
)

from .corrections import binary, frame_part
from .data import StudyData
from .desk import Desk, Desks, coloured_actions

_IMAGE_S = 600  # browser cache time of an image


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

    def begin(self) -> dict[str, str]:
        """Resume the named review, or draw a new one; returns its name.

        The request is JSON with name, rater, n (clips) and seed.

        Raises:
            SessionError: one of these is invalid.
        """
        asked = _asked()
        name = checked_name(str(asked.get("name", "")), "a review")
        checked_name(str(asked.get("rater", "")), "a rater")
        with self._lock:
            if name not in self.names():
                n, seed = (asked.get(key) for key in ("n", "seed"))
                if type(n) is not int or type(seed) is not int or not 0 <= seed < 1 << 53:
                    raise SessionError(
                        "a review needs a number of clips and a seed, a whole number"
                    )
                sessions = {entry.key: self._data.session(entry.key) for entry in self._data.done}
                self._write(drawn_review(name, sessions, n, seed))
        return {"name": name}

    def state(self, name: str, rater: str | None = None) -> dict[str, Any]:
        """What a rater may see: the words, the order and own answers; at the end the agreement.

        Args:
            name: the review.
            rater: the rater; None takes ?rater=.

        Raises:
            SessionError: there is no such review.
        """
        review = read_review(self._folder, name)
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
        with self._lock:
            self._write(read_review(self._folder, name).answered(rater, clip, word))
        return self.state(name, rater)

    def _write(self, review: Review) -> None:
        try:
            write_review(self._folder, review)
        except OSError as error:
            raise SessionError(f"the review cannot be saved: {error}") from None

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
        return frame_part(desk, first + row if row < stop - first else -1, _IMAGE_S)


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
