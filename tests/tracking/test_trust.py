"""Trust is earned against the picture: poses that it contradicts are not trusted, and while an
animal is in view no pose is made up elsewhere.
"""

from dataclasses import replace

import numpy as np
import pytest

from liex_lab.tracking.curve import track_whole
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.trust import (
    contradicted,
    elsewhere,
    head_tail_weight,
    lies_unknown,
    share_in_view,
    usual_pixels,
)
from tests.tracking.stories import MOUSE, SUBJECT, joint_error, lose, noisy, told, walk

SECONDS = np.arange(120) / 30.0
FIRST = np.zeros(120, np.int64)


@pytest.fixture
def seen() -> Observations:
    """Frames of a walking mouse whose body fits the picture."""
    seen = told(SECONDS, noisy(walk(SECONDS), np.random.default_rng(3)))
    seen.residual_mm[:] = 1.5
    seen.covered[:] = 0.8
    seen.beside[:] = 0.05
    return seen


def test_poses_that_fit_the_picture_are_trusted(seen: Observations) -> None:
    assert not contradicted(seen, FIRST, MOUSE.length).any()
    assert (track_whole(SUBJECT, seen).track.flag == "").all()


@pytest.mark.parametrize(
    ("column", "value"),
    [("residual_mm", 12.0), ("covered", 0.2), ("beside", 0.8), ("part_mm", 14.0)],
)
def test_a_frame_that_the_picture_contradicts_is_doubtful(
    seen: Observations, column: str, value: float
) -> None:
    """Whichever of the four says so, and only in the frames in which it does."""
    getattr(seen, column)[50:53] = value
    assert np.flatnonzero(contradicted(seen, FIRST, MOUSE.length)).tolist() == [50, 51, 52]
    track = track_whole(SUBJECT, seen).track
    assert not (track.flag[50:53] == "").any()
    assert (np.delete(track.flag, range(45, 58)) == "").all()


def test_a_noisy_session_has_larger_residuals_and_a_quiet_one_smaller(seen: Observations) -> None:
    """A residual is held against what is usual in the session, but never beyond an eighth of the
    length.
    """
    seen.residual_mm[60] = 5.0
    assert contradicted(seen, FIRST, MOUSE.length)[60] == (max(6.0, 0.04 * MOUSE.length) < 5.0)
    seen.residual_mm[:] = 1.0
    seen.residual_mm[60] = 5.0
    assert contradicted(seen, FIRST, MOUSE.length)[60]
    seen.residual_mm[:] = 20.0
    assert contradicted(seen, FIRST, MOUSE.length).all()


def test_what_nobody_compared_contradicts_nothing(seen: Observations) -> None:
    """Sessions of earlier versions do not hold how the outlines lie over each other."""
    for column in (seen.residual_mm, seen.covered, seen.beside, seen.part_mm):
        column[:] = np.nan
    assert not contradicted(seen, FIRST, MOUSE.length).any()


def test_a_pose_either_way_round_is_where_the_animal_is(seen: Observations) -> None:
    error = np.full(120, 2.0)
    for h in (0, 1):
        joints = seen.pose(np.full(120, h)).joints(MOUSE)
        assert not elsewhere(seen, joints, error, MOUSE.length, 800).any()
    across = seen.pose(FIRST).joints(MOUSE)
    middle = across.mean(axis=1, keepdims=True)
    across = middle + (across - middle) @ np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    assert elsewhere(seen, across, error, MOUSE.length, 800).mean() > 0.9


def test_of_an_animal_that_is_hardly_seen_nothing_is_said(seen: Observations) -> None:
    far = seen.pose(FIRST).joints(MOUSE) + 200.0
    assert elsewhere(seen, far, np.full(120, 2.0), MOUSE.length, 800).all()
    seen.n_px[:] = 200
    assert not elsewhere(seen, far, np.full(120, 2.0), MOUSE.length, 800).any()


