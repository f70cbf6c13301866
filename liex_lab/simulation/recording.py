"""Synthetic depth recordings with exact truth: a posed mesh in an arena through a sensor model.

A `SyntheticSession` ray-casts the floor and walls once, rasterises the animal's mesh frame by frame
with a z-buffer, and passes each ideal depth image through the sensor's noise model. Frames are
rendered on demand from a seed, in any order. `SPLITS` are the fixed splits for which accuracy is
reported: 'clean', 'hard' (twice the noise, an eroded outline, other objects), 'other-body'
(builds not used in training), 'other-camera' (focal lengths and resolutions not used in training),
and the held-out split 'sealed'.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import Body, Surface
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.memory import Rows
from liex_lab.runtime.processes import in_parallel
from liex_lab.scene.floor import Floor
from liex_lab.simulation import _render_kernels as render_kernels
from liex_lab.simulation._sensor_kernels import ANIMAL, NORMAL, OBJECT, UNIT
from liex_lab.simulation.scene import OBJECT_FACES, SimulatedScene, draw_object, outline_of
from liex_lab.simulation.species import MouseSpecies, Sensor, Species

Array = NDArray[np.float64]

FRAME_NS = MouseSpecies.frame_ns
OTHER_CAMERA = "other-camera"  # focal lengths and resolutions not used in training
# name: (own seed, shape family, noise, eroded pixels, share of frames with another object in view)
SPLITS = {
    "clean": (71_001, "train", 1.0, 0, 0.0),
    "hard": (72_001, "train", 2.0, 1, 0.5),
    "other-body": (74_001, "other", 1.0, 0, 0.0),
    OTHER_CAMERA: (75_001, "train", 1.0, 0, 0.0),
}
# held-out recordings, not used in tests, training or development: evaluated once per release. They
# are like the splits above in turn, each with its own seed
SEALED = "sealed"
SEALED_SEED = 970_413


@dataclass(frozen=True)
class FrameContents(Rows):
    """All moving contents of n frames of a virtual camera, and the sensor's noise.

    Attributes:
        skeleton: of the animal.
        spine_mm: its length, mm.
        pose: (n) arena frame.
        girth: (n,) factor of all lengths across the body.
        shape: body of the one animal.
        bends: (n, TAIL_RINGS) bends of its tail, rad; None without a separate tail.
        objects: (n, V, 3) meshes of the distractors, mm, arena frame.
        shown: (n,) bool, whether the distractors are present.
        parameters: (n, N_PARAMETERS) of the sensor.
        seeds: (n,) uint64, of the sensor's noise.
        object_faces: (F, 3) int32, triangles of the distractors' meshes.
    """

    SHARED = ("shape", "object_faces")
    skeleton: Skeleton
    spine_mm: float
    pose: Pose
    girth: Array
    shape: Body
    bends: Array | None
    objects: Array
    shown: NDArray[np.bool_]
    parameters: Array
    seeds: NDArray[np.uint64]
    object_faces: NDArray[np.int32] = field(default_factory=lambda: OBJECT_FACES)


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


class TrueRecording(Recording):
    """A virtual recording and its truth.

    Attributes:
        skeleton: of the animal.
        surface: its mesh model.
        spine_mm: the animal's size over the session, mm.
        pose: (n) root T_camera_root, angles and scale.
        joints_camera: (n, J, 3) joints, mm, camera frame.
        joints_arena: (n, J, 3) joints, mm, arena frame.
        T_arena_camera: exact transform from the camera frame into the arena frame.
        floor: the exact floor plane, or its substitute.
    """

    def __init__(
        self,
        name: str,
        camera: Camera,
        times_ns: NDArray[np.int64],
        *,
        skeleton: Skeleton,
        spine_mm: float,
        pose: Pose,
        T_arena_camera: SE3,
        floor: Floor | None = None,
        joints_camera: Array | None = None,
        joints_arena: Array | None = None,
    ) -> None:
        """A recording with the given truth; what is None follows from the rest."""
        super().__init__(
            name=name,
            format="synthetic",
            camera=camera,
            times_ns=times_ns,
            read=lambda index: self.depths(index, index + 1)[0],
        )
        self.skeleton = skeleton
        self.surface = Surface.of(skeleton)
        self.spine_mm = spine_mm
        self.pose = pose
        self.T_arena_camera = T_arena_camera
        self.floor = floor or Floor.from_plane(
            -T_arena_camera.rotation[2], float(T_arena_camera.translation[2]), camera
        )
        self.joints_camera = pose.joints(skeleton) if joints_camera is None else joints_camera
        self.joints_arena = (
            T_arena_camera @ self.joints_camera if joints_arena is None else joints_arena
        )

    @property
    def truth(self) -> dict[str, Any]:
        """The truth as arguments of another recording of the same frames."""
        names = ("skeleton", "spine_mm", "pose", "T_arena_camera", "floor", "joints_camera")
        return {name: getattr(self, name) for name in (*names, "joints_arena")}

    @cached_property
    def animals(self) -> tuple[TrueAnimal, ...]:
        """The truth of each animal; by default of one that is completely visible."""
        return (TrueAnimal(self.spine_mm, self.joints_camera, np.ones(len(self))),)

    def depths(self, start: int, stop: int) -> NDArray[np.float32]:
        """Depth images of a range of frames, rendered on all threads.

        Args:
            start: first frame.
            stop: one past the last frame.

        Returns:
            (stop - start, H, W) float32 mm, 0 if unread.
        """
        raise NotImplementedError

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


def whole_images(camera: Camera, n: int) -> render_kernels.PatchCamera:
    """The camera of n whole images."""
    size = np.array([camera.width, camera.height])
    return render_kernels.PatchCamera(
        np.tile(camera.intrinsics, (n, 1)), np.tile(size, (n, 1)), np.zeros((n, 2), np.int64)
    )


def render_frames(
    still: NDArray[np.float32],
    parts: tuple[render_kernels.Part, ...],
    camera: Camera,
    T_arena_camera: SE3,
    parameters: Array,
    seeds: NDArray[np.uint64],
) -> NDArray[np.float32]:
    """Depth images of frames of one still scene, rendered on all threads.

    Args:
        still: (H, W) mm, the ideal still scene, 0 for nothing.
        parts: the moving objects, arena frame.
        camera: the camera.
        T_arena_camera: its pose.
        parameters: (n, N_PARAMETERS) of the sensor.
        seeds: (n,) of the sensor's noise.

    Returns:
        (n, H, W) float32 mm, 0 if unread.
    """
    out = np.empty((len(seeds), camera.height, camera.width), np.uint16)
    T_camera_arena = T_arena_camera.inverse()
    in_parallel(
        render_kernels.draw_frames,
        len(seeds),
        still,
        parts,
        np.ascontiguousarray(T_camera_arena.rotation),
        T_camera_arena.translation,
        whole_images(camera, len(seeds)),
        render_kernels.SensorNoise(parameters, seeds, NORMAL),
        out,
    )
    return out * np.float32(parameters[0, UNIT])


class SyntheticSession(TrueRecording):
    """A virtual animal in a virtual arena, rendered on demand.

    Attributes:
        scene: the still scene and its camera.
        contents: the moving contents, and the sensor's noise.
        shape: the animal's body.
    """

    def __init__(
        self,
        name: str,
        scene: SimulatedScene,
        contents: FrameContents,
        times_ns: NDArray[np.int64] | None = None,
    ) -> None:
        """Combine moving contents with a still scene.

        Args:
            name: of the recording.
            scene: the still scene and its camera.
            contents: the moving contents, n frames.
            times_ns: (n,) int64 time stamps, ns; None counts steps of `FRAME_NS`.
        """
        times = np.arange(len(contents.seeds)) * FRAME_NS if times_ns is None else times_ns
        super().__init__(
            name,
            scene.camera,
            times,
            skeleton=contents.skeleton,
            spine_mm=contents.spine_mm,
            pose=contents.pose.moved(scene.T_arena_camera.inverse()),
            T_arena_camera=scene.T_arena_camera,
            joints_arena=contents.pose.joints(contents.skeleton),
        )
        self.scene = scene
        self.contents = contents
        self.shape = contents.shape

    def depths(self, start: int, stop: int) -> NDArray[np.float32]:
        """Depth images of a range of frames, rendered on all threads.

        Args:
            start: first frame.
            stop: one past the last frame.

        Returns:
            (stop - start, H, W) float32 mm, 0 if unread.
        """
        some = self.contents[start:stop]
        animal = self.surface.vertices(some.pose, some.shape, some.girth, some.bends)
        return render_frames(
            self.scene.still,
            (
                render_kernels.part_of(animal, self.surface.faces, ANIMAL),
                render_kernels.part_of(some.objects, some.object_faces, OBJECT, some.shown),
            ),
            self.scene.camera,
            self.scene.T_arena_camera,
            some.parameters,
            some.seeds,
        )

    @staticmethod
    def draw(
        seed: int | list[int],
        n_frames: int = 50,
        *,
        sensor: Sensor | None = None,
        family: str = "train",
        noise: float = 1.0,
        erosion_px: int = 0,
        object_share: float = 0.0,
        spine_mm: float | None = None,
        species: Species | None = None,
        name: str | None = None,
    ) -> "SyntheticSession":
        """A session of independent postures and positions before one camera, drawn from the seed.

        Camera, arena and animal are the same in all frames.

        Args:
            seed: seed or seeds of all random numbers.
            n_frames: length of the session.
            sensor: the camera's make; None draws one of the animal's.
            family: of body shapes, see `draw_shapes`.
            noise: multiplies the sensor's random errors and its rate of holes, see `Sensor.draw`.
            erosion_px: pixels stripped off the animal's outline, see `Sensor.draw`.
            object_share: share of frames with a distractor.
            spine_mm: length of the animal, mm; None draws it.
            species: the species; None is a mouse.
            name: of the recording; None names it after the sensor.

        Returns:
            The session with its truth.
        """
        rng = np.random.default_rng(seed)
        species = MouseSpecies() if species is None else species
        home = species.skeleton.length
        if sensor is None:
            sensor = species.sensors[int(rng.integers(len(species.sensors)))]
        drawn = home * float(rng.uniform(*species.sizes))
        spine = drawn if spine_mm is None else float(spine_mm)
        scene = SimulatedScene.draw(rng, sensor.camera, spine, species.setting)
        shape = species.shapes(rng, family, 1)
        size = np.full(n_frames, spine / home)
        camera_mm = np.full(n_frames, scene.T_arena_camera.translation[2])
        pose, girth = species.postures(rng, size, shape[0].broadcast(n_frames), camera_mm)
        contents = assemble(
            rng,
            scene,
            sensor,
            species,
            spine,
            shape,
            pose,
            girth,
            noise,
            erosion_px,
            object_share,
            scatter=True,
        )
        name = name or f"synthetic-{sensor.name.replace(' ', '-').lower()}"
        return SyntheticSession(name, scene, contents, np.arange(n_frames) * species.frame_ns)


def assemble(
    rng: np.random.Generator,
    scene: SimulatedScene,
    sensor: Sensor,
    species: Species,
    spine_mm: float,
    shape: Body,
    pose: Pose,
    girth: Array,
    noise: float,
    erosion_px: int,
    object_share: float,
    scatter: bool = False,
) -> FrameContents:
    """Place postures of one animal in a scene, with a distractor and the sensor's noise.

    Args:
        rng: random number generator.
        scene: the still scene.
        sensor: the camera's make, of which one unit is drawn.
        species: the species.
        spine_mm: length of the animal, mm.
        shape: its body, a batch of one.
        pose: (n) arena frame; root translations are changed in place if `scatter` is set.
        girth: (n,) factor of all lengths across the body.
        noise: multiplies the sensor's random errors and its rate of holes.
        erosion_px: pixels stripped off the animal's outline.
        object_share: share of frames with a distractor.
        scatter: move each posture to its own free position on the floor.

    Returns:
        The moving contents of n frames.
    """
    n = len(girth)
    surface = Surface.of(species.skeleton)
    bends = species.bends(rng, n)
    vertices = surface.vertices(pose, shape[0], girth, bends)
    trunk = vertices[:, : surface.n_trunk_vertices]
    if scatter:
        bottoms = trunk[..., 2].min(axis=1) if species.floats else None
        shift = scene.places(rng, outline_of(trunk), trunk[..., 2].max(axis=1), bottoms)
        pose.root.translation[:, :2] += shift
        trunk[..., :2] += shift[:, None]
    objects, shown = _beside(rng, scene, trunk, spine_mm, object_share, species, sensor.stride)
    parameters = np.repeat(sensor.draw(rng, 1, shape.fur, noise, erosion_px), n, axis=0)
    seeds = rng.integers(1, 2**63, n).astype(np.uint64)
    return FrameContents(
        species.skeleton, spine_mm, pose, girth, shape[0], bends, objects, shown, parameters, seeds
    )


def _beside(
    rng: np.random.Generator,
    scene: SimulatedScene,
    trunk: Array,
    spine_mm: float,
    share: float,
    species: Species,
    stride: int,
) -> tuple[Array, NDArray[np.bool_]]:
    """One distractor for a session, at an individual free position in every frame.

    Returns:
        Its meshes (n, V, 3) mm and whether it is shown (n,).
    """
    mesh = draw_object(rng, str(rng.choice(species.objects)), spine_mm)
    n = len(trunk)
    objects = np.repeat(mesh[None], n, axis=0)
    shown = rng.random(n) < share
    reach = 1.1 * scene.half
    for i in np.flatnonzero(shown):
        own = trunk[i, ::3, :2]
        for _ in range(40):
            shift = scene.centre + rng.uniform(-1.0, 1.0, 2) * reach
            outline = mesh[::3, :2] + shift
            gap = np.linalg.norm(outline[:, None] - own, axis=-1).min()
            # a hand reaches over the wall; other objects are inside
            within = mesh[:, 2].max() > 0.6 * spine_mm or scene.wall_clearance(shift) > 0
            free = bool(gap > 8.0 * species.setting.scale and within)
            if free and not _covers(scene, objects[i] + [*shift, 0.0], trunk[i], 4.0 * stride):
                objects[i, :, :2] += shift
                break
        else:
            shown[i] = False
    return objects, shown


def _covers(scene: SimulatedScene, item: Array, trunk: Array, margin_px: float) -> bool:
    """Whether the distractor and the animal overlap in the image, or nearly so."""
    T_camera_arena = scene.T_arena_camera.inverse()
    a = scene.camera.project(T_camera_arena @ item)
    b = scene.camera.project(T_camera_arena @ trunk)
    gap = np.linalg.norm(a[::3, None] - b[None, ::3], axis=-1).min()
    middle = b.mean(axis=0)
    around = (a.min(axis=0) < middle).all() and (a.max(axis=0) > middle).all()
    return bool(gap < margin_px or around)


def planned(
    name: str,
    n_sessions: int,
    splits: Mapping[str, tuple[int, str, float, int, float]],
    sealed_seed: int,
) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """Turn among the cameras, kind and settings of each recording of a split.

    Raises:
        LiexError: there is no split of this name.
    """
    if name not in (*splits, SEALED):
        raise LiexError(f"there is no split '{name}'; known are {', '.join(splits)}")
    for k in range(n_sessions):
        kind = split_of(name, k)
        seed, family, noise, erosion_px, object_share = splits[kind]
        settings = {
            "seed": [seed if name != SEALED else sealed_seed, k],
            "family": family,
            "noise": noise,
            "erosion_px": erosion_px,
            "object_share": object_share,
            "name": f"{name}-{k:02d}",
        }
        yield k if name != SEALED else k // len(splits), kind, settings


def split_of(name: str, k: int) -> str:
    """The kind of recording k of a split: the split itself; for 'sealed', each split in turn.

    Args:
        name: of the split.
        k: number of the recording.
    """
    return tuple(SPLITS)[k % len(SPLITS)] if name == SEALED else name
