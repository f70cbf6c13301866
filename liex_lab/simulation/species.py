"""Virtual animals: bodies, postures, movements and surroundings, and what cameras record of them.

A `Species` films recordings (independent postures, or an animal that moves), the fixed test splits,
and training patches; everything is drawn from seeds, so that any part of a set can be reproduced,
in any order. `MouseSpecies` is the mouse, `FishSpecies` the zebrafish, `GenericSpecies` any animal
with a skeleton.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from liex_lab.arrays import Array
from liex_lab.body.pose import Pose
from liex_lab.body.shape import Body, BodyShape, Surface
from liex_lab.body.skeleton import VIEWS, Skeleton
from liex_lab.body.variation import draw_shapes, draw_tail_bends, vary_body
from liex_lab.errors import LiexError
from liex_lab.simulation import training_patches
from liex_lab.simulation._sensor_kernels import ANIMAL
from liex_lab.simulation.locomotion import NEAREST_MM, smoothed, swim, walk, wander, waver
from liex_lab.simulation.pose_prior import (
    FISH_KINDS,
    FISH_SHARES,
    KINDS,
    SHARES,
    SIZE_RANGE,
    centred,
    clearance,
    draw_angles,
    draw_bends,
    hung,
    root_rotation,
    sample_postures,
)
from liex_lab.simulation.recording import (
    FRAME_NS,
    OTHER_CAMERA,
    SEALED,
    SEALED_SEED,
    SPLITS,
    Actor,
    RenderedRecording,
    Split,
    Stage,
    Take,
    distractor,
    in_motion,
    split_of,
)
from liex_lab.simulation.rendering import Solid
from liex_lab.simulation.scene import (
    ARENA,
    OBJECTS,
    SceneSpec,
    SimulatedScene,
    draw_views,
    outline_of,
)
from liex_lab.simulation.sensors import RAYTRIX_R5_SENSOR, SENSORS, Sensor, draw_units, unseen
from liex_lab.simulation.training_patches import PER_SESSION, TrainingPatches


@dataclass(frozen=True)
class Species:
    """An animal as rendered; everything is drawn from the given generator or seed.

    Attributes:
        skeleton: of the animal.
        sensors: makes of cameras.
        setting: ranges of its surroundings.
        objects: kinds of distractors, see `scene.draw_object`.
        sizes: smallest and largest animal over the nominal size.
        floats: whether it is above the floor, not on it.
        frame_ns: between two frames of a recording, ns.
        splits: the test splits.
        sealed_seed: of the held-out split, see `recording.SEALED`.
        patch_px: side of training patches, px, enough for mice of up to 70 mm.
        other_builds: whether errors of tracks are also calibrated on builds not used in training.
        sources: source of the training images.
        locomotion: how it goes, `locomotion.walk` or `locomotion.swim`.
    """

    skeleton: Skeleton
    sensors: tuple[Sensor, ...]
    setting: SceneSpec = ARENA
    objects: tuple[str, ...] = OBJECTS
    sizes: tuple[float, float] = SIZE_RANGE
    floats: bool = False
    frame_ns: int = FRAME_NS
    splits: ClassVar[Mapping[str, Split]] = SPLITS
    sealed_seed: ClassVar[int] = SEALED_SEED
    patch_px: ClassVar[int] = 144
    other_builds: ClassVar[bool] = True
    sources: ClassVar[str] = "rendered from a seed; no recording of an animal was used"
    locomotion: ClassVar[Callable[..., tuple[Pose, Array]]] = staticmethod(walk)

    @property
    def protocol(self) -> str:
        """A sentence on the test splits, for reports of results."""
        return (
            "each with its own camera, arena, animal; the background, the floor, the blob and the "
            "animal's size are found by the product, nothing is handed over. "
        )

    @property
    def test_postures(self) -> str:
        """Source of the test postures, one phrase; '' if they follow from the seeds alone."""
        return ""

    def shapes(self, rng: np.random.Generator, family: str, n: int) -> Body:
        """Bodies of a family of shapes.

        Args:
            rng: random number generator.
            family: one of `body.variation.FAMILIES`.
            n: number of bodies.

        Returns:
            A batch of n bodies.
        """
        return vary_body(rng, self.skeleton, family, n)

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> tuple[Pose, Array]:
        """A posture for each of n animals, on or above the floor.

        Args:
            rng: random number generator.
            size: (n,) of the animals over home size.
            shape: (n) their bodies.
            camera_mm: (n,) heights of the cameras above the floor, mm.

        Returns:
            The poses, base above the origin, and girths.
        """
        raise NotImplementedError

    def move(
        self, rng: np.random.Generator, scene: SimulatedScene, shape: Any, length: float, n: int
    ) -> tuple[Pose, Array]:
        """The motion of one animal in a scene.

        Args:
            rng: random number generator.
            scene: the arena and its camera.
            shape: its body, a batch of one.
            length: of the animal, mm.
            n: number of frames.

        Returns:
            Poses (n) in the arena frame, and girths (n,).
        """
        return self.locomotion(rng, scene, self.skeleton, shape, length, n)

    def bends(self, rng: np.random.Generator, n: int) -> Array | None:
        """Bends of tails, see `Surface.vertices`.

        Returns:
            (n, TAIL_RINGS) rad, or None for an animal without a separate tail.
        """
        return None

    @property
    def other_sensors(self) -> tuple[Sensor, ...]:
        """Cameras that are not used in training."""
        return unseen(self.sensors)

    def test_split(
        self, name: str, spine_mm: float | None = None, n_sessions: int = 40
    ) -> list[RenderedRecording]:
        """The recordings of a split: 40 of 50 independent frames, equally from each sensor.

        Args:
            name: 'clean', 'hard', 'other-body', 'other-camera', or 'sealed', see
                `recording.SEALED`.
            spine_mm: length of every animal, mm; None draws it.
            n_sessions: number of recordings, from the first on.

        Returns:
            The recordings, recording k named after the split and k.

        Raises:
            LiexError: there is no split of this name.
        """
        if name not in (*self.splits, SEALED):
            raise LiexError(f"there is no split '{name}'; known are {', '.join(self.splits)}")
        recordings = []
        for k in range(n_sessions):
            kind = split_of(name, k)
            seed, settings = self.splits[kind]
            sensors = self.other_sensors if kind == OTHER_CAMERA else self.sensors
            turn = k // len(self.splits) if name == SEALED else k
            recordings.append(
                self.film(
                    [self.sealed_seed if name == SEALED else seed, k],
                    sensor=sensors[turn % len(sensors)],
                    spine_mm=spine_mm,
                    name=f"{name}-{k:02d}",
                    **settings,
                )
            )
        return recordings

    def motion(self, seed: int | list[int], n_frames: int, **settings: Any) -> RenderedRecording:
        """A continuous recording of one moving animal, see `film`."""
        return self.film(seed, n_frames, moving=True, **settings)

    def film(
        self,
        seed: int | list[int],
        n_frames: int = 50,
        *,
        sensor: Sensor | None = None,
        **settings: Any,
    ) -> RenderedRecording:
        """A recording of one animal before one camera.

        Args:
            seed: seed or seeds of all random numbers.
            n_frames: length of the recording, at the species' rate.
            sensor: the camera's make; None is the species' last.
            **settings: the other attributes of `Take`.

        Returns:
            The recording with its truth.
        """
        rng = np.random.default_rng(seed)
        take = Take(n_frames, sensor or self.sensors[-1], **settings)
        length = float(take.spine_mm or self.skeleton.length * rng.uniform(*self.sizes))
        title = take.name or f"synthetic-{self.skeleton.name}"
        return RenderedRecording(title, self._stage(rng, take, length))

    def _stage(self, rng: np.random.Generator, take: Take, length: float) -> Stage:
        """Everything before the camera in `film`, of an animal of a given length, mm."""
        n = take.n_frames
        scene = SimulatedScene.draw(rng, take.sensor.camera, length, self.setting)
        shape = self.shapes(rng, take.family, 1)
        if take.moving:
            pose, girth = self.move(rng, scene, shape, length, n)
        else:
            size = np.full(n, length / self.skeleton.length)
            camera_mm = np.full(n, scene.T_arena_camera.translation[2])
            pose, girth = self.postures(rng, size, shape[0].broadcast(n), camera_mm)
        surface = Surface.of(self.skeleton)
        bends = self.bends(rng, n)
        trunk = surface.vertices(pose, shape[0], girth, bends)[:, : surface.n_trunk_vertices]
        if not take.moving:
            bottoms = trunk[..., 2].min(axis=1) if self.floats else None
            shift = scene.places(rng, outline_of(trunk), trunk[..., 2].max(axis=1), bottoms)
            pose.root.translation[:, :2] += shift
            trunk[..., :2] += shift[:, None]
        kind = str(rng.choice(self.objects))
        item = distractor(rng, scene, kind, trunk, length, self.setting.scale, take)
        parameters = take.parameters(rng, shape.fur)
        seeds = rng.integers(1, 2**63, n).astype(np.uint64)
        if take.moving and bends is not None:
            bends = bends[:1] + waver(rng, bends.shape)
        actor = Actor(surface, length, shape, pose, girth, bends, np.ones(n, np.bool_))
        stage = Stage(
            scene,
            self.skeleton,
            (actor,),
            (item,),
            parameters,
            seeds,
            np.arange(n) * self.frame_ns,
            scene.still[None],
            np.zeros(n, np.int64),
        )
        return in_motion(stage, take.sensor.exposure_ms) if take.moving else stage

    def training_blocks(
        self,
        seed: int,
        n_blocks: int,
        *,
        first: int = 0,
        family: str = "train",
        degraded_share: float = 0.0,
        spine_mm: float | None = None,
        window_px: int | None = None,
        per_session: int = PER_SESSION,
    ) -> Iterator[TrainingPatches]:
        """Blocks of `training_patches.BLOCK` training patches from block `first` on.

        They are bit-identical for a seed, for any number of threads.

        Args:
            seed: of the whole set; a block depends only on the seed and its number.
            n_blocks: number of blocks.
            first: number of the first block.
            family: of body shapes, one of `body.variation.FAMILIES`.
            degraded_share: share of mini-sessions with 1 to 2.5 times the noise; half of them have
                an outline eroded by one more pixel.
            spine_mm: mean length of the animals, mm; None uses the skeleton's own.
            window_px: side of the patches, px, that contains the animal with a margin; None is
                `patch_px`.
            per_session: images of one animal with one camera, a divisor of `BLOCK`.

        Yields:
            One set of `BLOCK` patches per block.
        """
        window = window_px or self.patch_px
        nominal = 1.0 if spine_mm is None else spine_mm / self.skeleton.length
        for number in range(first, first + n_blocks):
            rng = np.random.default_rng([seed, number])
            yield self._block(rng, family, degraded_share, nominal, window, per_session)

    def _block(
        self,
        rng: np.random.Generator,
        family: str,
        degraded_share: float,
        nominal: float,
        window_px: int,
        per_session: int,
    ) -> TrainingPatches:
        """One block of patches of animals whose mean size over home size is `nominal`."""
        n = training_patches.BLOCK
        m = n // per_session
        each = np.repeat(np.arange(m), per_session)
        scale = self.setting.scale
        surface = Surface.of(self.skeleton)
        body = self.shapes(rng, family, m)
        make = np.arange(m) % len(self.sensors)
        intrinsics, size_px, parameters = draw_units(rng, self.sensors, make, body.fur)
        training_patches.degrade(rng, parameters, degraded_share)
        T_arena_camera = draw_views(rng, m, self.setting)
        size = (nominal * rng.uniform(*self.sizes, m))[each]
        views = training_patches.floor_views(
            intrinsics,
            size_px,
            T_arena_camera,
            parameters,
            rough=scale * rng.uniform(0.0, 1.0, m),
            error=rng.standard_normal((m, 3)) * [0.003, 0.003, 0.8 * scale],
        )[each]
        height = views.T_arena_camera.translation[:, 2]
        pose, girth = self.postures(rng, size, body[each], height)
        training_patches.place(rng, self.skeleton, pose, views, self.floats)
        vertices = surface.vertices(pose, body[each], girth, self.bends(rng, n))
        trunk = vertices[:, : surface.n_trunk_vertices]
        radii = (size * self.skeleton.length)[:, None] * rng.uniform(0.12, 0.5, (n, 3))

        def raised(bodies: Array) -> tuple[Array, float]:
            """Beside a floating animal it is anywhere between the floor and the animal's back."""
            if not self.floats:
                return radii[:, 2], 1.0
            room = np.maximum(bodies[..., 2].max(axis=1) - radii[:, 2], 0.0)
            return radii[:, 2] + rng.uniform(0.0, 1.0, n) * room, 1.0

        gap = (5.0 * scale, 40.0 * scale)
        neighbour = training_patches.neighbours(rng, trunk, radii, gap, raised, 10.0, 0.10)
        training_patches.draw_walls(rng, trunk, self.setting, views)
        seeds = rng.integers(1, 2**63, n).astype(np.uint64)
        origin = views.around(trunk, window_px)
        depth, background = views.render(
            [Solid.of(vertices, surface.faces, label=ANIMAL), neighbour],
            seeds,
            origin,
            (window_px, window_px),
            learn=True,
        )
        pose = pose.moved(views.T_arena_camera.inverse())
        return TrainingPatches(
            depth,
            background,
            origin.astype(np.int32),
            views.intrinsics,
            views.floor,
            pose.root,
            pose.angles,
            pose.scale,
            pose.joints(self.skeleton),
            size * self.skeleton.length,
            body[each],
            self.sensors[0].unit_mm,
            self.sensors[0].spread_mm(views.parameters, height),
        )


