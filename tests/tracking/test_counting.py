"""How many animals are in view, from what stands free, moves and is of an animal's size."""

import numpy as np
import pytest

from liex_lab.tracking.counting import count_animals
from liex_lab.tracking.curve import track_whole
from liex_lab.tracking.observations import Observations
from tests.tracking.stories import SUBJECT, told, walk

SECONDS = np.arange(240) / 30.0
WALK = walk(SECONDS)
Thing = tuple[np.ndarray, float, float]
HEIGHT_MM, AREA_MM2 = 18.0, 2000.0
TOUCH = slice(100, 130)


def scene(**others: Thing) -> Observations:
    """A walking mouse and other objects: position (n, 2) mm, NaN if absent, height and area."""
    seen = told(SECONDS, WALK)
    own = WALK.root.translation[:, :2]
    for k, (xy, height, area) in enumerate([(own, HEIGHT_MM, AREA_MM2), *others.values()]):
        known = np.isfinite(xy[:, 0])
        seen.objects[known, k] = np.column_stack(
            [xy[known], np.full(known.sum(), height), np.full(known.sum(), area)]
        )
    return seen


def beside(area: float = AREA_MM2, height: float = HEIGHT_MM) -> Thing:
    """One that walks on the other side of the circle."""
    return -WALK.root.translation[:, :2].copy(), height, area


def here_until(rows: slice, thing: Thing) -> Thing:
    away = np.ones(len(SECONDS), bool)
    away[rows] = False
    thing[0][away] = np.nan
    return thing


@pytest.mark.parametrize("area", [0.4 * AREA_MM2, AREA_MM2, 3.0 * AREA_MM2])
def test_a_second_animal_counts_whatever_its_build(area: float) -> None:
    count = count_animals(scene(second=beside(area)))
    assert (count.n_animals, count.share) == (2, 1.0)
    assert (count.in_view == 2).all()


def test_what_is_low_or_at_rest_or_there_for_a_moment_is_no_animal() -> None:
    still = np.tile([200.0, 0.0], (len(SECONDS), 1))
    for thing in (
        beside(height=5.0),
        beside(height=80.0),
        (still, HEIGHT_MM, AREA_MM2),
        here_until(slice(50, 60), beside()),
    ):
        count = count_animals(scene(thing=thing))
        assert (count.n_animals, count.share) == (1, 1.0)


def test_one_that_comes_later_counts_from_then_on() -> None:
    count = count_animals(scene(second=here_until(slice(90, None), beside())))
    assert count.n_animals == 2
    assert (count.in_view == np.where(np.arange(len(SECONDS)) < 90, 1, 2)).all()
    assert count.share == pytest.approx(150 / 240)


def test_two_that_touch_are_two_by_their_area_or_because_none_left() -> None:
    apart = 150.0 - np.abs(np.arange(len(SECONDS)) - 114.5)[:, None] * [0.0, 1.0]
    for area in (2.0 * AREA_MM2, 1.2 * AREA_MM2):
        seen = scene(second=(WALK.root.translation[:, :2] + 190.0 - apart, HEIGHT_MM, AREA_MM2))
        seen.objects[TOUCH, 1] = np.nan
        seen.objects[TOUCH, 0, 3] = area
        assert (count_animals(seen).in_view == 2).all()


def test_one_that_pauses_beside_the_other_counts_while_it_rests() -> None:
    xy = beside()[0]
    xy[80:160] = xy[80]
    xy[160:] += xy[80] - xy[160]
    xy[100] = np.nan  # not found in a frame
    count = count_animals(scene(second=(xy, HEIGHT_MM, AREA_MM2)))
    assert (count.in_view == 2).all()


def test_no_pose_is_trusted_while_another_animal_is_in_view() -> None:
    """It may be either of them."""
    later = here_until(slice(120, None), beside())
    tracked = track_whole(SUBJECT, scene(second=later))
    assert (tracked.n_animals, tracked.n_animals_share) == (2, 0.5)
    assert (tracked.track.flag == np.where(np.arange(240) < 120, "", "doubtful")).all()
    assert (tracked.track.n_animals == np.where(np.arange(240) < 120, 1, 2)).all()


def test_a_hidden_one_of_two_that_are_measured_does_not_change_how_many_are_counted() -> None:
    seen = scene(second=beside())
    seen.score[TOUCH] = np.nan
    assert (count_animals(seen, 2).in_view == 2).all()
    assert (count_animals(seen).in_view[TOUCH] == 0).all()
