"""Pose prior of the human hand: Gaussian mixtures of joint angles and of palm orientations.

Each of eight kinds of posture has a mean, six principal axes and a residual deviation, as in
mixtures of probabilistic PCA; each of eight orientations is a Gaussian in the tangent space of
SO(3), R = R_k exp(delta). Training postures are also blends of two of these, and random postures
within the joints' limits. `pose_prior.toml` next to this module contains the statistics and their
sources.
"""

from __future__ import annotations

import os
import tomllib
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.geometry import so3
from liex_lab.recordings.formats.images.nyu import N_FIRST_PERSON, REFERENCE_FILE

Array = NDArray[np.float64]

STATISTICS = Path(__file__).with_name("pose_prior.toml")
_FREE_SHARE = 0.45  # share of random training postures, not based on observations
OBSERVED_SHARE = 1.0 - _FREE_SHARE  # share based on the labelled points of NYU test frames


@cache
def _mixture(name: str, *columns: str) -> tuple[Array, ...]:
    """Weights (K,) of the kinds of a bundled mixture, and columns (K, ...) of degrees as rad."""
    kinds = tomllib.loads(STATISTICS.read_text(encoding="utf-8"))[name]
    share = np.array([kind["share"] for kind in kinds])
    return share / share.sum(), *(np.radians([kind[c] for kind in kinds]) for c in columns)


def _observed_angles(rng: np.random.Generator, skeleton: Skeleton, n: int) -> Array:
    """Observed postures (n, J, 3) rad, within the joints' limits."""
    share, mean, axes, rest = _mixture("postures", "mean_deg", "axes_deg", "rest_deg")
    k = rng.choice(len(share), n, p=share)
    along = np.einsum("na,nad->nd", rng.standard_normal((n, axes.shape[1])), axes[k])
    angles = np.zeros((n, skeleton.n_joints, 3))
    angles[:, 1:][:, skeleton.axes[1:]] = (
        mean[k] + along + rng.standard_normal((n, mean.shape[1])) * rest[k]
    )
    return _clipped(skeleton, angles)


def _observed_turns(rng: np.random.Generator, n: int) -> Array:
    """Observed orientations T_view_palm (n, 3, 3), the view's z axis pointing at the viewer."""
    share, turn, axes = _mixture("turns", "turn_deg", "axes_deg")
    k = rng.choice(len(share), n, p=share)
    return so3.exp(turn)[k] @ so3.exp(np.einsum("na,nad->nd", rng.standard_normal((n, 3)), axes[k]))


def draw_observed(rng: np.random.Generator, skeleton: Skeleton, n: int) -> tuple[Array, Array]:
    """Draw hands from the observed postures and orientations.

    Returns:
        Angles (n, J, 3) rad and T_view_palm (n, 3, 3).
    """
    return _observed_angles(rng, skeleton, n), _observed_turns(rng, n)


def draw_wide(rng: np.random.Generator, skeleton: Skeleton, n: int) -> tuple[Array, Array]:
    """Draw hands from the observed postures, blends of two of them, or random postures.

    Angles and orientations are each random in 45 % of the draws; 30 % of the other postures are
    blends of two observed ones.

    Returns:
        Angles (n, J, 3) rad and T_view_palm (n, 3, 3).
    """
    one, other = (_observed_angles(rng, skeleton, n) for _ in range(2))
    t = np.where(rng.random(n) < 0.3, rng.random(n), 0.0)[:, None, None]
    angles = (1.0 - t) * one + t * other
    turns = _observed_turns(rng, n)
    free = rng.random(n) < _FREE_SHARE
    angles[free] = free_angles(rng, skeleton, int(free.sum()))
    free = rng.random(n) < _FREE_SHARE
    turns[free] = free_turns(rng, int(free.sum()))
    return angles, turns


def free_angles(rng: np.random.Generator, skeleton: Skeleton, n: int) -> Array:
    """Random postures: every finger is bent independently, or all in the same way.

    Returns:
        (n, J, 3) rad, within the joints' limits.
    """
    angles = np.zeros((n, skeleton.n_joints, 3))
    alike = rng.random((n, 1)) < 0.35
    together = rng.random((n, 1))
    each = np.clip(rng.beta(0.5, 0.5, (n, 4)), 0.0, 1.0)
    bent = np.clip(np.where(alike, together, each) + rng.normal(0.0, 0.05, (n, 4)), 0.0, 1.0)
    spread = rng.uniform(-0.6, 1.6, n)  # fingers together or spread
    # angles of the fingers of a spread hand
    fans = {"index": 10.0, "middle": 1.0, "ring": -8.0, "little": -19.0}
    for f, (finger, fan) in enumerate(fans.items()):
        root, middle, end = (
            skeleton.names.index(f"{finger}_{part}") for part in ("root", "middle", "end")
        )
        curl = bent[:, f]
        angles[:, root, 1] = np.radians(
            -8.0 + 80.0 * curl * rng.uniform(0.2, 1.1, n) + rng.normal(0.0, 8.0, n)
        )
        angles[:, root, 2] = np.radians(fan * spread + rng.normal(0.0, 7.0, n)) * (1.0 - 0.7 * curl)
        angles[:, middle, 1] = np.radians(100.0 * curl + rng.normal(0.0, 8.0, n))
        angles[:, end, 1] = angles[:, middle, 1] * rng.uniform(0.4, 0.8, n) + np.radians(
            rng.normal(0.0, 6.0, n)
        )
    root, middle, end = (
        skeleton.names.index(f"thumb_{part}") for part in ("root", "middle", "end")
    )
    for joint, axis, low, high in (
        (root, 1, -28, 50),
        (root, 2, -25, 25),
        (middle, 1, -5, 65),
        (end, 1, -15, 75),
    ):
        angles[:, joint, axis] = np.radians(rng.uniform(low, high, n))
    return _clipped(skeleton, angles)


