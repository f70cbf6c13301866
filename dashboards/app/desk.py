"""Data of the correction page: times, joints, bouts, doubtful stretches, crossings, depth images.

A session of an hour has a hundred thousand frames, so the page requests the joints of a few hundred
rows at a time, and one image at a time.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.actions.vocabulary import action_colours
from liex_lab.arrays import Array, NDArray
from liex_lab.behaviour.kinematics import IMPOSSIBLE_MM_S
from liex_lab.errors import LiexError, SessionError
from liex_lab.sessions import Session, correcting, corrections, evidence
from liex_lab.tracking.track import DOUBTFUL

from ..figures.animals import DepthImages, SessionAnimal
from ..report.contact_sheet import png
from ..report.report import contradicting
from ..video.film import Footage
from .tables import records

Suggest = Callable[[Path], pd.DataFrame]
Stretch = dict[str, Any]  # start_s, stop_s, kind and why

MOST_ROWS = 2000  # per request
_LIKELY = 0.01  # probability of an exchange below which a crossing is not listed


class Desk(Footage):
    """The current state of one session, as JSON for the page.

    Args:
        session: the opened session.
        images: the depth images.
        suggest: finds the stretches whose actions are least certain.
    """

    def __init__(self, session: Session, images: DepthImages, suggest: Suggest) -> None:
        super().__init__(session, images)
        self._suggest = suggest

    @cached_property
    def _numbers(self) -> dict[str, Any]:
        """Columns of `frames` that are sent for every frame."""
        names = ["flag", "predicted_error_mm", "p_flip", "frame_index"]
        table = self.animals[0].rows_of(
            self.session.table(
                "frames", [*names, *([] if self.animals[0].alone else ["individual"])]
            )
        )
        return {name: table[name].to_numpy() for name in names}

    @cached_property
    def notes(self) -> list[str]:
        """Sentences on exchanges of head and tail that contradict the neighbouring frames."""
        return correcting.disagreements(self.session)

    def about(self) -> dict[str, Any]:
        """Facts that the page needs once: size, animals, coloured actions, and the author."""
        animal = self.session.metadata["animal"]
        steps = np.diff(self.time_s)
        return {
            "n": len(self.time_s),
            "duration_s": float(self.time_s[-1]),
            "frame_s": float(np.median(steps)) if len(steps) else 1.0 / 30.0,
            "width": self.session.camera.width,
            "height": self.session.camera.height,
            "top_mm": self.relief.top_mm,
            "joints": [str(name) for name in animal["joints"]],
            "bones": self.bones,
            "animals": [
                {"name": one.label, "half_px": half}
                for one, (_, half) in zip(self.animals, self.paths, strict=True)
            ],
            "actions": coloured_actions(list(self.session.metadata.get("actions") or {})),
            "author": corrections.author_name(),
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
                for uv, (middle, _) in zip(self.uv, self.paths, strict=True)
            ],
        }

    def bouts(self) -> list[dict[str, Any]]:
        """Every bout: action, start_s, stop_s, source and score."""
        table = (
            self.animals[0]
            .bouts[["action", "start_s", "stop_s", "source", "score"]]
            .astype({"action": str, "source": str})
        )
        score = table["score"].astype(float).round(3).astype(object)
        return records(table.assign(score=score.where(score.notna(), None)))

    def doubts(self) -> list[Stretch]:
        """Doubtful stretches of poses in order of time."""
        rows = np.flatnonzero(np.isin(self._numbers["flag"].astype(str), DOUBTFUL))
        error = self._numbers["predicted_error_mm"].astype(float)
        found = []
        for run in _runs(self.time_s[rows], self.time_s[rows]):
            most = float(error[rows[run]].max())
            size = f"error {most:.1f} mm" if np.isfinite(most) else "error not known"
            at = self.time_s[rows[run]]
            found.append(_stretch(at[0], at[-1], "pose", f"pose in doubt: {size}"))
        flips = self.session.flips
        for flip in records(flips[~flips["applied"].astype(bool)]):
            why = f"head and tail perhaps exchanged (p {float(flip['p_flip']):.2f})"
            found.append(_stretch(flip["start_s"], flip["stop_s"], "flip", why))
        for bout in records(contradicting(self.session)):
            word = str(bout["action"]).replace("_", " ")
            why = f"{word} contradicts its definition: {bout['contradicts']}"
            found.append(_stretch(bout["start_s"], bout["stop_s"], "action", why))
        return sorted(found, key=lambda one: float(one["start_s"]))

    @cached_property
    def suggested(self) -> list[Stretch]:
        """The stretches whose actions are least certain; none without a model."""
        try:
            rows = records(self._suggest(self.session.path))
        except LiexError:  # no recogniser for this animal
            rows = []
        return [
            _stretch(
                row["start_s"],
                row["stop_s"],
                "action",
                f"{row['guess']} or {row['or_else']}?".replace("_", " "),
            )
            for row in rows
        ]

    def crossings(self) -> list[Stretch]:
        """Where ends or animals may have been exchanged, see `crossings`."""
        return crossings(self.session, self.animals)

    def log(self) -> list[dict[str, Any]]:
        """The corrections in effect: number, message, author and date."""
        return [
            {
                "number": entry.number,
                "message": str(entry.what),
                "author": entry.author,
                "made_at": entry.made_at,
            }
            for entry in corrections.read_log(self.session.path).standing
        ]

    def redo(self) -> str:
        """The correction that was last undone and can be repeated; "" if none."""
        redoable = corrections.read_log(self.session.path).redoable
        return "" if redoable is None else str(redoable[1])

    def image(self, row: int, box: Sequence[int]) -> bytes:
        """PNG of a part of a frame as relief: height above the floor in colours, with shading.

        Args:
            row: the frame's row.
            box: left, top, width and height of the part, px; clipped to the image.

        Raises:
            SessionError: there is no such frame, or the box lies outside the image.
        """
        camera = self.session.camera
        corners = np.array([box[:2], np.add(box[:2], box[2:])])
        (left, top), (right, low) = np.clip(corners, 0, [camera.width, camera.height]).tolist()
        if not 0 <= row < len(self.time_s) or right <= left or low <= top:
            raise SessionError(f"there is no part {list(box)} of a frame in row {row}")
        side = (right - left, low - top)
        return png(self.relief.image(self.depth(row), left, top, side, side), fast=True)


def coloured_actions(words: Sequence[str]) -> list[dict[str, str]]:
    """The actions for a page: word, title and colour."""
    return [
        {"word": word, "title": word.replace("_", " "), "colour": colour}
        for word, colour in action_colours(words).items()
    ]


def _stretch(start_s: float, stop_s: float, kind: str, why: str, **more: str) -> Stretch:
    return {"start_s": float(start_s), "stop_s": float(stop_s), "kind": kind, "why": why, **more}


def _runs(start_s: Array, stop_s: Array) -> list[NDArray[np.intp]]:
    """The rows of spans in order of time, split where they are more than 0.5 s apart."""
    if not len(start_s):
        return []
    # frames or events closer in time form one stretch
    far = np.flatnonzero(start_s[1:] - stop_s[:-1] > 0.5) + 1
    return np.split(np.arange(len(start_s)), far)


def _plain(values: Any) -> Any:
    """An array for JSON: two decimals, and None for values that are not finite."""
    array = np.asarray(values, float)
    rounded = np.round(array, 2).astype(object)
    rounded[~np.isfinite(array)] = None
    return rounded.tolist()


# Crossings: stretches in which head and tail, or two animals, may have been exchanged.
#
# Exchanges of head and tail come from the table `flips`. The tracker may have changed to another
# object where the body jumps farther than it can move, and, with several animals in view, where
# another one comes within a body's length or an animal is found again after a loss. Of several
# measured animals, the table `crossings` comes first: the likeliest exchange that nobody reviewed.


def crossings(session: Session, animals: Sequence[SessionAnimal]) -> list[Stretch]:
    """The crossings of a session: those of several animals by `p_swap`, then others by time.

    Their kind is `swap` (several measured animals), `ends` (head and tail) or `identity` (the
    animal and another object); `individual` is the animal's name within the session.

    Args:
        session: the opened session.
        animals: its animals, see `session_animals`.

    Raises:
        SessionError: a table is damaged.
    """
    # 90 mm for an animal of unknown length
    spine_mm = float(session.metadata["animal"].get("spine_mm") or 90.0)
    found = [
        stretch
        for animal in animals
        for stretch in (*_exchanged_ends(animal), *_jumps(session, animal, spine_mm))
    ]
    for one, other in combinations(animals, 2):
        if len(one.xy_mm) and len(one.xy_mm) == len(other.xy_mm):
            away_mm = np.linalg.norm(one.xy_mm - other.xy_mm, axis=1)
            found += _meetings(
                one,
                away_mm,
                spine_mm,
                f"{one.individual} and {other.individual}",
                "perhaps exchanged",
            )
    verdict = session.metadata.get("verdict") or {}
    if len(animals) == 1 and verdict.get("n_animals", 1) > verdict.get("n_measured", 1):
        centres = evidence.read_centres(session)
        if centres is not None:
            away_mm = np.linalg.norm(centres[:, 1] - centres[:, 0], axis=1)
            found += _meetings(
                animals[0], away_mm, spine_mm, "two animals", "perhaps the other is followed"
            )
        found += _found_again(animals[0])
    found.sort(key=lambda one: (one["start_s"], one["stop_s"]))
    return [*_unclear(session), *found]


def _unclear(session: Session) -> Iterator[Stretch]:
    """Crossings after which the animals may be exchanged by 1 % or more, and not reviewed."""
    if not session.has("crossings.parquet"):
        return
    table = session.crossings
    if "reviewed_by" in table:  # missing in earlier versions
        table = table[table["reviewed_by"] == ""]
    individual = str(session.metadata["individual"])
    for one in records(table[table["p_swap"] >= _LIKELY].sort_values("p_swap", ascending=False)):
        names = one["animals"].split(";")
        other = next((name for name in names if name != individual), "")
        why = (
            f"{' and '.join(names)} perhaps exchanged (p {one['p_swap']:.2f}): `crossing here` "
            f"if they are right, `swap {other} here` if not"
        )
        yield _stretch(one["start_s"], one["stop_s"], "swap", why, individual=individual)


def _exchanged_ends(animal: SessionAnimal) -> Iterator[Stretch]:
    """Stretches with a certain or possible exchange of head and tail; close ones are merged."""
    table = animal.table("flips")
    if table is None or not len(table):
        return
    table = table.sort_values("start_s")
    for text, own in table.groupby(
        np.array([_flip_status(row) for row in records(table)], object), sort=False
    ):
        spans = own[["start_s", "stop_s"]].to_numpy(float)
        for run in _runs(*spans.T):
            times = f", {len(run)} times" if len(run) > 1 else ""
            human = own["source"].iloc[run[0]] == "human"
            sure = "" if human else f" (p {own['p_flip'].iloc[run].max():.2f})"
            why = f"head and tail {text}{times}{sure}"
            start_s, stop_s = spans[run[0], 0], spans[run, 1].max()
            yield _stretch(start_s, stop_s, "ends", why, individual=animal.individual)


def _flip_status(flip: dict[str, Any]) -> str:
    """The status of a row of the table `flips`, in words."""
    if flip["source"] == "human":
        undone = isinstance(flip.get("undone_at"), str) and flip["undone_at"]
        return "exchanged by a person and reverted" if undone else "exchanged by a person"
    return "were exchanged and are corrected" if flip["applied"] else "perhaps exchanged"


def _jumps(session: Session, animal: SessionAnimal, spine_mm: float) -> Iterator[Stretch]:
    """Frames between which the body's centre moves faster than the plan allows."""
    rules = (session.metadata.get("plan") or {}).get("behaviour") or {}
    fastest_mm_s = float(rules.get("impossible_above_mm_s") or IMPOSSIBLE_MM_S)
    rows = np.flatnonzero(np.isfinite(animal.xy_mm).all(axis=1))
    time_s = animal.frames["time_s"].to_numpy(float)[rows]
    moved_mm = np.linalg.norm(np.diff(animal.xy_mm[rows], axis=0), axis=1)
    # half a spine excludes the jitter of a fast camera
    far = (moved_mm > fastest_mm_s * np.diff(time_s)) & (moved_mm > 0.5 * spine_mm)
    for k in np.flatnonzero(far):
        jump = f"the body jumps {moved_mm[k]:.0f} mm from one frame to the next"
        why = f"{jump}: perhaps another object is followed"
        yield _stretch(time_s[k], time_s[k + 1], "identity", why, individual=animal.individual)


def _meetings(
    animal: SessionAnimal, away_mm: Array, spine_mm: float, names: str, result: str
) -> Iterator[Stretch]:
    """Where two animals come within a body's length of each other."""
    rows = np.flatnonzero(away_mm < spine_mm)
    time_s = animal.frames["time_s"].to_numpy(float)[rows]
    for run in _runs(time_s, time_s):
        why = f"{names} come within {away_mm[rows[run]].min():.0f} mm: {result}"
        start_s, stop_s = time_s[run[[0, -1]]]
        yield _stretch(start_s, stop_s, "identity", why, individual=animal.individual)


def _found_again(animal: SessionAnimal) -> Iterator[Stretch]:
    """Where the tracked animal was lost and an animal was found again."""
    last_s = float(animal.frames["time_s"].max())
    for start_s, stop_s in animal.lost_s:
        if start_s > 0.0 and stop_s < last_s:
            why = f"lost for {stop_s - start_s:.2f} s: perhaps another animal is followed since"
            yield _stretch(start_s, stop_s, "identity", why, individual=animal.individual)
