"""Each of several animals keeps its name; where that is unclear, its exchange has a probability."""

from dataclasses import replace

import numpy as np
import pytest

from liex_lab.tracking.curve import track_whole
from liex_lab.tracking.identity import (
    CERTAIN,
    UNCLEAR,
    OnlineIdentity,
    _passed,
    covers,
    doubt,
    flag_unclear,
    identify,
    own_observations,
)
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.track import Crossing
from tests.tracking.stories import SUBJECT, joint_error, lose, told, walk

SECONDS = np.arange(90) / 30.0
WALKS = [walk(SECONDS), walk(SECONDS + 2.6), walk(SECONDS + 1.3)]
LOST = slice(40, 55)
POSE = ("turn", "place", "angles", "scale", "error_mm", "score", "n_px", "centroid_mm")


def mixed(n_animals: int, order: np.ndarray) -> Observations:
    """Frames of animals whose components come in another order each time: slot s shows animal
    order[t, s].
    """
    alone = [told(SECONDS, one) for one in WALKS[:n_animals]]
    seen = Observations.empty(SUBJECT.skeleton, alone[0].times_ns, n_animals)
    for k, one in enumerate(alone):
        one.centroid_mm[:, :2] = WALKS[k].root.translation[:, None]
        seen.objects[:, k, :3] = WALKS[k].root.translation
        seen.objects[:, k, 3] = 2000.0
        for s in range(n_animals):
            rows = np.flatnonzero(order[:, s] == k)
            for name in POSE:
                getattr(seen, name)[rows, 2 * s : 2 * s + 2] = getattr(one, name)[rows, :2]
    return seen


def shuffled(n_animals: int) -> np.ndarray:
    rng = np.random.default_rng(5)
    return np.array([rng.permutation(n_animals) for _ in SECONDS])


def named(order: np.ndarray, slots: np.ndarray) -> np.ndarray:
    """Which animal each track shows in each frame."""
    return np.take_along_axis(order, slots, axis=1)


@pytest.mark.parametrize("n_animals", [2, 3])
def test_each_animal_keeps_its_name_in_whatever_order_components_come(n_animals: int) -> None:
    order = shuffled(n_animals)
    seen = mixed(n_animals, order)
    found = identify([seen] * n_animals, [SUBJECT] * n_animals)
    names = named(order, found.slots)
    assert (names == names[0]).all()
    assert all(one.p_swap < 0.01 for one in found.crossings)
    track = track_whole(SUBJECT, own_observations(seen, found.slots[:, 0])).track
    assert joint_error(track.joints_mm, WALKS[names[0, 0]]).max() < 3.0


def test_a_frame_that_shows_one_of_two_belongs_to_the_one_that_is_near() -> None:
    order = shuffled(2)
    seen = mixed(2, order)
    for name in POSE[:-2]:
        getattr(seen, name)[40, 2:] = np.nan
    slots = identify([seen] * 2, [SUBJECT] * 2).slots
    assert sorted(slots[40]) == [-1, 0]
    near = int(np.flatnonzero(slots[40] == 0)[0])
    assert order[40, 0] == order[39, slots[39, near]]


def test_the_body_that_fits_decides_whose_component_it_is() -> None:
    order = shuffled(2)
    every = [mixed(2, order) for _ in range(2)]
    for k, seen in enumerate(every):  # the first body is that of the second animal
        seen.residual_mm[:] = np.repeat(np.where(order == 1 - k, 1.0, 3.0), 2, axis=1)
        lose(seen, LOST)
        for name in (*POSE[:-2], "residual_mm"):
            getattr(seen, name)[60, 2:] = np.nan
        seen.centroid_mm[60, :2] = seen.centroid_mm[[59, 61]].mean(axis=(0, 1))  # between both
    slots = identify(every, [SUBJECT] * 2).slots
    both = (slots >= 0).all(axis=1)
    assert (named(order, slots)[both] == [1, 0]).all()
    assert both.sum() == len(SECONDS) - 16
    assert slots[60].tolist() == [0 if order[60, 0] == 1 - k else -1 for k in range(2)]


@pytest.mark.parametrize("away", [slice(0, 50), slice(30, 60), slice(45, None)])
def test_an_animal_that_enters_leaves_or_hides_does_not_take_the_name_of_the_other(
    away: slice,
) -> None:
    order = np.tile([0, 1], (len(SECONDS), 1))
    seen = mixed(2, order)
    for name in POSE[:-2]:
        getattr(seen, name)[away, 2:] = np.nan  # the second one
    seen.n_px[away, 2:] = 0
    found = identify([seen] * 2, [SUBJECT] * 2)
    first = int(np.flatnonzero(found.slots[(found.slots == 1).any(axis=1)][0] == 0)[0])
    sure = np.ones(len(SECONDS), bool)
    for one in found.crossings:
        sure[one.start : one.stop] &= one.p_swap < 0.1
    assert (found.slots[sure, first] == 0).all()
    assert sure.mean() > 0.6
    assert (found.slots[away, 1 - first] == -1).all() or not sure[away].all()


