"""A track: one row for every frame, measured or not, and parts that join into the whole."""

from dataclasses import fields

import numpy as np
import pytest

from liex_lab.body.skeleton import Skeleton
from liex_lab.tracking.track import Track
from tests.sessions.walking_mouse import SPINE_MM, WalkingMouse, steady

COLUMNS = [field.name for field in fields(Track) if field.name != "skeleton"]


@pytest.mark.parametrize("animal", ["mouse", "fish", "hand"])
def test_an_empty_track_has_a_row_for_every_frame_and_nothing_in_it(animal):
    skeleton = Skeleton.load(animal)
    times = np.array([0, 40, 73, 200], np.int64)
    track = Track.empty(skeleton, times)
    assert track.n_frames == 4
    assert track.joints_mm.shape == (4, skeleton.n_joints, 3)
    assert not track.observed.any()
    assert set(track.flag) == {"not_found"}
    np.testing.assert_array_equal(track.times_ns, times)
    for name in COLUMNS:
        values = getattr(track, name)
        assert len(values) == 4
        if values.dtype == np.float64:
            assert np.isnan(values).all(), name
    assert np.isnan(track.spine_mm).all()


@pytest.mark.parametrize("stops", [(30,), (1, 30), (7, 8, 21, 30)])
def test_parts_of_a_track_join_into_the_whole(stops):
    mouse = WalkingMouse(steady(1.0), lost=(3, 4, 20))
    whole = mouse.track()
    parts = [whole[start:stop] for start, stop in zip((0, *stops), stops, strict=False)]
    joined = Track.join(parts)
    assert joined.skeleton is whole.skeleton
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name), err_msg=name)


def test_a_track_knows_which_frames_were_measured_its_root_and_its_spine():
    mouse = WalkingMouse(steady(0.5), lost=(2, 9))
    track = mouse.track()
    assert np.flatnonzero(~track.observed).tolist() == [2, 9]
    np.testing.assert_allclose(track.spine_mm[track.observed], SPINE_MM)
    np.testing.assert_allclose(
        (track.root @ np.zeros(3))[track.observed], track.joints_mm[track.observed, 0]
    )
    length = np.linalg.norm(np.diff(track.joints_mm, axis=1), axis=-1).sum(axis=1)
    np.testing.assert_allclose(length, track.spine_mm)
