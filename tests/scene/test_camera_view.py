"""Animals of the camera view: heights along the optical axis, bodies with holes, backs that
rise.
"""

from dataclasses import replace

import numpy as np
import pytest

from liex_lab.body.skeleton import CameraView, Skeleton
from liex_lab.estimation.cascade import draw_starts, start_poses
from liex_lab.estimation.method import method_of
from liex_lab.optics.camera import Camera
from liex_lab.recordings.recording import Recording
from liex_lab.scene.background import stride_for
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.floor import Floor
from tests.scene.staged import bare_floor

CAMERA = Camera(600.0, 600.0, 119.5, 89.5, 240, 180)
FLOOR = Floor.from_plane(np.array([0.0, 0.0, 1.0]), 300.0, CAMERA)
BEHIND, HIGH = 20.0, 40.0


def scene(frame: str) -> BackgroundSubtraction:
    bare = bare_floor(CAMERA, FLOOR, 3.0)
    view = CameraView(frame, behind_mm=BEHIND, smooth_mm=0.6)
    return BackgroundSubtraction(
        CAMERA, FLOOR, bare.background, bare.limit, bare.on_floor, view=view
    )


def bar(rise: float = 0.0, turned: float = 0.3) -> np.ndarray:
    """A frame with a bar of 60 x 8 mm that hangs HIGH above the floor, along a heading, its front
    higher by `rise`.
    """
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    z = FLOOR.distance_mm - HIGH
    x, y = (u - CAMERA.cx) / CAMERA.fx * z, -(v - CAMERA.cy) / CAMERA.fy * z
    along, across = (
        np.cos(turned) * x + np.sin(turned) * y,
        -np.sin(turned) * x + np.cos(turned) * y,
    )
    inside = (np.abs(along) < 30.0) & (np.abs(across) < 4.0)
    return np.where(inside, z - rise * along, FLOOR.depth(CAMERA.width, CAMERA.height)).astype(
        np.float32
    )


def test_heights_are_measured_from_behind_the_mean_of_what_is_kept():
    crops = scene("camera").extract(bar(0.2)[None], 1.0, camera_view=True)
    heights = crops.heights[0][crops.heights[0] > 0] / 16.0
    assert heights.mean() == pytest.approx(BEHIND, abs=0.1)
    assert crops.distance[0] == pytest.approx(FLOOR.distance_mm - HIGH + BEHIND, abs=0.2)
    assert np.ptp(heights) == pytest.approx(0.2 * 60.0, rel=0.15)


def test_the_height_map_does_not_tell_the_size_for_which_it_was_cut():
    cut = [scene("camera").extract(bar(0.2)[None], size, camera_view=True) for size in (0.9, 1.1)]
    np.testing.assert_array_equal(cut[0].heights, cut[1].heights)
    np.testing.assert_array_equal(cut[0].distance, cut[1].distance)


def test_what_hangs_together_with_the_animal_but_lies_far_behind_it_is_left_out():
    frame = bar()
    frame[85:95, 185:200] = (
        FLOOR.distance_mm - 4.0
    )  # something low on the floor, seen beside the animal
    crops = scene("camera").extract(frame[None], 1.0, camera_view=True)
    assert crops.distance[0] == pytest.approx(FLOOR.distance_mm - HIGH + BEHIND, abs=0.2)


def beside(alone: np.ndarray, *things: tuple[slice, slice, float]) -> np.ndarray:
    """An image with things in some rows and columns, at a depth, mm."""
    frame = alone.copy()
    for rows, columns, depth in things:
        frame[rows, columns] = depth
    return frame


ALL, LOW = slice(None), FLOOR.distance_mm - 4.0
RAISED = np.where(bar() < FLOOR.distance_mm - 20.0, bar() - 20.0, bar())
UPRIGHT = bar(turned=0.0)
UPRIGHT[FLOOR.distance_mm - 20.0 > UPRIGHT] -= 60.0
SPECKS = slice(60, 72), FLOOR.distance_mm - 10.0
TOUCHING: dict[str, tuple[float, np.ndarray, np.ndarray]] = {
    "a beam in front of one end is taken for unread": (
        480.0,
        beside(bar(), (ALL, slice(40, 70), 150.0)),
        beside(bar(), (ALL, slice(40, 70), 0.0)),
    ),
    "a beam in front of the other end, too": (
        480.0,
        beside(bar(), (ALL, slice(150, 230), 150.0)),
        beside(bar(), (ALL, slice(150, 230), 0.0)),
    ),
    "a larger thing far behind is background": (
        480.0,
        np.minimum(RAISED, beside(RAISED, (slice(60, 130), slice(170, 230), LOW))),
        RAISED,
    ),
    "an animal between a beam and specks far behind it": (
        280.0,
        beside(UPRIGHT, (ALL, slice(150, 230), 150.0), (SPECKS[0], slice(146, 150), SPECKS[1])),
        beside(UPRIGHT, (ALL, slice(150, 230), 0.0)),
    ),
    "a thing elsewhere, larger than the animal and likest to it": (
        480.0,
        beside(bar(), (ALL, slice(0, 40), 200.0), (SPECKS[0], slice(40, 44), SPECKS[1])),
        bar(),
    ),
}


