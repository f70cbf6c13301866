"""The NYU hand pose data set (Tompson et al. 2014): depth in colour PNGs, joints in joint_data.mat.

Depth is 256 green + blue, mm. The set has no times; its cameras ran at 30 frames/s. Labels are the
usual 14 of its 36 joints.
"""

import re
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.arrays import Array, ArrayLike, NDArray
from liex_lab.body.pose import Fit, Pose, fit_poses
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError, RecordingError, expecting
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera, Lens
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile
from liex_lab.recordings.formats.images.files import open_pngs
from liex_lab.recordings.formats.images.folder import image_recording, natural_key
from liex_lab.recordings.frame import COLOUR
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent

NYU_CAMERA = Camera(588.036865, 587.075073, 320.0, 240.0, 640, 480, source="NYU hand pose data set")
JOINT_FILE = "joint_data.mat"
VIEW = 1  # of the three cameras, the one used in evaluations
N_JOINTS = 36

_NAME = re.compile(r"(?:depth|synthdepth)_([123])_(\d{7})\.png")
_N_ASKED = 8  # images: one may be damaged
_NOMINAL_HZ = 30.0  # the data set has no times; its cameras ran at this rate


@dataclass(frozen=True)
class NyuJoints:
    """Ground truth of one view, in the order of its images, which are numbered from 1.

    Attributes:
        names: (J,) names of the joints, as in the file.
        uvd: (N, J, 3) u, v px and depth mm.
        xyz: (N, J, 3) mm, camera frame (x right, y down, z away); the sign of y is opposite in the
            file.
    """

    names: tuple[str, ...]
    uvd: NDArray[np.float64]
    xyz: NDArray[np.float64]


def is_nyu(folder: Path, names: list[str]) -> bool:
    """Whether files are those of the NYU data set: names match, and one of the first eight is in
    colour.

    Args:
        folder: their folder.
        names: names of the files in it.
    """
    candidates = [folder / name for name in names if _NAME.fullmatch(name)][:_N_ASKED]
    return any(path.read_bytes()[24:26] == b"\x08\x02" for path in candidates)


def open_nyu(
    path: Path,
    camera: Lens | None = None,
    fps: float | None = None,
    progress: Progress = silent,
    view: int = VIEW,
) -> Recording:
    """Open a folder of `depth_K_NNNNNNN.png` (K is the view), or one such image, as a recording.

    Args:
        path: the folder or image.
        camera: overrides a camera.toml and the data set's own intrinsics.
        fps: frame rate, Hz, without a stamp file; None for that of a camera.toml, or 30.
        progress: counts the probed images.
        view: which of the three cameras, 1 to 3.

    Raises:
        RecordingError: there are no such images, or they are damaged.
    """
    folder = path if path.is_dir() else path.parent
    camera_toml = CameraFile.read(folder / CAMERA_FILE)
    files = _images(folder, view) if path.is_dir() else [path]
    stack = open_pngs(files, progress, colour=True)
    camera_toml = replace(
        camera_toml,
        encoding=COLOUR,
        fps=camera_toml.fps or _NOMINAL_HZ,
        intrinsics=camera_toml.intrinsics
        or {name: getattr(NYU_CAMERA, name) for name in ("fx", "fy", "cx", "cy")},
        source=camera_toml.source if camera_toml.intrinsics else NYU_CAMERA.source,
    )
    return image_recording("nyu", path, files, camera_toml, stack, camera, fps)


def frame_numbers(folder: Path, view: int = VIEW) -> list[int]:
    """Numbers, from 1, of the images that `open_nyu` reads, in its order.

    Args:
        folder: their folder.
        view: which of the three cameras, 1 to 3.

    Raises:
        RecordingError: there are no such images.
    """
    return [int(path.stem.split("_")[2]) for path in _images(folder, view)]


def _images(folder: Path, view: int) -> list[Path]:
    named = {path: _NAME.fullmatch(path.name) for path in folder.iterdir()}
    files = [path for path, match in named.items() if match and int(match[1]) == view]
    real = [path for path in files if path.name.startswith("depth")] or files
    if not real:
        raise RecordingError(
            f"{folder} holds no images depth_{view}_0000001.png of the NYU data set; give "
            "another folder"
        )
    return sorted(real, key=lambda path: natural_key(path.name))