@pytest.mark.parametrize("beside", [0, 1])  # animals of another body
@pytest.mark.parametrize("ratio", [1.0, 1.04, 1.15, 1.5])
def test_an_exchange_that_nothing_decides_is_as_likely_as_not_and_sizes_decide_it(
    ratio: float, beside: int
) -> None:
    order = np.tile(np.arange(2 + beside), (len(SECONDS), 1))
    seen = mixed(2 + beside, order)
    lose(seen, LOST)
    later = slice(LOST.stop, None)
    middle = 0.5 * (seen.place[:, :1] + seen.place[:, 2:3])
    apart = np.clip(np.abs(np.arange(len(SECONDS)) - 47.0) / 400.0, 0.0, 1.0)  # they meet slowly
    seen.place[:, :4] = middle + apart[:, None, None] * (seen.place[:, :4] - middle)
    seen.place[:, 4:] += 500.0
    seen.centroid_mm[:] = seen.place
    seen.n_px[:, :2] = round(800 * ratio)
    every = [replace(seen, residual_mm=seen.residual_mm.copy()) for _ in range(2 + beside)]
    for k, one in enumerate(every):
        fits = (np.arange(2 + beside) < 2) == (k < 2)
        one.residual_mm[:] = np.repeat(np.where(fits, 1.0, 3.0), 2)
    found = identify(every, [SUBJECT] * (2 + beside))
    unclear = max(found.crossings, key=lambda one: one.p_swap)
    if ratio < 1.1:  # it may be by chance
        assert 0.2 < unclear.p_swap <= 0.5
        assert "may have been exchanged at 1 of" in doubt(found.crossings)
    else:
        assert doubt(found.crossings) == ""
        assert (found.slots[later] == found.slots[0]).all()
        assert "size" in {one.decided_by for one in found.crossings}


def touching(seen: Observations, rows: slice) -> Observations:
    """Two animals are one component in some frames, which shows all of both."""
    seen.objects[rows, 1:] = np.nan
    return seen


def test_how_smoothly_bodies_fit_does_not_exchange_animals_in_a_long_contact() -> None:
    rng = np.random.default_rng(8)
    order = np.tile([0, 1], (len(SECONDS), 1))
    rows = slice(20, 80)
    jitters, smooth = (touching(mixed(2, order), rows) for _ in range(2))
    jitters.place[rows, :2] += rng.normal(0.0, 4.0, (60, 1, 3))  # each body on its own animal
    smooth.place[rows, 2:4] += rng.normal(0.0, 4.0, (60, 1, 3))
    slots = identify([jitters, smooth], [SUBJECT] * 2).slots
    assert (slots == slots[0]).all()


def test_touching_animals_keep_their_poses_unless_they_cover_each_other() -> None:
    seen = touching(mixed(2, np.tile([0, 1], (len(SECONDS), 1))), LOST)
    seen.score[LOST, 1] = np.nan  # one direction only
    seen.n_px[LOST] = (0.9 * seen.n_px[LOST]).astype(int)
    slots = np.zeros(len(SECONDS), np.int64)
    one_of_two = replace(SUBJECT, n_measured=2)
    assert (track_whole(one_of_two, own_observations(seen, slots)).track.flag == "").all()
    seen.n_px[LOST] = (0.8 * seen.n_px[LOST]).astype(int)
    track = track_whole(one_of_two, own_observations(seen, slots)).track
    assert not ((track.flag == "") & track.observed)[LOST].any()
    assert (track.flag[: LOST.start] == "").all()


def test_who_lies_over_another_animal_may_be_that_one() -> None:
    one, other = (mixed(2, shuffled(2)) for _ in range(2))
    slots = np.argsort(shuffled(2), axis=1)
    own = [own_observations(seen, slots[:, k]) for k, seen in enumerate((one, other))]
    for seen in own:  # one outline
        seen.objects[LOST, 1] = np.nan
    far = [replace(seen, centroid_mm=seen.centroid_mm.copy()) for seen in own]
    for some, mm in ((own, 20.0), (far, 400.0)):
        some[0].centroid_mm[:, :2] = 0.0
        some[1].centroid_mm[:, :2] = mm
        lose(some[1], LOST)
    over = covers(own, SUBJECT.length_mm)
    assert np.flatnonzero(over[0]).tolist() == [*range(LOST.start, LOST.stop)]
    assert not over[1].any()
    assert not covers(far, SUBJECT.length_mm).any()  # it has gone elsewhere
    tracked = track_whole(SUBJECT, own[0])
    tracked = replace(tracked, crossings=(Crossing(45, 50, (0, 1), 0.0, "human", "Ada"),))
    flag_unclear(tracked, over[0])
    assert np.flatnonzero(tracked.track.flag == "unclear").tolist() == [
        *range(40, 45),
        *range(50, 55),
    ]


