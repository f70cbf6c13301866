"""Simulator of the hand: training patches, test splits and gestures, rendered for an NYU camera.

Hands are drawn from anatomy (`postures.py`), posed relative to the line of sight, combined with an
arm, a body and a wall, and passed through a structured-light noise model. Test postures come from
labelled frames of a person of the NYU Hand Pose data set (Tompson et al. 2014) if that reference is
available.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body._skinning_kernels import CAPSULE_RINGS, CAPSULE_SEGMENTS, joined_faces
from liex_lab.body.pose import Pose
from liex_lab.body.shape import Surface
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
from liex_lab.scene.floor import Floor
from liex_lab.scene.hand_segmenter import sight_rotations
from liex_lab.simulation import _render_kernels as kernels
from liex_lab.simulation import recording, training_patches
from liex_lab.simulation._sensor_kernels import ANIMAL, PRIMESENSE_KIND
from liex_lab.simulation.hand.postures import draw_postures, draw_turns
from liex_lab.simulation.recording import Actor, Split, Stage, Take
from liex_lab.simulation.rendering import Solid, Views, inverse_depth
from liex_lab.simulation.scene import BOX, SPHERE_TUBE, SimulatedScene, rounded
from liex_lab.simulation.sensors import KINECT_V2_SENSOR, Sensor, draw_units, unseen
from liex_lab.simulation.species import Species
from liex_lab.simulation.training_patches import TrainingPatches

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
class Hand(Actor):
    """A person's hand in n frames, with bones of its own, and its arm.

    Attributes:
        own_joints: (n, J, 3) mm, arena frame.
        hand: (n, V, 3) vertices of the hand, mm, arena frame.
        arm: (n, A, 3) vertices of the arm, mm, arena frame.
    """

    SHARED: ClassVar[tuple[str, ...]] = ()
    body: HandShape
    own_joints: Array
    hand: Array
    arm: Array

    @property
    def joints(self) -> Array:
        """The person's own joints (n, J, 3) mm, arena frame."""
        return self.own_joints

    @property
    def solids(self) -> tuple[Solid, ...]:
        """The hand and the arm."""
        return (
            Solid.of(self.hand, self.body.flesh.faces, self.present, ANIMAL),
            Solid.of(self.arm, ARM_FACES, self.present, ANIMAL),
        )


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
    rng: np.random.Generator,
    intrinsics: Array,
    size_px: NDArray[np.int64],
    low: Array,
    high: Array,
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


def surround(
    rng: np.random.Generator,
    pose: Pose,
    shape: HandShape,
    intrinsics: Array,
    object_share: float,
    scenery: int,
    wrists: Array | None,
    surface: Surface,
    T_arena_camera: SE3,
) -> tuple[Hand, tuple[Solid, ...], Array]:
    """Hands with their arms, and bodies, objects and walls around them.

    Args:
        rng: random number generator.
        pose: (n) camera frame.
        shape: (n) the people's hands.
        intrinsics: (n, 4) fx, fy, cx, cy, px.
        object_share: share of images with an object next to the hand.
        scenery: number of consecutive images that share body and wall.
        wrists: (n, 3) wrist rotations, rad; None draws one for every image.
        surface: the skeleton and its mesh model.
        T_arena_camera: the camera's pose.

    Returns:
        The hands and the objects, and the walls (n, N_GROUND) behind them.
    """
    skeleton, size, n = surface.skeleton, pose.scale, len(pose.scale)
    rotations, positions = shape.joints(skeleton, pose)
    hand = shape.flesh.vertices(rotations, positions, size, size)
    each = np.arange(n) // scenery
    n_scenes = int(each[-1]) + 1
    frame, elbow = forearms(rng, rotations, positions, size, wrists)
    body, shoulder = _bodies(positions, elbow, frame[:, :, 0], rng.random((n_scenes, 3, 8))[each])
    arm = arm_vertices(frame, elbow, shoulder, size, shape.arm)

    def depth(hands: Array) -> tuple[Array, Array]:
        """About that of the hand; farther away an object needs more room not to be behind it."""
        middle = hands[..., 2].mean(axis=1)
        z = np.maximum(middle + rng.uniform(-30.0, 160.0, n), 300.0)
        return z, np.maximum(z, middle) / middle

    radii = rng.uniform(15.0, 60.0, (n, 3))
    item = training_patches.neighbours(rng, hand, radii, (10.0, 80.0), depth, 8.0, object_share)
    walls = _walls(rng, n_scenes, intrinsics[::scenery][:n_scenes], hand, body)[each]
    T, there = T_arena_camera, np.ones(n, np.bool_)
    actor = Hand(
        surface,
        float(size[0] * skeleton.length),
        shape,
        pose.moved(T),
        size,
        None,
        there,
        T @ positions,
        T @ hand,
        T @ arm,
    )
    item = replace(item, mesh=(T @ item.vertices()).__getitem__)
    return actor, (Solid.of(T @ body, BODY_FACES), item), walls


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


