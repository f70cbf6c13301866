"""Body model of tapered capsules (sphere-swept segments) on a skeleton.

One capsule around every bone, and the additional ones of a skeleton's [surface] table. The two ends
of a capsule are points in the frames of two joints, p_e = t_j + scale R_j offset_e, each with its
own radius; the surface is a straight tube between them, round at both ends.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.body import _skinning_kernels as skinning_kernels
from liex_lab.body.shape import BodyShape
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.runtime.threads import in_parallel

Array = NDArray[np.float64]

_KEYS = {"from", "to", "from_mm", "to_mm", "radii_mm"}
PARTS = ("capsules", "beyond")


@dataclass(frozen=True)
class Capsules:
    """C tapered capsules that move with a skeleton; one body, or a batch (n) of them.

    Lengths in mm at scale 1. The first J - 1 capsules are the skeleton's bones, in order.

    Attributes:
        joints: (C, 2) int64, the joints that carry the two ends.
        offsets: (..., C, 2, 3) mm, the ends in these joints' frames.
        radii: (..., C, 2) mm at the ends.
        fur: (...), as in `BodyShape`.
    """

    joints: NDArray[np.int64]
    offsets: Array
    radii: Array
    fur: Array = field(default_factory=lambda: np.array(0.0))

    def __len__(self) -> int:
        """Number of bodies in a batch."""
        return len(self.fur)

    def __getitem__(self, index: int | slice | NDArray[np.int64]) -> Capsules:
        """One body, or some, of a batch, by number, slice or row numbers."""
        return replace(
            self, offsets=self.offsets[index], radii=self.radii[index], fur=self.fur[index]
        )

    def broadcast(self, n: int) -> Capsules:
        """A batch (n,) of this one body, or this batch."""
        if self.fur.ndim == 1 and len(self.fur) == n:
            return self
        offsets, radii, fur = (
            np.broadcast_to(a, (n, *a.shape)).copy() for a in (self.offsets, self.radii, self.fur)
        )
        return replace(self, offsets=offsets, radii=radii, fur=fur)

    @staticmethod
    def of(skeleton: Skeleton) -> Capsules:
        """The body described by a skeleton's [surface]: radii_mm at the joints, and the list
        [[surface.capsules]].

        Raises:
            LiexError: there is not one positive radius for each joint, or a capsule is invalid.
        """
        radii = np.array(skeleton.surface.get("radii_mm", []), float)
        if radii.shape != (skeleton.n_joints,) or not (radii > 0).all():
            raise LiexError(
                f"the [surface] of '{skeleton.name}' needs radii_mm, one positive number for each "
                f"of its {skeleton.n_joints} joints, or stations with half_width_mm and "
                "half_height_mm"
            )
        joints = [[int(skeleton.parents[j]), j] for j in range(1, skeleton.n_joints)]
        at_ends = [[radii[a], radii[b]] for a, b in joints]
        more = Capsules.listed(skeleton, PARTS[0])
        return Capsules(
            np.concatenate([np.array(joints, np.int64).reshape(-1, 2), more.joints]),
            np.concatenate([np.zeros((len(joints), 2, 3)), more.offsets]),
            np.concatenate([np.array(at_ends, float).reshape(-1, 2), more.radii]),
        )

    @staticmethod
    def listed(skeleton: Skeleton, part: str) -> Capsules:
        """The capsules of one of the lists in a skeleton's [surface].

        Args:
            skeleton: with its [surface] table.
            part: 'capsules', which belong to the body, or 'beyond', possible extensions that do
                not, such as an arm behind a hand.

        Raises:
            LiexError: an unknown key or joint, or a wrong number of values.
        """
        rows = [_parsed(table, skeleton, part) for table in skeleton.surface.get(part, [])]
        return Capsules(
            np.array([row[0] for row in rows], np.int64).reshape(-1, 2),
            np.array([row[1] for row in rows], float).reshape(-1, 2, 3),
            np.array([row[2] for row in rows], float).reshape(-1, 2),
        )

    @property
    def faces(self) -> NDArray[np.int32]:
        """Triangles (F, 3) int32 of the vertices returned by `vertices`."""
        return skinning_kernels.joined_faces(
            [(skinning_kernels.CAPSULE_RINGS, skinning_kernels.CAPSULE_SEGMENTS)] * len(self.joints)
        )

    @property
    def n_vertices(self) -> int:
        """Vertices V of one pose's mesh."""
        return len(self.joints) * (
            skinning_kernels.CAPSULE_RINGS * skinning_kernels.CAPSULE_SEGMENTS + 2
        )

    def vertices(self, rotations: Array, positions: Array, scale: Array, girth: Array) -> Array:
        """Mesh vertices in many poses.

        Args:
            rotations: (n, J, 3, 3) of the joints.
            positions: (n, J, 3) mm of the joints.
            scale: (n,) multiplies the offsets.
            girth: (n,) multiplies the radii.

        Returns:
            (n, V, 3) mm, in the frame of the joints.
        """
        body = self.broadcast(len(positions))
        out = np.empty((len(positions), self.n_vertices, 3))
        in_parallel(
            skinning_kernels.skin_capsules,
            len(positions),
            rotations,
            positions,
            scale,
            girth,
            self.joints,
            body.offsets,
            body.radii,
            out,
        )
        return out


