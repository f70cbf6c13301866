"""Bodies around a skeleton: a tube along a spine, tapered capsules, or a user's own mesh.

A tubular trunk is a generalised cylinder: superellipses |x / a|^p + |y / b|^p = 1 across the
mid-axis (Barr 1981), with half widths a and half heights b at stations along the spine; ears and
feet are ellipsoids, the tail is a thin tube. `Spheres` approximates any body along its bones.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from liex_lab.body import _skinning_kernels as skinning_kernels
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.runtime.kernels import kernel
from liex_lab.runtime.memory import Rows, check_index, check_shapes
from liex_lab.runtime.processes import in_parallel

Array = NDArray[np.float64]


class Body(Rows):
    """The body of one animal, or of a batch (n) of animals.

    Attributes:
        fur: () or (n,) from 0 (sleek) to 1 (long and soft): how much a sensor loses at the outline.
    """

    fur: Array

    def __len__(self) -> int:
        """Number of bodies in a batch."""
        return len(self.fur)

    def bare(self) -> Self:
        """The same body without limbs that not every animal shows."""
        return self

    def broadcast(self, n: int) -> Self:
        """A batch (n,) of this one body, or this batch."""
        if self.fur.shape == (n,):
            return self
        rows = {
            name: np.broadcast_to(value, (n, *value.shape)).copy()
            for name, value in vars(self).items()
            if name not in self.SHARED
        }
        return replace(self, **rows)  # type: ignore[type-var]


@dataclass(frozen=True)
class BodyShape(Body):
    """The body around a tubular animal's mid-axis, one shape or a batch (...).

    Lengths in mm at scale 1.

    Attributes:
        half_width: (..., R) mm at the tube's stations.
        half_height: (..., R) mm at the tube's stations.
        power: (...) of the superellipse across (2 is an ellipse).
        blobs: (..., B, 6) ellipsoids: station, left and up of the centre, radii forward, left, up.
        tail: (..., 3) length, radius at the rump, radius at the tip.
    """

    half_width: Array
    half_height: Array
    power: Array
    blobs: Array
    tail: Array
    fur: Array

    @staticmethod
    def default(skeleton: Skeleton) -> BodyShape:
        """The animal described by the skeleton's [surface] table, with stations along one chain of
        joints.

        Raises:
            LiexError: the joints are not one chain, or the table is incomplete.
        """
        table = skeleton.surface
        if not skeleton.is_chain:
            raise LiexError(
                f"the [surface] of '{skeleton.name}' has stations, but its joints are not one "
                "chain, each the parent of the next; give radii_mm instead"
            )
        try:
            width = np.array(table["half_width_mm"], float)
            height = np.array(table["half_height_mm"], float)
            blobs = [
                [pair["station"], side * pair["left_mm"], pair["up_mm"], *pair["radii_mm"]]
                for pair in table.get("pairs", [])
                for side in (1.0, -1.0)
            ]
            tail = np.array(table.get("tail_mm", [0.0, 0.0, 0.0]), float)
        except (KeyError, TypeError, ValueError) as error:
            raise LiexError(
                f"the [surface] of the skeleton '{skeleton.name}' is incomplete: {error}"
            ) from None
        if not len(width) == len(height) == len(table["stations"]) >= 4:
            raise LiexError(
                f"the [surface] of '{skeleton.name}' needs equally many stations, half_width_mm "
                "and half_height_mm, at least 4"
            )
        return BodyShape(
            width, height, np.array(2.0), np.array(blobs, float).reshape(-1, 6), tail, np.array(0.5)
        )

    def bare(self) -> BodyShape:
        """The same trunk without ears, feet and tail, for models of unknown limbs."""
        blobs = self.blobs.copy()
        blobs[..., 3:] = 0.0
        return replace(self, blobs=blobs, tail=np.zeros_like(self.tail))


# Body model of tapered capsules (sphere-swept segments) on a skeleton.


_KEYS = {"from", "to", "from_mm", "to_mm", "radii_mm"}
PARTS = ("capsules", "beyond")


@dataclass(frozen=True)
class Capsules(Body):
    """C tapered capsules that move with a skeleton; one body, or a batch (n) of them.

    Lengths in mm at scale 1. The first J - 1 capsules are the skeleton's bones, in order.

    Attributes:
        joints: (C, 2) int64, the joints that carry the two ends.
        offsets: (..., C, 2, 3) mm, the ends in these joints' frames.
        radii: (..., C, 2) mm at the ends.
    """

    SHARED = ("joints",)
    joints: NDArray[np.int64]
    offsets: Array
    radii: Array
    fur: Array = field(default_factory=lambda: np.array(0.0))

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
        bones = np.array(skeleton.edges, np.int64).reshape(-1, 2)
        more = Capsules.listed(skeleton, PARTS[0])
        return Capsules(
            np.concatenate([bones, more.joints]),
            np.concatenate([np.zeros((len(bones), 2, 3)), more.offsets]),
            np.concatenate([radii[bones], more.radii]),
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
        per_capsule = skinning_kernels.CAPSULE_RINGS * skinning_kernels.CAPSULE_SEGMENTS + 2
        out = np.empty((len(positions), per_capsule * len(self.joints), 3))
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
            ends, offsets, radii = body.joints, body.offsets, body.radii
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
    home = Pose.home(skeleton).joints(skeleton)
    rows = []
    bones = {(p, j) for p, j in skeleton.edges}
    for (a, b), (at_a, at_b), (first, last) in zip(ends, offsets, radii, strict=True):
        length = float(np.linalg.norm(home[b] + at_b - home[a] - at_a))
        is_bone = (
            (int(a), int(b)) in bones and not np.any(at_a) and not np.any(at_b)
        )  # it begins at the end of another capsule
        # 1.3 radii between the middles of two spheres
        n = max(1, round(length / (1.3 * 0.5 * (first + last))))
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
    half = np.minimum(shape.half_width, shape.half_height)
    thick = np.interp(skeleton.reach / skeleton.length, stations, half)
    thick = np.maximum(thick, 0.05 * thick.max())
    bones = np.array(skeleton.edges, np.int64)
    return bones, np.zeros((len(bones), 2, 3)), thick[bones]


# Linear blend skinning of a user's own triangle mesh.


@dataclass(frozen=True)
class MeshBody(Body):
    """A mesh of V vertices that moves with a skeleton; one body, or a batch (n).

    Lengths in mm at scale 1.

    Attributes:
        faces: (F, 3) int32.
        bones: (V, B) int64, the joints that end the bones which a vertex follows.
        carriers: (V, B) int64, the joints that begin them and carry them.
        weight: (V, B), of sum 1.
        along: (V, B, 3) mm, the vertex in the frame that carries the bone: the part along the bone.
        across: (V, B, 3) mm, the part across it.
        width: (..., J), the girth at each joint over the file's.
    """

    SHARED = ("faces", "bones", "carriers", "weight", "along", "across")
    faces: NDArray[np.int32]
    bones: NDArray[np.int64]
    carriers: NDArray[np.int64]
    weight: Array
    along: Array
    across: Array
    width: Array
    fur: Array = field(default_factory=lambda: np.array(0.0))

    @staticmethod
    def of(skeleton: Skeleton) -> MeshBody:
        """The mesh of a skeleton's [surface] table, with vertices_mm and faces, bound to the
        nearest bones at home.

        Raises:
            LiexError: vertices or faces are not finite triples, or a face refers to a missing
                vertex.
        """
        table = skeleton.surface
        vertices = np.array(table["vertices_mm"], float)
        faces = np.array(table["faces"], np.int64)
        if vertices.ndim != 2 or vertices.shape[1:] != (3,) or not np.isfinite(vertices).all():
            raise LiexError(
                f"the [surface] of '{skeleton.name}' needs vertices_mm, finite triples of mm"
            )
        if (
            faces.ndim != 2
            or faces.shape[1:] != (3,)
            or faces.min() < 0
            or faces.max() >= len(vertices)
        ):
            raise LiexError(
                f"the [surface] of '{skeleton.name}' needs faces, triples of numbers of its "
                "vertices"
            )
        home = Pose.home(skeleton).frames(skeleton)
        ends = np.arange(1, skeleton.n_joints)
        carriers = skeleton.parents[ends]
        start = home.translation[carriers]
        stop = home.translation[ends]
        bone = stop - start
        length2 = np.maximum(np.sum(bone**2, axis=-1), 1e-12)
        share = np.clip(
            np.einsum("vbd,bd->vb", vertices[:, None] - start, bone) / length2, 0.0, 1.0
        )
        far = np.linalg.norm(vertices[:, None] - start - share[..., None] * bone, axis=-1)
        # each vertex follows up to two bones
        n_bones = min(2, len(ends))
        near = np.argsort(far, axis=1, kind="stable")[:, :n_bones]
        pull = 1.0 / np.maximum(np.take_along_axis(far, near, axis=1), 1e-6) ** 4
        carrier = carriers[near]
        local = np.einsum(
            "vbji,vbj->vbi", home.rotation[carrier], vertices[:, None] - home.translation[carrier]
        )
        direction = skeleton.offsets[ends] / np.sqrt(length2)[:, None]
        along = np.einsum("vbi,vbi->vb", local, direction[near])[..., None] * direction[near]
        return MeshBody(
            faces.astype(np.int32),
            ends[near],
            carrier,
            pull / pull.sum(axis=1, keepdims=True),
            along,
            local - along,
            np.ones(skeleton.n_joints),
        )

    def vertices(self, rotations: Array, positions: Array, scale: Array, girth: Array) -> Array:
        """Mesh vertices in many poses.

        Args:
            rotations: (n, J, 3, 3) of the joints.
            positions: (n, J, 3) mm of the joints.
            scale: (n,) multiplies lengths along the bones.
            girth: (n,) multiplies lengths across the bones.

        Returns:
            (n, V, 3) mm, in the frame of the joints.
        """
        n = len(positions)
        body = self.broadcast(n)
        check_shapes(
            "a mesh's poses",
            ("rotations", rotations, (n, "J", 3, 3)),
            ("positions", positions, (n, "J", 3)),
            ("scale", scale, (n,)),
            ("girth", girth, (n,)),
            ("width", body.width, (n, "J")),
        )
        check_index("the skeleton's joints", self.bones, positions.shape[1])
        out = np.empty((n, len(self.weight), 3))
        in_parallel(
            _skin_mesh,
            n,
            rotations,
            positions,
            scale,
            girth,
            _Skin(self.carriers, self.bones, self.weight, self.along, self.across),
            body.width,
            out,
        )
        return out


class _Skin(NamedTuple):
    """How V vertices follow their B bones, see `MeshBody`.

    Attributes:
        carrier: (V, B) the joints that carry the bones.
        bones: (V, B) the joints that end them.
        weight: (V, B).
        along: (V, B, 3) mm.
        across: (V, B, 3) mm.
    """

    carrier: Any
    bones: Any
    weight: Any
    along: Any
    across: Any


@kernel(nogil=True)
def _skin_mesh(rotations, positions, scale, girth, skin, width, out, start, stop):
    """Linear blend skinning of a batch into out (n, V, 3)."""
    for i in range(start, stop):
        for v in range(len(skin.weight)):
            for axis in range(3):
                out[i, v, axis] = 0.0
            for b in range(skin.weight.shape[1]):
                j = skin.carrier[v, b]
                thick = girth[i] * 0.5 * (width[i, j] + width[i, skin.bones[v, b]])
                for axis in range(3):
                    total = positions[i, j, axis]
                    for k in range(3):
                        total += rotations[i, j, axis, k] * (
                            scale[i] * skin.along[v, b, k] + thick * skin.across[v, b, k]
                        )
                    out[i, v, axis] += skin.weight[v, b] * total
