"""Worlds: each animal's data through one interface; an animal of the user's own lies, hangs and
moves as it can.
"""

import numpy as np
import pytest

from liex_lab.body.shape import Surface
from liex_lab.body.skeleton import Skeleton
from liex_lab.catalog import find_sample
from liex_lab.runtime.processes import threads
from liex_lab.scene.learning import learn_scene
from liex_lab.simulation import training_patches
from liex_lab.simulation.simulator import world_of
from liex_lab.simulation.species import GenericSpecies

SNAKE = Skeleton.load(find_sample("snake.toml"))
# a spider's legs end in the air or on the floor; its joints turn about all axes
STAR = Skeleton.from_table(
    {
        "name": "star",
        "joints": [{"name": "middle"}]
        + [
            joint
            for k in range(4)
            for joint in (
                {
                    "name": f"knee_{k}",
                    "parent": "middle",
                    "rest_deg": [0, 0, 90 * k],
                    "axes": ["pitch", "yaw"],
                },
                {
                    "name": f"shin_{k}",
                    "parent": f"knee_{k}",
                    "offset_mm": [40, 0, 0],
                    "axes": ["pitch"],
                    "limits_deg": {"pitch": [0, 80]},
                },
                {"name": f"foot_{k}", "parent": f"shin_{k}", "offset_mm": [40, 0, 0]},
            )
        ],
        "surface": {"radii_mm": [9.0] + [6.0, 5.0, 4.0] * 4},
    },
    "star.toml",
)


@pytest.mark.parametrize("animal", ["fish", "snake"])
def test_a_block_depends_on_its_seed_and_number_alone(animal):
    world = world_of(SNAKE if animal == "snake" else Skeleton.load(animal))
    both = list(world.training_blocks(5, 2, window_px=200))
    with threads(False):
        (second,) = world.training_blocks(5, 1, first=1, window_px=200)
    np.testing.assert_array_equal(both[1].depth, second.depth)
    np.testing.assert_array_equal(both[1].joints_mm, second.joints_mm)
    assert (both[0].depth != both[1].depth).any()


@pytest.mark.parametrize("skeleton", [SNAKE, STAR], ids=["snake", "star"])
def test_an_unknown_animal_rests_on_the_floor_within_its_joints_limits(skeleton):
    rng, species = np.random.default_rng(8), GenericSpecies.of(skeleton)
    n = 200
    shape = species.shapes(rng, "augmented", n)
    pose, girth = species.postures(rng, rng.uniform(0.7, 1.4, n), shape, np.full(n, 700.0))
    low = Surface.of(skeleton).vertices(pose, shape, girth)[..., 2].min(axis=1)
    assert (low >= -1e-9).all()
    assert (low <= 2.0 * species.setting.scale + 1e-9).all()
    angles = pose.angles[:, 1:]
    assert (angles[:, ~skeleton.axes[1:]] == 0).all()
    assert (angles >= skeleton.limits[1:, :, 0] - 1e-12).all()
    assert (angles <= skeleton.limits[1:, :, 1] + 1e-12).all()
    heading = np.arctan2(pose.root.rotation[:, 1, 0], pose.root.rotation[:, 0, 0])
    assert np.histogram(heading, 4, (-np.pi, np.pi))[0].min() > 25


def test_an_animal_of_the_camera_view_hangs_above_the_floor():
    table = {**SNAKE.table, "view": {"frame": "camera"}}
    species = GenericSpecies.of(Skeleton.from_table(table, "eel.toml"))
    rng = np.random.default_rng(10)
    shape = species.shapes(rng, "train", 100)
    pose, girth = species.postures(rng, np.ones(100), shape, np.full(100, 900.0))
    z = Surface.of(species.skeleton).vertices(pose, shape, girth)[..., 2]
    assert z.min() > 0.0
    assert z.max() < 900.0 * 0.6
    assert z.min(axis=1).std() > 50.0


def test_a_window_holds_the_animal_wherever_it_is(monkeypatch):
    monkeypatch.setattr(training_patches, "BLOCK", 32)
    for skeleton in (SNAKE, STAR):
        world = world_of(skeleton)
        assert isinstance(world, GenericSpecies)
        (block,) = world.training_blocks(11, 1, window_px=world.window_px(skeleton.length))
        uv = block.joints_mm[..., :2] / block.joints_mm[..., 2:] * block.intrinsics[:, None, :2]
        uv = uv + block.intrinsics[:, None, 2:] - block.origin[:, None]
        assert (uv > 0).all()
        assert (uv < block.depth.shape[1]).all()


def test_an_unknown_animal_moves_smoothly_over_the_floor():
    recording = GenericSpecies.of(SNAKE).motion(12, 120)
    step = np.linalg.norm(np.diff(recording.joints_arena, axis=0), axis=-1)
    assert step.max() < 0.15 * recording.spine_mm
    assert step.mean() > 0.1
    assert recording.joints_arena[..., 2].min() > 0.0


@pytest.mark.nightly
@pytest.mark.parametrize("animal", ["fish", "snake"])
def test_the_scene_of_a_rendered_recording_is_learned_and_the_animal_found_in_it(animal):
    species = world_of(SNAKE if animal == "snake" else Skeleton.load(animal))
    skeleton = species.skeleton
    recording = species.film([13, 2], 20)
    spans = (0.6 * skeleton.length, 1.5 * skeleton.length)
    scene, sample = learn_scene(recording, spans, 20, skeleton.view.min_height_mm, skeleton.view)
    assert scene.stride == (2 if animal == "fish" else 1)
    crops = scene.extract(sample, recording.spine_mm / skeleton.length, camera_view=species.floats)
    assert crops.found.mean() > 0.9
    middle = scene.camera.project(recording.joints_camera.mean(axis=1))
    half = 48 * crops.step[:, None]
    assert (np.abs(crops.origin + half - middle)[crops.found] < 0.5 * half[crops.found]).all()
    whole = scene.extract(
        recording.depths(0, 4), recording.spine_mm / skeleton.length, camera_view=species.floats
    )
    np.testing.assert_array_equal(whole.heights, crops.heights[:4])
    np.testing.assert_array_equal(whole.origin, crops.origin[:4])
