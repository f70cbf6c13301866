"""Sphere-set approximation of a body: spheres along its bones that move with its joints.

Coarse, but quickly held against a depth picture (as the 48 spheres of a hand in Qian et al., CVPR
2014). The centre of a sphere is (1 - share) a + share b, where a and b are points in the frames of
two joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.capsules import PARTS, Capsules
from liex_lab.body.shape import BodyShape
from liex_lab.body.skeleton import Skeleton

Array = NDArray[np.float64]

_SPACING = 1.3  # radii between the middles of two balls


@dataclass(frozen=True)
class Spheres:
    """B spheres, each between two points that two joints carry. Lengths in mm at scale 1.

    The first n_own spheres are the body; the others lie where something may go on that is not the
    body, as an arm behind a hand, and what is seen there says nothing about it.

    Attributes:
        joints: (B, 2) int64, the joints that carry the two points.
        offsets: (B, 2, 3) mm, the points in the joints' frames.
        share: (B,) of the line from the first point to the second, at which the centre lies.
        radius: (B,) mm.
        n_own: how many are the body.
    """

    joints: NDArray[np.int64]
    offsets: Array
    share: Array
    radius: Array
    n_own: int

    @property
    def unit_mm(self) -> float:
        """A tenth of the mean radius of the body's spheres at scale 1, mm.

        By it distances from this body are measured.
        """
        return float(self.radius[: self.n_own].mean()) / 10.0

    @staticmethod
    def of(skeleton: Skeleton) -> Spheres:
        """Spheres along the capsules of a body, or along the chain of a tubular one.

        Args:
            skeleton: with its [surface] table.

        Raises:
            LiexError: the table describes neither capsules nor a tube.
        """
        if "stations" in skeleton.surface:
            ends, offsets, radii = _tube(skeleton)
        else:
            body = Capsules.of(skeleton)
            ends = body.joints
            offsets = body.offsets
            radii = body.radii
        rows = _along(skeleton, ends, offsets, radii)
        n_own = len(rows)
        more = Capsules.listed(skeleton, PARTS[1])
        rows += _along(skeleton, more.joints, more.offsets, more.radii)
        return Spheres(
            np.array([row[:2] for row in rows], np.int64),
            np.array([row[2:4] for row in rows], float),
            np.array([row[4] for row in rows], float),
            np.array([row[5] for row in rows], float),
            n_own,
        )


def _along(
    skeleton: Skeleton, ends: NDArray[np.int64], offsets: Array, radii: Array
) -> list[tuple[Any, ...]]:
    """Spheres along capsules, so near to one another at home that they make a body."""
    home = _home(skeleton)
    rows = []
    bones = {(p, j) for p, j in skeleton.edges}
    for (a, b), (at_a, at_b), (first, last) in zip(ends, offsets, radii, strict=True):
        length = float(np.linalg.norm(home[b] + at_b - home[a] - at_a))
        is_bone = (
            (int(a), int(b)) in bones and not np.any(at_a) and not np.any(at_b)
        )  # another ends where it begins
        n = max(1, round(length / (_SPACING * 0.5 * (first + last))))
        rows += [
            (a, b, at_a, at_b, s, first + s * (last - first))
            for s in np.arange(int(is_bone), n + 1) / n
        ]
    return rows


def _tube(skeleton: Skeleton) -> tuple[NDArray[np.int64], Array, Array]:
    """Ends, offsets and radii of capsules that fill a tubular body: as thick as it is where it is
    thinner.
    """
    shape = BodyShape.default(skeleton)
    stations = np.array(skeleton.surface["stations"], float)
    reach = np.concatenate([[0.0], np.cumsum(np.linalg.norm(skeleton.offsets[1:], axis=1))])
    thick = np.interp(reach / reach[-1], stations, np.minimum(shape.half_width, shape.half_height))
    thick = np.maximum(thick, 0.05 * thick.max())
    bones = np.array([[p, j] for p, j in skeleton.edges], np.int64)
    return bones, np.zeros((len(bones), 2, 3)), thick[bones]


def _home(skeleton: Skeleton) -> Array:
    """Joint positions (J, 3) mm at home."""
    turned = [np.eye(3)]
    at = [np.zeros(3)]
    for j in range(1, skeleton.n_joints):
        p = int(skeleton.parents[j])
        at.append(at[p] + turned[p] @ skeleton.offsets[j])
        turned.append(turned[p] @ skeleton.rest[j])
    return np.array(at)
