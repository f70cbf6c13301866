"""Corrections as entered by a person, checked against the session and made into log entries.

Seconds become frames, a pixel becomes a point of the arena frame (back-projection through the
pinhole camera at the depth read there), and words are checked against the ethogram's vocabulary.
Times are assumed to have three decimals. Used by `liex correct` and by the dashboard.
"""

import difflib
import math
import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from liex_lab.actions.ethogram import Ethogram
from liex_lab.actions.labels import sessions_named, words_of
from liex_lab.arrays import Array, NDArray
from liex_lab.errors import LiexError, SessionError, did_you_mean, refuse
from liex_lab.plan import Plan
from liex_lab.recordings.recording import Recording
from liex_lab.sessions import identities
from liex_lab.sessions.corrections import (
    DESCRIBED,
    BoutEdit,
    Correction,
    Description,
    FlipSpan,
    JointMove,
)
from liex_lab.sessions.cutouts import Kept, open_depth
from liex_lab.sessions.session import Session
from liex_lab.tables.rows import ROUNDED_S, frame_count, rows_between, stop_times

_WORD_LENGTH = 60
# shares of the animal's length: its least distance in front of the still scene, and its largest
# from the nearest joint (half of that if the scene is unknown and the floor is used instead)
_BESIDE = 0.5
SENTENCES = (  # seconds since the first frame; a pixel u v, or a position x y z in mm of the arena
    "flip FROM TO",
    "joint NAME FRAME U V",
    "joint NAME FRAME X Y Z",
    "rename AT ACTION",
    "recut AT FROM TO",
    "delete AT",
    "add ACTION FROM TO",
    "swap ANIMAL FROM [TO]",
    "crossing AT",
)
OFF_THE_ANIMAL = "height kept: the pixel is not on the animal"


def parse_correction(
    session: Session, sentence: str | Sequence[object], at_s: float | None = None
) -> Correction:
    """Parse a correction such as `joint nose 810 212 148`.

    The forms are those of `SENTENCES`; `here` is the time or frame on display, and `new` at the end
    of `rename` and `add` allows an action that is not in the ethogram's vocabulary.

    Args:
        session: the session.
        sentence: the sentence, or its words; a word with spaces is quoted in a sentence.
        at_s: the time on display, s since the first frame; None if absent.

    Raises:
        SessionError: the sentence has none of the forms, or the correction cannot be made.
        LiexError: the action is not a printable word of up to 60 letters.
    """

    def numbers(*words: object) -> list[float]:
        return [at_s if word == "here" and at_s is not None else float(str(word)) for word in words]

    def frame(word: object) -> int:
        if word != "here" or at_s is None:
            return int(str(word))
        row = int((session.frames["time_s"] - at_s).abs().to_numpy().argmin())
        return int(session.frames["frame_index"].iloc[row])

    try:
        match shlex.split(sentence) if isinstance(sentence, str) else list(sentence):
            case ["rename", at, action, *new] if new in ([], ["new"]):
                return rename_bout(session, numbers(at)[0], str(action), new_word=bool(new))
            case ["add", action, start, stop, *new] if new in ([], ["new"]):
                return add_bout(session, str(action), *numbers(start, stop), new_word=bool(new))
            case ["recut", at, start, stop]:
                return recut_bout(session, *numbers(at, start, stop))
            case ["delete", at]:
                return delete_bout(session, *numbers(at))
            case ["swap", name, start, *stop] if len(stop) < 2:
                return identities.swap(session, str(name), *numbers(start, *stop))
            case ["crossing", at]:
                return identities.check_crossing(session, *numbers(at))
            case ["flip", start, stop]:
                return flip_span(session, *numbers(start, stop))
            case ["joint", name, row, u, v]:
                return joint_move_at_pixel(session, frame(row), str(name), *numbers(u, v))
            case ["joint", name, row, x, y, z]:
                return joint_move(session, frame(row), str(name), numbers(x, y, z))
    except ValueError:  # a word that is not a number, or an open quote
        pass
    raise SessionError(f"a correction is written as one of: {'; '.join(SENTENCES)}")


