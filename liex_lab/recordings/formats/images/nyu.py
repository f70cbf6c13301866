"""The NYU hand pose data set (Tompson et al. 2014): depth in colour PNGs, joints in joint_data.mat.

Depth is 256 green + blue, mm. The set holds no times; its cameras ran at 30 frames/s.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera, Lens
from liex_lab.recordings.camera_file import CAMERA_FILE, CameraFile
from liex_lab.recordings.depth_units import COLOUR
from liex_lab.recordings.formats.images.folder import Folder, natural_key
from liex_lab.recordings.formats.images.png import open_pngs
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.progress import Progress, silent

NYU_CAMERA = Camera(588.036865, 587.075073, 320.0, 240.0, 640, 480, source="NYU hand pose data set")
JOINT_FILE = "joint_data.mat"
VIEW = 1  # of the three cameras, the one that everybody measures on
N_JOINTS = 36

_NAME = re.compile(r"(?:depth|synthdepth)_([123])_(\d{7})\.png")
_N_ASKED = 8  # pictures: one may be damaged
_NOMINAL_HZ = 30.0  # the data set holds no times; its cameras ran at this rate


@dataclass(frozen=True)
class NyuJoints:
    """Ground truth of one view, in the order of its pictures, which are numbered from 1.

    Attributes:
        names: (J,) names of the joints, as in the file.
        uvd: (N, J, 3) u, v px and depth mm.
        xyz: (N, J, 3) mm, camera frame (x right, y down, z away), so its y is the file's with the
            sign turned.
    """

    names: tuple[str, ...]
    uvd: NDArray[np.float64]
    xyz: NDArray[np.float64]


def looks_like_nyu(folder: Path, names: list[str]) -> bool:
    """Whether files are those of the NYU data set: so named, and 8-bit colour PNG.

    Args:
        folder: where they are.
        names: names of the files in it.

    Returns:
        True where one of the first eight so named is in colour.
    """
    for name in [name for name in names if _NAME.fullmatch(name)][:_N_ASKED]:
        with (folder / name).open("rb") as file:
            if file.read(26)[24:] == b"\x08\x02":
                return True
    return False


def open_nyu(
    path: Path,
    camera: Lens | None = None,
    fps: float | None = None,
    progress: Progress = silent,
    view: int = VIEW,
) -> Recording:
    """Open a folder of `depth_K_NNNNNNN.png` (K is the view), or one such picture, as a recording.

    Args:
        path: the folder or picture.
        camera: comes before a camera.toml and the data set's own intrinsics.
        fps: frame rate, Hz, where there is no stamp file; None for that of a camera.toml, or 30.
        progress: told how many pictures were looked at.
        view: which of the three cameras, 1 to 3.

    Returns:
        The recording.

    Raises:
        RecordingError: there are no such pictures, or they are damaged.
    """
    folder = path if path.is_dir() else path.parent
    camera_toml = CameraFile.read(folder / CAMERA_FILE)
    files = _pictures(folder, view) if path.is_dir() else [path]
    stack = open_pngs(files, progress, colour=True)
    camera_toml = replace(
        camera_toml,
        encoding=COLOUR,
        fps=camera_toml.fps or _NOMINAL_HZ,
        intrinsics=camera_toml.intrinsics
        or {name: getattr(NYU_CAMERA, name) for name in ("fx", "fy", "cx", "cy")},
        source=camera_toml.source if camera_toml.intrinsics else NYU_CAMERA.source,
    )
    return Folder(path, files, camera_toml, stack, camera_toml.decode).recording("nyu", camera, fps)


def frame_numbers(folder: Path, view: int = VIEW) -> list[int]:
    """Numbers, from 1, of the pictures that `open_nyu` reads, in its order.

    Args:
        folder: where they are.
        view: which of the three cameras, 1 to 3.

    Returns:
        (N,) numbers out of the names.

    Raises:
        RecordingError: there are no such pictures.
    """
    return [int(path.stem.split("_")[2]) for path in _pictures(folder, view)]


def _pictures(folder: Path, view: int) -> list[Path]:
    named = {path: _NAME.fullmatch(path.name) for path in folder.iterdir()}
    files = [path for path, match in named.items() if match and int(match[1]) == view]
    real = [path for path in files if path.name.startswith("depth")] or files
    if not real:
        raise RecordingError(
            f"{folder} holds no pictures depth_{view}_0000001.png of the NYU data set; give "
            "another folder"
        )
    return sorted(real, key=lambda path: natural_key(path.name))


def read_nyu_joints(folder: Path, view: int = VIEW) -> NyuJoints:
    """Joints of one view out of a joint_data.mat.

    Row i belongs to the picture with number i + 1.

    Args:
        folder: the folder that holds joint_data.mat, or the file itself.
        view: which of the three cameras, 1 to 3.

    Returns:
        The joints of all frames.

    Raises:
        RecordingError: there is no such file or no such view, or the file does not hold 36 joints
            to a frame.
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
    try:
        found: dict[str, Any] = loadmat(path, variable_names=wanted)
    except (
        MatReadError,
        NotImplementedError,
        ValueError,
        TypeError,
        OSError,
        EOFError,
        MemoryError,
    ) as error:
        raise RecordingError(
            f"{path} should be the NYU data set's MATLAB file, but: {error}; copy it again"
        ) from None
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
    names = tuple(
        str(np.asarray(name).ravel()[0]) for name in np.asarray(found["joint_names"]).ravel()
    )
    upright = np.array([1.0, -1.0, 1.0])
    return NyuJoints(
        names, uvd[view - 1].astype(np.float64), xyz[view - 1].astype(np.float64) * upright
    )
