"""The row a biologist reads first adds up."""

import numpy as np
import pandas as pd
import pytest

from liex_lab.behaviour import ACTIONS, MouseRules, measure
from liex_lab.behaviour.summary import frames_of_periods
from liex_lab.errors import PlanError
from liex_lab.plan import Plan
from tests.behaviour.test_kinematics import tables_of
from tests.sessions.walking_mouse import SPINE_MM, WalkingMouse, steady


def summary_of(mouse: WalkingMouse):
    return measure(*tables_of(mouse)).summary.iloc[0]


def test_distance_speed_and_rearing_of_a_known_walk():
    row = summary_of(WalkingMouse(steady(10.0), speed_mm_s=200.0, rear_s=(4.0, 6.0)))
    assert row["distance_m"] == pytest.approx(2.0, rel=1e-3)
    assert row["mean_speed_mm_s"] == pytest.approx(200.0, rel=1e-3)
    assert row["median_speed_mm_s"] == pytest.approx(200.0, rel=1e-3)
    assert row["rear_count"] == 1
    assert row["rear_s"] == pytest.approx(1.9, abs=0.1)
    assert row["distance_moving_m"] == pytest.approx(2.0, rel=1e-3), "rearing or not, it moves"
    assert row["spine_mm"] == pytest.approx(SPINE_MM)
    assert row["duration_s"] == pytest.approx(10.0, abs=1e-6)


def test_the_time_budget_is_of_the_observed_time_and_adds_up():
    times = np.delete(steady(10.0), slice(100, 130))
    row = summary_of(WalkingMouse(times, rear_s=(6.0, 7.0), lost=tuple(range(30, 60))))
    assert row["n_frames"] == 270
    assert row["n_lost"] == 30
    assert row["duration_s"] == pytest.approx(10.0, abs=1e-6)
    assert row["observed_s"] == pytest.approx(8.0, abs=1e-6)
    words = [*ACTIONS, "unlabelled"]
    assert sum(row[f"{word}_s"] for word in words) == pytest.approx(row["observed_s"])
    assert sum(row[f"{word}_share"] for word in words) == pytest.approx(1.0)


def test_an_animal_never_observed_has_its_tables_without_numbers():
    found = measure(*tables_of(WalkingMouse(steady(1.0), lost=tuple(range(30)))))
    row = found.summary.iloc[0]
    assert (row["n_lost"], row["observed_s"], row["rear_count"]) == (30, 0.0, 0)
    assert np.isnan(row["mean_speed_mm_s"])
    assert len(found.bouts) == 0
    assert "peak_speed_mm_s" in found.bouts
    assert (found.activity["observed_s"] == 0).all()
    assert found.activity["mean_speed_mm_s"].isna().all()


def named(mouse: WalkingMouse, *spans: tuple[str, float, float]) -> pd.DataFrame:
    """Bouts (action, from, to) of a mouse, as a model would name them."""
    time_s = mouse.times_s
    rows = [(word, *np.searchsorted(time_s, [a, b])) for word, a, b in spans]
    return pd.DataFrame(
        {
            "session_id": "circle",
            "individual": "mouse_1",
            "action": [word for word, _, _ in rows],
            "start_s": [time_s[a] for _, a, _ in rows],
            "stop_s": [time_s[b] for _, _, b in rows],
            "duration_s": [time_s[b] - time_s[a] for _, a, b in rows],
            "start_frame": [a for _, a, _ in rows],
            "stop_frame": [b for _, _, b in rows],
            "score": 0.9,
            "source": "model",
            "model_hash": "abc",
        }
    )


