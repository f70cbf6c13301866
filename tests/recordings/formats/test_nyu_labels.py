"""The labels of the NYU data: read, checked, and held against our skeleton."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from liex_lab.body import Pose, Skeleton
from liex_lab.errors import LiexError
from liex_lab.geometry import SE3
from liex_lab.recordings.formats.images.nyu import (
    LABEL_CAMERA,
    N_FIRST_PERSON,
    NYU_IDS,
    POINTS,
    REFERENCE_FILE,
    NyuReference,
    fit_hands,
    points_of_joints,
    uvd_to_mm,
)

HAND = Skeleton.load("hand")


def labels(n: int) -> np.ndarray:
    """Pixels and depths (n, 14, 3) of hands in some postures."""
    rng = np.random.default_rng(1)
    angles = 0.6 * rng.uniform(HAND.limits[..., 0], HAND.limits[..., 1], (n, HAND.n_joints, 3))
    pose = Pose(
        SE3(SE3.exp(rng.normal(0.0, 0.5, (n, 6))).rotation, np.tile([0.0, 0.0, 700.0], (n, 1))),
        angles,
        np.ones(n),
    )
    points = points_of_joints(HAND) @ pose.joints(HAND)
    return np.concatenate([LABEL_CAMERA.project(points), points[..., 2:]], axis=-1)


def test_every_point_is_a_mean_of_joints() -> None:
    weights = points_of_joints(HAND)
    assert weights.shape == (14, 23)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    assert (weights >= 0).all()


def test_hands_are_found_from_their_fourteen_points() -> None:
    points = uvd_to_mm(labels(20))
    assert fit_hands(HAND, points).residual_mm.mean() < 0.5


def test_our_skeleton_fits_both_people_of_the_test_set(reference_data: Path) -> None:
    truth = NyuReference.load(reference_data / "hand_nyu").truth
    for rows, size in (
        (slice(0, N_FIRST_PERSON, 60), 1.09),
        (slice(N_FIRST_PERSON, None, 150), 0.91),
    ):
        fit = fit_hands(HAND, truth[rows])
        assert fit.residual_mm.mean() < 3.0  # the labels' own scatter is about that
        assert np.median(fit.pose.scale) == pytest.approx(size, abs=0.03)


def test_labels_come_from_the_data_sets_own_file_as_well(tmp_path: Path) -> None:
    uvd = np.zeros((3, 4, 36, 3))
    uvd[0][:, NYU_IDS] = labels(4)
    names = np.array([[f"P{k}" for k in range(36)]], dtype=object)
    savemat(tmp_path / "joint_data.mat", {"joint_uvd": uvd, "joint_xyz": uvd, "joint_names": names})
    reference = NyuReference.load(tmp_path)
    np.testing.assert_allclose(reference.truth, uvd_to_mm(labels(4)))
    assert reference.answers == {}


def test_what_is_no_such_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LiexError, match="has neither"):
        NyuReference.load(tmp_path)
    (tmp_path / REFERENCE_FILE).write_bytes(b"PK\x03\x04 not an archive")
    with pytest.raises(LiexError, match="not a whole file of NYU labels"):
        NyuReference.load(tmp_path)
    np.savez(
        tmp_path / REFERENCE_FILE, groundtruth_uvd=labels(2), joint_names=np.array([*POINTS][::-1])
    )
    with pytest.raises(LiexError, match="in this order"):
        NyuReference.load(tmp_path)
