"""Corrections of identity: which of the animals of one arena is which.

Each animal has a session of its own. After corrections, session i shows in frame t the poses that
were measured as animal

    shown[t] = identity * (a1 b1) * (a2 b2) * ...     (transpositions, in the order of the log)

at its place i. Its track is made again from the observations of these animals (association and
smoothing, `tracking.curve`), so that no curve joins two animals.
"""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import SessionError, refuse
from liex_lab.runtime.text_files import loose_json
from liex_lab.sessions import evidence
from liex_lab.sessions.corrections import LogEntry, Roles, read_log
from liex_lab.sessions.session import Session
from liex_lab.tables.rows import ROUNDED_S, frame_count, rows_between
from liex_lab.tracking.curve import track_whole
from liex_lab.tracking.identity import covers, flag_unclear
from liex_lab.tracking.observations import COLUMNS, Observations
from liex_lab.tracking.track import Crossing, Subject, Tracked

Slots = NDArray[np.int64]
HUMAN = "human"


def arena_sessions(session: Session) -> dict[str, Session]:
    """The sessions of all animals of an arena, opened raw, by the animals' names in their order.

    Args:
        session: one of them.

    Raises:
        SessionError: it is the only animal of its recording, or a session is missing or occurs
            twice beside it.
    """
    about = session.metadata
    n_measured = int((about.get("verdict") or {}).get("n_measured", 1))
    if n_measured < 2 or not session.has("crossings.parquet"):
        raise SessionError(
            f"{session.path} is the only animal that was measured in its recording, so there is "
            "none to exchange it with; measure several with `liex run --set animal.count=2`"
        )
    found = [
        (str(other["individual"]), path.parent)
        for path in sorted(session.path.parent.glob("*.liex/session.json"))
        if _is_of_one_run(about, other := loose_json(path))
    ]
    names = sorted({name for name, _ in found})
    if len(found) != n_measured or len(names) != n_measured:
        listed = ", ".join(f"{name} ({path.name})" for name, path in found) or "none"
        raise SessionError(
            f"{n_measured} animals were measured in the recording of {session.path}, and their "
            f"sessions lie in one folder, each once; {session.path.parent} holds {listed}"
        )
    return {name: Session.open(path, raw=True) for name, path in sorted(found)}


def swap(
    session: Session, other: Session | str, start_s: float, stop_s: float | None = None
) -> Roles:
    """Correction that exchanges two animals of one arena in a span of time.

    Args:
        session: the session of one animal.
        other: that of the other one, or its animal's name.
        start_s: start, s since the first frame.
        stop_s: stop, s, exclusive; None for the end of the recording.

    Raises:
        SessionError: they are not two animals of one run, or the span has no frame.
    """
    if isinstance(other, str):
        members = arena_sessions(session)
        if other not in members:
            raise SessionError(f"there is no {other} in {', '.join(members)}")
        other = members[other]
    recordings = [one.metadata["input"]["sha256"] for one in (session, other)]
    names = [str(one.metadata["individual"]) for one in (session, other)]
    refuse(
        SessionError,
        (
            session.path.resolve() == other.path.resolve(),
            f"two animals are exchanged, and {session.path} was given twice; give the sessions of "
            "two animals of one recording",
        ),
        (
            recordings[0] != recordings[1],
            f"{session.path} and {other.path} were measured in two recordings; animals are "
            "exchanged within one recording",
        ),
        (
            not _is_of_one_run(session.metadata, other.metadata),
            f"{session.path} and {other.path} were measured with different plans; give the two "
            "sessions of one run",
        ),
        (names[0] == names[1], f"{session.path} and {other.path} are both of {names[0]}"),
    )
    members = arena_sessions(session)
    if members[names[1]].path.resolve() != other.path.resolve():
        raise SessionError(
            f"{other.path} does not lie beside {session.path}; keep the sessions of one recording "
            "in one folder"
        )
    last_s = float(session.frames["time_s"].iloc[-1])
    stop_s = last_s + 1.0 if stop_s is None else stop_s
    rows = rows_between(
        session.frames["time_s"].to_numpy(),
        start_s,
        stop_s,
        "a span in which animals are exchanged",
    )
    count = frame_count(session.frames["frame_index"].to_numpy(np.int64))
    first, last = (int(count[row]) for row in rows)
    return Roles(
        (names[0], names[1]), first, last, tuple(one.path.name for one in members.values())
    )


def check_crossing(session: Session, at_s: float) -> Roles:
    """Correction that confirms the roles in which the animals leave a crossing.

    Args:
        session: the session of one of them.
        at_s: a time in the crossing, s since the first frame.

    Raises:
        SessionError: there is no crossing at this time; the message lists them.
    """
    members = arena_sessions(session)
    table = session.crossings
    inside = table[(table["start_s"] - ROUNDED_S <= at_s) & (at_s <= table["stop_s"])]
    if not len(inside):
        begin = ", ".join(f"{one:.3f}" for one in table["start_s"][:10]) or "none"
        raise SessionError(
            f"no crossing of {session.path} holds {at_s:g} s; crossings begin at {begin} (s)"
        )
    first, last = (int(inside[f"{end}_frame"].iloc[0]) for end in ("start", "stop"))
    return Roles((), first, last, tuple(one.path.name for one in members.values()))


