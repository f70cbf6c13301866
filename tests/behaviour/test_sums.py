"""Transitions against chance, zones, walls, activity, latencies: stories with known answers."""

import subprocess
import sys
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest

from liex_lab.behaviour import Surroundings, measure, measure_session
from liex_lab.behaviour.activity import (
    _binomial,
    activity,
    by_chance,
    count_transitions,
    hold_times,
    intervals,
    occupancy,
    outer_margin_mm,
    transitions,
    visits,
)
from liex_lab.behaviour.bouts import measure_bouts
from liex_lab.behaviour.statistics import false_discovery
from liex_lab.behaviour.summary import summarise
from liex_lab.scene.scene import Arena
from liex_lab.scene.zones import Zone, zone_names
from liex_lab.tables.rows import stop_times
from liex_lab.tables.schema import BOUTS, GAPS, Vocabulary, empty_table, to_pandas
from tests.behaviour.test_kinematics import tables_of
from tests.sessions.walking_mouse import WalkingMouse, steady, write

NO_GAPS = empty_table(GAPS)


def ethogram(words: list[str], length_s: float = 1.0) -> pd.DataFrame:
    """Bouts of equal length, one after the other."""
    start = length_s * np.arange(len(words))
    frames = np.rint(30 * start).astype(int)
    return to_pandas(
        BOUTS,
        {
            "session_id": "s",
            "individual": "m",
            "action": words,
            "start_s": start,
            "stop_s": start + length_s,
            "duration_s": [length_s] * len(words),
            "start_frame": frames,
            "stop_frame": frames + round(30 * length_s),
            "score": [1.0] * len(words),
            "source": ["human"] * len(words),
            "model_hash": [""] * len(words),
        },
    )


