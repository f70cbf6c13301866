"""People read cm/s, degrees and whole words."""

import numpy as np
import pandas as pd
import pytest
from liex_lab.dashboards.app import tables
from liex_lab.dashboards.units import counted, day, reading, shown, titled


def test_speeds_and_angles_are_shown_in_cm_s_and_degrees() -> None:
    assert shown(120.0, "mm/s") == (pytest.approx(12.0), "cm/s")
    angles, unit = shown(np.array([np.pi, -np.pi / 2]), "rad")
    assert unit == "°"
    np.testing.assert_allclose(angles, [180.0, -90.0])
    assert shown(3, "") == (3, "")
    assert shown(62.9, "mm") == (62.9, "mm")


NAN = float("nan")


@pytest.mark.parametrize(
    ("made", "text"),
    [
        (titled("mean_speed_mm_s", "mm/s"), "mean speed"),  # a column without its unit
        (titled("mean_abs_yaw_rate_rad_s", "rad/s"), "mean abs yaw rate"),
        (titled("n_lost", ""), "n lost"),
        (titled("distance_m", "m"), "distance"),
        (counted(1, "stretch", "stretches"), "1 stretch"),  # one object is not several
        (counted(2, "stretch", "stretches"), "2 stretches"),
        (counted(1200, "frame"), "1,200 frames"),
        (counted(0, "gap"), "0 gaps"),
        (reading(0.7505, "s"), "0.75"),  # decimals of the unit, but never fewer than two digits
        (reading(12.0, "s"), "12.00"),
        (reading(9.076, "cm/s"), "9.1"),
        (reading(0.02134, "m"), "0.021"),
        (reading(1234.56, "mm"), "1,234.6"),
        (reading(0.0, "mm"), "0.0"),
        (reading(NAN, "s"), "–"),
        (reading(np.int64(1200), ""), "1,200"),  # counts are whole, whatever they were read as
        (reading(3.0, ""), "3"),
        (reading(-0.4462, ""), "-0.45"),
        (day("2017-01-25T10:42:07.173469-05:00"), "25 January 2017, 10:42:07 (UTC-05:00)"),
        (day("2026-08-01T09:00:00"), "1 August 2026, 09:00:00"),
        (day("some day"), "some day"),
    ],
)
def test_numbers_names_and_days_are_written_as_people_write_them(made: str, text: str) -> None:
    assert made == text


def test_the_table_of_differences_has_the_unit_of_its_measure() -> None:
    stats = pd.DataFrame(
        [
            {
                **dict.fromkeys(tables.STATS, 1),
                "measure": "mean_speed_mm_s",
                "estimate": -40.0,
                "ci_low": -60.0,
                "ci_high": -20.0,
            }
        ]
    )
    shown_table = tables.Table(stats, tables.STATS, units={"mean_speed_mm_s": "mm/s"})
    cells = tables.fill(shown_table)["rows"][0]
    texts = {name: cell["text"] for name, cell in zip(tables.STATS, cells, strict=True)}
    assert texts["measure"] == "mean speed, cm/s"
    assert [texts[name] for name in ("estimate", "ci_low", "ci_high")] == ["-4", "-6", "-2"]
    assert texts["effect_size"] == "1"
