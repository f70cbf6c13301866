"""What stands still and where the animal hid are drawn in the replay."""

from typing import Any

import numpy as np

from liex_lab.optics.camera import KINECT_V2
from liex_lab.scene.floor import Floor
from liex_lab.scene.scene import Fixture, Scene
from liex_lab.sessions.rrd_scene import (
    FLOOR,
    OVERLAY,
    log_hidden_places,
    log_surroundings,
)
from liex_lab.tables.rows import Rows
from liex_lab.tracking.curve import track_whole
from tests.tracking.stories import SUBJECT, lose, noisy, told, walk

LEVEL = Floor.from_plane(np.array([0.0, 0.0, 1.0]), 700.0, KINECT_V2)


class Logged:
    """A replay that keeps what is logged."""

    def __init__(self) -> None:
        self.entities: dict[str, Any] = {}

    def log(self, entity: str, what: Any, *, static: bool) -> None:
        assert static
        assert self.entities.setdefault(entity, what) is what


def test_the_region_and_what_stands_in_it_are_drawn() -> None:
    logged = Logged()
    house = Fixture((120.0, -40.0), 62.0, 9000.0)
    region = ((10.0, 20.0), (300.0, 20.0), (300.0, 200.0))
    log_surroundings(logged, Scene(LEVEL, region_px=region, fixtures=(house,)))
    (ring,) = logged.entities[f"{OVERLAY}/region"].strips.as_arrow_array().to_pylist()
    np.testing.assert_allclose(ring, np.array([*region, region[0]]) + 0.5)
    drawn = logged.entities[f"{FLOOR}/fixtures"]
    places = drawn.positions.as_arrow_array().to_pylist()
    np.testing.assert_allclose(places, [[0.12, -0.04, 0.062]], atol=1e-6)
    assert drawn.labels.as_arrow_array().to_pylist() == ["fixture, 62 mm"]
    empty = Logged()
    log_surroundings(empty, Scene(LEVEL))
    assert not empty.entities, "a whole image with an empty floor"


def test_the_place_where_the_animal_hid_is_drawn_with_since_when() -> None:
    seconds = np.arange(150) / 30.0
    seen = told(seconds, noisy(walk(seconds), np.random.default_rng(3)))
    seen.behind[:] = 0.0
    seen.n_px[55:60] = 500
    seen.behind[55:60] = 0.1
    seen.centroid_mm[:, 0] = [30.0, -20.0, 12.0]
    lose(seen, slice(60, 100))
    track = track_whole(SUBJECT, seen).track
    logged = Logged()
    log_hidden_places(logged, Rows(track, np.arange(150), "session", "mouse"))
    points = logged.entities[f"{FLOOR}/hidden"]
    places = points.positions.as_arrow_array().to_pylist()
    np.testing.assert_allclose(places, [[0.03, -0.02, 0.0]], atol=1e-6)
    first = int(np.flatnonzero(track.flag == "hidden")[0])
    (label,) = points.labels.as_arrow_array().to_pylist()
    assert label.startswith(f"hidden {first / 30.0:.1f} to 3.3")