def rows_of(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a table as plain dicts."""
    return [dict(row) for row in table.to_dict("records")]  # type: ignore[arg-type]


def chain(n: int, seed: int, weights: dict[str, float]) -> list[str]:
    """Actions that follow each other by chance: the next is drawn by weight from all but
    the last.
    """
    rng = np.random.default_rng(seed)
    words, out = list(weights), [next(iter(weights))]
    while len(out) < n:
        others = [word for word in words if word != out[-1]]
        p = np.array([weights[word] for word in others])
        out.append(others[rng.choice(len(others), p=p / p.sum())])
    return out


def test_a_mouse_that_rears_for_1_2_s_after_2_s():
    """Of 1.2 s, 0.03 s at each end are below half of the rearing height."""
    row = measure(*tables_of(WalkingMouse(steady(6.0), rear_s=(2.0, 3.2)))).summary.iloc[0]
    assert row["rear_count"] == 1
    assert row["rear_s"] == pytest.approx(1.14, abs=2 / 30)
    assert row["rear_mean_s"] == row["rear_s"]
    assert row["rear_latency_s"] == pytest.approx(2.05, abs=1 / 30)
    assert row["rear_per_min"] == pytest.approx(10.0)
    assert row["rear_share"] == pytest.approx(row["rear_s"] / 6.0)
    assert np.isnan(row["pause_latency_s"])
    assert row["turn_bias"] == pytest.approx(1.0)  # it walks round to its left
    assert row["mean_abs_yaw_rate_rad_s"] == pytest.approx(200.0 / 150.0, rel=1e-6)


def test_the_bout_of_a_rear_tells_its_peak_and_its_turn():
    bouts = measure(*tables_of(WalkingMouse(steady(6.0), rear_s=(2.0, 3.2)))).bouts
    rear = bouts[bouts["action"] == "rear"].iloc[0]
    assert rear["time_to_peak_height_s"] == pytest.approx(0.1, abs=0.07)
    assert rear["net_turn_rad"] == pytest.approx(
        200 / 150 * (rear["duration_s"] - 1 / 30), rel=1e-6
    )
    assert rear["net_turn_sd_rad"] > 0
    chord = 2 * 150 * np.sin(rear["net_turn_rad"] / 2)
    assert rear["displacement_mm"] == pytest.approx(chord, rel=1e-3)
    walks = bouts[bouts["action"] == "walk"]
    assert walks["since_last_s"].iloc[1] == pytest.approx(rear["duration_s"])
    assert np.isnan(walks["since_last_s"].iloc[0])


def test_the_time_since_the_last_bout_is_unknown_across_a_gap():
    moved = measure(*tables_of(WalkingMouse(np.delete(steady(9.0), slice(100, 120))))).kinematics
    named = ethogram(["walk", "pause", "walk", "pause", "walk"], 1.0)
    bouts = measure_bouts(named, moved)
    assert bouts["since_last_s"].iloc[2] == pytest.approx(1.0)
    assert np.isnan(bouts["since_last_s"].iloc[4])


def test_transitions_are_counted_and_a_gap_or_a_long_pause_parts_them():
    words = ["walk", "rear", "walk", "pause", "walk", "rear"]
    counts = count_transitions(ethogram(words), ("walk", "rear", "pause"), NO_GAPS, 0.33)
    np.testing.assert_array_equal(counts, [[0, 2, 1], [1, 0, 0], [1, 0, 0]])
    gap = to_pandas(
        GAPS,
        {
            "session_id": "s",
            "individual": "m",
            "start_s": [1.0],
            "stop_s": [1.1],
            "start_frame": [33],
            "stop_frame": [33],
            "n_frames_missing": [2],
            "reason": ["camera_dropped"],
        },
    )
    late = ethogram(words)
    late.loc[1, "start_s"] = 1.1
    assert count_transitions(late, ("walk", "rear", "pause"), gap, 0.33)[0, 1] == 1
    assert count_transitions(late, ("walk", "rear", "pause"), NO_GAPS, 0.33)[0, 1] == 2
    apart = ethogram(words).assign(stop_s=lambda table: table["start_s"] + 0.5)
    assert count_transitions(apart, ("walk", "rear", "pause"), NO_GAPS, 0.33).sum() == 0


def test_chance_keeps_how_often_each_action_occurs_and_never_repeats_one():
    counts = np.array([[0, 30, 10], [25, 0, 20], [15, 15, 0]])
    chance = by_chance(counts)
    np.testing.assert_array_equal(np.diag(chance), 0.0)
    np.testing.assert_allclose(chance.sum(axis=1), 1.0)
    np.testing.assert_allclose(
        (chance * counts.sum(axis=1)[:, None]).sum(axis=0), counts.sum(axis=0), rtol=1e-6
    )


def test_what_follows_by_chance_is_rarely_called_significant_and_a_habit_is():
    words = ("rear", "run", "walk", "pause")
    weights = {"rear": 1.0, "run": 1.0, "walk": 3.0, "pause": 2.0}
    p = [
        transitions(ethogram(chain(300, seed, weights)), words, NO_GAPS, 0.33)["p"]
        for seed in range(60)
    ]
    assert np.mean(np.concatenate(p) < 0.05) <= 0.06
    habit = []
    for word in chain(300, 7, weights):
        habit += [word] if word != "rear" else ["rear", "run"]
    table = transitions(ethogram(habit), words, NO_GAPS, 0.33)
    (pair,) = (
        row for row in rows_of(table) if (row["from_action"], row["to_action"]) == ("rear", "run")
    )
    assert pair["p_fdr"] < 1e-3
    assert pair["probability"] > 0.9 > 2 * pair["by_chance"]


def test_false_discovery_agrees_with_the_rule_as_it_is_printed():
    rng = np.random.default_rng(2)
    p = rng.random(30) ** 2
    order = np.sort(p)
    for value, corrected in zip(p, false_discovery(p), strict=True):
        least = min(1.0, min(order[k] * 30 / (k + 1) for k in range(30) if order[k] >= value))
        assert corrected == pytest.approx(least)
    np.testing.assert_allclose(false_discovery([0.01, np.nan, 0.04]), [0.02, np.nan, 0.04])


def test_a_mouse_on_a_circle_visits_a_zone_once_a_round():
    """On a circle of 150 mm at 200 mm/s it is right of x = 75 mm for a third of each round of 4.71
    s.
    """
    mouse = WalkingMouse(steady(20.0))
    frames, poses = tables_of(mouse)
    right = Zone(
        "right", polygon_mm=((75.0, -400.0), (400.0, -400.0), (400.0, 400.0), (75.0, 400.0))
    )
    far = Zone("far", circle_mm=(900.0, 0.0, 10.0))
    moved = measure(frames, poses).kinematics
    frames["zone"] = zone_names([right, far], moved[["x_mm", "y_mm"]].to_numpy())
    behaviour = measure(frames, poses, around=Surroundings(zones=("right", "far")))
    right_zone, far_zone = rows_of(behaviour.zones)
    assert right_zone["n_visits"] == 5  # it begins inside; 20 s are 4.2 rounds
    assert right_zone["latency_s"] == 0.0
    round_s = 2 * np.pi * 150 / 200
    assert right_zone["time_s"] == pytest.approx(4 * round_s / 3 + round_s / 6, abs=0.2)
    assert right_zone["distance_mm"] == pytest.approx(200 * right_zone["time_s"], rel=1e-3)
    assert (far_zone["n_visits"], far_zone["time_s"]) == (0, 0.0)
    assert np.isnan(far_zone["latency_s"])
    assert behaviour.summary["zone_right_s"].iloc[0] == right_zone["time_s"]


def test_a_border_that_is_crossed_by_jitter_is_one_visit():
    frames, poses = tables_of(WalkingMouse(steady(4.0)))
    inside = np.zeros(120, bool)
    inside[30:80] = True
    inside[[40, 55]] = False  # a frame outside
    inside[100] = True  # and one inside
    frames["zone"] = np.where(inside, "nest", "")
    behaviour = measure(frames, poses)
    found = visits(frames, behaviour.kinematics, ["nest"], behaviour.rules).iloc[0]
    assert found["n_visits"] == 1
    assert found["mean_visit_s"] == pytest.approx(50 / 30)
    assert found["time_s"] == pytest.approx(49 / 30)


@pytest.mark.parametrize(
    "arena",
    [
        Arena("round", (0.0, 0.0), 200.0),
        Arena("rectangular", (0.0, 0.0), None, (250.0, 120.0), 0.0),
    ],
)
def test_the_outer_half_is_half_of_the_floor(arena):
    rng = np.random.default_rng(1)
    wall = arena.wall_distance_mm(rng.uniform(-260, 260, (200_000, 2)))
    wall = wall[wall > 0]
    assert np.mean(wall < outer_margin_mm(arena)) == pytest.approx(0.5, abs=0.006)


def test_a_mouse_along_the_wall_is_in_the_outer_half():
    frames, poses = tables_of(WalkingMouse(steady(5.0), radius_mm=150.0))
    bowl = Arena("round", (0.0, 0.0), 180.0)
    frames["wall_distance_mm"] = 30.0
    row = measure(frames, poses, around=Surroundings(bowl)).summary.iloc[0]
    assert (row["wall_distance_mm"], row["outer_half_share"]) == (30.0, 1.0)
    assert np.isnan(measure(frames, poses).summary["outer_half_share"].iloc[0])


def test_long_sessions_are_cut_into_minutes():
    edges = intervals(3600.5)
    assert len(edges) == 62
    np.testing.assert_allclose(np.diff(edges)[:-1], 60.0)
    assert edges[-1] == 3600.5


@st.composite
def gappy_bouts(draw):
    """A table `kinematics` with random times, gaps and lost frames, and random bouts of it."""
    n = draw(st.integers(1, 40))
    steps = draw(st.lists(st.sampled_from([0.031, 0.033, 0.036, 0.1, 0.3, 5.0]), min_size=n))
    time_s = np.cumsum([0.0, *steps])[:n]
    lost = draw(st.lists(st.booleans(), min_size=n, max_size=n))
    moved = pd.DataFrame(
        {
            "session_id": "s",
            "individual": "m",
            "frame_index": np.arange(n),
            "time_s": time_s,
            "x_mm": np.where(lost, np.nan, 1.0),
            "step_mm": np.where(lost, np.nan, 0.5),
        }
    )
    ends = draw(st.lists(st.floats(-0.5, float(time_s[-1]) + 0.5), max_size=20, unique=True))
    ends = sorted(ends)[: len(ends) // 2 * 2]
    words = draw(st.lists(st.sampled_from(["a", "b", "c"]), min_size=len(ends) // 2))
    at = np.reshape(ends, (-1, 2))
    bouts = pd.DataFrame({"action": words[: len(at)], "start_s": at[:, 0], "stop_s": at[:, 1]})
    return moved, bouts.assign(duration_s=bouts["stop_s"] - bouts["start_s"])


@settings(max_examples=20)
@given(gappy_bouts())
def test_named_and_unlabelled_time_is_the_observed_time_whatever_was_lost(case):
    moved, bouts = case
    words = ("a", "b", "c")
    parts = [f"{word}_s" for word in ("unlabelled", *words)]
    table = activity(moved, bouts, words)
    np.testing.assert_allclose(table[parts].sum(axis=1), table["observed_s"], atol=1e-9)
    frames = pd.DataFrame({"session_id": ["s"], "individual": ["m"], "flag": [""]})
    row = summarise(
        frames,
        moved.assign(speed_mm_s=1.0, yaw_rate_rad_s=np.nan, speed_sd_mm_s=1.0),
        bouts,
        Vocabulary(words),
    ).iloc[0]
    # the loop that a reader would write: each observed frame has the last bout around it
    time_s, stop_s = moved["time_s"].to_numpy(), stop_times(moved["time_s"].to_numpy())
    slow = dict.fromkeys(("unlabelled", *words), 0.0)
    for k in np.flatnonzero(moved["x_mm"].notna()):
        inside = (bouts["start_s"] - 1e-6 <= time_s[k]) & (bouts["stop_s"] - 1e-6 > time_s[k])
        slow[[*bouts["action"][inside], "unlabelled"][0]] += stop_s[k] - time_s[k]
    for word, seconds in slow.items():
        assert row[f"{word}_s"] == pytest.approx(seconds, abs=1e-9)
        assert table[f"{word}_s"].sum() == pytest.approx(seconds, abs=1e-9)
    if row["observed_s"] > 0:
        assert sum(row[f"{word}_share"] for word in slow) == pytest.approx(1.0)


def test_the_tables_can_be_made_again_from_the_session_s_folder_alone(tmp_path):
    nest = Zone("nest", polygon_mm=((0.0, 0.0), (200.0, 0.0), (200.0, 200.0), (0.0, 200.0)))
    mouse = WalkingMouse(steady(5.0), rear_s=(1.0, 2.2), lost=(90, 91))
    session = write(
        tmp_path / "c.liex", mouse, arena=Arena("round", (0.0, 0.0), 250.0), zones=(nest,)
    )
    again = measure_session(session)
    for name, table in again.tables.items():
        stored = session.summary if name == "summary" else session.table(name)
        pd.testing.assert_frame_equal(table, stored, check_dtype=False, check_categorical=False)
    assert set(again.tables) == {
        "kinematics",
        "bouts",
        "summary",
        "transitions",
        "activity",
        "zones",
    }


# Transitions between actions: their test of chance is SciPy's exact binomial test.


@pytest.mark.parametrize("total", [1, 2, 7, 60, 3000])
def test_the_exact_binomial_test_is_that_of_scipy(total: int) -> None:
    rng = np.random.default_rng(total)
    for chance in (0.5, 0.02, 1.0 / 3.0, 0.97):
        for n in {0, total, *rng.integers(0, total + 1, 8).tolist()}:
            expected = binomtest(n, total, chance).pvalue
            assert _binomial(n, total, chance) == pytest.approx(expected, rel=1e-9, abs=1e-300)


def test_where_chance_leaves_no_choice_there_is_no_p() -> None:
    assert np.isnan(_binomial(0, 0, 0.5))
    assert np.isnan(_binomial(3, 5, 1.0))


RUN = "from liex_lab.api import run_demo; run_demo(tempfile.mkdtemp())"


@pytest.mark.parametrize(
    "work",
    [
        "import liex_lab.api, liex_lab.pipelines.session, liex_lab.behaviour.summary",
        pytest.param(RUN, id="run", marks=pytest.mark.nightly),
    ],
)
def test_a_run_does_without_the_statistics_of_scipy(work: str) -> None:
    """They take longer to import than all poses of a second take to measure."""
    code = f"import sys, tempfile; {work}; assert 'scipy.stats' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)


# Time on the floor is neither lost nor made.


@pytest.mark.parametrize("sd_mm", [0.0, 5.0, 40.0])
def test_the_cells_add_up_to_the_observed_time(sd_mm):
    rng = np.random.default_rng(0)
    xy = rng.uniform(-120.0, 120.0, (500, 2))
    xy[100:150] = np.nan
    hold = rng.uniform(0.01, 0.1, 500)
    found = occupancy(xy, hold, [-120.0, -120.0], [120.0, 120.0], sd_mm)
    seen = np.isfinite(xy).all(axis=1)
    assert found.n == 450
    assert found.observed_s == pytest.approx(hold[seen].sum())
    area = np.outer(np.diff(found.y_mm), np.diff(found.x_mm)) / 100.0
    assert (found.per_cm2 * area).sum() == pytest.approx(found.observed_s)


def test_a_place_outside_of_the_rectangle_widens_it():
    found = occupancy([[500.0, 0.0]], [2.0], [-100.0, -100.0], [100.0, 100.0])
    assert found.observed_s == pytest.approx(2.0)
    assert found.x_mm[-1] >= 500.0


def test_nobody_seen_is_no_time_and_no_error():
    found = occupancy(np.full((3, 2), np.nan), np.ones(3), [0.0, 0.0], [10.0, 10.0])
    assert (found.n, found.observed_s) == (0, 0.0)


def test_the_last_frame_and_one_before_a_gap_count_as_long_as_usual():
    np.testing.assert_allclose(hold_times([0.0, 0.1, 0.2, 5.0, 5.1]), [0.1, 0.1, 0.1, 0.1, 0.1])
