"""Hand postures: statistics that can be drawn from, and what their drawing keeps."""

import tomllib

import numpy as np
import pytest

from liex_lab.body import Skeleton
from liex_lab.simulation.hand.simulator import STATISTICS, draw_observed, draw_wide

HAND = Skeleton.load("hand")


@pytest.mark.parametrize("draw", [draw_observed, draw_wide])
def test_drawn_hands_are_hands(draw) -> None:
    angles, turns = draw(np.random.default_rng(0), HAND, 400)
    low, high = HAND.limits[..., 0], HAND.limits[..., 1]
    assert ((angles >= low - 1e-9) & (angles <= high + 1e-9))[:, 1:].all()
    assert (angles[:, ~HAND.axes] == 0).all()
    np.testing.assert_allclose(
        turns @ np.swapaxes(turns, 1, 2), np.tile(np.eye(3), (400, 1, 1)), atol=1e-9
    )
    assert np.linalg.det(turns).min() > 0.99
    again, _ = draw(np.random.default_rng(0), HAND, 400)
    np.testing.assert_array_equal(angles, again)


def test_wide_postures_reach_further_than_those_seen() -> None:
    seen, wide = (draw(np.random.default_rng(2), HAND, 3000) for draw in (draw_observed, draw_wide))
    middle = [j for j, name in enumerate(HAND.names) if name.endswith("_middle")]
    low, high = (
        [np.quantile(angles[:, middle, 1], q, axis=0) for angles in (seen[0], wide[0])]
        for q in (0.02, 0.98)
    )
    assert (high[1] - low[1] > 1.05 * (high[0] - low[0])).all()  # from stretched to a fist
    spin = [np.arctan2(turns[:, 1, 0], turns[:, 0, 0]) for _, turns in (seen, wide)]
    assert np.abs(np.exp(1j * spin[1]).mean()) < np.abs(np.exp(1j * spin[0]).mean())
    # the palm's z axis leaves through the back of the hand, which people show less often
    assert (seen[1][:, 2, 2] < 0).mean() > 0.6


def test_the_bundled_statistics_say_where_they_come_from() -> None:
    text = STATISTICS.read_text(encoding="utf-8")
    assert "NYU Hand Pose" in text.split("[[", 1)[0]
    table = tomllib.loads(text)
    assert sum(p["share"] for p in table["postures"]) == pytest.approx(1.0, abs=0.01)
    assert sum(t["share"] for t in table["turns"]) == pytest.approx(1.0, abs=0.01)
    assert {len(p["mean_deg"]) for p in table["postures"]} == {HAND.dof - 6}
