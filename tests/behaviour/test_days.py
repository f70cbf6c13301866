"""Light and dark, circadian measures and sleep by immobility of made movements."""

from dataclasses import replace
from datetime import datetime
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest

from liex_lab.behaviour.activity import observed_hold
from liex_lab.behaviour.days import Light, activity_by_hour, immobile_spans, rhythm
from liex_lab.errors import PlanError
from liex_lab.plan import Plan

LIGHT = Light(
    datetime(2026, 3, 2, 9, 30, tzinfo=ZoneInfo("Europe/Berlin")), "07:15", "19:00", 40.0, 2.0
)
DAY = 8640  # of ten seconds


def moving(x_mm: np.ndarray, step_s: float = 1.0) -> pd.DataFrame:
    """A table `kinematics` of a body centre that moves along x; NaN where it was not seen."""
    n = len(x_mm)
    return pd.DataFrame(
        {
            "session_id": "s",
            "individual": "a",
            "time_s": step_s * np.arange(n),
            "x_mm": x_mm,
            "y_mm": 0.0,
            "z_mm": 0.0,
            "step_mm": np.append(np.abs(np.diff(x_mm)), np.nan),
        }
    )


def walked(mm_per_s: np.ndarray) -> pd.DataFrame:
    """To and fro at a speed for every ten seconds, with one frame in each."""
    return moving(np.cumsum(10.0 * mm_per_s * (-1.0) ** np.arange(len(mm_per_s))), 10.0)


def measured(kinematics: pd.DataFrame, light: Light = LIGHT) -> tuple[pd.DataFrame, pd.Series]:
    hours = activity_by_hour(kinematics, light, observed_hold(kinematics))
    return hours, rhythm(hours, light).iloc[0]


def test_hours_are_those_of_the_clock_cut_where_the_light_is_switched() -> None:
    hours, found = measured(walked(np.full(DAY, 5.0)))
    assert hours["clock"].iloc[0] == "2026-03-02T09:30:00+01:00"
    assert (hours["stop_s"].iloc[0], hours["stop_s"].iloc[-1]) == (1800.0, 86_400.0)
    at_seven = hours[hours["clock"].str.contains("T07:")]
    assert at_seven["clock"].str[11:16].tolist() == ["07:00", "07:15"]
    assert at_seven["light"].tolist() == [False, True]
    assert hours.loc[hours["light"], "observed_s"].sum() == 11.75 * 3600
    assert hours["distance_mm"].sum() == pytest.approx(5.0 * 86_390, rel=1e-6)
    assert found["light_mm_per_h"] == pytest.approx(18_000, rel=1e-3)
    assert found["relative_amplitude"] == pytest.approx(0.0, abs=1e-3)
    dark_first = replace(LIGHT, on="19:00", off="07:15")  # a reversed cycle
    assert (measured(walked(np.full(DAY, 5.0)), dark_first)[0]["light"] != hours["light"]).all()


def test_the_hour_that_summer_time_repeats_is_two_hours() -> None:
    autumn = datetime(2026, 10, 25, 0, 0, tzinfo=ZoneInfo("Europe/Berlin"))
    edges, clock, _ = replace(LIGHT, start=autumn, on="07:00").hours(25 * 3600.0)
    np.testing.assert_allclose(np.diff(edges), 3600.0)
    assert [one.hour for one in clock] == [0, 1, 2, 2, *range(3, 24)]


def by_clock(of: object, days: int) -> pd.DataFrame:
    """Speeds that are a function of the time of day, h."""
    hour = (np.arange(days * DAY) / 360.0 + 9.5) % 24.0
    return walked(np.asarray(of(hour), float))  # type: ignore[operator]