@dataclass(frozen=True)
class MouseSpecies(Species):
    """A mouse in an arena, recorded by a PrimeSense or a Kinect v2."""

    skeleton: Skeleton = field(default_factory=lambda: Skeleton.load("mouse"))
    sensors: tuple[Sensor, ...] = SENSORS

    def shapes(self, rng: np.random.Generator, family: str, n: int) -> BodyShape:
        """Mice of a family of shapes."""
        return draw_shapes(rng, self.skeleton, family, n)

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> tuple[Pose, Array]:
        """Mice that walk, curl up, rear, hunch and reach, with the frequencies of
        `pose_prior.SHARES`; kinds are indices into `pose_prior.KINDS`.
        """
        assert isinstance(shape, BodyShape)
        kinds = rng.choice(len(KINDS), len(size), p=SHARES)
        return sample_postures(rng, self.skeleton, size, shape, kinds)

    def bends(self, rng: np.random.Generator, n: int) -> Array:
        """Bends of the tails (n, TAIL_RINGS), rad."""
        return draw_tail_bends(rng, n)


TANK = SceneSpec(
    camera_mm=(230.0, 330.0),
    tilt_rad=float(np.radians(6.0)),
    walls_mm=(30.0, 110.0),
    open_share=0.2,
    clutter=("pellet", "plant"),
    scale=0.3,
)