def test_poses_in_an_unclear_crossing_are_not_trusted() -> None:
    unclear = Crossing(10, 20, (0, 1), 0.3, "motion")
    clear = Crossing(30, 40, (0, 1), 0.01, "motion")
    from_the_start = Crossing(0, 4, (0, 1), 0.0, "motion")
    tracked = replace(
        track_whole(SUBJECT, told(SECONDS, WALKS[0])), crossings=(from_the_start, unclear, clear)
    )
    tracked.track.p_flip[35:50] = 0.2  # the head is not clear: it counts in contact alone
    flag_unclear(tracked, np.zeros(len(SECONDS), np.bool_))
    assert np.flatnonzero(tracked.track.flag == "doubtful").tolist() == [*range(4)]
    assert np.flatnonzero(tracked.track.flag == "unclear").tolist() == [
        *range(10, 20),
        *range(35, 40),
    ]
    assert doubt([Crossing(0, 1, (0, 1), 1.0 - CERTAIN - 1e-9, "motion")]) == ""
    assert "70% certain" in doubt([unclear])


@pytest.mark.parametrize("exchanged", [False, True])
def test_animals_that_run_past_each_other_are_likely_to_run_on(exchanged: bool) -> None:
    x = 200.0 * (SECONDS - 1.5)
    own = np.stack([np.stack([x, 0.0 * x], 1), np.stack([-x, 30.0 + 0.0 * x], 1)], 1)
    slots = np.tile([0, 1], (90, 1))
    if exchanged:  # the tracks turn back where they meet
        own[45:], slots[45:] = own[45:, ::-1], [1, 0]
    states = np.array([[0, 1], [1, 0]])
    cost = _passed(SECONDS, own, SUBJECT, slots, states, 38, 52)
    assert cost[0, 0] + 3.0 < cost[0, 1]
    assert cost[0] == pytest.approx(cost[1, ::-1])


def followed(seen: Observations, n_animals: int = 2) -> tuple[OnlineIdentity, np.ndarray]:
    """The online identities after all frames, and where each animal (n, N, 2) was said to be."""
    online = OnlineIdentity([SUBJECT] * n_animals)
    places = []
    for k in range(len(seen)):
        own = online.add([seen[k : k + 1]] * n_animals)
        places.append([one.place[0, 0, :2] for one in own])
    return online, np.array(places)


@pytest.mark.parametrize("n_animals", [2, 3])
def test_during_a_recording_each_animal_keeps_its_name_from_the_past_alone(n_animals: int) -> None:
    seen = mixed(n_animals, shuffled(n_animals))
    online, places = followed(seen, n_animals)
    of = [walk.root.translation[:, :2] for walk in WALKS[:n_animals]]
    off = np.array(
        [[np.linalg.norm(places[:, k] - one, axis=1) for one in of] for k in range(n_animals)]
    )
    nearest = off.argmin(axis=1)
    assert (nearest == nearest[:, :1]).all()
    assert sorted(nearest[:, 0]) == [*range(n_animals)]
    assert online.crossings == []


@pytest.mark.parametrize("is_clear", [False, True])
def test_during_a_recording_a_meeting_is_open_and_bodies_decide_it(is_clear: bool) -> None:
    seen = mixed(2, np.tile([0, 1], (len(SECONDS), 1)))
    middle = 0.5 * (seen.place[:, :1] + seen.place[:, 2:3])
    apart = np.clip(np.abs(np.arange(len(SECONDS)) - 47.0) / 400.0, 0.0, 1.0)  # they meet slowly
    seen.place[:] = middle + apart[:, None, None] * (seen.place - middle)
    seen.centroid_mm[:] = seen.place
    lose(seen, LOST)
    bodies = [replace(seen, residual_mm=np.full_like(seen.score, 4.0)) for _ in range(2)]
    for k in range(2 if is_clear else 0):
        bodies[k].residual_mm[:, 2 * k : 2 * k + 2] = 1.0
    online, chances = OnlineIdentity([SUBJECT] * 2), []
    for k in range(len(seen)):
        online.add([one[k : k + 1] for one in bodies])
        chances.append(online.p_swap)
    assert max(chances[:20]) < 0.01
    assert chances[LOST.stop] > UNCLEAR
    assert chances[-1] == 0.0, "what is likeliest is taken as certain"
    assert (max(online.crossings) < UNCLEAR) == is_clear


def test_during_a_recording_an_animal_that_hides_does_not_take_the_name_of_the_other() -> None:
    seen = mixed(2, np.tile([0, 1], (len(SECONDS), 1)))
    for name in POSE[:-2]:
        getattr(seen, name)[30:60, 2:] = np.nan
    seen.n_px[30:60, 2:] = 0
    online, places = followed(seen)
    first = int(np.isfinite(places[40, 1, 0]))
    assert np.isnan(places[30:60, 1 - first]).all()
    assert np.abs(np.diff(places[:, first], axis=0)).max() < 20.0
    assert max([0.0, *online.crossings]) < UNCLEAR
