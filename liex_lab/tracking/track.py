"""The track of one animal: poses over a recording with their uncertainty, one row for every frame.

Columns as arrays (n, ...): T_arena_root in SE(3) with its covariance (6, 6), joint angles, joint
positions, bone scale, predicted error, flip posterior and flags. The tables `frames`, `poses` and
`rotations` are written from it (`liex_lab.tables.rows`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from liex_lab.arrays import Array, NDArray
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.runtime.memory import Allocator, Rows, blocks, in_windows

_BLOCK = 16_384  # frames in memory at once
# flags of measured poses that are not trusted: off, or not clearly this animal's
DOUBTFUL = ("doubtful", "unclear")
CORRECTED = "corrected"  # flag of a pose with manually placed joints


@dataclass(frozen=True)
class Track(Rows):
    """Poses over time: one row for EVERY frame of the recording, NaN without a pose.

    Attributes:
        skeleton: kinematic tree of the animal.
        times_ns: (n,) int64.
        joints_mm: (n, J, 3) arena frame.
        uv_px: (n, J, 2) pixels of the depth image.
        sd_mm: (n, J) standard deviation of each joint along one axis from one frame to another, mm;
            speeds are computed from it.
        sd_xy_mm: (n, J) that of its position along x and along y: `sd_mm`, and the common shift of
            all joints along the body, because the build is unknown.
        sd_z_mm: (n, J) that of its height: `sd_mm`, and the common error of all heights, because
            a camera only records the back.
        root_rotation: (n, 3, 3) rotation of T_arena_root.
        root_mm: (n, 3) translation of T_arena_root.
        cov_root: (n, 6, 6) covariance of the root's turn, rad, and shift, mm, about and along its
            own axes.
        angles_rad: (n, J, 3) rotation vectors relative to the parent joint.
        sd_angles_rad: (n, J, 3) their standard deviations.
        scale: (n,) of the skeleton's bones.
        predicted_error_mm: (n,) mean joint error expected by the learned metric and the smoother.
        residual_mm: (n,) median distance between the rendered body and the observed depth.
        n_foreground_px: (n,) int64, 0 if nothing was measured.
        centroid_mm: (n, 3) centre of the animal from above and its mean height, arena
            frame.
        centroid_px: (n, 2) the same in the depth image.
        p_flip: (n,) probability that head and tail are exchanged.
        bridged: (n,) not measured, but interpolated between measurements shortly before and
            after.
        flag: (n,) a word of the column `flag` of the table `frames`.
        n_animals: (n,) int64, animals in view.
    """

    skeleton: Skeleton
    times_ns: NDArray[np.int64]
    joints_mm: Array
    uv_px: Array
    sd_mm: Array
    sd_xy_mm: Array
    sd_z_mm: Array
    root_rotation: Array
    root_mm: Array
    cov_root: Array
    angles_rad: Array
    sd_angles_rad: Array
    scale: Array
    predicted_error_mm: Array
    residual_mm: Array
    n_foreground_px: NDArray[np.int64]
    centroid_mm: Array
    centroid_px: Array
    p_flip: Array
    bridged: NDArray[np.bool_]
    flag: NDArray[np.str_]
    n_animals: NDArray[np.int64]

    @staticmethod
    def empty(
        skeleton: Skeleton,
        times_ns: NDArray[np.int64],
        flag: str = "not_found",
        allocate: Allocator = np.empty,
    ) -> Track:
        """A track of these times in which nothing has been measured yet.

        Args:
            skeleton: kinematic tree of the animal.
            times_ns: (n,) time stamps.
            flag: for all rows.
            allocate: allocator of the columns.

        Returns:
            n rows, NaN, 0 or False.
        """
        n = len(times_ns)
        j = skeleton.n_joints

        def column(value: object, dtype: object, *shape: int) -> NDArray[Any]:
            """A column (n, *shape) filled with a value.

            Args:
                value: what fills it.
                dtype: of the column.
                *shape: of one row.
            """
            made = allocate((n, *shape), dtype)
            for rows in blocks(n, _BLOCK):
                made[rows] = value
            return made

        def unknown(*shape: int) -> Array:
            """A column (n, *shape) of NaN, float64."""
            return column(np.nan, np.float64, *shape)

        return Track(
            skeleton,
            np.asarray(times_ns, np.int64),
            unknown(j, 3),
            unknown(j, 2),
            unknown(j),
            unknown(j),
            unknown(j),
            unknown(3, 3),
            unknown(3),
            unknown(6, 6),
            unknown(j, 3),
            unknown(j, 3),
            unknown(),
            unknown(),
            unknown(),
            column(0, np.int64),
            unknown(3),
            unknown(2),
            unknown(),
            column(False, np.bool_),
            column(flag, "<U12"),
            column(0, np.int64),
        )

    def put_pose(self, rows: NDArray[np.int64], pose: Pose) -> None:
        """Write poses into some rows, in place, except `uv_px`, which depends on the camera.

        Args:
            rows: (k,) the rows.
            pose: (k) poses, arena frame.
        """
        self.root_rotation[rows] = pose.root.rotation
        self.root_mm[rows] = pose.root.translation
        self.angles_rad[rows] = pose.angles
        self.joints_mm[rows] = pose.joints(self.skeleton)

    @property
    def n_frames(self) -> int:
        """Number of frames n of the recording, measured or not."""
        return len(self.times_ns)

    @property
    def posed(self) -> NDArray[np.bool_]:
        """(n,) True if there is a pose, measured or bridged."""
        there = np.empty(self.n_frames, np.bool_)
        for rows in blocks(self.n_frames, _BLOCK):
            there[rows] = np.isfinite(self.joints_mm[rows, 0, 0])
        return there

    @property
    def observed(self) -> NDArray[np.bool_]:
        """(n,) True if a pose was measured."""
        return self.posed & ~self.bridged

    def flagged(self, *flags: str) -> NDArray[np.bool_]:
        """(n,) True if the flag is one of these."""
        return in_windows(self.n_frames, 0, lambda rows: np.isin(self.flag[rows], flags))

    @property
    def root(self) -> SE3:
        """T_arena_root, a batch (n), mm."""
        return SE3(self.root_rotation, self.root_mm)

    @property
    def pose(self) -> Pose:
        """The poses (n), arena frame; NaN if absent."""
        return Pose(self.root, self.angles_rad, self.scale)

    @property
    def sd_root(self) -> Array:
        """(n, 6) standard deviations of the root's turn, rad, and shift, mm, on its own axes."""
        return np.asarray(np.sqrt(np.diagonal(self.cov_root, axis1=1, axis2=2)))

    @property
    def sd_xyz_mm(self) -> Array:
        """(n, J, 3) standard deviation of each joint along x, y and z, mm."""
        return np.stack([self.sd_xy_mm, self.sd_xy_mm, self.sd_z_mm], axis=-1)

    @property
    def spine_mm(self) -> Array:
        """(n,) length of the fitted (longest) chain, all its bones added up, mm."""
        return self.scale * self.skeleton.length


