"""Rotations: exp and log undo one another to 1e-9 everywhere, near 0 and near pi too."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given

from liex_lab.geometry import so3
from tests.geometry.strategies import Array, directions, few, rotation_vectors
from tests.oracles import motion


@few
@given(omega=rotation_vectors())
def test_log_undoes_exp(omega: Array) -> None:
    back = so3.log(so3.exp(omega))
    error = np.linalg.norm(back - omega)
    if np.linalg.norm(omega) > np.pi - 1e-9:  # at pi both signs are the same rotation
        error = min(error, np.linalg.norm(back + omega))
    assert error < 1e-9


@few
@given(direction=directions())
def test_log_undoes_exp_up_to_pi(direction: Array) -> None:
    for below_pi in (0.0, 1e-15, 1e-12, 1e-9, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3):
        omega = (np.pi - below_pi) * direction
        back = so3.log(so3.exp(omega))
        sign = np.sign(back @ omega) if below_pi < 1e-9 else 1.0
        np.testing.assert_allclose(sign * back, omega, atol=1e-9, rtol=0)
        assert np.linalg.norm(back) <= np.pi + 1e-15
    half_turn = so3.log(2.0 * np.outer(direction, direction) - np.eye(3))
    assert abs(np.linalg.norm(half_turn) - np.pi) < 1e-9
    assert np.linalg.norm(np.cross(half_turn, direction)) < 1e-9


@few
@given(omega=rotation_vectors())
def test_exp_is_the_matrix_exponential_and_a_proper_rotation(omega: Array) -> None:
    rotation = so3.exp(omega)
    np.testing.assert_allclose(rotation, motion.exp([*omega, 0, 0, 0])[:3, :3], atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert abs(np.linalg.det(rotation) - 1.0) < 1e-13


@few
@given(a=rotation_vectors(), b=rotation_vectors())
def test_cross_and_hat_are_the_cross_product(a: Array, b: Array) -> None:
    np.testing.assert_array_equal(so3.cross(a, b), np.cross(a, b))
    np.testing.assert_allclose(so3.hat(a) @ b, np.cross(a, b), atol=1e-15)
    np.testing.assert_array_equal(so3.cross(a, np.stack([b, a])), np.cross(a, np.stack([b, a])))


@few
@given(omega=rotation_vectors())
def test_the_inverse_of_the_left_jacobian_is_its_inverse(omega: Array) -> None:
    np.testing.assert_allclose(
        so3.left_jacobian(omega) @ so3.left_jacobian_inverse(omega), np.eye(3), atol=1e-12
    )


@pytest.mark.parametrize("function", [so3.exp, so3.left_jacobian, so3.left_jacobian_inverse])
def test_series_and_formula_meet_where_they_part(function: Callable[[list[float]], Array]) -> None:
    for limit in (1e-4, 1e-3):
        below, above = (
            function([0.0, 0.0, limit * (1 - 1e-9)]),
            function([0.0, 0.0, limit * (1 + 1e-9)]),
        )
        np.testing.assert_allclose(below, above, atol=1e-11)


def test_batches_are_what_single_ones_are() -> None:
    rng = np.random.default_rng(3)
    omegas = rng.normal(size=(4, 5, 3))
    rotations = so3.exp(omegas)
    assert rotations.shape == (4, 5, 3, 3)
    for index in np.ndindex(4, 5):
        np.testing.assert_array_equal(rotations[index], so3.exp(omegas[index]))
        np.testing.assert_allclose(so3.log(rotations)[index], so3.log(rotations[index]), atol=1e-15)


@few
@given(omega=rotation_vectors())
def test_a_dented_rotation_is_mended(omega: Array) -> None:
    rotation = so3.exp(omega)
    dented = rotation + 1e-6 * np.arange(9.0).reshape(3, 3)
    mended = so3.nearest_rotation(dented)
    np.testing.assert_allclose(mended @ mended.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(mended) > 0
    assert motion.angle_between(mended, rotation) < 2e-5
    assert np.linalg.det(so3.nearest_rotation(np.diag([1.0, 1.0, -1.0]))) > 0  # a reflection


@few
@given(omega=rotation_vectors())
def test_the_mean_lies_in_the_middle(omega: Array) -> None:
    centre = so3.exp(omega)
    bends = np.array([[0.3, 0, 0], [-0.3, 0, 0], [0, 0.2, 0], [0, -0.2, 0]])
    np.testing.assert_allclose(so3.mean(centre @ so3.exp(bends)), centre, atol=1e-12)
    np.testing.assert_allclose(
        so3.mean(so3.exp(bends), weights=[1, 0, 0, 0]), so3.exp(bends[0]), atol=1e-12
    )
