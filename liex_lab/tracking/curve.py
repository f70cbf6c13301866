"""Fixed-interval smoothing of a whole recording: association, flip posterior, then RTS smoothing.

1. Viterbi over the hypotheses of single frames (`association`) selects the animal's, or none.
2. A forward-backward pass over two states, head and tail as they are or exchanged, gives the flip
   posterior; spans that a person corrected are exchanged with certainty.
3. A Kalman filter and Rauch-Tung-Striebel smoother of an integrated Ornstein-Uhlenbeck process
   (`smoother`) runs over blocks of 4096 frames with a margin of 160 frames on either side. It is
   cut where a person's exchange makes a half turn: the sides do not affect each other.
4. Validation gate: a skipped hypothesis within one predicted error of the curve, its own and the
   curve's combined, is used as a measurement. This is done twice, because each pass moves the curve
   closer to others.
5. Gaps up to `bridge_s` are bridged by the curve, longer ones are NaN, and so are frames in which
   an animal is in full view elsewhere.
6. Poses that the depth image contradicts are doubtful (`trust`).

The default tracker of the package; it replaces the particle filter of Lie-X section 4.2
(`particles`).

For an ongoing recording, `OnlineTracker` uses the same methods over a sliding window of 48 frames
(fixed-lag smoothing), with earlier decisions fixed.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from liex_lab.arrays import Mask, NDArray
from liex_lab.recordings.timestamps import GAP_FACTOR, median_step
from liex_lab.runtime.memory import Allocator, blocks
from liex_lab.tracking.association import NONE, HypothesisAssociation
from liex_lab.tracking.counting import count_animals
from liex_lab.tracking.observations import Array, Observations, reversed_pose
from liex_lab.tracking.smoother import TrackingParameters, smooth
from liex_lab.tracking.track import (
    Flip,
    Subject,
    Track,
    Tracked,
    ends_of,
    short_gaps,
    spans,
    whole_gaps,
)
from liex_lab.tracking.trust import (
    SIGHT,
    OcclusionMonitor,
    distances,
    doubted,
    elsewhere,
    gone_behind,
    hide,
    lies_unknown,
    mask_and_flag,
    share_in_view,
    to_track,
    usual_pixels,
    write_curve,
)


def polled_twice(times_ns: NDArray[np.int64], copies: Mask, known: Mask) -> Mask:
    """Which copies (n,) result from polling faster than the frame rate; in others the stream froze.

    Args:
        times_ns: (n,) time stamps, ns.
        copies: (n,) whether the frame is a copy of the one before.
        known: (n,) whether the animal is known from the frame itself; False at copies.
    """
    if not copies.any():
        return copies
    seconds = (times_ns - times_ns[:1]).astype(np.float64) * 1e-9
    step_s = median_step(times_ns[~copies]) * 1e-9
    between = whole_gaps(seconds, known, GAP_FACTOR * step_s)
    last = np.flatnonzero(known)[-1:]  # no image follows it, and its copies end with the recording
    if len(last) and seconds[-1] - seconds[last[0]] < 0.9 * step_s:  # too short for a new image
        between[last[0] + 1 :] = True
    return copies & between


def repeat_messages(
    times_ns: NDArray[np.int64], repeats: Mask, noisy: bool
) -> tuple[list[str], list[str]]:
    """Messages about repeated images: reasons to review the recording, and notes.

    Args:
        times_ns: (n,) time stamps, ns.
        repeats: (n,) whether the depth image is, bit for bit, the one before.
        noisy: whether the sensor has noise, so that these are copies.
    """
    often = polled_twice(times_ns, repeats, ~repeats) & noisy
    still = repeats & ~often
    reasons: list[str] = []
    cautions: list[str] = []
    if often.any():
        true_hz, hz = (1e9 / median_step(times) for times in (times_ns[~repeats], times_ns))
        times = f"{hz / true_hz:.1f} times".replace("2.0 times", "twice").replace(".0 ", " ")
        cautions.append(
            f"each depth image is there {times}: the camera made {true_hz:.2f} frames/s, not "
            f"{hz:.2f}; each image counts once"
        )
    if (n := int(still.sum())) >= (1 if noisy else 5):  # some may repeat without noise
        stops = np.append(times_ns[1:], times_ns[-1] + median_step(times_ns))
        lasted = [(1e-9 * (stops[b - 1] - times_ns[a]), a) for a, b in spans(still)]
        longest_s, at = max(lasted)
        message = (
            f"the depth image of the frame before repeats in {n:,} of {len(still):,} frames, "
            f"{sum(one for one, _ in lasted):.2f} s in all, the longest time for {longest_s:.2f} s "
            f"from {1e-9 * (times_ns[at] - times_ns[0]):.2f} s on"
        )
        if not noisy:
            cautions.append(
                f"{message}; the background has no noise, so the animal may be still or the "
                "stream frozen: watch that part of the replay"
            )
        else:
            (reasons if n > 0.1 * len(still) else cautions).append(  # a longer freeze needs review
                f"the stream froze: {message}; nothing is measured there"
            )
    return reasons, cautions


# frames smoothed at once, and context frames on either side
_BLOCK = 4096
MARGIN = 160


def track_whole(
    subject: Subject,
    observed: Observations,
    corrections: Sequence[Flip] = (),
    tuning: TrackingParameters | None = None,
    allocate: Allocator = np.empty,
) -> Tracked:
    """The track of a recording, smoothed over all of its frames at once, and its head-tail flips.

    See the module for the steps. Besides the columns of the track, no more than a block of frames
    is in memory.

    Args:
        subject: the animal of the track.
        observed: hypotheses (n, H) of all frames, arena frame.
        corrections: spans that a person marked as having head and tail exchanged; those with
            `undone_at` are not applied.
        tuning: motion and association parameters; None uses the animal's own.
        allocate: allocator of the track's columns, `np.empty` or one on disk.

    Returns:
        The track (n rows) and the flips, those found and those of `corrections`, in order of time.
    """
    tuning = tuning or TrackingParameters.of(subject.skeleton.name)
    count = count_animals(observed, subject.n_measured)
    if np.isfinite(observed.objects).any():  # which sessions of earlier versions lack
        subject = replace(subject, n_animals=count.n_animals)
    path, doubt = _associate(subject, observed, tuning, allocate)
    error = observed.along(observed.error_mm, path)
    applied = [(flip.start, flip.stop) for flip in corrections if not flip.undone_at]
    turned = _turn_round(observed, path, doubt, applied)
    usual_px = usual_pixels(observed, path)
    track = Track.empty(subject.skeleton, observed.times_ns, allocate=allocate)
    track.n_animals[:] = count.in_view
    cuts = _half_turns(observed, path, turned, applied)
    in_view = share_in_view(observed, path, usual_px)
    # a pose fitted to the visible part is off by about the hidden length
    error = np.hypot(error, (1.0 - in_view) * subject.length_mm)
    unknown = lies_unknown(in_view, doubt)
    path[unknown] = NONE
    seconds = observed.seconds
    used = np.zeros(len(observed), np.bool_)

    def draw(rows: slice) -> None:
        """Smooth the frames `rows` with a margin on either side, and write them into the track."""
        for start, stop in pairwise([0, *cuts, len(observed)]):
            part = slice(max(rows.start, start), min(rows.stop, stop))
            if part.start >= part.stop:
                continue
            first = max(start, part.start - MARGIN)
            around = slice(first, min(stop, part.stop + MARGIN))
            pose = observed[around].pose(path[around])
            for t in np.repeat(np.arange(len(pose.scale)), turned[around]):
                pose.put([t], reversed_pose(subject.skeleton, pose[t : t + 1]))
            measured = seconds[around], pose, error[around]
            curve = smooth(subject.skeleton, *measured, subject.length_mm, tuning.motion)
            curve = curve[part.start - first : part.stop - first]
            write_curve(subject, track[part], curve, tuning)
            used[part] = curve.used

    for rows in blocks(len(observed), _BLOCK):
        draw(rows)
    for _ in range(2):  # twice, as each pass moves the curve nearer to others
        taken = path == NONE
        for rows in blocks(len(observed), _BLOCK):
            _admit(subject, observed[rows], path[rows], error[rows], track[rows], usual_px)
        path[unknown] = NONE
        taken &= path != NONE
        for rows in blocks(len(observed), _BLOCK):
            if taken[max(0, rows.start - MARGIN) : rows.stop + MARGIN].any():
                draw(rows)
    measured = used & (path >= 0)
    _bridge_and_flag(subject, observed, path, doubt, measured, in_view, usual_px, track)
    ordered = sorted(
        [*_flips(observed, track), *corrections], key=lambda flip: (flip.start, flip.source)
    )
    return Tracked(track, tuple(ordered), tuple(cuts), subject.n_animals, count.share)


def _associate(
    subject: Subject, observed: Observations, tuning: TrackingParameters, allocate: Allocator
) -> tuple[NDArray[np.int64], Array]:
    """The path (n,) of the animal's hypotheses, and its flip posterior (n,)."""
    chain = HypothesisAssociation(subject.skeleton, subject.length_mm, tuning.chain)
    joints = chain.joints(observed, allocate)
    emission = chain.emission(observed, joints, allocate)
    path = chain.path(observed, joints, emission, allocate=allocate)
    return path, chain.doubt(observed, path, joints, emission)


