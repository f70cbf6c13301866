"""The floor is where animals stand, however small and however high it lies."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from liex_lab.errors import EstimationError
from liex_lab.scene.floor import find_floor
from liex_lab.scene.learning import learn_scene
from liex_lab.scene.scene import LARGEST, find_arena
from liex_lab.simulation.scenes.catalogue import film
from tests.scene.staged import on_a_table, shown, stage, walk

SPINES = (40.0, 115.0)
N_FRAMES = 24

STAGES: dict[str, dict[str, Any]] = {
    "a small arena in the dark": {
        "half_mm": (95.0, 95.0),
        "height_mm": 900.0,
        "wall_mm": 150.0,
        "room": False,
    },
    "a small arena 30 mm above the bench": {
        "half_mm": (95.0, 95.0),
        "height_mm": 900.0,
        "wall_mm": 150.0,
        "raised_mm": 30.0,
    },
    "a platform without walls": {"height_mm": 700.0, "wall_mm": 0.0, "raised_mm": 480.0},
    "a platform seen at 35 degrees": {
        "height_mm": 700.0,
        "wall_mm": 0.0,
        "raised_mm": 300.0,
        "tilt_deg": 35.0,
    },
}


@pytest.mark.parametrize(
    "name",
    [
        "a small arena 30 mm above the bench",
        *(
            pytest.param(name, marks=pytest.mark.nightly)
            for name in ("an arena on a table", *STAGES)
            if "30 mm" not in name
        ),
    ],
)
def test_the_floor_is_where_the_mouse_walks(name):
    mouse = walk(stage(**STAGES[name]), N_FRAMES) if name in STAGES else on_a_table()[0]
    scene, sample = learn_scene(mouse, SPINES, N_FRAMES)
    assert scene.floor.distance_mm == pytest.approx(mouse.floor.distance_mm, abs=3.0)
    angle = np.degrees(np.arccos(np.clip(scene.floor.normal @ mouse.floor.normal, -1, 1)))
    assert angle < 0.5
    crops = scene.extract(sample, 1.0)
    assert crops.found.mean() > 0.9
    off = scene.middles(crops)[crops.found] - mouse.joints_arena.mean(axis=1)[crops.found]
    assert np.median(np.linalg.norm(off[:, :2], axis=1)) < 25.0
    assert scene.support_plane is not None
    assert scene.support_plane.support > 0.8
    assert not scene.support_plane.doubt


@pytest.mark.parametrize("tilt_deg", [pytest.param(0.0, marks=pytest.mark.nightly), 20.0])
def test_an_arena_whose_floor_lies_a_little_above_the_bench_has_its_own_plane(tilt_deg):
    """The largest plane runs between the two, for they are less than a floor's flatness apart."""
    mouse = walk(stage(height_mm=700.0, raised_mm=6.0, wall_mm=60.0, tilt_deg=tilt_deg), N_FRAMES)
    between = find_floor(np.asarray(mouse.stage.scene.still), mouse.camera)
    assert abs(between.distance_mm - mouse.floor.distance_mm) > 2.0
    scene, _ = learn_scene(mouse, SPINES, N_FRAMES)
    assert scene.floor.distance_mm == pytest.approx(mouse.floor.distance_mm, abs=1.2)
    angle = np.degrees(np.arccos(np.clip(scene.floor.normal @ mouse.floor.normal, -1, 1)))
    assert angle < 0.3


def test_an_arena_on_a_table_has_its_own_outline_and_nothing_else_is_looked_at():
    scene, _ = learn_scene(shown(on_a_table()[1]), SPINES, N_FRAMES)
    arena = find_arena(scene.background, scene.floor, scene.camera)
    assert arena.kind == "rectangular"
    np.testing.assert_allclose(np.array(arena.half_mm), 150.0, atol=4.0)
    assert arena.edge == "wall"
    assert not scene.limit[0].any()  # the room's floor


def test_a_glossy_floor_with_holes_is_still_the_floor():
    rng = np.random.default_rng(3)
    holes = rng.random((240, 320)) < 0.25
    depths = on_a_table()[1]
    glossy = shown(np.where(holes & (depths > 600.0), np.float32(0), depths))
    scene, sample = learn_scene(glossy, SPINES, N_FRAMES)
    assert scene.floor.distance_mm == pytest.approx(700.0, abs=3.0)
    assert scene.extract(sample, 1.0).found.mean() > 0.9


def test_in_an_ordinary_scene_the_floor_is_the_largest_plane_to_the_last_bit():
    mouse = walk(stage((250.0, 200.0), height_mm=700.0, room=False), N_FRAMES)
    scene, sample = learn_scene(mouse, SPINES, N_FRAMES)
    from liex_lab.scene.background import learn_background

    present = find_floor(learn_background(sample)[0], mouse.camera)
    assert scene.floor.distance_mm == present.distance_mm
    np.testing.assert_array_equal(scene.floor.normal, present.normal)
    assert scene.support_plane is not None
    assert scene.support_plane.region is None
    assert scene.support_plane.support > 0.9


def test_where_nothing_moves_the_walled_ground_is_taken_and_said_to_be_in_doubt():
    from liex_lab.body.skeleton import MOUSE_VIEW
    from liex_lab.scene.background import SampledScene, TargetAnimal
    from liex_lab.scene.support_plane import SupportPlane, find_support_plane

    def stood_on(frames: np.ndarray, still: np.ndarray) -> SupportPlane:
        spread = np.zeros_like(still)
        target = TargetAnimal(SPINES, 7.0, MOUSE_VIEW)
        scene = SampledScene(frames, still, spread, still, mouse.camera, target)
        return find_support_plane(scene)

    mouse = on_a_table()[0]
    still = mouse.stage.scene.still
    empty = np.tile(still, (6, 1, 1))
    found = stood_on(empty, still)
    assert found.floor.distance_mm == pytest.approx(700.0, abs=2.0)
    assert "no object of an animal's size moved" in found.doubt
    assert np.isnan(found.support)
    low = replace(mouse.stage.scene, still=np.where(still > 900.0, np.float32(0), still)).still
    ordinary = stood_on(np.tile(low, (6, 1, 1)), low)
    assert ordinary.region is None  # walls enclose the largest plane itself


def test_a_scene_in_which_nothing_is_flat_is_refused_in_one_sentence():
    rng = np.random.default_rng(0)
    rubble = rng.uniform(400.0, 900.0, (240, 320)).astype(np.float32)
    rough = shown(np.tile(rubble, (4, 1, 1)))
    with pytest.raises(EstimationError, match="no floor was found"):
        learn_scene(rough, SPINES, 4)


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [2027, 2048])
def test_the_back_of_a_mouse_on_unread_floor_is_no_ground(seed: int) -> None:
    """It keeps still but for its head, and all around it the glossy floor is unread."""
    recording = film("glossy", seed, 120, family="train" if seed % 2 == 0 else "other")
    scene, _ = learn_scene(recording, (40.0, 110.0))
    assert scene.support_plane is not None
    assert scene.support_plane.origin == LARGEST
    assert scene.support_plane.floor.distance_mm == pytest.approx(
        recording.floor.distance_mm, abs=5.0
    )
    assert scene.level is None
    assert scene.changed is None