def flip_span(session: Session, start_s: float, stop_s: float) -> FlipSpan:
    """Correction that exchanges head and tail in a span of time.

    Args:
        session: the session.
        start_s: start, s since the first frame.
        stop_s: stop, s, exclusive.

    Raises:
        SessionError: the span has no frame, or none with a pose, or the skeleton is not a chain of
            joints with a head and a tail.
    """
    first, last = rows_between(_times(session), start_s, stop_s, "a span to flip")
    refuse(
        SessionError,
        (
            any(b - a != 1 for a, b in session.metadata["animal"]["bones"]),
            f"head and tail cannot be exchanged in a {session.metadata['animal']['name']}: its "
            "joints branch; move single joints with `liex correct joint`",
        ),
        (
            not np.isfinite(_ahead(session)[first:last]).all(axis=1).any(),
            f"no frame from {start_s:g} to {stop_s:g} s has a pose, so there is nothing to "
            "exchange",
        ),
    )
    count = frame_count(session.frames["frame_index"].to_numpy(np.int64))
    return FlipSpan(int(count[first]), int(count[last]))


def disagreements(session: Session) -> list[str]:
    """Exchanges that contradict the frames around them or another session, in sentences.

    At an end of such an exchange the body turns by more than 90 degrees from one frame with a pose
    to the next. The nearest consistent span begins and ends where the body makes such a turn
    without the exchange, where the pose is missing for longer than 0.5 s, or at the recording's
    ends.

    Args:
        session: the session with its corrections.

    Returns:
        One sentence for each active exchange of head and tail that disagrees, with the commands to
        change it, and for each session beside this one whose animals are exchanged otherwise.
    """
    exchanges = [
        (one.number, one.what) for one in session.log.standing if isinstance(one.what, FlipSpan)
    ]
    found = identities.one_sided(session)
    if not exchanges:
        return found
    index, time_s = (session.frames[name].to_numpy() for name in ("frame_index", "time_s"))
    ahead = _ahead(session)
    rows = np.flatnonzero(np.isfinite(ahead).all(axis=1))
    cosine = np.zeros(len(index))  # of the turn from the previous frame with a pose
    cosine[rows[1:]] = (ahead[rows[1:]] * ahead[rows[:-1]]).sum(axis=1)
    # turns after a longer time without a pose are ignored
    apart = set(rows[1:][np.diff(time_s[rows]) > 0.5].tolist())
    half_turns = set(np.flatnonzero(cosine < 0.0).tolist()) - apart
    ends_s = np.append(time_s, stop_times(time_s)[-1:])
    path = shlex.quote(str(session.path))
    for number, flip in exchanges:
        # the first row with a pose from each end
        ends = np.searchsorted(rows, np.searchsorted(index, (flip.start_frame, flip.stop_frame)))
        ends = np.append(rows, len(index))[ends]
        at = [row for row in ends.tolist() if row in half_turns]
        if not at:
            continue
        # an exchange adds half turns at its ends, or removes existing ones
        free = np.array(sorted({0, len(index)} | apart | (half_turns ^ set(ends.tolist()))))
        start = free[np.abs(free[:-1] - ends[0]).argmin()]
        stop = free[free > start][np.abs(free[free > start] - ends[1]).argmin()]
        turns = (
            f"{np.degrees(np.arccos(cosine[row])):.0f} degrees at frame {index[row]}" for row in at
        )
        found.append(
            f"{flip}: this disagrees with the frames around it (a turn of "
            f"{' and '.join(turns)}). Take it back with `liex correct undo {path} {number}`; "
            "the nearest span that agrees is then exchanged by `liex correct flip "
            f"{path} --from {ends_s[start]:.3f} --to {ends_s[stop]:.3f}`"
        )
    return found


def _times(session: Session) -> Array:
    """(n,) time of every frame, s since the first."""
    return np.asarray(session.frames["time_s"], float)


def _joints(session: Session) -> Array:
    """(n, J, 3) positions of the joints of every frame, mm, arena frame; NaN without a pose."""
    places = session.poses[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    return places.reshape(len(session.frames), -1, 3)


def _ahead(session: Session) -> Array:
    """(n, 3) unit vectors from the first joint to the last, arena frame; NaN without a pose."""
    joints = _joints(session)
    along = joints[:, -1] - joints[:, 0]
    return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))


