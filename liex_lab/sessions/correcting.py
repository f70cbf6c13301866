"""Corrections that a person asks for, checked against the session: from seconds, pixels and words
to entries.
"""

from __future__ import annotations

import difflib
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import LiexError, SessionError
from liex_lab.sessions.corrections import BoutEdit, FlipSpan, JointMove
from liex_lab.tables.rows import frame_count, stop_times

if TYPE_CHECKING:
    from liex_lab.sessions.session import Session

Array = NDArray[np.float64]

_ROUNDED_S = 5e-4  # times are typed with three decimals
_INSET_FRAMES = 24  # in so many frames it is looked up how deep under the skin a joint lies
_WORD_LENGTH = 60


def flip_span(session: Session, start_s: float, stop_s: float) -> FlipSpan:
    """Head and tail are exchanged from start_s to stop_s, seconds since the first frame, stop
    exclusive.
    """
    first, last = rows_between(session, start_s, stop_s, "a span to flip")
    count = frame_count(session.frames["frame_index"].to_numpy(np.int64))
    return FlipSpan(int(count[first]), int(count[last]))


def joint_move(session: Session, frame: int, joint: str, place_mm: Any) -> JointMove:
    """A joint of one frame, the camera's count, lies at place_mm (3,), arena frame.

    Raises SessionError where there is no such frame, joint or pose, or where the place is farther
    from where the joint was than the animal is long.
    """
    row, was = _joint_row(session, frame, joint)
    place = np.asarray(place_mm, float)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise SessionError(
            f"a joint's place is x, y and z in mm of the arena frame, got {place_mm}"
        )
    length = float(session.frames["spine_mm"].iloc[row])
    off = float(np.linalg.norm(place - was))
    if off > length:
        raise SessionError(
            f"{joint} of frame {frame} cannot be {off:.0f} mm from where it was found, at "
            f"({was[0]:.1f}, {was[1]:.1f}, {was[2]:.1f}) mm, for the animal is {length:.0f} mm "
            "long; check the place"
        )
    return JointMove(int(frame), joint, *(round(float(x), 3) for x in place))


def joint_move_at_pixel(
    session: Session, frame: int, joint: str, u_px: float, v_px: float
) -> JointMove:
    """A joint of one frame lies under the pixel (u_px, v_px) of the depth picture.

    The depth there is that of the skin; the joint is put as deep under it as it usually lies: the
    median over frames of the recording in which the pose is trusted.
    """
    from liex_lab.recordings import open_recording

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
    with open_recording(session.path / "session.mcap") as recording:
        skin_mm = depth_under(recording.frame(row).depth, u_px, v_px)
        if math.isnan(skin_mm):
            raise SessionError(
                f"frame {frame} has no depth at pixel ({u_px:g}, {v_px:g}); choose one beside it, "
                "or give the joint's place in mm"
            )
        inset_mm = _inset_mm(session, recording, joint)
    place = camera.unproject(np.array([u_px, v_px]), np.array(skin_mm + inset_mm))
    return joint_move(session, frame, joint, session.T_arena_camera @ place)


def depth_under(depth: NDArray[Any], u_px: float, v_px: float) -> float:
    """The median depth (mm) read in the three by three pixels around one, NaN where nothing was."""
    v = round(v_px)
    u = round(u_px)
    near = depth[max(0, v - 1) : v + 2, max(0, u - 1) : u + 2]
    return float(np.median(near[near > 0])) if (near > 0).any() else math.nan


def _inset_mm(session: Session, recording: Any, joint: str) -> float:
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
        seen = depth_under(recording.frame(int(row)).depth, *uv[row])
        found.append((into @ places[row])[2] - seen)
    known = np.array(found)[np.isfinite(found)]
    return max(0.0, float(np.median(known))) if len(known) else 0.0


def bout_at(session: Session, at_s: float) -> dict[str, Any]:
    """The bout that a time lies in. Raises SessionError, with the nearest ones, where there is
    none.
    """
    bouts = session.bouts
    inside = bouts[(bouts["start_s"] <= at_s + _ROUNDED_S) & (bouts["stop_s"] > at_s + _ROUNDED_S)]
    if len(inside) == 0:
        starts, stops = (bouts[name].to_numpy(float) for name in ("start_s", "stop_s"))
        off = np.maximum(starts - at_s, at_s - stops)
        near = bouts.iloc[np.sort(np.argsort(off)[:2])]
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
    """From start_s to stop_s the animal does `action`; what other bouts say of that time goes.

    new_word: the action need not be one of the ethogram's words.
    """
    word = _word(session, action, new_word)
    return BoutEdit("add", word, *span_ns(session, start_s, stop_s))


def rename_bout(session: Session, at_s: float, action: str, *, new_word: bool = False) -> BoutEdit:
    """The bout at at_s is one of `action`; the word that it has already confirms it."""
    bout = bout_at(session, at_s)
    word = _word(session, action, new_word)
    span = _span_of(session, bout)
    return BoutEdit("rename", word, *span, str(bout["action"]), *span)


def recut_bout(session: Session, at_s: float, start_s: float, stop_s: float) -> BoutEdit:
    """The bout at at_s goes from start_s to stop_s."""
    bout = bout_at(session, at_s)
    word = str(bout["action"])
    return BoutEdit(
        "recut", word, *span_ns(session, start_s, stop_s), word, *_span_of(session, bout)
    )


def delete_bout(session: Session, at_s: float) -> BoutEdit:
    """The bout at at_s is none."""
    bout = bout_at(session, at_s)
    span = _span_of(session, bout)
    return BoutEdit("delete", "", *span, str(bout["action"]), *span)


def labelled_bouts(session: Session, labels: Any) -> list[BoutEdit]:
    """The whole ethogram as a person has labelled it: `labels` is a table of actions.labels, of
    this session alone or with its name as session_id.
    """
    from liex_lab.actions.ethogram import Ethogram
    from liex_lab.actions.labels import words_of

    time_ns, time_s = (session.frames[name].to_numpy() for name in ("time_ns", "time_s"))
    named = (
        session.name
        if "session_id" in labels and session.name in set(labels["session_id"].astype(str))
        else ""
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
    """The rows of a span given in seconds, stop exclusive."""
    time_s = session.frames["time_s"].to_numpy()
    first, last = (int(np.searchsorted(time_s, at - _ROUNDED_S)) for at in (start_s, stop_s))
    if not (start_s < stop_s and first < last):
        raise SessionError(
            f"{what} is from a time to a later one, in seconds since the first frame, and holds a "
            f"frame; got {start_s:g} to {stop_s:g} in a session of 0 to {time_s[-1]:.3f} s"
        )
    return first, last


def span_ns(session: Session, start_s: float, stop_s: float) -> tuple[int, int]:
    """A span of frames on the recording's clock: of the first frame inside, and of the first one
    outside.
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
    """The row of a frame, and where (3,) mm a joint of it is."""
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
