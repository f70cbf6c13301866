"""Inverse kinematics: poses are found again from the points they put down, within the joints'
limits.
"""

import numpy as np

from liex_lab.body import Pose, Skeleton
from liex_lab.body.pose import fit_poses
from liex_lab.geometry import SE3, so3

HAND = Skeleton.load("hand")


def hands(n: int, seed: int, share: float = 0.8) -> Pose:
    """Random postures, `share` of the way to their limits."""
    rng = np.random.default_rng(seed)
    angles = share * rng.uniform(HAND.limits[..., 0], HAND.limits[..., 1], (n, HAND.n_joints, 3))
    return Pose(SE3.exp(rng.normal(0.0, 1.0, (n, 6))), angles, rng.uniform(0.8, 1.2, n))


def near(pose: Pose, seed: int) -> Pose:
    """Where a search may begin: bent a little, the base turned by about twenty degrees."""
    rng = np.random.default_rng(seed)
    n = len(pose.scale)
    turned = pose.root.rotation @ so3.exp(rng.normal(0.0, 0.2, (n, 3)))
    angles = np.zeros(pose.angles.shape)
    angles[:, 1:, 1] = 0.3 * HAND.axes[1:, 1]
    return Pose(SE3(turned, pose.root.translation + 5.0), angles, np.ones(n))


def test_poses_are_found_again_from_all_their_joints() -> None:
    pose = hands(8, 0)
    fit = fit_poses(HAND, pose.joints(HAND), np.eye(HAND.n_joints), near(pose, 1))
    assert fit.residual_mm.mean(axis=1).max() < 0.5
    np.testing.assert_allclose(fit.pose.scale, pose.scale, rtol=0.01)


def test_joints_stay_within_their_limits_and_bones_as_long_as_asked() -> None:
    pose = hands(6, 2, share=1.0)
    stretched = pose.joints(HAND) * 1.3
    fit = fit_poses(HAND, stretched, np.eye(HAND.n_joints), near(pose, 3), keep_scale=True)
    np.testing.assert_array_equal(fit.pose.scale, 1.0)
    low, high = HAND.limits[..., 0], HAND.limits[..., 1]
    assert (fit.pose.angles[:, 1:] >= low[1:] - 1e-12).all()
    assert (fit.pose.angles[:, 1:] <= high[1:] + 1e-12).all()


def test_what_points_leave_open_stays_at_rest() -> None:
    pose = Pose.home(HAND, 1)
    weights = np.zeros((3, HAND.n_joints))
    weights[[0, 1, 2], [0, 1, 2]] = 1.0  # the palm and the wrist know nothing of the fingers
    start = hands(1, 4)
    fit = fit_poses(
        HAND, pose.joints(HAND)[:, :3], weights, Pose(pose.root, start.angles, pose.scale)
    )
    assert np.abs(fit.pose.angles).max() < 1e-3