def joint_move(
    session: Session, frame: int, joint: str, place_mm: Any, note: str = ""
) -> JointMove:
    """Correction that moves a joint of one frame to a position.

    Args:
        session: the session.
        frame: the frame, the camera's count.
        joint: the joint's name.
        place_mm: (3,) position, mm, arena frame.
        note: how the height was chosen, see `JointMove`.

    Raises:
        SessionError: there is no such frame, joint or pose, or the position is below the floor or
            farther from the measured one than the length of the animal.
    """
    row, was = _joint_row(session, frame, joint)
    place = np.asarray(place_mm, float)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise SessionError(
            f"a joint's place is x, y and z in mm of the arena frame, got {place_mm}"
        )
    length = float(session.frames["spine_mm"].iloc[row])
    distance = float(np.linalg.norm(place - was))
    refuse(
        SessionError,
        (
            place[2] < min(0.0, was[2]) - 1e-6,
            f"{joint} of frame {frame} cannot be {-place[2]:.1f} mm below the floor; give a height "
            f"z of 0 mm or more (it is at {was[2]:.1f} mm now)",
        ),
        (
            distance > length,
            f"{joint} of frame {frame} cannot be {distance:.0f} mm from where it was found, at "
            f"({was[0]:.1f}, {was[1]:.1f}, {was[2]:.1f}) mm, for the animal is {length:.0f} mm "
            "long; check the place",
        ),
    )
    x, y, z = (round(float(one), 3) for one in place)
    return JointMove(int(frame), joint, x, y, z, note)


def joint_move_at_pixel(
    session: Session, frame: int, joint: str, u_px: float, v_px: float
) -> JointMove:
    """Correction that moves a joint of one frame under a pixel of the depth image.

    On the animal, the depth at the pixel is that of the skin (the median over 3 x 3 pixels), and
    the joint is placed at its usual depth below the skin: the median over up to 24 frames with a
    trusted pose. Elsewhere, on the floor, a wall or an unread pixel, the joint keeps its height
    above the floor and moves along the pixel's ray. It never moves below the floor.

    Args:
        session: the session.
        frame: the frame, the camera's count.
        joint: the joint's name.
        u_px: column, px; 0 is the centre of the first one.
        v_px: row, px; 0 is the centre of the first one.

    Raises:
        SessionError: the pixel is outside the image, the session has no depth, the pixel's ray does
            not reach the joint's height, or see `joint_move`.
    """
    row, was = _joint_row(session, frame, joint)
    camera = session.camera
    if not (
        math.isfinite(u_px)
        and math.isfinite(v_px)
        and 0 <= round(u_px) < camera.width
        and 0 <= round(v_px) < camera.height
    ):
        raise SessionError(
            f"a pixel is a column and a row of the depth image of {camera.width} x "
            f"{camera.height}, the top-left one (0, 0); got ({u_px:g}, {v_px:g})"
        )
    kept = Kept(session)
    with open_depth(session) as recording:
        skin_mm = _skin_under(session, recording, kept, row, u_px, v_px)
        inset_mm = 0.0 if math.isnan(skin_mm) else _inset_mm(session, recording, kept, joint)
    eye = session.T_arena_camera.translation
    along = session.T_arena_camera.rotation @ camera.unproject(
        np.array([u_px, v_px]), np.array(1.0)
    )
    off = math.isnan(skin_mm)
    height = was[2] if off else eye[2] + (skin_mm + inset_mm) * along[2]
    depth_mm = (max(height, min(0.0, was[2])) - eye[2]) / along[2]
    if depth_mm <= 0.0:
        raise SessionError(
            f"the line of sight of pixel ({u_px:g}, {v_px:g}) does not reach the height of the "
            f"{joint}; choose a pixel nearer to the animal, or give the place in mm"
        )
    return joint_move(session, frame, joint, eye + depth_mm * along, OFF_THE_ANIMAL if off else "")


def _skin_under(
    session: Session, recording: Recording, kept: Kept, row: int, u_px: float, v_px: float
) -> float:
    """Depth of the animal's skin at a pixel of a frame, mm; NaN if the pixel is not on the animal.

    The animal is in front of the still scene, or above the floor if the still scene is unknown at
    the pixel, and close to the joints of the pose.
    """
    if not kept.holds(row, u_px, v_px):
        return math.nan  # the still scene
    skin_mm = depth_under(recording.frame(row).depth, u_px, v_px)
    # sampled for the still scene
    rows = np.linspace(0, len(session.frames) - 1, 256).astype(int).tolist()
    empty = next((k for k in rows if not kept.holds(k, u_px, v_px)), None)
    scene_mm = math.nan if empty is None else depth_under(recording.frame(empty).depth, u_px, v_px)
    pixel = np.array([u_px, v_px])
    point = session.T_arena_camera @ session.camera.unproject(pixel, np.array(skin_mm))
    stands_mm, reach = (
        (point[2], 0.5 * _BESIDE) if math.isnan(scene_mm) else (scene_mm - skin_mm, _BESIDE)
    )
    away_mm = np.linalg.norm(_joints(session)[row] - point, axis=-1).min()
    length = float(session.frames["spine_mm"].iloc[row])
    return skin_mm if stands_mm > 0.05 * length and away_mm < reach * length else math.nan


