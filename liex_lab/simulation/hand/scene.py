"""Scene model of an outstretched hand: arm, body and wall behind it, objects next to it.

Torso, head and objects are superellipsoids, arms are capsules, the wall is a plane 1 / z = a u + b
v + c. Everything is in the camera frame; a palm's orientation is drawn in the view along its line
of sight, so that a hand's appearance does not depend on its position in the image.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from liex_lab.body._skinning_kernels import CAPSULE_RINGS, CAPSULE_SEGMENTS, joined_faces
from liex_lab.body.capsules import Capsules
from liex_lab.body.hand_shape import N_ARM_CAPSULES, HandShape, arm_vertices, forearms
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.runtime.threads import threads
from liex_lab.scene.hand_segmenter import sight_rotations
from liex_lab.simulation import _render_kernels as kernels
from liex_lab.simulation._render_kernels import PatchCamera, SensorNoise
from liex_lab.simulation._sensor_kernels import NORMAL
from liex_lab.simulation.scene import PART_FACES, SPHERE, rounded

Array = NDArray[np.float64]

DISTANCE_MM = (400.0, 1200.0)
ARM_FACES = joined_faces([(CAPSULE_RINGS, CAPSULE_SEGMENTS)] * N_ARM_CAPSULES)
_N_BODY_PARTS = 3  # torso, head, and another object behind
BODY_FACES = np.concatenate([PART_FACES + k * len(SPHERE) for k in range(_N_BODY_PARTS)]).astype(
    np.int32
)
_EDGE_MM = 110.0  # minimum distance of the palm from the image border


@dataclass(frozen=True)
class HandFrameContents:
    """Hands, n of them, and their surroundings, in the camera frame.

    Attributes:
        pose: (n) of the hands.
        joints: (n, J, 3) mm.
        spine_mm: (n,) lengths of the hands, mm.
        hand: (n, V, 3) meshes of the hands, mm.
        arm: (n, A, 3) meshes of the arms, mm.
        body: (n, B, 3) meshes of torso, head and another object, mm.
        thing: (n, W, 3) meshes of the distractors, mm.
        shown: (n,) bool, whether the distractor is present.
        wall: (n, 4) planes behind everything and their unevenness, as in `_render_kernels.picture`.
        parameters: (n, N_PARAMETERS) of the sensors.
        seeds: (n,) uint64 of their noise.
        thing_faces: (F, 3) int32, triangles of the distractors' meshes.
    """

    pose: Pose
    joints: Array
    spine_mm: Array
    hand: Array
    arm: Array
    body: Array
    thing: Array
    shown: NDArray[np.bool_]
    wall: Array
    parameters: Array
    seeds: NDArray[np.uint64]
    thing_faces: NDArray[np.int32] = field(default_factory=lambda: PART_FACES)

    def __getitem__(self, index: slice | NDArray[np.int64]) -> HandFrameContents:
        """A subset of the images.

        Args:
            index: slice or row numbers.
        """
        columns = [column.name for column in fields(self) if column.name != "thing_faces"]
        return replace(self, **{name: getattr(self, name)[index] for name in columns})

    def pictures(
        self,
        faces: NDArray[np.int32],
        intrinsics: Array,
        size: NDArray[np.int64],
        origin: NDArray[np.int64],
        shape: tuple[int, int],
        parallel: bool = True,
    ) -> NDArray[np.uint16]:
        """Render depth images.

        Args:
            faces: (F, 3) int32, triangles of the hands' meshes, see `hand_faces`.
            intrinsics: (n, 4) fx, fy, cx, cy, px.
            size: (n, 2) int64 width and height of the whole images, px.
            origin: (n, 2) int64 first pixel (u, v) of the rendered part of the whole images.
            shape: rows and columns of the rendered part.
            parallel: render on all threads.

        Returns:
            (n, *shape) uint16 mm, 0 if unread.
        """
        out = np.empty((len(self.seeds), *shape), np.uint16)
        with threads(parallel):
            kernels.pictures(
                kernels.HandMeshes(
                    self.hand,
                    faces,
                    self.arm,
                    ARM_FACES,
                    self.body,
                    BODY_FACES,
                    self.thing,
                    self.thing_faces,
                    self.shown,
                ),
                self.wall,
                PatchCamera(intrinsics, size, origin),
                SensorNoise(self.parameters, self.seeds, NORMAL),
                out,
            )
        return out


def hold_out(
    rng: np.random.Generator,
    skeleton: Skeleton,
    angles: Array,
    turns: Array,
    size: Array,
    p_camera: Array,
) -> Pose:
    """Poses of hands at given points, oriented relative to the lines of sight.

    Args:
        rng: not used.
        skeleton: not used.
        angles: (n, J, 3) joint angles, rad.
        turns: (n, 3, 3) T_view_palm, in the view along the line of sight to the palm.
        size: (n,) over home size.
        p_camera: (n, 3) of the palms, mm, camera frame.

    Returns:
        Poses (n) in the camera frame.
    """
    rotation = np.swapaxes(sight_rotations(p_camera), 1, 2) @ turns
    return Pose(SE3(rotation, p_camera), angles, size)


def draw_places(
    rng: np.random.Generator, intrinsics: Array, picture: Array, low: Array, high: Array
) -> Array:
    """Points between two depths and inside their images, uniform in the image.

    Args:
        rng: random number generator.
        intrinsics: (n, 4) fx, fy, cx, cy, px.
        picture: (n, 2) image width and height, px.
        low: (n,) smallest depths, mm.
        high: (n,) largest depths, mm.

    Returns:
        (n, 3) mm, camera frame.
    """
    n = len(low)
    depth = rng.uniform(low, high)
    margin = np.minimum(_EDGE_MM * intrinsics[:, 0] / depth, 0.45 * picture.min(axis=1))
    uv = margin[:, None] + rng.random((n, 2)) * (picture - 2.0 * margin[:, None])
    xy = (uv - intrinsics[:, 2:]) / intrinsics[:, :2] * depth[:, None]
    return np.concatenate([xy, depth[:, None]], axis=1)


def assemble(
    rng: np.random.Generator,
    skeleton: Skeleton,
    pose: Pose,
    shape: HandShape,
    size: Array,
    intrinsics: Array,
    parameters: Array,
    thing_share: float,
    scenery: int,
    wrists: Array | None = None,
) -> HandFrameContents:
    """Hands with their arms, bodies, walls and distractors.

    Args:
        rng: random number generator.
        skeleton: of the hand.
        pose: (n) camera frame.
        shape: (n) the people's hands.
        size: (n,) over home size.
        intrinsics: (n, 4) fx, fy, cx, cy, px.
        parameters: (n, N_PARAMETERS) of the sensors.
        thing_share: share of images with a distractor next to the hand.
        scenery: number of consecutive images that share body and wall.
        wrists: (n, 3) wrist rotations, rad; None draws one for every image.

    Returns:
        The contents of n images.
    """
    n = len(size)
    rotations, positions = shape.joints(skeleton, pose)
    hand = shape.flesh.vertices(rotations, positions, pose.scale, pose.scale)
    each = np.arange(n) // scenery
    n_scenes = int(each[-1]) + 1
    frame, elbow = forearms(rng, rotations, positions, pose.scale, wrists)
    body, shoulder = _bodies(positions, elbow, frame[:, :, 0], rng.random((n_scenes, 3, 8))[each])
    arm = arm_vertices(frame, elbow, shoulder, pose.scale, shape.arm)
    thing, shown = _things(rng, hand, thing_share)
    wall = _walls(rng, n_scenes, intrinsics[::scenery][:n_scenes], hand, body)[each]
    seeds = rng.integers(1, 2**63, n).astype(np.uint64)
    return HandFrameContents(
        pose,
        positions,
        size * skeleton.length,
        hand,
        arm,
        body,
        thing,
        shown,
        wall,
        parameters,
        seeds,
    )


def _bodies(joints: Array, elbow: Array, forward: Array, u: Array) -> tuple[Array, Array]:
    """Torso, head and one more object (n, V, 3) mm behind each hand, and the shoulders (n, 3) mm.

    The arms lead to the shoulders. u (n, 3, 8) in [0, 1) sets position, size and presence of the
    three. Without a torso the arm continues straight out of the image.
    """
    n = len(joints)
    behind = np.maximum(joints[:, :, 2].max(axis=1), elbow[:, 2])
    radii = np.empty((n, 3, 3))
    centre = np.empty((n, 3, 3))
    radii[:, 0] = [150.0, 260.0, 90.0] + u[:, 0, :3] * [60.0, 80.0, 60.0]
    centre[:, 0, 0] = elbow[:, 0] + (2.0 * u[:, 0, 3] - 1.0) * 300.0
    centre[:, 0, 1] = elbow[:, 1] + (u[:, 0, 4] - 0.4) * 400.0
    centre[:, 0, 2] = behind + 110.0 + 450.0 * u[:, 0, 5] ** 2 + radii[:, 0, 2]
    side = np.where(centre[:, 0, 0] > elbow[:, 0], -1.0, 1.0)
    shoulder = centre[:, 0] + radii[:, 0] * np.stack(
        [0.7 * side, np.full(n, -0.6), np.full(n, -0.2)], axis=1
    )
    radii[:, 1] = [75.0, 105.0, 90.0] + u[:, 1, :3] * 20.0
    centre[:, 1] = centre[:, 0]
    centre[:, 1, 0] += 60.0 * (u[:, 1, 3] - 0.5)
    centre[:, 1, 1] -= radii[:, 0, 1] + 110.0
    centre[:, 1, 2] = np.maximum(
        centre[:, 1, 2] - 120.0 * (u[:, 1, 4] - 0.4), behind + 60.0 + radii[:, 1, 2]
    )
    radii[:, 2] = 60.0 + 200.0 * u[:, 2, :3]
    centre[:, 2, :2] = centre[:, 0, :2] + (2.0 * u[:, 2, 3:5] - 1.0) * 500.0
    centre[:, 2, 2] = behind + 120.0 + radii[:, 2, 2] + 900.0 * u[:, 2, 5]
    power = np.stack([2.0 + u[:, 0, 6], 2.0 + 0.0 * u[:, 1, 6], 2.0 + 8.0 * u[:, 2, 6]], axis=1)
    alone = u[:, 0, 7] < 0.25
    shoulder[alone] = (elbow - 800.0 * forward)[alone]
    radii[alone, :2] = 0.01
    radii[u[:, 2, 7] < 0.4, 2] = 0.01
    return rounded(
        centre, radii, np.pi * (2.0 * u[:, :, 6] - 1.0) * [0.1, 0.0, 1.0], power
    ).reshape(n, -1, 3), shoulder


def _things(rng: np.random.Generator, hand: Array, share: float) -> tuple[Array, NDArray[np.bool_]]:
    """A block or ball (n, V, 3) mm next to each hand at about its depth, and its presence (n,)."""
    n = len(hand)
    radii = rng.uniform(15.0, 60.0, (n, 3))
    direction = rng.uniform(-np.pi, np.pi, n)
    toward = np.stack([np.cos(direction), np.sin(direction)], axis=-1)
    reach = np.einsum("nvk,nk->nv", hand[..., :2], toward).max(axis=1)
    middle = hand.mean(axis=1)
    clear = reach - np.sum(middle[:, :2] * toward, axis=1) + np.hypot(radii[:, 0], radii[:, 1])
    offset = (clear + rng.uniform(10.0, 80.0, n))[:, None] * toward
    depth = np.maximum(middle[:, 2] + rng.uniform(-30.0, 160.0, n), 300.0)
    # an object farther away needs a larger offset to appear next to the hand, not behind it
    centre = np.column_stack(
        [
            (middle[:, :2] + offset) * (np.maximum(depth, middle[:, 2]) / middle[:, 2])[:, None],
            depth,
        ]
    )
    power = np.where(rng.random(n) < 0.5, 2.0, 8.0)
    return rounded(centre, radii, rng.uniform(-np.pi, np.pi, n), power), rng.random(n) < share


def _walls(rng: np.random.Generator, m: int, intrinsics: Array, hand: Array, body: Array) -> Array:
    """A randomly sloped plane (m, 4) behind everything; out of range in a fifth of the scenes."""
    farthest = max(float(hand[..., 2].max()), float(np.quantile(body[..., 2], 0.9)))
    distance = np.minimum(farthest, 2000.0) + rng.uniform(150.0, 1500.0, m)
    slope = rng.normal(0.0, 0.25, (m, 2))
    a = slope[:, 0] / intrinsics[:, 0] / distance
    b = slope[:, 1] / intrinsics[:, 1] / distance
    c = 1.0 / distance - a * intrinsics[:, 2] - b * intrinsics[:, 3]
    wall = np.stack([a, b, c, rng.uniform(0.0, 6.0, m)], axis=1)
    wall[rng.random(m) < 0.2, :3] = 0.0
    return wall


def hand_faces(skeleton: Skeleton) -> NDArray[np.int32]:
    """Triangles of the hands' meshes.

    Returns:
        (F, 3) int32.
    """
    return Capsules.of(skeleton).faces