@dataclass(frozen=True)
class Flip:
    """Frames start to stop (exclusive) in which head and tail may have been exchanged.

    Attributes:
        start: first frame.
        stop: frame after the last.
        p_flip: their probability, in the single frames if `applied`, else in the track.
        applied: whether the exchange was undone in the track.
        source: model or human.
        undone_at: when a person undid the correction, ISO 8601; empty otherwise.
    """

    start: int
    stop: int
    p_flip: float
    applied: bool
    source: str = "model"
    undone_at: str = ""


def ends_of(spans: Iterable[tuple[int, int]]) -> list[int]:
    """Starts and ends of exchanges of head and tail; exchanging twice restores the original.

    Args:
        spans: start and stop (exclusive) of each exchange, rows or frames; they may overlap.

    Returns:
        First rows (or frames) of the stretches that the exchanges make, ascending.
    """
    ends: set[int] = set()
    for span in spans:
        ends ^= set(span)
    return sorted(ends)


@dataclass(frozen=True)
class Crossing:
    """Frames in which animals may have been exchanged.

    Attributes:
        start: first frame.
        stop: frame after the last.
        animals: which of them, from 0.
        p_swap: probability that they leave it in other roles than in the tracks.
        decided_by: what decided it: motion, size or rfid, or human.
        reviewed_by: the reviewer; "" if nobody did.
        reviewed_at: when, ISO 8601.
    """

    start: int
    stop: int
    animals: tuple[int, ...]
    p_swap: float
    decided_by: str
    reviewed_by: str = ""
    reviewed_at: str = ""