def depth_under(depth: NDArray[Any], u_px: float, v_px: float) -> float:
    """Median depth (mm) of the 3 x 3 pixels around one; NaN if all are unread.

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
    """Usual depth of a joint below the skin at its pixel, along the optical axis, mm."""
    frames = session.frames
    poses = session.poses[session.poses["joint"] == joint]
    usable = np.flatnonzero(
        (frames["flag"].to_numpy() == "") & np.isfinite(poses["u_px"].to_numpy(float))
    )
    # sampled for the depth of a joint below the skin
    sample = np.linspace(0, len(usable) - 1, 24 if len(usable) else 0).astype(int)
    uv = poses[["u_px", "v_px"]].to_numpy(float)
    places = poses[["x_mm", "y_mm", "z_mm"]].to_numpy(float)
    into = session.T_arena_camera.inverse()
    found = [
        (into @ places[row])[2] - depth_under(recording.frame(row).depth, *uv[row])
        for row in np.unique(usable[sample]).tolist()
        if kept.holds(row, *uv[row])  # else it shows the still scene
    ]
    known = np.array(found)[np.isfinite(found)]
    return max(0.0, float(np.median(known))) if len(known) else 0.0


def bout_at(session: Session, at_s: float) -> dict[str, Any]:
    """Row of the table `bouts` at a given time.

    Args:
        session: the session.
        at_s: time, s since the first frame.

    Raises:
        SessionError: there is no bout at this time; the message names the nearest ones.
    """
    bouts = session.bouts
    inside = bouts[(bouts["start_s"] <= at_s + ROUNDED_S) & (bouts["stop_s"] > at_s + ROUNDED_S)]
    if len(inside) == 0:
        starts, stops = (bouts[name].to_numpy(float) for name in ("start_s", "stop_s"))
        distance = np.maximum(starts - at_s, at_s - stops)
        near = " and ".join(
            f"{b.action} from {b.start_s:.3f} to {b.stop_s:.3f} s"
            for b in bouts.iloc[np.sort(np.argsort(distance)[:2])].itertuples()
        )
        others = f"the nearest are {near}" if near else "there are none"
        raise SessionError(f"no bout holds {at_s:g} s; {others}")
    return {str(k): v for k, v in inside.iloc[0].items()}


def add_bout(
    session: Session, action: str, start_s: float, stop_s: float, *, new_word: bool = False
) -> BoutEdit:
    """Edit that adds a bout; other bouts lose that time.

    Args:
        session: the session.
        action: the action.
        start_s: start, s since the first frame.
        stop_s: stop, s, exclusive.
        new_word: allow an action that is not in the vocabulary.

    Raises:
        SessionError: the span has no frame, or the word is unknown.
        LiexError: the action is not a printable word of up to 60 letters.
    """
    return BoutEdit("add", _word(session, action, new_word), *span_ns(session, start_s, stop_s))


def rename_bout(session: Session, at_s: float, action: str, *, new_word: bool = False) -> BoutEdit:
    """Edit that changes the action of a bout; the same action confirms it.

    Args:
        session: the session.
        at_s: a time within the bout, s since the first frame.
        action: the action.
        new_word: allow an action that is not in the vocabulary.

    Raises:
        SessionError: there is no bout at this time, or the word is unknown.
        LiexError: the action is not a printable word of up to 60 letters.
    """
    bout = bout_at(session, at_s)
    word = _word(session, action, new_word)
    span = _span_of(session, bout)
    return BoutEdit("rename", word, *span, str(bout["action"]), *span)


def recut_bout(session: Session, at_s: float, start_s: float, stop_s: float) -> BoutEdit:
    """Edit that changes start and stop of a bout.

    Args:
        session: the session.
        at_s: a time within the present bout, s since the first frame.
        start_s: new start, s.
        stop_s: new stop, s, exclusive.

    Raises:
        SessionError: there is no bout at this time, or the new span has no frame.
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
        SessionError: there is no bout at this time.
    """
    bout = bout_at(session, at_s)
    span = _span_of(session, bout)
    return BoutEdit("delete", "", *span, str(bout["action"]), *span)


def labelled_bouts(session: Session, labels: Any) -> list[BoutEdit]:
    """Edits that replace the whole ethogram by labels of a person or of MoSeq.

    Time between the labels is cleared.

    Args:
        session: the session.
        labels: a table of `liex_lab.actions.labels`, of this session only or with its name as
            session_id.

    Raises:
        SessionError: the labels are of several recordings without this one, or none of them is
            within the session.
    """
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
    ends = (t for bout in bouts for t in (bout.start_ns, bout.stop_ns))
    edges = [int(time_ns[0]), *ends, _end_ns(session)]
    free = [
        BoutEdit("delete", "", a, b, "any")
        for a, b in zip(edges[::2], edges[1::2], strict=True)
        if a < b
    ]
    source = labels["source"].iloc[0]
    return [
        *free,
        *(BoutEdit("add", one.action, one.start_ns, one.stop_ns, source=source) for one in bouts),
    ]


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
        SessionError: the span has no frame.
    """
    first, last = rows_between(_times(session), start_s, stop_s, "a bout")
    times = session.frames["time_ns"].to_numpy(np.int64)
    return int(times[first]), int(times[last]) if last < len(times) else _end_ns(session)


