"""Bodies around a skeleton: a tube along a spine, tapered capsules, or a user's own mesh.

A tubular trunk is a generalised cylinder: superellipses |x / a|^p + |y / b|^p = 1 across the
mid-axis (Barr 1981), with half widths a and half heights b at stations along the spine; ears and
feet are ellipsoids, the tail is a thin tube. `Spheres` approximates any body along its bones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body import _rasterizer_kernels as rasterizer_kernels
from liex_lab.body import _skinning_kernels as skinning_kernels
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError, one_line, refuse
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.runtime.kernels import kernel
from liex_lab.runtime.memory import Rows, check_index, check_shapes
from liex_lab.runtime.processes import in_parallel, threads


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
        refuse(
            LiexError,
            (
                vertices.ndim != 2 or vertices.shape[1:] != (3,) or not np.isfinite(vertices).all(),
                f"the [surface] of '{skeleton.name}' needs vertices_mm, finite triples of mm",
            ),
            (
                faces.ndim != 2
                or faces.shape[1:] != (3,)
                or faces.min() < 0
                or faces.max() >= len(vertices),
                f"the [surface] of '{skeleton.name}' needs faces, triples of numbers of its "
                "vertices",
            ),
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
            self.carriers,
            self.bones,
            self.weight,
            np.stack([self.along, self.across]),
            body.width,
            out,
        )
        return out


@kernel(nogil=True)
def _skin_mesh(
    rotations,
    positions,
    scale,
    girth,
    carrier,
    bones,
    weight,
    offsets,
    width,
    out,
    start,
    stop,
):
    """Linear blend skinning of a batch into out (n, V, 3); (V, B) arrays as in `MeshBody`.

    offsets: (2, V, B, 3) along and across.
    """
    for i in range(start, stop):
        for v in range(len(weight)):
            for axis in range(3):
                out[i, v, axis] = 0.0
            for b in range(weight.shape[1]):
                j = carrier[v, b]
                thick = girth[i] * 0.5 * (width[i, j] + width[i, bones[v, b]])
                for axis in range(3):
                    total = positions[i, j, axis]
                    for k in range(3):
                        total += rotations[i, j, axis, k] * (
                            scale[i] * offsets[0, v, b, k] + thick * offsets[1, v, b, k]
                        )
                    out[i, v, axis] += weight[v, b] * total


# The surface around a skeleton as a triangle mesh, and its depth image.


Window = tuple[int, int, int, int]
# distance of the silhouette's camera, in reaches of the body, and size of its image, px
_FAR = 50.0
_SILHOUETTE_PX = 400


@dataclass(frozen=True)
class Surface:
    """A mesh of fixed topology that follows a skeleton.

    A skeleton's [surface] table defines its kind: `stations` with half widths and heights make a
    tube along one chain of joints, a generalised cylinder with superelliptic cross-sections (the
    mouse); `radii_mm` a tapered capsule around every bone and `capsules` additional ones (any other
    animal); `mesh` is the file of the user's own body, deformed by linear blend skinning. Depth is
    rendered with a z-buffer, see `_rasterizer_kernels`.

    Attributes:
        skeleton: of the poses.
        faces: (F, 3) int32, indices of the vertices (V, 3) of every pose.
        body: the default animal.
        stations: (R,) along a tubular body, shares of the spine's length; empty for another.
    """

    skeleton: Skeleton
    faces: NDArray[np.int32]
    body: Body
    stations: Array

    @staticmethod
    def of(skeleton: Skeleton) -> Surface:
        """The surface described by the skeleton's [surface] table.

        Raises:
            LiexError: the table describes no surface.
        """
        try:
            with np.errstate(all="raise", under="ignore"):
                return Surface._of(skeleton)
        except (
            KeyError,
            TypeError,
            ValueError,
            IndexError,
            AttributeError,
            ArithmeticError,
        ) as error:
            raise LiexError(
                f"the [surface] of '{skeleton.name}' cannot be read ({type(error).__name__}: "
                f"{one_line(error)}); compare it with that of a bundled skeleton"
            ) from None

    @staticmethod
    def _of(skeleton: Skeleton) -> Surface:
        table = skeleton.surface
        if "stations" not in table:
            body = MeshBody.of(skeleton) if "vertices_mm" in table else Capsules.of(skeleton)
            return Surface(skeleton, body.faces, body, np.zeros(0))
        tube = BodyShape.default(skeleton)
        stations = np.array(table["stations"], float)
        parts = [(len(stations) - 2, skinning_kernels.BODY_SEGMENTS)]
        blob = (skinning_kernels.BLOB_RINGS, skinning_kernels.BLOB_SEGMENTS)
        parts += [blob] * len(tube.blobs)
        parts += [(skinning_kernels.TAIL_RINGS, skinning_kernels.TAIL_SEGMENTS)]
        return Surface(skeleton, skinning_kernels.joined_faces(parts), tube, stations)

    @property
    def n_vertices(self) -> int:
        """Vertices V of one pose's mesh."""
        return int(self.faces.max()) + 1

    @property
    def n_trunk_vertices(self) -> int:
        """The leading vertices that belong to the trunk, without ears, feet and tail."""
        trunk = (len(self.stations) - 2) * skinning_kernels.BODY_SEGMENTS + 2
        return trunk if len(self.stations) else self.n_vertices

    @property
    def n_trunk_faces(self) -> int:
        """The leading faces that belong to the trunk, without ears, feet and tail."""
        n_rings = len(self.stations) - 2
        return 2 * n_rings * skinning_kernels.BODY_SEGMENTS if n_rings > 0 else len(self.faces)

    @property
    def area_mm2(self) -> float:
        """Approximate area of the home pose in top view, mm^2 at scale 1.

        Of capsules: their horizontal lengths times the sum of their radii at the ends; of a tube:
        its width integrated along the spine; of a mesh: its silhouette.
        """
        if isinstance(self.body, Capsules):
            home = Pose.home(self.skeleton).joints(self.skeleton)
            first, last = (home[self.body.joints[:, k]] for k in range(2))
            along = np.linalg.norm((last - first)[:, :2], axis=-1)
            return float((along * self.body.radii.sum(axis=-1)).sum())
        if isinstance(self.body, BodyShape):
            along = self.stations * self.skeleton.length
            return float(np.trapezoid(2.0 * self.body.half_width, along))
        # pixels of the image of a very distant camera
        mesh = self.vertices(Pose.home(self.skeleton))
        reach = float(np.abs(mesh).max())
        px = _SILHOUETTE_PX
        camera = Camera(_FAR * px / 2, _FAR * px / 2, px / 2, px / 2, px, px)
        above = SE3(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, _FAR * reach]))
        covered = render_mesh(mesh, self.faces, camera, T_camera_mesh=above) > 0
        return float(covered.sum()) * (2.0 * reach / px) ** 2

    def vertices(
        self,
        pose: Pose,
        shape: Body | None = None,
        girth: Array | float | None = None,
        bends: Array | None = None,
        parallel: bool = True,
    ) -> Array:
        """Mesh vertices of poses, in the poses' frame.

        A tail requires poses in the arena frame: it sinks to z = 0.

        Args:
            pose: a batch (...).
            shape: the animal; None is the default animal without ears, feet and tail.
            girth: (...) multiplies all lengths across the body; None uses the pose's scale.
            bends: (n or 1, TAIL_RINGS) rad, the tail's turn at each ring; None is straight.
            parallel: whether to use all threads.

        Returns:
            (..., V, 3) mm.
        """
        frames = pose.frames(self.skeleton)
        batch = frames.translation.shape[:-2]
        joints = np.ascontiguousarray(frames.translation).reshape(-1, self.skeleton.n_joints, 3)
        rotations = np.ascontiguousarray(frames.rotation).reshape(*joints.shape, 3)
        n = len(joints)
        scale, across = (
            np.broadcast_to(factor, batch).astype(float).reshape(n)
            for factor in (pose.scale, pose.scale if girth is None else girth)
        )
        body = self.body.bare() if shape is None else shape
        # one thread skins few bodies sooner than several do
        with threads(parallel and n > 16):
            if isinstance(body, Capsules | MeshBody):
                return body.vertices(rotations, joints, scale, across).reshape(*batch, -1, 3)
            assert isinstance(body, BodyShape)
            tube = body.broadcast(n)
            turns = np.broadcast_to(
                0.0 if bends is None else bends, (n, skinning_kernels.TAIL_RINGS)
            )
            out = np.empty((n, self.n_vertices, 3))
            in_parallel(
                skinning_kernels.skin_tubes,
                n,
                joints,
                rotations,
                across,
                self.stations,
                np.stack([tube.half_width, tube.half_height]),
                tube.power,
                tube.blobs,
                tube.tail,
                turns.astype(float, order="C"),
                out,
            )
            return out.reshape(*batch, -1, 3)