def test_the_way_in_which_it_moved_does_not_depend_on_the_names_of_actions():
    mouse = WalkingMouse(steady(10.0), speed_mm_s=120.0)
    told = [
        measure(*tables_of(mouse), bouts=named(mouse, *spans), actions={"x": "", "walk": ""})
        for spans in ([], [("x", 1.0, 9.0)], [("walk", 2.0, 3.0)])
    ]
    ways = [one.summary["distance_moving_m"].iloc[0] for one in told]
    assert ways == [ways[0]] * 3
    assert ways[0] == pytest.approx(1.2, rel=1e-3)
    slow = WalkingMouse(steady(10.0), speed_mm_s=30.0)
    assert summary_of(slow)["distance_moving_m"] == 0.0
    noisy = WalkingMouse(steady(10.0), speed_mm_s=60.0, sd_mm=10.0)
    row = summary_of(noisy)
    assert row["speed_noise_mm_s"] > 60.0
    assert row["distance_moving_m"] == 0.0, "slower than its noise, nobody knows that it moved"


def test_rears_with_and_without_a_wall_are_counted_together():
    mouse = WalkingMouse(steady(10.0))
    spans = [("rear_supported", 2.0, 3.0), ("walk", 3.0, 5.0), ("rear_unsupported", 6.0, 6.5)]
    words = dict.fromkeys(("walk", "rear_supported", "rear_unsupported"), "")
    row = measure(*tables_of(mouse), bouts=named(mouse, *spans), actions=words).summary.iloc[0]
    assert row["rear_count"] == 2
    assert row["rear_s"] == pytest.approx(1.5, abs=1e-6)
    assert row["rear_share"] == pytest.approx(0.15, abs=1e-6)
    assert row["rear_latency_s"] == pytest.approx(2.0, abs=1e-6)


def test_periods_are_measured_as_the_session_is_and_add_up() -> None:
    mouse = WalkingMouse(steady(10.0), speed_mm_s=200.0, rear_s=(4.0, 6.0))
    plan = Plan().with_settings(
        [
            "behaviour.periods=[{name = 'before', start_s = 0, stop_s = 5},"
            "{name = 'after', start_s = 5}]"
        ]
    )
    assert Plan.from_toml(plan.to_toml()) == plan
    whole = measure(*tables_of(mouse), MouseRules(**plan.behaviour.model_dump()))
    row, periods = whole.summary.iloc[0], whole.tables["periods"].set_index("period")
    assert periods[["start_s", "stop_s"]].to_numpy().ravel() == pytest.approx([0, 5, 5, 10])
    for name in ("observed_s", "distance_m", "rear_s", "walk_s", "unlabelled_s"):
        assert periods[name].sum() == pytest.approx(row[name], abs=1e-6), name
    assert periods["rear_count"].tolist() == [1, 1], "the rear is cut"
    assert periods["rear_mean_s"].sum() == pytest.approx(row["rear_mean_s"], abs=1e-6)
    assert periods.loc["after", "rear_latency_s"] == 0.0
    assert set(periods.columns) < {one.name for one in whole.columns} | {"session_id"}


def test_periods_that_overlap_or_are_not_in_the_recording_are_refused() -> None:
    for spans, match in (
        ("{name = 'a', start_s = 0, stop_s = 5}, {name = 'b', start_s = 4}", "not overlap"),
        ("{name = 'a', start_s = 0}, {name = 'b', start_s = 4}", "not overlap"),
        ("{name = 'a', start_s = 5, stop_s = 4}", "begin before it ends"),
        ("{name = 'a', start_s = 0, stop_s = 1}, {name = 'a', start_s = 4}", "a is twice"),
        ("{name = 'A b', start_s = 0}", "should match pattern"),
    ):
        with pytest.raises(PlanError, match=match):
            Plan().with_settings([f"behaviour.periods=[{spans}]"])
    for span in ("start_s = 1, stop_s = 3", "start_s = 2.5"):
        plan = Plan().with_settings([f"behaviour.periods=[{{name = 'late', {span}}}]"])
        with pytest.raises(PlanError, match=r"the period late .* lie in the recording"):
            list(frames_of_periods(plan.behaviour, steady(2.0)))