@dataclass(frozen=True)
class Tracked:
    """A track, its exchanges of head and tail, and the animals in view.

    Attributes:
        track: one row for every frame.
        flips: spans of exchanged or uncertain head and tail, in order of time.
        cuts: first rows of stretches that were smoothed by themselves, since a person's exchange
            makes a half turn there.
        n_animals: animals in view at once.
        n_animals_share: share of the frames with an animal in view that show this number.
        crossings: in which the animal takes part; None if it was measured alone.
    """

    track: Track
    flips: tuple[Flip, ...]
    cuts: tuple[int, ...] = ()
    n_animals: int = 1
    n_animals_share: float = 1.0
    crossings: tuple[Crossing, ...] | None = None


# The subject of a track.


@dataclass(frozen=True)
class Subject:
    """The animal of a track, its camera, and the limits for keeping or flagging rows.

    Attributes:
        skeleton: kinematic tree of the animal.
        camera: the depth camera that took the recording.
        T_arena_camera: pose of the camera in the arena frame, mm.
        length_mm: spine length of this animal, mm.
        doubtful_mm: frames with a larger predicted mean joint error, mm, are flagged.
        bridge_s: the longest gap that is bridged, s; a longer one is bridged half as far from
            both its ends.
        joint_share: (J,) error of each joint over the mean of all joints.
        stretch_sd: standard deviation of the common relative error of all distances from the base,
            because an animal whose edges the sensor loses appears smaller; None uses the usual
            value of `Motion`.
        unseen: remaining standard deviations, over the length, of the joints' height and of their
            position along the body after fitting a session's own shape; None uses those of
            `Motion`.
        n_animals: how many animals are in view at once.
        n_measured: how many of them are measured.
    """

    skeleton: Skeleton
    camera: Camera
    T_arena_camera: SE3
    length_mm: float
    doubtful_mm: float
    bridge_s: float
    joint_share: tuple[float, ...]
    stretch_sd: float | None = None
    unseen: tuple[float, float] | None = None
    n_animals: int = 1
    n_measured: int = 1


# Gaps between measured frames, in seconds, and runs of frames.


def short_gaps(
    seconds: Array, measured: NDArray[np.bool_], bridge_s: float, ahead: bool = False
) -> NDArray[np.bool_]:
    """Mask (n,) of the unmeasured frames that are bridged.

    A frame between two measured ones is bridged where the nearer of them is no farther than half of
    bridge_s, so a gap no longer than bridge_s is bridged whole.

    Args:
        seconds: (n,) s, increasing.
        measured: (n,) True where the pose was measured.
        bridge_s: the longest gap that is bridged whole, s.
        ahead: also bridge the frames within bridge_s after the last measured one.

    Returns:
        (n,) bool, False at measured frames.
    """
    rows, lost = (np.flatnonzero(some) for some in (measured, ~measured))
    short = np.zeros(len(measured), np.bool_)
    if not len(rows):
        return short
    after = np.searchsorted(rows, lost)
    inside = (after > 0) & (after < len(rows))
    before = seconds[rows[np.maximum(after - 1, 0)]]
    after = rows[np.minimum(after, len(rows) - 1)]
    away = np.minimum(seconds[lost] - before, seconds[after] - seconds[lost])
    short[lost] = inside & (away <= 0.5 * bridge_s)
    if ahead:
        short[rows[-1] + 1 :] = seconds[rows[-1] + 1 :] - seconds[rows[-1]] <= bridge_s
    return short


def whole_gaps(seconds: Array, measured: NDArray[np.bool_], bridge_s: float) -> NDArray[np.bool_]:
    """Mask (n,) of the unmeasured frames in gaps no longer than bridge_s.

    Args:
        seconds: (n,) s, increasing.
        measured: (n,) True where the pose was measured.
        bridge_s: the longest gap, s.

    Returns:
        (n,) bool, False at measured frames, and before the first and after the last of them.
    """
    rows = np.flatnonzero(measured)
    out = np.zeros(len(measured), np.bool_)
    at = np.flatnonzero(np.diff(rows) > 1)
    for before, after in zip(rows[at], rows[at + 1], strict=True):
        out[before + 1 : after] = seconds[after] - seconds[before] <= bridge_s
    return out


def spans(where: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """The runs of True in a mask, as (start, stop) with stop exclusive.

    Args:
        where: (n,) bool.

    Returns:
        One pair of indices for each run, in order.
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
