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
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.recordings.timestamps import GAP_FACTOR, median_step
from liex_lab.runtime.memory import Allocator, blocks
from liex_lab.tracking.association import NONE, HypothesisAssociation, cost_of_the_other
from liex_lab.tracking.motion_model import TrackingParameters
from liex_lab.tracking.observations import Observations, joints_of, reversed_pose
from liex_lab.tracking.smoother import smooth
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
from liex_lab.tracking.track_rows import (
    add_sight_of_copies,
    doubted,
    hide,
    mask_and_flag,
    write_curve,
)
from liex_lab.tracking.trust import (
    elsewhere,
    gone_behind,
    lies_unknown,
    share_in_view,
    usual_pixels,
)

Mask = NDArray[np.bool_]

_MUCH = 0.1  # share of frames; a longer freeze needs review
_FEW = 5  # frames that may repeat in a recording without noise
_SOON = 0.9  # of a step: too short for a new image


def asked_too_often(times_ns: NDArray[np.int64], copies: Mask, known: Mask) -> Mask:
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
    if len(last) and seconds[-1] - seconds[last[0]] < _SOON * step_s:
        between[last[0] + 1 :] = True
    return copies & between


def copies_told(
    times_ns: NDArray[np.int64], repeats: Mask, noisy: bool
) -> tuple[list[str], list[str]]:
    """Messages about repeated images: reasons to review the recording, and notes.

    Args:
        times_ns: (n,) time stamps, ns.
        repeats: (n,) whether the depth image is, bit for bit, the one before.
        noisy: whether the sensor has noise, so that these are copies.
    """
    often = asked_too_often(times_ns, repeats, ~repeats) & noisy
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
    if (n := int(still.sum())) >= (1 if noisy else _FEW):
        stops = np.append(times_ns[1:], times_ns[-1] + median_step(times_ns))
        lasted = [(1e-9 * (stops[b - 1] - times_ns[a]), a) for a, b in spans(still)]
        longest_s, at = max(lasted)
        told = (
            f"the depth image of the frame before repeats in {n:,} of {len(still):,} frames, "
            f"{sum(one for one, _ in lasted):.2f} s in all, the longest time for {longest_s:.2f} s "
            f"from {1e-9 * (times_ns[at] - times_ns[0]):.2f} s on"
        )
        if not noisy:
            cautions.append(
                f"{told}; the background has no noise, so a stream that froze looks like an animal "
                "that keeps still: watch that part of the replay"
            )
        else:
            (reasons if n > _MUCH * len(still) else cautions).append(
                f"the stream froze: {told}; nothing is measured there"
            )
    return reasons, cautions


Array = NDArray[np.float64]

