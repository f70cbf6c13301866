"""Crossings of a session: where its ends, or its animals, may have been taken for one another.

Head and tail are exchanged, or may be (table `flips`). Another thing may be taken for the animal
where its body jumps farther than it can go, and, of several animals in view, where one comes within
a body's length of the other or is found again after it was lost.
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
from liex_lab.sessions.evidence import read_things

from ..figures.seen import Seen
from .tables import records

Array = NDArray[np.float64]
ENDS = "ends"
IDENTITY = "identity"
_ONE_S = 0.5  # what is less far apart is one place
_SPINE_MM = 90.0  # of an animal whose length is not stated
_LEAST_JUMP = 0.5  # of the spine; a fast camera's jitter is no jump
_HUMAN = "human"


@dataclass(frozen=True)
class Crossing:
    """A place where two things may have been taken for one another.

    Attributes:
        start_s: its beginning, s since the first frame.
        stop_s: its end, s.
        kind: `ENDS` (head and tail) or `IDENTITY` (the animal and something else).
        individual: the animal's name within the session.
        why: what is to be said of it.
    """

    start_s: float
    stop_s: float
    kind: str
    individual: str
    why: str


def crossings(session: Session, all_seen: Sequence[Seen]) -> list[dict[str, Any]]:
    """Every crossing of a session in order of time, as JSON takes it (the fields of `Crossing`).

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
    """Stretches whose head and tail were exchanged or may be; near ones of a kind are one."""
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
    """What happened to head and tail in a row of the table `flips`."""
    if flip["source"] == _HUMAN:
        undone = isinstance(flip.get("undone_at"), str) and flip["undone_at"]
        return "were exchanged by a person, who took it back" if undone else "exchanged by a person"
    return "were exchanged and are put right" if flip["applied"] else "perhaps exchanged"


def _jumps(session: Session, seen: Seen) -> Iterator[Crossing]:
    """Where the body's centre goes farther between two frames than the plan holds possible."""
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
    """Of several animals in view, where another one is within a body's length of the followed."""
    things = read_things(session)
    if things is None:
        return
    away_mm = np.linalg.norm(things[:, 1] - things[:, 0], axis=1)
    time_s = seen.frames["time_s"].to_numpy(float)
    for rows in _runs(time_s, away_mm < _spine_mm(session)):
        why = f"two animals come within {away_mm[rows].min():.0f} mm: perhaps the other is followed"
        yield _over(time_s, rows, seen.individual, why)


def _found_again(seen: Seen) -> Iterator[Crossing]:
    """Of several animals in view, where the followed one was lost and one is found again."""
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
    """The rows where a mask is True, those less than `_ONE_S` apart together."""
    rows = np.flatnonzero(where)
    if not len(rows):
        return []
    return np.split(rows, np.flatnonzero(np.diff(time_s[rows]) > _ONE_S) + 1)


def _over(time_s: Array, rows: NDArray[np.intp], individual: str, why: str) -> Crossing:
    return Crossing(float(time_s[rows[0]]), float(time_s[rows[-1]]), IDENTITY, individual, why)


def _spine_mm(session: Session) -> float:
    """Length of the animal, mm."""
    return float(session.metadata["animal"].get("spine_mm") or _SPINE_MM)