def test_a_gap_is_not_bridged_elsewhere_while_the_animal_is_in_view(seen: Observations) -> None:
    """The frames say that it lies across for a moment; a bridge over them may not say otherwise."""
    truth = walk(SECONDS)
    turned = truth.root.rotation[60:66] @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    truth.root.rotation[60:66] = turned
    truth.root.translation[60:66] += [70.0, 0.0, 0.0]
    other = told(SECONDS, truth)
    for name in ("turn", "place", "angles", "scale"):
        getattr(seen, name)[60:66] = getattr(other, name)[60:66]
    track = track_whole(SUBJECT, seen).track
    posed = np.flatnonzero(track.posed[60:66]) + 60
    fits = joint_error(track.joints_mm, truth) < 0.25 * MOUSE.length
    assert fits[posed].all() or (track.flag[posed] != "").all()
    assert track.posed[:55].all()


def test_a_gap_in_which_nothing_is_seen_is_bridged_as_ever(seen: Observations) -> None:
    lose(seen, slice(60, 66))
    seen.n_px[60:66] = 0
    assert track_whole(SUBJECT, seen).track.bridged[60:66].all()


def test_an_error_of_a_quarter_of_the_length_is_not_trusted_whatever_the_plan_says(
    seen: Observations,
) -> None:
    seen.error_mm[:] = 0.5 * MOUSE.length
    lenient = replace(SUBJECT, doubtful_mm=1000.0)
    assert (track_whole(lenient, seen).track.flag == "doubtful").mean() > 0.5


def test_what_an_animal_usually_shows_is_told_by_frames_with_nothing_before_it(
    seen: Observations,
) -> None:
    """Though most of a recording shows half of it beside a bar."""
    seen.behind[:] = 0.0
    seen.n_px[40:, :2] = 400
    seen.behind[40:, :2] = 0.2
    assert usual_pixels(seen, FIRST) == 800
    assert share_in_view(seen, FIRST, usual_pixels(seen, FIRST))[80] == 0.5
    seen.behind[5:, :2] = 0.2  # too few are left to tell
    assert usual_pixels(seen, FIRST) == 400


def test_the_ends_of_an_animal_beside_a_bar_are_told_by_the_frames_around(
    seen: Observations,
) -> None:
    """The metric takes one end for the other in every frame that shows two thirds of it; it counts
    for nothing there, so the track goes on as it came, and without the bar it would turn round.
    """
    seen.behind[:] = 0.0
    behind = slice(50, 80)
    seen.n_px[behind, :2] = 580
    seen.score[behind, 0], seen.score[behind, 1] = 12.0, 2.0
    truth = walk(SECONDS)
    turned = track_whole(SUBJECT, seen).track
    seen.behind[behind, :2] = 0.2
    ends = head_tail_weight(seen)
    assert np.all(ends[behind, :2] < 0.05)
    assert np.all(ends[:45] == 1.0)
    track = track_whole(SUBJECT, seen).track
    assert np.isfinite(track.joints_mm[behind]).all()
    assert joint_error(track.joints_mm, truth)[behind].max() < 6.0
    assert np.nanmax(joint_error(turned.joints_mm, truth)[behind]) > 20.0
    assert not (track.flag[behind] == "").any()


def test_half_an_animal_whose_ends_are_unknown_has_no_pose() -> None:
    share = np.array([1.0, 1.0, 0.8, 0.8, 0.6])
    doubt = np.array([0.0, 0.5, 0.1, 0.5, 0.0])
    assert lies_unknown(share, doubt).tolist() == [False, False, False, True, True]


def test_a_long_gap_beside_a_bar_is_not_bridged_from_its_ends(seen: Observations) -> None:
    """A second in which half of it is in view: hidden throughout; a gap of 0.3 s is bridged."""
    seen.behind[:] = 0.0
    for rows, hidden in ((slice(40, 70), True), (slice(90, 99), False)):
        seen.n_px[rows, :2] = 400
        seen.behind[rows, :2] = 0.2
        flags = track_whole(SUBJECT, seen).track.flag[rows]
        assert (flags == "hidden").all() == hidden
        assert (flags == "hidden").any() == hidden
