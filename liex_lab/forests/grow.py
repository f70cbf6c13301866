"""Growth of regression trees by variance reduction, and stochastic gradient boosting of them.

Lie-X section 4.4, Eq. 16 and 17. At each node m random tests with evenly spread thresholds are
tried, and the one with the largest gain is kept:

    I = E(S) - |S_l|/|S| E(S_l) - |S_r|/|S| E(S_r),   E(S) = 1/|S| sum_i |y_i - mean(S)|^2

(plain variance reduction; the paper's E is a sum). All tests are ranked on a small subsample of the
node, and the best few again on a larger one. Bagging is by image, without replacement, so that
out-of-bag predictions are independent of the image. `boost_forest` grows pairs of trees on the
residuals of those before them (Friedman, Stochastic gradient boosting, 2002).
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from liex_lab.forests._kernels import (
    ONE_PROBE,
    SCALAR,
    TWO_PROBES,
    next_random,
    pack_offsets,
    random_below,
    response,
)
from liex_lab.forests.forest import Forest, Samples, predict
from liex_lab.runtime.kernels import inner_kernel, kernel
from liex_lab.runtime.memory import check_shapes
from liex_lab.runtime.processes import in_parallel

_N_THRESHOLDS = 20
_TREES_A_STAGE = 2
# samples of the first and second ranking; tests that reach the second
_N_FIRST = 96
_N_SECOND = 1500
_N_KEPT = 12


class GrowthPlan(NamedTuple):
    """Settings of tree growth.

    Shares are of the tests that are tried at a node; the rest compare two probes (Eq. 15).

    Attributes:
        n_trees: number of trees.
        max_depth: deepest level of a leaf, the root being 0.
        min_leaf: fewest samples of a leaf.
        n_tests: random tests that are tried at a node of 128 samples or more; fewer at smaller
            ones.
        one_probe_share: share of tests that compare one probe with the joint's own height.
        scalar_share: share of tests on a number that describes the whole animal.
        depth_share: range of offsets along the joint's z axis, relative to that across it.
        bag_share: share of the images used by a tree, drawn without replacement, all samples of an
            image together (1: every tree uses all).
        max_leaf: most samples of a leaf above the deepest level: a node with more is split by any
            test that separates it; 0 for no limit.
    """

    n_trees: int
    max_depth: int
    min_leaf: int
    n_tests: int
    one_probe_share: float
    scalar_share: float
    depth_share: float
    bag_share: float
    max_leaf: int = 0


class _SampleArrays(NamedTuple):
    """`Samples` and their labels (N, D) for the kernels."""

    heights: Any
    image: Any
    inverse_size: Any
    views: Any
    scalars: Any
    labels: Any


class _Scratch(NamedTuple):
    """Buffers for the samples that tests are tried on: their rows, responses and running sums."""

    chosen: Any
    labels: Any
    tests: Any
    first: Any
    kept: Any
    second: Any
    sums: Any


def grow_forest(
    samples: Samples,
    labels: NDArray[np.float32],
    keep: NDArray[np.bool_],
    plan: GrowthPlan,
    rng: np.random.Generator,
) -> tuple[Forest, NDArray[np.bool_]]:
    """Grow a bagged regression forest.

    Trees grow in parallel from seeds drawn in advance, so the forest does not depend on the number
    of threads.

    Args:
        samples: n samples with their features.
        labels: (n, D) float32 labels, of the same unit in every component.
        keep: (n,) bool, the samples to learn from.
        plan: size of the forest and its tests.
        rng: source of the bags and of the trees' seeds.

    Returns:
        The forest, and (T, n_images) bool, the images each tree was grown on.
    """
    n_images = len(samples.heights)
    n = len(samples)
    check_shapes("a forest's growth", ("labels", labels, (n, "D")), ("keep", keep, (n,)))
    in_bag = np.zeros((plan.n_trees, n_images), np.bool_)
    for bag in in_bag:
        bag[rng.permutation(n_images)[: max(1, round(plan.bag_share * n_images))]] = True
    members = [np.flatnonzero(keep & bag[samples.image]).astype(np.int32) for bag in in_bag]
    starts = np.cumsum([0, *(len(m) for m in members)], dtype=np.int64)
    order = np.concatenate(members)
    capacity = max(1, max(len(m) for m in members) // max(1, plan.min_leaf)) + 1
    nodes = np.zeros((plan.n_trees, 2 * capacity + 1, 4), np.int32)
    leaves = np.zeros((plan.n_trees, capacity + 1, labels.shape[1]), np.float32)
    counts = np.zeros((plan.n_trees, 2), np.int64)
    seeds = rng.integers(0, 2**63, plan.n_trees, dtype=np.uint64)
    in_parallel(
        _grow_trees,
        plan.n_trees,
        _SampleArrays(
            samples.heights,
            samples.image,
            samples.inverse_size,
            samples.views,
            samples.scalars,
            labels,
        ),
        plan,
        order,
        starts,
        seeds,
        nodes,
        leaves,
        counts,
    )
    root = np.zeros(1, np.int32)
    trees = [
        Forest(nodes[t, :n_nodes], root, leaves[t, :n_leaves])
        for t, (n_nodes, n_leaves) in enumerate(counts)
    ]
    return Forest.join(trees), in_bag


def boost_forest(
    samples: Samples,
    labels: NDArray[np.float32],
    plan: GrowthPlan,
    shrinkage: float,
    rng: np.random.Generator,
) -> Forest:
    """Grow a forest by stochastic gradient boosting of the squared error.

    Each pair of trees is grown in parallel, on different bags of images, on the residuals of the
    pairs before it (Friedman 2002, with two trees per stage); the last of an odd number of trees is
    a stage by itself. Leaves are scaled so that the mean over trees, which is the prediction of
    every forest, is the boosted sum.

    Args:
        samples: n samples with their features, all used for training.
        labels: (n, D) float32 labels.
        plan: size of the forest; n_trees counts all stages.
        shrinkage: share of a pair's prediction that is subtracted from the residuals, in (0, 1].
        rng: source of the bags and of the trees' seeds.

    Returns:
        The forest of all stages.
    """
    mean = labels.mean(axis=0)
    left = (labels - mean).astype(np.float32)
    everything = np.ones(len(labels), np.bool_)
    trees = []
    for first in range(0, plan.n_trees, _TREES_A_STAGE):
        n = min(_TREES_A_STAGE, plan.n_trees - first)
        stage, _ = grow_forest(samples, left, everything, plan._replace(n_trees=n), rng)
        left -= shrinkage * predict(stage, samples)
        # the mean over all trees weights this stage's with n / n_trees
        share = np.float32(shrinkage * (plan.n_trees / n))
        trees.append(Forest(stage.nodes, stage.roots, stage.leaves * share + mean))
    return Forest.join(trees)


@kernel(nogil=True)
def _grow_trees(samples, growth, order, starts, seeds, nodes, leaves, counts, start, stop):
    """Grow some trees: tree t on the samples order[starts[t] : starts[t + 1]]."""
    for t in range(start, stop):
        _grow_tree(
            samples,
            growth,
            order[starts[t] : starts[t + 1]],
            seeds[t],
            nodes[t],
            leaves[t],
            counts[t],
        )


@inner_kernel()
def _draw_test(state, n_views, n_scalars, growth, test):
    """A random test into `test` (3,) int32: words 0, 1 and 3 of a node, threshold still 0."""
    kind_draw = (next_random(state) >> np.uint64(11)) * (1.0 / 9007199254740992.0)
    kind = TWO_PROBES
    channel = random_below(state, n_views)
    if kind_draw < growth.scalar_share and n_scalars > 0:
        kind = SCALAR
        channel = random_below(state, n_scalars)
    elif kind_draw < growth.scalar_share + growth.one_probe_share:
        kind = ONE_PROBE
    u = np.empty(3, np.int64)
    v = np.empty(3, np.int64)
    deep = max(1, int(127 * growth.depth_share))
    for k in range(3):
        reach = deep if k == 2 else 127
        u[k] = random_below(state, 2 * reach + 1) - reach
        v[k] = random_below(state, 2 * reach + 1) - reach
    test[0], test[1] = pack_offsets(u, v, 0)
    test[2] = kind + 4 * channel


@inner_kernel()
def _best_threshold(values, n, labels, min_share, sums, result):
    """Best of evenly spread thresholds for the responses of a node's samples: gain and threshold.

    Plain variance reduction (Eq. 16 with Eq. 17 as a mean): up to a constant, |sum_left|^2 / n_left
    + |sum_right|^2 / n_right.

    Args:
        values: (n,) responses of the samples to a test, the first n of which count.
        n: number of samples.
        labels: (n, D) labels of the samples, likewise.
        min_share: smallest share of the samples that may go to one side.
        sums: (thresholds + 1, D + 1) scratch: running sums of labels and counts.
        result: (2,) filled with the gain, -1 if absent, and the threshold.
    """
    result[0] = -1.0
    result[1] = 0.0
    low = values[0]
    high = values[0]
    for i in range(1, n):
        low = min(low, values[i])
        high = max(high, values[i])
    if not high - low >= 1.0:
        return
    n_labels = labels.shape[1]
    for b in range(_N_THRESHOLDS + 1):
        sums[b, n_labels] = 0.0
    scale = _N_THRESHOLDS / (high - low)
    for i in range(n):
        b = int((values[i] - low) * scale + 0.5)
        if sums[b, n_labels] == 0.0:
            for d in range(n_labels):
                sums[b, d] = 0.0
        sums[b, n_labels] += 1.0
        for d in range(n_labels):
            sums[b, d] += labels[i, d]
    # thresholds with no sample between them split alike: the first represents all
    before = -1
    for b in range(_N_THRESHOLDS + 1):
        if sums[b, n_labels] == 0.0:
            continue
        if before >= 0:
            for d in range(n_labels + 1):
                sums[b, d] += sums[before, d]
        before = b
    total = sums[before]
    least = max(1.0, min_share * n)
    for b in range(before):
        n_left = sums[b, n_labels]
        n_right = total[n_labels] - n_left
        if n_left < least or n_right < least:
            continue
        gain = 0.0
        for d in range(n_labels):
            right = total[d] - sums[b, d]
            gain += sums[b, d] * sums[b, d] / n_left + right * right / n_right
        if gain > result[0]:
            result[0] = gain
            result[1] = low + (b + 0.5) / scale


@inner_kernel()
def _response(samples, s, test):
    """The response of sample s to a test, words 0, 1 and 3 of a node."""
    return response(
        samples.heights[samples.image[s]],
        samples.inverse_size[s],
        samples.views[s],
        samples.scalars[s],
        test[0],
        test[1],
        test[2],
    )


@inner_kernel()
def _respond(samples, n, tests, scratch, values):
    """Responses (tests, n) and labels of the first n of the chosen samples, sample by sample.

    A sample's height map is loaded from memory once for all tests; test by test it would be evicted
    from the cache each time.
    """
    for i in range(n):
        s = scratch.chosen[i]
        scratch.labels[i] = samples.labels[s]
        heights = samples.heights[samples.image[s]]
        inverse_size = samples.inverse_size[s]
        views = samples.views[s]
        scalars = samples.scalars[s]
        for k in range(len(tests)):
            test = tests[k]
            values[k, i] = response(
                heights, inverse_size, views, scalars, test[0], test[1], test[2]
            )


@inner_kernel()
def _find_split(samples, growth, members, state, scratch, best):
    """Find the test of a node.

    All tests are ranked on at most 96 of the node's samples, the best 12 of them again on at most
    1500. Writes words 0, 1 and 3 of the node and the threshold into best (4,); returns False if no
    test separates the samples.
    """
    n = members.size
    n_tests = growth.n_tests
    n_tried = n_tests if n >= 128 else min(n_tests, max(20, n_tests * n // 128))
    chosen = scratch.chosen
    least_share = growth.min_leaf / n
    n_first = min(n, _N_FIRST)
    for i in range(n_first):
        chosen[i] = members[i] if n <= _N_FIRST else members[random_below(state, n)]
    tests = scratch.tests[:n_tried]
    gains = np.empty(n_tried)
    thresholds = np.empty(n_tried)
    result = np.empty(2)
    for k in range(n_tried):
        _draw_test(state, samples.views.shape[1], samples.scalars.shape[1], growth, tests[k])
    _respond(samples, n_first, tests, scratch, scratch.first)
    for k in range(n_tried):
        _best_threshold(
            scratch.first[k], n_first, scratch.labels, least_share, scratch.sums, result
        )
        gains[k] = -result[0]
        thresholds[k] = result[1]
    ranked = np.argsort(gains)
    if n <= _N_FIRST:  # all of the node's samples were used
        k = ranked[0]
        if gains[k] > 0.0:
            return False
        _keep(tests[k], thresholds[k], best)
        return True
    n_second = min(n, _N_SECOND)
    for i in range(n_second):
        chosen[i] = members[i] if n <= _N_SECOND else members[random_below(state, n)]
    found = False
    best_gain = -1.0
    n_kept = 0
    for r in range(min(_N_KEPT, n_tried)):
        if gains[ranked[r]] > 0.0:
            break
        scratch.kept[r] = tests[ranked[r]]
        n_kept += 1
    kept = scratch.kept[:n_kept]
    _respond(samples, n_second, kept, scratch, scratch.second)
    for k in range(n_kept):
        _best_threshold(
            scratch.second[k], n_second, scratch.labels, least_share, scratch.sums, result
        )
        if result[0] > best_gain:
            found = True
            best_gain = result[0]
            _keep(kept[k], result[1], best)
    return found


@kernel()
def _keep(test, threshold, best):
    """Write a test (3,) and its threshold into `best` (4,), in the layout of a node."""
    best[0] = test[0]
    best[1] = test[1]
    best[2] = test[2]
    best[3] = min(max(int(np.ceil(threshold)), -32768), 32767)


@kernel()
def _part(samples, members, best):
    """Partition `members` in place so that those that go left are first; returns their number."""
    left = 0
    right = members.size - 1
    while left <= right:
        if _response(samples, members[left], best) >= best[3]:
            members[left], members[right] = members[right], members[left]
            right -= 1
        else:
            left += 1
    return left


@inner_kernel()
def _grow_tree(samples, growth, members, seed, nodes, leaves, counts):
    """Grow one tree on the samples `members` into nodes and leaves, depth first.

    counts (2,) receives the numbers of nodes and leaves. `members` is reordered.
    """
    state = np.empty(1, np.uint64)
    state[0] = seed
    labels = samples.labels
    min_leaf = growth.min_leaf
    n_labels = labels.shape[1]
    scratch = _Scratch(
        np.empty(max(_N_FIRST, _N_SECOND), np.int32),
        np.empty((max(_N_FIRST, _N_SECOND), n_labels), np.float32),
        np.empty((growth.n_tests, 3), np.int32),
        np.empty((growth.n_tests, _N_FIRST), np.float32),
        np.empty((_N_KEPT, 3), np.int32),
        np.empty((_N_KEPT, _N_SECOND), np.float32),
        np.empty((_N_THRESHOLDS + 1, n_labels + 1)),
    )
    best = np.empty(4, np.int32)
    # node, first member, past the last, depth
    stack = np.zeros((4 * growth.max_depth + 8, 4), np.int64)
    stack[0, 2] = members.size
    top = 1
    n_nodes = 1
    n_leaves = 0
    while top > 0:
        top -= 1
        node = stack[top, 0]
        first = stack[top, 1]
        stop = stack[top, 2]
        depth = stack[top, 3]
        here = members[first:stop]
        middle = 0
        if (
            here.size >= max(2 * min_leaf, growth.max_leaf + 1)
            and depth < growth.max_depth
            and _find_split(samples, growth, here, state, scratch, best)
        ):
            middle = _part(samples, here, best)
            if middle < min_leaf or here.size - middle < min_leaf:
                middle = 0
        if middle == 0:
            for d in range(n_labels):
                total = 0.0
                for i in range(here.size):
                    total += labels[here[i], d]
                leaves[n_leaves, d] = total / max(1, here.size)
            nodes[node, 2] = -n_leaves - 1
            n_leaves += 1
            continue
        nodes[node, 0] = best[0]
        nodes[node, 1] = (best[1] & 0xFFFF) | (best[3] << 16)
        nodes[node, 2] = n_nodes
        nodes[node, 3] = best[2]
        for side in (1, 0):  # the left child is grown first
            stack[top, 0] = n_nodes + side
            stack[top, 1] = first + middle * side
            stack[top, 2] = stop if side else first + middle
            stack[top, 3] = depth + 1
            top += 1
        n_nodes += 2
    counts[0] = n_nodes
    counts[1] = n_leaves
