"""Rigid transforms are a group, and the formulas of Lie-X section 3 hold in it."""

from typing import Any

import numpy as np
from hypothesis import given

from liex_lab.geometry import SE3
from tests.geometry.strategies import Array, few, twists
from tests.oracles import motion


def assert_close(found: Any, expected: Any) -> None:
    np.testing.assert_allclose(found, expected, atol=1e-9, rtol=0)


def assert_same(first: SE3, second: SE3) -> None:
    assert_close(first.matrix, second.matrix)


@few
@given(a=twists(), b=twists(), c=twists())
def test_transforms_are_a_group(a: Array, b: Array, c: Array) -> None:
    g, h, k = SE3.exp(a), SE3.exp(b), SE3.exp(c)
    assert_same((g @ h) @ k, g @ (h @ k))
    assert_same(g @ SE3.identity(), g)
    assert_same(g @ g.inverse(), SE3.identity())
    assert_same((g @ h).inverse(), h.inverse() @ g.inverse())
    assert_close((g @ h).matrix, g.matrix @ h.matrix)
    assert_same(SE3.from_matrix(g.matrix), g)
    p = 500.0 * np.cos(c[:3])
    assert_close((g @ h) @ p, (g.matrix @ h.matrix @ [*p, 1.0])[:3])


@few
@given(xi=twists())
def test_exp_agrees_with_the_matrix_exponential(xi: Array) -> None:
    assert_close(SE3.exp(xi).matrix, motion.exp(xi))


@few
@given(xi=twists())
def test_exp_and_log_undo_one_another(xi: Array) -> None:
    g = SE3.exp(xi)
    assert_same(SE3.exp(g.log()), g)
    # near pi the two directions of turning meet, and log may come back by the other one
    if np.linalg.norm(xi[:3]) < np.pi - 1e-9:
        assert_close(g.log(), xi)


@few
@given(a=twists(), b=twists())
def test_the_adjoint_carries_a_twist_into_the_other_frame(a: Array, b: Array) -> None:
    g, h, xi = SE3.exp(a), SE3.exp(b), 0.001 * b
    by_matrix = g.matrix @ motion.hat(xi) @ np.linalg.inv(g.matrix)
    assert_close(motion.hat(g.adjoint() @ xi), by_matrix)
    assert_same(SE3.exp(g.adjoint() @ xi), g @ SE3.exp(xi) @ g.inverse())
    assert_close((g @ h).adjoint(), g.adjoint() @ h.adjoint())


@few
@given(a=twists(), b=twists())
def test_a_geodesic_joins_its_ends_at_constant_speed_on_the_shorter_way(a: Array, b: Array) -> None:
    g, h = SE3.exp(a), SE3.exp(b)
    path = g.geodesic(h, np.linspace(0.0, 1.0, 9))
    assert_close(path.matrix[0], g.matrix)
    assert_close(path.matrix[8], h.matrix)
    turns = [motion.angle_between(path.rotation[i], path.rotation[i + 1]) for i in range(8)]
    steps = np.linalg.norm(np.diff(path.translation, axis=0), axis=1)
    np.testing.assert_allclose(turns, motion.angle_between(g.rotation, h.rotation) / 8, atol=1e-7)
    assert_close(steps, np.linalg.norm(h.translation - g.translation) / 8)


def test_one_transform_moves_a_batch_and_a_batch_moves_one_point() -> None:
    rng = np.random.default_rng(9)
    xis, points = rng.normal(size=(7, 6)), rng.normal(size=(7, 3))
    batch = SE3.exp(xis)
    for k in range(7):
        one = SE3.exp(xis[k])
        np.testing.assert_array_equal(batch[k].matrix, batch.matrix[k])
        np.testing.assert_allclose((batch @ points)[k], one @ points[k], atol=1e-14)
        np.testing.assert_allclose((batch @ points[0])[k], one @ points[0], atol=1e-14)
        np.testing.assert_allclose(
            (batch[0] @ batch)[k].matrix, (batch[0] @ one).matrix, atol=1e-14
        )
    np.testing.assert_array_equal(SE3.join([batch, batch[2:4]])[8].matrix, batch[3].matrix)
    np.testing.assert_array_equal(SE3.identity(2, 3).matrix, np.tile(np.eye(4), (2, 3, 1, 1)))