@dataclass(frozen=True)
class FishSpecies(Species):
    """A zebrafish that swims anywhere in a tank, recorded from above by a Raytrix R5."""

    skeleton: Skeleton = field(default_factory=lambda: Skeleton.load("fish"))
    sensors: tuple[Sensor, ...] = (RAYTRIX_R5_SENSOR,)
    setting: SceneSpec = TANK
    objects: tuple[str, ...] = ("pellet", "plant", "fish")
    sizes: tuple[float, float] = (25.0 / 30.0, 40.0 / 30.0)
    floats: bool = True
    frame_ns: int = 20_000_000
    locomotion = staticmethod(swim)

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> tuple[Pose, Array]:
        """Fish that glide, scoot and turn, mostly level, at any height above the floor, at least
        NEAREST_MM from the camera; kinds are indices into `pose_prior.FISH_KINDS`.
        """
        n = len(size)
        kind = rng.choice(len(FISH_KINDS), n, p=FISH_SHARES)
        steep = np.where(rng.random(n) < 0.12, 25.0, 8.0)
        pitch = np.clip(rng.normal(0.0, 1.0, n) * steep, -55.0, 55.0)
        roll = np.clip(rng.normal(0.0, 8.0, n), -25.0, 25.0)
        rotation = root_rotation(rng.uniform(-np.pi, np.pi, n), np.radians(pitch), np.radians(roll))
        pose = hung(self.skeleton, draw_bends(rng, self.skeleton, kind), rotation, size)
        low, high = clearance(self.skeleton, pose, shape, size)
        headroom = np.maximum(camera_mm - NEAREST_MM - high, low + 1.0)
        # some are just above the floor
        at = np.where(rng.random(n) < 0.12, rng.uniform(0.0, 0.06, n), rng.random(n))
        pose.root.translation[:, 2] += low + at * (headroom - low) + rng.uniform(0.5, 2.0, n)
        return pose, size