def _parsed(
    table: Any, skeleton: Skeleton, part: str
) -> tuple[list[int], list[list[float]], list[float]]:
    """Joints, offsets and radii of one [[surface.capsules]] or [[surface.beyond]]."""
    where = f"the [[surface.{part}]] of '{skeleton.name}'"
    if not isinstance(table, dict) or not set(table) <= _KEYS:
        raise LiexError(f"{where} have the keys {', '.join(sorted(_KEYS))}, got {table}")
    names = [table.get("from"), table.get("to")]
    for name in names:
        if name not in skeleton.names:
            raise LiexError(f"{where} connect two joints, but there is no joint {name!r}")
    offsets = [table.get("from_mm", [0.0] * 3), table.get("to_mm", [0.0] * 3)]
    radii = table.get("radii_mm", [])
    if not (
        _numbers(offsets[0], 3)
        and _numbers(offsets[1], 3)
        and _numbers(radii, 2)
        and min(radii) > 0
    ):
        raise LiexError(
            f"{where} have from_mm and to_mm of three numbers and radii_mm of two positive ones, "
            f"got {table}"
        )
    return [skeleton.names.index(name) for name in names], offsets, radii


def _numbers(value: Any, n: int) -> bool:
    return (
        isinstance(value, list)
        and len(value) == n
        and all(isinstance(x, int | float) for x in value)
    )


# Sphere-set approximation of a body: spheres along its bones that move with its joints.


_SPACING = 1.3  # radii between the middles of two balls


@dataclass(frozen=True)
class Spheres:
    """B spheres, each between two points that two joints carry. Lengths in mm at scale 1.

    The first n_own spheres are the body; the others cover possible extensions that are not the
    body, such as an arm behind a hand, where observations provide no evidence about it.

    Attributes:
        joints: (B, 2) int64, the joints that carry the two points.
        offsets: (B, 2, 3) mm, the points in the joints' frames.
        share: (B,) position of the centre on the line from the first point to the second.
        radius: (B,) mm.
        n_own: number of spheres of the body.
    """

    joints: NDArray[np.int64]
    offsets: Array
    share: Array
    radius: Array
    n_own: int

    @property
    def unit_mm(self) -> float:
        """A tenth of the mean radius of the body's spheres at scale 1, mm: the unit of distances
        from this body.
        """
        return float(self.radius[: self.n_own].mean()) / 10.0

    @staticmethod
    def of(skeleton: Skeleton) -> Spheres:
        """Spheres along the capsules of a body, or along the chain of a tubular one.

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
    """Spheres along capsules, spaced at home closely enough to form a body."""
    home = _home(skeleton)
    rows = []
    bones = {(p, j) for p, j in skeleton.edges}
    for (a, b), (at_a, at_b), (first, last) in zip(ends, offsets, radii, strict=True):
        length = float(np.linalg.norm(home[b] + at_b - home[a] - at_a))
        is_bone = (
            (int(a), int(b)) in bones and not np.any(at_a) and not np.any(at_b)
        )  # it begins at the end of another capsule
        n = max(1, round(length / (_SPACING * 0.5 * (first + last))))
        rows += [
            (a, b, at_a, at_b, s, first + s * (last - first))
            for s in np.arange(int(is_bone), n + 1) / n
        ]
    return rows


def _tube(skeleton: Skeleton) -> tuple[NDArray[np.int64], Array, Array]:
    """Ends, offsets and radii of capsules that fill a tubular body, as thick as its smaller half
    axis.
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
