"""Forests: nodes hold what was put in, fast descents agree with the slow twin, growth learns and is
repeatable.
"""

from dataclasses import replace

import numba
import numpy as np
import pytest
from numba import njit

from liex_lab.forests import _kernels as kernels
from liex_lab.forests._walk import LANES, walk_one_view, walk_views
from liex_lab.forests.forest import Forest, Samples, predict
from liex_lab.forests.grow import GrowthPlan, grow_forest
from tests.oracles.forest import leaf_by_hand

PLAN = GrowthPlan(
    n_trees=4,
    max_depth=8,
    min_leaf=5,
    n_tests=60,
    one_probe_share=0.3,
    scalar_share=0.2,
    depth_share=0.3,
    bag_share=0.63,
)


@pytest.fixture(scope="module")
def bumps() -> tuple[Samples, np.ndarray]:
    """Height maps with one bump, seen by a joint beside it; the label is where the bump is, mm."""
    rng = np.random.default_rng(3)
    n, size = 400, 48
    where = rng.uniform(-8, 8, (n, 2))
    rows, columns = np.mgrid[:size, :size]
    off = (columns - 24 - where[:, :1, None]) ** 2 + (rows - 24 - where[:, 1:, None]) ** 2
    heights = (np.maximum(20.0 - 0.4 * off, 0.0) * 16).astype(np.int16)
    views = np.zeros((n, 1, kernels.VIEW), np.float32)
    views[:, 0, :2] = 24
    views[:, 0, 2] = views[:, 0, 6] = 20 / 127
    views[:, 0, 8] = 16 * 10
    scalars = rng.normal(0, 100, (n, 3)).astype(np.float32)
    image, inverse_size = np.arange(n, dtype=np.int32), np.ones(n, np.float32)
    return Samples(heights, image, inverse_size, views, scalars), where.astype(np.float32)


def grown(bumps, **changes) -> tuple[Forest, np.ndarray]:
    """A forest of the bumps, and which image each tree was grown on."""
    samples, labels = bumps
    keep = np.ones(len(samples), bool)
    return grow_forest(samples, labels, keep, PLAN._replace(**changes), np.random.default_rng(0))


def test_descents_agree_with_the_walk_a_reader_would_write(bumps):
    samples, _ = bumps
    forest, _ = grown(bumps)
    for s in range(0, 400, 40):
        for root in forest.roots:
            scene = (
                samples.heights[s],
                samples.inverse_size[s],
                samples.views[s],
                samples.scalars[s],
            )
            assert kernels.descend(forest.nodes, root, *scene) == leaf_by_hand(
                forest.nodes, root, *scene
            )


@njit
def walk_all(nodes, root, pixels, base, scalar_base, inverse, one, several, side, leaves):
    """Leaves (2, n) of all lanes, for a forest of one view and for one that chooses among views."""
    n = base.size
    for first in range(0, n, LANES):
        walk_one_view(
            nodes, root, pixels, base, scalar_base, inverse, one, n, side, leaves[0], first
        )
        walk_views(
            nodes,
            root,
            pixels,
            base,
            scalar_base,
            inverse,
            several,
            several.size // n,
            side,
            leaves[1],
            first,
        )


@pytest.mark.parametrize("n_views", [1, 3])
def test_sixteen_lanes_reach_the_leaves_that_one_sample_after_the_other_does(bumps, n_views):
    samples, labels = bumps
    rng = np.random.default_rng(5)
    n, side = 32, samples.heights.shape[1]
    views = np.repeat(samples.views, n_views, axis=1)
    views += rng.normal(0, 0.4, views.shape).astype(np.float32)
    many = replace(samples, views=views)
    forest, _ = grow_forest(many, labels, np.ones(len(many), bool), PLAN, rng)
    n_scalars, area = many.scalars.shape[1], side * side
    scalars = np.floor(many.scalars[:n]).astype(np.int16)
    pixels = np.concatenate([many.heights[:n].ravel(), scalars.ravel()])
    base = np.arange(n, dtype=np.int32) * area
    scalar_base = (n * area + np.arange(n) * n_scalars).astype(np.int32)
    leaves = np.zeros((2, n), np.int32)
    for root in forest.roots:
        wanted = [
            kernels.descend(
                forest.nodes, root, many.heights[s], many.inverse_size[s], views[s], many.scalars[s]
            )
            for s in range(n)
        ]
        one = np.ascontiguousarray(views[:n, 0].T).ravel()
        walk_all(
            forest.nodes,
            root,
            pixels,
            base,
            scalar_base,
            many.inverse_size[:n].copy(),
            one,
            views[:n].ravel(),
            side,
            leaves,
        )
        np.testing.assert_array_equal(leaves[1], wanted)
        if n_views == 1:
            np.testing.assert_array_equal(leaves[0], wanted)


def test_a_forest_learns_where_the_bump_is(bumps):
    samples, labels = bumps
    forest, in_bag = grown(bumps)
    off = np.linalg.norm(predict(forest, samples, in_bag) - labels, axis=1).mean()
    assert off < 0.5 * np.linalg.norm(labels - labels.mean(0), axis=1).mean()


def test_out_of_bag_predictions_use_only_trees_that_did_not_see_the_image(bumps):
    samples, _ = bumps
    forest, in_bag = grown(bumps, n_trees=1)
    assert in_bag.sum() == round(0.63 * len(samples))
    two = np.concatenate([in_bag, ~in_bag])
    doubled = replace(forest, roots=np.repeat(forest.roots, 2))
    np.testing.assert_allclose(predict(doubled, samples, two), predict(forest, samples), atol=1e-6)


def test_growth_does_not_depend_on_the_number_of_threads(bumps):
    forests = []
    for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
        numba.set_num_threads(threads)
        forests.append(grown(bumps)[0])
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    np.testing.assert_array_equal(forests[0].nodes, forests[1].nodes)
    np.testing.assert_array_equal(forests[0].leaves, forests[1].leaves)


def test_no_leaf_is_smaller_than_allowed(bumps):
    samples, _ = bumps
    forest, _ = grown(bumps, bag_share=1.0)
    for root in forest.roots[:1]:
        reached = [
            kernels.descend(
                forest.nodes, root, samples.heights[s], 1.0, samples.views[s], samples.scalars[s]
            )
            for s in range(len(samples))
        ]
        assert np.unique(reached, return_counts=True)[1].min() >= PLAN.min_leaf
