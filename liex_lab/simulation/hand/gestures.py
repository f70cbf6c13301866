"""Trajectories of hand gestures: geodesics in SO(3), straight lines in angles, cosine timing.

Between two postures at t = 0 and 1 the palm turns as R(s) = R_0 exp(s log(R_0^T R_1)) and angles
and position change in proportion to s = (1 - cos(pi t)) / 2, so that a move starts and ends at
rest. It lasts as long as people take at the drawn peak speeds, with a rest after each.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import so3
from liex_lab.simulation.hand.pose_prior import draw_seen

Array = NDArray[np.float64]

# at the fastest moment of a move: the palm's turning and the quickest finger joint's, rad/s, and
# the palm's way, mm/s
_TURN = (2.0, 6.0)
_BEND = (5.0, 12.0)
_GO = (200.0, 700.0)
_SHORTEST_S = 0.25
_REST_S = (0.0, 0.6)
_WRIST_RAD = np.radians([0.0, 22.0, 12.0])  # how a wrist is bent
# where gestures are made, beside the middle of them all
_NEARER = (0.93, 1.07)
_ASIDE_MM = 15.0


class Gestures(NamedTuple):
    """A hand at n moments.

    Attributes:
        angles: (n, J, 3) joint angles, rad.
        turns: (n, 3, 3) T_view_palm.
        places: (n, 3) of the palm, mm, camera frame.
        wrists: (n, 3) how the wrist is bent, rad.
    """

    angles: Array
    turns: Array
    places: Array
    wrists: Array


def draw_gestures(
    rng: np.random.Generator, skeleton: Skeleton, n: int, step_s: float, middle: Array
) -> Gestures:
    """Moments of somebody who goes through postures that were seen, about one point.

    Each move lasts as long as its longest part, turning, bending or going, takes at a speed drawn
    for it, but 0.25 s at least.

    Args:
        rng: source of randomness.
        skeleton: of the hand.
        n: number of moments.
        step_s: between two moments, s.
        middle: (3,) point about which gestures are made, mm, camera frame.

    Returns:
        The hand at n moments.
    """
    keys = 2 + int(n * step_s / _SHORTEST_S)
    angles, turns = draw_seen(rng, skeleton, keys)
    places = middle * rng.uniform(*_NEARER, (keys, 1)) + rng.normal(0.0, _ASIDE_MM, (keys, 3))
    wrists = rng.normal(0.0, 1.0, (keys, 3)) * _WRIST_RAD
    turning = so3.log(np.swapaxes(turns[:-1], 1, 2) @ turns[1:])
    bending, going, leaning = (np.diff(values, axis=0) for values in (angles, places, wrists))
    longest = np.stack(
        [
            np.linalg.norm(turning, axis=-1) / rng.uniform(*_TURN, keys - 1),
            np.abs(bending).max(axis=(1, 2)) / rng.uniform(*_BEND, keys - 1),
            np.linalg.norm(going, axis=-1) / rng.uniform(*_GO, keys - 1),
        ]
    ).max(axis=0)
    moves = np.maximum(
        0.5 * np.pi * longest, _SHORTEST_S
    )  # the fastest moment of a cosine is pi/2 times the mean
    starts = np.concatenate([[0.0], np.cumsum(moves + rng.uniform(*_REST_S, keys - 1))])
    now = step_s * np.arange(n)
    at = np.clip(np.searchsorted(starts, now, side="right") - 1, 0, keys - 2)
    share = 0.5 - 0.5 * np.cos(np.pi * np.clip((now - starts[at]) / moves[at], 0.0, 1.0))[:, None]
    return Gestures(
        angles[at] + share[..., None] * bending[at],
        turns[at] @ so3.exp(share * turning[at]),
        places[at] + share * going[at],
        wrists[at] + share * leaning[at],
    )
