"""Boosted forests: trees that correct one another, read as every forest is read, by their mean."""

from dataclasses import replace

import numpy as np
import pytest

from liex_lab.forests import _kernels as kernels
from liex_lab.forests.forest import Forest, Samples, predict
from liex_lab.forests.grow import GrowthPlan, boost_forest, grow_forest

PLAN = GrowthPlan(
    n_trees=20,
    max_depth=4,
    min_leaf=8,
    n_tests=40,
    one_probe_share=0.0,
    scalar_share=1.0,
    depth_share=0.3,
    bag_share=0.5,
)


@pytest.fixture(scope="module")
def numbers() -> tuple[Samples, np.ndarray]:
    """Samples without a picture: four numbers, and a label that is no sum of steps."""
    rng = np.random.default_rng(1)
    n = 600
    scalars = rng.uniform(-300, 300, (n, 4)).astype(np.float32)
    label = 0.02 * scalars[:, 0] + 4.0 * np.sin(scalars[:, 1] / 60) + 7.0
    samples = Samples(
        np.zeros((n, 1, 1), np.int16),
        np.arange(n, dtype=np.int32),
        np.ones(n, np.float32),
        np.zeros((n, 1, kernels.VIEW), np.float32),
        scalars,
    )
    return samples, label[:, None].astype(np.float32)


@pytest.mark.parametrize("n_trees", [1, 5])
def test_a_boosted_forest_is_its_stages_added_up(numbers, n_trees):
    samples, labels = numbers
    plan = PLAN._replace(n_trees=n_trees)
    boosted = boost_forest(samples, labels, plan, 0.3, np.random.default_rng(2))
    assert boosted.n_trees == n_trees  # none is lost of an odd number
    mean = labels.mean(axis=0)
    total = np.zeros_like(labels)
    for first in range(0, n_trees, 2):
        stage = replace(boosted, roots=boosted.roots[first : first + 2])
        total += (predict(stage, samples) - mean) * (stage.n_trees / n_trees)
    np.testing.assert_allclose(predict(boosted, samples), mean + total, atol=1e-3)
    assert np.std(predict(boosted, samples) - labels) < np.std(labels)
    distrusted = boost_forest(samples, labels, plan, 1e-6, np.random.default_rng(4))
    np.testing.assert_allclose(predict(distrusted, samples), labels.mean(), atol=1e-3)


def test_joined_forests_predict_as_each_of_them_alone(numbers):
    samples, labels = numbers
    everything = np.ones(len(samples), bool)
    parts = [
        grow_forest(samples, labels, everything, PLAN, np.random.default_rng(seed))[0]
        for seed in (5, 6, 7)
    ]
    joined = Forest.join(parts)
    np.testing.assert_allclose(
        predict(joined, samples),
        np.mean([predict(part, samples) for part in parts], axis=0),
        atol=1e-4,
    )
    third = Forest(joined.nodes, joined.roots[2 * PLAN.n_trees :], joined.leaves)
    np.testing.assert_array_equal(predict(third, samples), predict(parts[2], samples))
