"""What single frames might say of a mouse that walks on a known curve."""

import numpy as np

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3, so3
from liex_lab.optics.camera import KINECT_V2
from liex_lab.tracking.observations import Observations, reversed_pose
from liex_lab.tracking.track import Subject

MOUSE = Skeleton.load("mouse")
ERROR_MM = 2.0
SUBJECT = Subject(
    MOUSE,
    KINECT_V2,
    SE3(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 700.0])),
    MOUSE.length,
    6.0,
    0.5,
    (1.0,) * 5,
)


def walk(seconds: np.ndarray) -> Pose:
    """A circle at 150 mm/s, the spine swaying."""
    n = len(seconds)
    heading = 1.2 * seconds
    turn = np.zeros((n, 3))
    turn[:, 2] = heading + np.pi / 2
    place = np.stack([125 * np.cos(heading), 125 * np.sin(heading), np.full(n, 15.0)], axis=1)
    angles = np.zeros((n, 5, 3))
    angles[:, 1:4, 2] = 0.2 * np.sin(4.0 * seconds)[:, None]
    return Pose(SE3(so3.exp(turn), place), angles, np.ones(n))


def noisy(pose: Pose, rng: np.random.Generator, sd_mm: float = 1.2, sd_rad: float = 0.04) -> Pose:
    n = len(pose.scale)
    turned = pose.root.rotation @ so3.exp(sd_rad * rng.standard_normal((n, 3)))
    moved = pose.root.translation + sd_mm * rng.standard_normal((n, 3))
    bent = pose.angles + sd_rad * rng.standard_normal(pose.angles.shape) * MOUSE.axes
    bent[:, 0] = 0.0
    return Pose(SE3(turned, moved), bent, pose.scale)


def told(seconds: np.ndarray, pose: Pose, flipped: np.ndarray | None = None) -> Observations:
    """Frames that say this, and with less conviction the same turned round; where `flipped` the
    other way about.
    """
    seen = Observations.empty(MOUSE, np.round(1e9 * seconds).astype(np.int64))
    other = reversed_pose(MOUSE, pose)
    flipped = np.zeros(len(seconds), bool) if flipped is None else flipped
    for h, (yes, no) in enumerate(((pose, other), (other, pose))):
        seen.put_pose(h, yes)
        swapped = told_pose(seen, h, no)
        for name in ("turn", "place", "angles", "scale"):
            getattr(seen, name)[flipped, h] = getattr(swapped, name)[flipped, h]
        seen.error_mm[:, h] = ERROR_MM
    seen.score[:, 0], seen.score[:, 1] = 4.0, 9.0
    seen.n_px[:, :2] = 800
    return seen


def told_pose(seen: Observations, h: int, pose: Pose) -> Observations:
    other = Observations.empty(MOUSE, seen.times_ns)
    other.put_pose(h, pose)
    return other


def lose(seen: Observations, rows: np.ndarray | slice) -> None:
    """Nothing is found in these frames."""
    for name in ("turn", "place", "angles", "scale", "error_mm", "score"):
        getattr(seen, name)[rows] = np.nan


def joint_error(joints: np.ndarray, pose: Pose) -> np.ndarray:
    return np.linalg.norm(joints - pose.joints(MOUSE), axis=-1).mean(axis=1)
