"""What is said of a camera's place above the floor."""

from __future__ import annotations

import math

import numpy as np
import pytest

from liex_lab.optics.camera import Camera
from liex_lab.scene.floor import Floor

CAMERA = Camera(365.0, 365.0, 255.5, 211.5, 512, 424)


def floor_below(distance_mm: float, tilt_deg: float) -> Floor:
    """A floor whose perpendicular is turned from the optical axis about the picture's rows."""
    tilt = math.radians(tilt_deg)
    normal = np.array([0.0, math.sin(tilt), math.cos(tilt)])
    return Floor.from_plane(normal, distance_mm, CAMERA)


@pytest.mark.parametrize("distance_mm", [200.0, 700.0, 2900.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 9.0])
def test_nothing_is_said_of_a_camera_as_labs_hang_it(distance_mm: float, tilt_deg: float) -> None:
    assert floor_below(distance_mm, tilt_deg).unusual() == []


def test_a_camera_that_looks_aslant_is_told_by_how_much() -> None:
    (said,) = floor_below(700.0, 35.0).unusual()
    assert "looks down at 35 degrees" in said


@pytest.mark.parametrize("distance_mm", [70.0, 7000.0])
def test_a_floor_that_is_unlikely_far_away_is_told(distance_mm: float) -> None:
    (said,) = floor_below(distance_mm, 0.0).unusual()
    assert f"{distance_mm:.0f} mm from the camera" in said


def test_the_distance_from_a_lens_above_water_is_that_of_the_lens() -> None:
    lift = np.array([0.0, 0.0, 60.0])  # the ideal camera is 60 mm nearer to the floor
    assert floor_below(400.0, 0.0).lens_distance_mm(-lift) == pytest.approx(460.0)
    assert floor_below(140.0, 0.0).unusual(-lift) == []
