"""Joints are drawn no thicker than their bones allow, and a mouse's as ever."""

from __future__ import annotations

import numpy as np
import pytest

from liex_lab.body import Skeleton
from liex_lab.sessions.drawn import dot_mm, dot_pt


@pytest.mark.parametrize("name", ["mouse", "fish", "hand"])
def test_two_joints_beside_each_other_are_two_dots(name):
    skeleton = Skeleton.load(name)
    bones = np.linalg.norm(skeleton.offsets[1:], axis=1)
    assert 2.0 * dot_mm(skeleton) < np.median(bones)
    assert 1.5 <= dot_pt(skeleton) <= 3.5


def test_a_mouse_is_drawn_thicker_than_a_fish():
    mouse, fish = Skeleton.load("mouse"), Skeleton.load("fish")
    assert dot_mm(mouse) == 3.0
    assert dot_mm(fish) < 1.0
    assert dot_pt(mouse) > 2.0 * dot_pt(fish)
