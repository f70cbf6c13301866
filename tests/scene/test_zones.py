"""Zones that a person has drawn: points are in them or not, and a slip is told in one sentence."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.behaviour.activity import intervals
from liex_lab.errors import PlanError
from liex_lab.optics.camera import Camera
from liex_lab.plan import Plan
from liex_lab.scene.floor import Floor
from liex_lab.scene.scene import Arena
from liex_lab.scene.zones import Zone, joint_of, read_zones, zone_names

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
FLOOR = Floor.from_plane(np.array([0.1, -0.05, 1.0]), 700.0, CAMERA)
ROOM = Arena("rectangular", (40.0, -30.0), None, (200.0, 150.0), 0.3)
corners = st.lists(st.tuples(st.floats(-100, 100), st.floats(-100, 100)), min_size=3, max_size=8)


def zones(folder: Path, text: str, arena: Arena = ROOM) -> tuple[Zone, ...]:
    path = folder / "zones.toml"
    path.write_text(text, encoding="utf-8")
    drawn = read_zones(path)
    return tuple(zone for one in drawn for zone in one.placed(CAMERA, FLOOR, arena))


def test_circles_and_polygons_hold_what_is_in_them(tmp_path: Path) -> None:
    found = zones(
        tmp_path,
        """
        [[zones]]
        name = "centre"
        circle = { centre = [0, 10.0], radius = 50 }
        [[zones]]
        name = "left_half"
        polygon = [[-200, -200], [0, -200], [0, 200], [-200, 200]]
        unit = "mm"
    """,
    )
    points = np.array([[0.0, 59.0], [-10.0, 10.0], [-100.0, 0.0], [30.0, 60.0], [np.nan, np.nan]])
    assert zone_names(found, points) == ["centre", "centre;left_half", "left_half", "", ""]
    assert [zone.to_dict()["name"] for zone in found] == ["centre", "left_half"]


@given(drawn=corners, x=st.floats(-120, 120), y=st.floats(-120, 120))
def test_a_polygon_holds_a_point_round_which_it_winds(
    drawn: list[tuple[float, float]], x: float, y: float
) -> None:
    """An odd number of crossings is an odd winding number, which is told from the angles alone."""
    off = np.array(drawn) - [x, y]
    if np.hypot(*off.T).min() < 1e-6:
        return
    turn = np.angle(
        np.exp(
            1j * np.diff(np.arctan2(off[:, 1], off[:, 0]), append=np.arctan2(off[0, 1], off[0, 0]))
        )
    )
    if np.abs(np.abs(turn) - np.pi).min() < 1e-6:
        return  # on a side
    winding = round(float(turn.sum()) / (2 * np.pi))
    assert Zone("z", polygon_mm=tuple(drawn)).contains([[x, y]])[0] == (winding % 2 == 1)


def test_zones_drawn_in_the_picture_lie_on_the_floor(tmp_path: Path) -> None:
    (square, disc) = zones(
        tmp_path,
        """
        [[zones]]
        name = "square"
        unit = "px"
        polygon = [[100, 60], [220, 60], [220, 180], [100, 180]]
        [[zones]]
        name = "disc"
        unit = "px"
        circle = { centre = [160, 120], radius = 40 }
    """,
    )
    rng = np.random.default_rng(1)
    uv = rng.uniform([0, 0], [319, 239], (500, 2))
    a, b, c = FLOOR.inverse_depth
    on_floor = (
        FLOOR.T_arena_camera @ CAMERA.unproject(uv, 1.0 / (a * uv[:, 0] + b * uv[:, 1] + c))
    )[:, :2]
    in_square = ((uv > [100, 60]) & (uv < [220, 180])).all(axis=1)
    np.testing.assert_array_equal(square.contains(on_floor), in_square)
    off = np.hypot(*(uv - [160, 120]).T)
    clear = np.abs(off - 40) > 0.5
    np.testing.assert_array_equal(disc.contains(on_floor)[clear], (off < 40)[clear])


def test_zones_relative_to_the_centre_turn_with_the_arena(tmp_path: Path) -> None:
    middle, corner = zones(
        tmp_path,
        """
        [[zones]]
        name = "middle"
        relative_to = "centre"
        circle = { centre = [0, 0], radius = 50 }
        [[zones]]
        name = "corner"
        relative_to = "centre"
        polygon = [[150, 100], [200, 100], [200, 150], [150, 150]]
    """,
    )
    assert middle.circle_mm == (40.0, -30.0, 50.0)
    assert corner.polygon_mm is not None
    np.testing.assert_allclose(
        ROOM.wall_distance_mm(np.array(corner.polygon_mm)), [50, 0, 0, 0], atol=1e-9
    )


CIRCLE = "circle = { centre = [0, 0], radius = 4 }"
SLIPS = [
    ("", "zones is missing"),
    ("[[zone]]\nname = 'a'", "zone is an unknown key; the nearest known key is zones"),
    ("zones = 5", "zones should be a valid list, got 5"),
    ("zones = [5]", "zones 1 should be a table"),
    ("[[zones]\n", "should be a TOML file"),
    ("[[zones]]\nname = 'a'", "zones 1 should have either a circle or a polygon"),
    (f"[[zones]]\nnmae = 'a'\n{CIRCLE}", "the nearest known key is name"),
    (f"[[zones]]\nname = 'left half'\n{CIRCLE}", "letters, digits"),
    ("[[zones]]\nname = 'a'\npolygon = [[0, 0], [1, 1]]", "zones 1 polygon List should have at"),
    ("[[zones]]\nname = 'a'\npolygon = [[0, 0], [1, 1], [2, 2]]", "enclose no area"),
    ("[[zones]]\nname = 'a'\npolygon = [[0, 0], [9, 9], [9, 0], [0, 8]]", "sides 1 and 3 cross"),
    (
        "[[zones]]\nname = 'a'\npolygon = [[0, 0], [1, 'x'], [2, 2]]",
        "zones 1 polygon 2 2 should be a valid number, got 'x'",
    ),
    (
        "[[zones]]\nname = 'a'\ncircle = { centre = [0, 0], radius = 0 }",
        "zones 1 circle radius should be greater than 0, got 0",
    ),
    ("[[zones]]\nname = 'a'\ncircle = { centre = [0, inf], radius = 4 }", "a finite number"),
    ("[[zones]]\nname = 'a'\ncircle = [0, 0, 4]", "zones 1 circle should be a table"),
    (f"[[zones]]\nname = 'a'\nunit = 'cm'\n{CIRCLE}", "unit should be 'mm' or 'px'"),
    (f"[[zones]]\nname = 'a'\nunit = 'px'\nrelative_to = 'centre'\n{CIRCLE}", "only with unit"),
    (2 * f"[[zones]]\nname = 'a'\n{CIRCLE}\n", "two zones called 'a'"),
]


@pytest.mark.parametrize(("text", "says"), SLIPS)
def test_a_slip_is_told_in_one_sentence(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(PlanError) as caught:
        zones(tmp_path, text)
    assert says in str(caught.value), caught.value
    assert "zones.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_centre_no_zones_about_it_and_none_above_the_horizon(tmp_path: Path) -> None:
    text = f'[[zones]]\nname = "a"\nrelative_to = "centre"\n{CIRCLE}'
    with pytest.raises(PlanError, match=r"'a' is relative to .* no walls were found"):
        zones(tmp_path, text, Arena("open"))
    text = "[[zones]]\nname = 'a'\nunit = 'px'\ncircle = { centre = [-9e5, 0], radius = 4 }"
    with pytest.raises(PlanError, match="'a' reaches above the horizon"):
        zones(tmp_path, text)


def test_a_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(PlanError, match=r"there is no file .* arena\.zones"):
        read_zones(tmp_path / "none.toml")
    with pytest.raises(PlanError, match="should be a TOML"):
        read_zones(tmp_path)


def test_the_nose_may_be_in_a_zone_that_the_body_is_not_in() -> None:
    at_object = Zone("object", (0.0, 0.0, 20.0), part="nose")
    around = Zone("around", (0.0, 0.0, 60.0))
    body, nose = (
        [[50.0, 0.0], [50.0, 0.0], [5.0, 0.0]],
        [[15.0, 0.0], [np.nan, np.nan], [40.0, 0.0]],
    )
    names = zone_names([at_object, around], body, {"nose": nose})
    assert names == ["object;around", "around", "around"]
    assert Zone.from_dict(at_object.to_dict()) == at_object
    assert "part" not in around.to_dict(), "sessions without parts are as before"


def test_centre_and_periphery_share_the_arena(tmp_path: Path) -> None:
    for arena in (ROOM, Arena("round", (10.0, 20.0), 150.0)):
        centre, periphery = zones(tmp_path, "[[zones]]\nkind = 'centre_periphery'", arena)
        assert (centre.name, periphery.name) == ("centre", "periphery")
        points = np.random.default_rng(0).uniform(-300.0, 300.0, (4000, 2))
        inside = arena.wall_distance_mm(points) > 0.5
        both = np.stack([centre.contains(points), periphery.contains(points)])
        assert (both.sum(axis=0)[inside] == 1).all()
        assert not both[:, arena.wall_distance_mm(points) < -0.5].any()
        assert both[0].sum() / inside.sum() == pytest.approx(0.25, abs=0.04)


def test_corners_are_the_four_squares_of_a_rectangular_arena(tmp_path: Path) -> None:
    corners = zones(tmp_path, "[[zones]]\nkind = 'corners'\nsize = 60")
    assert [zone.name for zone in corners] == [f"corner_{k}" for k in range(1, 5)]
    for zone in corners:
        sides = np.linalg.norm(np.diff(zone.outline_mm(), axis=0), axis=1)
        np.testing.assert_allclose(sides, 60.0)
        assert ROOM.wall_distance_mm(zone.outline_mm()).min() == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(PlanError, match="rectangular arena, but this one is round"):
        zones(tmp_path, "[[zones]]\nkind = 'corners'", Arena("round", (0.0, 0.0), 150.0))


def test_an_object_is_visited_by_the_nose(tmp_path: Path) -> None:
    text = "[[zones]]\nname = 'ball'\nobject = { at = [30, 40], margin = 25 }"
    assert zones(tmp_path, text) == (Zone("ball", (30.0, 40.0, 25.0), part="nose"),)
    assert zones(tmp_path, f"{text}\npart = 'centre'") == (Zone("ball", (30.0, 40.0, 25.0)),)
    with pytest.raises(PlanError, match="has no tail_base or rump among its joints"):
        joint_of("tail_base", ("head", "tail_tip"))


def test_bins_of_one_s_own_length_cover_the_recording() -> None:
    np.testing.assert_allclose(intervals(65.0, 20.0), [0.0, 20.0, 40.0, 60.0, 65.0])
    assert len(intervals(65.0)) == 11
    with pytest.raises(PlanError, match="at least 1 s"):
        Plan().with_settings(["behaviour.bin_s=0.01"])
