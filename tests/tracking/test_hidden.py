"""Hidden is a state: an animal that goes behind something is told from one that was not found."""

import numpy as np
import pytest

from liex_lab.scene.height_maps import CROP, HeightMaps
from liex_lab.tables.rows import Rows
from liex_lab.tracking.curve import OnlineTracker, track_whole
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.residual import behind_something
from liex_lab.tracking.track import Track
from tests.tracking.stories import SUBJECT, lose, noisy, told, walk

SECONDS = np.arange(150) / 30.0
GONE = slice(60, 100)


@pytest.fixture
def seen() -> Observations:
    """A mouse that walks, of which less and less is seen from frame 52 on, and nothing from 60."""
    seen = told(SECONDS, noisy(walk(SECONDS), np.random.default_rng(3)))
    seen.behind[:] = 0.0
    for k, frame in enumerate(range(52, 60)):
        seen.n_px[frame] = seen.n_px[frame] * (0.9 - 0.1 * k)
        seen.behind[frame] = 0.1
    lose(seen, GONE)
    return seen


def live_track(seen: Observations, lag: int) -> Track:
    """What a tracker that sees no more than `lag` frames ahead says of each frame."""
    online = OnlineTracker(SUBJECT, lag)
    parts = [*(online.add(seen[k : k + 1]) for k in range(len(seen))), online.close()]
    return Track.join([part for part in parts if part is not None])


def test_a_mouse_that_goes_under_a_roof_is_hidden_until_it_comes_back(seen: Observations) -> None:
    """Of a mouse that is mostly behind something there is no trusted pose."""
    track = track_whole(SUBJECT, seen).track
    assert (track.flag[GONE] == "hidden").all()
    assert np.isnan(track.joints_mm[GONE]).all()
    assert (track.flag[:50] == "").all()
    assert (track.flag[52:55] == "doubtful").all()
    assert (track.flag[56:60] == "hidden").all()
    assert (track.flag[105:] == "").all()


def test_a_mouse_that_is_lost_in_the_open_is_not_found(seen: Observations) -> None:
    seen.behind[:] = 0.0
    for track in (track_whole(SUBJECT, seen).track, live_track(seen[52:70], 0)):
        rows = np.flatnonzero(np.isin(track.times_ns, seen.times_ns[GONE]))
        assert not (track.flag == "hidden").any()
        assert (track.flag[rows] == "not_found").all()


def test_observations_that_do_not_know_what_is_before_the_animal_are_as_before(
    seen: Observations,
) -> None:
    before = track_whole(SUBJECT, seen).track
    seen.behind[:] = np.nan
    now = track_whole(SUBJECT, seen).track
    assert not (now.flag == "hidden").any()
    assert now.posed.sum() > before.posed.sum()


def test_the_gap_says_where_the_animal_was_last_seen_and_since_when(seen: Observations) -> None:
    track = track_whole(SUBJECT, seen).track
    rows = Rows(track, np.arange(150), "session", "mouse")
    gaps = rows.gaps()
    at = list(gaps["reason"]).index("hidden")
    first = int(gaps["start_frame"][at])
    assert 52 <= first <= 60
    assert gaps["start_s"][at] == pytest.approx(first / 30.0)
    place = [gaps["x_mm"][at], gaps["y_mm"][at]]
    np.testing.assert_allclose(place, track.centroid_mm[first - 1, :2])


@pytest.mark.parametrize(("away_mm", "hides"), [(20.0, False), (200.0, True)])
def test_a_place_under_another_animal_is_no_hiding_place(
    seen: Observations, away_mm: float, hides: bool
) -> None:
    track = track_whole(SUBJECT, seen).track
    track.centroid_mm[:] = 0.0
    other = np.tile([away_mm, 0.0, 0.0], (150, 1))
    gaps = Rows(track, np.arange(150), "session", "mouse", others=[other]).gaps()
    assert np.isfinite(gaps["x_mm"][list(gaps["reason"]).index("hidden")]) == hides


@pytest.mark.parametrize("lag", [pytest.param(0, marks=pytest.mark.nightly), 6])
def test_the_live_track_says_hidden_as_the_whole_recording_does(
    seen: Observations, lag: int
) -> None:
    live = live_track(seen, lag)
    assert (live.flag[GONE] == "hidden").all()
    assert np.isnan(live.joints_mm[GONE]).all()
    assert np.isnan(live.uv_px[GONE]).all()
    assert not live.bridged[GONE].any()
    assert (live.flag[56:60] == "hidden").all()
    assert not (live.flag[:52] == "hidden").any()
    assert not (live.flag[105:] == "hidden").any()
    assert np.isfinite(live.joints_mm[105:]).all()


def test_a_mouse_that_stays_under_a_roof_for_longer_than_the_live_window_stays_hidden() -> None:
    seconds = np.arange(110) / 30.0
    seen = told(seconds, noisy(walk(seconds), np.random.default_rng(3)))
    seen.behind[:] = 0.0
    seen.n_px[15:20] = 500
    seen.behind[15:20] = 0.1
    lose(seen, slice(20, 100))
    live = live_track(seen, 0)
    assert (live.flag[20:100] == "hidden").all()
    assert (live.flag[102:] != "hidden").all()


def roofed(roof_mm: float) -> np.ndarray:
    """The share of a block's outline behind a roof over half of it, so far above the block."""
    crops = HeightMaps.blank(1, 700.0)
    crops.heights[0, 20:40, 20:40] = 16 * 25
    crops.n_px[:] = 400
    depth = np.full((1, CROP, CROP), 700.0, np.float32)
    depth[0, 20:40, 20:40] = 675.0
    depth[0, 10:60, 40:70] = 675.0 - roof_mm
    return behind_something(crops, depth)


def test_an_outline_under_a_roof_ends_there_and_beside_a_low_step_it_does_not() -> None:
    assert roofed(60.0) == pytest.approx(0.25)
    assert roofed(10.0) == 0.0


def test_an_animal_that_rears_stands_before_nothing_of_itself() -> None:
    crops = HeightMaps.blank(1, 700.0)
    crops.heights[0, 20:40, 20:40] = 16 * 15  # the feet
    crops.heights[0, 25:35, 25:35] = 16 * 90  # the head above them
    depth = np.full((1, CROP, CROP), 700.0, np.float32)
    depth -= crops.heights / 16.0
    crops.heights[0, 23:25, 23:37] = depth[0, 23:25, 23:37] = 0  # the steep flank is unread
    assert behind_something(crops, depth) == 0.0
    depth[0, 40:60, 15:45] = 600.0  # what is another's is before it as ever
    assert behind_something(crops, depth)[0] > 0.15


def test_an_outline_that_leaves_the_picture_goes_on_outside() -> None:
    crops = HeightMaps.blank(1, 700.0)
    crops.heights[0, 1:21, 30:50] = 16 * 25
    crops.n_px[:] = 400
    depth = np.full((1, CROP, CROP), 700.0, np.float32)
    depth[0, 1:21, 30:50] = 675.0
    assert behind_something(crops, depth) == pytest.approx(0.25)
