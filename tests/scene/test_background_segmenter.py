"""The scene and the animal in it: backgrounds under animals that sit, floors that tilt, blobs of
the right size.
"""

from dataclasses import replace

import numpy as np
import pytest

from liex_lab.errors import EstimationError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.recording import Recording
from liex_lab.scene.background import learn_background
from liex_lab.scene.floor import Floor, find_floor
from liex_lab.scene.learning import learn_scene
from tests.scene.staged import bare_floor

CAMERA = Camera(300.0, 300.0, 79.5, 59.5, 160, 120)
SPINES = (40.0, 115.0)


def tilted(degrees: float, distance: float = 600.0) -> Floor:
    angle = np.radians(degrees)
    return Floor.from_plane(
        np.array([np.sin(angle), 0.3 * np.sin(angle), np.cos(angle)]), distance, CAMERA
    )


def with_box(
    floor: Floor, centre: tuple[int, int], half: tuple[int, int] = (12, 6), high: float = 25.0
) -> np.ndarray:
    depth = floor.depth(CAMERA.width, CAMERA.height)
    u, v = centre
    depth[v - half[1] : v + half[1], u - half[0] : u + half[0]] -= high
    return depth


def recording_of(frames: list[np.ndarray], noise_mm: float = 1.0) -> Recording:
    rng = np.random.default_rng(0)
    noisy = [
        np.where(f > 0, np.maximum(f + rng.normal(0, noise_mm, f.shape), 1), 0).astype(np.float32)
        for f in frames
    ]
    return Recording(
        name="boxes",
        format="synthetic",
        camera=CAMERA,
        times_ns=np.arange(len(frames)) * 33_000_000,
        read=lambda k: noisy[k],
    )


def test_the_arena_frame_stands_on_the_floor_with_z_up():
    floor = tilted(8.0)
    T = floor.T_arena_camera
    np.testing.assert_allclose(T.rotation @ T.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T.rotation) == pytest.approx(1.0)
    uv = np.array([[10.0, 20.0], [150.0, 100.0], [80.0, 60.0]])
    a, b, c = floor.inverse_depth
    on_floor = T @ CAMERA.unproject(uv, 1.0 / (a * uv[:, 0] + b * uv[:, 1] + c))
    np.testing.assert_allclose(on_floor[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(T @ np.zeros(3), [0.0, 0.0, floor.distance_mm], atol=1e-9)


@pytest.mark.parametrize("degrees", [0.0, 5.0, 10.0])
def test_a_tilted_floor_is_found_under_clutter(degrees):
    floor = tilted(degrees)
    depth = floor.depth(CAMERA.width, CAMERA.height)
    depth[:30] -= 120.0  # a shelf over a quarter of the picture
    found = find_floor(depth, CAMERA)
    assert found.distance_mm == pytest.approx(floor.distance_mm, abs=0.5)
    assert np.degrees(np.arccos(np.clip(found.normal @ floor.normal, -1, 1))) < 0.1


def test_a_scene_without_a_floor_is_refused_in_one_sentence():
    rng = np.random.default_rng(1)
    with pytest.raises(EstimationError, match="no floor was found"):
        find_floor(rng.uniform(300, 2000, (120, 160)).astype(np.float32), CAMERA)


@pytest.mark.parametrize(("frames_at_first", "most_mm"), [(range(0, 40, 2), 4.0), (range(36), 6.0)])
def test_the_background_survives_a_pixel_that_is_covered_most_of_the_time(frames_at_first, most_mm):
    floor = tilted(3.0)
    frames = [with_box(floor, (50, 50) if k in frames_at_first else (110, 70)) for k in range(40)]
    background, spread, _ = learn_background(np.stack([f.depth for f in recording_of(frames)]))
    assert np.abs(background - floor.depth(CAMERA.width, CAMERA.height)).max() < most_mm
    assert np.median(spread) < 2.0


def test_an_animal_that_never_moves_is_found_against_the_floor():
    recording = recording_of([with_box(tilted(2.0), (60, 60))] * 20)
    scene, sample = learn_scene(recording, SPINES)
    crops = scene.extract(sample, 1.0)
    assert crops.found.all()
    u = crops.origin[:, 0] + 48
    assert np.abs(u - 60).max() < 4


def test_the_animal_is_told_from_a_larger_thing_that_comes_and_goes():
    floor = tilted(2.0)
    frames = []
    for k in range(40):
        frame = with_box(floor, (30 + 2 * k, 40))
        if k % 2:
            frame[80:116, 20:100] -= 60.0
        frames.append(frame)
    scene, sample = learn_scene(recording_of(frames), SPINES)
    crops = scene.extract(sample, 1.0)
    centre = crops.origin[:, 0] + 48
    assert crops.found.all()
    assert np.abs(centre - (30 + 2 * np.arange(40))).max() < 5


def test_heights_are_true_whatever_the_tilt_and_holes_are_filled():
    floor = tilted(10.0)
    T = floor.T_arena_camera
    camera_points = CAMERA.unproject(
        np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), -1), 1.0
    )
    ray_up = camera_points @ T.rotation[2]
    roof = ((20.0 - floor.distance_mm) / ray_up).astype(np.float32)  # a plane 20 mm above the floor
    depth = floor.depth(160, 120)
    depth[50:70, 60:100] = roof[50:70, 60:100]
    depth[60, 80] = 0.0
    crops = bare_floor(CAMERA, floor).extract(depth[None], 1.0)
    inner = crops.heights[0][48 - 6 : 48 + 6, 48 - 12 : 48 + 12] / 16.0
    np.testing.assert_allclose(inner, 20.0, atol=0.2)