def _walls(rng: np.random.Generator, m: int, intrinsics: Array, hand: Array, body: Array) -> Array:
    """A randomly sloped plane behind everything (m, N_GROUND); in four fifths of the scenes."""
    farthest = max(float(hand[..., 2].max()), float(np.quantile(body[..., 2], 0.9)))
    distance = np.minimum(farthest, 2000.0) + rng.uniform(150.0, 1500.0, m)
    normal = np.column_stack([rng.normal(0.0, 0.25, (m, 2)), np.ones(m)])
    walls = np.zeros((m, kernels.N_GROUND))
    walls[:, kernels.FLOOR] = inverse_depth(normal, distance, intrinsics)
    walls[:, kernels.HEIGHT] = distance
    walls[:, kernels.ROUGH] = rng.uniform(0.0, 6.0, m)
    walls[rng.random(m) < 0.2, kernels.FLOOR] = 0.0
    return walls


NYU_SENSOR = Sensor("NYU Kinect", LABEL_CAMERA, PRIMESENSE_KIND)
# as of other animals, with other seeds
SPLITS: Mapping[str, Split] = {
    name: (seed + 10_000, settings) for name, (seed, settings) in recording.SPLITS.items()
}
# training images: (sensor, nearest and farthest hand, share)
_KINDS = (
    (NYU_SENSOR, 620.0, 1200.0, 0.55),
    (replace(NYU_SENSOR, stride=2), 400.0, 700.0, 0.20),
    (KINECT_V2_SENSOR, 400.0, 1000.0, 0.25),
)


# angles, T_view_palm, places and wrist rotations of n hands, see `draw_gestures`
_Acted = tuple[Array, Array, Array, Array | None]