def free_turns(rng: np.random.Generator, n: int) -> Array:
    """Random orientations with the palm or the back towards the viewer, with tilt and spin.

    The palm faces the viewer in 70 % of the draws; the tilt's standard deviation is 35 degrees per
    axis.

    Returns:
        (n, 3, 3) T_view_palm.
    """
    spin, tilt, over = np.zeros((3, n, 3))
    spin[:, 2] = rng.uniform(-np.pi, np.pi, n)
    tilt[:, :2] = np.radians(rng.normal(0.0, 35.0, (n, 2)))
    # the palm's z axis points out of the back of the hand: a rotation by pi about the long axis
    # turns the palm towards the viewer
    over[:, 0] = np.where(rng.random(n) < 0.7, np.pi, 0.0)
    return so3.exp(spin) @ so3.exp(tilt) @ so3.exp(over)


def _clipped(skeleton: Skeleton, angles: Array) -> Array:
    return np.clip(angles, skeleton.limits[..., 0], skeleton.limits[..., 1])


# Location of the labelled hands to which test postures are fitted.


VARIABLE = "LIEX_NYU"
FITTED = f"fitted to the labels of the NYU test frames from {N_FIRST_PERSON + 1} on"
DRAWN = "drawn from statistics of one person's hand"
_REPOSITORY = Path(__file__).resolve().parents[3]


def find_reference() -> Path | None:
    """Find the folder of labelled hands: `LIEX_NYU`, else the one next to the repository.

    Returns:
        `LIEX_NYU`, or `../shared/data/hand_nyu` of the repository that contains this file; None if
        the variable is not set and that folder has no labels.

    Raises:
        LiexError: `LIEX_NYU` names a folder without labels.
    """
    if stated := os.environ.get(VARIABLE):
        folder = Path(stated)
        if not (folder / REFERENCE_FILE).is_file():
            raise LiexError(
                f"{VARIABLE} should name a folder with {REFERENCE_FILE}, labels of NYU hands, but "
                f"{folder} holds none; name another one, or unset it"
            )
        return folder
    folder = _REPOSITORY.parent / "shared" / "data" / "hand_nyu"
    return folder if (folder / REFERENCE_FILE).is_file() else None


# Trajectories of hand gestures: geodesics in SO(3), straight lines in angles, cosine timing.


_SHORTEST_S = 0.25  # of a move


def draw_gestures(
    rng: np.random.Generator, skeleton: Skeleton, n: int, step_s: float, middle: Array
) -> tuple[Array, Array, Array, Array]:
    """A sequence of observed postures near one point, joined by smooth moves.

    The duration of a move is that of its slowest part (rotation, bending or translation) at a
    random speed, at least 0.25 s.

    Args:
        rng: random number generator.
        skeleton: of the hand.
        n: number of moments.
        step_s: between two moments, s.
        middle: (3,) centre of the gestures, mm, camera frame.

    Returns:
        At n moments: joint angles (n, J, 3) rad, T_view_palm (n, 3, 3), places (n, 3) of the palm,
        mm, camera frame, and rotations (n, 3) of the wrist, rad.
    """
    keys = 2 + int(n * step_s / _SHORTEST_S)
    angles, turns = draw_observed(rng, skeleton, keys)
    places = middle * rng.uniform(0.93, 1.07, (keys, 1)) + rng.normal(0.0, 15.0, (keys, 3))
    wrists = rng.normal(0.0, 1.0, (keys, 3)) * np.radians([0.0, 22.0, 12.0])
    turning = so3.log(np.swapaxes(turns[:-1], 1, 2) @ turns[1:])
    bending, going, leaning = (np.diff(values, axis=0) for values in (angles, places, wrists))
    # peak speeds of a move: rotation of the palm and of the fastest finger joint, rad/s, and
    # translation of the palm, mm/s
    speeds = (
        (np.linalg.norm(turning, axis=-1), 2.0, 6.0),
        (np.abs(bending).max(axis=(1, 2)), 5.0, 12.0),
        (np.linalg.norm(going, axis=-1), 200.0, 700.0),
    )
    longest = np.max([way / rng.uniform(low, high, keys - 1) for way, low, high in speeds], axis=0)
    moves = np.maximum(
        0.5 * np.pi * longest, _SHORTEST_S
    )  # the fastest moment of a cosine is pi/2 times the mean
    starts = np.concatenate([[0.0], np.cumsum(moves + rng.uniform(0.0, 0.6, keys - 1))])
    now = step_s * np.arange(n)
    at = np.clip(np.searchsorted(starts, now, side="right") - 1, 0, keys - 2)
    share = 0.5 - 0.5 * np.cos(np.pi * np.clip((now - starts[at]) / moves[at], 0.0, 1.0))[:, None]
    return (
        angles[at] + share[..., None] * bending[at],
        turns[at] @ so3.exp(share * turning[at]),
        places[at] + share * going[at],
        wrists[at] + share * leaning[at],
    )
