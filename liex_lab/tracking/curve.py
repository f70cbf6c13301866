"""From what single frames say to the track: the whole recording at once, head and tail told apart over all of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.camera import Camera
from liex_lab.geometry import SE3
from liex_lab.tracking.chain import NONE, Chain
from liex_lab.tracking.observations import Observations, joints_of, reversed_pose
from liex_lab.tracking.smoother import Curve, Motion, smooth
from liex_lab.tracking.track import Flip, Track, Tracked
from liex_lab.tracking.tuning import Tuning

Array = NDArray[np.float64]

_BLOCK, MARGIN = 4096, 160  # frames smoothed at a time, and how many beside them have a say
# nearer to the curve than so many predicted errors, a hypothesis that was passed by is a measurement after all, unless
# its score costs more than this share of what a score can: then it is of something else, or of half the animal
_ADMIT, _ADMIT_COST = 2.0, 2 / 3
_TOLD = 0.05  # a lesser doubt about head and tail is not worth a row


@dataclass(frozen=True)
class Subject:
    """Whom a track is of, and before which camera.

    length_mm: of this animal; doubtful_mm: frames with a larger predicted error are flagged; bridge_s: so long a
    stretch without a measurement is bridged; joint_share (J,): each joint's error over the mean.
    """

    skeleton: Skeleton
    camera: Camera
    T_arena_camera: SE3
    length_mm: float
    doubtful_mm: float
    bridge_s: float
    joint_share: tuple[float, ...]


def track_whole(
    subject: Subject, seen: Observations, corrections: Sequence[Flip] = (), tuning: Tuning | None = None
) -> Tracked:
    """The track of a recording from what was seen in all of its frames; corrections: what a human says of flips.

    tuning: None takes the animal's own.
    """
    tuning = tuning or Tuning.of(subject.skeleton.name)
    chain, motion = Chain(subject.skeleton, subject.length_mm, tuning.chain), tuning.motion
    path = chain.path(seen)
    doubt = chain.doubt(seen, path)
    pose, error = seen.pose(path), seen.along(seen.error_mm, path)
    for span in corrections:
        if not span.undone_at:
            _turn_round(subject.skeleton, seen, path, pose, span)
            doubt[span.start : span.stop] = 0.0
    curve = _smoothed(subject, seen, pose, error, motion)
    admitted = _admitted(subject.skeleton, seen, path, curve, chain.likely(seen, _ADMIT_COST))
    if (admitted >= 0).any():
        taken = admitted >= 0
        path = np.where(taken, admitted, path)
        _put(pose, taken, seen.pose(admitted)[taken])
        error = np.where(taken, seen.along(seen.error_mm, admitted), error)
        curve = _smoothed(subject, seen, pose, error, motion)
    track = to_track(subject, seen, path, curve, doubt, tuning=tuning)
    flips = _flips(seen, track)
    return Tracked(track, tuple(sorted([*flips, *corrections], key=lambda flip: (flip.start, flip.source))))


def _put(pose: Pose, rows: NDArray[np.bool_] | NDArray[np.int64], other: Pose) -> None:
    pose.root.rotation[rows], pose.root.translation[rows] = other.root.rotation, other.root.translation
    pose.angles[rows], pose.scale[rows] = other.angles, other.scale


def _turn_round(skeleton: Skeleton, seen: Observations, path: NDArray[np.int64], pose: Pose, span: Flip) -> None:
    """Exchange head and tail of the poses in a span: by the other hypothesis of a frame where there is one."""
    for t in range(span.start, span.stop):
        if path[t] == NONE:
            continue
        if seen.known[t, path[t] ^ 1]:
            path[t] ^= 1
            _put(pose, np.array([t]), seen[t : t + 1].pose(path[t : t + 1]))
        else:
            _put(pose, np.array([t]), reversed_pose(skeleton, pose[np.array([t])]))


def _smoothed(subject: Subject, seen: Observations, pose: Pose, error: Array, motion: Motion) -> Curve:
    """`smooth` over a recording of any length, in blocks whose neighbours have a say."""
    parts: list[Curve] = []
    n = len(seen)
    for start in range(0, n, _BLOCK):
        first, last = max(0, start - MARGIN), min(n, start + _BLOCK + MARGIN)
        rows = slice(first, last)
        curve = smooth(subject.skeleton, seen.seconds[rows], pose[rows], error[rows], subject.length_mm, motion)
        parts.append(curve[start - first : min(start + _BLOCK, n) - first])
    return Curve.join(parts)


def _admitted(
    skeleton: Skeleton, seen: Observations, path: NDArray[np.int64], curve: Curve, likely: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """(n,) of frames that were passed by, the `likely` (n, H) hypothesis that lies on the curve all the same; NONE
    elsewhere.
    """
    found, best = np.full(len(seen), NONE, np.int64), np.full(len(seen), _ADMIT)
    for h in range(seen.score.shape[1]):
        rows = np.flatnonzero((path == NONE) & likely[:, h] & np.isfinite(curve.error_mm))
        if not len(rows):
            continue
        joints = joints_of(skeleton, seen.pose(np.full(len(seen), h))[rows])
        off = np.linalg.norm(joints - curve.joints[rows], axis=-1).mean(axis=1) / seen.error_mm[rows, h]
        better = off < best[rows]
        found[rows[better]], best[rows[better]] = h, off[better]
    return found


def to_track(
    subject: Subject, seen: Observations, path: NDArray[np.int64], curve: Curve, doubt: Array, ahead: bool = False,
    told: slice = slice(None), tuning: Tuning | None = None,
) -> Track:  # fmt: skip
    """A curve as rows of a track: measured, bridged over a short time, or missing.

    ahead: the curve also goes on for a short time after the last measurement; told: only these rows.
    """
    skeleton = subject.skeleton
    measured = curve.used & (path >= 0)
    bridged = short_gaps(seen.seconds, measured, subject.bridge_s, ahead)[told]
    measured, seen, path, curve, doubt = measured[told], seen[told], path[told], curve[told], doubt[told]
    track = Track.empty(skeleton, seen.times_ns)
    there = measured | bridged
    pose, camera = curve.pose, subject.camera
    in_camera = subject.T_arena_camera.inverse() @ curve.joints[there]
    track.joints_mm[there], track.uv_px[there] = curve.joints[there], camera.project(in_camera)
    track.root_rotation[there], track.root_mm[there] = pose.root.rotation[there], pose.root.translation[there]
    track.angles_rad[there], track.scale[there] = pose.angles[there], pose.scale[there]
    sd = curve.error_mm / _ERROR_PER_SD
    track.sd_mm[there] = (sd[:, None] * np.array(subject.joint_share))[there]
    motion = (tuning or Tuning.of(skeleton.name)).motion
    track.sd_root[there] = (_spread_of_root(curve) * motion.honest_root)[there]
    bend = curve.sd_bend * motion.honest_bend
    track.sd_angles_rad[there] = (bend[:, None] * skeleton.axes)[there]
    track.sd_angles_rad[:, 0] = np.where(there[:, None], 0.0, np.nan)
    track.predicted_error_mm[there] = curve.error_mm[there]
    track.p_flip[there] = doubt[there]
    _add_sight(track, seen, path, measured)
    track.bridged[:] = bridged
    track.flag[measured] = np.where(curve.error_mm > subject.doubtful_mm, "doubtful", "")[measured]
    track.flag[~measured & ~seen.has_depth] = "no_depth"
    return track


def _spread_of_root(curve: Curve) -> Array:
    """Standard deviations (n, 6) of the root in its own frame, rad and mm: what its middle may be off, and what a turn
    about the middle moves the root.
    """
    root = curve.pose.root
    lever = np.einsum("nij,ni->nj", root.rotation, curve.joints[:, 0] - curve.joints.mean(axis=1))
    moved = np.cross(np.eye(3), lever[:, None]) * curve.sd_turn[:, :, None]  # (n, axis turned about, axis moved along)
    place = np.einsum("nij,ni->nj", root.rotation**2, curve.sd_middle_mm**2) + (moved**2).sum(axis=1)
    return np.concatenate([curve.sd_turn, np.sqrt(place)], axis=1)


# a mean distance in space over the standard deviation along one axis: 1.6 of a Gaussian, but tails are heavier
_ERROR_PER_SD = 1.4


def _add_sight(track: Track, seen: Observations, path: NDArray[np.int64], measured: NDArray[np.bool_]) -> None:
    """What was seen of the animal where it was measured."""
    rows, taken = np.flatnonzero(measured), path[measured]
    track.n_foreground_px[rows] = seen.n_px[rows, taken]
    track.centroid_mm[rows], track.centroid_px[rows] = seen.centroid_mm[rows, taken], seen.centroid_px[rows, taken]
    track.residual_mm[rows] = seen.residual_mm[rows, taken]


def single_frames(subject: Subject, seen: Observations) -> Track:
    """What each frame says by itself, without its neighbours."""
    path = np.where(seen.known[:, 0], 0, NONE)
    pose, error = seen.pose(path), seen.along(seen.error_mm, path)
    moves = Tuning.of(subject.skeleton.name).motion.packed
    turn, bend = (group[:, 0] * error[:, None] / subject.length_mm for group in (moves.turn, moves.bend))
    curve = Curve(pose, joints_of(subject.skeleton, pose), error, moves.place_error * error[:, None], turn, bend,
                  path >= 0)  # fmt: skip
    return to_track(replace(subject, bridge_s=0.0), seen, path, curve, np.zeros(len(seen)))


def short_gaps(
    seconds: Array, measured: NDArray[np.bool_], bridge_s: float, ahead: bool = False
) -> NDArray[np.bool_]:  # fmt: skip
    """(n,) True in frames between two measured ones that are no farther apart than that; ahead: and so long after the
    last one.
    """
    rows = np.flatnonzero(measured)
    if not len(rows):
        return np.zeros(len(measured), np.bool_)
    t = np.arange(len(measured))
    after = np.searchsorted(rows, t)
    inside = (after > 0) & (after < len(rows))
    before, after = rows[np.maximum(after - 1, 0)], rows[np.minimum(after, len(rows) - 1)]
    short = inside & (seconds[after] - seconds[before] <= bridge_s)
    if ahead:
        short[rows[-1] + 1 :] = seconds[rows[-1] + 1 :] - seconds[rows[-1]] <= bridge_s
    return short & ~measured


def _flips(seen: Observations, track: Track) -> list[Flip]:
    """The stretches in which the single frames had head and tail exchanged, and those in which the track may have."""
    tip = track.skeleton.tip
    ends = seen.joints([0, tip])[:, 0]
    along = track.joints_mm[:, tip] - track.joints_mm[:, 0]
    exchanged = np.einsum("nd,nd->n", along, ends[:, 1] - ends[:, 0]) < 0
    found = [Flip(a, b, float(1.0 - track.p_flip[a:b].mean()), True) for a, b in spans(exchanged)]
    unsure = ~exchanged & (track.p_flip > _TOLD)
    return found + [Flip(a, b, float(track.p_flip[a:b].mean()), False) for a, b in spans(unsure)]


def spans(where: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """The stretches of True in (n,), as (start, stop), stop exclusive."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
