"""The surface around a skeleton as a triangle mesh, and its depth image.

A skeleton's [surface] table defines its kind: `stations` with half widths and heights make a tube
along one chain of joints, a generalised cylinder with superelliptic cross-sections (the mouse);
`radii_mm` a tapered capsule around every bone and `capsules` additional ones (any other animal);
`mesh` is the file of the user's own body, deformed by linear blend skinning. Depth is rendered with
a z-buffer, see `_rasterizer_kernels`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body import _rasterizer_kernels as rasterizer_kernels
from liex_lab.body import _skinning_kernels as skinning_kernels
from liex_lab.body.pose import Pose
from liex_lab.body.shape import Body, BodyShape, Capsules, MeshBody
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError, one_line
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.runtime.memory import check_index, check_shapes
from liex_lab.runtime.processes import in_parallel, threads

Array = NDArray[np.float64]
Window = tuple[int, int, int, int]
# distance of the silhouette's camera, in reaches of the body, and size of its image, px
_FAR = 50.0
_SILHOUETTE_PX = 400


@dataclass(frozen=True)
class Surface:
    """A mesh of fixed topology that follows a skeleton.

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
        n_rings = len(self.stations) - 2
        return n_rings * skinning_kernels.BODY_SEGMENTS + 2 if n_rings > 0 else self.n_vertices

    @property
    def n_trunk_faces(self) -> int:
        """The leading faces that belong to the trunk, without ears, feet and tail."""
        n_rings = len(self.stations) - 2
        return 2 * n_rings * skinning_kernels.BODY_SEGMENTS if n_rings > 0 else len(self.faces)

    @property
    def area_mm2(self) -> float:
        """Approximate area of the home pose seen from above, mm^2 at scale 1.

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
            bends: (n, TAIL_RINGS) rad, the tail's turn at each ring; None is straight.
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
            straight = np.zeros((n, skinning_kernels.TAIL_RINGS))
            out = np.empty((n, self.n_vertices, 3))
            in_parallel(
                skinning_kernels.skin_tubes,
                n,
                joints,
                rotations,
                across,
                self.stations,
                skinning_kernels.TubeBodies(
                    tube.half_width, tube.half_height, tube.power, tube.blobs, tube.tail
                ),
                straight if bends is None else np.asarray(bends, float),
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
        camera.intrinsics,
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
        vertices,
        faces,
        T_camera_mesh.rotation,
        T_camera_mesh.translation,
        np.asarray(intrinsics, float),
        np.asarray(origin, float),
        depth,
    )
    return depth