def _bridge_and_flag(
    subject: Subject,
    observed: Observations,
    path: NDArray[np.int64],
    doubt: Array,
    measured: Mask,
    in_view: Array,
    usual_px: float,
    track: Track,
) -> None:
    """Decide which rows of a smoothed track are bridged, doubtful or hidden, and remove others."""
    unknown = lies_unknown(in_view, doubt)
    seconds = observed.seconds
    bridged = short_gaps(seconds, measured, subject.bridge_s) & ~observed.copies
    copies = polled_twice(observed.times_ns, observed.copies, measured)
    strayed = np.zeros(len(observed), np.bool_)
    for rows in blocks(len(observed), _BLOCK):
        part = track[rows]
        strayed[rows] = elsewhere(
            observed[rows], part.joints_mm, part.predicted_error_mm, subject.length_mm, usual_px
        )
    hidden = gone_behind(observed, measured, usual_px)
    bridged &= ~strayed & ~hidden  # visible animals are measured, or have no pose
    # the behaviour of an animal that stays half hidden is unknown
    bridged &= ~unknown | whole_gaps(seconds, measured, subject.bridge_s)
    hidden |= unknown & ~bridged
    strayed |= doubted(subject, observed, path, in_view, track.n_animals)
    masks = measured | copies, bridged, strayed
    for rows in blocks(len(observed), _BLOCK):
        part = track[rows]
        some = (mask[rows] for mask in masks)
        mask_and_flag(subject, part, observed[rows], path[rows], doubt[rows], *some)
        hide(part, hidden[rows])
    shown = observed.shown[copies] if copies.any() else copies[:0]
    for name in SIGHT if copies.any() else ():  # a copy shows what its original shows
        column = getattr(track, name)
        column[copies] = column[shown]


