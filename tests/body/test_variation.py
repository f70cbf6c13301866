"""Bodies of any animal: individuals vary, and the other family holds builds that training never
reaches.
"""

import numpy as np
import pytest

from liex_lab.body.shape import BodyShape, Capsules, Surface
from liex_lab.body.skeleton import Skeleton
from liex_lab.body.variation import FAMILIES, vary_body
from liex_lab.catalog import find_sample

FISH, SNAKE = Skeleton.load("fish"), Skeleton.load(find_sample("snake.toml"))


def girths(skeleton: Skeleton, family: str, n: int = 800) -> np.ndarray:
    """Thickness (n, places) of bodies over that of the default, drawn again from their seed."""
    body, again = (vary_body(np.random.default_rng(1), skeleton, family, n) for _ in range(2))
    for name, values in vars(body).items():
        np.testing.assert_array_equal(values, getattr(again, name))
    default = Surface.of(skeleton).body
    if isinstance(body, Capsules):
        assert isinstance(default, Capsules)
        return (body.radii / default.radii).reshape(n, -1)
    assert isinstance(body, BodyShape)
    assert isinstance(default, BodyShape)
    thick, usual = (np.sqrt(one.half_width * one.half_height) for one in (body, default))
    return thick[:, 2:-2] / usual[2:-2]


@pytest.mark.parametrize("skeleton", [FISH, SNAKE], ids=["fish", "snake"])
def test_other_bodies_are_slimmer_or_stouter_than_any_of_training(skeleton):
    train, augmented, wide, other = (
        np.log(girths(skeleton, family)).mean(axis=1) for family in FAMILIES
    )
    assert np.abs(np.median(train)) < 0.05
    assert train.std() < augmented.std() < wide.std() < other.std()
    outside = (other < np.quantile(train, 0.01)) | (other > np.quantile(train, 0.99))
    assert outside.mean() > 0.8
    beyond = (other < np.quantile(augmented, 0.05)) | (other > np.quantile(augmented, 0.95))
    assert beyond.mean() > 0.5
