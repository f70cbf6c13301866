"""Patches for the CNN: what is said of them can be undone, and they look as a reader would cut
them.
"""

from importlib.util import find_spec

import numpy as np
import pytest

from liex_lab.baselines._kernels import PATCH
from liex_lab.baselines.baseline import frames_of, joints_of, patches_of, targets_of
from liex_lab.estimation.method import METHODS
from liex_lab.scene.height_maps import in_camera_frame
from tests.estimation.toy import toy_mice, training_set


def drawn(seed: int, step: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Two height maps of noise within a box, and how they were cut."""
    rng = np.random.default_rng(seed)
    heights = np.zeros((2, 96, 96), np.int16)
    heights[0, 20:51, 30:41] = rng.integers(1500, 2300, (31, 11))
    heights[1, 40:49, 5:90] = rng.integers(1, 2500, (9, 85))
    crop_cameras = np.zeros((2, 17))
    crop_cameras[:, :4] = 500.0, 510.0, 320.0, 240.0
    crop_cameras[:, 4:13] = np.diag([1.0, -1.0, -1.0]).ravel()
    crop_cameras[:, 13], crop_cameras[:, 14:16], crop_cameras[:, 16] = (
        [700.0, 900.0],
        [[100, 50], [300, 200]],
        step,
    )
    return heights, crop_cameras


def patch_by_hand(heights: np.ndarray, look: np.ndarray) -> np.ndarray:
    """One patch, every ninth pixel, as the module's docstring tells it; NaN elsewhere."""
    rows, columns = np.nonzero(heights > 0)
    side = 1.1 * (max(np.ptp(rows), np.ptp(columns)) + 1)
    middle = np.array([(rows.min() + rows.max()) / 2, (columns.min() + columns.max()) / 2])
    mean = heights[heights > 0].mean() / 16
    half_mm = 0.5 * side * look[16] * (look[13] - mean) / np.sqrt(look[0] * look[1])
    shade = np.where(
        heights > 0, np.clip(127.5 + 127.5 * (heights / 16 - mean) / half_mm, 1, 255), 0
    )
    padded = np.pad(shade, 100)
    out = np.full((PATCH, PATCH), np.nan)
    for i, j in np.ndindex(PATCH, PATCH):
        if (i + j) % 9 == 0:
            y, x = middle - side / 2 + (np.array([i, j]) + 0.5) * side / PATCH
            r, c = int(np.floor(y)), int(np.floor(x))
            square = padded[r + 100 : r + 102, c + 100 : c + 102]
            out[i, j] = np.array([1 - (y - r), y - r]) @ square @ np.array([1 - (x - c), x - c])
    return out


@pytest.mark.parametrize(("seed", "step"), [(0, 1), (1, 2), (2, 3)])
def test_targets_of_joints_can_be_undone(seed, step):
    heights, crop_cameras = drawn(seed, step)
    frames = frames_of(heights, crop_cameras)
    joints = np.random.default_rng(seed).uniform([-200, -150, 400], [200, 150, 1000], (2, 7, 3))
    targets = targets_of(joints, crop_cameras, frames)
    assert targets.shape == (2, 21)
    np.testing.assert_allclose(joints_of(targets, crop_cameras, frames), joints, atol=2e-3)


def test_a_patch_is_what_a_reader_would_cut():
    heights, crop_cameras = drawn(3)
    patches = patches_of(heights, crop_cameras, frames_of(heights, crop_cameras))
    for k in range(2):
        by_hand = patch_by_hand(heights[k], crop_cameras[k])
        told = np.isfinite(by_hand)
        np.testing.assert_allclose(patches[k][told], by_hand[told], atol=0.05)


def test_a_joint_in_the_middle_of_the_square_at_the_mean_depth_is_zero_and_nearer_is_positive():
    heights, crop_cameras = drawn(2)
    frames = frames_of(heights, crop_cameras)
    z = frames[:, 3] - [0.0, 10.0]
    x, y = (
        (frames[:, 0] - crop_cameras[:, 2]) / crop_cameras[:, 0] * z,
        (frames[:, 1] - crop_cameras[:, 3]) / crop_cameras[:, 1] * z,
    )
    told = targets_of(np.stack([x, y, z], axis=-1)[:, None], crop_cameras, frames)
    np.testing.assert_allclose(told[0], 0.0, atol=1e-6)
    assert told[1, 2] == pytest.approx(10.0 / frames[1, 4])


if find_spec("torch"):  # an extra that the tests do without: see `cnn` in pyproject.toml

    def test_a_small_network_learns_and_is_the_same_after_writing(tmp_path):
        from liex_lab.baselines.baseline import Cnn, CnnPlan, load_baseline, train_cnn

        plan = CnnPlan(width=0.125, connected=32, epochs=10)
        toy = toy_mice(64, 6)
        some = training_set(toy, METHODS["paper"])
        nets = [
            train_cnn(some, toy.skeleton, plan, np.random.default_rng(0), lambda share, what: None)
            for _ in range(2)
        ]
        heights, crop_cameras = some.images.heights[:32], some.images.crop_cameras[:32]
        said = nets[0].joints(heights, crop_cameras)
        off = np.linalg.norm(
            said - in_camera_frame(some.truth.positions[:32], crop_cameras), axis=-1
        )
        assert np.median(off) < 25.0
        np.testing.assert_allclose(nets[1].joints(heights, crop_cameras), said, atol=1.0)
        (tmp_path / "net.npz").write_bytes(nets[0].to_bytes())
        again = load_baseline(tmp_path / "net.npz", toy.skeleton, plan)
        assert isinstance(again, Cnn)
        np.testing.assert_array_equal(again.joints(heights, crop_cameras), said)
