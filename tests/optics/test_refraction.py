"""Through the water: known points are seen as Snell's law says, and put back where they are."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liex_lab.errors import LiexError
from liex_lab.optics.camera import PRIMESENSE, RANGINGS, Water
from tests.oracles.refraction import ray_to, seen, true_points

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
@settings(max_examples=15)
@given(height=st.floats(150, 900), n=st.floats(1.0, 1.5), tilt_x=tilts, tilt_y=tilts)
def test_the_law_places_a_point_under_water_where_it_is(
    ranging: str, height: float, n: float, tilt_x: float, tilt_y: float
) -> None:
    water = Water(height, n, tilt_x, tilt_y, ranging)
    points = points_under(water, 50)
    rays, apparent = seen(points, water.normal, height, n, ranging, baseline_mm=0.01)
    np.testing.assert_allclose(true_points(water, rays, apparent), points, atol=1e-4)


def test_the_angles_obey_snell() -> None:
    """The oracle itself: sines in air and in water have the ratio n."""
    water = Water(400.0, 1.333, 0.1, -0.05)
    points = points_under(water)
    ray, in_air, _ = ray_to(points, np.zeros(3), water.normal, 400.0, 1.333)
    down = points - ray * in_air[:, None]
    down /= np.linalg.norm(down, axis=-1, keepdims=True)
    sines = [np.linalg.norm(np.cross(way, water.normal), axis=-1) for way in (ray, down)]
    np.testing.assert_allclose(sines[0], 1.333 * sines[1], atol=1e-9)
    assert np.abs(np.cross(ray, down) @ water.normal).max() < 1e-9, "in one plane"


@pytest.mark.parametrize("ranging", RANGINGS)
def test_straight_down_above_the_water_and_in_air_the_law_is_the_textbooks(ranging: str) -> None:
    """Light takes longer under water: a time-of-flight camera reports a larger depth, others a
    smaller one.
    """
    factor = 1.333 if ranging == "time_of_flight" else 1 / 1.333
    found = true_points(Water(500.0, 1.333, ranging=ranging), [0.0, 0.0], 500.0 + 200.0 * factor)
    assert found == pytest.approx([0.0, 0.0, 700.0], abs=1e-9)
    rays = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 2))
    for water, depth in (
        (Water(500.0, 1.333, 0.05, 0.0, ranging), 400.0),
        (Water(500.0, 1.0, 0.1, 0.2, ranging), 800.0),
    ):
        seeming = np.concatenate([rays, np.ones((50, 1))], axis=1) * depth
        np.testing.assert_allclose(true_points(water, rays, depth), seeming, atol=1e-9)


def test_views_at_a_finite_distance_give_nearly_the_same() -> None:
    """A PrimeSense camera's views are 75 mm apart: half a millimetre at most."""
    water = Water(400.0, ranging="structured_light")
    points = points_under(water)
    rays, apparent = seen(points, water.normal, 400.0, 1.333, "structured_light", baseline_mm=75.0)
    assert np.abs(true_points(water, rays, apparent) - points).max() < 0.5


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
    axis = true_points(water, [0.0, 0.0], 900.0) + water.lift_mm
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