def test_circadian_measures_of_known_rhythms() -> None:
    nightly = by_clock(lambda h: np.where((h >= 19) | (h < 7), 50.0, 5.0), 4)
    _, found = measured(nightly)
    assert found["n_days"] == pytest.approx(4.0, abs=0.05)
    assert found["m10_mm_per_h"] == pytest.approx(180_000, rel=0.01)
    assert (found["m10_onset_h"], found["l5_onset_h"]) == (19.0, 7.0)
    assert found["relative_amplitude"] == pytest.approx(45 / 55, abs=0.01)
    assert found["interdaily_stability"] == pytest.approx(1.0, abs=0.02)
    assert found["period_h"] == pytest.approx(24.0, abs=0.3)
    low, high = (found[f"dark_minus_light_{end}_mm_per_h"] for end in ("low", "high"))
    assert low < found["dark_minus_light_mm_per_h"] < high
    assert found["not_measured"] == ""
    _, sine = measured(by_clock(lambda h: 20.0 + 10.0 * np.sin(2 * np.pi * h / 24.0), 6))
    assert sine["intradaily_variability"] == pytest.approx(2 - 2 * np.cos(np.pi / 12), rel=0.05)
    drifting = 20.0 + 10.0 * np.sin(2 * np.pi * np.arange(8 * DAY) / (22.5 * 360.0))
    assert measured(walked(drifting))[1]["period_h"] == pytest.approx(22.5, abs=0.1)
    noise = np.repeat(np.random.default_rng(1).uniform(1, 40, 20 * 24), 360)
    _, found = measured(walked(noise), replace(LIGHT, start=LIGHT.start.replace(minute=0)))
    assert found["intradaily_variability"] == pytest.approx(2.0, abs=0.3)
    assert found["interdaily_stability"] < 0.15


def test_short_recordings_lack_measures_and_say_why() -> None:
    _, found = measured(walked(np.full(DAY, 5.0)))
    assert found[["interdaily_stability", "period_h"]].isna().all()
    assert "need 3 days, and 1.0 were observed" in found["not_measured"]
    _, found = measured(walked(np.full(720, 5.0)))
    assert np.isnan(found["relative_amplitude"])
    assert np.isnan(found["dark_mm_per_h"])
    assert "need every hour of the day" in found["not_measured"]


def test_sleep_by_immobility_lasts_forty_seconds_of_poses_without_movement() -> None:
    speed = np.full(1000, 30.0)
    speed[100:139] = 1.0  # with the second before, which it is compared with: 40 s
    speed[200:238] = 1.0  # 39 s
    speed[300:400] = 1.9
    speed[500:700] = 0.0
    x = np.cumsum(speed * (-1.0) ** np.arange(len(speed)))
    x[600] = np.nan  # not seen for a second
    spans = immobile_spans(moving(x), LIGHT)
    assert spans.tolist() == [[99, 139], [299, 400], [499, 600], [601, 700]]
    hours = activity_by_hour(moving(x), LIGHT, observed_hold(moving(x)))
    assert hours["sleep_by_immobility_s"].sum() == 40 + 101 + 101 + 99
    assert hours["sleep_by_immobility_count"].sum() == 4


def test_sleep_does_not_depend_on_the_frame_rate_nor_on_noise_of_a_millimetre() -> None:
    rng = np.random.default_rng(4)
    for hz in (10, 30, 90):
        still = rng.normal(0.0, 1.0, 200 * hz)
        (span,) = immobile_spans(moving(still, 1.0 / hz), LIGHT)
        assert span[1] - span[0] > 198


def test_light_is_stated_whole_and_for_a_known_time_of_day() -> None:
    plan = Plan()
    for settings, match in (
        (["light.on=07:00"], "takes on, off and zone together"),
        (["light.on=07:00", "light.off=07:00", "light.zone=UTC"], "together"),
        (["light.on=7:00", "light.off=19:00", "light.zone=UTC"], "light.on"),
        (["light.on=07:00", "light.off=19:00", "light.zone=Berlin"], "time zone such as"),
    ):
        with pytest.raises(PlanError, match=match):
            plan.with_settings(settings)
    whole = plan.with_settings(["light.on=07:00", "light.off=19:00", "light.zone=UTC"])
    stated = whole.light.model_dump()
    assert Light.of(plan.light.model_dump(), None) is None
    with pytest.raises(PlanError, match=r"session\.session_start_time"):
        Light.of(stated, "")
    light = Light.of(stated, "2026-08-21T10:00:00+02:00")
    assert light is not None
    assert light.start.isoformat() == "2026-08-21T08:00:00+00:00"
