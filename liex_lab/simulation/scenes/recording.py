"""A rendered scene as a recording with the truth of every animal in it.

Frames are rendered on demand, in any order, from the seed: the still scene of the epoch, the
animals, their equipment and other moving objects, the sensor's model, and then effects of the whole
camera (warming up, mirroring). `visible` is the share of each animal's pixels in the ideal depth
image that are not occluded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.surface import Surface, render_mesh
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.recordings.frame import Depth
from liex_lab.scene.floor import Floor
from liex_lab.simulation import _render_kernels as render_kernels
from liex_lab.simulation._sensor_kernels import NORMAL, UNIT
from liex_lab.simulation.recording import TrueRecording
from liex_lab.simulation.scenes.cast import AWAY, Animal
from liex_lab.simulation.scenes.meshes import Mesh
from liex_lab.simulation.species import Species

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrueAnimal:
    """The truth of one animal of a recording of n frames.

    Attributes:
        spine_mm: its length, mm.
        joints_camera: (n, J, 3) mm, camera frame; NaN if absent.
        visible: (n,) visible share of it, 0 if absent.
    """

    spine_mm: float
    joints_camera: Array
    visible: Array


@dataclass(frozen=True)
class Moving:
    """A moving object other than an animal: worn, added, or held in a hand.

    Attributes:
        vertices: (m, V, 3) mm, arena frame, at m moments.
        faces: (F, 3) int32.
        moment: (n,) int64, index of the moment in each frame; -1 if absent.
    """

    vertices: Array
    faces: NDArray[np.int32]
    moment: NDArray[np.int64]

    @staticmethod
    def always(vertices: Array, faces: NDArray[np.int32], shown: NDArray[np.bool_]) -> Moving:
        """An object with its own moment in every frame.

        Args:
            vertices: (n, V, 3) mm, arena frame.
            faces: (F, 3) int32.
            shown: (n,) bool, its presence.
        """
        return Moving(vertices, faces, np.where(shown, np.arange(len(shown)), -1))

    @staticmethod
    def fixed(mesh: Mesh, shown: NDArray[np.bool_]) -> Moving:
        """An object that appears or disappears, but does not move.

        Args:
            mesh: its mesh.
            shown: (n,) bool, its presence.
        """
        return Moving(mesh.vertices[None], mesh.faces, np.where(shown, 0, -1))

    def placed(self, part: slice) -> Array:
        """Its vertices in some frames.

        Args:
            part: the frames.

        Returns:
            (k, V, 3) mm, arena frame; far behind the camera if absent.
        """
        moment = self.moment[part]
        return self.vertices[moment] + (moment < 0)[:, None, None] * AWAY


@dataclass(frozen=True)
class Stage:
    """The contents of a scene, n frames.

    Attributes:
        camera: the camera.
        T_arena_camera: its pose.
        species: the animals'.
        animals: all animals; a single track should follow the first.
        moving: other moving objects.
        stills: (E, H, W) float32 mm, the still scene by epoch, 0 = nothing.
        epoch: (n,) int64, the epoch of each frame.
        parameters: (N_PARAMETERS,) of the sensor.
        seeds: (n,) uint64, of its noise.
        offset_mm: (n,) error added to the sensor's depth, mm.
    """

    camera: Camera
    T_arena_camera: SE3
    species: Species
    animals: tuple[Animal, ...]
    moving: tuple[Moving, ...]
    stills: NDArray[np.float32]
    epoch: NDArray[np.int64]
    parameters: Array
    seeds: NDArray[np.uint64]
    offset_mm: Array


class TrueScene(TrueRecording):
    """A scene by name with the truth of all animals in it.

    Attributes:
        scene: name of the scene.
    """

    scene: str

    @cached_property
    def animals(self) -> tuple[TrueAnimal, ...]:
        """The truth of each animal; () if there are none."""
        raise NotImplementedError


class OneAnimal(TrueScene):
    """A recording of one fully visible animal as a scene, optionally mirrored."""

    def __init__(
        self, name: str, scene: str, filmed: TrueRecording, *, mirrored: bool = False
    ) -> None:
        """Wrap a recording as a scene.

        Args:
            name: of the recording.
            scene: name of the scene.
            filmed: the recording of one animal.
            mirrored: exchange left and right in every depth image, and in the truth.
        """
        c = filmed.camera
        camera = replace(c, cx=c.width - 1.0 - c.cx) if mirrored else c
        super().__init__(
            name=name,
            format="synthetic",
            camera=camera,
            times_ns=filmed.times_ns.copy(),
            read=lambda index: self.depths(index, index + 1)[0],
        )
        self.scene = scene
        self._filmed = filmed
        self._mirrored = mirrored
        for fact in ("skeleton", "surface", "spine_mm", "pose", "T_arena_camera", "floor"):
            setattr(self, fact, getattr(filmed, fact))
        across = np.array([-1.0 if mirrored else 1.0, 1.0, 1.0])
        self.joints_camera = filmed.joints_camera * across
        self.joints_arena = self.T_arena_camera @ self.joints_camera

    @cached_property
    def animals(self) -> tuple[TrueAnimal, ...]:
        """The truth of the one animal."""
        return (TrueAnimal(self.spine_mm, self.joints_camera, np.ones(len(self))),)

    def depths(self, start: int, stop: int) -> NDArray[np.float32]:
        """Depth images of a range of frames, rendered on all threads.

        Args:
            start: first frame.
            stop: one past the last frame.

        Returns:
            (stop - start, H, W) float32 mm, 0 if unread.
        """
        depths = self._filmed.depths(start, stop)
        return np.ascontiguousarray(depths[..., ::-1]) if self._mirrored else depths


class SceneRecording(TrueScene):
    """A scene of mice from a recipe.

    Attributes:
        stage: its contents.
    """

    def __init__(self, name: str, scene: str, stage: Stage) -> None:
        """Record a stage.

        Args:
            name: of the recording.
            scene: name of the scene.
            stage: its contents.
        """
        n = len(stage.seeds)
        times = np.arange(n, dtype=np.int64) * stage.species.frame_ns
        super().__init__(
            name=name, format="synthetic", camera=stage.camera, times_ns=times, read=self._depth
        )
        self.scene = scene
        self.stage = stage
        self.skeleton = stage.species.skeleton
        self.surface = Surface.of(self.skeleton)
        self.T_arena_camera = stage.T_arena_camera
        self.floor = Floor.from_plane(
            -self.T_arena_camera.rotation[2],
            float(self.T_arena_camera.translation[2]),
            stage.camera,
        )
        if stage.animals:
            first = stage.animals[0]
            self.spine_mm = first.spine_mm
            self.pose = first.pose.moved(self.T_arena_camera.inverse())
        else:
            self.spine_mm = self.skeleton.length
            self.pose = Pose.home(self.skeleton, n)
        self.joints_camera = self.pose.joints(self.skeleton)
        self.joints_arena = self.T_arena_camera @ self.joints_camera

    @cached_property
    def animals(self) -> tuple[TrueAnimal, ...]:
        """The truth of each animal, computed on demand; () if there are none."""
        return tuple(self._truth(animal) for animal in self.stage.animals)

    def _truth(self, animal: Animal) -> TrueAnimal:
        joints = self.T_arena_camera.inverse() @ animal.pose.joints(self.skeleton)
        joints[~animal.present] = np.nan
        return TrueAnimal(animal.spine_mm, joints, self._visible(animal))

    def _visible(self, animal: Animal) -> Array:
        """Share (n,) of an animal's pixels that are inside the image and not occluded."""
        stage = self.stage
        T_camera_arena = self.T_arena_camera.inverse()
        others = [other for other in stage.animals if other is not animal]
        share = np.zeros(len(stage.seeds))
        c = stage.camera
        left = c.width // 4
        top = c.height // 4
        around = (-left, -top, c.width + 2 * left, c.height + 2 * top)
        for i in np.flatnonzero(animal.present):
            part = slice(i, i + 1)
            mesh = animal.vertices(self.surface, part)[0]
            whole = render_mesh(mesh, self.surface.faces, c, around, T_camera_arena)
            own = whole[top : top + c.height, left : left + c.width]
            before = [
                render_mesh(
                    thing.placed(part)[0], thing.faces, stage.camera, T_camera_mesh=T_camera_arena
                )
                for thing in stage.moving
                if thing.moment[i] >= 0
            ]
            before += [
                render_mesh(
                    other.vertices(self.surface, part)[0],
                    self.surface.faces,
                    stage.camera,
                    T_camera_mesh=T_camera_arena,
                )
                for other in others
                if other.present[i]
            ]
            seen = own > 0
            for depth in (stage.stills[stage.epoch[i]], *before):
                seen &= (depth == 0) | (own < depth + 2.0)
            share[i] = seen.sum() / max(int((whole > 0).sum()), 1)
        return share

    def _depth(self, index: int) -> Depth:
        return self.depths(index, index + 1)[0]

    def depths(self, start: int, stop: int) -> NDArray[np.float32]:
        """Depth images of a range of frames, rendered on all threads.

        Args:
            start: first frame.
            stop: one past the last frame.

        Returns:
            (stop - start, H, W) float32 mm, 0 if unread.
        """
        stage = self.stage
        out = np.empty((stop - start, stage.camera.height, stage.camera.width), np.float32)
        for epoch in np.unique(stage.epoch[start:stop]):
            rows = start + np.flatnonzero(stage.epoch[start:stop] == epoch)
            part = slice(int(rows[0]), int(rows[-1]) + 1)  # an epoch is a stretch of frames
            out[part.start - start : part.stop - start] = self._render(part, int(epoch))
        return out

    def _render(self, part: slice, epoch: int) -> NDArray[np.float32]:
        """Depth images of consecutive frames of one epoch."""
        stage = self.stage
        c = stage.camera
        n = part.stop - part.start
        animals, faces = _together(
            n, [(a.vertices(self.surface, part), self.surface.faces) for a in stage.animals]
        )
        things, thing_faces = _together(
            n, [(thing.placed(part), thing.faces) for thing in stage.moving]
        )
        out = np.empty((n, c.height, c.width), np.uint16)
        T_camera_arena = self.T_arena_camera.inverse()
        render_kernels.frames_parallel(
            stage.stills[epoch],
            render_kernels.Meshes(animals, faces, things, thing_faces, np.ones(n, np.bool_)),
            np.ascontiguousarray(T_camera_arena.rotation),
            T_camera_arena.translation,
            np.array([c.fx, c.fy, c.cx, c.cy]),
            render_kernels.SensorNoise(
                np.tile(stage.parameters, (n, 1)), stage.seeds[part], NORMAL
            ),
            out,
        )
        depth = out * np.float32(stage.parameters[UNIT])
        offset = stage.offset_mm[part]
        if offset.any():
            shifted = np.round(depth + offset[:, None, None].astype(np.float32))
            depth = np.where(depth > 0, shifted, 0.0).astype(np.float32)
        return depth


def _together(
    n: int, parts: Sequence[tuple[Array, NDArray[np.int32]]]
) -> tuple[Array, NDArray[np.int32]]:
    """Join several meshes of n frames."""
    if not parts:
        return np.zeros((n, 3, 3)), np.zeros((0, 3), np.int32)
    starts = np.cumsum([0, *(vertices.shape[1] for vertices, _ in parts)])
    faces = [f + np.int32(start) for (_, f), start in zip(parts, starts, strict=False)]
    return (
        np.ascontiguousarray(np.concatenate([vertices for vertices, _ in parts], axis=1)),
        np.concatenate(faces).astype(np.int32),
    )