def _turn_round(
    observed: Observations,
    path: NDArray[np.int64],
    doubt: Array,
    exchanged: Sequence[tuple[int, int]],
) -> NDArray[np.int8]:
    """Exchange head and tail in the spans that a person corrected; their flip posterior is 0.

    The path uses the reversed hypothesis if the frame has one. Returns how many times (n,) the pose
    itself must be reversed elsewhere.
    """
    turned = np.zeros(len(observed), np.int8)
    for start, stop in exchanged:
        rows = start + np.flatnonzero(path[start:stop] != NONE)
        has_other = observed.known[rows, path[rows] ^ 1]
        path[rows[has_other]] ^= 1
        turned[rows[~has_other]] += 1
        doubt[start:stop] = 0.0
    return turned


def _half_turns(
    observed: Observations,
    path: NDArray[np.int64],
    turned: NDArray[np.int8],
    exchanged: Sequence[tuple[int, int]],
) -> list[int]:
    """The ends of a person's exchanges at which the body turns by more than 90 degrees.

    Compared are the last measured frame before an end and the first one after it.
    """

    def ahead(row: int) -> Array:
        """From base to tip (3,) of the pose in a `row`, mm."""
        base, tip = observed[row : row + 1].joints_as(int(path[row]), [0, observed.skeleton.tip])[0]
        return (tip - base) * (-1.0) ** turned[row]

    ends = ends_of(exchanged)
    rows = np.flatnonzero(path != NONE)
    return [
        end
        for end, k in zip(ends, np.searchsorted(rows, ends), strict=True)
        if 0 < k < len(rows) and ahead(rows[k - 1]) @ ahead(rows[k]) < 0.0
    ]


def _admit(
    subject: Subject,
    observed: Observations,
    path: NDArray[np.int64],
    error: Array,
    track: Track,
    usual_px: float,
) -> None:
    """Gate: add hypotheses on the curve to the path in skipped frames.

    Fills path (n,) and error (n,). Such a hypothesis is within one predicted error, its own and the
    curve's combined, and has 0.5 to 1.5 times the usual pixels: the pose of half an animal is
    unknown, as is the curve in a gap.
    """
    best = np.full(len(observed), 1.0)
    passed = (path == NONE) & np.isfinite(track.predicted_error_mm)
    for h, rows, shown, distance in distances(
        observed, track.joints_mm, passed, usual_px, (0.5, 1.5)
    ):
        # a pose errs by this share of the hidden length
        hidden_mm = 0.4 * subject.length_mm * np.maximum(1.0 - shown, 0.0)
        own = np.hypot(observed.error_mm[rows, h], hidden_mm)
        relative = distance / np.hypot(own, track.predicted_error_mm[rows])
        better = relative < best[rows]
        path[rows[better]] = h
        best[rows[better]] = relative[better]
        error[rows[better]] = own[better]


