"""The surface around a skeleton as a triangle mesh, and its depth image.

A skeleton's [surface] table defines its kind: `stations` with half widths and heights make a tube
along one chain of joints, a generalised cylinder with superelliptic cross-sections (the mouse);
`radii_mm` a tapered capsule around every bone and `capsules` additional ones (any other animal);
`mesh` is the file of the user's own body, deformed by linear blend skinning. Depth is rendered with
a z-buffer, see `_rasterizer_kernels`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body import _rasterizer_kernels as rasterizer_kernels
from liex_lab.body import _skinning_kernels as skinning_kernels
from liex_lab.body.capsules import Capsules
from liex_lab.body.mesh import MeshBody
from liex_lab.body.pose import Pose
from liex_lab.body.shape import FAMILIES, BodyShape
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError, one_line
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.runtime.shapes import check_index, check_shapes
from liex_lab.runtime.threads import in_parallel, threads

Array = NDArray[np.float64]
Body = BodyShape | Capsules | MeshBody
Window = tuple[int, int, int, int]
# distance of the silhouette's camera, in reaches of the body, and size of its image, px
_FAR = 50.0
_FEW = 16  # bodies: fewer are not worth threads
_SILHOUETTE_PX = 400


@dataclass(frozen=True)
class Surface:
    """A mesh of fixed topology that follows a skeleton.

    Exactly one of shape, capsules and mesh is given; the others are None.

    Attributes:
        skeleton: of the poses.
        faces: (F, 3) int32, indices of the vertices (V, 3) of every pose.
        stations: (R,) along a tubular body, shares of the spine's length; empty for another.
        shape: the default animal of a tubular body.
        capsules: a capsule body.
        mesh: the body of a file.
    """

    skeleton: Skeleton
    faces: NDArray[np.int32]
    stations: Array
    shape: BodyShape | None
    capsules: Capsules | None
    mesh: MeshBody | None = None

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
        if "stations" in table:
            shape = BodyShape.default(skeleton)
            stations = np.array(table["stations"], float)
            parts = [(len(stations) - 2, skinning_kernels.BODY_SEGMENTS)]
            parts += [(skinning_kernels.BLOB_RINGS, skinning_kernels.BLOB_SEGMENTS)] * len(
                shape.blobs
            )
            parts += [(skinning_kernels.TAIL_RINGS, skinning_kernels.TAIL_SEGMENTS)]
            return Surface(skeleton, skinning_kernels.joined_faces(parts), stations, shape, None)
        if "vertices_mm" in table:
            mesh = MeshBody.of(skeleton)
            return Surface(skeleton, mesh.faces, np.zeros(0), None, None, mesh)
        capsules = Capsules.of(skeleton)
        return Surface(skeleton, capsules.faces, np.zeros(0), None, capsules)

    @property
    def n_vertices(self) -> int:
        """Vertices V of one pose's mesh."""
        return int(self.faces.max()) + 1

    @property
    def n_trunk_vertices(self) -> int:
        """The leading vertices that belong to the trunk, without ears, feet and tail."""
        return (
            (len(self.stations) - 2) * skinning_kernels.BODY_SEGMENTS + 2
            if self.shape is not None
            else self.n_vertices
        )

    @property
    def n_trunk_faces(self) -> int:
        """The leading faces that belong to the trunk, without ears, feet and tail."""
        return (
            2 * (len(self.stations) - 2) * skinning_kernels.BODY_SEGMENTS
            if self.shape is not None
            else len(self.faces)
        )

    @property
    def area_mm2(self) -> float:
        """Approximate area of the home pose seen from above, mm^2 at scale 1.

        Of capsules: their horizontal lengths times the sum of their radii at the ends; of a tube:
        its width integrated along the spine; of a mesh: its silhouette.
        """
        if self.mesh is not None:
            return self._silhouette_mm2()
        if self.capsules is not None:
            home = Pose.home(self.skeleton).joints(self.skeleton)
            first, last = (home[self.capsules.joints[:, k]] for k in range(2))
            along = np.linalg.norm((last - first)[:, :2], axis=-1)
            return float((along * self.capsules.radii.sum(axis=-1)).sum())
        assert self.shape is not None
        return float(
            np.trapezoid(2.0 * self.shape.half_width, self.stations * self.skeleton.length)
        )

    def _silhouette_mm2(self) -> float:
        """The area of the home pose from above, counted in the image of a very distant camera."""
        mesh = self.vertices(Pose.home(self.skeleton))
        reach = float(np.abs(mesh).max())
        camera = Camera(
            _FAR * _SILHOUETTE_PX / 2,
            _FAR * _SILHOUETTE_PX / 2,
            _SILHOUETTE_PX / 2,
            _SILHOUETTE_PX / 2,
            _SILHOUETTE_PX,
            _SILHOUETTE_PX,
        )
        above = SE3(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, _FAR * reach]))
        seen = render_mesh(mesh, self.faces, camera, T_camera_mesh=above) > 0
        return float(seen.sum()) * (2.0 * reach / _SILHOUETTE_PX) ** 2

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
            bends: (n, TAIL_RINGS) rad, the tail's turn at each ring; None is straight.
            parallel: whether to use all threads.

        Returns:
            (..., V, 3) mm.
        """
        frames = pose.frames(self.skeleton)
        batch = frames.translation.shape[:-2]
        joints = np.ascontiguousarray(frames.translation).reshape(-1, self.skeleton.n_joints, 3)
        n = len(joints)
        size = (
            np.broadcast_to(pose.scale if girth is None else girth, batch).astype(float).reshape(n)
        )
        rotations = np.ascontiguousarray(frames.rotation).reshape(n, self.skeleton.n_joints, 3, 3)
        if self.mesh is not None:
            own = shape if isinstance(shape, MeshBody) else self.mesh
            scale = np.broadcast_to(pose.scale, batch).astype(float).reshape(n)
            with threads(parallel):
                return own.vertices(self.skeleton, rotations, joints, scale, size).reshape(
                    *batch, -1, 3
                )
        if self.capsules is not None:
            flesh = shape if isinstance(shape, Capsules) else self.capsules
            scale = np.broadcast_to(pose.scale, batch).astype(float).reshape(n)
            with threads(parallel):
                return flesh.vertices(rotations, joints, scale, size).reshape(*batch, -1, 3)
        assert self.shape is not None
        out = np.empty((n, self.n_vertices, 3))
        body = (shape if isinstance(shape, BodyShape) else self.shape.bare()).broadcast(n)
        turns = (
            np.zeros((n, skinning_kernels.TAIL_RINGS))
            if bends is None
            else np.asarray(bends, float)
        )
        bodies = skinning_kernels.TubeBodies(
            body.half_width, body.half_height, body.power, body.blobs, body.tail
        )
        with threads(parallel and n > _FEW):
            in_parallel(
                skinning_kernels.skin_tubes,
                n,
                joints,
                rotations,
                size,
                self.stations,
                bodies,
                turns,
                out,
            )
        return out.reshape(*batch, -1, 3)

    def render(
        self,
        pose: Pose,
        camera: Camera,
        window: Window | None = None,
        shape: BodyShape | None = None,
        T_camera_pose: SE3 | None = None,
        **skinning: Array | float | None,
    ) -> NDArray[np.float32]:
        """Depth image of one pose alone; see `vertices` and `render_mesh`.

        Args:
            pose: one pose.
            camera: the ideal pinhole camera.
            window: (u0, v0, width, height) px of the image; None for the full image.
            shape: the animal; None is the default animal without ears, feet and tail.
            T_camera_pose: transforms the pose's frame to the camera's; None if they are the same.
            **skinning: girth, bends and parallel of `vertices`.

        Returns:
            (H, W) float32 mm, 0 outside the animal.
        """
        mesh = self.vertices(pose, shape, **skinning)  # type: ignore[arg-type]
        return render_mesh(mesh, self.faces, camera, window, T_camera_pose)


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
    u0, v0, width, height = (0, 0, camera.width, camera.height) if window is None else window
    check_shapes("a mesh", ("vertices", vertices, ("V", 3)), ("faces", faces, ("F", 3)))
    check_index("vertices", faces, len(vertices))
    inverse = np.zeros((height, width))
    depth = np.empty((height, width), np.float32)
    rasterizer_kernels.draw(
        np.ascontiguousarray(vertices),
        faces,
        T.rotation,
        T.translation,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        float(u0),
        float(v0),
        inverse,
    )
    rasterizer_kernels.to_depth(inverse, depth)
    return depth


def render_meshes(
    vertices: Array,
    faces: NDArray[np.int32],
    T_camera_mesh: SE3,
    intrinsics: Array,
    origin: Array,
    size: tuple[int, int],
    parallel: bool = True,
) -> NDArray[np.float32]:
    """Depth images of many meshes, each by its own camera in its own window.

    Args:
        vertices: (n, V, 3) mm.
        faces: (F, 3) int32, shared.
        T_camera_mesh: (n) transforms from the meshes' frames to the cameras'.
        intrinsics: (n, 4) fx, fy, cx, cy px.
        origin: (n, 2) image pixel (u, v) at the window's top left.
        size: (width, height) px of the windows.
        parallel: whether to use all threads.

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
    with threads(parallel):
        in_parallel(
            rasterizer_kernels.draw_batch,
            n,
            vertices,
            faces,
            T_camera_mesh.rotation,
            T_camera_mesh.translation,
            np.asarray(intrinsics, float),
            np.asarray(origin, float),
            depth,
        )
    return depth


