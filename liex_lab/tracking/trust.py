"""Poses of a track that the depth image contradicts, whatever error the model predicts for them.

A pose with an error of more than a quarter of the length is not trusted, whatever limit the plan
states. A measured pose is compared with the depth image by four numbers (`residual.Agreement`): the
distance between the rendered body and the depth, the same in the part of the body where it is
largest, the share of the silhouette that the body covers, and the share of the body outside it. A
smoothed or bridged pose is compared with the hypotheses of its frame: while an animal is in full
view, a pose elsewhere is rejected.

The limits were set on virtual recordings of the mouse, the fish and the hand with known truth;
`docs/trust.md` describes how.

A row of a track is measured, bridged over a gap, or missing. It is doubtful if its predicted error
is large or its depth image contradicts it, and hidden if the animal is behind an object. Its spread
is that of the curve plus the systematic error of a body of a different build or size.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.geometry import so3
from liex_lab.runtime.memory import Allocator, in_windows
from liex_lab.tracking._association_kernels import NONE
from liex_lab.tracking.observations import Array, Observations, joints_of
from liex_lab.tracking.smoother import SmoothedCurve, TrackingParameters
from liex_lab.tracking.track import Subject, Track, short_gaps, spans

# of the animal's length
MOST_ERROR = 0.25
MOST_RESIDUAL = 0.12
# smallest and largest share of the usual pixels of a fully visible animal
_SHOWN = (0.6, 1.6)
# an animal is partly hidden if this share of its outline ends at an obstruction and it has less
# than this share of its usual pixels; an obstruction lasts for some frames
_BEHIND = 0.03
WHOLE = 0.95
_FRAMES = 2  # before and after
MOSTLY = 0.7  # share that must be visible to determine its posture
_SHORTLY_S = 0.5  # before it disappeared behind something, less and less of it was visible


def contradicted(
    observed: Observations, path: NDArray[np.int64], length_mm: float
) -> NDArray[np.bool_]:
    """Whether (n,) the depth image contradicts the pose of a frame's own hypothesis.

    Args:
        observed: hypotheses (n, H) of the frames.
        path: (n,) index of the hypothesis, negative for none.
        length_mm: of the animal.

    Returns:
        False if there is no hypothesis, or its agreement with the depth image is unknown.
    """
    residual = observed.along(observed.residual_mm, path)
    # a smaller residual is never a contradiction, even in a low-noise session
    limit = min(
        max(4.0 * finite_median(residual, 0.0), 0.04 * length_mm), MOST_RESIDUAL * length_mm
    )

    def disagrees(at: slice) -> NDArray[np.bool_]:
        """Whether the depth image contradicts the poses of some frames."""
        some, h = observed[at], path[at]
        with np.errstate(invalid="ignore"):
            return np.asarray(
                (residual[at] > limit)
                | (some.along(some.part_mm, h) > MOST_RESIDUAL * length_mm)
                | (some.along(some.covered, h) < 0.35)
                | (some.along(some.beside, h) > 0.6)
            )

    return in_windows(len(observed), 0, disagrees)


def finite_median(values: Array, otherwise: float) -> float:
    """The median of the finite values, or another number if there are none."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else otherwise


def usual_pixels(observed: Observations, path: NDArray[np.int64]) -> float:
    """The animal's usual number of pixels when it is unobstructed.

    The median along a path over the frames in which its outline does not end at a nearer object, or
    over all frames if fewer than 12 of them qualify.

    Args:
        observed: hypotheses (n, H) of the frames.
        path: (n,) index of the hypothesis, negative for none.

    Returns:
        The pixels; 0 if the path is empty.
    """
    return median_of_whole(
        observed.along(observed.n_px, path), observed.along(observed.behind, path)
    )


def median_of_whole(shown: Array, behind: Array) -> float:
    """An animal's usual number of pixels when it is unobstructed.

    Args:
        shown: (n,) its pixels, NaN if unknown.
        behind: (n,) share of its outline that ends at a nearer object.

    Returns:
        The median; 0 if none is known.
    """
    whole = np.isfinite(shown) & (np.nan_to_num(behind) <= _BEHIND)
    return finite_median(shown[whole] if whole.sum() >= 12 else shown, 0.0)


