"""Corrections as a person states them, checked against the session and made into log entries.

Seconds become frames, a pixel becomes a point of the arena frame (back-projection through the
pinhole camera at the depth read there), words are looked up in the ethogram's vocabulary. Times are
taken to be typed with three decimals. Used by `liex correct` and by the dashboard.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError, SessionError
from liex_lab.plan import Plan
from liex_lab.sessions.corrections import (
    DESCRIBED,
    BoutEdit,
    Correction,
    Description,
    FlipSpan,
    JointMove,
)
from liex_lab.tables.rows import frame_count, stop_times

if TYPE_CHECKING:
    from liex_lab.recordings.recording import Recording
    from liex_lab.sessions.cutouts import Kept
    from liex_lab.sessions.session import Session

Array = NDArray[np.float64]

_ROUNDED_S = 5e-4  # times are typed with three decimals
_INSET_FRAMES = 24  # in so many frames it is looked up how deep under the skin a joint lies
_WORD_LENGTH = 60


def flip_span(session: Session, start_s: float, stop_s: float) -> FlipSpan:
    """Correction that exchanges head and tail in a span of time.

    Args:
        session: the session.
        start_s: start, s since the first frame.
        stop_s: stop, s, exclusive.

    Raises:
        SessionError: the span holds no frame.
    """
    first, last = rows_between(session, start_s, stop_s, "a span to flip")
    count = frame_count(session.frames["frame_index"].to_numpy(np.int64))
    return FlipSpan(int(count[first]), int(count[last]))


def joint_move(session: Session, frame: int, joint: str, place_mm: Any) -> JointMove:
    """Correction that puts a joint of one frame to a position.

    Args:
        session: the session.
        frame: the frame, the camera's count.
        joint: the joint's name.
        place_mm: (3,) position, mm, arena frame.

    Raises:
        SessionError: there is no such frame, joint or pose, or the position is farther from where
            the joint was than the animal is long.
    """
    row, was = _joint_row(session, frame, joint)
    place = np.asarray(place_mm, float)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise SessionError(
            f"a joint's place is x, y and z in mm of the arena frame, got {place_mm}"
        )
    length = float(session.frames["spine_mm"].iloc[row])
    distance = float(np.linalg.norm(place - was))
    if distance > length:
        raise SessionError(
            f"{joint} of frame {frame} cannot be {distance:.0f} mm from where it was found, at "
            f"({was[0]:.1f}, {was[1]:.1f}, {was[2]:.1f}) mm, for the animal is {length:.0f} mm "
            "long; check the place"
        )
    return JointMove(int(frame), joint, *(round(float(x), 3) for x in place))


def joint_move_at_pixel(
    session: Session, frame: int, joint: str, u_px: float, v_px: float
) -> JointMove:
    """Correction that puts a joint of one frame under a pixel of the depth picture.

    The depth read there is that of the skin: the median over 3 x 3 pixels. The joint is put as deep
    under it as it usually lies: the median over up to 24 frames of the recording in which the pose
    is trusted.

    Args:
        session: the session.
        frame: the frame, the camera's count.
        joint: the joint's name.
        u_px: column, px; 0 is the centre of the first one.
        v_px: row, px; 0 is the centre of the first one.

    Raises:
        SessionError: the pixel is outside the picture, or of what the session keeps of it, or has
            no depth, or see `joint_move`.
    """
    from liex_lab.sessions.cutouts import Kept, open_pictures

    row, _ = _joint_row(session, frame, joint)
    camera = session.camera
    if not (
        math.isfinite(u_px)
        and math.isfinite(v_px)
        and 0 <= round(u_px) < camera.width
        and 0 <= round(v_px) < camera.height
    ):
        raise SessionError(
            f"a pixel is a column and a row of the depth picture of {camera.width} x "
            f"{camera.height}, the top-left one (0, 0); got ({u_px:g}, {v_px:g})"
        )
    kept = Kept(session)
    if not kept.holds(row, u_px, v_px):
        raise SessionError(
            f"pixel ({u_px:g}, {v_px:g}) of frame {frame} is outside of the cut-out that the "
            "session keeps of it, and shows the still scene; give the joint's place in mm, or run "
            "`liex run` on the recording again with --set replay.depth=all (in Python "
            "plan.with_settings(['replay.depth=all']))"
        )
    with open_pictures(session) as recording:
        skin_mm = depth_under(recording.frame(row).depth, u_px, v_px)
        if math.isnan(skin_mm):
            raise SessionError(
                f"frame {frame} has no depth at pixel ({u_px:g}, {v_px:g}); choose one beside it, "
                "or give the joint's place in mm"
            )
        inset_mm = _inset_mm(session, recording, kept, joint)
    place = camera.unproject(np.array([u_px, v_px]), np.array(skin_mm + inset_mm))
    return joint_move(session, frame, joint, session.T_arena_camera @ place)


def depth_under(depth: NDArray[Any], u_px: float, v_px: float) -> float:
    """Median depth (mm) read in the 3 x 3 pixels around one; NaN where nothing was read.

    Args:
        depth: (H, W) mm, 0 where unread.
        u_px: column, px; rounded.
        v_px: row, px; rounded.
    """
    v = round(v_px)
    u = round(u_px)
    near = depth[max(0, v - 1) : v + 2, max(0, u - 1) : u + 2]
    return float(np.median(near[near > 0])) if (near > 0).any() else math.nan


def _inset_mm(session: Session, recording: Recording, kept: Kept, joint: str) -> float:
    """How much farther from the camera than the skin seen at its pixel a joint usually is, mm."""
    frames = session.frames
    poses = session.poses[session.poses["joint"] == joint]
    usable = np.flatnonzero(
        (frames["flag"].to_numpy() == "") & np.isfinite(poses["u_px"].to_numpy(float))
    )
    chosen = (
        usable[np.unique(np.linspace(0, len(usable) - 1, _INSET_FRAMES).astype(int))]
        if len(usable)
        else usable
    )
    uv, places = (
        poses[names].to_numpy(float) for names in (["u_px", "v_px"], ["x_mm", "y_mm", "z_mm"])
    )
    into = session.T_arena_camera.inverse()
    found = []
    for row in chosen:
        if not kept.holds(int(row), *uv[row]):
            continue  # what is seen there is the still scene
        seen = depth_under(recording.frame(int(row)).depth, *uv[row])
        found.append((into @ places[row])[2] - seen)
    known = np.array(found)[np.isfinite(found)]
    return max(0.0, float(np.median(known))) if len(known) else 0.0


def bout_at(session: Session, at_s: float) -> dict[str, Any]:
    """Row of the table `bouts` that a time lies in.

    Args:
        session: the session.
        at_s: time, s since the first frame.

    Raises:
        SessionError: no bout holds the time; the message names the nearest ones.
    """
    bouts = session.bouts
    inside = bouts[(bouts["start_s"] <= at_s + _ROUNDED_S) & (bouts["stop_s"] > at_s + _ROUNDED_S)]
    if len(inside) == 0:
        starts, stops = (bouts[name].to_numpy(float) for name in ("start_s", "stop_s"))
        distance = np.maximum(starts - at_s, at_s - stops)
        near = bouts.iloc[np.sort(np.argsort(distance)[:2])]
        told = " and ".join(
            f"{b.action} from {b.start_s:.3f} to {b.stop_s:.3f} s" for b in near.itertuples()
        )
        raise SessionError(
            f"no bout holds {at_s:g} s; {f'the nearest are {told}' if told else 'there are none'}"
        )
    return {str(k): v for k, v in inside.iloc[0].items()}


def add_bout(
    session: Session, action: str, start_s: float, stop_s: float, *, new_word: bool = False
) -> BoutEdit:
    """Edit that adds a bout; what other bouts say of that time goes.

    Args:
        session: the session.
        action: what the animal does.
        start_s: start, s since the first frame.
        stop_s: stop, s, exclusive.
        new_word: the action need not be one of the ethogram's words.

    Raises:
        SessionError: the span holds no frame, or the word is not known.
        LiexError: the action is not a printable word of up to 60 letters.
    """
    word = _word(session, action, new_word)
    return BoutEdit("add", word, *span_ns(session, start_s, stop_s))


def rename_bout(session: Session, at_s: float, action: str, *, new_word: bool = False) -> BoutEdit:
    """Edit that gives a bout another action; the word that it has already confirms it.

    Args:
        session: the session.
        at_s: a time within the bout, s since the first frame.
        action: what the animal does.
        new_word: the action need not be one of the ethogram's words.

    Raises:
        SessionError: no bout holds the time, or the word is not known.
        LiexError: the action is not a printable word of up to 60 letters.
    """
    bout = bout_at(session, at_s)
    word = _word(session, action, new_word)
    span = _span_of(session, bout)
    return BoutEdit("rename", word, *span, str(bout["action"]), *span)


def recut_bout(session: Session, at_s: float, start_s: float, stop_s: float) -> BoutEdit:
    """Edit that gives a bout another start and stop.

    Args:
        session: the session.
        at_s: a time within the bout as it is, s since the first frame.
        start_s: new start, s.
        stop_s: new stop, s, exclusive.

    Raises:
        SessionError: no bout holds the time, or the new span holds no frame.
    """
    bout = bout_at(session, at_s)
    word = str(bout["action"])
    return BoutEdit(
        "recut", word, *span_ns(session, start_s, stop_s), word, *_span_of(session, bout)
    )


def delete_bout(session: Session, at_s: float) -> BoutEdit:
    """Edit that removes a bout.

    Args:
        session: the session.
        at_s: a time within the bout, s since the first frame.

    Raises:
        SessionError: no bout holds the time.
    """
    bout = bout_at(session, at_s)
    span = _span_of(session, bout)
    return BoutEdit("delete", "", *span, str(bout["action"]), *span)


def labelled_bouts(session: Session, labels: Any) -> list[BoutEdit]:
    """Edits that replace the whole ethogram by a person's labels.

    Time between the labels is cleared.

    Args:
        session: the session.
        labels: a table of `liex_lab.actions.labels`, of this session alone or with its name as
            session_id.

    Raises:
        SessionError: the labels are of several recordings and not of this one, or none of them
            lies within the session.
    """
    from liex_lab.actions.ethogram import Ethogram
    from liex_lab.actions.labels import sessions_named, words_of

    time_ns, time_s = (session.frames[name].to_numpy() for name in ("time_ns", "time_s"))
    of = sessions_named(labels)
    named = session.name if session.name in of else ""
    if not named and len(of) > 1:
        raise SessionError(
            f"these labels are of {', '.join(sorted(of)[:5])} and of none named {session.name}; "
            "give the session's name as session_id (in BORIS: the observation's name)"
        )
    bouts = Ethogram.of_words(words_of(labels, time_s, named), time_ns).bouts
    if not bouts:
        raise SessionError(
            f"none of these labels lies within the session {session.name}; check their times and "
            "names"
        )
    first = int(time_ns[0])
    last = _end_ns(session)
    edges = [first, *(t for bout in bouts for t in (bout.start_ns, bout.stop_ns)), last]
    free = [
        BoutEdit("delete", "", a, b, "any")
        for a, b in zip(edges[::2], edges[1::2], strict=True)
        if a < b
    ]
    return [*free, *(BoutEdit("add", bout.action, bout.start_ns, bout.stop_ns) for bout in bouts)]


def rows_between(session: Session, start_s: float, stop_s: float, what: str) -> tuple[int, int]:
    """First row of a span of time, and the first row after it.

    Args:
        session: the session.
        start_s: start, s since the first frame.
        stop_s: stop, s, exclusive.
        what: what the span is, for the error message.

    Raises:
        SessionError: the span holds no frame.
    """
    time_s = session.frames["time_s"].to_numpy()
    first, last = (int(np.searchsorted(time_s, at - _ROUNDED_S)) for at in (start_s, stop_s))
    if not (start_s < stop_s and first < last):
        raise SessionError(
            f"{what} is from a time to a later one, in seconds since the first frame, and holds a "
            f"frame; got {start_s:g} to {stop_s:g} in a session of 0 to {time_s[-1]:.3f} s"
        )
    return first, last


def span_ns(session: Session, start_s: float, stop_s: float) -> tuple[int, int]:
    """Span of frames on the recording's clock, ns.

    It starts with the first frame inside and stops with the first one outside, or with the end of
    the last frame.

    Args:
        session: the session.
        start_s: start, s since the first frame.
        stop_s: stop, s, exclusive.

    Returns:
        (start, stop), ns.

    Raises:
        SessionError: the span holds no frame.
    """
    first, last = rows_between(session, start_s, stop_s, "a bout")
    times = session.frames["time_ns"].to_numpy(np.int64)
    return int(times[first]), int(times[last]) if last < len(times) else _end_ns(session)


def _end_ns(session: Session) -> int:
    """When the last frame ends, on the recording's clock."""
    time_s = session.frames["time_s"].to_numpy(float)
    return int(session.frames["time_ns"].iloc[0]) + round(1e9 * float(stop_times(time_s)[-1])) + 1


