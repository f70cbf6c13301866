"""The animals of a scene: body, path and presence of each.

Body, posture and path of an animal are drawn from the seed alone, not from the scene, so that the
animal behaves the same in every scene of a seed, as far as the arena permits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape, Surface, render_mesh
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.simulation._render_kernels import part_of
from liex_lab.simulation._sensor_kernels import ANIMAL, OBJECT
from liex_lab.simulation.locomotion import Path, Script, free_path, smoothed, walk
from liex_lab.simulation.recording import TrueAnimal, TrueRecording, render_frames
from liex_lab.simulation.scene import SimulatedScene
from liex_lab.simulation.scenes.places import Mesh, joined
from liex_lab.simulation.species import MouseSpecies, Species

Array = NDArray[np.float64]

AWAY = np.array([0.0, 0.0, 1e7])  # mm: behind any downward-facing camera
_RATE_HZ = 30.0
_TRIES = 60


@dataclass(frozen=True)
class SceneAnimal:
    """One animal in n frames.

    Attributes:
        spine_mm: its length, mm.
        shape: its body, a batch of one.
        pose: (n) arena frame.
        girth: (n,) factor of all lengths across the body.
        bends: (n, TAIL_RINGS) bends of its tail, rad.
        present: (n,) bool, whether it is in the arena.
    """

    spine_mm: float
    shape: BodyShape
    pose: Pose
    girth: Array
    bends: Array
    present: NDArray[np.bool_]

    @staticmethod
    def draw(
        seed: int,
        which: int,
        species: MouseSpecies,
        arena: SimulatedScene,
        family: str,
        spine_mm: float | None,
        timing: tuple[NDArray[np.int64], NDArray[np.bool_]],
        script: Script | None = None,
        path: Path | None = None,
    ) -> SceneAnimal:
        """An animal that walks in an arena.

        Args:
            seed: of the recording.
            which: number of the animal.
            species: the mouse.
            arena: the arena.
            family: of body shapes, see `draw_shapes`.
            spine_mm: its length, mm; None draws it.
            timing: index of the moment of its walk in each frame (n,), and its presence (n,).
            script: its activity, see `locomotion.walk`.
            path: its path, likewise.

        Returns:
            The animal.
        """
        moments, present = timing
        body = np.random.default_rng([seed, which, 1])
        drawn = float(body.uniform(55.0, 75.0))
        spine = drawn if spine_mm is None else float(spine_mm)
        shape = species.shapes(body, family, 1)
        n_moments = int(moments.max()) + 1
        going = np.random.default_rng([seed, which, 2])
        pose, girth = walk(going, arena, species, shape, spine, n_moments, script, path)
        tail = np.random.default_rng([seed, which, 3])
        first = species.bends(tail, 1)
        assert first is not None  # mice have tails
        bends = first + 4.0 * smoothed(tail.normal(0.0, 0.05, (n_moments, first.shape[1])), 3.6)
        asleep = np.diff(moments, prepend=moments[0] - 1) == 0
        # share of the girth; breaths per frame
        breath = 1.0 + 0.012 * np.sin(2 * np.pi * 2.5 * np.arange(len(moments)) / _RATE_HZ)
        return SceneAnimal(
            spine,
            shape,
            pose[moments],
            girth[moments] * np.where(asleep, breath, 1.0),
            bends[moments],
            present,
        )

    def lifted(self, height: Array) -> SceneAnimal:
        """The same animal, raised above the floor.

        Args:
            height: (n,) mm.
        """
        shift = np.stack([0 * height, 0 * height, height], axis=-1)
        root = replace(self.pose.root, translation=self.pose.root.translation + shift)
        return replace(self, pose=replace(self.pose, root=root))

    def middle(self, species: MouseSpecies) -> Array:
        """The mean of its joints (n, 3), mm, arena frame."""
        return np.asarray(self.pose.joints(species.skeleton).mean(axis=1))

    def placed(self, surface: Surface, part: slice) -> Mesh:
        """Its mesh (k, V, 3) mm in some frames, arena frame; far behind the camera if absent.

        Args:
            surface: of the skeleton.
            part: the frames.
        """
        mesh = surface.vertices(self.pose[part], self.shape[0], self.girth[part], self.bends[part])
        mesh[~self.present[part]] += AWAY
        return Mesh(mesh, surface.faces)


def timing_of(presence: str, n_frames: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Presence and timing of an animal.

    Args:
        presence: 'always'; 'asleep', motionless for 78 % of the recording; 'still', for all of it;
            'late', from two thirds on; 'leaves', for the first 45 %; or 'never'.
        n_frames: length of the recording.

    Returns:
        Index of the moment of its walk in each frame (n,), and its presence (n,).
    """
    frame = np.arange(n_frames)
    always = np.ones(n_frames, np.bool_)
    falls, wakes, comes = (int(share * n_frames) for share in (0.12, 0.90, 2.0 / 3.0))
    slept = np.where(frame < falls, frame, np.maximum(falls, frame - (wakes - falls)))
    return {
        "always": (frame, always),
        "asleep": (slept, always),
        "still": (np.zeros(n_frames, np.int64), always),
        "late": (np.maximum(frame - comes, 0), frame >= comes),
        "leaves": (frame, frame < max(1, int(0.45 * n_frames))),
        "never": (frame, ~always),
    }[presence]