# Random variation of any animal's body: girth and proportions around its skeleton.


_WILD_SHARE = 0.6
_WAVES = (0.5, 1.0, 1.5, 2.0)  # cycles along the body


def vary_body(rng: np.random.Generator, skeleton: Skeleton, family: str, n: int) -> Body:
    """Draw n animals of a family around the body described by a skeleton's TOML.

    Args:
        rng: random generator.
        skeleton: with its [surface] table.
        family: 'train' varies it as individuals vary; most of 'augmented' varies more than
            individuals do, so that no forest relies on one exact profile; 'wide' varies all three
            times as much as 'train'; 'other' has builds outside of the first two: far slimmer or
            stouter, with the mass far forward or far back.
        n: animals.

    Returns:
        A batch (n,) of the skeleton's kind of body.

    Raises:
        LiexError: there is no such family, or the skeleton describes no surface.
    """
    if family not in FAMILIES:
        raise LiexError(f"there is no shape family '{family}'; choose one of {', '.join(FAMILIES)}")
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
    """Path lengths (J,) from the base to each joint, as shares of the longest."""
    reach = np.zeros(skeleton.n_joints)
    for parent, child in skeleton.edges:
        reach[child] = reach[parent] + np.linalg.norm(skeleton.offsets[child])
    return reach / reach.max()


def _factors(rng: np.random.Generator, along: Array, family: str, n: int) -> tuple[Array, Array]:
    """Factors (n, R) of width and height at positions `along` (R,) the body, from 0 to 1."""
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