# frames smoothed at once, and context frames on either side
_BLOCK = 4096
MARGIN = 160
# a skipped hypothesis within this many predicted errors (its own and the curve's) of the curve is
# accepted after all, unless its area is below this share or above this multiple of the animal's
# usual area; the pose of a partly hidden animal errs by this share of the hidden length. Repeated,
# as each pass moves the curve nearer to others.
_ADMIT = 1.0
_LEAST = 0.5
_MOST = 1.5
_UNSEEN = 0.4
_TIMES = 2
_TOLD = 0.05  # a smaller doubt about head and tail is not reported


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
        subject: the animal of the track.
        seen: hypotheses (n, H) of all frames, arena frame.
        corrections: spans that a person marked as having head and tail exchanged; those with
            `undone_at` are not applied.
        tuning: motion and association parameters; None uses the animal's own.
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
    cuts = _half_turns(subject.skeleton, seen, path, turned, corrections)
    track = Track.empty(subject.skeleton, seen.times_ns, allocate=allocate)
    used = np.zeros(len(seen), np.bool_)
    seconds = seen.seconds

    def draw(rows: slice) -> None:
        """Smooth the frames `rows` with a margin on either side, and write them into the track.

        Args:
            rows: consecutive frames, one block.
        """
        for start, stop in pairwise([0, *cuts, len(seen)]):
            part = slice(max(rows.start, start), min(rows.stop, stop))
            if part.start >= part.stop:
                continue
            first = max(start, part.start - MARGIN)
            around = slice(first, min(stop, part.stop + MARGIN))
            pose = seen[around].pose(path[around])
            _reverse(subject.skeleton, pose, turned[around])
            curve = smooth(
                subject.skeleton,
                seconds[around],
                pose,
                error[around],
                subject.length_mm,
                tuning.motion,
            )
            curve = curve[part.start - first : part.stop - first]
            write_curve(subject, track[part], curve, tuning)
            used[part] = curve.used

    usual_px = usual_pixels(seen, path)
    in_view = share_in_view(seen, path, usual_px)
    # a pose fitted to the visible part is off by about the hidden length
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
    bridged = short_gaps(seconds, measured, subject.bridge_s) & ~seen.copies
    copies = asked_too_often(seen.times_ns, seen.copies, measured)
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
    bridged &= ~strayed & ~hidden  # visible animals are measured, or have no pose
    # the behaviour of an animal that stays half hidden is unknown
    bridged &= ~unknown | whole_gaps(seconds, measured, subject.bridge_s)
    hidden |= unknown & ~bridged
    strayed |= doubted(subject, seen, path, in_view, usual_px)
    for rows in blocks(len(seen), _BLOCK):
        mask_and_flag(
            subject,
            track[rows],
            seen[rows],
            path[rows],
            doubt[rows],
            (measured | copies)[rows],
            bridged[rows],
            strayed[rows],
        )
        hide(track[rows], hidden[rows])
    add_sight_of_copies(track, seen, copies)
    flips = _flips(seen, track)
    return Tracked(
        track,
        tuple(sorted([*flips, *corrections], key=lambda flip: (flip.start, flip.source))),
        tuple(cuts),
    )


def _turn_round(
    seen: Observations, path: NDArray[np.int64], doubt: Array, corrections: Sequence[Flip]
) -> NDArray[np.int64]:
    """Exchange head and tail in the spans that a person corrected; their flip posterior is 0.

    The path uses the reversed hypothesis if the frame has one. Returns how many times (n,) the pose
    itself must be reversed elsewhere.
    """
    turned = np.zeros(len(seen), np.int64)
    for span in (one for one in corrections if not one.undone_at):
        rows = span.start + np.flatnonzero(path[span.start : span.stop] != NONE)
        has_other = seen.known[rows, path[rows] ^ 1]
        path[rows[has_other]] ^= 1
        turned[rows[~has_other]] += 1
        doubt[span.start : span.stop] = 0.0
    return turned


def _half_turns(
    skeleton: Skeleton,
    seen: Observations,
    path: NDArray[np.int64],
    turned: NDArray[np.int64],
    corrections: Sequence[Flip],
) -> list[int]:
    """The ends of a person's exchanges at which the body turns by more than 90 degrees.

    Compared are the last measured frame before an end and the first one after it.
    """

    def ahead(row: int) -> Array:
        """From base to tip (3,) of the pose in a `row`, mm."""
        base, tip = seen[row : row + 1].joints_as(int(path[row]), [0, skeleton.tip])[0]
        return (tip - base) * (-1.0) ** turned[row]

    ends = ends_of((flip.start, flip.stop) for flip in corrections if not flip.undone_at)
    rows = np.flatnonzero(path != NONE)
    after = np.searchsorted(rows, ends)
    return [
        end
        for end, k in zip(ends, after, strict=True)
        if 0 < k < len(rows) and ahead(rows[k - 1]) @ ahead(rows[k]) < 0.0
    ]


def _reverse(skeleton: Skeleton, pose: Pose, turned: NDArray[np.int64]) -> None:
    """Reverse poses (n) a given number of times (n,) each, in place."""
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
    """Gate: add hypotheses on the curve to the path in skipped frames.

    Fills path (n,) and error (n,). Such a hypothesis is within one predicted error, its own and the
    curve's combined, and has 0.5 to 1.5 times the usual pixels: the pose of half an animal is
    unknown, as is the curve in a gap.
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
    exchanged = exchanged[seen.shown]
    found = [Flip(a, b, float(1.0 - track.p_flip[a:b].mean()), True) for a, b in spans(exchanged)]
    unsure = ~exchanged & (track.p_flip > _TOLD)
    return found + [Flip(a, b, float(track.p_flip[a:b].mean()), False) for a, b in spans(unsure)]