def share_in_view(observed: Observations, path: NDArray[np.int64], usual_px: float) -> Array:
    """The visible share (n,) of an animal that is partly behind a nearer object.

    Args:
        observed: hypotheses (n, H) of consecutive frames.
        path: (n,) index of the hypothesis; if negative, the first one is used.
        usual_px: the animal's usual number of pixels.

    Returns:
        1 if it is unobstructed, or if there is no hypothesis.
    """

    def share(at: slice) -> Array:
        """The share of some frames."""
        some = observed[at]
        meant = np.where((path[at] < 0) & some.known[:, 0], 0, path[at])
        behind, shown = (some.along(values, meant) for values in (some.behind, some.n_px))
        return np.where(meant >= 0, visible_share(behind, shown, usual_px), 1.0)

    return in_windows(len(observed), _FRAMES, share)


def lies_unknown(in_view: Array, doubt: Array) -> NDArray[np.bool_]:
    """Whether (n,) so much of an animal is hidden that its pose is unknown.

    Args:
        in_view: (n,) its visible share.
        doubt: (n,) probability that its head and tail are exchanged.

    Returns:
        True if less than 0.7 is visible, or if part of it is hidden and its ends are uncertain.
    """
    return np.asarray((in_view < MOSTLY) | ((in_view < WHOLE) & (doubt > 0.25)))


def visible_share(behind: Array, shown_px: Array, usual_px: float, beside: int = _FRAMES) -> Array:
    """The visible share (n,) of an animal that is partly behind a nearer object.

    Args:
        behind: (n,) share of its outline that ends at a nearer object.
        shown_px: (n,) its pixels.
        usual_px: its usual pixels.
        beside: an obstruction within this many frames before and after also counts here.
    """
    near = np.pad(np.nan_to_num(behind), beside)
    most = np.max([near[k : k + len(behind)] for k in range(2 * beside + 1)], axis=0)
    return np.where(most > _BEHIND, np.minimum(shown_px / max(usual_px, 1.0), 1.0), 1.0)


def head_tail_weight(observed: Observations, allocate: Allocator = np.empty) -> Array:
    """The weight (n, H), 0 to 1, of each hypothesis as evidence for which end is the head.

    The metric was not trained on partly hidden animals, and confuses their ends in many consecutive
    frames: the weight is 0 if no more than 0.7 of the animal is visible.

    Args:
        observed: hypotheses (n, H) of consecutive frames.
        allocate: allocator of the result.

    Returns:
        1 if all of it is visible, or if there is no hypothesis.
    """
    usual_px = usual_pixels(observed, np.where(observed.known[:, 0], 0, -1))

    def weight(at: slice) -> Array:
        """The weight of some frames."""
        behind, shown = (values[at].T.astype(float) for values in (observed.behind, observed.n_px))
        share = np.array([visible_share(*one, usual_px) for one in zip(behind, shown, strict=True)])
        return np.clip((share.T - MOSTLY) / (WHOLE - MOSTLY), 0.0, 1.0) ** 2

    return in_windows(len(observed), _FRAMES, weight, allocate)


def gone_behind(
    observed: Observations, measured: NDArray[np.bool_], usual_px: float
) -> NDArray[np.bool_]:
    """Whether (n,) the animal is hidden: it disappeared behind or under an object.

    A hidden stretch has no measured pose and for a while no object of the animal's size in view;
    just before it, less and less of the animal was visible next to a nearer object. If a recording
    begins with such a stretch, the frames after it decide.

    Args:
        observed: hypotheses (n, H) of all frames.
        measured: (n,) whether a pose was measured.
        usual_px: the animal's usual number of pixels.
    """
    hidden = np.zeros(len(observed), np.bool_)
    known = np.asarray(observed.known.any(axis=1))
    shown = np.where(known, observed.n_px.max(axis=1), 0) / max(usual_px, 1.0)
    behind = np.where(known, np.nan_to_num(observed.behind).max(axis=1), 0.0)
    seconds = observed.seconds
    for start, stop in spans(~measured):
        gone = start + np.flatnonzero(~known[start:stop] & observed.has_depth[start:stop])
        if not len(gone):
            continue
        before = np.flatnonzero(known[: gone[0]])
        if len(before):
            near = before[seconds[before] >= seconds[gone[0]] - _SHORTLY_S]
        else:
            after = gone[0] + np.flatnonzero(known[gone[0] :])
            near = after[seconds[after] <= seconds[after[:1]] + _SHORTLY_S]
        hidden[start:stop] = disappears(shown[near], behind[near])
    return hidden


