"""How an animal holds itself and moves, from five points along its back: real beside virtual.

The points go from the base of the tail to the nose (`POINTS`), the three between them along the
back. With a, b, c the directions from the first to the middle of the second and third, from there
to the fourth, and from the first to the fourth, and h from the fourth to the fifth,

    trunk_bend  angle from a to b on the floor        trunk_arch  elevation of a minus that of b
    pitch       elevation of c                        head_turn   angle from c to h on the floor
    head_pitch  elevation of h minus that of c        stretch     tail to nose over its median

`MOTION_PROTOCOL` states every figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

POINTS = ("tail base", "hind back", "fore back", "neck", "nose")
POSTURE = ("trunk_bend", "trunk_arch", "pitch", "head_turn", "head_pitch", "stretch")
QUANTILES = (0.05, 0.5, 0.95)
MOTION_PROTOCOL = (
    "Five points from the tail's base to the nose, of a real animal and of a virtual one at the "
    "same shares of its length (the inner three `above` the mid-axis, a share of the body's half "
    "height by which the median of trunk_arch is the real animal's). trunk_bend and head_turn: "
    "angles on the floor without their sign, degrees, and about_lean what is beside their median, "
    "lean_degrees, which is nought of an animal that is recorded for long enough and whose points "
    "lie in its middle; trunk_arch, pitch, head_pitch: elevations, degrees; stretch: tail to nose "
    "over its median. Of these outside: share of the real frames beyond what lies between the "
    "0.5 % and 99.5 % quantiles of the virtual ones. Rates of change, where the frame rate is "
    "stated: speed in lengths/s of the point between tail and neck, turning of the trunk and "
    "changes of trunk_bend, head_turn and head_pitch in degrees/s without their sign, all over "
    "steps of about 1/30 s. nearest_degrees: for a real frame, the root mean square difference of "
    "the five angles to the most similar virtual posture, mirror images being one."
)
_OUTSIDE = (0.005, 0.995)
_STEP_S = 1.0 / 30.0
_UNSIGNED = ("trunk_bend", "head_turn")
_AT_ONCE = 256


@dataclass(frozen=True)
class Motion:
    """Postures of one animal, and how they change.

    Attributes:
        points_mm: (n, 5, 3) see `POINTS`, z up.
        clips: (n,) number of the recording without a break that each frame belongs to; None where
            postures have nothing to do with each other.
        rate_hz: frames a second; None where it is not known.
    """

    points_mm: Array
    clips: NDArray[np.int64] | None = None
    rate_hz: float | None = None

    @property
    def length_mm(self) -> float:
        """Median length along the points."""
        bones = np.linalg.norm(np.diff(self.points_mm, axis=1), axis=-1)
        return float(np.median(bones.sum(axis=1)))

    def posture(self) -> dict[str, Array]:
        """Each of `POSTURE` in every frame (n,), degrees and with its sign; stretch a ratio."""
        rump, hind, fore, neck, nose = np.moveaxis(self.points_mm, 1, 0)
        middle = 0.5 * (hind + fore)
        rear, front, trunk, head = middle - rump, neck - middle, neck - rump, nose - neck
        reach = np.linalg.norm(nose - rump, axis=-1)
        return {
            "trunk_bend": _turn(rear, front),
            "trunk_arch": _elevation(rear) - _elevation(front),
            "pitch": _elevation(trunk),
            "head_turn": _turn(trunk, head),
            "head_pitch": _elevation(head) - _elevation(trunk),
            "stretch": reach / np.median(reach),
        }

    def change(self) -> dict[str, Array]:
        """How fast each of speed, turning and the angles changes (m,); {} without a frame rate."""
        if self.rate_hz is None or self.clips is None:
            return {}
        lag = max(1, round(self.rate_hz * _STEP_S))
        together = self.clips[lag:] == self.clips[:-lag]
        per_s = self.rate_hz / lag
        rump, neck = self.points_mm[:, 0], self.points_mm[:, 3]
        trunk, middle = neck - rump, 0.5 * (neck + rump)
        step = np.linalg.norm((middle[lag:] - middle[:-lag])[:, :2], axis=-1)
        turn = np.abs(_turn(trunk[:-lag], trunk[lag:]))
        found = {"speed": step / self.length_mm * per_s, "turning": turn * per_s}
        posture = self.posture()
        for name in ("trunk_bend", "head_turn", "head_pitch"):
            off = (posture[name][lag:] - posture[name][:-lag] + 180.0) % 360.0 - 180.0
            found[f"{name}_rate"] = np.abs(off) * per_s
        return {name: values[together] for name, values in found.items()}


def _turn(first: Array, second: Array) -> Array:
    """Angles (n,) degrees on the floor from the first directions (n, 3) to the second."""
    off = np.arctan2(second[:, 1], second[:, 0]) - np.arctan2(first[:, 1], first[:, 0])
    return np.asarray(np.degrees((off + np.pi) % (2.0 * np.pi) - np.pi))


def _elevation(direction: Array) -> Array:
    """Elevations (n,) of directions (n, 3), degrees."""
    level = np.hypot(direction[:, 0], direction[:, 1])
    return np.asarray(np.degrees(np.arctan2(direction[:, 2], level)))


def motion_figures(real: Motion, virtual: dict[str, Motion]) -> dict[str, Any]:
    """Quantiles of a real animal's postures and changes beside those of virtual ones.

    Args:
        real: the real animal.
        virtual: virtual ones by a word for each.

    Returns:
        `quantiles`: by measure, then by whose, the values at `QUANTILES`; `outside`: by whose, then
        by measure, the share of real frames that lie beyond; `nearest_degrees`: by whose, the
        median and the 95 % quantile; `lean_degrees`: the real animal's median bend and turn with
        their signs, nought of one that leans to neither side. See `MOTION_PROTOCOL`.
    """
    own = _shown(real)
    others = {name: _shown(one) for name, one in virtual.items()}
    quantiles = {
        measure: {
            name: np.quantile(shown[measure], QUANTILES).tolist()
            for name, shown in {"real": own, **others}.items()
            if measure in shown
        }
        for measure in own
    }
    outside = {}
    for name, shown in others.items():
        bounds = {m: np.quantile(shown[m], _OUTSIDE) for m in POSTURE}
        outside[name] = {
            m: float(((own[m] < low) | (own[m] > high)).mean()) for m, (low, high) in bounds.items()
        }
    posture = real.posture()
    return {
        "n_frames": {"real": len(real.points_mm)}
        | {name: len(one.points_mm) for name, one in virtual.items()},
        "quantiles": quantiles,
        "outside": outside,
        "nearest_degrees": {
            name: np.quantile(nearest(real, one), (0.5, 0.95)).tolist()
            for name, one in virtual.items()
        },
        "lean_degrees": {name: float(np.median(posture[name])) for name in _UNSIGNED},
        "protocol": MOTION_PROTOCOL,
    }


def _shown(motion: Motion) -> dict[str, Array]:
    """Postures, angles on the floor without their sign and about their median, and changes."""
    shown: dict[str, Array] = {}
    for name, values in motion.posture().items():
        shown[name] = np.abs(values) if name in _UNSIGNED else values
        if name in _UNSIGNED:
            shown[f"{name}_about_lean"] = np.abs(values - np.median(values))
    return shown | motion.change()


def nearest(real: Motion, virtual: Motion) -> Array:
    """How far (n,) degrees each real posture is from the most similar virtual one.

    Args:
        real: n frames.
        virtual: m postures, of which and of whose mirror images the nearest is taken.
    """
    own, drawn = (_angles(one) for one in (real, virtual))
    mirrored = drawn * np.array([-1.0 if name in _UNSIGNED else 1.0 for name in POSTURE[:-1]])
    drawn = np.concatenate([drawn, mirrored])
    return np.concatenate(
        [
            np.sqrt(((own[at : at + _AT_ONCE, None] - drawn) ** 2).mean(axis=-1).min(axis=1))
            for at in range(0, len(own), _AT_ONCE)
        ]
    )


def _angles(motion: Motion) -> Array:
    """The five angles (n, 5) of each posture."""
    posture = motion.posture()
    names: Sequence[str] = POSTURE[:-1]
    return np.stack([posture[name] for name in names], axis=-1)
