"""Fixed-interval smoothing of a whole recording: association, flip posterior, then RTS smoothing.

1. Viterbi over the hypotheses of single frames (`association`) says which of them the animal is, or
   none.
2. A forward-backward pass over two states, head and tail as they are or exchanged, gives the flip
   posterior; spans that a person corrected are exchanged with certainty.
3. A Kalman filter and Rauch-Tung-Striebel smoother of an integrated Ornstein-Uhlenbeck process
   (`smoother`) runs over blocks of 4096 frames with a margin of 160 frames on either side.
4. Validation gate: a hypothesis that was passed by, but lies within one predicted error of the
   curve, its own and the curve's together, is a measurement after all; twice over, for each time
   the curve comes nearer to others.
5. Gaps up to `bridge_s` are bridged by the curve, longer ones are NaN, and so are frames in which
   an animal is in full view elsewhere.
6. Poses that the picture contradicts are doubtful (`trust`).

The default tracker of the package; it replaces the particle filter of Lie-X section 4.2
(`particles`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3
from liex_lab.optics.camera import Camera
from liex_lab.runtime.memory import Allocator, blocks
from liex_lab.tracking.association import NONE, HypothesisAssociation
from liex_lab.tracking.gaps import short_gaps, spans, whole_gaps
from liex_lab.tracking.larger_animal import cost_of_the_other
from liex_lab.tracking.motion_model import TrackingParameters
from liex_lab.tracking.observations import Observations, joints_of, reversed_pose
from liex_lab.tracking.smoother import Curve, smooth
from liex_lab.tracking.track import Flip, Track, Tracked
from liex_lab.tracking.trust import (
    MOST_ERROR,
    WHOLE,
    contradicted,
    elsewhere,
    gone_behind,
    lies_unknown,
    share_in_view,
    together,
    usual_pixels,
)

Array = NDArray[np.float64]

# frames smoothed at a time, and how many beside them have a say
_BLOCK = 4096
MARGIN = 160
# nearer to the curve than so many predicted errors, its own and the curve's, a hypothesis that was
# passed by is a measurement after all, unless it shows less than this share of what the animal
# usually shows, or more than that many times as much; of half an animal beside a bar the pose errs
# by this share of the length that is not seen. Each time that some are taken, the curve comes
# nearer to others.
_ADMIT = 1.0
_LEAST = 0.5
_MOST = 1.5
_UNSEEN = 0.4
_TIMES = 2
_TOLD = 0.05  # a lesser doubt about head and tail is not worth a row


@dataclass(frozen=True)
class Subject:
    """Whom a track is of, before which camera, and by which limits its rows are kept or flagged.

    Attributes:
        skeleton: kinematic tree of the animal.
        camera: the depth camera that took the recording.
        T_arena_camera: pose of the camera in the arena frame, mm.
        length_mm: spine length of this animal, mm.
        doubtful_mm: frames with a larger predicted mean joint error, mm, are flagged.
        bridge_s: so long a gap without a measurement is bridged, s, and half as far into a longer
            one from both its ends.
        joint_share: (J,) error of each joint over the mean of all joints.
        stretch_sd: standard deviation of the share by which all distances from the base may be off
            throughout, for an animal whose ends a sensor eats is taken for a smaller one; None
            where nothing is known of it, which takes the usual share of `Motion`.
        unseen: standard deviations over the length of the joints' height and of their place along
            the body that a session's own shape leaves; None without one, which takes those of
            `Motion`.
        n_animals: how many animals are in view at once, one of which is followed.
    """

    skeleton: Skeleton
    camera: Camera
    T_arena_camera: SE3
    length_mm: float
    doubtful_mm: float
    bridge_s: float
    joint_share: tuple[float, ...]
    stretch_sd: float | None = None
    unseen: tuple[float, float] | None = None
    n_animals: int = 1


def track_whole(
    subject: Subject,
    seen: Observations,
    corrections: Sequence[Flip] = (),
    tuning: TrackingParameters | None = None,
    allocate: Allocator = np.empty,
) -> Tracked:
    """The track of a recording, smoothed over all of its frames at once, and its head-tail flips.

    See the module for the steps. Besides the columns of the track, no more than a block of frames
    is in memory.

    Args:
        subject: whom the track is of.
        seen: hypotheses (n, H) of all frames, arena frame.
        corrections: spans in which a person says that head and tail are exchanged; those with
            `undone_at` are not applied.
        tuning: motion and association parameters; None takes the animal's own.
        allocate: allocator of the track's columns, `np.empty` or one on disk.

    Returns:
        The track (n rows) and the flips, those found and those of `corrections`, in order of time.
    """
    tuning = tuning or TrackingParameters.of(subject.skeleton.name)
    chain = HypothesisAssociation(
        subject.skeleton, subject.length_mm, tuning.chain, subject.n_animals
    )
    joints = chain.joints(seen, allocate)
    emission = chain.emission(seen, joints, allocate)
    path = chain.path(seen, joints=joints, allocate=allocate, emission=emission)
    if subject.n_animals > 1 and (other := cost_of_the_other(seen, path)) is not None:
        emission += chain.independent(seen) * other
        path = chain.path(seen, joints=joints, allocate=allocate, emission=emission)
    doubt = chain.doubt(seen, path, joints, allocate, emission)
    del joints, emission
    error = seen.along(seen.error_mm, path)
    turned = _turn_round(seen, path, doubt, corrections)
    track = Track.empty(subject.skeleton, seen.times_ns, allocate=allocate)
    used = np.zeros(len(seen), np.bool_)
    seconds = seen.seconds

    def draw(rows: slice) -> None:
        """Smooth the frames `rows` with a margin on either side, and write them into the track.

        Args:
            rows: consecutive frames, one block.
        """
        first = max(0, rows.start - MARGIN)
        last = min(len(seen), rows.stop + MARGIN)
        around = slice(first, last)
        pose = seen[around].pose(path[around])
        _reverse(subject.skeleton, pose, turned[around])
        curve = smooth(
            subject.skeleton, seconds[around], pose, error[around], subject.length_mm, tuning.motion
        )
        curve = curve[rows.start - first : rows.stop - first]
        _write(subject, track[rows], curve, tuning)
        used[rows] = curve.used

    usual_px = usual_pixels(seen, path)
    in_view = share_in_view(seen, path, usual_px)
    # fitted to what is seen, a pose is off by about what is hidden
    error = np.hypot(error, (1.0 - in_view) * subject.length_mm)
    unknown = lies_unknown(in_view, doubt)
    path[unknown] = NONE
    for rows in blocks(len(seen), _BLOCK):
        draw(rows)
    for _ in range(_TIMES):
        taken = path == NONE
        for rows in blocks(len(seen), _BLOCK):
            _admit(subject, seen[rows], path[rows], error[rows], track[rows], usual_px)
        path[unknown] = NONE
        taken &= path != NONE
        for rows in blocks(len(seen), _BLOCK):
            if taken[max(0, rows.start - MARGIN) : rows.stop + MARGIN].any():
                draw(rows)
    measured = used & (path >= 0)
    bridged = short_gaps(seconds, measured, subject.bridge_s)
    strayed = np.zeros(len(seen), np.bool_)
    for rows in blocks(len(seen), _BLOCK):
        strayed[rows] = elsewhere(
            subject.skeleton,
            seen[rows],
            track.joints_mm[rows],
            track.predicted_error_mm[rows],
            subject.length_mm,
            usual_px,
        )
    hidden = gone_behind(seen, measured, usual_px)
    bridged &= ~strayed & ~hidden  # what is in view is measured, or it has no pose
    # nobody knows what an animal does that stays half hidden for long
    bridged &= ~unknown | whole_gaps(seconds, measured, subject.bridge_s)
    hidden |= unknown & ~bridged
    strayed |= _doubted(subject, seen, path, in_view, usual_px)
    for rows in blocks(len(seen), _BLOCK):
        _mask_and_flag(
            subject,
            track[rows],
            seen[rows],
            path[rows],
            doubt[rows],
            measured[rows],
            bridged[rows],
            strayed[rows],
        )
        hide(track[rows], hidden[rows])
    flips = _flips(seen, track)
    return Tracked(
        track, tuple(sorted([*flips, *corrections], key=lambda flip: (flip.start, flip.source)))
    )


def _doubted(
    subject: Subject,
    seen: Observations,
    path: NDArray[np.int64],
    in_view: Array,
    usual_px: float,
) -> NDArray[np.bool_]:
    """Whether (n,) a pose is doubtful for what its picture shows: it contradicts the pose, a part
    of the animal (1 - `in_view`, (n,)) is behind something, or it touches another animal.
    """
    doubted = contradicted(seen, path, subject.length_mm) | (in_view < WHOLE)
    if subject.n_animals > 1:
        doubted |= together(seen, path, usual_px)
    return doubted


def _turn_round(
    seen: Observations, path: NDArray[np.int64], doubt: Array, corrections: Sequence[Flip]
) -> NDArray[np.int64]:
    """Exchange head and tail in the spans that a person corrected; their flip posterior is 0.

    The path takes the reversed hypothesis where a frame has it. Returns how often (n,) the pose
    itself is to be turned round elsewhere.
    """
    turned = np.zeros(len(seen), np.int64)
    for span in corrections:
        if span.undone_at:
            continue
        for t in range(span.start, min(span.stop, len(seen))):
            if path[t] == NONE:
                continue
            if seen.known[t, path[t] ^ 1]:
                path[t] ^= 1
            else:
                turned[t] += 1
        doubt[span.start : span.stop] = 0.0
    return turned


def _reverse(skeleton: Skeleton, pose: Pose, turned: NDArray[np.int64]) -> None:
    """Turn poses (n) round so many times (n,) each, in place."""
    for t in np.repeat(np.arange(len(turned)), turned):
        other = reversed_pose(skeleton, pose[t : t + 1])
        pose.root.rotation[t] = other.root.rotation[0]
        pose.root.translation[t] = other.root.translation[0]
        pose.angles[t] = other.angles[0]
        pose.scale[t] = other.scale[0]


def _admit(
    subject: Subject,
    seen: Observations,
    path: NDArray[np.int64],
    error: Array,
    track: Track,
    usual_px: float,
) -> None:
    """Gate: put hypotheses that lie on the curve after all into the path of frames passed by.

    Fills path (n,) and error (n,). Such a hypothesis lies within one predicted error, its own and
    the curve's together, and shows between half and 1.5 times as many pixels as usual: of half an
    animal nobody knows how it lies, and in a gap nobody knows where the curve is.
    """
    best = np.full(len(seen), _ADMIT)
    passed = (path == NONE) & np.isfinite(track.predicted_error_mm)
    for h in range(seen.score.shape[1]):
        shown = seen.n_px[:, h] / max(usual_px, 1.0)
        rows = np.flatnonzero(passed & seen.known[:, h] & (shown >= _LEAST) & (shown <= _MOST))
        if not len(rows):
            continue
        joints = joints_of(subject.skeleton, seen.pose(np.full(len(seen), h))[rows])
        unseen = _UNSEEN * subject.length_mm * np.maximum(1.0 - shown[rows], 0.0)
        said = np.hypot(seen.error_mm[rows, h], unseen)
        distance = np.linalg.norm(joints - track.joints_mm[rows], axis=-1).mean(axis=1)
        distance /= np.hypot(said, track.predicted_error_mm[rows])
        better = distance < best[rows]
        path[rows[better]] = h
        best[rows[better]] = distance[better]
        error[rows[better]] = said[better]


def to_track(
    subject: Subject,
    seen: Observations,
    path: NDArray[np.int64],
    curve: Curve,
    doubt: Array,
    ahead: bool = False,
    told: slice = slice(None),
    tuning: TrackingParameters | None = None,
    usual_px: float | None = None,
) -> Track:
    """The rows of a track that a smoothed curve gives: measured, bridged over a gap, or missing.

    Args:
        subject: whom the track is of.
        seen: hypotheses (n, H) of the frames that the curve covers.
        path: (n,) hypothesis of each frame, `NONE` where it was passed by.
        curve: smoothed poses of the n frames, arena frame.
        doubt: (n,) probability that head and tail are exchanged.
        ahead: the curve also goes on for up to `bridge_s` after the last measurement (prediction).
        told: only these rows are returned; gaps are judged by all n.
        tuning: motion parameters with the calibration factors; None takes the animal's own.
        usual_px: pixels that the animal usually shows; None takes the median of these frames.

    Returns:
        A track of the rows `told`; NaN where nothing was measured or bridged, flagged as hidden
        where too little of the animal is in view beside something nearer.
    """
    tuning = tuning or TrackingParameters.of(subject.skeleton.name)
    measured = curve.used & (path >= 0)
    bridged = short_gaps(seen.seconds, measured, subject.bridge_s, ahead)
    track = Track.empty(subject.skeleton, seen.times_ns[told])
    _write(subject, track, curve[told], tuning)
    usual_px = usual_pixels(seen, path) if usual_px is None else usual_px
    in_view = share_in_view(seen, path, usual_px)
    strayed = _doubted(subject, seen, path, in_view, usual_px)
    unknown = lies_unknown(in_view, doubt)
    measured &= ~unknown
    _mask_and_flag(
        subject,
        track,
        seen[told],
        path[told],
        doubt[told],
        measured[told],
        bridged[told],
        strayed[told],
    )
    hide(track, unknown[told] & ~bridged[told])
    return track


def hide(track: Track, hidden: NDArray[np.bool_]) -> None:
    """Flag rows (n,) of a track in which nothing was measured as hidden, in place.

    Args:
        track: n rows.
        hidden: where the animal is behind or under something; what was bridged there is no pose.
    """
    hidden = hidden & (track.flag == "not_found")
    _mask(track, hidden)
    track.bridged[hidden] = False
    track.flag[hidden] = "hidden"


def _mask(track: Track, rows: NDArray[np.bool_]) -> None:
    """Take the pose, with its spread and projection, out of rows (n,) of a track."""
    for column in (
        track.joints_mm,
        track.uv_px,
        track.predicted_error_mm,
        track.root_rotation,
        track.root_mm,
        track.angles_rad,
        track.scale,
        track.sd_mm,
        track.sd_xy_mm,
        track.sd_z_mm,
        track.cov_root,
        track.sd_angles_rad,
        track.p_flip,
    ):
        column[rows] = np.nan


def _write(subject: Subject, track: Track, curve: Curve, tuning: TrackingParameters) -> None:
    """A curve into the rows (n) of a track, whether anything was measured there or not."""
    pose = curve.pose
    motion = tuning.motion
    track.joints_mm[:] = curve.joints
    track.root_rotation[:] = pose.root.rotation
    track.root_mm[:] = pose.root.translation
    track.angles_rad[:] = pose.angles
    track.scale[:] = pose.scale
    stretch = motion.usual_stretch if subject.stretch_sd is None else subject.stretch_sd
    away = stretch_of(stretch, curve.joints)
    # two of three axes: up, and along the body, whose direction on the floor is any
    unseen = subject.unseen or (motion.unseen_height, motion.unseen_shift)
    height, shift = (share * subject.length_mm for share in unseen)
    track.sd_mm[:] = np.hypot(
        (curve.error_mm / ERROR_PER_SD)[:, None] * np.array(subject.joint_share), away
    ) * (motion.joint_calibration or 1.0)
    # sd_mm is what speeds and headings are made of; what is off throughout changes none
    track.sd_xy_mm[:] = np.hypot(track.sd_mm, np.sqrt(0.5) * shift)
    track.sd_z_mm[:] = np.hypot(track.sd_mm, height)
    constant = np.hypot(ERROR_PER_SD * away.mean(axis=1), MEAN_PER_SD * np.hypot(height, shift))
    track.predicted_error_mm[:] = np.hypot(curve.error_mm, constant)
    calibration = np.array(motion.root_calibration)
    R = pose.root.rotation
    up = height * R[:, 2]  # of the arena, in the root's own frame
    along = curve.joints[:, 0] - curve.joints[:, subject.skeleton.tip]
    along *= shift / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    along = np.einsum("nji,nj->ni", R, along)
    track.cov_root[:] = covariance_of_root(curve) * (calibration[:, None] * calibration)
    for constant_mm in (up, along):
        track.cov_root[:, 3:, 3:] += constant_mm[:, :, None] * constant_mm[:, None, :]
    track.sd_angles_rad[:] = (curve.sd_bend * motion.bend_calibration)[
        :, None
    ] * subject.skeleton.axes
    track.sd_angles_rad[:, 0] = 0.0


def _mask_and_flag(
    subject: Subject,
    track: Track,
    seen: Observations,
    path: NDArray[np.int64],
    doubt: Array,
    measured: NDArray[np.bool_],
    bridged: NDArray[np.bool_],
    strayed: NDArray[np.bool_],
) -> None:
    """Mask rows (n) of a track to those measured or bridged; add projections, flags and sight.

    Poses are doubtful where their predicted error is large or the picture contradicts them
    (strayed, (n,)).
    """
    there = measured | bridged
    _mask(track, ~there)
    track.uv_px[there] = subject.camera.project(
        subject.T_arena_camera.inverse() @ track.joints_mm[there]
    )
    track.p_flip[there] = doubt[there]
    _add_sight(track, seen, path, measured)
    track.bridged[:] = bridged
    limit = min(subject.doubtful_mm, MOST_ERROR * subject.length_mm)
    doubtful = strayed | (track.predicted_error_mm > limit)
    track.flag[measured] = np.where(doubtful, "doubtful", "")[measured]
    track.flag[~measured & ~seen.has_depth] = "no_depth"


def covariance_of_root(curve: Curve) -> Array:
    """Covariance (n, 6, 6) of the root: rotation, rad, then translation, mm, in its own frame.

    First-order propagation: the joints' middle is off by `cov_middle_mm2`, and a small turn φ about
    that middle moves the root by φ x l, with l the lever from the middle to the root; hence the
    blocks Σ_φ, -[l] Σ_φ and R^T Σ_m R + [l] Σ_φ [l]^T, with [l] the skew matrix.

    Args:
        curve: smoothed poses of n frames with the spread of the middle and of the turn.

    Returns:
        (n, 6, 6) symmetric, rad^2, rad mm and mm^2.
    """
    root = curve.pose.root
    out = np.zeros((len(curve.joints), 6, 6))
    lever = np.einsum("nij,ni->nj", root.rotation, curve.joints[:, 0] - curve.joints.mean(axis=1))
    moved = -so3.hat(lever)  # of a small turn: the shift is its cross product with the lever
    turn = curve.sd_turn[:, :, None] ** 2 * np.eye(3)
    out[:, :3, :3] = turn
    out[:, 3:, :3] = moved @ turn
    out[:, :3, 3:] = np.swapaxes(out[:, 3:, :3], 1, 2)
    middle = np.swapaxes(root.rotation, 1, 2) @ curve.cov_middle_mm2 @ root.rotation
    out[:, 3:, 3:] = middle + moved @ turn @ np.swapaxes(moved, 1, 2)
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))


def stretch_of(stretch_sd: float, joints: Array) -> Array:
    """Standard deviations (n, J) mm of joints whose distances from the base are all off.

    Args:
        stretch_sd: share by which the distances are off, as a standard deviation.
        joints: (n, J, 3) mm, the base first.

    Returns:
        (n, J) mm along one axis: stretch_sd times the distance from the base over sqrt(3).
    """
    return np.asarray(stretch_sd * np.linalg.norm(joints - joints[:, :1], axis=-1) / np.sqrt(3.0))


MEAN_PER_SD = 0.8  # the mean of |x| over the standard deviation of a Gaussian x, sqrt(2 / pi)
# a mean distance in space over the standard deviation along one axis: 1.6 of a Gaussian, but tails
# are heavier
ERROR_PER_SD = 1.4


def _add_sight(
    track: Track, seen: Observations, path: NDArray[np.int64], measured: NDArray[np.bool_]
) -> None:
    """What was seen of the animal where it was measured."""
    rows = np.flatnonzero(measured)
    taken = path[measured]
    track.n_foreground_px[rows] = seen.n_px[rows, taken]
    track.centroid_mm[rows] = seen.centroid_mm[rows, taken]
    track.centroid_px[rows] = seen.centroid_px[rows, taken]
    track.residual_mm[rows] = seen.residual_mm[rows, taken]


def single_frames(subject: Subject, seen: Observations) -> Track:
    """The track of each frame by itself, without its neighbours: its first hypothesis.

    No association, no smoothing and no bridging; p_flip is 0 throughout. The spread is that of one
    measurement.

    Args:
        subject: whom the track is of; its `bridge_s` is not used.
        seen: hypotheses (n, H), arena frame.

    Returns:
        A track of n rows, NaN where a frame has no first hypothesis.
    """
    path = np.where(seen.known[:, 0], 0, NONE)
    pose = seen.pose(path)
    error = seen.along(seen.error_mm, path)
    moves = TrackingParameters.of(subject.skeleton.name).motion.packed
    turn, bend = (
        group[:, 0] * error[:, None] / subject.length_mm for group in (moves.turn, moves.bend)
    )
    middle = (moves.position_error * error[:, None])[:, :, None] ** 2 * np.eye(3)
    curve = Curve(pose, joints_of(subject.skeleton, pose), error, middle, turn, bend, path >= 0)
    return to_track(replace(subject, bridge_s=0.0), seen, path, curve, np.zeros(len(seen)))


def _flips(seen: Observations, track: Track) -> list[Flip]:
    """The stretches in which the single frames had head and tail exchanged, and those in which the
    track may have.
    """
    tip = track.skeleton.tip
    exchanged = np.zeros(len(seen), np.bool_)
    for rows in blocks(len(seen), _BLOCK):
        ends = seen[rows].joints_as(0, [0, tip])
        along = track.joints_mm[rows, tip] - track.joints_mm[rows, 0]
        exchanged[rows] = np.einsum("nd,nd->n", along, ends[:, 1] - ends[:, 0]) < 0
    found = [Flip(a, b, float(1.0 - track.p_flip[a:b].mean()), True) for a, b in spans(exchanged)]
    unsure = ~exchanged & (track.p_flip > _TOLD)
    return found + [Flip(a, b, float(track.p_flip[a:b].mean()), False) for a, b in spans(unsure)]