def _end_ns(session: Session) -> int:
    """End of the last frame on the recording's clock, ns."""
    time_s = session.frames["time_s"].to_numpy(float)
    return int(session.frames["time_ns"].iloc[0]) + round(1e9 * float(stop_times(time_s)[-1])) + 1


def _span_of(session: Session, bout: dict[str, Any]) -> tuple[int, int]:
    """Start and stop of a bout of the table on the recording's clock, ns."""
    first = int(session.frames["time_ns"].iloc[0])
    return first + round(1e9 * bout["start_s"]), first + round(1e9 * bout["stop_s"])


def _word(session: Session, action: str, new_word: bool) -> str:
    """The word of an action, validated."""
    word = action.strip()
    known = list(session.metadata.get("actions") or {})
    if not word or len(word) > _WORD_LENGTH or not word.isprintable():
        raise LiexError(f"an action is a word of up to {_WORD_LENGTH} letters, got {action!r}")
    if word not in known and not new_word:
        hint = did_you_mean(word, known)
        raise SessionError(
            f"the ethogram has no word '{word}': {hint}known are {', '.join(known) or 'none'}; "
            "--new-word, or `new` after it, makes it one"
        )
    return word


def _joint_row(session: Session, frame: int, joint: str) -> tuple[int, Array]:
    """Row of a frame, and the position (3,) mm of one of its joints, arena frame."""
    joints = list(session.metadata["animal"]["joints"])
    if joint not in joints:
        raise SessionError(f"there is no joint '{joint}'; known are {', '.join(joints)}")
    index = session.frames["frame_index"].to_numpy(np.int64)
    row = int(np.searchsorted(index, frame))
    if row == len(index) or index[row] != frame:
        raise SessionError(
            f"there is no frame {frame}; the recording has {index[0]} to {index[-1]}"
        )
    place = _joints(session)[row, joints.index(joint)]
    if not np.isfinite(place).all():
        raise SessionError(
            f"frame {frame} has no pose, so no joint of it can be moved; joints are moved where "
            "the animal was found"
        )
    return row, place


def descriptions(facts: Mapping[str, str]) -> list[Correction]:
    """Facts about the animal and the session, as corrections.

    Args:
        facts: any of `DESCRIBED`; an empty text is unknown.

    Raises:
        SessionError: a fact is not one of `DESCRIBED`, or none is given.
        PlanError: a value is invalid, such as a start time without a time zone.
    """
    if not facts:
        raise SessionError(f"nothing to describe; give any of {', '.join(DESCRIBED)} as KEY=VALUE")
    for key in facts:
        if key not in DESCRIBED:
            near = difflib.get_close_matches(key, DESCRIBED, 1, 0.4)
            raise SessionError(
                f"a session is not described by {key!r}"
                + (f"; did you mean {near[0]}?" if near else f"; use {', '.join(DESCRIBED)}")
            )
    stated = {key: value for key, value in facts.items() if value}
    checked = Plan.from_table({"session": stated}).session.model_dump()
    return [
        Description(key, str(checked[key] or "") if value else "") for key, value in facts.items()
    ]
