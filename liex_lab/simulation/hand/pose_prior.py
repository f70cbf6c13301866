"""Pose prior of the human hand: Gaussian mixtures of joint angles and of palm orientations.

Each of eight kinds of posture has a mean, six principal axes and a residual deviation, as in
mixtures of probabilistic PCA; each of eight orientations is a Gaussian in the tangent space of
SO(3), R = R_k exp(delta). Training postures are also blends of two of these, and random postures
within the joints' limits. `pose_prior.toml` next to this module contains the statistics and their
sources; `distil` makes it, by k-means and a singular value decomposition.
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
_FREE_SHARE = 0.45  # share of random training postures, not based on observations
OBSERVED_SHARE = 1.0 - _FREE_SHARE  # share based on the labelled points of NYU test frames
_FAN_DEG = {
    "index": 10.0,
    "middle": 1.0,
    "ring": -8.0,
    "little": -19.0,
}  # angles of the fingers of a spread hand
_BLEND_SHARE = 0.3  # share of observed postures that are blends of two


@dataclass(frozen=True)
class HandPostures:
    """A mixture of K kinds of posture and M of orientation; D free angles in the skeleton's order.

    Attributes:
        share: (K,) weights.
        mean: (K, D) rad.
        axes: (K, A, D) principal deviations, one standard deviation long, rad.
        rest: (K, D) residual standard deviation, rad.
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
        """The bundled statistics, cached."""
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
        """Observed postures, within the joints' limits.

        Returns:
            (n, J, 3) rad.
        """
        k = rng.choice(len(self.share), n, p=self.share / self.share.sum())
        along = np.einsum("na,nad->nd", rng.standard_normal((n, self.axes.shape[1])), self.axes[k])
        values = self.mean[k] + along + rng.standard_normal((n, self.mean.shape[1])) * self.rest[k]
        return _within_limits(skeleton, values)

    def draw_turns(self, rng: np.random.Generator, n: int) -> Array:
        """Observed orientations of the palm towards the viewer.

        Returns:
            (n, 3, 3) T_view_palm.
        """
        k = rng.choice(len(self.turn_share), n, p=self.turn_share / self.turn_share.sum())
        return self.turn[k] @ so3.exp(
            np.einsum("na,nad->nd", rng.standard_normal((n, 3)), self.turn_axes[k])
        )


def draw_observed(rng: np.random.Generator, skeleton: Skeleton, n: int) -> tuple[Array, Array]:
    """Draw hands from the observed postures and orientations.

    Returns:
        Angles (n, J, 3) rad and T_view_palm (n, 3, 3).
    """
    postures = HandPostures.load()
    return postures.draw_angles(rng, skeleton, n), postures.draw_turns(rng, n)


def draw_wide(rng: np.random.Generator, skeleton: Skeleton, n: int) -> tuple[Array, Array]:
    """Draw hands from the observed postures, blends of two of them, or random postures.

    Angles and orientations are each random in 45 % of the draws; 30 % of the other postures are
    blends of two observed ones.

    Returns:
        Angles (n, J, 3) rad and T_view_palm (n, 3, 3).
    """
    postures = HandPostures.load()
    visible = postures.draw_angles(rng, skeleton, n)
    other = postures.draw_angles(rng, skeleton, n)
    t = np.where(rng.random(n) < _BLEND_SHARE, rng.random(n), 0.0)[:, None, None]
    angles = (1.0 - t) * visible + t * other
    turns = postures.draw_turns(rng, n)
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
    """Random orientations with the palm or the back towards the viewer, with tilt and spin.

    The palm faces the viewer in 70 % of the draws; the tilt's standard deviation is 35 degrees per
    axis.

    Returns:
        (n, 3, 3) T_view_palm.
    """
    spin = np.zeros((n, 3))
    spin[:, 2] = rng.uniform(-np.pi, np.pi, n)
    tilt = np.zeros((n, 3))
    tilt[:, :2] = np.radians(rng.normal(0.0, 35.0, (n, 2)))
    # the palm's z axis points out of the back of the hand: a rotation by pi about the long axis
    # turns the palm towards the viewer
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
    """(J, 3) mask of the free angles of a posture."""
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


# peak speeds of a move: rotation of the palm and of the fastest finger joint, rad/s, and
# translation of the palm, mm/s
_TURN = (2.0, 6.0)
_BEND = (5.0, 12.0)
_GO = (200.0, 700.0)
_SHORTEST_S = 0.25
_REST_S = (0.0, 0.6)
_WRIST_RAD = np.radians([0.0, 22.0, 12.0])  # standard deviations of the wrist's rotation
# positions of gestures relative to their common centre
_NEARER = (0.93, 1.07)
_ASIDE_MM = 15.0


class Gestures(NamedTuple):
    """A hand at n moments.

    Attributes:
        angles: (n, J, 3) joint angles, rad.
        turns: (n, 3, 3) T_view_palm.
        places: (n, 3) of the palm, mm, camera frame.
        wrists: (n, 3) wrist rotation, rad.
    """

    angles: Array
    turns: Array
    places: Array
    wrists: Array


def draw_gestures(
    rng: np.random.Generator, skeleton: Skeleton, n: int, step_s: float, middle: Array
) -> Gestures:
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
        The hand at n moments.
    """
    keys = 2 + int(n * step_s / _SHORTEST_S)
    angles, turns = draw_observed(rng, skeleton, keys)
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