@pytest.mark.parametrize("name", TOUCHING)
def test_things_that_touch_the_animal_in_the_image_do_not_change_it(name: str) -> None:
    area_mm2, frame, alone = TOUCHING[name]
    known = replace(scene("camera"), area_mm2=area_mm2)
    crops, same = (known.extract(each[None], 1.0, camera_view=True) for each in (frame, alone))
    assert crops.n_px[0] > 0
    np.testing.assert_array_equal(crops.n_px, same.n_px)
    np.testing.assert_array_equal(crops.heights, same.heights)
    np.testing.assert_array_equal(crops.moments, same.moments)
    if "beam in front" in name:
        bare = known.extract(bar()[None], 1.0, camera_view=True)
        assert crops.n_px[0] > 0.5 * bare.n_px[0]


def test_readings_missing_across_the_body_do_not_part_it():
    frame = bar(turned=0.0)
    frame[60:120, 100:112] = 0.0  # 12 pixels, 5 mm
    whole = scene("camera").extract(frame[None], 1.0, camera_view=True)
    assert np.ptp(np.nonzero(whole.heights[0] > 0)[1]) * whole.step[0] > 120
    part = scene("floor").extract(frame[None], 1.0)
    assert np.ptp(np.nonzero(part.heights[0] > 0)[1]) * part.step[0] < 90


@pytest.mark.parametrize("rise", [-0.3, 0.0, 0.15])
@pytest.mark.parametrize("wrong_share", [0.0, 0.12])
def test_the_slope_of_the_back_is_told_in_spite_of_gross_errors(rise, wrong_share):
    rng = np.random.default_rng(3)
    frame = bar(rise)
    body = frame < FLOOR.distance_mm - 20.0
    wrong = body & (rng.random(frame.shape) < wrong_share)
    frame[wrong] -= rng.uniform(3.0, 12.0, int(wrong.sum())).astype(np.float32) * (
        np.nonzero(wrong)[1] > CAMERA.cx
    )
    crops = scene("camera").extract(frame[None], 1.0, camera_view=True)
    assert np.cos(crops.moments[0, 5] - 0.3) == pytest.approx(1.0, abs=0.01)
    assert crops.moments[0, 8] == pytest.approx(rise, abs=0.03)
    assert scene("floor").extract(frame[None], 1.0).moments[0, 8] == 0.0


@pytest.mark.parametrize("rise", [-0.3, 0.15])
def test_an_animal_of_the_camera_view_starts_as_steep_as_its_back_both_ways(rise):
    moments = scene("camera").extract(bar(rise)[None], 1.0, camera_view=True).moments
    starts = draw_starts(np.random.default_rng(1), 1, 8)
    rotation, position, _ = start_poses(
        moments,
        starts,
        np.ones((1, 8)),
        Skeleton.load("fish"),
        method_of("default", Skeleton.load("fish")),
    )
    forward = rotation[0, :, :, 0]
    slope = forward[:, 2] / np.hypot(forward[:, 0], forward[:, 1])
    ahead = np.sign(forward[:, 0])  # the bar's front points to the right
    np.testing.assert_allclose(slope * ahead, rise, atol=0.08)
    assert {-1.0, 1.0} == set(ahead)
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, -1, -2),
        np.broadcast_to(np.eye(3), (1, 8, 3, 3)),
        atol=1e-12,
    )
    tip = position[0, :, 2] - moments[0, 2] / moments[0, 1]
    assert (
        np.sign(tip + 0.05 * 60.0) == np.sign(forward[:, 2])
    ).all()  # the base is the front here


def test_a_large_picture_is_looked_at_as_finely_as_the_smallest_animal_needs():
    def recording(camera: Camera, depth_mm: float) -> Recording:
        depth = np.full((camera.height, camera.width), depth_mm, np.float32)
        return Recording(
            name="flat",
            format="synthetic",
            camera=camera,
            times_ns=np.arange(3) * 10,
            read=lambda k: depth,
        )

    large = Camera(2363.0, 2363.0, 511.5, 511.5, 1024, 1024)
    assert stride_for(recording(large, 280.0), 18.0) == 2
    assert stride_for(recording(large, 280.0), 60.0) == 4
    assert stride_for(recording(CAMERA, 280.0), 18.0) == 1
    assert stride_for(recording(large, 0.0), 18.0) == 1  # nothing to tell it by
