"""Hand postures from anatomy: within the joints' limits, tips that meet, bones around an object."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from liex_lab.body import Skeleton
from liex_lab.body.pose import Pose
from liex_lab.simulation.hand import postures

HAND = Skeleton.load("hand")


@pytest.mark.parametrize("anywhere", [0.0, 1.0])
def test_drawn_hands_are_hands(anywhere: float) -> None:
    rng = np.random.default_rng(0)
    angles = postures.draw_postures(rng, HAND, 400)
    turns = postures.draw_turns(rng, 400, anywhere)
    assert (np.abs(angles - HAND.limits.mean(-1)) <= np.ptp(HAND.limits, -1) / 2 + 1e-9).all()
    np.testing.assert_allclose(
        turns @ np.swapaxes(turns, 1, 2), np.tile(np.eye(3), (400, 1, 1)), atol=1e-9
    )
    assert np.linalg.det(turns).min() > 0.99
    # the palm's z axis leaves through the back of the hand, which people show less often
    assert 0.55 < (turns[:, 2, 2] < 0).mean() < 0.85


@pytest.mark.parametrize("finger", ["index", "middle", "ring", "little"])
def test_the_thumb_meets_the_finger_of_the_shape(
    finger: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = tomllib.loads(Path(postures.__file__).with_name("postures.toml").read_text("utf-8"))
    row = np.hstack([*table["shapes"][f"tips of thumb and {finger} finger"].values()])[1:]
    monkeypatch.setattr(postures, "_drawn", lambda rng, skeleton, n: np.tile(row, (n, 1)))
    angles = postures.draw_postures(np.random.default_rng(1), HAND, 200)
    joints = replace(Pose.home(HAND, 200), angles=angles).joints(HAND)
    tips = joints[:, [10, 14, 18, 22]] - joints[:, [6]]
    away = np.median(np.linalg.norm(tips, axis=2), axis=0)
    assert ("index", "middle", "ring", "little")[away.argmin()] == finger
    assert away.min() < 30.0  # a thumb and a finger are 16 mm thick


def test_the_bones_of_a_grasp_touch_the_object() -> None:
    """Where the middle joint's bones touch it, both are perpendicular to lines from its centre."""
    bend = np.radians(postures._grasps(np.random.default_rng(3), HAND, 50)[:, 4])
    radius = 0.5 * np.random.default_rng(3).uniform(15.0, 110.0, 50) + 9.0
    t = 0.25 * np.linalg.norm(HAND.offsets[[8, 9]], axis=1).sum()  # of the index finger
    along = np.stack([np.cos(bend), -np.sin(bend)], axis=1)
    toward = np.stack([np.full(50, -t), -radius], axis=1) - t * along
    np.testing.assert_allclose(np.linalg.norm(toward, axis=1), radius)
    np.testing.assert_allclose(np.sum(toward * along, axis=1), 0.0, atol=1e-9)