def read_nyu_joints(folder: Path, view: int = VIEW) -> NyuJoints:
    """Joints of one view from a joint_data.mat.

    Row i belongs to the image with number i + 1.

    Args:
        folder: the folder of joint_data.mat, or the file itself.
        view: which of the three cameras, 1 to 3.

    Raises:
        RecordingError: there is no such file or no such view, or the file does not have 36 joints
            per frame.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    path = folder / JOINT_FILE if folder.is_dir() else folder
    wanted = ["joint_uvd", "joint_xyz", "joint_names"]
    if view < 1:
        raise RecordingError(f"the data set's cameras are numbered 1 to 3, got view {view}")
    if not path.is_file():
        raise RecordingError(
            f"there is no {JOINT_FILE} in {folder}; copy it there from the data set"
        )
    with expecting(
        RecordingError,
        f"{path} should be the NYU data set's MATLAB file",
        NotImplementedError,
        ValueError,
        TypeError,
        OSError,
        EOFError,
        MemoryError,
        MatReadError,
        advice="copy it again",
    ):
        found: dict[str, Any] = loadmat(path, variable_names=wanted)
    missing = [name for name in wanted if name not in found]
    if missing:
        raise RecordingError(
            f"{path} does not hold {', '.join(missing)}; give the data set's own {JOINT_FILE}"
        )
    uvd, xyz = (np.asarray(found[name]) for name in wanted[:2])
    if (
        uvd.ndim != 4
        or uvd.shape != xyz.shape
        or uvd.shape[2:] != (N_JOINTS, 3)
        or uvd.shape[0] < view
    ):
        raise RecordingError(
            f"{path} should hold joints of the shape (views, frames, {N_JOINTS}, 3), but they have "
            f"{uvd.shape} and {xyz.shape}; give the data set's own {JOINT_FILE}"
        )
    names = [str(np.ravel(name)[0]) for name in np.ravel(found["joint_names"])]
    upright = np.array([1.0, -1.0, 1.0])
    return NyuJoints(
        tuple(names), uvd[view - 1].astype(np.float64), xyz[view - 1].astype(np.float64) * upright
    )


# Labels of the NYU hand pose data set (Tompson et al. 2014): the usual 14 of its 36 joints.


LABEL_CAMERA = Camera(588.03, 587.07, 320.0, 240.0, 640, 480, source="NYU Hand Pose")
REFERENCE_FILE = "nyu_test_14joints.npz"
N_FIRST_PERSON = 2440  # test frames before this one show the first person, the others the second
PALM = 13  # row of the palm, where the root is

# weights of the skeleton's joints for each labelled point. The thumb's second point is on its
# last bone.
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
NYU_IDS = (*range(0, 25, 3), 25, 27, 30, 31, 32)  # of the data set's 36 points, from 0


def points_of_joints(skeleton: Skeleton) -> Array:
    """Weights that combine a hand's joints into the fourteen labelled points.

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
    """Convert pixels and depths to points in the camera frame, by the pinhole camera
    `LABEL_CAMERA`.

    Args:
        uvd: (..., 3) u, v px and depth mm.

    Returns:
        (..., 3) mm, camera frame.
    """
    values = np.asarray(uvd, float)
    return LABEL_CAMERA.unproject(values[..., :2], values[..., 2])


@dataclass(frozen=True)
class NyuReference:
    """True points of the NYU test frames, and the results of published methods.

    Attributes:
        truth: (n, 14, 3) mm, camera frame.
        answers: (n, 14, 3) mm, camera frame, by name of the method.
    """

    truth: Array
    answers: dict[str, Array]

    @staticmethod
    def load(folder: str | Path) -> "NyuReference":
        """Load the reference from its file, or else from the data set's own.

        Args:
            folder: contains nyu_test_14joints.npz, or else joint_data.mat, which has no results of
                methods.

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
        with (
            expecting(
                LiexError,
                f"{path} should be a whole file of NYU labels",
                OSError,
                ValueError,
                KeyError,
                EOFError,
                zipfile.BadZipFile,
                advice="copy it again",
            ),
            path.open("rb") as file,
            np.load(file, allow_pickle=False) as table,
        ):
            truth = uvd_to_mm(table["groundtruth_uvd"])
            found = {
                name.removesuffix("_uvd"): uvd_to_mm(table[name])
                for name in table.files
                if "_uvd" in name
            }
            names = [str(name) for name in table["joint_names"]]
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

    The search starts with the palm at its point, pointing away from the wrist, and with fingers
    bent by 0.3 rad, because the bending direction of a straight finger is ambiguous.

    Args:
        skeleton: the hand's skeleton.
        points: (n, 14, 3) labelled points, mm, in the order of `POINTS`.

    Returns:
        n poses in the frame of the points, and their residuals.
    """
    palm = points[:, PALM]
    wrists = points[:, [11, 12]]  # on the little finger's side, and on the thumb's
    forward = _unit(palm - wrists.mean(axis=1))
    left = wrists[:, 1] - wrists[:, 0]
    left = _unit(left - np.sum(left * forward, axis=1, keepdims=True) * forward)
    rotation = np.stack([forward, left, np.cross(forward, left)], axis=-1)
    angles = np.zeros((len(points), skeleton.n_joints, 3))
    # 0.3 rad: the bending direction of a straight finger is ambiguous
    angles[:, 1:, 1] = 0.3 * skeleton.axes[1:, 1]
    start = Pose(SE3(rotation, palm.copy()), angles, np.ones(len(points)))
    return fit_poses(skeleton, points, points_of_joints(skeleton), start)


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
