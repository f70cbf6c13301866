"""Pose prior of the human hand: Gaussian mixtures of joint angles and of palm orientations.

Each of eight kinds of posture has a mean, six principal axes and a residual deviation, as in
mixtures of probabilistic PCA; each of eight orientations is a Gaussian in the tangent space of
SO(3), R = R_k exp(delta). Training postures are also drawn between two of these, and freely within
what a hand can do. `pose_prior.toml` beside this module holds the statistics and says where they
come from; `distil` makes them, by k-means and a singular value decomposition.
"""

from __future__ import annotations

import os
import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.geometry import so3
from liex_lab.recordings.formats.images.nyu import N_FIRST_PERSON, REFERENCE_FILE

Array = NDArray[np.float64]

STATISTICS = Path(__file__).with_name("pose_prior.toml")
_N_POSTURES = 8
_N_TURNS = 8
_N_AXES = 6
_FREE_SHARE = 0.45  # of the training postures are what a hand can do, not what was seen
SEEN_SHARE = 1.0 - _FREE_SHARE  # come from the labelled points of NYU test frames
_FAN_DEG = {
    "index": 10.0,
    "middle": 1.0,
    "ring": -8.0,
    "little": -19.0,
}  # how fingers part when a hand is spread
_BLEND_SHARE = 0.3  # of the seen ones lie between two


@dataclass(frozen=True)
class HandPostures:
    """A mixture of K kinds of posture and M of orientation; D free angles in the skeleton's order.

    Attributes:
        share: (K,) weights.
        mean: (K, D) rad.
        axes: (K, A, D) principal deviations, one standard deviation long, rad.
        rest: (K, D) standard deviation of what they leave, rad.
        turn_share: (M,) weights.
        turn: (M, 3, 3) T_view_palm, the view's z axis pointing at the viewer.
        turn_axes: (M, 3, 3) deviations from it, one standard deviation long, in the palm's frame,
            as rows, rad.
    """

    share: Array
    mean: Array
    axes: Array
    rest: Array
    turn_share: Array
    turn: Array
    turn_axes: Array

    @staticmethod
    @cache
    def load() -> HandPostures:
        """The statistics that come with the package, read once."""
        table = tomllib.loads(STATISTICS.read_text(encoding="utf-8"))
        postures = table["postures"]
        turns = table["turns"]
        return HandPostures(
            np.array([p["share"] for p in postures]),
            np.radians([p["mean_deg"] for p in postures]),
            np.radians([p["axes_deg"] for p in postures]),
            np.radians([p["rest_deg"] for p in postures]),
            np.array([t["share"] for t in turns]),
            so3.exp(np.radians([t["turn_deg"] for t in turns])),
            np.radians([t["axes_deg"] for t in turns]),
        )

    def draw_angles(self, rng: np.random.Generator, skeleton: Skeleton, n: int) -> Array:
        """Postures as they were seen, within the joints' limits.

        Args:
            rng: source of randomness.
            skeleton: of the hand.
            n: how many.

        Returns:
            (n, J, 3) rad.
        """
        k = rng.choice(len(self.share), n, p=self.share / self.share.sum())
        along = np.einsum("na,nad->nd", rng.standard_normal((n, self.axes.shape[1])), self.axes[k])
        values = self.mean[k] + along + rng.standard_normal((n, self.mean.shape[1])) * self.rest[k]
        return _within_limits(skeleton, values)

    def draw_turns(self, rng: np.random.Generator, n: int) -> Array:
        """Orientations of the palm towards the viewer, as they were seen.

        Args:
            rng: source of randomness.
            n: how many.

        Returns:
            (n, 3, 3) T_view_palm.
        """
        k = rng.choice(len(self.turn_share), n, p=self.turn_share / self.turn_share.sum())
        return self.turn[k] @ so3.exp(
            np.einsum("na,nad->nd", rng.standard_normal((n, 3)), self.turn_axes[k])
        )


def draw_seen(rng: np.random.Generator, skeleton: Skeleton, n: int) -> tuple[Array, Array]:
    """Hands as they were seen.

    Args:
        rng: source of randomness.
        skeleton: of the hand.
        n: how many.

    Returns:
        Angles (n, J, 3) rad and T_view_palm (n, 3, 3).
    """
    postures = HandPostures.load()
    return postures.draw_angles(rng, skeleton, n), postures.draw_turns(rng, n)


def draw_wide(rng: np.random.Generator, skeleton: Skeleton, n: int) -> tuple[Array, Array]:
    """Hands as they were seen, between two of these, or quite free.

    Angles and orientations are each free in 45 % of the draws; of the others' angles 30 % lie
    between two postures.

    Args:
        rng: source of randomness.
        skeleton: of the hand.
        n: how many.

    Returns:
        Angles (n, J, 3) rad and T_view_palm (n, 3, 3).
    """
    postures = HandPostures.load()
    seen = postures.draw_angles(rng, skeleton, n)
    other = postures.draw_angles(rng, skeleton, n)
    t = np.where(rng.random(n) < _BLEND_SHARE, rng.random(n), 0.0)[:, None, None]
    angles = (1.0 - t) * seen + t * other
    turns = postures.draw_turns(rng, n)
    free = rng.random(n) < _FREE_SHARE
    angles[free] = free_angles(rng, skeleton, int(free.sum()))
    free = rng.random(n) < _FREE_SHARE
    turns[free] = free_turns(rng, int(free.sum()))
    return angles, turns


