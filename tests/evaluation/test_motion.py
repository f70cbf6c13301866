"""How an animal holds itself and moves, from five points along its back."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.evaluation.motion import Motion, motion_figures, nearest


def back(bend: float = 0.0, rise: float = 0.0, turn: float = 0.0, nod: float = 0.0) -> np.ndarray:
    """Five points, bones of 10 mm: the trunk bends and rises by so many degrees, the head turns."""
    points = [np.zeros(3)]
    bends = np.radians([0.0, 0.0, bend, bend + turn])
    rises = np.radians([rise, rise, rise, rise + nod])
    for azimuth, up in zip(bends, rises, strict=True):
        way = [np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)]
        points.append(points[-1] + 10.0 * np.array(way))
    return np.array(points)


def test_a_straight_animal_bends_nowhere_and_a_bent_one_by_what_it_was_bent() -> None:
    straight = Motion(back()[None]).posture()
    assert all(
        straight[name] == pytest.approx(0.0, abs=1e-9) for name in straight if name != "stretch"
    )
    bent = Motion(back(bend=30.0, turn=20.0)[None]).posture()
    # the middle of the second and third point lies on the first bone's line, half a bone before
    # the bend
    front = np.degrees(
        np.arctan2(10.0 * np.sin(np.radians(30.0)), 5.0 + 10.0 * np.cos(np.radians(30.0)))
    )
    assert bent["trunk_bend"][0] == pytest.approx(front)
    reared = Motion(back(rise=40.0, nod=-25.0)[None]).posture()
    assert reared["pitch"][0] == pytest.approx(40.0)
    assert reared["head_pitch"][0] == pytest.approx(-25.0)
    assert reared["trunk_arch"][0] == pytest.approx(0.0, abs=1e-9)


def test_angles_and_lean_do_not_depend_on_where_the_animal_heads() -> None:
    rng = np.random.default_rng(0)
    points = np.stack([back(*rng.normal(0.0, 20.0, 4)) for _ in range(50)])
    a = 2.3
    turned = points @ np.array([[np.cos(a), np.sin(a), 0], [-np.sin(a), np.cos(a), 0], [0, 0, 1.0]])
    own, other = Motion(points).posture(), Motion(turned + np.array([5.0, -7.0, 0.0])).posture()
    for name, values in own.items():
        np.testing.assert_allclose(values, other[name], atol=1e-9)


def test_speeds_are_those_that_were_walked_and_stop_at_a_break() -> None:
    n, rate = 120, 60.0
    points = np.repeat(back()[None], n, axis=0)
    points[:, :, 0] += 40.0 * np.arange(n)[:, None] / rate  # one length a second
    points[60:] += 500.0  # a jump
    clips = np.arange(n) // 60
    change = Motion(points, clips, rate).change()
    np.testing.assert_allclose(change["speed"], 1.0)
    assert len(change["speed"]) == n - 4
    np.testing.assert_allclose(change["turning"], 0.0, atol=1e-9)
    assert Motion(points, clips, None).change() == {}


def test_a_lean_of_the_points_is_told_and_taken_off() -> None:
    rng = np.random.default_rng(1)
    bends = rng.normal(12.0, 6.0, 400)
    real = Motion(np.stack([back(bend=b) for b in bends]))
    virtual = Motion(np.stack([back(bend=b) for b in rng.normal(0.0, 6.0, 400)]))
    told = motion_figures(real, {"drawn": virtual})
    assert told["lean_degrees"]["trunk_bend"] > 5.0
    bent, about = (told["quantiles"][f"trunk_bend{also}"] for also in ("", "_about_lean"))
    assert bent["real"][1] > 1.5 * bent["drawn"][1]
    assert about["real"][1] == pytest.approx(about["drawn"][1], rel=0.2)
    assert told["outside"]["drawn"]["trunk_bend"] > 0.02


def test_the_nearest_posture_may_be_a_mirror_image() -> None:
    left, right = (Motion(np.stack([back(bend=s * 20.0, turn=s * 10.0)] * 2)) for s in (1.0, -1.0))
    np.testing.assert_allclose(nearest(left, right), 0.0, atol=1e-9)
    opposed = Motion(np.stack([back(bend=20.0, turn=-60.0)] * 2))
    assert nearest(left, opposed).min() > 10.0
