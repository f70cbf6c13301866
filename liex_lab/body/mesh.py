"""Linear blend skinning of a user's own triangle mesh.

Every vertex follows the two bones that are nearest at home, with weights 1 / distance^4 of sum 1
(skeleton-subspace deformation; Magnenat-Thalmann et al. 1988, Lewis et al. 2000):

    v' = sum_b w_b (p_b + R_b (scale along_b + girth across_b))

R_b, p_b is the frame of the joint that carries bone b; along and across are the parts of the
vertex's home position in that frame, along the bone and across it, so that length and girth vary
apart.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.runtime.kernels import kernel
from liex_lab.runtime.shapes import check_index, check_shapes
from liex_lab.runtime.threads import in_parallel

Array = NDArray[np.float64]

_BONES = 2  # bones per vertex
_SHARPNESS = 4  # exponent of the distance in a bone's weight


@dataclass(frozen=True)
class MeshBody:
    """A mesh of V vertices that moves with a skeleton; one body, or a batch (n).

    Lengths in mm at scale 1.

    Attributes:
        faces: (F, 3) int32.
        bones: (V, B) int64, the joints that end the bones which a vertex follows.
        weight: (V, B), of sum 1.
        along: (V, B, 3) mm, the vertex in the frame that carries the bone: the part along the bone.
        across: (V, B, 3) mm, the part across it.
        width: (..., J), the girth at each joint over the file's.
        fur: (...), as in `BodyShape`.
    """

    faces: NDArray[np.int32]
    bones: NDArray[np.int64]
    weight: Array
    along: Array
    across: Array
    width: Array
    fur: Array = field(default_factory=lambda: np.array(0.0))

    def __len__(self) -> int:
        """Number of bodies in a batch."""
        return len(self.fur)

    def __getitem__(self, index: int | slice | NDArray[np.int64]) -> MeshBody:
        """One body, or some, of a batch, by number, slice or row numbers."""
        return replace(self, width=self.width[index], fur=self.fur[index])

    def broadcast(self, n: int) -> MeshBody:
        """A batch (n,) of this one body, or this batch."""
        if self.fur.ndim == 1 and len(self.fur) == n:
            return self
        return replace(
            self,
            width=np.broadcast_to(self.width, (n, self.width.shape[-1])).copy(),
            fur=np.broadcast_to(self.fur, n).copy(),
        )

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
        n_bones = min(_BONES, len(ends))
        near = np.argsort(far, axis=1, kind="stable")[:, :n_bones]
        pull = 1.0 / np.maximum(np.take_along_axis(far, near, axis=1), 1e-6) ** _SHARPNESS
        carrier = carriers[near]
        local = np.einsum(
            "vbji,vbj->vbi", home.rotation[carrier], vertices[:, None] - home.translation[carrier]
        )
        direction = skeleton.offsets[ends] / np.sqrt(length2)[:, None]
        along = np.einsum("vbi,vbi->vb", local, direction[near])[..., None] * direction[near]
        return MeshBody(
            faces.astype(np.int32),
            ends[near],
            pull / pull.sum(axis=1, keepdims=True),
            along,
            local - along,
            np.ones(skeleton.n_joints),
        )

    @property
    def n_vertices(self) -> int:
        """Vertices V of one pose's mesh."""
        return len(self.weight)

    def vertices(
        self, skeleton: Skeleton, rotations: Array, positions: Array, scale: Array, girth: Array
    ) -> Array:
        """Mesh vertices in many poses.

        Args:
            skeleton: the one to which the mesh is bound.
            rotations: (n, J, 3, 3) of the joints.
            positions: (n, J, 3) mm of the joints.
            scale: (n,) multiplies lengths along the bones.
            girth: (n,) multiplies those across.

        Returns:
            (n, V, 3) mm, in the frame of the joints.
        """
        n = len(positions)
        check_shapes(
            "a mesh's poses",
            ("rotations", rotations, (n, skeleton.n_joints, 3, 3)),
            ("positions", positions, (n, skeleton.n_joints, 3)),
            ("scale", scale, (n,)),
            ("girth", girth, (n,)),
        )
        check_index("the skeleton's joints", self.bones, skeleton.n_joints)
        body = self.broadcast(n)
        out = np.empty((len(positions), self.n_vertices, 3))
        skin = _Skin(skeleton.parents[self.bones], self.bones, self.weight, self.along, self.across)
        in_parallel(
            _skin_mesh,
            n,
            rotations,
            positions,
            scale,
            girth,
            skin,
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