def free_angles(rng: np.random.Generator, skeleton: Skeleton, n: int) -> Array:
    """Postures in which every finger is bent, stretched or in between on its own, or all alike.

    Args:
        rng: source of randomness.
        skeleton: of the hand.
        n: how many.

    Returns:
        (n, J, 3) rad, within the joints' limits.
    """
    angles = np.zeros((n, skeleton.n_joints, 3))
    alike = rng.random((n, 1)) < 0.35
    together = rng.random((n, 1))
    each = np.clip(rng.beta(0.5, 0.5, (n, 4)), 0.0, 1.0)
    bent = np.clip(np.where(alike, together, each) + rng.normal(0.0, 0.05, (n, 4)), 0.0, 1.0)
    spread = rng.uniform(-0.6, 1.6, n)  # fingers closed up, or fanned out
    for f, (finger, fan) in enumerate(_FAN_DEG.items()):
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
    """Orientations with palm or back towards the viewer, tilted any way, turned by any angle.

    The palm faces the viewer in 70 % of the draws; the tilt's standard deviation is 35 degrees an
    axis.

    Args:
        rng: source of randomness.
        n: how many.

    Returns:
        (n, 3, 3) T_view_palm.
    """
    spin = np.zeros((n, 3))
    spin[:, 2] = rng.uniform(-np.pi, np.pi, n)
    tilt = np.zeros((n, 3))
    tilt[:, :2] = np.radians(rng.normal(0.0, 35.0, (n, 2)))
    # the palm's z axis leaves through the back of the hand: turned about its long axis it points
    # away from the viewer
    over = np.zeros((n, 3))
    over[:, 0] = np.where(rng.random(n) < 0.7, np.pi, 0.0)
    return so3.exp(spin) @ so3.exp(tilt) @ so3.exp(over)


def _within_limits(skeleton: Skeleton, values: Array) -> Array:
    """Free angles (n, D) as rotation vectors (n, J, 3) within the joints' limits."""
    angles = np.zeros((len(values), skeleton.n_joints, 3))
    angles[:, _free(skeleton)] = values
    return _clipped(skeleton, angles)


def _clipped(skeleton: Skeleton, angles: Array) -> Array:
    return np.clip(angles, skeleton.limits[..., 0], skeleton.limits[..., 1])


def _free(skeleton: Skeleton) -> NDArray[np.bool_]:
    """(J, 3) the angles that a posture consists of."""
    free = skeleton.axes.copy()
    free[0] = False
    return free


def distil(skeleton: Skeleton, angles: Array, turns: Array) -> str:
    """The content of `pose_prior.toml` for observed hands.

    Args:
        skeleton: of the hand.
        angles: (n, J, 3) observed joint angles, rad.
        turns: (n, 3, 3) observed T_view_palm.

    Returns:
        TOML text, angles in degrees.
    """
    from sklearn.cluster import KMeans

    values = angles[:, _free(skeleton)]
    lines = []
    kind = KMeans(_N_POSTURES, n_init=10, random_state=0).fit_predict(values)
    for k in range(_N_POSTURES):
        rows = values[kind == k]
        mean = rows.mean(axis=0)
        _, sd, axes = np.linalg.svd(rows - mean, full_matrices=False)
        axes = axes[:_N_AXES] * (sd[:_N_AXES, None] / np.sqrt(len(rows)))
        rest = np.sqrt(np.maximum((rows - mean).var(axis=0) - (axes**2).sum(axis=0), 0.0))
        lines += [
            "[[postures]]",
            f"share = {len(rows) / len(values):.4f}",
            f"mean_deg = {_degrees(mean)}",
            f"axes_deg = {_degrees(axes)}",
            f"rest_deg = {_degrees(rest)}",
            "",
        ]
    kind = KMeans(_N_TURNS, n_init=10, random_state=0).fit_predict(turns.reshape(-1, 9))
    for k in range(_N_TURNS):
        group = turns[kind == k]
        mean = so3.mean(group)
        deviation = so3.log(mean.T @ group)
        _, sd, axes = np.linalg.svd(deviation, full_matrices=False)
        lines += [
            "[[turns]]",
            f"share = {len(group) / len(turns):.4f}",
            f"turn_deg = {_degrees(so3.log(mean))}",
            f"axes_deg = {_degrees(axes * (sd[:, None] / np.sqrt(len(group))))}",
            "",
        ]
    return "\n".join(lines)


def _degrees(values: Array) -> list[float]:
    return np.degrees(values).round(1).tolist()


# Where the labelled hands lie that test postures are fitted to.


VARIABLE = "LIEX_NYU"
FITTED = f"fitted to the labels of the NYU test frames from {N_FIRST_PERSON + 1} on"
DRAWN = "drawn from statistics of one person's hand"
_REPOSITORY = Path(__file__).resolve().parents[3]


def find_reference() -> Path | None:
    """The folder of labelled hands: what `LIEX_NYU` names, else that beside the repository.

    Returns:
        `LIEX_NYU`, or `../shared/data/hand_nyu` of the repository that this file is in; None where
        the variable is not set and no labels lie there.

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