def disappears(shown: Array, behind: Array) -> bool:
    """Whether frames (k,) show an animal that disappears: fewer pixels, over the usual ones, and an
    outline that ends at a nearer object.
    """
    return len(shown) > 0 and bool(shown.min() < 0.8 and behind.max() > _BEHIND)


class OcclusionMonitor:
    """`gone_behind` during a recording, frame by frame, from past frames only.

    Without later frames, an animal that is hidden at the beginning counts as not found.
    """

    def __init__(self) -> None:
        # of measured frames: pixels, share of the outline behind something
        self._shown: deque[tuple[float, float]] = deque(maxlen=900)
        # preceding frames with something in view: s, px, share behind
        self._near: deque[tuple[float, int, float]] = deque()
        self._lost = False
        self._gone = False

    @property
    def usual_px(self) -> float | None:
        """The animal's usual number of pixels; None before the first measurement."""
        return median_of_whole(*np.array(self._shown).T) if self._shown else None

    def gone(
        self, observed: Observations, path: NDArray[np.int64], measured: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Whether (n,) the animal is hidden in the next frames, see `gone_behind`.

        Args:
            observed: hypotheses (n, H) of consecutive frames, the first the one after the last.
            path: (n,) index of the hypothesis, negative for none.
            measured: (n,) whether a pose was measured.
        """
        known = np.asarray(observed.known.any(axis=1))
        behind = np.nan_to_num(observed.behind)
        hidden = np.zeros(len(observed), np.bool_)
        for k, time_ns in enumerate(observed.times_ns):
            now_s = 1e-9 * float(time_ns)
            if measured[k]:
                self._shown.append((float(observed.n_px[k, path[k]]), float(behind[k, path[k]])))
                self._lost = self._gone = False
            if known[k]:
                self._near.append((now_s, int(observed.n_px[k].max()), float(behind[k].max())))
            while self._near and self._near[0][0] < now_s - _SHORTLY_S:
                self._near.popleft()
            if not known[k] and observed.has_depth[k] and not self._lost:
                _, shown, near = np.array([*self._near]).reshape(-1, 3).T
                self._lost = True
                self._gone = disappears(shown / max(self.usual_px or 0.0, 1.0), near)
            hidden[k] = self._gone
        return hidden


def distances(
    observed: Observations,
    joints_mm: Array,
    where: NDArray[np.bool_],
    usual_px: float,
    sizes: tuple[float, float],
) -> Iterator[tuple[int, NDArray[np.int64], Array, Array]]:
    """Mean joint distances of hypotheses from other poses of their frames.

    Args:
        observed: hypotheses (n, H) of the frames.
        joints_mm: (n, J, 3) the poses, arena frame, mm.
        where: (n,) the frames to compare.
        usual_px: the animal's usual number of pixels.
        sizes: least and most pixels of a hypothesis, over the usual ones.

    Yields:
        For each number of a hypothesis the frames (k,) that have it, its pixels over the usual
        ones, and its distances, mm.
    """
    for h in range(observed.score.shape[1]):
        shown = observed.n_px[:, h] / max(usual_px, 1.0)
        least, most = sizes
        rows = np.flatnonzero(where & observed.known[:, h] & (shown >= least) & (shown <= most))
        if len(rows):
            own = joints_of(observed.skeleton, observed.pose(np.full(len(observed), h))[rows])
            off = np.linalg.norm(own - joints_mm[rows], axis=-1).mean(axis=1)
            yield h, rows, shown[rows], off


def elsewhere(
    observed: Observations, joints_mm: Array, error_mm: Array, length_mm: float, usual_px: float
) -> NDArray[np.bool_]:
    """Whether (n,) a pose differs from all hypotheses of its frame while the animal is in view.

    Both directions are compared, because the head is decided from several frames.

    Args:
        observed: hypotheses (n, H) of the frames.
        joints_mm: (n, J, 3) the poses, arena frame, mm; NaN if absent.
        error_mm: (n,) their predicted errors, mm.
        length_mm: of the animal.
        usual_px: the animal's usual number of pixels.

    Returns:
        False if no object of the animal's size is in full view, or if there is no pose.
    """
    nearest = np.full(len(observed), np.inf)
    allowed = np.zeros(len(observed))
    posed = np.isfinite(error_mm)
    for h, rows, _, off in distances(observed, joints_mm, posed, usual_px, _SHOWN):
        both = np.hypot(observed.error_mm[rows, h], error_mm[rows])
        nearer = off < nearest[rows]
        nearest[rows[nearer]] = off[nearer]
        # in predicted errors, and over the length
        allowed[rows[nearer]] = np.maximum(4.0 * both, 0.25 * length_mm)[nearer]
    return np.asarray(np.isfinite(nearest) & (nearest > allowed))


# Plausibility of an animal's speed, given the clock of its recording.


def why_too_fast(track: Track, length_mm: float) -> str:
    """A message if the animal is faster than animals can sustain; "" if it is not, or if unknown.

    Args:
        track: one row for every frame.
        length_mm: of the animal, mm.
    """
    times_s = (track.times_ns - track.times_ns[0]) / 1e9
    n = len(times_s)
    first = np.unique(np.linspace(0, n - 1, min(n, 20_000)).round().astype(int))
    # the displacement in this time exceeds single-frame noise
    then = np.searchsorted(times_s, times_s[first] + 0.1)
    first, then = first[then < n], then[then < n]
    passed_s = times_s[then] - times_s[first]
    gone = track.centroid_mm[then, :2] - track.centroid_mm[first, :2]
    known = np.isfinite(gone).all(axis=1) & (passed_s <= 0.2)  # no long gap of missing frames
    if known.sum() < 30:
        return ""
    speed = float(np.quantile(np.hypot(*gone[known].T) / passed_s[known], 0.75))
    if speed <= 10.0 * length_mm:  # 1 to 4 are usual, in short bursts 30
        return ""
    return (
        f"by its time stamps the animal goes {speed:,.0f} mm/s for a quarter of the time, "
        f"{speed / length_mm:.0f} of its lengths a second, which none keeps up: check the frame "
        "rate"
    )


# Rows of a track: values of the smoothed curve, validity and uncertainty.


# mean 3D distance over the standard deviation along one axis: 1.6 for a Gaussian, but tails are
# heavier
ERROR_PER_SD = 1.4


# columns that describe the observed animal, not its pose
SIGHT = ("n_foreground_px", "centroid_mm", "centroid_px", "residual_mm")


def to_track(
    subject: Subject,
    observed: Observations,
    path: NDArray[np.int64],
    curve: SmoothedCurve,
    doubt: Array,
    ahead: bool = False,
    usual_px: float | None = None,
) -> Track:
    """The rows of a track that a smoothed curve gives: measured, bridged over a gap, or missing.

    Args:
        subject: the animal of the track.
        observed: hypotheses (n, H) of the frames that the curve covers.
        path: (n,) hypothesis of each frame, `NONE` if it was skipped.
        curve: smoothed poses of the n frames, arena frame.
        doubt: (n,) probability that head and tail are exchanged.
        ahead: extend the curve for up to `bridge_s` after the last measurement (prediction).
        usual_px: the animal's usual number of pixels; None uses the median of these frames.

    Returns:
        A track of n rows; NaN if nothing was measured or bridged, flagged as hidden if too little
        of the animal is visible next to a nearer object.
    """
    measured = curve.used & (path >= 0)
    bridged = short_gaps(observed.seconds, measured, subject.bridge_s, ahead)
    track = Track.empty(subject.skeleton, observed.times_ns)
    write_curve(subject, track, curve, TrackingParameters.of(subject.skeleton.name))
    usual_px = usual_pixels(observed, path) if usual_px is None else usual_px
    in_view = share_in_view(observed, path, usual_px)
    unknown = lies_unknown(in_view, doubt)
    objects = np.isfinite(observed.objects[..., 0]).sum(axis=1)
    track.n_animals[:] = np.clip(objects, observed.known.any(axis=1), subject.n_animals)
    # animals that touch are one object
    n_animals = np.maximum(track.n_animals, subject.n_animals)
    strayed = doubted(subject, observed, path, in_view, n_animals)
    mask_and_flag(subject, track, observed, path, doubt, measured & ~unknown, bridged, strayed)
    hide(track, unknown & ~bridged)
    return track


def hide(track: Track, hidden: NDArray[np.bool_]) -> None:
    """Flag rows (n,) of a track in which nothing was measured as hidden, in place.

    Args:
        track: n rows.
        hidden: frames with the animal behind or under an object; bridged poses there are removed.
    """
    hidden = hidden & (track.flag == "not_found")
    _mask(track, hidden)
    track.bridged[hidden] = False
    track.flag[hidden] = "hidden"


def _mask(track: Track, rows: NDArray[np.bool_]) -> None:
    """Remove the pose, with its spread and projection, from rows (n,) of a track."""
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


def write_curve(
    subject: Subject, track: Track, curve: SmoothedCurve, tuning: TrackingParameters
) -> None:
    """Write a curve into rows of a track, measured or not.

    Args:
        subject: the animal of the track.
        track: its n rows, filled in place.
        curve: smoothed poses of these n frames, arena frame.
        tuning: motion parameters with the calibration factors.
    """
    pose = curve.pose
    motion = tuning.motion
    track.joints_mm[:] = curve.joints
    track.root_rotation[:] = pose.root.rotation
    track.root_mm[:] = pose.root.translation
    track.angles_rad[:] = pose.angles
    track.scale[:] = pose.scale
    stretch = motion.usual_stretch if subject.stretch_sd is None else subject.stretch_sd
    away = stretch_of(stretch, curve.joints)
    # two of three axes: up, and along the body, at any heading
    unseen = subject.unseen or (motion.unseen_height, motion.unseen_shift)
    height, shift = (np.asarray(share) * subject.length_mm for share in unseen)
    track.sd_mm[:] = np.hypot(
        (curve.error_mm / ERROR_PER_SD)[:, None] * np.array(subject.joint_share), away
    ) * (motion.joint_calibration or 1.0)
    # sd_mm applies to speeds and headings, which constant errors do not change
    track.sd_xy_mm[:] = np.hypot(track.sd_mm, np.sqrt(0.5) * shift)
    track.sd_z_mm[:] = np.hypot(track.sd_mm, height)
    # of |x| for a Gaussian x, 0.8 is the mean over the standard deviation, sqrt(2 / pi)
    constant = np.hypot(ERROR_PER_SD * away.mean(axis=1), 0.8 * np.hypot(height, shift).mean())
    track.predicted_error_mm[:] = np.hypot(curve.error_mm, motion.expected_share * constant)
    calibration = np.array(motion.root_calibration)
    R = pose.root.rotation
    up = height.flat[0] * R[:, 2]  # of the arena, in the root's own frame
    along = curve.joints[:, 0] - curve.joints[:, subject.skeleton.tip]
    along *= shift / np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    along = np.einsum("nji,nj->ni", R, along)
    track.cov_root[:] = covariance_of_root(curve) * (calibration[:, None] * calibration)
    for constant_mm in (up, along):
        track.cov_root[:, 3:, 3:] += constant_mm[:, :, None] * constant_mm[:, None, :]
    sd_bend = curve.sd_bend * motion.bend_calibration
    track.sd_angles_rad[:] = sd_bend[:, None] * subject.skeleton.axes
    track.sd_angles_rad[:, 0] = 0.0


def mask_and_flag(
    subject: Subject,
    track: Track,
    observed: Observations,
    path: NDArray[np.int64],
    doubt: Array,
    measured: NDArray[np.bool_],
    bridged: NDArray[np.bool_],
    strayed: NDArray[np.bool_],
) -> None:
    """Mask rows of a track to those measured or bridged; add projections, flags and visibility.

    Args:
        subject: the animal of the track.
        track: its n rows, changed in place.
        observed: hypotheses (n, H) of these frames.
        path: (n,) hypothesis of each frame, `NONE` if it was skipped.
        doubt: (n,) probability that head and tail are exchanged.
        measured: (n,) bool, where a hypothesis was selected.
        bridged: (n,) bool, where the curve bridges a gap.
        strayed: (n,) bool, where the depth image contradicts the pose, which makes it doubtful
            like a large predicted error.
    """
    there = measured | bridged
    _mask(track, ~there)
    track.uv_px[there] = subject.camera.project(
        subject.T_arena_camera.inverse() @ track.joints_mm[there]
    )
    track.p_flip[there] = doubt[there]
    rows = np.flatnonzero(measured)
    columns = observed.n_px, observed.centroid_mm, observed.centroid_px, observed.residual_mm
    for name, values in zip(SIGHT, columns, strict=True):
        getattr(track, name)[rows] = values[rows, path[rows]]
    track.bridged[:] = bridged
    limit = min(subject.doubtful_mm, MOST_ERROR * subject.length_mm)
    doubtful = strayed | (track.predicted_error_mm > limit)
    track.flag[measured] = np.where(doubtful, "doubtful", "")[measured]
    track.flag[~measured & ~observed.has_depth] = "no_depth"
    track.flag[observed.copies] = "repeated"


def covariance_of_root(curve: SmoothedCurve) -> Array:
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
    moved = -so3.hat(lever)  # for a small turn: the shift is its cross product with the lever
    turn = curve.sd_turn[:, :, None] ** 2 * np.eye(3)
    out[:, :3, :3] = turn
    out[:, 3:, :3] = moved @ turn
    out[:, :3, 3:] = np.swapaxes(out[:, 3:, :3], 1, 2)
    middle = np.swapaxes(root.rotation, 1, 2) @ curve.cov_middle_mm2 @ root.rotation
    out[:, 3:, 3:] = middle + moved @ turn @ np.swapaxes(moved, 1, 2)
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))


def stretch_of(stretch_sd: float, joints: Array) -> Array:
    """Standard deviations (n, J) mm of joints from a common error of their distances to the base.

    Args:
        stretch_sd: relative error of the distances, as a standard deviation.
        joints: (n, J, 3) mm, the base first.

    Returns:
        (n, J) mm along one axis: stretch_sd times the distance from the base over sqrt(3).
    """
    return np.asarray(stretch_sd * np.linalg.norm(joints - joints[:, :1], axis=-1) / np.sqrt(3.0))


def single_frames(subject: Subject, observed: Observations) -> Track:
    """The track of single frames, without their neighbours: the first hypothesis of each.

    No association, no smoothing and no bridging; p_flip is 0 throughout. The spread is that of one
    measurement.

    Args:
        subject: the animal of the track; its `bridge_s` is not used.
        observed: hypotheses (n, H), arena frame.

    Returns:
        A track of n rows, NaN if a frame has no first hypothesis.
    """
    path = np.where(observed.known[:, 0], 0, NONE)
    pose = observed.pose(path)
    error = observed.along(observed.error_mm, path)
    motion = TrackingParameters.of(subject.skeleton.name).motion
    turn, bend = motion.angle_sd(error, subject.length_mm)
    middle = (np.array(motion.position_error) * error[:, None])[:, :, None] ** 2 * np.eye(3)
    curve = SmoothedCurve(
        pose, joints_of(subject.skeleton, pose), error, middle, turn, bend, path >= 0
    )
    return to_track(replace(subject, bridge_s=0.0), observed, path, curve, np.zeros(len(observed)))


def doubted(
    subject: Subject,
    observed: Observations,
    path: NDArray[np.int64],
    in_view: Array,
    n_animals: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Whether (n,) a pose is doubtful because of its depth image.

    The image contradicts the pose, the animal is partly hidden, or it is not known which of several
    animals it is.

    Args:
        subject: the animal of the track.
        observed: hypotheses (n, H).
        path: (n,) hypothesis of each frame, `NONE` if it was skipped.
        in_view: (n,) visible share of the animal.
        n_animals: (n,) animals in view.
    """
    contradicts = contradicted(observed, path, subject.length_mm)
    return contradicts | (in_view < WHOLE) | (n_animals > subject.n_measured)
