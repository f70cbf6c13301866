"""Marks stand where their numbers say."""

from __future__ import annotations

import re

import numpy as np
import pytest
from liex_lab.dashboards.report import svg as figures
from liex_lab.dashboards.report.svg import Scale


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (0.0, 217.3), (-3.0, 0.002), (5.0, 5.01)])
def test_ticks_are_round_and_inside(low, high):
    ticks = Scale(low, high, 0.0, 100.0).ticks(5)
    assert 2 <= len(ticks) <= 7
    assert all(low - 1e-9 <= tick <= high + 1e-9 for tick in ticks)
    steps = np.diff(ticks)
    np.testing.assert_allclose(steps, steps[0])
    assert "-0" not in [f"{tick:g}" for tick in ticks]


def test_a_curve_is_broken_where_a_value_is_unknown():
    values = np.array([1.0, 2.0, np.nan, 3.0, np.nan, 1.0, 1.0])
    paths = figures._broken(np.arange(7.0), values)
    assert [len(re.findall(r"[ML]", path)) for path in paths] == [2, 1, 2]


def test_a_long_curve_keeps_its_peaks_and_its_holes():
    values = np.zeros(100_000)
    values[54_321] = 9.0
    values[20_000:30_000] = np.nan
    paths = figures._paths(np.arange(100_000.0), values)
    assert len(paths) == 2
    points = sum(len(re.findall(r"[ML]", path)) for path in paths)
    assert points < 2600
    assert " 9.0" in "".join(paths)


def test_a_bar_stands_at_its_time():
    time = figures.time_scale(10.0)
    svg = figures.lanes([(2.5, 5.0, "rear")], ["rear", "walk"], [], time)
    found = re.search(r'fill="#[0-9A-Fa-f]{6}" x="([\d.]+)" y="[\d.]+" width="([\d.]+)"', svg)
    assert found
    x, width = map(float, found.groups())
    assert x == pytest.approx(float(time(2.5)), abs=0.01)
    assert width == pytest.approx(float(time(5.0) - time(2.5)), abs=0.02)


def test_near_is_light_and_unread_is_grey():
    depth = np.array([[700, 700, 700, 700], [700, 650, 650, 0]], np.uint16)
    rgb = figures.shade(depth, 80.0).astype(int)
    assert rgb[1, 1].sum() > rgb[0, 0].sum()
    assert rgb[1, 3].tolist() == [90, 90, 90]


def test_a_skeleton_is_drawn_on_its_pixels():
    depth = np.full((20, 20), 700, np.uint16)
    svg = figures.picture(
        depth, np.array([[104.0, 55.0], [110.0, 60.0]]), [(0, 1)], left=100, top=50, reach_mm=60.0
    )
    assert 'x1="4.5" y1="5.5" x2="10.5" y2="10.5"' in svg
