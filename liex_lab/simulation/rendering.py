"""Depth images of labelled meshes before a still scene, through a sensor, on all threads."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.runtime.memory import Rows
from liex_lab.runtime.processes import in_parallel
from liex_lab.simulation import _render_kernels as kernels
from liex_lab.simulation._sensor_kernels import NORMAL, OBJECT


@dataclass(frozen=True)
class Solid(Rows):
    """A labelled mesh in n frames: a body, something it wears, a distractor.

    Attributes:
        faces: (F, 3) int32 triangles.
        moment: (n,) int64 index of its shape in each frame; -1 if absent.
        mesh: gives the vertices (k, V, 3), mm, arena frame, at k indices.
        label: kind of its pixels, ANIMAL or OBJECT.
    """

    SHARED = ("faces",)
    faces: NDArray[np.int32]
    moment: NDArray[np.int64]
    mesh: Callable[[NDArray[np.int64]], Array]
    label: int = OBJECT

    @staticmethod
    def of(
        vertices: Array,
        faces: NDArray[np.int32],
        shown: NDArray[np.bool_] | None = None,
        label: int = OBJECT,
    ) -> "Solid":
        """A mesh with its own shape in every frame, or one that only appears and disappears.

        Args:
            vertices: (n, V, 3) or (V, 3) mm, arena frame.
            faces: (F, 3) triangles.
            shown: (n,) its presence; None for always.
            label: kind of its pixels.
        """
        shown = np.ones(len(vertices), np.bool_) if shown is None else shown
        moment = np.arange(len(shown)) if vertices.ndim == 3 else np.zeros(len(shown), np.int64)
        shapes = vertices.reshape(-1, *vertices.shape[-2:])
        return Solid(faces, np.where(shown, moment, -1), shapes.__getitem__, label)

    def vertices(self) -> Array:
        """Its vertices (n, V, 3) mm, arena frame; any shape where it is absent."""
        return self.mesh(np.maximum(self.moment, 0))


@dataclass(frozen=True)
class Views(Rows):
    """Cameras before still scenes, n of them.

    Attributes:
        intrinsics: (n, 4) fx, fy, cx, cy of the whole images, px.
        size_px: (n, 2) int64, their width and height, px.
        T_arena_camera: (n) poses.
        parameters: (n, N_PARAMETERS) of the units' sensors.
        ground: (n, N_GROUND) floor and wall to ray-cast, columns as in `_render_kernels`.
        floor: (n, 3) plane 1 / z = a u + b v + c in pixels of the whole image, as estimated.
    """

    intrinsics: Array
    size_px: NDArray[np.int64]
    T_arena_camera: SE3
    parameters: Array
    ground: Array
    floor: Array

    @staticmethod
    def of(camera: Camera, T_arena_camera: SE3, parameters: Array, ground: Array) -> "Views":
        """One camera n times."""
        n = len(parameters)
        intrinsics = np.tile(camera.intrinsics, (n, 1))
        size_px = np.tile(np.array([camera.width, camera.height]), (n, 1))
        T = T_arena_camera[None][np.zeros(n, np.int64)]
        return Views(intrinsics, size_px, T, parameters, ground, np.zeros((n, 3)))

    def around(
        self, bodies: Array, window_px: int, shift: Array | float = 0.5
    ) -> NDArray[np.int64]:
        """Square patches around the middles of the bounding boxes of bodies.

        Args:
            bodies: (n, V, 3) vertices, mm, arena frame.
            window_px: side of the patches, px.
            shift: (n, 2) px, before rounding down.

        Returns:
            (n, 2) pixels (u, v) of the whole image at patch pixel (0, 0), which may be outside.
        """
        T = self.T_arena_camera.inverse()
        p = np.einsum("nij,nvj->nvi", T.rotation, bodies) + T.translation[:, None]
        uv = p[..., :2] / p[..., 2:] * self.intrinsics[:, None, :2] + self.intrinsics[:, None, 2:]
        middle = (uv.min(axis=1) + uv.max(axis=1)) / 2.0
        return np.floor(middle - window_px / 2.0 + shift).astype(np.int64)

    def render(
        self,
        solids: Sequence[Solid],
        seeds: NDArray[np.uint64],
        origin: NDArray[np.int64],
        shape: tuple[int, int],
        still: tuple[NDArray[np.float32], NDArray[np.int64]] | None = None,
        learn: bool = False,
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Render depth images, or patches of them.

        Args:
            solids: everything that is not part of the still scene, n frames.
            seeds: (n,) of the sensors' noise.
            origin: (n, 2) pixel (u, v) of the whole image at (0, 0) of the patch.
            shape: rows and columns of the patch.
            still: ideal depth (E, *shape) mm of still scenes, 0 for nothing, and the index of each
                image's (n,); None casts rays at `ground`.
            learn: whether to draw learned backgrounds.

        Returns:
            Depth (n, *shape) in the sensors' units, 0 if unread, and the learned backgrounds
            likewise, or none of them.
        """
        n = len(seeds)
        T = self.T_arena_camera.inverse()
        out = np.empty((n, *shape), np.uint16)
        learned = np.empty((n if learn else 0, *shape), np.uint16)
        meshes = [solid.vertices() for solid in solids] or [np.zeros((n, 0, 3))]
        faces = [solid.faces for solid in solids] or [np.zeros((0, 3), np.int32)]
        counts = [(mesh.shape[1], len(own)) for mesh, own in zip(meshes, faces, strict=True)]
        stills, epoch = still or (np.zeros((0, *shape), np.float32), np.full(n, -1))
        in_parallel(
            kernels.draw_frames,
            n,
            kernels.Parts(
                np.ascontiguousarray(np.concatenate(meshes, axis=1)),
                np.concatenate(faces),
                np.cumsum([(0, 0), *counts], axis=0),
                np.array([solid.moment >= 0 for solid in solids]).reshape(-1, n).T.copy(),
                np.array([solid.label for solid in solids], np.uint8),
            ),
            kernels.PatchCamera(
                self.intrinsics,
                self.size_px,
                origin,
                np.ascontiguousarray(T.rotation),
                np.ascontiguousarray(T.translation),
            ),
            kernels.Backdrop(stills, epoch, self.ground),
            kernels.SensorNoise(self.parameters, seeds, NORMAL),
            out,
            learned,
        )
        return out, learned


def inverse_depth(normal: Array, distance: Array, intrinsics: Array) -> Array:
    """Coefficients a, b, c of 1 / z = a u + b v + c for planes.

    With the plane's normal n and distance d in the camera frame, n . p = d: a = n_x / (fx d), b =
    n_y / (fy d) and c = n_z / d - a cx - b cy.

    Args:
        normal: (n, 3).
        distance: (n,) mm, for a unit normal; else in proportion to it.
        intrinsics: (n, 4) fx, fy, cx, cy, px.

    Returns:
        (n, 3) in 1/mm per pixel and 1/mm.
    """
    a, b = (normal[:, k] / intrinsics[:, k] / distance for k in range(2))
    c = normal[:, 2] / distance - a * intrinsics[:, 2] - b * intrinsics[:, 3]
    return np.column_stack([a, b, c])