# tilts from which the resting orientation on the floor is chosen
_TILTS = 8
NEAR_SHARE = 0.55  # of the camera's height: upper limit of floating animals


@dataclass(frozen=True)
class GenericSpecies(Species):
    """An animal with only a skeleton and a surface, in any posture.

    It lies on the floor, in the lowest of several tilts, as gravity would have it, or (view frame
    'camera') floats above it.
    """

    @staticmethod
    def of(skeleton: Skeleton) -> "GenericSpecies":
        """The species of a skeleton: visible by the Raytrix R5 below 35 mm of length, in a scene in
        which the whole animal is visible from anywhere, at a sufficient size.
        """
        # a short animal uses a close-range camera
        sensors = (RAYTRIX_R5_SENSOR,) if skeleton.length < 35.0 else SENSORS
        scale = float(np.clip(skeleton.relative_size, 0.3, 2.0))
        # large in the image, with space to move, and not below the cameras' minimum distance
        least = ARENA.camera_mm[0] if sensors == SENSORS else 230.0
        wide = max(sensor.camera.fx / sensor.camera.height for sensor in sensors)
        near = max(least, 2.2 * skeleton.length * wide)
        walls = (ARENA.walls_mm[0] * scale, ARENA.walls_mm[1] * scale)
        return GenericSpecies(
            skeleton,
            sensors,
            SceneSpec(camera_mm=(near, 1.6 * near), walls_mm=walls, scale=scale),
            ("block", "ball"),
            floats=skeleton.view.frame != VIEWS[0],
        )

    def window_px(self, length_mm: float) -> int:
        """Side of a square patch, px, that contains an animal of this mean length at any position.

        Args:
            length_mm: mean length of the animals, mm.

        Returns:
            The side, a multiple of 8 px.
        """
        nearest = self.setting.camera_mm[0] * (1.0 - NEAR_SHARE if self.floats else 0.9)
        focal = max(sensor.camera.fx / sensor.stride for sensor in self.sensors)
        px = 1.1 * self.sizes[1] * length_mm * focal / nearest + 32.0
        return 8 * int(np.ceil(px / 8.0))

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> tuple[Pose, Array]:
        """Postures within the joints' limits, smooth along the chains."""
        n = len(size)
        angles = draw_angles(rng, self.skeleton, n)
        heading = rng.uniform(-np.pi, np.pi, n)
        if self.floats:
            tilt = np.clip(rng.normal(0.0, 0.25, (2, n)), -0.9, 0.9)
            pose = centred(
                self.skeleton, angles, root_rotation(heading, tilt[0], 0.6 * tilt[1]), size
            )
            low, high = self.extent(pose, shape, size)
            headroom = np.maximum(NEAR_SHARE * camera_mm - high, -low + 1.0)
            pose.root.translation[:, 2] += -low + rng.random(n) * (headroom + low)
            return pose, size
        pose = self._fallen(rng, angles, heading, size)
        low, _ = self.extent(pose, shape, size)
        pose.root.translation[:, 2] += rng.uniform(0.0, 2.0, n) * self.setting.scale - low
        return pose, size

    def move(
        self, rng: np.random.Generator, scene: SimulatedScene, shape: Any, length: float, n: int
    ) -> tuple[Pose, Array]:
        """An animal that moves about and changes its posture."""
        skeleton = self.skeleton
        step_s = self.frame_ns * 1e-9
        size = np.full(n, length / skeleton.length)
        # mean number of frames of a posture
        slow = 0.5 / step_s
        starts = np.where(rng.random(n) < 1.0 / slow, np.arange(n), 0)
        drawn = draw_angles(rng, skeleton, n)[np.maximum.accumulate(starts)]
        angles = smoothed(drawn, 0.4 * slow)
        speed = np.maximum(smoothed(rng.normal(0.4, 0.8, n), slow), 0.0)
        turning = smoothed(rng.normal(0.0, 3.0, n), slow)
        level = np.zeros(n)
        flat = centred(skeleton, angles, root_rotation(level, level, level), size)
        low, high = self.extent(flat, shape[0].broadcast(n), size)
        least = -float(low.min()) + 1.0
        camera_mm = float(scene.T_arena_camera.translation[2])
        top = NEAR_SHARE * camera_mm - float(high.max()) if self.floats else 0.0
        water = (least, max(top, least))
        position, heading = wander(rng, scene, length, speed, turning, level, water, step_s)
        pose = centred(skeleton, angles, root_rotation(heading, level, level), size)
        pose.root.translation[:] += position
        if not self.floats:
            pose.root.translation[:, 2] -= position[:, 2] + low
        return pose, size

    def extent(self, pose: Pose, shape: Body, size: Array) -> tuple[Array, Array]:
        """Lowest and highest points (n,) mm of the bodies."""
        z = Surface.of(self.skeleton).vertices(pose, shape, size)[..., 2]
        return z.min(axis=1), z.max(axis=1)

    def _fallen(self, rng: np.random.Generator, angles: Array, heading: Array, size: Array) -> Pose:
        """The lowest of several random tilts, as under gravity; sometimes any of them."""
        n = len(size)
        tilts = rng.normal(0.0, 0.35, (_TILTS, 2, n))
        tilts[0] = 0.0
        poses = [
            centred(self.skeleton, angles, root_rotation(heading, t[0], t[1]), size) for t in tilts
        ]
        z = np.stack([pose.joints(self.skeleton)[..., 2] for pose in poses])
        best = np.argmin(z.mean(axis=2) - z.min(axis=2), axis=0)
        # not all lie as low as possible
        best = np.where(rng.random(n) < 0.15, rng.integers(_TILTS, size=n), best)
        return Pose.join(poses)[best * n + np.arange(n)]