def calm_script(rng: np.random.Generator, n: int) -> tuple[NDArray[np.int64], Array]:
    """A mouse that walks without rearing, with pauses.

    Returns:
        Kinds of posture (n,) and speeds (n,), spines/s, see `locomotion.walk_script`.
    """
    speed = np.empty(n)
    at = 0
    while at < n:
        stop = at + int(_RATE_HZ * rng.uniform(0.8, 2.5))
        speed[at:stop] = rng.uniform(1.0, 2.4)
        pause = stop + int(_RATE_HZ * rng.uniform(0.1, 0.8))
        speed[stop:pause] = 0.0
        at = pause
    return np.zeros(n, np.int64), np.maximum(smoothed(speed[:, None], 3.6)[:, 0], 0.0)


def visiting(door: Array, inside: Array, spans: tuple[tuple[float, float], ...]) -> Path:
    """A path that starts in front of a house, and enters it at given times.

    Args:
        door: (2,) in front of the house, mm, arena frame.
        inside: (2,) inside it.
        spans: start and end of the times inside, as shares of the recording.

    Returns:
        A path for `locomotion.walk`.
    """

    def path(
        rng: np.random.Generator, scene: SimulatedScene, spine_mm: float, speed: Array
    ) -> tuple[Array, Array]:
        n = len(speed)
        position = np.empty((n, 2))
        heading = np.empty(n)
        goals = [free_spot(rng, scene, 0.8 * spine_mm) for _ in range(40)]
        at = door + 0.6 * (door - inside)
        way = rng.uniform(-np.pi, np.pi)
        passing = False  # inside, or on the way through the door
        for i in range(n):
            invited = any(low <= i / n < high for low, high in spans)
            at_door = bool(np.linalg.norm(at - door) < 25.0)
            passing = passing or at_door if invited else passing and not at_door
            goal = inside if invited and passing else goals[(i // 45) % len(goals)]
            if invited != passing:
                goal = door
            gap = goal - at
            # not there yet
            if np.linalg.norm(gap) > 6.0:
                errand = invited or passing
                ahead = np.arctan2(gap[1], gap[0])
                # up to 5 rad/s, twice as fast on an errand
                most = (2.0 if errand else 1.0) * 5.0 / _RATE_HZ
                way += np.clip((ahead - way + np.pi) % (2 * np.pi) - np.pi, -most, most)
                # at least 1.8 spines per second on an errand
                run = max(speed[i], 1.8 * spine_mm * errand) / _RATE_HZ
                facing = max(float(np.cos(ahead - way)), 0.1)
                step = run * facing * np.array([np.cos(way), np.sin(way)])
                if errand or scene.freedom(at + step) > 0.4 * spine_mm:
                    at = at + step
            position[i] = at
            heading[i] = way
        return position, heading

    return path


def free_spot(rng: np.random.Generator, scene: SimulatedScene, margin_mm: float) -> Array:
    """A random position in an arena, away from walls and clutter.

    Args:
        rng: random number generator.
        scene: the arena.
        margin_mm: minimum distance from them, mm.

    Returns:
        (2,) mm, arena frame; of some random positions the first free one, else the best.
    """
    spots = scene.centre + rng.uniform(-1.0, 1.0, (_TRIES, 2)) * scene.half
    room = np.array([scene.freedom(spot) for spot in spots])
    free = room > margin_mm
    return np.asarray(spots[int(np.argmax(free)) if free.any() else int(np.argmax(room))])


def keeping_apart(other: Array, spine_mm: float) -> Path:
    """A path that avoids another animal's path.

    Args:
        other: (n, 2) positions of the other, mm, arena frame.
        spine_mm: its length, mm.

    Returns:
        A path for `locomotion.walk`: the first of some free paths that stays clear, else the best.
    """

    def path(
        rng: np.random.Generator, scene: SimulatedScene, own_mm: float, speed: Array
    ) -> tuple[Array, Array]:
        best: tuple[Array, Array] | None = None
        best_gap = -np.inf
        for _ in range(_TRIES):
            position, heading = free_path(rng, scene, own_mm, speed)
            gap = float(np.linalg.norm(position - other[: len(position)], axis=1).min())
            if gap > best_gap:
                best = (position, heading)
                best_gap = gap
            if gap > 0.95 * 0.5 * (spine_mm + own_mm):
                break
        assert best is not None
        return best

    return path


# A rendered scene as a recording with the truth of every animal in it.


@dataclass(frozen=True)
class Moving:
    """A moving object other than an animal: worn, added, or held in a hand.

    Attributes:
        mesh: vertices (m, V, 3) mm, arena frame, at m moments.
        moment: (n,) int64, index of the moment in each frame; -1 if absent.
    """

    mesh: Mesh
    moment: NDArray[np.int64]

    @staticmethod
    def of(mesh: Mesh, shown: NDArray[np.bool_]) -> Moving:
        """An object with its own moment in every frame, or one that appears or disappears, but does
        not move.

        Args:
            mesh: vertices (n, V, 3) or (V, 3) mm, arena frame.
            shown: (n,) bool, its presence.
        """
        if mesh.vertices.ndim == 2:
            return Moving(Mesh(mesh.vertices[None], mesh.faces), np.where(shown, 0, -1))
        return Moving(mesh, np.where(shown, np.arange(len(shown)), -1))

    def placed(self, part: slice) -> Mesh:
        """Its mesh (k, V, 3) mm in some frames, arena frame; far behind the camera if absent."""
        moment = self.moment[part]
        away = (moment < 0)[:, None, None] * AWAY
        return Mesh(self.mesh.vertices[moment] + away, self.mesh.faces)


@dataclass(frozen=True)
class SceneContents:
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
    animals: tuple[SceneAnimal, ...]
    moving: tuple[Moving, ...]
    stills: NDArray[np.float32]
    epoch: NDArray[np.int64]
    parameters: Array
    seeds: NDArray[np.uint64]
    offset_mm: Array


class Mirrored(TrueRecording):
    """A recording with left and right exchanged."""

    def __init__(self, name: str, filmed: TrueRecording) -> None:
        """Mirror a recording.

        Args:
            name: of the mirrored recording.
            filmed: the recording, of a camera without lens distortion.
        """
        c = filmed.camera
        camera = replace(c, cx=c.width - 1.0 - c.cx)
        joints = filmed.joints_camera * np.array([-1.0, 1.0, 1.0])
        truth = filmed.truth | {"joints_camera": joints, "joints_arena": None}
        super().__init__(name, camera, filmed.times_ns.copy(), **truth)
        self._filmed = filmed

    def depths(self, start: int, stop: int) -> NDArray[np.float32]:
        """Depth images of a range of frames, rendered on all threads."""
        return np.ascontiguousarray(self._filmed.depths(start, stop)[..., ::-1])


class SceneRecording(TrueRecording):
    """A scene of mice from a recipe.

    Attributes:
        stage: its contents.
    """

    def __init__(self, name: str, stage: SceneContents) -> None:
        """Record a stage.

        Args:
            name: of the recording.
            stage: its contents.
        """
        n = len(stage.seeds)
        skeleton = stage.species.skeleton
        pose = Pose.home(skeleton, n)
        if stage.animals:
            pose = stage.animals[0].pose.moved(stage.T_arena_camera.inverse())
        super().__init__(
            name,
            stage.camera,
            np.arange(n) * stage.species.frame_ns,
            skeleton=skeleton,
            spine_mm=stage.animals[0].spine_mm if stage.animals else skeleton.length,
            pose=pose,
            T_arena_camera=stage.T_arena_camera,
        )
        self.stage = stage

    @cached_property
    def animals(self) -> tuple[TrueAnimal, ...]:
        """The truth of each animal, computed on demand; () if there are none."""
        return tuple(self._truth(animal) for animal in self.stage.animals)

    def _truth(self, animal: SceneAnimal) -> TrueAnimal:
        joints = self.T_arena_camera.inverse() @ animal.pose.joints(self.skeleton)
        joints[~animal.present] = np.nan
        return TrueAnimal(animal.spine_mm, joints, self._visible(animal))

    def _visible(self, animal: SceneAnimal) -> Array:
        """Share (n,) of an animal's pixels that are inside the image and not occluded."""
        stage = self.stage
        T_camera_arena = self.T_arena_camera.inverse()
        share = np.zeros(len(stage.seeds))
        c = stage.camera
        left = c.width // 4
        top = c.height // 4
        around = (-left, -top, c.width + 2 * left, c.height + 2 * top)
        for i in np.flatnonzero(animal.present):
            part = slice(i, i + 1)
            mesh = animal.placed(self.surface, part)
            whole = render_mesh(mesh.vertices[0], mesh.faces, c, around, T_camera_arena)
            own = whole[top : top + c.height, left : left + c.width]
            objects = [one.placed(part) for one in stage.moving if one.moment[i] >= 0]
            objects += [
                other.placed(self.surface, part)
                for other in stage.animals
                if other is not animal and other.present[i]
            ]
            before = [
                render_mesh(one.vertices[0], one.faces, c, T_camera_mesh=T_camera_arena)
                for one in objects
            ]
            visible = own > 0
            for depth in (stage.stills[stage.epoch[i]], *before):
                visible &= (depth == 0) | (own < depth + 2.0)
            share[i] = visible.sum() / max(int((whole > 0).sum()), 1)
        return share

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
        n = part.stop - part.start
        animals = _together(n, [animal.placed(self.surface, part) for animal in stage.animals])
        objects = _together(n, [one.placed(part) for one in stage.moving])
        depth = render_frames(
            stage.stills[epoch],
            (part_of(*animals, ANIMAL), part_of(*objects, OBJECT)),
            stage.camera,
            stage.T_arena_camera,
            np.tile(stage.parameters, (n, 1)),
            stage.seeds[part],
        )
        offset = stage.offset_mm[part]
        if offset.any():
            shifted = np.round(depth + offset[:, None, None].astype(np.float32))
            depth = np.where(depth > 0, shifted, 0.0).astype(np.float32)
        return depth


def _together(n: int, parts: Sequence[Mesh]) -> Mesh:
    """Meshes of n frames as one, which may be empty."""
    nothing = Mesh(np.zeros((n, 3, 3)), np.zeros((0, 3), np.int32))
    return joined(parts) if parts else nothing
