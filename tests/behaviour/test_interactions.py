"""Who did what to whom, from joints of animals that move on known paths."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.distance import cdist

from liex_lab.actions.vocabulary import INTERACTIONS
from liex_lab.behaviour import interactions
from liex_lab.behaviour.interactions import Individual, find_interactions
from liex_lab.body.pose import Pose
from liex_lab.body.shape import Surface
from liex_lab.body.skeleton import Skeleton
from liex_lab.plan.sections import InteractionThresholds

MOUSE = Skeleton.load("mouse")
SPINE = 65.0
HZ = 30.0
LIMITS = InteractionThresholds()
Path = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def mouse(name: str, path: Path, seconds: float = 6.0, hz: float = HZ) -> Individual:
    """A straight mouse whose tail base goes along a path: x, y (mm) and heading (rad) over time."""
    time_s = np.arange(round(seconds * hz)) / hz
    x, y, way = (np.broadcast_to(one, time_s.shape) for one in path(time_s))
    reach = MOUSE.reach * SPINE / MOUSE.length
    ahead = np.stack([np.cos(way), np.sin(way), np.zeros(len(way))], axis=-1)
    start = np.stack([x, y, np.full(len(x), 15.0)], axis=-1)
    joints = start[:, None] + reach[:, None] * ahead[:, None]
    return Individual(name, MOUSE, joints, *[np.ones(len(joints), np.bool_)] * 3)


def still(x: float, y: float, way: float = 0.0) -> Path:
    return lambda t: (np.array(x), np.array(y), np.array(way))


def comes(to_x: float, mm_s: float = 150.0, stop_s: float = 3.0) -> Path:
    """Along x to a place, which it reaches at a time."""
    return lambda t: (np.minimum(to_x + mm_s * (t - stop_s), to_x), np.array(0.0), np.array(0.0))


def events(*animals: Individual, hz: float = HZ) -> pd.DataFrame:
    time_s = np.arange(len(animals[0].joints_mm)) / hz
    return find_interactions(time_s, animals, LIMITS).events


def said(table: pd.DataFrame, *words: str) -> list[tuple[str, str, str]]:
    rows = table[table["action"].isin(words)] if words else table
    return [*rows[["agent", "target", "action"]].itertuples(index=False, name=None)]


def test_who_comes_is_the_agent_of_an_approach_and_of_what_follows():
    a, b = mouse("a", comes(-75.0)), mouse("b", still(12.0, -32.0, np.pi / 2))
    found = events(a, b)
    assert said(found, "approach") == [("a", "b", "approach")]
    b = mouse("b", still(65.0, 0.0, np.pi))  # noses 10 mm apart in the end
    found = events(a, b)
    contact = found[found["action"] == "nose_to_nose"].iloc[0]
    assert (contact["agent"], contact["target"], contact["directed"]) == ("a", "b", True)
    assert contact["start_s"] == pytest.approx(3.0, abs=0.2)
    assert contact["stop_s"] == pytest.approx(6.0)
    assert said(events(b, a), "nose_to_nose") == [("a", "b", "nose_to_nose")]


def test_the_part_that_is_sniffed_names_the_contact():
    nose = mouse("a", comes(-75.0))
    behind = events(nose, mouse("b", still(0.0, 0.0)))  # its tail base 10 mm before the nose
    assert said(behind, "nose_to_tail_base") == [("a", "b", "nose_to_tail_base")]
    beside = events(nose, mouse("b", still(12.0, -32.0, np.pi / 2)))
    assert said(beside, "nose_to_side") == [("a", "b", "nose_to_side")]
    assert not said(beside, "nose_to_nose", "nose_to_tail_base")


@pytest.mark.parametrize(("mm_s", "word"), [(150.0, "follow"), (400.0, "chase")])
def test_a_follower_is_the_agent_and_a_fast_one_chases(mm_s, word):
    def ahead(by: float) -> Path:
        return lambda t: (by + mm_s * t, np.array(0.0), np.array(0.0))

    found = events(mouse("first", ahead(90.0)), mouse("second", ahead(0.0)))
    assert said(found, "follow", "chase") == [("second", "first", word)]
    assert not said(found, "approach", "leave", "avoid")
    apart = events(mouse("first", ahead(300.0)), mouse("second", ahead(0.0)))
    assert not said(apart, "follow", "chase")


def test_rest_side_by_side_is_a_huddle_and_a_mount_needs_height():
    a, b = mouse("a", still(0.0, 0.0)), mouse("b", still(0.0, 32.0))
    assert set(said(events(a, b))) == {
        ("a", "b", word) for word in ("huddle", "side_by_side_same", "contact")
    }
    turned = events(a, mouse("b", still(SPINE, 32.0, np.pi)))
    assert ("a", "b", "side_by_side_opposite") in said(turned)
    raised = mouse("b", still(-25.0, 0.0))
    joints = raised.joints_mm + np.array([0.0, 0.0, 25.0])
    assert said(events(a, replace(raised, joints_mm=joints)), "mount") == [("b", "a", "mount")]
    assert not said(events(a, raised), "mount")


def test_leaving_fast_is_an_escape_and_one_far_from_all_is_isolated():
    def goes(mm_s: float) -> Path:
        return lambda t: (np.maximum(mm_s * (t - 2.0), 0.0), np.array(0.0), np.array(0.0))

    stays = mouse("b", still(-75.0, 0.0))
    assert said(events(mouse("a", goes(150.0)), stays), "leave") == [("a", "b", "leave")]
    gone = events(mouse("a", goes(450.0)), stays, mouse("c", still(0.0, 900.0)))
    assert said(gone, "leave", "escape") == [("a", "b", "escape")]
    assert {agent for agent, _, _ in said(gone, "isolated")} == {"a", "b", "c"}
    assert set(gone[gone["action"] == "isolated"]["target"]) == {""}


def test_names_place_and_frame_rate_do_not_change_what_happened():
    a, b = mouse("a", comes(-75.0)), mouse("b", still(65.0, 0.0, np.pi))
    found = events(a, b).sort_values(["action", "agent"], ignore_index=True)
    again = events(b, a).sort_values(["action", "agent"], ignore_index=True)
    pd.testing.assert_frame_equal(found, again)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = [replace(one, joints_mm=one.joints_mm @ turn.T + [300.0, -70.0, 0.0]) for one in (a, b)]
    again = events(*moved).sort_values(["action", "agent"], ignore_index=True)
    pd.testing.assert_frame_equal(found, again)
    fast = [mouse("a", comes(-75.0), hz=90.0), mouse("b", still(65.0, 0.0, np.pi), hz=90.0)]
    quick = events(*fast, hz=90.0).sort_values(["action", "agent"], ignore_index=True)
    assert said(quick) == said(found)
    np.testing.assert_allclose(quick["start_s"], found["start_s"], atol=0.07)
    np.testing.assert_allclose(quick["stop_s"], found["stop_s"], atol=0.07)


def test_frames_that_are_not_trusted_are_not_observed():
    a, b = mouse("a", still(0.0, 0.0)), mouse("b", still(0.0, 32.0))
    trusted = np.ones(180, np.bool_)
    trusted[60:90] = False
    time_s = np.arange(180) / HZ
    whole = find_interactions(time_s, [a, b], LIMITS).totals
    found = find_interactions(time_s, [a, replace(b, trusted=trusted)], LIMITS)
    span = found.events[["start_frame", "stop_frame"]].to_numpy()
    assert ((span[:, 1] <= 60) | (span[:, 0] >= 90)).all()
    contact = found.totals[found.totals["action"] == "contact"]
    assert contact["observed_s"].tolist() == pytest.approx([5.0, 5.0])
    assert contact["share"].tolist() == pytest.approx([1.0, 1.0])
    assert whole[whole["action"] == "contact"]["total_s"].tolist() == pytest.approx([6.0, 6.0])
    nobody = replace(b, trusted=np.zeros(180, np.bool_))
    alone = find_interactions(time_s, [a, nobody], LIMITS)
    assert len(alone.events) == 0
    assert alone.totals["observed_s"].eq(0.0).all()
    assert alone.totals["share"].isna().all()


@pytest.mark.parametrize(("lost", "frames"), [(1, 180), (8, 180), (12, 168)])
def test_short_pauses_of_a_measurement_are_bridged(lost, frames):
    a, b = mouse("a", still(0.0, 0.0)), mouse("b", still(0.0, 32.0))
    trusted = np.ones(180, np.bool_)
    trusted[100 : 100 + lost] = False
    joints = np.where(trusted[:, None, None], b.joints_mm, 500.0)  # wrong where not trusted
    b = replace(b, trusted=trusted, joints_mm=joints)
    contact = events(a, b).query("action == 'contact'")
    assert (contact["stop_frame"] - contact["start_frame"]).sum() == frames
    # bridged frames are no clearer than the one before
    late = find_interactions(
        np.arange(180) / HZ, [a, replace(b, clear=np.arange(180) >= 100)], LIMITS
    )
    own = late.totals.query("action == 'nose_to_side'")
    assert own["observed_s"].to_numpy() == pytest.approx((80 - lost) / HZ)


def test_an_interaction_begins_and_ends_within_its_limits():
    """Side by side at 70, 45, 55, 45 and 70 mm: 50 mm is the limit, 60 mm within 20 % of it."""
    y = np.interp(np.arange(180), [0, 40, 60, 90, 120, 140, 179], [70, 45, 45, 55, 45, 45, 70])
    moves = mouse("b", lambda t: (np.array(0.0), y, np.array(0.0)))
    found = events(mouse("a", still(0.0, 0.0)), moves).query("action == 'side_by_side_same'")
    within = np.flatnonzero(y <= 50.0)
    span = found[["start_frame", "stop_frame"]].to_numpy().tolist()
    assert span == [[within[0], within[-1] + 1]]


@pytest.mark.parametrize(("sure", "stop"), [(170, 180), (180, 100)])
def test_poses_whose_head_is_in_doubt_only_bridge_what_depends_on_it(sure, stop):
    a, b, frame = mouse("a", still(0.0, 0.0)), mouse("b", still(0.0, 32.0)), np.arange(180)
    b = replace(b, ends=(frame < 100) | (frame >= sure))
    found = find_interactions(frame / HZ, [a, b], LIMITS)
    ends = found.events.set_index("action")["stop_frame"]
    assert (ends["side_by_side_same"], ends["huddle"], ends["contact"]) == (stop, 180, 180)
    seen = found.totals.query("action == 'side_by_side_same'")["observed_s"].to_numpy()
    assert seen == pytest.approx(stop / HZ)


@pytest.mark.parametrize(("way", "words"), [(np.pi / 2 - 0.1, ["avoid"]), (np.pi / 2 + 0.5, [])])
def test_going_aside_avoids_one_that_comes(way, words):
    """a goes from 120 mm before b's nose, b comes along x."""
    t0 = 1.0

    def leaves(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        far = 200.0 * np.clip(t - t0, 0.0, 0.5)
        return 190.0 + far * np.cos(way), far * np.sin(way), np.array(way)

    b = mouse("b", lambda t: (100.0 * np.clip(t - t0, 0, 0.5), np.array(0.0), np.array(0.0)), 3.0)
    found = events(mouse("a", leaves, 3.0), b)
    assert said(found, "avoid") == [("a", "b", word) for word in words]


def covered_pair(turned: float = 0.0, **of_b: Any) -> tuple[list[Individual], np.ndarray]:
    """Two mice, a behind b, and their outlines: in frames 90 to 150 b has no pose, and one outline
    shows 1.3 mice whose volume is that of 1.95.
    """
    a, b = mouse("a", still(0.0, 0.0)), mouse("b", still(100.0, 0.0, turned))
    covered = slice(90, 150)
    outlines = np.full((180, 4, 4), np.nan)
    outlines[:, :2] = [[32.0, 0.0, 20.0, 1500.0], [132.0, 0.0, 20.0, 1500.0]]
    outlines[covered, 0, 2:] = 30.0, 1.3 * 1500.0
    outlines[covered, 1] = np.nan
    trusted = np.ones(180, np.bool_)
    trusted[covered] = False
    return [a, replace(b, trusted=trusted, **of_b)], outlines


def mounts(animals: list[Individual], outlines: np.ndarray | None) -> pd.DataFrame:
    found = find_interactions(np.arange(180) / HZ, animals, LIMITS, outlines=outlines)
    return found.events.query("action == 'mount'")


def test_a_mount_is_seen_by_the_outline_of_a_covered_animal():
    animals, outlines = covered_pair()
    found = mounts(animals, outlines)
    assert said(found) == [("a", "b", "mount")]
    assert found[["start_frame", "stop_frame", "score"]].to_numpy().tolist() == [[90, 150, 0.0]]
    assert found["directed"].all()
    whole = find_interactions(np.arange(180) / HZ, animals, LIMITS, outlines=outlines)
    touch = whole.events.query("action == 'contact' and start_frame <= 90 and stop_frame >= 150")
    assert len(touch) == 1
    own = whole.totals.query("action == 'mount'").set_index("agent")
    assert own["share"].to_dict() == pytest.approx({"a": 2.0 / 6.0, "b": 0.0})
    flipped = animals[0].joints_mm.copy()
    flipped[84:90] = flipped[84:90, ::-1]  # the last poses are turned round
    again = mounts([replace(animals[0], joints_mm=flipped), animals[1]], outlines)
    assert said(again) == [("a", "b", "mount")]
    unclear, _ = covered_pair(clear=np.arange(180) < 80)
    assert not mounts(unclear, outlines)["directed"].any()


def test_an_animal_that_is_hidden_beside_or_faces_the_other_is_not_mounted():
    animals, outlines = covered_pair()
    assert mounts(animals, None).empty
    low = outlines.copy()
    low[90:150, 0, 2] = 20.0  # as one that an edge hides
    assert mounts(animals, low).empty
    wide = outlines.copy()
    wide[90:150, 0, 3] = 1.8 * 1500.0
    assert mounts(animals, wide).empty
    assert mounts(covered_pair(np.pi)[0], outlines).empty


def test_distances_of_skins_agree_with_those_of_the_meshes():
    surface = Surface.of(MOUSE)
    scale = SPINE / MOUSE.length
    pose = Pose.home(MOUSE)
    skin = scale * surface.vertices(pose)[: surface.n_trunk_vertices]
    joints = scale * pose.joints(MOUSE)
    limits = LIMITS
    rng = np.random.default_rng(3)
    for _ in range(20):
        way, shift = rng.uniform(-np.pi, np.pi), np.append(rng.uniform(-90.0, 90.0, 2), 0.0)
        turn = np.array(
            [[np.cos(way), -np.sin(way), 0.0], [np.sin(way), np.cos(way), 0.0], [0.0, 0.0, 1.0]]
        )
        a, b = (
            interactions._Course.of(
                Individual("", MOUSE, np.repeat(one[None], 2, 0), *[np.ones(2, bool)] * 3),
                np.array([0.0, 0.1]),
                limits,
            )
            for one in (joints, joints @ turn.T + shift)
        )
        gap = interactions._Toward.of(a, b, limits).gap[0]
        true = cdist(skin, skin @ turn.T + shift).min()
        if true > 12.0:
            assert gap == pytest.approx(true, abs=6.0)
        else:
            assert gap < 18.0


def test_every_word_has_a_definition_with_numbers_of_the_plan():
    texts = interactions.definitions(InteractionThresholds(nose_mm=31.0))
    assert set(texts) == set(INTERACTIONS)
    assert "31 mm" in texts["nose_to_nose"]
    assert not any("{" in text for text in texts.values())
