"""Pose prior and locomotion of any animal with only a skeleton and a surface.

Joint angles are drawn by a Gaussian copula over the kinematic tree: a standard normal number
follows an AR(1) process down every chain (correlation 0.75 with the parent's), and its quantile
sets the joint's position between its limits (`draw_angles`). An animal on the floor takes the
lowest of eight tilts, as gravity would have it; one with view frame 'camera' floats at any height.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import VIEWS, Skeleton
from liex_lab.body.surface import Body, Surface, vary_body
from liex_lab.geometry import SE3
from liex_lab.simulation.locomotion import smoothed, wander
from liex_lab.simulation.pose_prior import root_rotation
from liex_lab.simulation.recording import SyntheticSession, assemble
from liex_lab.simulation.scene import ARENA, SceneSpec, SimulatedScene
from liex_lab.simulation.species import RAYTRIX_R5_SENSOR, SENSORS, Postures, Sensor

Array = NDArray[np.float64]

_SMALL_MM = 35.0  # a shorter animal uses a close-range camera
_LIKE_NEXT = 0.75  # correlation of a joint's bend with its parent's
_UNLIMITED_RAD = np.radians(100.0)  # an axis with a wider range counts as unlimited
_USUAL_RAD = np.radians(45.0)  # and turns by this much
# tilts from which the resting orientation on the floor is chosen
_TILTS = 8
_TILT_RAD = 0.35
_REARED_SHARE = 0.15  # share of animals that do not lie as low as possible
_NEAR_SHARE = 0.55  # of the camera's height: upper limit of floating animals
_CHANGE_S = 0.5  # mean duration of a posture


@dataclass(frozen=True)
class GenericSpecies:
    """An animal that lies on the floor or (view frame 'camera') floats above it, in any posture.

    Postures are restricted only by the joints' limits; other attributes are as in `Species`.

    Attributes:
        skeleton: of the animal.
        sizes: smallest and largest animal over the nominal size.
        things: kinds of distractors.
        frame_ns: between two frames of a recording, ns.
    """

    skeleton: Skeleton
    sizes: tuple[float, float] = (0.9, 1.1)
    things: tuple[str, ...] = ("block", "ball")
    frame_ns: int = 33_333_333

    @cached_property
    def floats(self) -> bool:
        """Whether it is above the floor: its view frame is 'camera'."""
        return self.skeleton.view.frame != VIEWS[0]

    @cached_property
    def sensors(self) -> tuple[Sensor, ...]:
        """Makes of cameras that resolve it: the Raytrix R5 below 35 mm of length."""
        return (RAYTRIX_R5_SENSOR,) if self.skeleton.length < _SMALL_MM else SENSORS

    @cached_property
    def setting(self) -> SceneSpec:
        """A scene in which the whole animal is visible from anywhere, at a sufficient size."""
        length = self.skeleton.length
        scale = float(np.clip(self.skeleton.relative_size, 0.3, 2.0))
        # large in the image, with space to move, and not below the cameras' minimum distance
        least = ARENA.camera_mm[0] if self.sensors == SENSORS else 230.0
        near = max(
            least,
            2.2 * length * max(sensor.camera.fx / sensor.camera.height for sensor in self.sensors),
        )
        walls = (ARENA.walls_mm[0] * scale, ARENA.walls_mm[1] * scale)
        return SceneSpec(camera_mm=(near, 1.6 * near), walls_mm=walls, scale=scale)

    def window_px(self, length_mm: float) -> int:
        """Side of a square patch, px, that contains an animal of this mean length at any position.

        Args:
            length_mm: mean length of the animals, mm.

        Returns:
            The side, a multiple of 8 px.
        """
        nearest = self.setting.camera_mm[0] * (1.0 - _NEAR_SHARE if self.floats else 0.9)
        focal = max(sensor.camera.fx / sensor.stride for sensor in self.sensors)
        px = 1.1 * self.sizes[1] * length_mm * focal / nearest + 32.0
        return 8 * int(np.ceil(px / 8.0))

    def shapes(self, rng: np.random.Generator, family: str, n: int) -> Body:
        """Bodies of a family, varied in girth and proportions.

        Args:
            rng: random number generator.
            family: one of `body.shape.FAMILIES`.
            n: number of bodies.

        Returns:
            A batch of n bodies.
        """
        return vary_body(rng, self.skeleton, family, n)

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> Postures:
        """Postures within the joints' limits, smooth along the chains.

        On the floor, 85 % lie as low as possible, up to 2 mm (times the scene's scale) above it;
        floating animals are anywhere from the floor to 0.55 of the camera's height.

        Args:
            rng: random number generator.
            size: (n,) over home size.
            shape: (n) their bodies.
            camera_mm: (n,) heights of the cameras above the floor, mm.

        Returns:
            The poses with girths; all kinds are 0.
        """
        n = len(size)
        angles = draw_angles(rng, self.skeleton, n)
        heading = rng.uniform(-np.pi, np.pi, n)
        if self.floats:
            tilt = np.clip(rng.normal(0.0, 0.25, (2, n)), -0.9, 0.9)
            pose = _centred(
                self.skeleton, angles, root_rotation(heading, tilt[0], 0.6 * tilt[1]), size
            )
            low, high = self._extent(pose, shape, size)
            headroom = np.maximum(_NEAR_SHARE * camera_mm - high, -low + 1.0)
            pose.root.translation[:, 2] += -low + rng.random(n) * (headroom + low)
            return Postures(pose, size, np.zeros(n, np.int64))
        pose = self._fallen(rng, angles, heading, size)
        low, _ = self._extent(pose, shape, size)
        pose.root.translation[:, 2] += rng.uniform(0.0, 2.0, n) * self.setting.scale - low
        return Postures(pose, size, np.zeros(n, np.int64))

    def bends(self, rng: np.random.Generator, n: int) -> Array | None:
        """None, as a tail is part of the skeleton."""
        return None

    def _extent(self, pose: Pose, shape: Body, size: Array) -> tuple[Array, Array]:
        """Lowest and highest points (n,) mm of the bodies."""
        z = Surface.of(self.skeleton).vertices(pose, shape, size)[..., 2]
        return z.min(axis=1), z.max(axis=1)

    def _fallen(self, rng: np.random.Generator, angles: Array, heading: Array, size: Array) -> Pose:
        """The lowest of several random tilts, as under gravity; sometimes any of them."""
        n = len(size)
        tilts = rng.normal(0.0, _TILT_RAD, (_TILTS, 2, n))
        tilts[0] = 0.0
        poses = [
            _centred(self.skeleton, angles, root_rotation(heading, t[0], t[1]), size) for t in tilts
        ]
        height = []
        for pose in poses:
            z = pose.joints(self.skeleton)[..., 2]
            height.append(z.mean(axis=1) - z.min(axis=1))
        best = np.argmin(height, axis=0)
        best = np.where(rng.random(n) < _REARED_SHARE, rng.integers(_TILTS, size=n), best)
        rows = np.arange(n)
        rotation = np.stack([p.root.rotation for p in poses])[best, rows]
        translation = np.stack([p.root.translation for p in poses])[best, rows]
        return Pose(SE3(rotation, translation), angles, size)


def draw_angles(rng: np.random.Generator, skeleton: Skeleton, n: int) -> Array:
    """Joint angles about the free axes, within the limits, correlated with the parent's.

    A standard normal number follows an AR(1) process down every chain; its quantile sets the
    joint's position between its limits. A factor from a beta distribution pulls each body towards
    its home pose, so that some are nearly straight. An axis whose range is wider than 200 degrees
    counts as unlimited and turns by up to 45 degrees either way.

    Returns:
        (n, J, 3) rad, 0 at the base joint.
    """
    from scipy.special import ndtr

    low = skeleton.limits[..., 0]
    high = skeleton.limits[..., 1]
    wide = high - low > 2.0 * _UNLIMITED_RAD
    low = np.where(wide, -_USUAL_RAD, low)
    high = np.where(wide, _USUAL_RAD, high)
    bent = rng.beta(1.2, 1.0, (n, 1, 1))  # deviation of this body from its home pose
    number = rng.standard_normal((n, skeleton.n_joints, 3))
    for j in range(1, skeleton.n_joints):
        p = skeleton.parents[j]
        if p > 0:
            number[:, j] = _LIKE_NEXT * number[:, p] + np.sqrt(1.0 - _LIKE_NEXT**2) * number[:, j]
    home = np.clip(0.0, low, high)
    angles = home + bent * (low + ndtr(number) * (high - low) - home)
    angles = angles * skeleton.axes
    angles[:, 0] = 0.0
    return angles


def _centred(skeleton: Skeleton, angles: Array, rotation: Array, size: Array) -> Pose:
    """Poses (n) with their joints' mean at the origin."""
    pose = Pose(SE3(rotation, np.zeros((len(angles), 3))), angles, np.asarray(size, float))
    pose.root.translation[:] -= pose.joints(skeleton).mean(axis=1)
    return pose


def moving_session(
    seed: int | list[int],
    n_frames: int,
    *,
    species: GenericSpecies,
    sensor: Sensor | None = None,
    family: str = "train",
    noise: float = 1.0,
    erosion_px: int = 0,
    thing_share: float = 0.0,
    spine_mm: float | None = None,
    name: str = "moving",
) -> SyntheticSession:
    """A recording of one animal that moves around and changes its posture.

    A posture lasts about half a second and is blended into the next by a Gaussian kernel; the path
    is that of `locomotion.wander`.

    Args:
        seed: seed or seeds of all random numbers.
        n_frames: length of the recording, at the rate of `species.frame_ns`.
        species: the species.
        sensor: the camera's make; None is the last of the species'.
        family: of body shapes, see `vary_body`.
        noise: multiplies the sensor's random errors and its rate of holes.
        erosion_px: pixels stripped off the animal's outline.
        thing_share: share of frames with a distractor.
        spine_mm: length of the animal, mm; None draws it.
        name: of the recording.

    Returns:
        The recording with its truth.
    """
    rng = np.random.default_rng(seed)
    skeleton = species.skeleton
    sensor = sensor or species.sensors[-1]
    length = (
        skeleton.length * float(rng.uniform(*species.sizes))
        if spine_mm is None
        else float(spine_mm)
    )
    scene = SimulatedScene.draw(rng, sensor.camera, length, species.setting)
    shape = species.shapes(rng, family, 1)
    step_s = species.frame_ns * 1e-9
    size = np.full(n_frames, length / skeleton.length)
    slow = _CHANGE_S / step_s
    change = np.maximum.accumulate(
        np.where(rng.random(n_frames) < 1.0 / slow, np.arange(n_frames), 0)
    )
    drawn = draw_angles(rng, skeleton, n_frames)[change].reshape(n_frames, -1)
    angles = smoothed(drawn, 0.4 * slow).reshape(n_frames, -1, 3)
    speed = np.maximum(smoothed(rng.normal(0.4, 0.8, (n_frames, 1)), slow)[:, 0], 0.0)
    turning = smoothed(rng.normal(0.0, 3.0, (n_frames, 1)), slow)[:, 0]
    level = np.zeros(n_frames)
    body = shape[0].broadcast(n_frames)
    flat = _centred(skeleton, angles, root_rotation(level, level, level), size)
    low, high = species._extent(flat, body, size)
    top = (
        _NEAR_SHARE * float(scene.T_arena_camera.translation[2]) - float(high.max())
        if species.floats
        else 0.0
    )
    water = (-float(low.min()) + 1.0, max(top, -float(low.min()) + 1.0))
    position, heading = wander(rng, scene, length, speed, turning, level, water, step_s)
    pose = _centred(skeleton, angles, root_rotation(heading, level, level), size)
    pose.root.translation[:] += position
    if not species.floats:
        pose.root.translation[:, 2] -= position[:, 2] + low
    contents = assemble(
        rng,
        scene,
        sensor,
        species,
        length,
        shape,
        pose,
        size,
        noise,
        erosion_px,
        thing_share,
        False,
    )
    return SyntheticSession(
        name, scene, contents, np.arange(n_frames, dtype=np.int64) * species.frame_ns
    )