@dataclass(frozen=True)
class HandSpecies(Species):
    """A right hand in front of a depth camera; the joints are the person's own.

    Its recordings have no floor: a plane perpendicular to the optical axis, at 1300 mm, replaces it
    and defines the arena frame.

    Attributes:
        reference: folder with labelled hands for the test postures; None draws them as those of
            the training images.
    """

    skeleton: Skeleton = field(default_factory=lambda: Skeleton.load("hand"))
    sensors: tuple[Sensor, ...] = (NYU_SENSOR,)
    floats: bool = True
    reference: Path | None = None
    splits: ClassVar[Mapping[str, Split]] = SPLITS
    sealed_seed: ClassVar[int] = 980_413
    patch_px: ClassVar[int] = 320
    other_builds: ClassVar[bool] = False
    sources: ClassVar[str] = (
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

    @property
    def other_sensors(self) -> tuple[Sensor, ...]:
        """Cameras that are not used in training."""
        return unseen((NYU_SENSOR, KINECT_V2_SENSOR))

    def _block(
        self,
        rng: np.random.Generator,
        family: str,
        degraded_share: float,
        nominal: float,
        window_px: int,
        per_session: int,
    ) -> TrainingPatches:
        n, surface = training_patches.BLOCK, Surface.of(self.skeleton)
        m = n // per_session
        each = np.repeat(np.arange(m), per_session)
        sensors = tuple(sensor for sensor, *_ in _KINDS)
        nearest, farthest, share = np.array([numbers for _, *numbers in _KINDS]).T
        make = rng.choice(len(_KINDS), m, p=share)
        intrinsics, size_px, parameters = draw_units(rng, sensors, make, np.zeros(m))
        size_px[:, 1] = np.maximum(size_px[:, 1], self.patch_px)
        training_patches.degrade(rng, parameters, degraded_share)
        ground, flat = np.zeros((m, kernels.N_GROUND)), np.zeros((m, 3))
        views = Views(intrinsics, size_px, SE3.identity(m), parameters, ground, flat)[each]
        shape = draw_hands(rng, self.skeleton, family, m)[each]
        size = (nominal * rng.uniform(*self.sizes, m))[each]
        low, high = nearest[make[each]], farthest[make[each]]
        turns = draw_turns(rng, n, anywhere=0.4)
        places = draw_places(rng, views.intrinsics, views.size_px, low, high)
        pose = pose_hands(draw_postures(rng, self.skeleton, n), turns, size, places)
        hand, objects, walls = surround(
            rng,
            pose,
            shape,
            views.intrinsics,
            0.15,
            per_session,
            None,
            surface,
            SE3.identity(),
        )
        seeds = rng.integers(1, 2**63, n).astype(np.uint64)
        shift = rng.uniform(-0.08, 0.08, (n, 2)) * window_px
        # an arm leaves a window as it leaves an image
        origin = views.around(hand.hand, window_px, shift)
        origin = np.clip(origin, 0, np.maximum(views.size_px - window_px, 0))
        depth, _ = replace(views, ground=walls).render(
            [*hand.solids, *objects], seeds, origin, (window_px, window_px)
        )
        return TrainingPatches(
            depth,
            np.broadcast_to(np.zeros(1, np.uint16), depth.shape),
            origin.astype(np.int32),
            views.intrinsics,
            views.floor,
            pose.root,
            pose.angles,
            pose.scale,
            hand.joints,
            size * self.skeleton.length,
            shape,
            own_bones=True,
        )

    def _stage(self, rng: np.random.Generator, take: Take, length: float) -> Stage:
        skeleton, camera, n = self.skeleton, take.sensor.camera, take.n_frames
        shape = draw_hands(rng, skeleton, take.family, 1)[np.zeros(n, np.int64)]
        intrinsics = np.tile(camera.intrinsics, (n, 1))
        size_px = np.tile(np.array([camera.width, camera.height]), (n, 1))
        act = self._gestures if take.moving else self._test_hands
        angles, turns, places, wrists = act(rng, intrinsics, size_px)
        parameters = take.parameters(rng, np.zeros(1))
        pose = pose_hands(angles, turns, np.full(n, length / skeleton.length), places)
        T = Floor.from_plane(np.array([0.0, 0.0, 1.0]), 1300.0, camera).T_arena_camera
        hand, objects, walls = surround(
            rng,
            pose,
            shape,
            intrinsics,
            take.object_share,
            n if take.moving else 1,
            wrists,
            Surface.of(skeleton),
            T,
        )
        scene = SimulatedScene(camera, T, BOX, np.zeros(2), np.full(2, np.inf), 0.0, 0.0)
        return Stage(
            scene,
            skeleton,
            (hand,),
            objects,
            parameters,
            rng.integers(1, 2**63, n).astype(np.uint64),
            np.arange(n) * self.frame_ns,
            scene.still[None],
            np.zeros(n, np.int64),
            walls,
        )

    def _test_hands(
        self, rng: np.random.Generator, intrinsics: Array, size_px: NDArray[np.int64]
    ) -> _Acted:
        """Independent hands, with postures of the reference, or of the training without one."""
        n = len(size_px)
        if self.reference is None:
            angles, turns = draw_postures(rng, self.skeleton, n), draw_turns(rng, n)
        else:
            truth = NyuReference.load(self.reference).truth[N_FIRST_PERSON:]
            pose = fit_hands(self.skeleton, rng.choice(truth, n, replace=False)).pose
            angles, turns = (
                pose.angles,
                sight_rotations(pose.root.translation) @ pose.root.rotation,
            )
        low, high = np.array([[400.0], [1200.0]]).repeat(n, axis=1)
        places = draw_places(rng, intrinsics, size_px, low, high)
        return angles, turns, places, None

    def _gestures(
        self, rng: np.random.Generator, intrinsics: Array, size_px: NDArray[np.int64]
    ) -> _Acted:
        """Moves from gesture to gesture, with pauses."""
        near, far = np.array([[550.0], [850.0]])
        (middle,) = draw_places(rng, intrinsics[:1], size_px[:1], near, far)
        return draw_gestures(rng, self.skeleton, len(size_px), self.frame_ns * 1e-9, middle)
