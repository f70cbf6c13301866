"""What is said of a camera's place above the floor."""

import math

import cv2
import numpy as np
import pytest

from liex_lab.optics.camera import Camera
from liex_lab.scene.background import unread_floor
from liex_lab.scene.floor import Floor, components

CAMERA = Camera(365.0, 365.0, 255.5, 211.5, 512, 424)


def floor_below(distance_mm: float, tilt_deg: float) -> Floor:
    """A floor whose perpendicular is turned from the optical axis about the picture's rows."""
    tilt = math.radians(tilt_deg)
    normal = np.array([0.0, math.sin(tilt), math.cos(tilt)])
    return Floor.from_plane(normal, distance_mm, CAMERA)


@pytest.mark.parametrize(
    ("distance_mm", "tilt_deg", "problem"),
    [
        (200.0, 0.0, ""),
        (2900.0, 9.0, ""),
        (700.0, 35.0, "tilted by 35 degrees"),
        (70.0, 0.0, "70 mm from the camera"),
        (7000.0, 0.0, "7000 mm from the camera"),
    ],
)
def test_an_unusual_camera_position_is_reported(
    distance_mm: float, tilt_deg: float, problem: str
) -> None:
    found = floor_below(distance_mm, tilt_deg).unusual()
    assert len(found) == bool(problem)
    assert problem in "".join(found)


def test_the_distance_from_a_lens_above_water_is_that_of_the_lens() -> None:
    lift = np.array([0.0, 0.0, 60.0])  # the ideal camera is 60 mm nearer to the floor
    assert floor_below(400.0, 0.0).lens_distance_mm(-lift) == pytest.approx(460.0)
    assert floor_below(140.0, 0.0).unusual(-lift) == []


# Components in a box are those of the whole picture, in the same order.


@pytest.mark.parametrize("density", [0.01, 0.2, 0.45, 0.7])
@pytest.mark.parametrize("box", [(0, 60, 0, 80), (7, 52, 13, 71), (8, 9, 3, 80), (59, 60, 79, 80)])
def test_components_are_those_of_the_whole_picture(
    density: float, box: tuple[int, int, int, int]
) -> None:
    rng = np.random.default_rng(int(100 * density) + sum(box))
    mask = np.zeros((60, 80), np.uint8)
    inside = (slice(*box[:2]), slice(*box[2:]))
    mask[inside] = rng.random(mask[inside].shape) < density
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask)
    found, sizes = components(mask)
    np.testing.assert_array_equal(found, labels)
    np.testing.assert_array_equal(sizes[1:], stats[1:])


def test_an_empty_mask_has_no_component() -> None:
    labels, stats = components(np.zeros((5, 7), np.uint8))
    assert not labels.any()
    assert len(stats) == 1


# Where a glossy floor is unread, what stood there is no background.


FLOOR_MM = 700.0


EVERY, SHORT = slice(None), slice(12)


@pytest.mark.parametrize(
    ("things", "n_px"),
    [
        # an animal that stood on an unread patch is no background
        ([(EVERY, 20, 40, 30, 50, 0.0), (SHORT, 25, 35, 35, 45, 675.0)], 100),
        # a thing that stays and is read is background
        ([(EVERY, 20, 40, 30, 50, 660.0)], 0),
        # a dark thing on a wall is none of the floor
        (
            [
                (EVERY, 10, 50, 20, 60, 620.0),
                (EVERY, 20, 40, 30, 50, 0.0),
                (SHORT, 20, 40, 30, 50, 600.0),
            ],
            0,
        ),
        # specks hide no animal
        ([(EVERY, 20, 24, 30, 34, 0.0), (SHORT, 20, 24, 30, 34, 675.0)], 0),
    ],
)
def test_of_unread_floor_only_what_stood_there_is_no_background(things, n_px) -> None:
    sample = np.full((40, 60, 80), FLOOR_MM, np.float32)
    for frames, top, bottom, left, right, depth_mm in things:
        sample[frames, top:bottom, left:right] = depth_mm
    bare = np.full((60, 80), FLOOR_MM, np.float32)
    on_floor = np.ones(bare.shape, np.bool_)
    found = unread_floor(sample, sample.max(axis=0), bare, on_floor, 7.0, 30.0)
    assert found.sum() == found[25:35, 35:45].sum() == n_px