def render_mesh(
    vertices: Array,
    faces: NDArray[np.int32],
    camera: Camera,
    window: Window | None = None,
    T_camera_mesh: SE3 | None = None,
) -> NDArray[np.float32]:
    """Depth image of one closed mesh, by z-buffer.

    Args:
        vertices: (V, 3) mm, in the frame of the mesh.
        faces: (F, 3) int32.
        camera: the ideal pinhole camera.
        window: (u0, v0, width, height) px of the image; None for the full image.
        T_camera_mesh: transforms the mesh's frame to the camera's; None if they are the same.

    Returns:
        (H, W) float32 mm, 0 outside the mesh.
    """
    T = SE3.identity() if T_camera_mesh is None else T_camera_mesh
    u0, v0, *size = (0, 0, camera.width, camera.height) if window is None else window
    vertices, intrinsics = np.asarray(vertices)[None], camera.intrinsics[None]
    return render_meshes(vertices, faces, T[None], intrinsics, np.array([[u0, v0]]), size)[0]


def render_meshes(
    vertices: Array,
    faces: NDArray[np.int32],
    T_camera_mesh: SE3,
    intrinsics: Array,
    origin: Array,
    size: Sequence[int],
) -> NDArray[np.float32]:
    """Depth images of many meshes, each by its own camera in its own window.

    Args:
        vertices: (n, V, 3) mm.
        faces: (F, 3) int32, shared.
        T_camera_mesh: (n) transforms from the meshes' frames to the cameras'.
        intrinsics: (n, 4) fx, fy, cx, cy px.
        origin: (n, 2) image pixel (u, v) at the window's top left.
        size: (width, height) px of the windows.

    Returns:
        (n, H, W) float32 mm, 0 outside the mesh.
    """
    n = len(vertices)
    check_shapes(
        "meshes",
        ("vertices", vertices, (n, "V", 3)),
        ("faces", faces, ("F", 3)),
        ("rotations", T_camera_mesh.rotation, (n, 3, 3)),
        ("intrinsics", np.asarray(intrinsics), (n, 4)),
        ("origin", np.asarray(origin), (n, 2)),
    )
    check_index("vertices", faces, vertices.shape[1])
    depth = np.empty((n, size[1], size[0]), np.float32)
    in_parallel(
        rasterizer_kernels.draw_batch,
        n,
        np.ascontiguousarray(vertices, float),
        faces,
        np.ascontiguousarray(T_camera_mesh.rotation),
        np.ascontiguousarray(T_camera_mesh.translation),
        np.asarray(intrinsics, float),
        np.asarray(origin, float),
        depth,
    )
    return depth
