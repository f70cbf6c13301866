"""Virtual mice go where real ones went."""

from pathlib import Path

import numpy as np
import pytest

from liex_lab.errors import LiexError
from liex_lab.simulation.scenes.courses import film_courses, read_courses
from liex_lab.simulation.sensors import KINECT_V2_SENSOR

h5py = pytest.importorskip("h5py", reason="pose files of JABS need h5py")

N = 30
BACK = (9, 6, 3, 0)
# of two mice of 80 px, side by side, the second of which turns about the first; px, x to the right
TURN = np.linspace(0.0, 1.0, N)
MIDDLE = np.array([[300.0 + 60.0 * TURN, 200.0 + 0.0 * TURN], [300.0 + 0.0 * TURN, 320.0 - TURN]])
HEADING = np.array([np.zeros(N), TURN])
ALONG = np.array([-40.0, -10.0, 20.0, 40.0])


def backs_px() -> np.ndarray:
    """(2, n, 4, 2) from the tail base to the nose, column and row."""
    ahead = np.stack([np.cos(HEADING), np.sin(HEADING)], axis=-1)
    return np.asarray(MIDDLE.swapaxes(1, 2)[:, :, None] + ALONG[:, None] * ahead[:, :, None])


def written(path: Path, scale: float = 0.08) -> Path:
    """A pose file whose rows change places, with a false detection and missing points."""
    points = np.zeros((N, 3, 12, 2), np.uint16)
    identity = np.zeros((N, 3), np.uint32)
    sure = np.zeros((N, 3, 12), np.float32)
    for frame in range(N):
        for k in range(2):
            row = (frame + k) % 3
            points[frame, row][[*BACK]] = np.round(backs_px()[k, frame, :, ::-1])
            identity[frame, row], sure[frame, row] = k + 1, 0.9
    identity[4, np.flatnonzero(identity[4] == 0)] = 97
    sure[10, :, 0] = 0.0
    points[10, :, 0] = 0
    with h5py.File(path, "w") as file:
        poses = file.create_group("poseest")
        poses.attrs["cm_per_pixel"] = scale
        poses["points"], poses["confidence"], poses["instance_embed_id"] = points, sure, identity
        poses["instance_id_center"] = np.zeros((2, 16))
    return path


def test_virtual_mice_are_where_the_real_ones_were(tmp_path: Path) -> None:
    backs = read_courses(written(tmp_path / "pose_est_v5.h5"))
    true = 0.8 * backs_px().swapaxes(0, 1) * [1.0, -1.0]  # rows count downwards
    off = (backs - true) - (backs - true).mean(axis=(0, 1, 2))
    assert np.abs(off).max() < 2.5  # smoothed at both ends
    recording = film_courses(backs, 3, KINECT_V2_SENSOR, "train")
    actors = recording.stage.actors
    middles = np.stack([one.joints[..., :2].mean(axis=1) for one in actors], axis=1)
    gap = (backs.mean(axis=2) - middles) - (backs.mean(axis=2) - middles).mean(axis=(0, 1))
    assert np.abs(gap).max() < 0.5
    trunk = actors[1].joints[:, -1] - actors[1].joints[:, 0]
    ahead = backs[:, 1, -1] - backs[:, 1, 0]
    turn = np.arctan2(trunk[:, 1], trunk[:, 0]) - np.arctan2(ahead[:, 1], ahead[:, 0])
    assert np.abs((turn + np.pi) % (2 * np.pi) - np.pi).max() < 0.1
    assert actors[0].spine_mm == pytest.approx(0.85 * 64.0, rel=0.05)
    assert (recording.frame(0).depth > 0).mean() > 0.5


def test_a_file_without_identities_is_refused_in_a_sentence(tmp_path: Path) -> None:
    path = written(tmp_path / "pose_est_v5.h5")
    with h5py.File(path, "a") as file:
        del file["poseest/instance_embed_id"]
    with pytest.raises(LiexError, match="should be a pose file of JABS with identities"):
        read_courses(path)
