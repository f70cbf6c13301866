"""What stands still and where the animal hid are drawn in the replay."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from liex_lab.body import Skeleton
from liex_lab.optics.camera import KINECT_V2
from liex_lab.scene.floor import Floor
from liex_lab.scene.scene import Fixture, Scene
from liex_lab.sessions.rrd_scene import (
    FLOOR,
    OVERLAY,
    dot_mm,
    dot_pt,
    log_hidden_places,
    log_surroundings,
)
from liex_lab.tables.rows import Rows
from liex_lab.tracking.offline import track_whole
from tests.tracking.stories import SUBJECT, lose, noisy, told, walk

LEVEL = Floor.from_plane(np.array([0.0, 0.0, 1.0]), 700.0, KINECT_V2)


class Heard:
    """A replay that keeps what is logged."""

    def __init__(self) -> None:
        self.said: dict[str, Any] = {}

    def log(self, entity: str, what: Any, *, static: bool) -> None:
        assert static
        assert entity not in self.said
        self.said[entity] = what


def test_the_region_and_what_stands_in_it_are_drawn() -> None:
    heard = Heard()
    house = Fixture((120.0, -40.0), 62.0, 9000.0)
    region = ((10.0, 20.0), (300.0, 20.0), (300.0, 200.0))
    log_surroundings(heard, Scene(LEVEL, region_px=region, fixtures=(house,)))
    (ring,) = heard.said[f"{OVERLAY}/region"].strips.as_arrow_array().to_pylist()
    np.testing.assert_allclose(ring, np.array([*region, region[0]]) + 0.5)
    things = heard.said[f"{FLOOR}/fixtures"]
    places = things.positions.as_arrow_array().to_pylist()
    np.testing.assert_allclose(places, [[0.12, -0.04, 0.062]], atol=1e-6)
    assert things.labels.as_arrow_array().to_pylist() == ["fixture, 62 mm"]


def test_of_a_whole_picture_with_nothing_in_it_nothing_is_drawn() -> None:
    heard = Heard()
    log_surroundings(heard, Scene(LEVEL))
    assert not heard.said


def test_the_place_where_the_animal_hid_is_drawn_with_since_when() -> None:
    seconds = np.arange(150) / 30.0
    seen = told(seconds, noisy(walk(seconds), np.random.default_rng(3)))
    seen.behind[:] = 0.0
    seen.n_px[55:60] = 500
    seen.behind[55:60] = 0.1
    seen.centroid_mm[:, 0] = [30.0, -20.0, 12.0]
    lose(seen, slice(60, 100))
    track = track_whole(SUBJECT, seen).track
    heard = Heard()
    log_hidden_places(heard, Rows(track, np.arange(150), "session", "mouse"))
    points = heard.said[f"{FLOOR}/hidden"]
    places = points.positions.as_arrow_array().to_pylist()
    np.testing.assert_allclose(places, [[0.03, -0.02, 0.0]], atol=1e-6)
    first = int(np.flatnonzero(track.flag == "hidden")[0])
    (label,) = points.labels.as_arrow_array().to_pylist()
    assert label.startswith(f"hidden {first / 30.0:.1f} to 3.3")


@pytest.mark.parametrize("name", ["mouse", "fish", "hand"])
def test_two_joints_beside_each_other_are_two_dots(name):
    skeleton = Skeleton.load(name)
    bones = np.linalg.norm(skeleton.offsets[1:], axis=1)
    assert 2.0 * dot_mm(skeleton) < np.median(bones)
    assert 1.5 <= dot_pt(skeleton) <= 3.5


def test_a_mouse_is_drawn_thicker_than_a_fish():
    mouse, fish = Skeleton.load("mouse"), Skeleton.load("fish")
    assert dot_mm(mouse) == 3.0
    assert dot_mm(fish) < 1.0
    assert dot_pt(mouse) > 2.0 * dot_pt(fish)
