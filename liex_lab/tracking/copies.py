"""Copies: frames whose depth image repeats, bit for bit, the image of the frame before.

Either a program asked faster than the camera made images: then each image is there twice or more,
and its copies lie within 1.5 of the camera's own steps. Or the stream froze, which is a gap,
although stamps went on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.recordings.timestamps import GAP_FACTOR, median_step
from liex_lab.tracking.gaps import spans, whole_gaps

Mask = NDArray[np.bool_]

_MUCH = 0.1  # of the frames; a stream that froze for longer is one to look at
_FEW = 5  # frames that may repeat in a recording without noise
_SOON = 0.9  # of a step: sooner than the camera could have made another image


def asked_too_often(times_ns: NDArray[np.int64], copies: Mask, known: Mask) -> Mask:
    """Which copies (n,) came of asking faster than the camera made images; in others it froze.

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
    """Sentences on images that repeat: why to look at the recording, and what else to know.

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
