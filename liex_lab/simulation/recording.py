"""Virtual depth recordings with exact truth: animals and objects before a still scene.

A `Stage` holds everything before the camera in n frames: the still scene, the animals (`Actor`) and
other labelled meshes over time (`Solid`), the sensor's parameters and a seed for each frame. A
`RenderedRecording` renders it on demand, in any order, with the truth of every animal. `SPLITS` are
the fixed splits for which accuracy is reported: 'clean', 'hard' (twice the noise, an eroded
outline, other objects), 'other-body' (builds not used in training), 'other-camera' (focal lengths
and resolutions not used in training), and the held-out split 'sealed'.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import Pose
from liex_lab.body.shape import Surface, render_mesh
from liex_lab.body.skeleton import Skeleton
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.memory import Rows
from liex_lab.scene.floor import Floor
from liex_lab.simulation._render_kernels import N_GROUND
from liex_lab.simulation._sensor_kernels import ANIMAL, MOTION_U, MOTION_V, UNIT
from liex_lab.simulation.corruptions import Event, Loss
from liex_lab.simulation.rendering import Solid, Views
from liex_lab.simulation.scene import OBJECT_FACES, SimulatedScene, draw_object
from liex_lab.simulation.sensors import Sensor

FRAME_NS = 33_333_333
OTHER_CAMERA = "other-camera"  # focal lengths and resolutions not used in training
Split = tuple[int, Mapping[str, Any]]
# name: (own seed, settings, see `Take`)
SPLITS: Mapping[str, Split] = {
    "clean": (71_001, {}),
    "hard": (72_001, {"noise": 2.0, "erosion_px": 1, "object_share": 0.5}),
    "other-body": (74_001, {"family": "other"}),
    OTHER_CAMERA: (75_001, {}),
}
# held-out recordings, not used in tests, training or development: evaluated once per release. They
# are like the splits above in turn, each with its own seed
SEALED = "sealed"
SEALED_SEED = 970_413


@dataclass(frozen=True)
class Take:
    """Settings of a recording of animals before one camera.

    Attributes:
        n_frames: its length, at the species' rate.
        sensor: the camera's make.
        moving: whether the animal moves; else postures and places are independent.
        family: of body shapes, see `body.variation`.
        noise: multiplies the sensor's random errors and its rate of holes.
        erosion_px: pixels of the image stripped off the animal's outline.
        object_share: share of frames with a distractor.
        spine_mm: length of the animals, mm; None draws it.
        name: of the recording; '' names it after the animal.
    """

    n_frames: int
    sensor: Sensor
    moving: bool = False
    family: str = "train"
    noise: float = 1.0
    erosion_px: int = 0
    object_share: float = 0.0
    spine_mm: float | None = None
    name: str = ""

    def parameters(self, rng: np.random.Generator, fur: Array) -> Array:
        """Parameters of a unit of the sensor in each frame, (n_frames, N_PARAMETERS).

        Args:
            rng: random number generator.
            fur: (1,) of the animal, from 0 to 1.
        """
        unit = self.sensor.draw(rng, 1, fur, self.noise, self.erosion_px * self.sensor.stride)
        return np.repeat(unit, self.n_frames, axis=0)


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
class Actor(Rows):
    """An animal in n frames.

    Attributes:
        surface: its skeleton and mesh model.
        spine_mm: its length, mm.
        body: its body, a `Body` as a batch of one.
        pose: (n) arena frame.
        girth: (n,) factor of all lengths across the body.
        bends: (n, TAIL_RINGS) bends of its tail, rad; None without a separate tail.
        present: (n,) bool, whether it is in the arena.
    """

    SHARED: ClassVar[tuple[str, ...]] = ("body",)
    surface: Surface
    spine_mm: float
    body: Any
    pose: Pose
    girth: Array
    bends: Array | None
    present: NDArray[np.bool_]

    @property
    def joints(self) -> Array:
        """Its joints (n, J, 3) mm, arena frame."""
        return self.pose.joints(self.surface.skeleton)

    @property
    def solids(self) -> tuple[Solid, ...]:
        """Its body, and any other parts that sensors read as its own."""

        def mesh(rows: NDArray[np.int64]) -> Array:
            bends = None if self.bends is None else self.bends[rows]
            return self.surface.vertices(self.pose[rows], self.body[0], self.girth[rows], bends)

        moment = np.where(self.present, np.arange(len(self.present)), -1)
        return (Solid(self.surface.faces, moment, mesh, ANIMAL),)


@dataclass(frozen=True)
class Stage(Rows):
    """Everything before a camera in n frames.

    Attributes:
        scene: the still scene and its camera.
        skeleton: of the animals.
        actors: the animals; a single track should follow the first.
        objects: other meshes.
        parameters: (n, N_PARAMETERS) of the sensor.
        seeds: (n,) uint64, of its noise.
        times_ns: (n,) int64 time stamps, ns.
        stills: (E, H, W) float32 mm, ideal depth of still scenes, 0 for nothing.
        epoch: (n,) int64, the still scene of each frame.
        ground: (n, N_GROUND) a background to ray-cast instead.
        offset_mm: (n,) error added to the sensor's depth, mm.
    """

    SHARED = ("stills",)
    scene: SimulatedScene
    skeleton: Skeleton
    actors: tuple[Actor, ...]
    objects: tuple[Solid, ...]
    parameters: Array
    seeds: NDArray[np.uint64]
    times_ns: NDArray[np.int64]
    stills: NDArray[np.float32]
    epoch: NDArray[np.int64]
    ground: Array | None = None
    offset_mm: Array | None = None

    def __getitem__(self, index: Any) -> Self:
        """Some frames, by mask, numbers or slice."""
        actors = tuple(actor[index] for actor in self.actors)
        objects = tuple(solid[index] for solid in self.objects)
        return replace(super().__getitem__(index), actors=actors, objects=objects)

    @cached_property
    def solids(self) -> list[Solid]:
        """All meshes."""
        return [*(solid for actor in self.actors for solid in actor.solids), *self.objects]

    def depths(self) -> NDArray[np.float32]:
        """Depth images (n, H, W) mm of all frames, 0 if unread."""
        n = len(self.seeds)
        c = self.scene.camera
        ground = np.zeros((n, N_GROUND)) if self.ground is None else self.ground
        still = (self.stills, self.epoch) if self.ground is None else None
        views = Views.of(c, self.scene.T_arena_camera, self.parameters, ground)
        origin = np.zeros((n, 2), np.int64)
        out, _ = views.render(self.solids, self.seeds, origin, (c.height, c.width), still)
        depths = out * np.float32(self.parameters[0, UNIT])
        if self.offset_mm is not None:
            shifted = np.round(depths + self.offset_mm[:, None, None].astype(np.float32))
            depths = np.where(depths > 0, shifted, 0.0).astype(np.float32)
        return depths


def in_motion(stage: Stage, exposure_ms: float) -> Stage:
    """The stage with the motion of its fastest animal during each exposure of the sensor.

    Args:
        stage: of n frames in order of time.
        exposure_ms: of one depth image, ms; 0 returns the stage as it is.
    """
    if not (exposure_ms and stage.actors and len(stage.seeds) > 1):
        return stage
    T_camera_arena = stage.scene.T_arena_camera.inverse()
    at = [
        stage.scene.camera.project(T_camera_arena @ actor.joints.mean(axis=1))
        for actor in stage.actors
    ]
    moved = np.array([np.gradient(path, axis=0) for path in at])  # px per frame
    fastest = np.argmax(np.linalg.norm(moved, axis=-1), axis=0)
    frame_ms = float(np.median(np.diff(stage.times_ns))) * 1e-6
    parameters = stage.parameters.copy()
    parameters[:, [MOTION_U, MOTION_V]] = (
        moved[fastest, np.arange(len(fastest))] * exposure_ms / frame_ms
    )
    return replace(stage, parameters=parameters)


class RenderedRecording(Recording):
    """A virtual recording and its truth, rendered on demand.

    Attributes:
        stage: everything before the camera.
        events: its corruptions, in order of their start.
        skeleton: of the animals.
        spine_mm: size of the first animal, mm.
        pose: (n) its root T_camera_root, angles and scale.
        joints_camera: (n, J, 3) its joints, mm, camera frame.
        joints_arena: (n, J, 3) its joints, mm, arena frame.
        T_arena_camera: exact transform from the camera frame into the arena frame.
        floor: the exact floor plane, or its substitute.
    """

    def __init__(
        self,
        name: str,
        stage: Stage,
        *,
        mirrored: bool = False,
        loss: Loss | None = None,
    ) -> None:
        """Record a stage.

        Args:
            name: of the recording.
            stage: everything before the camera.
            mirrored: exchange left and right, of a camera without lens distortion.
            loss: readings that are lost in its frames.
        """
        camera = stage.scene.camera
        if mirrored:
            camera = replace(camera, cx=camera.width - 1.0 - camera.cx)
        super().__init__(
            name=name,
            format="synthetic",
            camera=camera,
            times_ns=stage.times_ns,
            read=lambda index: self.depths(index, index + 1)[0],
        )
        self.stage = stage
        self.events: list[Event] = []
        self._loss = loss
        self._sides = np.array([-1.0 if mirrored else 1.0, 1.0, 1.0])
        self.skeleton = stage.skeleton
        self.T_arena_camera = T = stage.scene.T_arena_camera
        self.floor = Floor.from_plane(-T.rotation[2], float(T.translation[2]), camera)
        self.spine_mm = stage.skeleton.length
        self.pose = Pose.home(stage.skeleton, len(stage.seeds))
        self.joints_camera = self.pose.joints(stage.skeleton)
        if stage.actors:
            self.spine_mm = stage.actors[0].spine_mm
            self.pose = stage.actors[0].pose.moved(T.inverse())
            self.joints_camera = self._sides * (T.inverse() @ stage.actors[0].joints)
        self.joints_arena = T @ self.joints_camera

    @cached_property
    def animals(self) -> tuple[TrueAnimal, ...]:
        """The truth of each animal, computed on demand; () if there are none."""
        return tuple(self._truth(actor) for actor in self.stage.actors)

    def _truth(self, actor: Actor) -> TrueAnimal:
        joints = self._sides * (self.T_arena_camera.inverse() @ actor.joints)
        there = actor.present
        share = np.zeros(len(self))
        share[there] = self.visible(actor, np.flatnonzero(there))
        return TrueAnimal(actor.spine_mm, np.where(there[:, None, None], joints, np.nan), share)

    def visible(self, actor: Actor, rows: NDArray[np.int64]) -> Array:
        """Share of an animal's body that is inside the image and not occluded.

        Args:
            actor: one of the stage's.
            rows: (k,) frames in which it is present.

        Returns:
            (k,) shares of its pixels.
        """
        c = self.stage.scene.camera
        T = self.T_arena_camera.inverse()
        left, top = c.width // 4, c.height // 4
        around = (-left, -top, c.width + 2 * left, c.height + 2 * top)
        own, *parts = actor.solids
        others = [one for one in self.stage.actors if one is not actor]
        before = [*parts, *self.stage.objects, *(part for one in others for part in one.solids)]
        share = np.empty(len(rows))
        for k, i in enumerate(rows):
            whole = render_mesh(own[i : i + 1].vertices()[0], own.faces, c, around, T)
            mine = whole[top : top + c.height, left : left + c.width]
            depths = [
                render_mesh(solid[i : i + 1].vertices()[0], solid.faces, c, T_camera_mesh=T)
                for solid in before
                if solid.moment[i] >= 0
            ]
            if self.stage.ground is None:
                depths.append(self.stage.stills[self.stage.epoch[i]])
            clear = mine > 0
            for depth in depths:
                clear &= (depth == 0) | (mine < depth + 2.0)
            share[k] = clear.sum() / max(int((whole > 0).sum()), 1)
        return share

    def depths(self, start: int, stop: int) -> NDArray[np.float32]:
        """Depth images of a range of frames, rendered on all threads.

        Args:
            start: first frame.
            stop: one past the last frame.

        Returns:
            (stop - start, H, W) float32 mm, 0 if unread.
        """
        depths = self.stage[start:stop].depths()
        if self._loss is not None:
            middle = self.joints_camera.mean(axis=1)
            camera = self.stage.scene.camera
            reach = 1.2 * self.spine_mm * camera.fx / middle[:, 2]
            still = None if self.stage.ground is not None else self.stage.scene.still
            at = camera.project(middle)
            self._loss.apply(depths, still, start, self.stage.seeds, at, reach)
        return np.ascontiguousarray(depths[..., ::-1]) if self._sides[0] < 0 else depths

    def chunks(
        self, n_frames: int, first: int = 0, stop: int | None = None
    ) -> Iterator[list[DepthFrame]]:
        """The frames in lists, each list rendered on all threads.

        Args:
            n_frames: frames per list; the last may be shorter.
            first: first frame.
            stop: one past the last frame; None for all.

        Yields:
            Lists of depth frames in order of time.
        """
        end = len(self) if stop is None else min(stop, len(self))
        for start in range(first, end, n_frames):
            rows = range(start, min(start + n_frames, end))
            depths = self.depths(rows.start, rows.stop)
            yield [DepthFrame(i, int(self.times_ns[i]), depths[i - start]) for i in rows]


def distractor(
    rng: np.random.Generator,
    scene: SimulatedScene,
    kind: str,
    trunk: Array,
    spine_mm: float,
    scale: float,
    take: Take,
) -> Solid:
    """One object for a recording, at a free position of its own in a share of the frames.

    Args:
        rng: random number generator.
        scene: the still scene.
        kind: of object, see `draw_object`.
        trunk: (n, V, 3) vertices of the animal, mm, arena frame.
        spine_mm: length of the animal, mm.
        scale: of the surroundings, see `SceneSpec`.
        take: the sensor and the share of frames with an object.
    """
    mesh = draw_object(rng, kind, spine_mm)
    n = len(trunk)
    shift = np.zeros((n, 3))
    shown = rng.random(n) < take.object_share
    reach = 1.1 * scene.half
    for i in np.flatnonzero(shown):
        own = trunk[i, ::3, :2]
        for _ in range(40):
            shift[i, :2] = scene.centre + rng.uniform(-1.0, 1.0, 2) * reach
            gap = np.linalg.norm((mesh[::3, None] + shift[i])[..., :2] - own, axis=-1).min()
            # a hand reaches over the wall; other objects are inside
            within = mesh[:, 2].max() > 0.6 * spine_mm or scene.wall_clearance(shift[i, :2]) > 0
            apart = gap > 8.0 * scale and within
            if apart and not _covers(scene, mesh + shift[i], trunk[i], 4.0 * take.sensor.stride):
                break
        else:
            shown[i] = False
    return Solid(
        OBJECT_FACES, np.where(shown, np.arange(n), -1), lambda rows: mesh + shift[rows, None]
    )


def _covers(scene: SimulatedScene, item: Array, trunk: Array, margin_px: float) -> bool:
    """Whether the distractor and the animal overlap in the image, or nearly so."""
    T_camera_arena = scene.T_arena_camera.inverse()
    a, b = (scene.camera.project(T_camera_arena @ points) for points in (item, trunk))
    gap = np.linalg.norm(a[::3, None] - b[None, ::3], axis=-1).min()
    middle = b.mean(axis=0)
    around = (a.min(axis=0) < middle).all() and (a.max(axis=0) > middle).all()
    return bool(gap < margin_px or around)


def split_of(name: str, k: int) -> str:
    """The kind of recording k of a split: the split itself; for 'sealed', each split in turn.

    Args:
        name: of the split.
        k: number of the recording.
    """
    return tuple(SPLITS)[k % len(SPLITS)] if name == SEALED else name