def _flips(observed: Observations, track: Track) -> list[Flip]:
    """The stretches in which the single frames had head and tail exchanged, and those in which the
    track may have.
    """
    tip = track.skeleton.tip
    exchanged = np.zeros(len(observed), np.bool_)
    for rows in blocks(len(observed), _BLOCK):
        ends = observed[rows].joints_as(0, [0, tip])
        along = track.joints_mm[rows, tip] - track.joints_mm[rows, 0]
        exchanged[rows] = np.einsum("nd,nd->n", along, ends[:, 1] - ends[:, 0]) < 0
    exchanged = exchanged[observed.shown]
    found = [Flip(a, b, float(1.0 - track.p_flip[a:b].mean()), True) for a, b in spans(exchanged)]
    unsure = ~exchanged & (track.p_flip > 0.05)  # a smaller doubt is not reported
    return found + [Flip(a, b, float(track.p_flip[a:b].mean()), False) for a, b in spans(unsure)]


# Fixed-lag smoothing of an ongoing recording.


class OnlineTracker:
    """Receives observations of frames as they arrive; returns a row for each, `lag` frames later.

    The hypothesis chosen for a frame does not change once its row is returned; estimates improve
    with a longer lag. With lag 0 a row is returned at once, from the past alone.

    Attributes:
        recent: the row returned last and up to 20 before it, smoothed together: rates within it are
            those of one curve.

    Args:
        subject: the animal.
        lag: frames by which a row is delayed.
    """

    def __init__(self, subject: Subject, lag: int = 0) -> None:
        tuning = TrackingParameters.of(subject.skeleton.name)
        self._subject = subject
        self._lag = lag
        self._motion = tuning.motion
        self._chain = HypothesisAssociation(subject.skeleton, subject.length_mm, tuning.chain)
        self._window = Observations.empty(subject.skeleton, np.zeros(0, np.int64))
        # joints of the window's hypotheses that the association uses
        self._joints = self._chain.joints(self._window)
        self._path: NDArray[np.int64] = np.zeros(0, np.int64)
        self._n_returned = 0  # of the window's frames
        self._monitor = OcclusionMonitor()
        self.recent = Track.empty(subject.skeleton, np.zeros(0, np.int64))

    def add(self, observed: Observations) -> Track | None:
        """Add frames; returns the rows that are due.

        Args:
            observed: hypotheses (n, H) of the next n frames, arena frame.

        Returns:
            The rows that are due, in order; None if none are.
        """
        rows = []
        for k in range(len(observed)):
            frame = observed[k : k + 1]
            gone = max(0, len(self._window) + 1 - 48)  # frames that decide on the hypothesis
            self._window = Observations.join([self._window, frame])[gone:]
            self._joints = np.concatenate([self._joints, self._chain.joints(frame)])[gone:]
            self._path = np.append(self._path[gone:], NONE)
            self._n_returned -= gone
            if len(self._path) - self._n_returned > self._lag:
                rows.append(self._next_rows(1))
        return Track.join(rows) if rows else None

    def close(self) -> Track | None:
        """The delayed rows, at the end of the recording; None if there are none."""
        left = len(self._path) - self._n_returned
        return self._next_rows(left) if left else None

    def _next_rows(self, n: int) -> Track:
        """The rows of the next n frames that have not been returned yet."""
        observed, joints, done = self._window, self._joints, self._n_returned
        emission = self._chain.emission(observed, joints)
        path = self._chain.path(observed, joints, emission, self._path[:done])
        self._path[done : done + n] = path[done : done + n]
        self._n_returned += n
        doubt = self._chain.doubt(observed, path, joints, emission)
        first = max(0, done - 20)  # earlier frames that are smoothed, too
        if (path[first:] == NONE).all():  # all observations of the animal are older
            first = 0
        observed, path, doubt = observed[first:], path[first:], doubt[first:]
        due = slice(done - first, done - first + n)
        subject = self._subject
        measured = observed.seconds, observed.pose(path), observed.along(observed.error_mm, path)
        curve = smooth(subject.skeleton, *measured, subject.length_mm, self._motion)
        usual_px = self._monitor.usual_px
        self.recent = to_track(subject, observed, path, curve, doubt, ahead=True, usual_px=usual_px)
        track = self.recent[due]
        hide(track, self._monitor.gone(observed[due], path[due], track.observed))
        return track
