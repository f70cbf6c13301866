"""Labels: the correction that a forest learns is the one that, applied, leads to the truth."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from liex_lab.body.pose import Pose
from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation.cascade import Candidates, Cascade, Truth, aim_about
from liex_lab.estimation.method import METHODS
from liex_lab.geometry import SE3, so3

N = 24


def drawn_truth(skeleton: Skeleton, rng: np.random.Generator, bend: float = 0.3) -> Truth:
    angles = rng.normal(0, bend, (N, skeleton.n_joints, 3)) * skeleton.axes
    angles[:, 0] = 0.0
    root = SE3(so3.exp(rng.normal(0, 1.5, (N, 3))), rng.normal(0, 40, (N, 3)))
    scale = rng.uniform(0.8, 1.3, N)
    frames = Pose(root, angles, scale).frames(skeleton)
    return Truth(frames.rotation, frames.translation, scale)


def off_the_truth(
    skeleton: Skeleton, truth: Truth, rng: np.random.Generator, size: np.ndarray
) -> Candidates:
    """Candidates whose base is somewhere else, turned by anything up to pi."""
    twist = rng.normal(0, 1, (N, 6))
    twist[:, :3] *= rng.uniform(0, np.pi, (N, 1)) / np.linalg.norm(
        twist[:, :3], axis=1, keepdims=True
    )
    twist[:, 3:] *= 20.0
    base = SE3(truth.rotations[:, 0], truth.positions[:, 0]) @ SE3.exp(twist)
    return Candidates.start(
        skeleton,
        np.arange(N, dtype=np.int32),
        base.rotation,
        base.translation,
        rng.uniform(0.8, 1.2, N),
        size,
    )


def with_true_base(skeleton: Skeleton, truth: Truth, size: float = 1.0) -> Candidates:
    """Candidates whose base is exact; the other joints are yet to come."""
    return Candidates.start(
        skeleton,
        np.arange(N, dtype=np.int32),
        truth.rotations[:, 0],
        truth.positions[:, 0],
        truth.scale,
        np.full(N, size),
    )


def apply_exactly(cascade: Cascade, candidates: Candidates, joint: int, values: Any) -> None:
    """What a forest would do whose leaves were float64."""
    cascade.apply(candidates, joint, values)


@pytest.mark.parametrize("variant", ["default", "paper"])
def test_the_label_of_the_base_moves_it_onto_the_truth(variant):
    rng = np.random.default_rng(1)
    skeleton, method = Skeleton.load("mouse"), METHODS[variant]
    truth = drawn_truth(skeleton, rng)
    candidates = off_the_truth(
        skeleton, truth, rng, rng.uniform(0.8, 1.2, N) if method.session_size else np.ones(N)
    )
    before = candidates.scale.copy()
    cascade = Cascade(skeleton, method, [])
    labels, _ = cascade.labels(candidates, 0, truth)
    assert labels.shape == (N, cascade.n_values(0)) == (N, 7 if variant == "default" else 6)
    apply_exactly(cascade, candidates, 0, labels)
    np.testing.assert_allclose(candidates.rotations[:, 0], truth.rotations[:, 0], atol=1e-9)
    np.testing.assert_allclose(candidates.positions[:, 0], truth.positions[:, 0], atol=1e-8)
    np.testing.assert_allclose(
        candidates.scale, truth.scale if method.regress_scale else before, rtol=1e-12
    )


@pytest.mark.parametrize("animal", ["mouse", "fish", "hand"])
def test_the_papers_label_of_a_joint_is_the_turn_that_remains(animal):
    rng = np.random.default_rng(2)
    skeleton = Skeleton.load(animal)
    truth = drawn_truth(skeleton, rng)
    candidates, cascade = with_true_base(skeleton, truth), Cascade(skeleton, METHODS["paper"], [])
    for joint in skeleton.solved[1:]:
        cascade.place(candidates, joint)
        labels, keep = cascade.labels(candidates, joint, truth)
        assert labels.shape == (N, cascade.n_values(joint))
        assert keep.all()
        apply_exactly(cascade, candidates, joint, labels)
        np.testing.assert_allclose(
            candidates.rotations[:, joint], truth.rotations[:, joint], atol=1e-9
        )
    cascade.place_ends(candidates)
    np.testing.assert_allclose(candidates.positions, truth.positions, atol=1e-7)


@pytest.mark.parametrize("animal", ["mouse", "fish"])
def test_a_label_that_points_aims_the_bone_at_the_true_next_joint(animal):
    rng = np.random.default_rng(3)
    skeleton = Skeleton.load(animal)
    truth = drawn_truth(skeleton, rng)
    candidates, cascade = with_true_base(skeleton, truth), Cascade(skeleton, METHODS["default"], [])
    for joint in skeleton.solved[1:]:
        cascade.place(candidates, joint)
        candidates.positions[:, joint] += (
            1.5 * rng.normal(0, 1, (N, 1)) * candidates.rotations[:, joint, :, 0]
        )
        labels, _ = cascade.labels(candidates, joint, truth)
        apply_exactly(cascade, candidates, joint, labels)
        child = skeleton.next_joint[joint]
        wanted = truth.positions[:, child] - candidates.positions[:, joint]
        bone = candidates.rotations[:, joint] @ skeleton.offsets[child]
        bone, wanted = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (bone, wanted))
        across = np.cross(bone, wanted)
        if skeleton.axes[joint].sum() == 1:  # a hinge cannot do more than turn in its own plane
            axis = candidates.rotations[:, joint] @ skeleton.axes[joint]
            np.testing.assert_allclose(np.sum(across * axis, axis=1), 0.0, atol=1e-9)
        else:
            np.testing.assert_allclose(across, 0.0, atol=1e-9)
        assert (np.sum(bone * wanted, axis=1) > 0).all()
        candidates.rotations[:, joint] = truth.rotations[:, joint]
        candidates.positions[:, joint] = truth.positions[:, joint]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_hinge_finds_the_angle_that_a_search_over_all_angles_finds(axis):
    rng = np.random.default_rng(4)
    axes = np.arange(3) == axis
    bone, wanted = rng.normal(0, 10, 3), rng.normal(0, 10, (20, 3))
    turns = aim_about(bone, wanted, axes)
    np.testing.assert_array_equal(turns[:, ~axes], 0.0)
    tried = np.linspace(-np.pi, np.pi, 2001)
    turned = so3.exp(tried[:, None] * axes) @ bone
    best = tried[np.argmax(wanted @ turned.T, axis=1)]
    off = np.abs(np.angle(np.exp(1j * (turns[:, axis] - best))))
    assert off.max() < 2 * np.pi / 2000


def test_a_base_that_is_turned_too_far_is_not_learned_from():
    skeleton = Skeleton.load("mouse")
    rng = np.random.default_rng(5)
    truth = drawn_truth(skeleton, rng)
    limit = METHODS["default"].keep_turned
    angle = np.where(np.arange(N) % 2, limit + 1e-3, limit - 1e-3)
    axis = rng.normal(0, 1, (N, 3))
    turn = so3.exp(angle[:, None] * axis / np.linalg.norm(axis, axis=1, keepdims=True))
    candidates = with_true_base(skeleton, truth)
    candidates.rotations[:, 0] = candidates.rotations[:, 0] @ turn
    _, keep = Cascade(skeleton, METHODS["default"], []).labels(candidates, 0, truth)
    np.testing.assert_array_equal(keep, np.arange(N) % 2 == 0)
    _, keep = Cascade(skeleton, METHODS["paper"], []).labels(candidates, 0, truth)
    assert keep.all()


def test_a_joint_that_is_bent_too_far_or_lies_too_far_off_is_not_learned_from():
    skeleton, method = Skeleton.load("mouse"), METHODS["default"]
    truth = drawn_truth(skeleton, np.random.default_rng(6), bend=0.0)
    size, joint = 1.2, 2
    cascade = Cascade(skeleton, method, [])
    candidates = with_true_base(skeleton, truth, size)
    cascade.place(candidates, 1)
    cascade.place(candidates, joint)
    bent, far = np.zeros(N), np.zeros(N)
    bent[0::4], bent[1::4] = method.keep_bent - 1e-3, method.keep_bent + 1e-3
    far[2::4], far[3::4] = method.keep_off_mm - 1e-3, method.keep_off_mm + 1e-3
    turn = so3.exp(bent[:, None] * np.array([0.0, 0.0, 1.0]))
    candidates.rotations[:, joint] = candidates.rotations[:, joint] @ turn
    # backwards along the bone, so that being far off does not also mean being bent
    candidates.positions[:, joint] -= size * far[:, None] * candidates.rotations[:, joint, :, 0]
    _, keep = cascade.labels(candidates, joint, truth)
    np.testing.assert_array_equal(keep, np.tile([True, False, True, False], N // 4))
    everything = replace(method, keep_bent=10.0, keep_off_mm=1e9)
    assert Cascade(skeleton, everything, []).labels(candidates, joint, truth)[1].all()
