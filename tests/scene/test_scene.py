"""The scene as a noun: stated in a plan or found, written down, and refused in one sentence."""

import json

import numpy as np
import pytest
from liex_lab.pipelines.build import build_scene
from typer.testing import CliRunner

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import EstimationError, PlanError
from liex_lab.plan import Plan
from liex_lab.scene.background_segmenter import BackgroundSubtraction
from liex_lab.scene.scene import find_fixtures, plane_of
from tests.scene.staged import CAMERA, on_a_table, shown

N_FRAMES = 24


def seen(*settings: str) -> BackgroundSubtraction:
    plan = Plan.load("mouse").with_settings(settings)
    scene, _ = build_scene(shown(on_a_table(N_FRAMES)[1]), plan, Skeleton.load("mouse"), N_FRAMES)
    assert isinstance(scene, BackgroundSubtraction)
    return scene


def test_a_scene_says_where_its_floor_comes_from_and_what_stands_and_moves_on_it():
    found = seen().described()
    assert found.floor_from == "where animals stand"
    assert found.floor_support is not None
    assert found.floor_support > 0.9
    assert found.n_animals == 1
    assert found.roughness_mm is not None
    assert found.roughness_mm < 3.0
    assert len(found.region_px) >= 4
    document = json.loads(json.dumps(found.to_dict()))
    assert document["floor"]["distance_mm"] == pytest.approx(700.0, abs=3.0)
    assert document["doubts"] == []


def test_a_floor_that_is_stated_is_taken_as_it_is():
    found = seen("arena.floor={point = [0, 0, 701.5], normal = [0, 0, -1]}").described()
    assert found.floor_from == "plan"
    assert found.floor.distance_mm == 701.5


def test_outside_a_region_that_is_stated_nothing_is_looked_at():
    scene = seen("arena.region=[[60, 20], [250, 20], [250, 220], [60, 220]]")
    assert not scene.limit[:20].any()
    assert not scene.limit[:, 251:].any()
    assert scene.limit[100, 100] > 0
    assert scene.floor.distance_mm == pytest.approx(700.0, abs=3.0)


def test_a_floor_that_nothing_stands_on_is_refused():
    with pytest.raises(EstimationError, match="nothing stands on the floor"):
        seen("arena.floor={point = [0, 0, 1180], normal = [0, 0, 1]}")


@pytest.mark.parametrize("normal", [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
def test_a_plane_that_does_not_face_the_camera_is_no_floor(normal):
    with pytest.raises(PlanError, match="a plane in front of the camera that faces it"):
        plane_of([0.0, 0.0, 700.0], normal, CAMERA)


@pytest.mark.parametrize(
    ("words", "setting"),
    [
        ("1,2 30,2 30,40", "arena.region=[[1.0, 2.0], [30.0, 2.0], [30.0, 40.0]]"),
        ("circle 0,-5 140 mm", "arena.region.circle={centre=[0.0, -5.0], radius=140.0}"),
        ("circle 160,120 90", "arena.region.circle={centre=[160.0, 120.0], radius=90.0}"),
        ("-90,-90 90,-90 0,90 mm", "arena.region.polygon=[[-90.0,-90.0],[90.0,-90.0],[0.0,90.0]]"),
    ],
)
def test_a_region_on_the_command_line_is_what_a_plan_states(words, setting):
    from liex_lab.cli.options import region_setting

    unit = ["arena.region.unit=mm"] if words.endswith("mm") else []
    (told,) = region_setting(words)
    assert Plan().with_settings([told]) == Plan().with_settings([setting, *unit])


@pytest.mark.parametrize("words", ["circle 160,120", "circle 1 2 3", "circle a,b 9", "mm", ""])
def test_a_region_on_the_command_line_that_is_none_is_told_how_to_write_one(words):
    from liex_lab.cli.options import region_setting

    with pytest.raises(PlanError, match=r"'circle 160,120 90'; add mm at the end"):
        region_setting(words)


def test_the_doctor_looks_within_a_circle_of_millimetres_and_says_where_it_is_none():
    from liex_lab.cli.main import app

    walk = "synthetic:walk?frames=30&seed=3&sensor=primesense-qvga"
    inside = CliRunner().invoke(app, ["doctor", walk, "--region", "circle 0,0 150 mm"])
    assert inside.exit_code == 0, inside.output
    outside = CliRunner().invoke(app, ["doctor", walk, "--region", "circle 9000,0 150 mm"])
    told = " ".join(f"{outside.output}{outside.exception}".split())
    assert "arena.region lies outside the image" in told


def test_rough_ground_is_told_by_its_spread():
    from liex_lab.scene.scene import roughness

    rng = np.random.default_rng(0)
    bare = np.full((80, 80), 700.0, np.float32)
    bedding = (bare - rng.normal(9.0, 6.0, bare.shape)).astype(np.float32)
    assert roughness(bedding, bare, np.ones(bare.shape, bool)) == pytest.approx(6.0, rel=0.1)
    assert roughness(np.zeros_like(bare), bare, np.ones(bare.shape, bool)) is None


def test_the_walls_of_an_arena_are_no_fixture_and_a_thing_in_it_is_one():
    floor = plane_of([0, 0, 700], [0, 0, 1], CAMERA)
    depth = floor.depth(CAMERA.width, CAMERA.height)
    wall = np.zeros(depth.shape, bool)
    wall[30:210, 60:260] = True
    wall[40:200, 70:250] = False
    depth[wall] -= 80.0
    depth[80:100, 120:150] -= 55.0
    (thing,) = find_fixtures(depth, floor, CAMERA, np.ones(depth.shape, bool))
    assert thing.height_mm == pytest.approx(55.0, abs=0.5)
