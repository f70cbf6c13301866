"""Labels of the NYU hand pose data set (Tompson et al. 2014): the usual 14 of its 36 joints.

Each labelled point is a weighted mean of the joints of our hand skeleton; hand poses are fitted to
the points by least squares (Levenberg-Marquardt on the manifold, `fit_poses`).
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from liex_lab.body.fitting import Fit, fit_poses
from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.recordings.formats.images.nyu import JOINT_FILE, read_nyu_joints

Array = NDArray[np.float64]

NYU_CAMERA = Camera(588.03, 587.07, 320.0, 240.0, 640, 480, source="NYU Hand Pose")
REFERENCE_FILE = "nyu_test_14joints.npz"
N_FIRST_PERSON = 2440  # test frames before this one show the first person, the others the second
PALM = 13  # row of the palm, where the root is

# row by row: how a labelled point is made of the skeleton's joints. The thumb's second point lies
# on its last bone.
POINTS: dict[str, dict[str, float]] = {
    "pinky_tip": {"little_tip": 1.0},
    "pinky_mid": {"little_middle": 1.0},
    "ring_tip": {"ring_tip": 1.0},
    "ring_mid": {"ring_middle": 1.0},
    "middle_tip": {"middle_tip": 1.0},
    "middle_mid": {"middle_middle": 1.0},
    "index_tip": {"index_tip": 1.0},
    "index_mid": {"index_middle": 1.0},
    "thumb_tip": {"thumb_tip": 1.0},
    "thumb_mid": {"thumb_end": 0.7, "thumb_tip": 0.3},
    "thumb_base": {"thumb_middle": 1.0},
    "wrist_a": {"wrist_right": 1.0},
    "wrist_b": {"wrist_left": 1.0},
    "palm": {"palm": 1.0},
}
NYU_IDS = (
    0,
    3,
    6,
    9,
    12,
    15,
    18,
    21,
    24,
    25,
    27,
    30,
    31,
    32,
)  # of the data set's 36 points, from 0
_LITTLE_WRIST = 11
_THUMB_WRIST = 12
_START_BEND = 0.3  # rad: a straight finger does not know which way to bend


def points_of_joints(skeleton: Skeleton) -> Array:
    """Weights that make the fourteen labelled points of a hand's joints.

    Args:
        skeleton: the hand's skeleton, J joints.

    Returns:
        (14, J) weights: `weights @ joints` are the points.
    """
    weights = np.zeros((len(POINTS), skeleton.n_joints))
    for row, parts in enumerate(POINTS.values()):
        for name, share in parts.items():
            weights[row, skeleton.names.index(name)] = share
    return weights


def uvd_to_mm(uvd: ArrayLike) -> Array:
    """Points in the camera frame of pixels and depths, by the pinhole `NYU_CAMERA`.

    Args:
        uvd: (..., 3) u, v px and depth mm.

    Returns:
        (..., 3) mm, camera frame.
    """
    values = np.asarray(uvd, float)
    return NYU_CAMERA.unproject(values[..., :2], values[..., 2])


@dataclass(frozen=True)
class NyuReference:
    """True points of the NYU test frames, and what methods have answered.

    Attributes:
        truth: (n, 14, 3) mm, camera frame.
        answers: (n, 14, 3) mm, camera frame, by name of the method.
    """

    truth: Array
    answers: dict[str, Array]

    @staticmethod
    def load(folder: str | Path) -> NyuReference:
        """Load the reference from its file, or else from the data set's own.

        Args:
            folder: holds nyu_test_14joints.npz, or else joint_data.mat, which holds no answers.

        Returns:
            The reference.

        Raises:
            LiexError: the folder has neither file, or the file is damaged or labels other points.
        """
        path = Path(folder) / REFERENCE_FILE
        if not path.is_file() and (Path(folder) / JOINT_FILE).is_file():
            return NyuReference(uvd_to_mm(read_nyu_joints(Path(folder)).uvd[:, NYU_IDS]), {})
        if not path.is_file():
            raise LiexError(
                f"the NYU reference should be a folder with {REFERENCE_FILE} or {JOINT_FILE}, but "
                f"{folder} has neither"
            )
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as table:
                truth = uvd_to_mm(table["groundtruth_uvd"])
                found = {
                    name.removesuffix("_uvd"): uvd_to_mm(table[name])
                    for name in table.files
                    if "_uvd" in name
                }
                names = [str(name) for name in table["joint_names"]]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise LiexError(
                f"{path} is not a whole file of NYU labels ({error}); copy it anew"
            ) from None
        if names != list(POINTS) or truth.shape[1:] != (len(POINTS), 3):
            raise LiexError(
                f"{path} should label {', '.join(POINTS)}, in this order, but labels "
                f"{', '.join(names)}"
            )
        return NyuReference(
            truth, {name: points for name, points in found.items() if name != "groundtruth"}
        )


def fit_hands(skeleton: Skeleton, points: Array) -> Fit:
    """Fit hand poses to labelled points.

    The search begins with the palm at its point, pointing away from the wrist, and with fingers
    bent by 0.3 rad, for a straight finger does not know which way to bend.

    Args:
        skeleton: the hand's skeleton.
        points: (n, 14, 3) labelled points, mm, in the order of `POINTS`.

    Returns:
        n poses in the frame of the points, and how well they fit.
    """
    palm = points[:, PALM]
    wrists = points[:, [_LITTLE_WRIST, _THUMB_WRIST]]
    forward = _unit(palm - wrists.mean(axis=1))
    left = wrists[:, 1] - wrists[:, 0]
    left = _unit(left - np.sum(left * forward, axis=1, keepdims=True) * forward)
    rotation = np.stack([forward, left, np.cross(forward, left)], axis=-1)
    angles = np.zeros((len(points), skeleton.n_joints, 3))
    angles[:, 1:, 1] = _START_BEND * skeleton.axes[1:, 1]
    start = Pose(SE3(rotation, palm.copy()), angles, np.ones(len(points)))
    return fit_poses(skeleton, points, points_of_joints(skeleton), start)


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
