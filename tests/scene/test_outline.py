"""Arenas whose shape is known: found round or rectangular, as large as they are, or said to be out
of view.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liex_lab.optics.camera import KINECT_V2, PRIMESENSE, PRIMESENSE_QVGA, Camera
from liex_lab.recordings import open_recording
from liex_lab.scene.background import learn_background
from liex_lab.scene.floor import find_floor
from liex_lab.scene.scene import Arena, find_arena, fit_circle, fit_rectangle
from liex_lab.simulation.scene import SimulatedScene


def seen(stage: SimulatedScene, rng: np.random.Generator) -> np.ndarray:
    """A stage's still picture with noise and unread pixels."""
    noisy = np.where(stage.still > 0, stage.still + rng.normal(0, 1.0, stage.still.shape), 0)
    return np.where(rng.random(noisy.shape) < 0.03, 0, noisy).astype(np.float32)


@pytest.mark.parametrize("n", [6, pytest.param(24, marks=pytest.mark.nightly)])
def test_drawn_arenas_are_found_as_they_are(n: int) -> None:
    """Half of them are cut by the image's edge, a third have things on the floor; the seed is not
    chosen.
    """
    rng = np.random.default_rng(0)
    kinds = {"round": 0, "rectangular": 0, "open": 0}
    for k in range(n):
        camera = (KINECT_V2, PRIMESENSE, PRIMESENSE_QVGA)[k % 3]
        stage = SimulatedScene.draw(rng, camera, 80.0)
        picture = seen(stage, rng)
        arena = find_arena(picture, find_floor(picture, camera), camera)
        kinds[arena.kind] += 1
        if arena.kind == "open":
            continue
        assert stage.wall_mm > 0, "a table has no wall"
        assert arena.kind == {"round": "round", "box": "rectangular"}[stage.kind]
        assert arena.edge == "wall"
        half = [arena.radius_mm] * 2 if arena.half_mm is None else arena.half_mm
        np.testing.assert_allclose(
            np.array([arena.centre_mm, half], float), [stage.centre, stage.half], atol=4.0
        )
        if arena.yaw_rad is not None:
            assert arena.yaw_rad == pytest.approx(stage.yaw, abs=0.01)
    assert min(kinds["round"], kinds["rectangular"]) >= n // 6
    assert kinds["open"] <= 9 * n / 24


def test_a_platform_ends_in_the_air() -> None:
    camera = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
    v, u = np.mgrid[0:240, 0:320]
    table = np.where(np.hypot(u - 150, v - 120) < 90, 600.0, 950.0).astype(np.float32)
    arena = find_arena(table, find_floor(np.where(table < 700, table, 0), camera), camera)
    assert (arena.kind, arena.edge) == ("round", "drop")
    assert arena.radius_mm == pytest.approx(180.0, abs=2.0)


def test_an_outline_of_no_simple_shape_is_irregular() -> None:
    camera = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
    v, u = np.mgrid[0:240, 0:320]
    triangle = (v > 40) & (v - 40 < 1.4 * (u - 60)) & (v - 40 < 1.4 * (260 - u)) & (v < 200)
    picture = np.where(triangle, 600.0, 480.0).astype(np.float32)
    assert (
        find_arena(picture, find_floor(np.where(triangle, picture, 0), camera), camera).kind
        == "irregular"
    )


def test_an_open_table_has_no_shape() -> None:
    table = np.full((240, 320), 600.0, np.float32)
    camera = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
    arena = find_arena(table, find_floor(table, camera), camera)
    assert arena == Arena("open", seen_share=0.0)
    assert np.isnan(arena.wall_distance_mm(np.zeros((3, 2)))).all()


@settings(max_examples=10)
@given(
    x=st.floats(-300, 300),
    y=st.floats(-300, 300),
    radius=st.floats(50, 500),
    astray=st.integers(0, 60),
)
def test_a_circle_is_found_though_some_points_are_astray(
    x: float, y: float, radius: float, astray: int
) -> None:
    rng = np.random.default_rng(astray)
    angle = rng.uniform(-2.0, 2.0, 200)
    points = np.array([x, y]) + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    points[:astray] -= 0.2 * radius * np.stack([np.cos(angle), np.sin(angle)], -1)[:astray]
    centre, found, off = fit_circle(points)
    np.testing.assert_allclose([*centre, found], [x, y, radius], atol=0.02 * radius)
    assert off < 0.02 * radius


@settings(max_examples=6)
@given(yaw=st.floats(-0.7, 0.7), a=st.floats(60, 300), ratio=st.floats(0.5, 1.0))
def test_a_rectangle_is_found_at_any_angle(yaw: float, a: float, ratio: float) -> None:
    rng = np.random.default_rng(0)
    side, along = np.arange(400) % 4, rng.uniform(-1, 1, 400)
    local = np.where(
        (side < 2)[:, None],
        np.stack([along, np.sign(side - 0.5)], -1),
        np.stack([np.sign(side - 2.5), along], -1),
    ) * [a, a * ratio]
    c, s = np.cos(yaw), np.sin(yaw)
    centre, half, found, off = fit_rectangle(local @ np.array([[c, s], [-s, c]]) + [30.0, -20.0])
    np.testing.assert_allclose(centre, [30.0, -20.0], atol=1.0)
    np.testing.assert_allclose(half, [a, a * ratio], atol=1.0)
    assert found == pytest.approx(yaw, abs=0.002)
    assert off < 0.5


def test_distances_to_the_wall_are_what_a_tape_would_say() -> None:
    points = np.array([[0.0, 0.0], [90.0, 0.0], [0.0, 45.0], [103.0, 54.0], [np.nan, 0.0]])
    box = Arena("rectangular", (0.0, 0.0), None, (100.0, 50.0), 0.0)
    np.testing.assert_allclose(box.wall_distance_mm(points), [50.0, 10.0, 5.0, -5.0, np.nan])
    turned = Arena("rectangular", (10.0, 0.0), None, (100.0, 50.0), np.pi / 2)
    np.testing.assert_allclose(turned.wall_distance_mm(points[:2]), [40.0, -30.0])
    bowl = Arena("round", (0.0, 30.0), 80.0)
    np.testing.assert_allclose(
        bowl.wall_distance_mm(points[:3]), [50.0, 80.0 - np.hypot(90, 30), 65.0]
    )


@pytest.mark.parametrize(
    "arena",
    [
        Arena("round", (1.5, -2.0), 200.0, None, None, 0.5, 1.0, "wall"),
        Arena("open", seen_share=0.25),
        Arena("rectangular", (1.5, -2.0), None, (200.0, 100.0), 0.125, 0.5, 0.75, "drop"),
    ],
)
def test_an_arena_survives_its_own_table(arena: Arena) -> None:
    assert Arena.from_dict(json.loads(json.dumps(arena.to_dict()))) == arena


@pytest.mark.nightly
def test_a_real_round_arena(reference_data: Path) -> None:
    """Its maker's bucket is 17 inches across, which is 216 mm of radius."""
    with open_recording(reference_data / "mouse_kinect2" / "session_20170125.tar.gz") as recording:
        background, *_ = learn_background(recording)
        arena = find_arena(background, find_floor(background, recording.camera), recording.camera)
    assert (arena.kind, arena.edge) == ("round", "wall")
    assert arena.radius_mm == pytest.approx(216, rel=0.02)
