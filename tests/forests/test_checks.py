"""A forest from a file is checked before a kernel follows it: every index that is wrong is
refused.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from liex_lab.forests._kernels import ONE_PROBE, SCALAR, VIEW, number_nodes
from liex_lab.forests.forest import (
    Forest,
    Samples,
    check_forest,
    check_roots,
    predict,
    predict_each,
)

N_VIEWS, N_SCALARS, N_VALUES = 2, 3, 2
IS_LEAF = np.array([False, False, True, True, True, False, True, True])  # trees of 5 and 3 nodes
ROOTS = np.array([0, 5], np.int32)
INNER = np.flatnonzero(~IS_LEAF)


def small() -> Forest:
    """Two small trees, numbered as a model file is."""
    nodes = np.zeros((len(IS_LEAF), 4), np.int32)
    nodes[INNER, 3] = [0 + 4 * 1, ONE_PROBE, SCALAR + 4 * 2]
    number_nodes(IS_LEAF, np.append(ROOTS, len(IS_LEAF)).astype(np.int64), nodes)
    return Forest(nodes, ROOTS, np.arange(10, dtype=np.float32).reshape(5, 2))


def check(forest: Forest) -> None:
    check_forest(forest, N_VIEWS, N_SCALARS, N_VALUES)


def with_node(row: int, word: int, value: int) -> Forest:
    """The small forest with one word of one node replaced."""
    forest = small()
    nodes = forest.nodes.copy()
    nodes[row, word] = value
    return replace(forest, nodes=nodes)


def test_a_sound_forest_passes():
    check_roots(ROOTS, IS_LEAF)
    check(small())


def test_roots_that_do_not_begin_whole_trees_are_refused():
    wrong = [
        np.array(roots, np.int32)
        for first in (-1, 1, 4, 2**30, -(2**31))
        for second in (-1, 0, 4, 6, 8, 2**30, -(2**31))
        for roots in ([first, 5], [0, second], [first, second])
    ]
    wrong += [np.zeros(0, np.int32), np.zeros((1, 1), np.int32), np.array([0.0, 5.0]), ROOTS[:1]]
    for roots in wrong:
        with pytest.raises(ValueError, match=r"roots|complete trees"):
            check_roots(roots, IS_LEAF)


def test_every_wrong_index_is_refused():
    beyond = (2**30, 2**31 - 1)
    wrong = [(replace(small(), roots=np.array([root, 5], np.int32)), "root") for root in (-1, 8)]
    wrong += [(replace(small(), roots=np.array([0, root], np.int32)), "root") for root in beyond]
    # back, onto itself, or past the last: a descent would read elsewhere or never end
    wrong += [
        (with_node(row, 2, child), "child")
        for row in INNER.tolist()
        for child in (0, row - 1, row, len(IS_LEAF) - 1, len(IS_LEAF), *beyond)
        if child >= 0
    ]
    wrong += [
        (with_node(row, 2, -leaf - 1), "leaf")
        for row in np.flatnonzero(IS_LEAF).tolist()
        for leaf in (5, 6, *beyond)
    ]
    tests = [3, 0 + 4 * N_VIEWS, ONE_PROBE + 4 * N_VIEWS, SCALAR + 4 * N_SCALARS, 4 * (2**28)]
    tests += [-1, -4, ONE_PROBE - 4, SCALAR - 4, -(2**31)]
    wrong += [(with_node(row, 3, test), "test") for row in INNER.tolist() for test in tests]
    circle = small().nodes.copy()
    circle[[0, 1], 2] = 1, 0
    wrong.append((replace(small(), nodes=circle), "child"))
    for forest, says in wrong:
        with pytest.raises(ValueError, match=says):
            check(forest)


def test_leaves_of_another_width_or_not_finite_are_refused():
    forest = small()
    for leaves in (forest.leaves[:, :1], forest.leaves * np.float32(np.nan), forest.leaves.ravel()):
        with pytest.raises(ValueError, match="leaves"):
            check(replace(forest, leaves=leaves))
    with pytest.raises(ValueError, match="right kind"):
        check(replace(forest, nodes=forest.nodes.astype(np.int64)))


@given(st.integers(0, len(IS_LEAF) - 1), st.integers(2, 3), st.integers(-(2**31), 2**31 - 1))
def test_whatever_passes_leads_from_every_root_to_a_leaf(row, word, value):
    """Any single number may be wrong: what passes walks within its arrays, and ends."""
    forest = with_node(row, word, value)
    try:
        check(forest)
    except ValueError:
        return
    waiting = [(int(root), 0) for root in forest.roots]
    while waiting:
        at, depth = waiting.pop()
        assert 0 <= at < len(forest.nodes)
        assert depth < len(forest.nodes)
        child = int(forest.nodes[at, 2])
        if child < 0:
            assert -child - 1 < len(forest.leaves)
            continue
        kind, channel = forest.nodes[at, 3] & 3, forest.nodes[at, 3] >> 2
        assert 0 <= channel < (N_SCALARS if kind == SCALAR else N_VIEWS)
        waiting += [(child, depth + 1), (child + 1, depth + 1)]


def asked(n_views: int, n_scalars: int) -> Samples:
    """Two samples of a blank picture."""
    return Samples(
        np.zeros((1, 4, 4), np.int16),
        np.zeros(2, np.int32),
        np.ones(2, np.float32),
        np.zeros((2, n_views, VIEW), np.float32),
        np.zeros((2, n_scalars), np.float32),
    )


def test_samples_narrower_than_a_test_reads_are_refused():
    forest = small()
    assert forest.reads == (N_VIEWS, N_SCALARS)
    for answer in (predict, predict_each):
        assert np.isfinite(answer(forest, asked(N_VIEWS, N_SCALARS))).all()
        for n_views, n_scalars in ((N_VIEWS - 1, N_SCALARS), (N_VIEWS, N_SCALARS - 1)):
            with pytest.raises(ValueError, match="reads 2 views and 3 scalars, but its samples"):
                answer(forest, asked(n_views, n_scalars))
    with pytest.raises(ValueError, match="in_bag"):
        predict(forest, asked(N_VIEWS, N_SCALARS), np.zeros((2, 5), np.bool_))


@pytest.mark.parametrize(
    "other",
    [
        {"image": np.ones(2, np.int32)},
        {"image": np.zeros(3, np.int32)},
        {"views": np.zeros((2, 1, VIEW - 1), np.float32)},
        {"scalars": np.zeros(2, np.float32)},
        {"inverse_size": np.ones(1, np.float32)},
        {"heights": np.zeros((4, 4), np.int16)},
    ],
)
def test_samples_that_do_not_fit_together_are_refused(other):
    with pytest.raises(ValueError, match=r"should (have the shape|be 0 to)"):
        replace(asked(N_VIEWS, N_SCALARS), **other)