def _span_of(session: Session, bout: dict[str, Any]) -> tuple[int, int]:
    """When a bout of the table begins and ends, on the recording's clock."""
    first = int(session.frames["time_ns"].iloc[0])
    return first + round(1e9 * bout["start_s"]), first + round(1e9 * bout["stop_s"])


def _word(session: Session, action: str, new_word: bool) -> str:
    """A word for an action, checked."""
    word = action.strip()
    known = list(session.metadata.get("actions") or {})
    if not word or len(word) > _WORD_LENGTH or not word.isprintable():
        raise LiexError(f"an action is a word of up to {_WORD_LENGTH} letters, got {action!r}")
    if word not in known and not new_word:
        near = difflib.get_close_matches(word, known, 1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise SessionError(
            f"the ethogram has no word '{word}': {hint}known are {', '.join(known) or 'none'}; "
            "--new-word makes it one"
        )
    return word


def _joint_row(session: Session, frame: int, joint: str) -> tuple[int, Array]:
    """Row of a frame, and the position (3,) mm of a joint of it, arena frame."""
    joints = list(session.metadata["animal"]["joints"])
    if joint not in joints:
        raise SessionError(f"there is no joint '{joint}'; known are {', '.join(joints)}")
    index = session.frames["frame_index"].to_numpy(np.int64)
    row = int(np.searchsorted(index, frame))
    if row == len(index) or index[row] != frame:
        raise SessionError(
            f"there is no frame {frame}; the recording has {index[0]} to {index[-1]}"
        )
    place = (
        session.poses[["x_mm", "y_mm", "z_mm"]]
        .iloc[row * len(joints) + joints.index(joint)]
        .to_numpy(float)
    )
    if not np.isfinite(place).all():
        raise SessionError(
            f"frame {frame} has no pose, so no joint of it can be moved; joints are moved where "
            "the animal was found"
        )
    return row, place


def descriptions(facts: Mapping[str, str]) -> list[Correction]:
    """What is known of the animal and the session, as corrections.

    Args:
        facts: any of `DESCRIBED`; an empty text is unknown.

    Raises:
        SessionError: there is no such fact, or none is given.
        PlanError: a value cannot be used, as a start time without a time zone.
    """
    if not facts:
        raise SessionError(f"nothing to describe; give any of {', '.join(DESCRIBED)} as KEY=VALUE")
    for key in facts:
        if key not in DESCRIBED:
            near = difflib.get_close_matches(key, DESCRIBED, 1, 0.4)
            raise SessionError(
                f"a session is not described by {key!r}"
                + (f"; did you mean {near[0]}?" if near else f"; say {', '.join(DESCRIBED)}")
            )
    said = {key: value for key, value in facts.items() if value}
    checked = Plan.from_table({"session": said}).session.model_dump()
    return [
        Description(key, str(checked[key] or "") if value else "") for key, value in facts.items()
    ]
