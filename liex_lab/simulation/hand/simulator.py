"""Simulator of the hand: training patches, test splits and gestures, rendered for an NYU camera.

Hands are drawn from the statistics in `hand.pose_prior`, posed relative to the line of sight,
combined with an arm, a body and a wall, and passed through a structured-light noise model. Test
postures come from another person's labelled frames of the NYU Hand Pose data set (Tompson et al.
2014) if that reference is available.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.hand_shape import HandShape, draw_hands
from liex_lab.body.skeleton import Skeleton
from liex_lab.body.surface import Surface
from liex_lab.errors import LiexError
from liex_lab.geometry import SE3
from liex_lab.recordings.formats.images.nyu import (
    LABEL_CAMERA,
    N_FIRST_PERSON,
    NyuReference,
    fit_hands,
)
from liex_lab.recordings.frame import Depth
from liex_lab.scene.floor import Floor
from liex_lab.scene.hand_segmenter import sight_rotations
from liex_lab.simulation._sensor_kernels import PRIMESENSE_KIND
from liex_lab.simulation.hand import scene
from liex_lab.simulation.hand.pose_prior import DRAWN, FITTED, draw_gestures, draw_seen, draw_wide
from liex_lab.simulation.pose_prior import SIZE_RANGE
from liex_lab.simulation.recording import OTHER_CAMERA, SEALED, TrueRecording, split_of
from liex_lab.simulation.species import KINECT_V2_SENSOR, Sensor, unseen
from liex_lab.simulation.training_patches import BLOCK, PER_SESSION, TrainingPatches, _degrade

Array = NDArray[np.float64]

NYU_SENSOR = Sensor("NYU Kinect", LABEL_CAMERA, PRIMESENSE_KIND)
FRAME_NS = 33_333_333
N_SESSIONS = 40
N_FRAMES = 50
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
_THING_SHARE = 0.15
_LEAST_PX = 320  # smallest height of the images that windows are cut from
_FLAT = np.array([0.0, 0.0, 1.0])
_FLOOR_MM = 1300.0  # depth of the plane that replaces the arena's floor


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
        contents: scene.HandFrameContents,
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
        n = len(contents.seeds)
        times = np.arange(n, dtype=np.int64) * FRAME_NS if times_ns is None else times_ns
        super().__init__(
            name=name, format="synthetic", camera=sensor.camera, times_ns=times, read=self._depth
        )
        self.skeleton = skeleton
        self.sensor = sensor
        self.contents = contents
        self.surface = Surface.of(skeleton)
        self.spine_mm = float(contents.spine_mm[0])
        self.floor = Floor.from_plane(_FLAT, _FLOOR_MM, sensor.camera)
        self.T_arena_camera = self.floor.T_arena_camera
        self.pose = contents.pose
        self.joints_camera = contents.joints
        self.joints_arena = self.T_arena_camera @ contents.joints

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
        c = self.camera
        part = self.contents[slice(start, stop)]
        n = len(part.seeds)
        intrinsics = np.broadcast_to(np.array([c.fx, c.fy, c.cx, c.cy]), (n, 4)).copy()
        size = np.broadcast_to(np.array([c.width, c.height]), (n, 2)).copy()
        faces = scene.hand_faces(self.skeleton)
        return part.pictures(
            faces, intrinsics, size, np.zeros((n, 2), np.int64), (c.height, c.width)
        ).astype(np.float32)


@dataclass(frozen=True)
class HandSimulator:
    """Simulator of a right hand in front of a depth camera.

    Attributes:
        skeleton: of the hand.
        reference: folder with labelled hands (the second person's) for the test postures; None
            draws them from the statistics of the first person.
        splits: names of the test splits.
    """

    skeleton: Skeleton
    reference: Path | None = None
    splits: tuple[str, ...] = tuple(SPLITS)

    @property
    def protocol(self) -> str:
        """One sentence on the test splits, for reports of results."""
        how = (
            "each of another person's right hand before an NYU camera; the hand and its size are "
            "found by the product, nothing is handed over; flips are told by the direction from "
            "the palm to the wrist. "
        )
        as_trained = (
            "as part of the training pictures are"
            if self.reference is None
            else "a person after whom no training picture is drawn"
        )
        return f"{how}Postures: {self.test_postures}, {as_trained}. "

    @property
    def test_postures(self) -> str:
        """Source of the postures of the test splits, one phrase."""
        return DRAWN if self.reference is None else FITTED

    @property
    def sources(self) -> str:
        """Source of the training images, one phrase."""
        return (
            "rendered from a seed; postures partly drawn from statistics of labelled points of "
            f"the NYU Hand Pose test frames 1 to {N_FIRST_PERSON}; no picture of a hand was used"
        )

    def training_blocks(
        self,
        seed: int,
        n_blocks: int,
        *,
        first: int = 0,
        family: str = "train",
        noise: float = 1.0,
        erosion_px: int = 0,
        degraded_share: float = 0.0,
        spine_mm: float | None = None,
        window_px: int = 320,
        parallel: bool = True,
    ) -> Iterator[TrainingPatches]:
        """Blocks of training patches with truth; see `training_patches.training_blocks`.

        The patches have no floor and no background: these are zero.

        Args:
            seed: of the whole set; a block depends only on the seed and its number.
            n_blocks: number of blocks.
            first: number of the first block.
            family: of hand shapes.
            noise: multiplies the sensor's random errors and its rate of holes.
            erosion_px: pixels stripped off the hand's outline.
            degraded_share: share of mini-sessions with more noise; half of them also have more
                erosion.
            spine_mm: mean length of the hands, mm; None uses the skeleton's own.
            window_px: side of the patches, px.
            parallel: render on all threads.

        Yields:
            One set of `BLOCK` patches per block.
        """
        for number in range(first, first + n_blocks):
            rng = np.random.default_rng([seed, number, 1])
            yield self._block(
                rng,
                number,
                family,
                noise,
                erosion_px,
                degraded_share,
                spine_mm,
                window_px,
                parallel,
            )

    def _block(
        self,
        rng: np.random.Generator,
        number: int,
        family: str,
        noise: float,
        erosion_px: int,
        degraded_share: float,
        spine_mm: float | None,
        window_px: int,
        parallel: bool,
    ) -> TrainingPatches:
        """The images of one block."""
        skeleton = self.skeleton
        n = BLOCK
        m = BLOCK // PER_SESSION
        each = np.repeat(np.arange(m), PER_SESSION)
        kind, intrinsics, picture, parameters = _draw_cameras(rng, m, noise, erosion_px)
        _degrade(rng, parameters, degraded_share)
        shape = draw_hands(rng, skeleton, family, m)[each]
        nominal = 1.0 if spine_mm is None else spine_mm / skeleton.length
        size = (nominal * rng.uniform(*SIZE_RANGE, m))[each]
        low, high = np.array([k[2:4] for k in _KINDS]).T[:, kind[each]]
        angles, turns = draw_wide(rng, skeleton, n)
        places = scene.draw_places(rng, intrinsics[each], picture[each].astype(float), low, high)
        pose = scene.hold_out(rng, skeleton, angles, turns, size, places)
        contents = scene.assemble(
            rng,
            skeleton,
            pose,
            shape,
            size,
            intrinsics[each],
            parameters[each],
            _THING_SHARE,
            PER_SESSION,
        )
        uv = (
            contents.hand[..., :2] / contents.hand[..., 2:] * intrinsics[each][:, None, :2]
            + intrinsics[each][:, None, 2:]
        )
        shift = rng.uniform(-0.08, 0.08, (n, 2)) * window_px
        origin = np.floor((uv.min(axis=1) + uv.max(axis=1)) / 2.0 - window_px / 2.0 + shift).astype(
            np.int64
        )
        origin = np.clip(
            origin, 0, np.maximum(picture[each] - window_px, 0)
        )  # an arm leaves a window as it leaves an image
        depth = contents.pictures(
            scene.hand_faces(skeleton),
            intrinsics[each],
            picture[each],
            origin,
            (window_px, window_px),
            parallel,
        )
        flat = np.zeros((n, 3))
        return TrainingPatches(
            depth,
            np.broadcast_to(np.zeros(1, np.uint16), depth.shape),
            origin.astype(np.int32),
            intrinsics[each],
            flat,
            flat,
            SE3.identity(n),
            pose.root,
            pose.angles,
            pose.scale,
            contents.joints,
            contents.spine_mm,
            number * m + each,
            kind[each],
            np.zeros(n, np.int64),
            own_bones=True,
        )

    def test_split(
        self, name: str, spine_mm: float | None = None, n_sessions: int = N_SESSIONS
    ) -> list[HandSession]:
        """The recordings of a split: 40 of 50 independent frames, each of another person.

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
        if name not in (*SPLITS, SEALED):
            raise LiexError(f"there is no split '{name}'; known are {', '.join(SPLITS)}")
        others = unseen((NYU_SENSOR, KINECT_V2_SENSOR))
        sessions = []
        for k in range(n_sessions):
            kind = split_of(name, k)
            seed, family, noise, erosion_px, thing_share = SPLITS[kind]
            turn = k if name != SEALED else k // len(SPLITS)
            sensor = others[turn % len(others)] if kind == OTHER_CAMERA else NYU_SENSOR
            sessions.append(
                self._session(
                    [seed if name != SEALED else _SEALED_SEED, k],
                    f"{name}-{k:02d}",
                    sensor,
                    family,
                    noise,
                    erosion_px,
                    thing_share,
                    spine_mm,
                )
            )
        return sessions

    def _session(
        self,
        seed: list[int],
        name: str,
        sensor: Sensor,
        family: str,
        noise: float,
        erosion_px: int,
        thing_share: float,
        spine_mm: float | None,
    ) -> HandSession:
        """Independent frames of one person."""
        rng = np.random.default_rng(seed)
        n = N_FRAMES
        camera = sensor.camera
        drawn = float(rng.uniform(*SIZE_RANGE))
        size = np.full(n, drawn if spine_mm is None else spine_mm / self.skeleton.length)
        shape = _same(draw_hands(rng, self.skeleton, family, 1), n)
        angles, turns = self._test_postures(rng, n)
        intrinsics = np.broadcast_to(
            np.array([camera.fx, camera.fy, camera.cx, camera.cy]), (n, 4)
        ).copy()
        picture = np.broadcast_to(np.array([camera.width, camera.height]), (n, 2)).copy()
        low, high = np.full((2, n), np.array(scene.DISTANCE_MM)[:, None])
        pose = scene.hold_out(
            rng,
            self.skeleton,
            angles,
            turns,
            size,
            scene.draw_places(rng, intrinsics, picture.astype(float), low, high),
        )
        parameters = np.repeat(sensor.draw(rng, 1, np.zeros(1), noise, erosion_px), n, axis=0)
        contents = scene.assemble(
            rng, self.skeleton, pose, shape, size, intrinsics, parameters, thing_share, 1
        )
        return HandSession(name, self.skeleton, sensor, contents)

    def _test_postures(self, rng: np.random.Generator, n: int) -> tuple[Array, Array]:
        """Angles (n, J, 3) and T_view_palm (n, 3, 3), from the reference (not used in training).

        Without a reference they are drawn from the training statistics.
        """
        if self.reference is None:
            return draw_seen(rng, self.skeleton, n)
        truth = NyuReference.load(self.reference).truth
        rows = N_FIRST_PERSON + rng.choice(len(truth) - N_FIRST_PERSON, n, replace=False)
        pose = fit_hands(self.skeleton, truth[rows]).pose
        return pose.angles, sight_rotations(pose.root.translation) @ pose.root.rotation

    def motion(self, seed: int | list[int], n_frames: int, **settings: Any) -> HandSession:
        """A recording of a hand that moves from one gesture to the next.

        Args:
            seed: seed or seeds of all random numbers.
            n_frames: length of the recording.
            **settings: sensor, family, noise, erosion_px, thing_share, spine_mm and name, see
                `gesture_session`.

        Returns:
            The recording with its truth.
        """
        return gesture_session(self.skeleton, seed, n_frames, **settings)


def gesture_session(
    skeleton: Skeleton,
    seed: int | list[int],
    n_frames: int,
    *,
    sensor: Sensor = NYU_SENSOR,
    family: str = "train",
    noise: float = 1.0,
    erosion_px: int = 0,
    thing_share: float = 0.0,
    spine_mm: float | None = None,
    name: str = "gestures",
) -> HandSession:
    """A recording of one person who moves from gesture to gesture at 30 frames/s, with pauses.

    Args:
        skeleton: of the hand.
        seed: seed or seeds of all random numbers.
        n_frames: length of the recording.
        sensor: the camera's make.
        family: of hand shapes.
        noise: multiplies the sensor's random errors and its rate of holes.
        erosion_px: pixels stripped off the hand's outline.
        thing_share: share of frames with a distractor next to the hand.
        spine_mm: length of the hand, mm; None draws it.
        name: of the recording.

    Returns:
        The recording with its truth.
    """
    rng = np.random.default_rng(seed)
    drawn = float(rng.uniform(*SIZE_RANGE))
    size = np.full(n_frames, drawn if spine_mm is None else spine_mm / skeleton.length)
    shape = _same(draw_hands(rng, skeleton, family, 1), n_frames)
    c = sensor.camera
    intrinsics = np.broadcast_to(np.array([c.fx, c.fy, c.cx, c.cy]), (n_frames, 4)).copy()
    picture = np.array([[c.width, c.height]], float)
    (middle,) = scene.draw_places(
        rng, intrinsics[:1], picture, np.array([550.0]), np.array([850.0])
    )
    moving = draw_gestures(rng, skeleton, n_frames, FRAME_NS * 1e-9, middle)
    pose = scene.hold_out(rng, skeleton, moving.angles, moving.turns, size, moving.places)
    parameters = np.repeat(sensor.draw(rng, 1, np.zeros(1), noise, erosion_px), n_frames, axis=0)
    contents = scene.assemble(
        rng,
        skeleton,
        pose,
        shape,
        size,
        intrinsics,
        parameters,
        thing_share,
        n_frames,
        moving.wrists,
    )
    return HandSession(name, skeleton, sensor, contents)


def _same(shape: HandShape, n: int) -> HandShape:
    """One person's hand repeated for n images."""
    return shape[np.zeros(n, np.int64)]


def _draw_cameras(
    rng: np.random.Generator, m: int, noise: float, erosion_px: int
) -> tuple[NDArray[np.int64], Array, NDArray[np.int64], Array]:
    """Kind (m,), intrinsics (m, 4), image size (m, 2) and sensor parameters of m cameras."""
    kind = rng.choice(len(_KINDS), m, p=[k[4] for k in _KINDS])
    focal = rng.uniform(0.97, 1.03, (m, 1))
    axis = rng.normal(0.0, 4.0, (m, 2))
    intrinsics = np.empty((m, 4))
    picture = np.empty((m, 2), np.int64)
    parameters = np.empty((m, 0))
    for k, (sensor, coarse, *_) in enumerate(_KINDS):
        rows = kind == k
        c = sensor.camera
        drawn = sensor.draw(rng, m, np.zeros(m), noise, erosion_px)
        parameters = np.where(rows[:, None], drawn, parameters) if parameters.size else drawn
        whole = (
            np.concatenate([focal * [c.fx, c.fy], axis + np.array([c.cx, c.cy])], axis=1) / coarse
        )
        intrinsics[rows] = whole[rows]
        picture[rows] = (c.width // coarse, max(c.height // coarse, _LEAST_PX))
    return kind, intrinsics, picture, parameters
