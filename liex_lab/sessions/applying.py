"""Application of human corrections: flips and joint moves to the track, bout edits to the ethogram.

A flip makes the track again from the observations with the association constrained in its span;
frames outside of it follow only where the exchange agrees with them. A moved joint is fitted by
weighted least squares over joint angles (inverse kinematics), so that bones keep their lengths and
joints their limits. Bout edits cut and replace half-open intervals.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.actions.labels import HUMAN
from liex_lab.body.fitting import fit_poses
from liex_lab.body.pose import Pose
from liex_lab.errors import SessionError
from liex_lab.geometry import SE3
from liex_lab.sessions.corrections import BoutEdit, FlipSpan, JointMove, Log
from liex_lab.sessions.evidence import read_evidence, read_flips, track_of
from liex_lab.tables.rows import frame_count
from liex_lab.tables.schema import BOUTS
from liex_lab.tracking.following import let_follow
from liex_lab.tracking.observations import reversed_pose
from liex_lab.tracking.offline import MARGIN, track_whole
from liex_lab.tracking.track import COLUMNS, CORRECTED, Flip, Track, ends_of

if TYPE_CHECKING:
    from liex_lab.body.skeleton import Skeleton
    from liex_lab.optics.camera import Camera
    from liex_lab.sessions.session import Session

Array = NDArray[np.float64]
Rows = NDArray[np.int64]

_HELD = 20.0  # how much more a joint that a person placed counts than one that may follow


@dataclass(frozen=True)
class CorrectedTrack:
    """A track with the corrections of flips and joints in it.

    Attributes:
        track: the corrected track.
        turned: (k,) rows in which exchanging head and tail may have changed the pose.
        moved: (m,) rows with joints that a person placed.
        flips: the rows of the table `flips`, frames counted by row.
    """

    track: Track
    turned: Rows
    moved: Rows
    flips: tuple[Flip, ...]

    @property
    def seams(self) -> list[int]:
        """Rows at which an exchange of head and tail by a person begins or ends."""
        return ends_of((flip.start, flip.stop) for flip in self.flips if flip.source == HUMAN)

    @property
    def changed(self) -> bool:
        """Whether any pose is another one than was measured."""
        return bool(len(self.turned) + len(self.moved))


def corrected_track(session: Session, log: Log, skeleton: Skeleton) -> CorrectedTrack:
    """Track of a session with the standing corrections of its log.

    Args:
        session: the session, opened raw.
        log: its corrections; bout edits are not looked at here.
        skeleton: the skeleton that the session was made with.

    Raises:
        SessionError: the session holds no observations to make the track of again, or a joint was
            moved in a frame that has no pose.
    """
    track = track_of(session, skeleton)
    index = session.frames["frame_index"].to_numpy(np.int64)
    flips = tuple(read_flips(session))
    turned = np.zeros(0, np.int64)
    spans: list[FlipSpan] = log.corrections(FlipSpan)
    if spans:
        track, flips, turned = _turned_round(session, track, index, spans)
    moves = _moves_of(log, skeleton)
    was = deepcopy(track.pose)
    moved = place_joints(track, index, moves, session.camera, session.T_arena_camera)
    if len(moved):
        followed = let_follow(track, was, moved)
        track.uv_px[followed] = session.camera.project(
            session.T_arena_camera.inverse() @ track.joints_mm[followed]
        )
    return CorrectedTrack(track, turned, moved, flips)


def _moves_of(log: Log, skeleton: Skeleton) -> list[JointMove]:
    """The standing moves; one whose frame was exchanged later is of the joint at the other end."""
    names = list(skeleton.names)
    moves: list[JointMove] = []
    for one in (entry.what for entry in log.standing):
        if isinstance(one, JointMove):
            moves.append(one)
        elif isinstance(one, FlipSpan):
            moves = [
                replace(move, joint=names[-1 - names.index(move.joint)])
                if one.start_frame <= move.frame < one.stop_frame
                else move
                for move in moves
            ]
    return moves


def _turned_round(
    session: Session, track: Track, index: Rows, spans: Sequence[FlipSpan]
) -> tuple[Track, tuple[Flip, ...], Rows]:
    """The track made again from the observations, with the spans turned round.

    Rows outside of the spans keep what they had, but for those within `MARGIN` of an end at which
    the exchange agrees with its neighbour: there the curve was bent by the half turn that is gone.
    No row loses its pose or its trust.
    """
    seen, subject = read_evidence(session)
    rows_of_spans = (np.searchsorted(index, (one.start_frame, one.stop_frame)) for one in spans)
    wanted = [Flip(int(start), int(stop), 1.0, True, HUMAN) for start, stop in rows_of_spans]
    earlier = [
        flip for flip in read_flips(session) if flip.source == HUMAN
    ]  # of versions that wrote into the table
    again = track_whole(subject, seen, [*earlier, *wanted])
    ends = ends_of((flip.start, flip.stop) for flip in wanted)
    exchanged = np.cumsum(np.bincount(ends, minlength=len(index) + 1))[:-1] % 2 == 1
    near = exchanged.copy()
    parts = [0, *again.cuts, len(index)]
    for end in set(ends) - set(parts):
        k = int(np.searchsorted(parts, end))
        near[max(parts[k - 1], end - MARGIN) : min(parts[k], end + MARGIN)] = True
    was, now = (
        one.joints_mm[:, one.skeleton.tip] - one.joints_mm[:, 0] for one in (track, again.track)
    )
    lost = near & (
        (track.posed & ~again.track.posed)
        | (track.observed & ~again.track.observed)
        | (exchanged & (np.einsum("nd,nd->n", was, now) > 0.0))  # passed by, and bridged as it was
    )
    trusted = near & (track.flag == "")
    for name in {*COLUMNS} - {"times_ns"}:
        getattr(track, name)[near & ~lost] = getattr(again.track, name)[near & ~lost]
    track.flag[trusted] = ""
    rows = np.flatnonzero(lost & exchanged)
    turned = reversed_pose(track.skeleton, track.pose[rows])
    _put(track, rows, turned, session.camera, session.T_arena_camera)
    return track, again.flips, np.flatnonzero(near)


def _put(track: Track, rows: Rows, pose: Pose, camera: Camera, T_arena_camera: SE3) -> None:
    """Write poses into some rows of a track, in place."""
    track.put_pose(rows, pose)
    track.uv_px[rows] = camera.project(T_arena_camera.inverse() @ track.joints_mm[rows])


def place_joints(
    track: Track, index: Rows, moves: Sequence[JointMove], camera: Camera, T_arena_camera: SE3
) -> Rows:
    """Put joints where a person says, in place, and let the others follow; returns changed rows.

    Least-squares fit of the kinematic tree (inverse kinematics by Levenberg-Marquardt): bones keep
    their lengths and joints their limits. The residual of a joint that a person placed counts 20
    times that of the others, which stay as near as they can to where they were. The rows get the
    flag `corrected`.

    Args:
        track: the track, n rows, changed in place.
        index: (n,) the camera's frame count of each row, ascending.
        moves: the joints that were placed, arena frame, mm.
        camera: the depth camera, for the pixels of the joints.
        T_arena_camera: carries the camera frame into the arena frame.

    Returns:
        (k,) rows that were changed.

    Raises:
        SessionError: a joint was moved in a frame that has no pose.
    """
    if not moves:
        return np.zeros(0, np.int64)
    skeleton = track.skeleton
    names = list(track.skeleton.names)
    rows = np.unique(np.searchsorted(index, [move.frame for move in moves]))
    weight = np.ones((len(rows), skeleton.n_joints))
    points = track.joints_mm[rows].copy()
    for move in moves:
        k = int(np.searchsorted(rows, np.searchsorted(index, move.frame)))
        j = names.index(move.joint)
        points[k, j] = (move.x_mm, move.y_mm, move.z_mm)
        weight[k, j] = _HELD
    if not np.isfinite(points).all():
        raise SessionError(
            "a joint was moved in a frame that has no pose; take that correction back"
        )
    limits = skeleton.limits
    start = Pose(
        SE3(track.root_rotation[rows], track.root_mm[rows]),
        np.clip(track.angles_rad[rows], limits[..., 0], limits[..., 1]),
        track.scale[rows],
    )
    for k in range(len(rows)):
        pull = np.diag(weight[k])
        fit = fit_poses(skeleton, (pull @ points[k])[None], pull, start[k : k + 1], keep_scale=True)
        _put(track, rows[k : k + 1], fit.pose, camera, T_arena_camera)
    track.bridged[rows] = False
    track.flag[rows] = CORRECTED
    return rows


def edited_bouts(
    bouts: pd.DataFrame, edits: Iterable[BoutEdit], frames: pd.DataFrame
) -> pd.DataFrame:
    """Ethogram with a person's edits applied, one after the other.

    Each edit clears the bout that it edits, then its own span: a bout that reaches into the span
    keeps what lies outside. What a person says has the source human, the score 1 and no model.

    Args:
        bouts: the table `bouts` of the session.
        edits: the edits, in the order in which they were made.
        frames: the table `frames`, for the times of the rows.

    Returns:
        A table with the columns of `tables.BOUTS`.
    """
    rows = _spans(bouts, frames)
    for edit in edits:
        rows = _cleared(
            _cleared(rows, edit.was_start_ns, edit.was_stop_ns), edit.start_ns, edit.stop_ns
        )
        if edit.action:
            said = {"action": edit.action, "score": 1.0, "source": HUMAN, "model_hash": ""}
            rows.append({**said, "start_ns": edit.start_ns, "stop_ns": edit.stop_ns})
    return _table(rows, frames)


def spliced_bouts(
    bouts: pd.DataFrame, other: pd.DataFrame, rows: Rows, frames: pd.DataFrame
) -> pd.DataFrame:
    """Ethogram that takes some rows of the recording from another ethogram.

    One word across a seam is one bout.

    Args:
        bouts: the table `bouts` that holds everywhere else.
        other: the table `bouts` that holds in `rows`.
        rows: (k,) rows of the recording, ascending, at least one.
        frames: the table `frames`, for the times of the rows.

    Returns:
        A table with the columns of `tables.BOUTS`.
    """
    times = frames["time_ns"].to_numpy(np.int64)
    inside = _spans(other, frames)
    mixed = _spans(bouts, frames)
    end = max([int(times[-1]) + 1, *(row["stop_ns"] for row in [*inside, *mixed])])
    for part in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
        start = int(times[part[0]])
        stop = int(times[part[-1] + 1]) if part[-1] + 1 < len(times) else end
        mixed = _cleared(mixed, start, stop) + _cleared(_cleared(inside, 0, start), stop, end)
    joined: list[dict[str, Any]] = []
    for row in sorted(mixed, key=lambda row: row["start_ns"]):
        last = joined[-1] if joined else None
        if last and last["stop_ns"] == row["start_ns"] and last["action"] == row["action"]:
            joined[-1] = {**last, "stop_ns": row["stop_ns"]}
        else:
            joined.append(row)
    return _table(joined, frames)


def _spans(bouts: pd.DataFrame, frames: pd.DataFrame) -> list[dict[str, Any]]:
    """Bouts as dicts with start and stop on the recording's clock, ns.

    A time within 1 ns of a frame's is that frame's own.
    """
    times = frames["time_ns"].to_numpy(np.int64)
    rows: list[dict[str, Any]] = []
    for row in bouts[["action", "start_s", "stop_s", "score", "source", "model_hash"]].to_dict(
        "records"
    ):
        ends = [int(times[0]) + round(1e9 * row[name]) for name in ("start_s", "stop_s")]
        nearest = [int(times[min(np.searchsorted(times, end - 1), len(times) - 1)]) for end in ends]
        start, stop = (b if abs(a - b) <= 1 else a for a, b in zip(ends, nearest, strict=True))
        rows.append({**{str(k): v for k, v in row.items()}, "start_ns": start, "stop_ns": stop})
    return rows


def _cleared(rows: list[dict[str, Any]], start_ns: int, stop_ns: int) -> list[dict[str, Any]]:
    """Bouts without what lies within a span; a bout around it becomes two."""
    kept: list[dict[str, Any]] = []
    for row in rows:
        if stop_ns <= start_ns or row["stop_ns"] <= start_ns or row["start_ns"] >= stop_ns:
            kept.append(row)
            continue
        kept += [{**row, "stop_ns": start_ns}] if row["start_ns"] < start_ns else []
        kept += [{**row, "start_ns": stop_ns}] if row["stop_ns"] > stop_ns else []
    return kept


def _table(rows: Sequence[dict[str, Any]], frames: pd.DataFrame) -> pd.DataFrame:
    """Bouts in order of time as the table `bouts`; a piece of a bout without a frame is dropped."""
    times = frames["time_ns"].to_numpy(np.int64)
    count = frame_count(frames["frame_index"].to_numpy(np.int64))
    first = int(times[0])
    made = []
    for row in sorted(rows, key=lambda row: row["start_ns"]):
        a, b = np.searchsorted(times, [row["start_ns"], row["stop_ns"]])
        if a == b:
            continue
        start_s, stop_s = ((row[name] - first) * 1e-9 for name in ("start_ns", "stop_ns"))
        made.append(
            {
                "session_id": frames["session_id"].iloc[0],
                "individual": frames["individual"].iloc[0],
                **{name: row[name] for name in ("action", "score", "source", "model_hash")},
                "start_s": start_s,
                "stop_s": stop_s,
                "duration_s": stop_s - start_s,
                "start_frame": int(count[a]),
                "stop_frame": int(count[b]),
            }
        )
    table = pd.DataFrame(made, columns=[column.name for column in BOUTS])
    return table.astype(
        {column.name: "str" if column.dtype == "string" else column.dtype for column in BOUTS}
    )