def one_sided(session: Session) -> list[str]:
    """The sessions of an arena whose identities are corrected differently, in sentences.

    Args:
        session: the session with its corrections.
    """
    wanted = [one.what for one in session.log.shared]
    return [
        f"{path.name} does not have the same exchanges of animals; `liex correct apply "
        f"{shlex.quote(str(session.path))}` makes them alike"
        for path in session.log.beside(session.path)
        if path.is_dir() and [one.what for one in read_log(path).shared] != wanted
    ]


def shown(entries: Sequence[LogEntry], names: Sequence[str], index: Slots) -> Slots:
    """Which animal's measured poses each session shows: (n, N) for N sessions in n frames.

    Args:
        entries: the active corrections of identity.
        names: of the N animals.
        index: (n,) the camera's frame count.
    """
    found = np.tile(np.arange(len(names)), (len(index), 1))
    for one in (entry.what for entry in entries if isinstance(entry.what, Roles)):
        if one.animals:
            rows = np.flatnonzero((one.start_frame <= index) & (index < one.stop_frame))
            a, b = (names.index(name) for name in one.animals)
            found[rows, a], found[rows, b] = found[rows, b], found[rows, a]
    return found


def exchanged(
    session: Session, members: Mapping[str, Session], entries: Sequence[LogEntry]
) -> tuple[Observations, Subject, Tracked, list[str]]:
    """The observations, the animal and the track of a session, with the identities corrected.

    Args:
        session: the session, opened raw.
        members: those of all animals of its arena, see `arena_sessions`.
        entries: the active corrections of identity.

    Returns:
        Observations, subject, track with its crossings, and sentences on frames that were measured
        with the body of an animal of another length.
    """
    index = session.frames["frame_index"].to_numpy(np.int64)
    order = shown(entries, [*members], index)
    own = [*members].index(session.metadata["individual"])
    every = [evidence.read_evidence(one) for one in members.values()]
    observed, subject = every[own]
    covering = covers([one for one, _ in every], subject.length_mm)[
        order[:, own], np.arange(len(order))
    ]
    remarks = []
    for k in sorted(set(order[:, own].tolist()) - {own}):
        theirs, measured_as = every[k]
        rows = order[:, own] == k
        for name in COLUMNS:
            getattr(observed, name)[rows] = getattr(theirs, name)[rows]
        if measured_as.length_mm != subject.length_mm:
            remarks.append(
                f"{rows.sum():,} frames were measured as {[*members][k]}, with a body of "
                f"{measured_as.length_mm:.1f} mm instead of {subject.length_mm:.1f} mm."
            )
    known = {one for other in members.values() for one in evidence.read_crossings(other) or ()}
    crossings = [_reviewed(one, order, entries, index) for one in known]
    met = sorted((one for one in crossings if own in one.animals), key=lambda one: one.start)
    tracked = replace(track_whole(subject, observed), crossings=tuple(met))
    flag_unclear(tracked, covering)
    return observed, subject, tracked, remarks


def _reviewed(
    crossing: Crossing, order: Slots, entries: Sequence[LogEntry], index: Slots
) -> Crossing:
    """A crossing by the corrected names of its animals, and its last reviewer.

    Exchanging animals in it, or at its end, is a review.
    """
    some = np.isin(order[crossing.start : crossing.stop], crossing.animals).any(axis=0)
    crossing = replace(crossing, animals=tuple(np.flatnonzero(some).tolist()))
    count = frame_count(index)
    span = int(count[crossing.start]), int(count[crossing.stop])
    for one in entries:
        assert isinstance(one.what, Roles)
        ends = (one.what.start_frame, one.what.stop_frame)
        inner = {*ends} - {int(count[0]), int(count[-1])}
        applies = (
            any(span[0] <= end <= span[1] for end in inner) if one.what.animals else ends == span
        )
        if applies:
            crossing = replace(
                crossing,
                p_swap=0.0,
                decided_by=HUMAN,
                reviewed_by=one.author,
                reviewed_at=one.made_at,
            )
    return crossing


def _is_of_one_run(about: Mapping[str, object], other: Mapping[str, object]) -> bool:
    """Whether two sessions, by their session.json, are of one recording and plan."""
    facts = []
    for one in (about, other):
        source, plan = (
            part if isinstance(part := one.get(k), dict) else {} for k in ("input", "plan")
        )
        facts.append((source.get("sha256"), {**plan, "session": None}, "individual" in one))
    return facts[0] == facts[1]
