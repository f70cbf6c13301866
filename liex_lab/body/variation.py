"""Random variation of any animal's body: girth and proportions around its skeleton.

For a species of which nobody described how individuals differ: smooth log-factors along the body
(overall girth, a tilt of mass forward or back, flatness, a belly, and low-frequency sine waves)
multiply the widths and heights of its tube, capsules or mesh (domain randomisation).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.shape import FAMILIES, BodyShape
from liex_lab.body.skeleton import Skeleton
from liex_lab.body.surface import Body, Surface
from liex_lab.errors import LiexError

Array = NDArray[np.float64]

_WILD_SHARE = 0.6
_WAVES = (0.5, 1.0, 1.5, 2.0)  # cycles along the body


def vary_body(rng: np.random.Generator, skeleton: Skeleton, family: str, n: int) -> Body:
    """Draw n animals of a family around the body that a skeleton's TOML describes.

    Args:
        rng: where chance comes from.
        skeleton: with its [surface] table.
        family: 'train' varies it as individuals vary; most of 'augmented' varies more than
            individuals do, so that no forest relies on one exact profile; 'wide' varies it by three
            times as much as 'train', all of them; 'other' holds builds that neither of the first
            two reaches: far slimmer or stouter, with the mass far forward or far back.
        n: animals.

    Returns:
        A batch (n,) of the kind of body that the skeleton has.

    Raises:
        LiexError: there is no such family, or the skeleton describes no surface.
    """
    if family not in FAMILIES:
        raise LiexError(f"there is no shape family '{family}'; known are {', '.join(FAMILIES)}")
    surface = Surface.of(skeleton)
    fur = rng.uniform(0.0, 0.4, n)
    if surface.mesh is not None:
        wide, high = _factors(rng, joint_reaches(skeleton), family, n)
        return replace(surface.mesh.broadcast(n), width=np.sqrt(wide * high), fur=fur)
    if surface.capsules is not None:
        reach = joint_reaches(skeleton)
        wide, high = _factors(rng, reach, family, n)
        around = np.sqrt(wide * high)[:, surface.capsules.joints]
        return replace(
            surface.capsules.broadcast(n), radii=surface.capsules.radii * around, fur=fur
        )
    assert surface.shape is not None
    wide, high = _factors(rng, np.clip(surface.stations, 0.0, 1.0), family, n)
    shape = surface.shape.broadcast(n)
    blobs = shape.blobs.copy()
    for first in range(0, blobs.shape[1], 2):  # limbs come in pairs, one on each side
        nearest = int(np.argmin(np.abs(surface.stations - blobs[0, first, 0])))
        size = rng.uniform(0.6, 1.3, n) * (rng.random(n) < 0.7)
        for b in (first, first + 1):
            blobs[:, b, 1] *= wide[:, nearest]
            blobs[:, b, 2] *= high[:, nearest]
            blobs[:, b, 3:] *= size[:, None]
    power = rng.uniform(1.8, 2.4, n)
    return BodyShape(
        shape.half_width * wide, shape.half_height * high, power, blobs, shape.tail, fur
    )


def joint_reaches(skeleton: Skeleton) -> Array:
    """Path lengths (J,) from the base to each joint, as shares of the longest.

    Args:
        skeleton: with at least one bone.
    """
    reach = np.zeros(skeleton.n_joints)
    for parent, child in skeleton.edges:
        reach[child] = reach[parent] + np.linalg.norm(skeleton.offsets[child])
    return reach / reach.max()


def _factors(rng: np.random.Generator, along: Array, family: str, n: int) -> tuple[Array, Array]:
    """Factors (n, R) of width and height at places `along` (R,) the body, from 0 to 1."""
    wild = ((rng.random(n) < _WILD_SHARE) & (family == "augmented"))[:, None]
    sign = rng.choice([-1.0, 1.0], (4, n, 1))
    size, slope, flat, belly = rng.uniform(0.0, 1.0, (4, n, 1))
    at = rng.uniform(0.2, 0.5, (n, 1))
    if family == "other":
        log_girth = sign[0] * (0.24 + 0.12 * size)
        tilt = sign[1] * (0.40 + 0.25 * slope)
        squeeze = sign[2] * (0.10 + 0.12 * flat)
        bulge = 0.25 * belly
        rough = np.full((n, 1), 0.05)
    else:
        more = np.where(wild, 2.0, 3.0 if family == "wide" else 1.0)
        log_girth = more * sign[0] * 0.12 * size
        tilt = more * sign[1] * 0.15 * slope
        squeeze = more * sign[2] * 0.08 * flat
        bulge = more * (0.2 * belly - 0.05)
        rough = np.where(wild, 0.08, 0.08 if family == "wide" else 0.03)
    log_width = (
        log_girth + tilt * (along - 0.4) + np.log1p(bulge * np.exp(-(((along - at) / 0.18) ** 2)))
    )
    log_height = (
        log_girth + tilt * (along - 0.4) + 0.5 * (log_width - log_girth - tilt * (along - 0.4))
    )
    waves = [_waves(rng, along, n) * rough for _ in range(2)]
    return np.exp(log_width + squeeze + waves[0]), np.exp(log_height - squeeze + waves[1])


def _waves(rng: np.random.Generator, along: Array, n: int) -> Array:
    """Slow waves (n, R) of about unit deviation along the body."""
    total = np.zeros((n, len(along)))
    for cycles in _WAVES:
        phase = rng.uniform(0.0, 2.0 * np.pi, (n, 1))
        total += rng.normal(0.0, np.sqrt(0.5), (n, 1)) * np.sin(
            2.0 * np.pi * cycles * along + phase
        )
    return total
