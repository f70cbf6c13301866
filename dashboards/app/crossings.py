"""Crossings of a session: where head and tail, or two animals, may have been exchanged.

Exchanges of head and tail come from the table `flips`. The tracker may have changed to another
object where the body jumps farther than it can move, and, with several animals in view, where
another one comes within a body's length or an animal is found again after a loss.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.behaviour.kinematics import IMPOSSIBLE_MM_S
from liex_lab.sessions import Session
from liex_lab.sessions.evidence import read_centres

from ..figures.seen import Seen
from .tables import records

Array = NDArray[np.float64]
ENDS = "ends"
IDENTITY = "identity"
_ONE_S = 0.5  # events closer in time are one crossing
_SPINE_MM = 90.0  # of an animal of unknown length
_LEAST_JUMP = 0.5  # of the spine; excludes the jitter of a fast camera
_HUMAN = "human"


@dataclass(frozen=True)
class Crossing:
    """A stretch in which head and tail, or two animals, may have been exchanged.

    Attributes:
        start_s: its beginning, s since the first frame.
        stop_s: its end, s.
        kind: `ENDS` (head and tail) or `IDENTITY` (the animal and another object).
        individual: the animal's name within the session.
        why: the reason, as a sentence.
    """

    start_s: float
    stop_s: float
    kind: str
    individual: str
    why: str


def crossings(session: Session, all_seen: Sequence[Seen]) -> list[dict[str, Any]]:
    """The crossings of a session in order of time, as dicts of the fields of `Crossing`.

    Args:
        session: the opened session.
        all_seen: its animals, see `figures.seen.animals`.

    Raises:
        SessionError: a table is damaged.
    """
    found: list[Crossing] = []
    for seen in all_seen:
        found += _exchanged_ends(seen)
        found += _jumps(session, seen)
    if len(all_seen) > 1:
        for first, second in combinations(all_seen, 2):
            found += _meetings(session, first, second)
    elif (session.metadata.get("verdict") or {}).get("n_animals", 1) > 1:
        found += _near_others(session, all_seen[0])
        found += _found_again(all_seen[0])
    return [asdict(one) for one in sorted(found, key=lambda one: (one.start_s, one.stop_s))]


def _exchanged_ends(seen: Seen) -> Iterator[Crossing]:
    """Stretches with a certain or possible exchange of head and tail; close ones are merged."""
    table = seen.table("flips")
    rows = [] if table is None else records(table.sort_values("start_s"))
    for said in dict.fromkeys(_said_of(row) for row in rows):
        own = [row for row in rows if _said_of(row) == said]
        spans = np.array([[row["start_s"], row["stop_s"]] for row in own], float)
        far = np.flatnonzero(spans[1:, 0] - spans[:-1, 1] > _ONE_S) + 1
        for run in np.split(np.arange(len(own)), far):
            p = max(float(own[k]["p_flip"]) for k in run)
            times = f", {len(run)} times" if len(run) > 1 else ""
            sure = "" if own[run[0]]["source"] == _HUMAN else f" (p {p:.2f})"
            why = f"head and tail {said}{times}{sure}"
            start_s, stop_s = float(spans[run[0], 0]), float(spans[run, 1].max())
            yield Crossing(start_s, stop_s, ENDS, seen.individual, why)


def _said_of(flip: dict[str, Any]) -> str:
    """The status of a row of the table `flips`, in words."""
    if flip["source"] == _HUMAN:
        undone = isinstance(flip.get("undone_at"), str) and flip["undone_at"]
        return "were exchanged by a person, who took it back" if undone else "exchanged by a person"
    return "were exchanged and are put right" if flip["applied"] else "perhaps exchanged"


def _jumps(session: Session, seen: Seen) -> Iterator[Crossing]:
    """Frames between which the body's centre moves faster than the plan allows."""
    rules = (session.metadata.get("plan") or {}).get("behaviour") or {}
    fastest_mm_s = float(rules.get("impossible_above_mm_s") or IMPOSSIBLE_MM_S)
    rows = np.flatnonzero(np.isfinite(seen.xy_mm).all(axis=1))
    time_s = seen.frames["time_s"].to_numpy(float)[rows]
    way_mm = np.linalg.norm(np.diff(seen.xy_mm[rows], axis=0), axis=1)
    far = (way_mm > fastest_mm_s * np.diff(time_s)) & (way_mm > _LEAST_JUMP * _spine_mm(session))
    for k in np.flatnonzero(far):
        why = f"the body jumps {way_mm[k]:.0f} mm from one frame to the next: perhaps another thing"
        yield Crossing(float(time_s[k]), float(time_s[k + 1]), IDENTITY, seen.individual, why)


def _near_others(session: Session, seen: Seen) -> Iterator[Crossing]:
    """Where another animal comes within a body's length of the tracked one."""
    things = read_centres(session)
    if things is None:
        return
    away_mm = np.linalg.norm(things[:, 1] - things[:, 0], axis=1)
    time_s = seen.frames["time_s"].to_numpy(float)
    for rows in _runs(time_s, away_mm < _spine_mm(session)):
        why = f"two animals come within {away_mm[rows].min():.0f} mm: perhaps the other is followed"
        yield _over(time_s, rows, seen.individual, why)


def _found_again(seen: Seen) -> Iterator[Crossing]:
    """Where the tracked animal was lost and an animal was found again."""
    last_s = float(seen.frames["time_s"].max())
    for start_s, stop_s in seen.lost_s:
        if start_s > 0.0 and stop_s < last_s:
            why = f"lost for {stop_s - start_s:.2f} s: perhaps another animal is followed since"
            yield Crossing(float(start_s), float(stop_s), IDENTITY, seen.individual, why)


def _meetings(session: Session, first: Seen, second: Seen) -> Iterator[Crossing]:
    """Where two animals of a session come within a body's length of each other."""
    if not len(first.xy_mm) or len(first.xy_mm) != len(second.xy_mm):
        return
    away_mm = np.linalg.norm(first.xy_mm - second.xy_mm, axis=1)
    time_s = first.frames["time_s"].to_numpy(float)
    for rows in _runs(time_s, away_mm < _spine_mm(session)):
        why = (
            f"{first.individual} and {second.individual} come within "
            f"{away_mm[rows].min():.0f} mm: perhaps exchanged"
        )
        yield _over(time_s, rows, first.individual, why)


def _runs(time_s: Array, where: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """The rows where a mask is True; rows less than `_ONE_S` apart form one run."""
    rows = np.flatnonzero(where)
    if not len(rows):
        return []
    return np.split(rows, np.flatnonzero(np.diff(time_s[rows]) > _ONE_S) + 1)


def _over(time_s: Array, rows: NDArray[np.intp], individual: str, why: str) -> Crossing:
    return Crossing(float(time_s[rows[0]]), float(time_s[rows[-1]]), IDENTITY, individual, why)


def _spine_mm(session: Session) -> float:
    """Length of the animal, mm."""
    return float(session.metadata["animal"].get("spine_mm") or _SPINE_MM)
