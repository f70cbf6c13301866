"""Pose prior of a zebrafish in a tank: bodies, travelling waves of bending, depth in the water.

The midline's yaw at arc length s (0 at the base joint, 1 at the end of the chain) consists of two
arcs, joined by a logistic step, plus a travelling wave whose amplitude grows along the body, A
(0.35 + 0.65 s) sin(2 pi s / L - phase), plus four small standing waves (`bend_profile`). The kinds
of posture are those of zebrafish ethograms: glide, scoot, J-turn, C-turn and S-bend.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape
from liex_lab.body.skeleton import Skeleton
from liex_lab.body.surface import Body, joint_reaches, vary_body
from liex_lab.geometry import SE3
from liex_lab.simulation.pose_prior import root_rotation
from liex_lab.simulation.scene import SceneSpec
from liex_lab.simulation.species import RAYTRIX_R5_SENSOR, Postures, Sensor

Array = NDArray[np.float64]

TANK = SceneSpec(
    camera_mm=(230.0, 330.0),
    tilt_rad=float(np.radians(6.0)),
    walls_mm=(30.0, 110.0),
    open_share=0.2,
    clutter=("pellet", "plant"),
    scale=0.3,
)
# at rest or gliding; scooting with waves down the body; J: the hind half bent, C: both halves, S:
# in opposite directions
KINDS = ("glide", "scoot", "j", "c", "s")
SHARES = (0.28, 0.30, 0.14, 0.14, 0.14)
_NEAREST_MM = 180.0  # to the camera: nearer, a large fish does not fit in the image
_FLOOR_SHARE = 0.12  # share of fish just above the floor
_FRONT = 0.47  # front arc's share of the body (as in human annotations)


@dataclass(frozen=True)
class FishSpecies:
    """A zebrafish that swims anywhere in a tank, recorded from above by a Raytrix R5.

    Attributes:
        skeleton: of the fish; by default the preset's.
        sensors: makes of cameras.
        setting: ranges of its tank.
        things: kinds of distractors.
        sizes: smallest and largest fish over the nominal size, 25 and 40 mm over 30.
        floats: True, as it can be anywhere above the floor.
        frame_ns: between two frames of a recording, ns.
    """

    skeleton: Skeleton = field(default_factory=lambda: Skeleton.load("fish"))
    sensors: tuple[Sensor, ...] = (RAYTRIX_R5_SENSOR,)
    setting: SceneSpec = TANK
    things: tuple[str, ...] = ("pellet", "plant", "fish")
    sizes: tuple[float, float] = (25.0 / 30.0, 40.0 / 30.0)
    floats: bool = True
    frame_ns: int = 20_000_000

    def shapes(self, rng: np.random.Generator, family: str, n: int) -> Body:
        """Fish of a family of shapes.

        Args:
            rng: random number generator.
            family: one of `body.shape.FAMILIES`.
            n: number of fish.

        Returns:
            A batch of n bodies.
        """
        return vary_body(rng, self.skeleton, family, n)

    def postures(
        self, rng: np.random.Generator, size: Array, shape: Body, camera_mm: Array
    ) -> Postures:
        """Fish that glide, scoot and turn, mostly level, at any height above the floor.

        Args:
            rng: random number generator.
            size: (n,) of the fish over home size.
            shape: (n) their bodies.
            camera_mm: (n,) heights of the cameras above the floor, mm; the fish stay at least 180
                mm from them.

        Returns:
            The poses with girths and kinds, indices into `KINDS`.
        """
        n = len(size)
        kind = rng.choice(len(KINDS), n, p=SHARES)
        steep = np.where(rng.random(n) < 0.12, 25.0, 8.0)
        pitch = np.clip(rng.normal(0.0, 1.0, n) * steep, -55.0, 55.0)
        roll = np.clip(rng.normal(0.0, 8.0, n), -25.0, 25.0)
        rotation = root_rotation(rng.uniform(-np.pi, np.pi, n), np.radians(pitch), np.radians(roll))
        pose = hung(self.skeleton, draw_bends(rng, self.skeleton, kind), rotation, size)
        low, high = clearance(self.skeleton, pose, shape, size)
        headroom = np.maximum(camera_mm - _NEAREST_MM - high, low + 1.0)
        at = np.where(rng.random(n) < _FLOOR_SHARE, rng.uniform(0.0, 0.06, n), rng.random(n))
        pose.root.translation[:, 2] += low + at * (headroom - low) + rng.uniform(0.5, 2.0, n)
        return Postures(pose, size, kind)

    def bends(self, rng: np.random.Generator, n: int) -> Array | None:
        """None, as the tail is part of the skeleton."""
        return None


def draw_bends(rng: np.random.Generator, skeleton: Skeleton, kind: NDArray[np.int64]) -> Array:
    """Yaw at each joint for kinds of posture, within the skeleton's limits.

    Two arcs, a wave that travels down the body, and small independent bends. Degrees are those of a
    chain of 20 bones; the hind half bends about twice as much as the front half, up to some 7
    degrees per joint in a turn.

    Args:
        rng: random number generator.
        skeleton: of the fish.
        kind: (n,) int64, indices into `KINDS`.

    Returns:
        (n, J) rad.
    """
    n = len(kind)
    side = rng.choice([-1.0, 1.0], n)
    slight = rng.normal(0.0, 1.0, (2, n)) * [[0.6], [1.2]]
    strong = rng.uniform(0.0, 1.0, (2, n))
    front = np.choose(
        kind,
        [
            slight[0],
            1.2 * slight[0],
            1.2 * slight[0],
            side * (2 + 7 * strong[0]),
            side * (1.5 + 5 * strong[0]),
        ],
    )
    hind = np.choose(
        kind,
        [
            slight[1],
            1.5 * slight[1],
            side * (2.5 + 6.5 * strong[1]),
            side * (1.5 + 9 * strong[1]),
            -side * (2 + 6.5 * strong[1]),
        ],
    )
    amplitude = np.choose(
        kind, [0.4, 1.0 + 5.0 * strong[0], 1.5 * strong[0], 1.5 * strong[0], 2.0 * strong[0]]
    )
    phase = rng.uniform(-np.pi, np.pi, n)
    length = rng.uniform(0.7, 1.4, n)
    middle = rng.normal(_FRONT, 0.06, n)
    own = rng.normal(0.0, 0.5, (n, 4))
    return bend_profile(skeleton, front, hind, amplitude, phase, length, middle, own)


def bend_profile(
    skeleton: Skeleton,
    front: Array,
    hind: Array,
    amplitude: Array,
    phase: Array,
    length: Array,
    middle: Array,
    own: Array,
) -> Array:
    """Yaw at each joint of two arcs with a travelling wave.

    With s the joint's share of the body's length, the arcs join in a logistic step of width 0.05 at
    `middle`; the wave is amplitude (0.35 + 0.65 s) sin(2 pi s / length - phase).

    Args:
        skeleton: of the fish; only joints with a yaw axis bend, within their limits.
        front: (n,) bend of the front arc, degrees per joint of 20.
        hind: (n,) bend of the hind arc, degrees per joint of 20.
        amplitude: (n,) of the travelling wave, degrees per joint of 20.
        phase: (n,) of the travelling wave, rad.
        length: (n,) of the travelling wave, over the body's length.
        middle: (n,) position where the arcs meet, over the body's length.
        own: (n, 4) amplitudes of standing waves, degrees per joint of 20.

    Returns:
        (n, J) rad, 0 at the base joint.
    """
    s = joint_reaches(skeleton)
    joint = 20.0 / max(1, skeleton.n_joints - 1)
    share = 1.0 / (1.0 + np.exp(-(s - middle[:, None]) / 0.05))
    arcs = front[:, None] * (1.0 - share) + hind[:, None] * share
    wave = (
        amplitude[:, None]
        * (0.35 + 0.65 * s)
        * np.sin(2 * np.pi * s / length[:, None] - phase[:, None])
    )
    stand = np.stack([np.sin(np.pi * (k + 1) * s + k) for k in range(own.shape[1])])
    yaw = np.radians((arcs + wave + own @ stand) * joint) * skeleton.axes[:, 2]
    yaw[:, 0] = 0.0
    return np.clip(yaw, skeleton.limits[:, 2, 0], skeleton.limits[:, 2, 1])


def hung(skeleton: Skeleton, yaw: Array, rotation: Array, size: Array) -> Pose:
    """Poses with given bends and orientations and the mean of their joints at the origin.

    Args:
        skeleton: of the animal.
        yaw: (n, J) bend at each joint, rad.
        rotation: (n, 3, 3) of the base joint, arena frame.
        size: (n,) over home size.

    Returns:
        Poses (n) in the arena frame.
    """
    angles = np.zeros((*yaw.shape, 3))
    angles[..., 2] = yaw
    pose = Pose(SE3(rotation, np.zeros((len(yaw), 3))), angles, np.asarray(size, float))
    pose.root.translation[:] -= pose.joints(skeleton).mean(axis=1)
    return pose


def clearance(skeleton: Skeleton, pose: Pose, shape: Body, size: Array) -> tuple[Array, Array]:
    """Upper bounds of the extent of bodies below and above the origin.

    Args:
        skeleton: of the animal.
        pose: (n) around the origin.
        shape: (n) their bodies, `BodyShape`.
        size: (n,) over home size.

    Returns:
        Extent below (n,) and above (n,), mm.
    """
    assert isinstance(shape, BodyShape)
    z = pose.joints(skeleton)[..., 2]
    thick = size * shape.half_height.max(axis=-1)
    return thick - z.min(axis=1), thick + z.max(axis=1)