def test_an_empty_frame_is_not_found_and_costs_nothing_else():
    floor = tilted(2.0)
    scene = bare_floor(CAMERA, floor)
    stack = np.stack(
        [floor.depth(160, 120), with_box(floor, (60, 60)), np.zeros((120, 160), np.float32)]
    )
    assert scene.extract(stack, 1.0).found.tolist() == [False, True, False]


def test_what_else_may_be_the_animal_is_cut_out_in_the_same_go():
    floor = tilted(3.0)
    alone = with_box(floor, (50, 60))
    beside = np.where(
        alone < with_box(floor, (110, 60), (10, 6)), alone, with_box(floor, (110, 60), (10, 6))
    )
    scene = replace(bare_floor(CAMERA, floor), area_mm2=24 * 12 * (575.0 / 300.0) ** 2)
    first, second = scene.extract_both(np.stack([alone, beside]), 1.0)
    np.testing.assert_array_equal(
        first.heights, scene.extract(np.stack([alone, beside]), 1.0).heights
    )
    assert first.n_blobs.tolist() == second.n_blobs.tolist() == [1, 2]
    assert second.found.tolist() == [False, True]
    only_other = scene.extract(with_box(floor, (110, 60), (10, 6))[None], 1.0)
    np.testing.assert_array_equal(second.heights[1], only_other.heights[0])
    np.testing.assert_allclose(second.moments[1], only_other.moments[0])


def test_the_long_axis_and_area_of_a_box_are_its_own():
    floor = tilted(0.0)
    crops = bare_floor(CAMERA, floor).extract(with_box(floor, (80, 60), (20, 8))[None], 1.0)
    area, angle = crops.moments[0, 1], crops.moments[0, 5]
    scale = (600.0 - 25.0) / 300.0
    assert area == pytest.approx(40 * 16 * scale**2, rel=0.03)
    assert abs(np.sin(angle)) < 0.02


@pytest.mark.parametrize(
    ("n", "depth_mm", "says"), [(1, 700, "learned from 1 frame"), (30, 0, "no depth was read")]
)
def test_a_recording_that_shows_no_background_is_told_why(n: int, depth_mm: int, says: str) -> None:
    pictures = np.full((60, 80), depth_mm, np.float32)
    still = Recording(
        name="still",
        format="test",
        camera=Camera(80.0, 80.0, 40.0, 30.0, 80, 60),
        times_ns=np.arange(n, dtype=np.int64) * 10**8,
        read=lambda row: pictures,
    )
    with pytest.raises(EstimationError, match=says):
        learn_scene(still, (40.0, 115.0))


# Which of the components of a picture is likest to the animal.
