"""Simulator of the hand: training patches, test splits and gestures, rendered for an NYU camera.

Hands are drawn from anatomy (`postures.py`), posed relative to the line of sight, combined with an
arm, a body and a wall, and passed through a structured-light noise model. Test postures come from
labelled frames of a person of the NYU Hand Pose data set (Tompson et al. 2014) if that reference is
available.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.body._skinning_kernels import CAPSULE_RINGS, CAPSULE_SEGMENTS, joined_faces
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.body.variation import N_ARM_CAPSULES, HandShape, arm_vertices, draw_hands, forearms
from liex_lab.errors import LiexError
from liex_lab.geometry import SE3, so3
from liex_lab.recordings.formats.images.nyu import (
    LABEL_CAMERA,
    N_FIRST_PERSON,
    REFERENCE_FILE,
    NyuReference,
    fit_hands,
)
from liex_lab.runtime.memory import Rows
from liex_lab.runtime.processes import in_parallel
from liex_lab.scene.floor import Floor
from liex_lab.scene.hand_segmenter import sight_rotations
from liex_lab.simulation import _render_kernels as kernels
from liex_lab.simulation._render_kernels import PatchCamera, SensorNoise, part_of
from liex_lab.simulation._sensor_kernels import (
    ANIMAL,
    N_PARAMETERS,
    NORMAL,
    OBJECT,
    PRIMESENSE_KIND,
)
from liex_lab.simulation.hand.postures import draw_postures, draw_turns
from liex_lab.simulation.pose_prior import SIZE_RANGE
from liex_lab.simulation.recording import (
    FRAME_NS,
    OTHER_CAMERA,
    TrueRecording,
    planned,
    whole_images,
)
from liex_lab.simulation.scene import PART_FACES, SPHERE_TUBE, rounded
from liex_lab.simulation.species import KINECT_V2_SENSOR, Sensor, unseen
from liex_lab.simulation.training_patches import BLOCK, PER_SESSION, TrainingPatches, degrade

Array = NDArray[np.float64]

# Location of the labelled hands to which test postures are fitted.


VARIABLE = "LIEX_NYU"


def find_reference() -> Path | None:
    """Find the folder of labelled hands: `LIEX_NYU`, else the one next to the repository.

    Returns:
        `LIEX_NYU`, or `../shared/data/hand_nyu` of the repository that contains this file; None if
        the variable is not set and that folder has no labels.

    Raises:
        LiexError: `LIEX_NYU` names a folder without labels.
    """
    if stated := os.environ.get(VARIABLE):
        folder = Path(stated)
        if not (folder / REFERENCE_FILE).is_file():
            raise LiexError(
                f"{VARIABLE} should name a folder with {REFERENCE_FILE}, labels of NYU hands, but "
                f"{folder} holds none; name another one, or unset it"
            )
        return folder
    folder = Path(__file__).resolve().parents[4] / "shared" / "data" / "hand_nyu"
    return folder if (folder / REFERENCE_FILE).is_file() else None


# Trajectories of hand gestures: geodesics in SO(3), straight lines in angles, cosine timing.


_SHORTEST_S = 0.25  # of a move


def draw_gestures(
    rng: np.random.Generator, skeleton: Skeleton, n: int, step_s: float, middle: Array
) -> tuple[Array, Array, Array, Array]:
    """A sequence of postures near one point, joined by smooth moves.

    The duration of a move is that of its slowest part (rotation, bending or translation) at a
    random speed, at least 0.25 s.

    Args:
        rng: random number generator.
        skeleton: of the hand.
        n: number of moments.
        step_s: between two moments, s.
        middle: (3,) centre of the gestures, mm, camera frame.

    Returns:
        At n moments: joint angles (n, J, 3) rad, T_view_palm (n, 3, 3), places (n, 3) of the palm,
        mm, camera frame, and rotations (n, 3) of the wrist, rad.
    """
    keys = 2 + int(n * step_s / _SHORTEST_S)
    angles, turns = draw_postures(rng, skeleton, keys), draw_turns(rng, keys)
    places = middle * rng.uniform(0.93, 1.07, (keys, 1)) + rng.normal(0.0, 15.0, (keys, 3))
    wrists = rng.normal(0.0, 1.0, (keys, 3)) * np.radians([0.0, 22.0, 12.0])
    turning = so3.log(np.swapaxes(turns[:-1], 1, 2) @ turns[1:])
    bending, going, leaning = (np.diff(values, axis=0) for values in (angles, places, wrists))
    # peak speeds of a move: rotation of the palm and of the fastest finger joint, rad/s, and
    # translation of the palm, mm/s
    # the fastest moment of a cosine is pi/2 times the mean
    moves = (
        0.5
        * np.pi
        * np.max(
            [
                np.linalg.norm(turning, axis=-1) / rng.uniform(2.0, 6.0, keys - 1),
                np.abs(bending).max(axis=(1, 2)) / rng.uniform(5.0, 12.0, keys - 1),
                np.linalg.norm(going, axis=-1) / rng.uniform(200.0, 700.0, keys - 1),
                np.full(keys - 1, _SHORTEST_S / (0.5 * np.pi)),
            ],
            axis=0,
        )
    )
    starts = np.concatenate([[0.0], np.cumsum(moves + rng.uniform(0.0, 0.6, keys - 1))])
    now = step_s * np.arange(n)
    at = np.clip(np.searchsorted(starts, now, side="right") - 1, 0, keys - 2)
    share = 0.5 - 0.5 * np.cos(np.pi * np.clip((now - starts[at]) / moves[at], 0.0, 1.0))[:, None]
    return (
        angles[at] + share[..., None] * bending[at],
        turns[at] @ so3.exp(share * turning[at]),
        places[at] + share * going[at],
        wrists[at] + share * leaning[at],
    )


ARM_FACES = joined_faces([(CAPSULE_RINGS, CAPSULE_SEGMENTS)] * N_ARM_CAPSULES)
# torso, head, and another object behind
BODY_FACES = joined_faces([SPHERE_TUBE] * 3)


@dataclass(frozen=True)
class HandFrameContents(Rows):
    """Hands, n of them, and their surroundings, in the camera frame.

    Attributes:
        pose: (n) of the hands.
        joints: (n, J, 3) mm.
        spine_mm: (n,) lengths of the hands, mm.
        hand: (n, V, 3) meshes of the hands, mm.
        arm: (n, A, 3) meshes of the arms, mm.
        body: (n, B, 3) meshes of torso, head and another object, mm.
        objects: (n, W, 3) meshes of the distractors, mm.
        shown: (n,) bool, whether the distractor is present.
        wall: (n, 4) planes behind the scene and their unevenness, as in `kernels.draw_hands`.
        parameters: (n, N_PARAMETERS) of the sensors.
        seeds: (n,) uint64 of their noise.
        faces: (F, 3) int32, triangles of the hands' meshes.
        object_faces: (G, 3) int32, triangles of the distractors' meshes.
    """

    SHARED = ("faces", "object_faces")
    pose: Pose
    joints: Array
    spine_mm: Array
    hand: Array
    arm: Array
    body: Array
    objects: Array
    shown: NDArray[np.bool_]
    wall: Array
    parameters: Array
    seeds: NDArray[np.uint64]
    faces: NDArray[np.int32]
    object_faces: NDArray[np.int32] = field(default_factory=lambda: PART_FACES)

    def images(self, cameras: PatchCamera, shape: tuple[int, int]) -> NDArray[np.uint16]:
        """Render depth images.

        Args:
            cameras: of the n images.
            shape: rows and columns of the rendered part.

        Returns:
            (n, *shape) uint16 mm, 0 if unread.
        """
        parts = (
            part_of(self.body, BODY_FACES, OBJECT),
            part_of(self.objects, self.object_faces, OBJECT, self.shown),
            part_of(self.arm, ARM_FACES, ANIMAL),
            part_of(self.hand, self.faces, ANIMAL),
        )
        noises = SensorNoise(self.parameters, self.seeds, NORMAL)
        out = np.empty((len(self.seeds), *shape), np.uint16)
        in_parallel(kernels.draw_hands, len(out), parts, self.wall, cameras, noises, out)
        return out


def pose_hands(angles: Array, turns: Array, size: Array, p_camera: Array) -> Pose:
    """Poses of hands at given points, oriented relative to the lines of sight.

    Args:
        angles: (n, J, 3) joint angles, rad.
        turns: (n, 3, 3) T_view_palm, in the view along the line of sight to the palm.
        size: (n,) relative to the skeleton's home size.
        p_camera: (n, 3) of the palms, mm, camera frame.

    Returns:
        Poses (n) in the camera frame.
    """
    rotation = np.swapaxes(sight_rotations(p_camera), 1, 2) @ turns
    return Pose(SE3(rotation, p_camera), angles, size)


def draw_places(
    rng: np.random.Generator, intrinsics: Array, size_px: Array, low: Array, high: Array
) -> Array:
    """Points between two depths and inside their images, uniform in the image.

    Args:
        rng: random number generator.
        intrinsics: (n, 4) fx, fy, cx, cy, px.
        size_px: (n, 2) image width and height, px.
        low: (n,) smallest depths, mm.
        high: (n,) largest depths, mm.

    Returns:
        (n, 3) mm, camera frame.
    """
    n = len(low)
    depth = rng.uniform(low, high)
    # minimum distance of the palm from the image border
    margin = np.minimum(110.0 * intrinsics[:, 0] / depth, 0.45 * size_px.min(axis=1))
    uv = margin[:, None] + rng.random((n, 2)) * (size_px - 2.0 * margin[:, None])
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
    object_share: float,
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
        object_share: share of images with a distractor next to the hand.
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
    item, shown = _objects(rng, hand, object_share)
    wall = _walls(rng, n_scenes, intrinsics[::scenery][:n_scenes], hand, body)[each]
    seeds = rng.integers(1, 2**63, n).astype(np.uint64)
    return HandFrameContents(
        pose,
        positions,
        size * skeleton.length,
        hand,
        arm,
        body,
        item,
        shown,
        wall,
        parameters,
        seeds,
        shape.flesh.faces,
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


def _objects(
    rng: np.random.Generator, hand: Array, share: float
) -> tuple[Array, NDArray[np.bool_]]:
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
    a, b = (slope[:, k] / intrinsics[:, k] / distance for k in range(2))
    c = 1.0 / distance - a * intrinsics[:, 2] - b * intrinsics[:, 3]
    wall = np.stack([a, b, c, rng.uniform(0.0, 6.0, m)], axis=1)
    wall[rng.random(m) < 0.2, :3] = 0.0
    return wall


NYU_SENSOR = Sensor("NYU Kinect", LABEL_CAMERA, PRIMESENSE_KIND)
# name: (own seed, shape family, noise, eroded pixels, share of frames with another object next to
# the hand)
SPLITS = {
    "clean": (81_001, "train", 1.0, 0, 0.0),
    "hard": (82_001, "train", 2.0, 1, 0.5),
    "other-body": (84_001, "other", 1.0, 0, 0.0),
    OTHER_CAMERA: (85_001, "train", 1.0, 0, 0.0),
}
_SEALED_SEED = 980_413  # of the held-out split, see `recording.SEALED`
# training images: (sensor, sensor pixels per image pixel, nearest and farthest hand, share)
_KINDS = (
    (NYU_SENSOR, 1, 620.0, 1200.0, 0.55),
    (NYU_SENSOR, 2, 400.0, 700.0, 0.20),
    (KINECT_V2_SENSOR, 1, 400.0, 1000.0, 0.25),
)


class HandSession(TrueRecording):
    """A virtual recording of one person's hand; the joints are the person's own.

    It has no floor: a plane perpendicular to the optical axis, at 1300 mm, replaces it and defines
    the arena frame.

    Attributes:
        sensor: the camera's make.
        contents: the hand and its surroundings, n frames.
    """

    def __init__(
        self,
        name: str,
        skeleton: Skeleton,
        sensor: Sensor,
        contents: HandFrameContents,
        times_ns: NDArray[np.int64] | None = None,
    ) -> None:
        """A recording of given contents.

        Args:
            name: of the recording.
            skeleton: of the hand.
            sensor: the camera's make.
            contents: the hand and its surroundings, n frames, camera frame.
            times_ns: (n,) int64 time stamps, ns; None counts steps of `FRAME_NS`.
        """
        times = np.arange(len(contents.seeds)) * FRAME_NS if times_ns is None else times_ns
        floor = Floor.from_plane(np.array([0.0, 0.0, 1.0]), 1300.0, sensor.camera)
        super().__init__(
            name,
            sensor.camera,
            times,
            skeleton=skeleton,
            spine_mm=float(contents.spine_mm[0]),
            pose=contents.pose,
            T_arena_camera=floor.T_arena_camera,
            floor=floor,
            joints_camera=contents.joints,
        )
        self.sensor = sensor
        self.contents = contents

    def depths(self, start: int, stop: int) -> NDArray[np.float32]:
        """Depth images of a range of frames, rendered on all threads.

        Args:
            start: first frame.
            stop: one past the last frame.

        Returns:
            (stop - start, H, W) float32 mm, 0 if unread.
        """
        c = self.sensor.camera
        cameras = whole_images(c, stop - start)
        some = self.contents[start:stop]
        return some.images(cameras, (c.height, c.width)).astype(np.float32)


# angles, T_view_palm, places and wrist rotations of n hands, see `draw_gestures`
_Acted = tuple[Array, Array, Array, Array | None]


@dataclass(frozen=True)
class HandSimulator:
    """Simulator of a right hand in front of a depth camera.

    Attributes:
        skeleton: of the hand.
        reference: folder with labelled hands for the test postures; None draws them as those of
            the training images.
        splits: names of the test splits.
        sources: source of the training images, one phrase.
    """

    skeleton: Skeleton
    reference: Path | None = None
    splits: tuple[str, ...] = tuple(SPLITS)
    sources: str = (
        "rendered from a seed; bones and postures from published anatomy; no depth image and no "
        "label of a real hand was used"
    )

    @property
    def protocol(self) -> str:
        """One sentence on the test splits, for reports of results."""
        return (
            "each recording shows another person's right hand in front of an NYU camera (another "
            "camera in other-camera); the software finds the hand and its size itself; flips are "
            "detected by the direction from the palm to the wrist. "
            f"Postures: {self.test_postures}. "
        )

    @property
    def test_postures(self) -> str:
        """Source of the postures of the test splits, one phrase."""
        return (
            "drawn from the anatomy of hands and arms, as for the training images"
            if self.reference is None
            else f"fitted to the labels of the NYU test frames from {N_FIRST_PERSON + 1} on"
        )

    def training_blocks(
        self,
        seed: int,
        n_blocks: int,
        *,
        first: int = 0,
        family: str = "train",
        degraded_share: float = 0.0,
        spine_mm: float | None = None,
        window_px: int = 320,
    ) -> Iterator[TrainingPatches]:
        """Blocks of training patches with truth; see `training_patches.training_blocks`."""
        skeleton = self.skeleton
        m = BLOCK // PER_SESSION
        each = np.repeat(np.arange(m), PER_SESSION)
        nominal = 1.0 if spine_mm is None else spine_mm / skeleton.length
        flat = np.zeros((BLOCK, 3))
        for number in range(first, first + n_blocks):
            rng = np.random.default_rng([seed, number, 1])
            cameras = _draw_cameras(rng, m)
            degrade(rng, cameras[-1], degraded_share)
            shape = draw_hands(rng, skeleton, family, m)[each]
            size = (nominal * rng.uniform(*SIZE_RANGE, m))[each]
            kind, size_px = cameras[0][each], cameras[2][each]
            intrinsics, parameters = cameras[1][each], cameras[3][each]
            low, high = np.array([k[2:4] for k in _KINDS]).T[:, kind]
            turns = draw_turns(rng, BLOCK, anywhere=0.4)
            places = draw_places(rng, intrinsics, size_px.astype(float), low, high)
            pose = pose_hands(draw_postures(rng, skeleton, BLOCK), turns, size, places)
            contents = assemble(
                rng, skeleton, pose, shape, size, intrinsics, parameters, 0.15, PER_SESSION
            )
            uv = contents.hand[..., :2] / contents.hand[..., 2:] * intrinsics[:, None, :2]
            uv = uv + intrinsics[:, None, 2:]
            shift = rng.uniform(-0.08, 0.08, (BLOCK, 2)) * window_px
            middle = (uv.min(axis=1) + uv.max(axis=1)) / 2.0
            origin = np.floor(middle - window_px / 2.0 + shift).astype(np.int64)
            # an arm leaves a window as it leaves an image
            origin = np.clip(origin, 0, np.maximum(size_px - window_px, 0))
            depth = contents.images(
                PatchCamera(intrinsics, size_px, origin), (window_px, window_px)
            )
            yield TrainingPatches(
                depth,
                np.broadcast_to(np.zeros(1, np.uint16), depth.shape),
                origin.astype(np.int32),
                intrinsics,
                flat,
                pose.root,
                pose.angles,
                pose.scale,
                contents.joints,
                contents.spine_mm,
                shape,
                own_bones=True,
            )

    def test_split(
        self, name: str, spine_mm: float | None = None, n_sessions: int = 40
    ) -> list[HandSession]:
        """The recordings of a split: by default 40 of 50 independent frames, each of another hand.

        Args:
            name: 'clean', 'hard', 'other-body', 'other-camera', or 'sealed', see
                `recording.SEALED`.
            spine_mm: length of every hand, mm; None draws it.
            n_sessions: number of recordings, from the first on.

        Returns:
            The recordings, recording k named after the split and k.

        Raises:
            LiexError: there is no split of this name.
        """
        others = unseen((NYU_SENSOR, KINECT_V2_SENSOR))
        sessions = []
        for turn, kind, settings in planned(name, n_sessions, SPLITS, _SEALED_SEED):
            sensor = others[turn % len(others)] if kind == OTHER_CAMERA else NYU_SENSOR
            settings |= {"sensor": sensor, "spine_mm": spine_mm}
            sessions.append(self._film(50, self._test_hands, **settings))
        return sessions

    def _film(
        self,
        n_frames: int,
        act: Callable[[np.random.Generator, PatchCamera], _Acted],
        *,
        seed: int | list[int],
        sensor: Sensor = NYU_SENSOR,
        family: str = "train",
        noise: float = 1.0,
        erosion_px: int = 0,
        object_share: float = 0.0,
        spine_mm: float | None = None,
        name: str = "gestures",
    ) -> HandSession:
        """A recording of one person, whose angles, orientations, places and wrists `act` draws."""
        rng = np.random.default_rng(seed)
        skeleton = self.skeleton
        drawn = float(rng.uniform(*SIZE_RANGE))
        size = np.full(n_frames, drawn if spine_mm is None else spine_mm / skeleton.length)
        shape = draw_hands(rng, skeleton, family, 1)[np.zeros(n_frames, np.int64)]
        cameras = whole_images(sensor.camera, n_frames)
        angles, turns, places, wrists = act(rng, cameras)
        parameters = np.repeat(
            sensor.draw(rng, 1, np.zeros(1), noise, erosion_px), n_frames, axis=0
        )
        contents = assemble(
            rng,
            skeleton,
            pose_hands(angles, turns, size, places),
            shape,
            size,
            cameras.intrinsics,
            parameters,
            object_share,
            1 if wrists is None else n_frames,
            wrists,
        )
        return HandSession(name, skeleton, sensor, contents)

    def _test_hands(self, rng: np.random.Generator, cameras: PatchCamera) -> _Acted:
        """Independent hands, with postures of the reference, or of the training without one."""
        n = len(cameras.size)
        if self.reference is None:
            angles, turns = draw_postures(rng, self.skeleton, n), draw_turns(rng, n)
        else:
            truth = NyuReference.load(self.reference).truth[N_FIRST_PERSON:]
            pose = fit_hands(self.skeleton, rng.choice(truth, n, replace=False)).pose
            angles, turns = (
                pose.angles,
                sight_rotations(pose.root.translation) @ pose.root.rotation,
            )
        places = draw_places(
            rng,
            cameras.intrinsics,
            cameras.size.astype(float),
            *np.array([[400.0], [1200.0]]).repeat(n, axis=1),
        )
        return angles, turns, places, None

    def motion(self, seed: int | list[int], n_frames: int, **settings: Any) -> HandSession:
        """A recording of one person moving from gesture to gesture at 30 frames/s, with pauses.

        Args:
            seed: seed or seeds of all random numbers.
            n_frames: length of the recording.
            **settings: sensor (the NYU camera), family, noise, erosion_px, object_share, spine_mm
                and name, as in `locomotion.moving_session`.

        Returns:
            The recording with its truth.
        """

        def act(rng: np.random.Generator, cameras: PatchCamera) -> _Acted:
            near, far = np.array([[550.0], [850.0]])
            size = cameras.size[:1].astype(float)
            (middle,) = draw_places(rng, cameras.intrinsics[:1], size, near, far)
            return draw_gestures(rng, self.skeleton, n_frames, FRAME_NS * 1e-9, middle)

        return self._film(n_frames, act, seed=seed, **settings)


def _draw_cameras(
    rng: np.random.Generator, m: int
) -> tuple[NDArray[np.int64], Array, NDArray[np.int64], Array]:
    """Kind (m,), intrinsics (m, 4), image size (m, 2) and sensor parameters of m cameras."""
    kind = rng.choice(len(_KINDS), m, p=[k[4] for k in _KINDS])
    focal = rng.uniform(0.97, 1.03, (m, 1))
    axis = rng.normal(0.0, 4.0, (m, 2))
    intrinsics = np.empty((m, 4))
    size_px = np.empty((m, 2), np.int64)
    parameters = np.empty((m, N_PARAMETERS))
    for k, (sensor, coarse, *_) in enumerate(_KINDS):
        rows = kind == k
        c = sensor.camera
        parameters[rows] = sensor.draw(rng, m, np.zeros(m))[rows]
        whole = np.concatenate([focal * [c.fx, c.fy], axis + np.array([c.cx, c.cy])], axis=1)
        intrinsics[rows] = whole[rows] / coarse
        # windows are cut from at least 320 rows
        size_px[rows] = (c.width // coarse, max(c.height // coarse, 320))
    return kind, intrinsics, size_px, parameters
