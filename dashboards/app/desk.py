"""Data of the correction page: times, joints, bouts, doubtful stretches and depth images.

A session of an hour has a hundred thousand frames, so the page requests the joints of a few hundred
rows at a time, and one image at a time.
"""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.vocabulary import action_colours
from liex_lab.errors import LiexError, SessionError
from liex_lab.sessions import Session
from liex_lab.sessions.correcting import disagreements
from liex_lab.sessions.corrections import author_name, read_log

from ..figures.seen import animals, joints_in_picture
from ..video.film import way_of
from ..video.relief import Relief, scale_mm
from .crossings import crossings
from .frames import Frames
from .tables import records

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]
Suggest = Callable[[Path], "pd.DataFrame"]

MOST_ROWS = 2000  # per request
_LEAST_DOUBT_S = 0.5  # doubtful frames closer in time form one stretch
_HELD = 6  # desks that stay in memory
_FIRST = (
    "liex_lab.recordings.formats.messages.mcap",
    "cv2",
    "matplotlib",
    "pyarrow.parquet",
)


class Desk:
    """The current state of one session, as JSON for the page.

    Args:
        key: the session's name in the study.
        session: the opened session.
        frames: the depth images.
    """

    def __init__(self, key: str, session: Session, frames: Frames) -> None:
        self.key = key
        self.session = session
        self._frames = frames
        self.seen = animals(session)

    @cached_property
    def time_s(self) -> Array:
        """(n,) times of the frames, s."""
        return self.seen[0].frames["time_s"].to_numpy(float)

    @cached_property
    def _numbers(self) -> dict[str, Any]:
        """Columns of `frames` that are sent for every frame."""
        names = ["flag", "predicted_error_mm", "p_flip", "frame_index"]
        if len(self.seen) > 1:
            names.append("individual")
        table = self.session.table("frames", names)
        if len(self.seen) > 1:
            table = table[table["individual"].astype(str) == self.seen[0].individual]
        return {name: table[name].to_numpy() for name in names}

    @cached_property
    def uv(self) -> list[Array]:
        """The joints of each animal (n, J, 2), px; NaN without a pose."""
        return joints_in_picture(self.seen, len(self.time_s))

    @cached_property
    def _ways(self) -> list[tuple[Array, int]]:
        return [way_of(joints, self.session.camera) for joints in self.uv]

    @cached_property
    def _relief(self) -> Relief:
        return Relief(self.session, scale_mm([self.session]))

    @cached_property
    def notes(self) -> list[str]:
        """Sentences on exchanges of head and tail that contradict the neighbouring frames."""
        return disagreements(self.session)

    def row_at(self, at_s: float) -> int:
        """Row of the frame nearest in time to `at_s` (s since the first frame)."""
        return int(np.abs(self.time_s - at_s).argmin())

    def open_ahead(self) -> None:
        """Prepare the data of the first image before it is requested."""
        self._frames.depth(self.key, self.session, 0)
        self.about()
        self.rows(0, 1)
        len(self.session.frames)  # shown on the page

    def about(self) -> dict[str, Any]:
        """Facts that the page needs once: size, animals, coloured actions, and the author."""
        camera = self.session.camera
        animal = self.session.metadata["animal"]
        words = list(self.session.metadata.get("actions") or {})
        colours = action_colours(words)
        steps = np.diff(self.time_s)
        return {
            "n": len(self.time_s),
            "duration_s": float(self.time_s[-1]),
            "frame_s": float(np.median(steps)) if len(steps) else 1.0 / 30.0,
            "width": camera.width,
            "height": camera.height,
            "top_mm": self._relief.top_mm,
            "joints": [str(name) for name in animal["joints"]],
            "bones": [[int(a), int(b)] for a, b in animal["bones"]],
            "animals": [
                {"name": seen.who, "half_px": half}
                for seen, (_, half) in zip(self.seen, self._ways, strict=True)
            ],
            "actions": [
                {"word": word, "title": word.replace("_", " "), "colour": colours[word]}
                for word in words
            ],
            "author": author_name(),
        }

    def rows(self, first: int, stop: int) -> dict[str, Any]:
        """The overlay of some frames: joints, the view's centre, flags and errors.

        Args:
            first: the first row.
            stop: the row after the last one; at most `MOST_ROWS` rows are returned.
        """
        first = int(np.clip(first, 0, len(self.time_s)))
        rows = slice(first, int(np.clip(stop, first, min(len(self.time_s), first + MOST_ROWS))))
        numbers = self._numbers
        return {
            "first": first,
            "flag": ["" if flag is None else str(flag) for flag in numbers["flag"][rows]],
            "error_mm": _plain(numbers["predicted_error_mm"][rows]),
            "p_flip": _plain(numbers["p_flip"][rows]),
            "frame": [int(index) for index in numbers["frame_index"][rows]],
            "animals": [
                {"uv": _plain(uv[rows]), "middle": _plain(middle[rows])}
                for uv, (middle, _) in zip(self.uv, self._ways, strict=True)
            ],
        }

    def bouts(self) -> list[dict[str, Any]]:
        """Every bout: action, start_s, stop_s, source and score."""
        names = ("action", "start_s", "stop_s", "source", "score")
        table = self.seen[0].bouts
        columns = [table[name].tolist() for name in names]
        return [
            {
                "action": str(action),
                "start_s": float(start),
                "stop_s": float(stop),
                "source": str(source),
                "score": None if not np.isfinite(score) else round(float(score), 3),
            }
            for action, start, stop, source, score in zip(*columns, strict=True)
        ]

    def doubts(self) -> list[dict[str, Any]]:
        """Doubtful stretches of poses in order of time: start_s, stop_s, kind and why."""
        found: list[dict[str, Any]] = [
            {"start_s": a, "stop_s": b, "kind": "pose", "why": f"pose in doubt: {_error(error)}"}
            for a, b, error in self._doubtful_runs()
        ]
        flips = self.session.flips
        for flip in records(flips[~flips["applied"].astype(bool)]):
            why = f"head and tail perhaps exchanged (p {float(flip['p_flip']):.2f})"
            found.append(_doubt(flip, "flip", why))
        bouts = self.session.bouts
        if "contradicts" in bouts:
            for bout in records(bouts[bouts["contradicts"].fillna("").astype(str) != ""]):
                word = str(bout["action"]).replace("_", " ")
                why = f"{word} contradicts its definition: {bout['contradicts']}"
                found.append(_doubt(bout, "action", why))
        return sorted(found, key=lambda one: one["start_s"])

    def crossings(self) -> list[dict[str, Any]]:
        """Where ends or animals may have been exchanged, see `crossings.Crossing`."""
        return crossings(self.session, self.seen)

    def _doubtful_runs(self) -> list[tuple[float, float, float]]:
        """Start, stop (s) and largest predicted error (mm) of the runs of doubtful frames."""
        rows = np.flatnonzero(self._numbers["flag"].astype(str) == "doubtful")
        if not len(rows):
            return []
        far = np.flatnonzero(np.diff(self.time_s[rows]) > _LEAST_DOUBT_S) + 1
        error = self._numbers["predicted_error_mm"].astype(float)
        return [
            (float(self.time_s[run[0]]), float(self.time_s[run[-1]]), float(error[run].max()))
            for run in np.split(rows, far)
        ]

    def log(self) -> list[dict[str, Any]]:
        """The corrections in effect: number, message (said), author and date."""
        return [
            {
                "number": entry.number,
                "said": str(entry.what),
                "author": entry.author,
                "made_at": entry.made_at,
            }
            for entry in read_log(self.session.path).standing
        ]

    def redo(self) -> str:
        """The correction that was last undone and can be repeated; "" if none."""
        redoable = read_log(self.session.path).redoable
        return "" if redoable is None else str(redoable[1])

    def picture(self, row: int, box: Sequence[int]) -> bytes:
        """PNG of a part of a frame as relief: height above the floor in colours, with shading.

        Args:
            row: the frame's row.
            box: left, top, width and height of the part, px; clipped to the image.

        Raises:
            SessionError: there is no such frame, or the box lies outside the image.
        """
        import cv2

        camera = self.session.camera
        left, top = (int(np.clip(box[k], 0, size)) for k, size in enumerate(_size(camera)))
        width, height = (
            int(np.clip(box[k] + box[k + 2], 0, size)) - at
            for k, (at, size) in enumerate(zip((left, top), _size(camera), strict=True))
        )
        if not 0 <= row < len(self.time_s) or width < 1 or height < 1:
            raise SessionError(f"there is no part {list(box)} of a frame in row {row}")
        depth = self._frames.depth(self.key, self.session, row)
        if depth is None:
            depth = np.zeros((camera.height, camera.width), np.uint16)
        side = (width, height)
        drawn = self._relief.picture(depth, left, top, side, side)
        done, png = cv2.imencode(".png", drawn[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if not done:
            raise SessionError(f"the picture of row {row} cannot be made")
        return bytes(png)


class Desks:
    """The desks of a study's sessions; a desk is replaced when its session changes.

    Args:
        find: opens a session by its key; returns the same object until its folder changes.
        frames: the depth images.
        suggest: finds the stretches of the session in a folder whose actions are least certain;
            None finds none.
    """

    def __init__(
        self, find: Callable[[str], Session], frames: Frames, suggest: Suggest | None = None
    ) -> None:
        self._find = find
        self._frames = frames
        self._suggest = suggest
        self._lock = threading.Lock()
        self._ahead = threading.Semaphore()
        self._known: dict[str, Desk] = {}
        self._suggested: dict[str, tuple[Session, list[dict[str, Any]]]] = {}
        threading.Thread(target=_import, daemon=True).start()

    def of(self, key: str) -> Desk:
        """The desk of the session `key`.

        Raises:
            SessionError: there is no such session.
        """
        session = self._find(key)
        with self._lock:
            known = self._known.get(key)
            if known is None or known.session is not session:
                known = self._known[key] = Desk(key, session, self._frames)
                while len(self._known) > _HELD:
                    self._known.pop(next(iter(self._known)))
            return known

    def open_ahead(self, key: str) -> None:
        """Prepare a session's first image in a thread; does nothing if another is being prepared.

        An unknown `key` is ignored.
        """

        def make() -> None:
            try:
                self.of(key).open_ahead()
            except LiexError:  # the page shows the reason
                pass
            finally:
                self._ahead.release()

        if self._ahead.acquire(blocking=False):
            threading.Thread(target=make).start()  # short; the interpreter waits for it at exit

    def suggested(self, key: str) -> list[dict[str, Any]]:
        """The stretches whose actions are least certain, as `Desk.doubts`; none without a model.

        Raises:
            SessionError: there is no such session.
        """
        session = self._find(key)
        with self._lock:
            known = self._suggested.get(key)
        if known is not None and known[0] is session:
            return known[1]
        found: list[dict[str, Any]] = []
        if self._suggest is not None:
            try:
                rows = self._suggest(session.path)
            except LiexError:  # no recogniser for this animal
                rows = None
            for row in records(rows) if rows is not None else ():
                words = [str(row[name]).replace("_", " ") for name in ("guess", "or_else")]
                found.append(_doubt(row, "action", f"{words[0]} or {words[1]}?"))
        with self._lock:
            self._suggested[key] = (session, found)
        return found


def _doubt(span: dict[str, Any], kind: str, why: str) -> dict[str, Any]:
    return {
        "start_s": float(span["start_s"]),
        "stop_s": float(span["stop_s"]),
        "kind": kind,
        "why": why,
    }


def _import() -> None:
    """Import the modules that the first image needs, ahead of its request."""
    for name in _FIRST:
        importlib.import_module(name)


def _size(camera: Any) -> tuple[int, int]:
    return camera.width, camera.height


def _error(error_mm: float) -> str:
    return f"error {error_mm:.1f} mm" if np.isfinite(error_mm) else "error not known"


def _plain(values: Any) -> Any:
    """An array for JSON: two decimals, and None for values that are not finite."""
    array = np.asarray(values, float)
    rounded = np.round(array, 2).astype(object)
    rounded[~np.isfinite(array)] = None
    return rounded.tolist()
