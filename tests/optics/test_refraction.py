"""Through the water: known points are seen as Snell's law says, and put back where they are."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.errors import LiexError
from liex_lab.optics.camera import PRIMESENSE
from liex_lab.optics.refraction import RANGINGS, Water
from tests.oracles.refraction import ray_to, seen

TRACED = [ranging for ranging in RANGINGS if ranging != "paraxial"]
tilts = st.floats(-0.25, 0.25)


def points_under(water: Water, n: int = 200, seed: int = 0) -> np.ndarray:
    """(n, 3) mm in front of the camera, 5 to 400 mm below the surface."""
    rng = np.random.default_rng(seed)
    points = np.stack([rng.uniform(-250, 250, n), rng.uniform(-200, 200, n), np.zeros(n)], axis=-1)
    wanted = water.height_mm + rng.uniform(5, 400, n)
    points[:, 2] = (wanted - points[:, :2] @ water.normal[:2]) / water.normal[2]
    return points


@pytest.mark.parametrize("ranging", TRACED)
@given(height=st.floats(150, 900), n=st.floats(1.0, 1.5), tilt_x=tilts, tilt_y=tilts)
def test_a_point_under_water_is_put_back_where_it_is(
    ranging: str, height: float, n: float, tilt_x: float, tilt_y: float
) -> None:
    water = Water(height, n, tilt_x, tilt_y, ranging)
    points = points_under(water, 50)
    rays, apparent = seen(points, water.normal, height, n, ranging, baseline_mm=0.01)
    np.testing.assert_allclose(water.true_points(rays, apparent), points, atol=1e-4)


def test_the_angles_obey_snell() -> None:
    """The oracle itself: sines in air and in water are as n to 1, whatever was solved to
    get there.
    """
    water = Water(400.0, 1.333, 0.1, -0.05)
    points = points_under(water)
    ray, in_air, _ = ray_to(points, np.zeros(3), water.normal, 400.0, 1.333)
    down = points - ray * in_air[:, None]
    down /= np.linalg.norm(down, axis=-1, keepdims=True)
    sines = [np.linalg.norm(np.cross(way, water.normal), axis=-1) for way in (ray, down)]
    np.testing.assert_allclose(sines[0], 1.333 * sines[1], atol=1e-9)
    assert np.abs(np.cross(ray, down) @ water.normal).max() < 1e-9, "in one plane"


@pytest.mark.parametrize("ranging", ["light_field", "structured_light", "paraxial"])
def test_straight_down_the_apparent_depth_is_the_true_one_over_n(ranging: str) -> None:
    water = Water(500.0, 1.333, ranging=ranging)
    assert water.true_points([0.0, 0.0], 500.0 + 200.0 / 1.333) == pytest.approx(
        [0.0, 0.0, 700.0], abs=1e-9
    )


def test_light_takes_longer_under_water() -> None:
    """A time-of-flight camera sees the bottom farther away than it is, where the others see it
    nearer.
    """
    water = Water(500.0, 1.333, ranging="time_of_flight")
    assert water.true_points([0.0, 0.0], 500.0 + 200.0 * 1.333) == pytest.approx(
        [0.0, 0.0, 700.0], abs=1e-9
    )


def test_two_eyes_that_are_not_infinitely_near_see_nearly_the_same() -> None:
    """A PrimeSense camera's views are 75 mm apart: half a millimetre at most, over the
    whole field.
    """
    water = Water(400.0, ranging="structured_light")
    points = points_under(water)
    rays, apparent = seen(points, water.normal, 400.0, 1.333, "structured_light", baseline_mm=75.0)
    assert np.abs(water.true_points(rays, apparent) - points).max() < 0.5


@pytest.mark.parametrize("ranging", RANGINGS)
def test_what_is_above_the_water_is_where_it_seems(ranging: str) -> None:
    water = Water(500.0, 1.333, 0.05, 0.0, ranging)
    rays, depth = np.array([[0.1, 0.2], [-0.3, 0.1], [0.0, 0.0]]), np.array([300.0, 400.0, 499.0])
    seeming = np.concatenate([rays, np.ones((3, 1))], axis=1) * depth[:, None]
    np.testing.assert_allclose(water.true_points(rays, depth), seeming, atol=1e-9)


@pytest.mark.parametrize("ranging", RANGINGS)
def test_air_under_the_surface_changes_nothing(ranging: str) -> None:
    rays = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    seeming = np.concatenate([rays, np.ones((50, 1))], axis=1) * 800.0
    np.testing.assert_allclose(
        Water(500.0, 1.0, 0.1, 0.2, ranging).true_points(rays, 800.0), seeming, atol=1e-9
    )


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (0.08, -0.05)])
def test_the_camera_without_water_sees_everything_in_the_same_pixel(
    tilt: tuple[float, float],
) -> None:
    """So neither is detail lost nor another side of the animal shown; off the perpendicular a point
    moves inwards.
    """
    water = Water(500.0, 1.333, *tilt)
    ideal = water.without(PRIMESENSE)
    points = points_under(water)
    ray, *_ = ray_to(points, np.zeros(3), water.normal, 500.0, 1.333)
    real, virtual = PRIMESENSE.project(ray), ideal.project(points + water.lift_mm)
    middle = np.array([PRIMESENSE.cx, PRIMESENSE.cy])
    off, out = np.linalg.norm(virtual - real, axis=-1), np.linalg.norm(real - middle, axis=-1)
    assert (off < 1.0 + 0.015 * out).all()
    assert off[out < 60].max() < 1.5
    axis = water.true_points([0.0, 0.0], 900.0) + water.lift_mm
    np.testing.assert_allclose(ideal.project(axis), middle, atol=0.1)


@pytest.mark.parametrize(
    "wrong",
    [
        {"height_mm": 0.0},
        {"refractive_index": 0.9},
        {"tilt_x_rad": 1.5},
        {"ranging": "sonar"},
        {"height_mm": np.nan},
    ],
)
def test_a_surface_that_cannot_be_is_refused_in_a_sentence(wrong: dict) -> None:
    with pytest.raises(LiexError, match=r"correct \[water\] in the plan"):
        replace(Water(500.0), **wrong)
