"""Random regression forest: all trees in one packed node array, and its prediction.

Lie-X section 4.4 (Breiman 2001; Criminisi and Shotton 2013). A sample descends every tree by binary
tests on pose-indexed depth features; each leaf stores the mean label of its training samples, and
the forest predicts the mean over trees,

    y(x) = 1/T sum_t leaf_t(x).

The paper uses the mean-shift mode of the trees' votes instead, see
`estimation._cascade_kernels.mode_of_votes`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from liex_lab.arrays import NDArray
from liex_lab.errors import refuse
from liex_lab.forests._kernels import ONE_PROBE, SCALAR, TWO_PROBES, VIEW, descend
from liex_lab.runtime.kernels import kernel
from liex_lab.runtime.memory import Rows, check_index, check_shapes
from liex_lab.runtime.processes import in_parallel


@dataclass(frozen=True)
class Forest:
    """Regression trees on pose-indexed tests, packed in one node array.

    Attributes:
        nodes: (n, 4) int32 packed nodes, see `_kernels`.
        roots: (T,) int32 index of each tree's root among the nodes.
        leaves: (n_leaves, D) float32 value of each leaf.
    """

    nodes: NDArray[np.int32]
    roots: NDArray[np.int32]
    leaves: NDArray[np.float32]

    @cached_property
    def reads(self) -> tuple[int, int]:
        """Number of views and of scalars of a sample that its tests read."""
        tests = self.nodes[self.nodes[:, 2] >= 0, 3]
        scalar = (tests & 3) == SCALAR
        n_views, n_scalars = (
            int(tests.max(where=each, initial=-1) >> 2) + 1 for each in (~scalar, scalar)
        )
        return n_views, n_scalars

    @property
    def n_trees(self) -> int:
        """Number of trees."""
        return len(self.roots)

    def quantised(self) -> "Forest":
        """The forest with leaves rounded to float16, the precision of the model file, so that
        training uses the same forest as estimation.
        """
        leaves = self.leaves.astype(np.float16).astype(np.float32)
        return Forest(self.nodes, self.roots, leaves)

    @staticmethod
    def join(forests: "list[Forest]") -> "Forest":
        """Join forests, with equally many values per leaf, into one of all their trees; its
        prediction is the mean over all the trees.
        """
        n_nodes, n_leaves = np.array([(len(one.nodes), len(one.leaves)) for one in forests]).T
        first_node = np.cumsum(n_nodes) - n_nodes
        first_leaf = np.cumsum(n_leaves) - n_leaves
        nodes = np.concatenate([forest.nodes for forest in forests])
        shift = (np.repeat(first, n_nodes) for first in (first_node, -first_leaf))
        nodes[:, 2] += np.where(nodes[:, 2] >= 0, *shift).astype(np.int32)
        roots = [forest.roots + first for forest, first in zip(forests, first_node, strict=True)]
        return Forest(
            nodes,
            np.concatenate(roots).astype(np.int32),
            np.concatenate([forest.leaves for forest in forests]),
        )


def check_roots(roots: NDArray[Any], is_leaf: NDArray[np.bool_]) -> None:
    """Check the roots of trees whose nodes are stored tree by tree in the order of growth.

    `_kernels.number_nodes` does not check its indices, so this has to run before it: a binary tree
    of m leaves has m - 1 other nodes.

    Args:
        roots: (T,) index of each tree's root.
        is_leaf: (n,) which nodes are leaves.

    Raises:
        ValueError: the error, as a part of a sentence.
    """
    n = len(is_leaf)
    if roots.ndim != 1 or roots.dtype.kind != "i" or not len(roots):
        raise ValueError("its roots are not a list of integers")
    starts = np.append(roots.astype(np.int64), n)
    if starts[0] != 0 or not (np.diff(starts) > 0).all():
        raise ValueError(f"its roots do not rise from 0 to its {n} nodes")
    leaves = np.add.reduceat(is_leaf, roots.astype(np.int64), dtype=np.int64)
    if not np.array_equal(2 * leaves - 1, np.diff(starts)):
        raise ValueError("its nodes do not form complete trees")


def check_forest(forest: Forest, n_views: int, n_scalars: int, n_values: int) -> None:
    """Check every index in a forest from a file, before a kernel follows it.

    Children are stored after their parent, so that each descent ends.

    Args:
        forest: the forest.
        n_views: views of its samples.
        n_scalars: scalars of its samples.
        n_values: values of a leaf.

    Raises:
        ValueError: the error, as a part of a sentence.
    """
    nodes = forest.nodes
    roots = forest.roots
    leaves = forest.leaves
    shapes = nodes.shape[1:] == (4,) and roots.ndim == 1 and leaves.ndim == 2
    kinds = nodes.dtype == np.int32 and roots.dtype == np.int32 and leaves.dtype == np.float32
    if not (shapes and kinds):
        raise ValueError("its nodes, roots and leaves are not of the right kind")
    refuse(
        ValueError,
        (leaves.shape[1] != n_values, f"its leaves have {leaves.shape[1]} values, not {n_values}"),
        (
            not (leaves.size and np.isfinite(leaves.min()) and np.isfinite(leaves.max())),
            "its leaves are not all finite",
        ),
        (
            not len(roots) or roots.min() < 0 or roots.max() >= len(nodes),
            f"a root is not one of its {len(nodes)} nodes",
        ),
    )
    word2 = np.ascontiguousarray(nodes[:, 2])
    at = np.flatnonzero(word2 >= 0)
    child = word2[at]
    refuse(
        ValueError,
        (
            (child <= at).any() or child.max(initial=-1) >= len(nodes) - 1,
            "a child does not follow its parent among the nodes",
        ),
        (
            -1 - int(word2.min()) >= len(leaves),
            f"a node names a leaf beyond the {len(leaves)} there are",
        ),
    )
    tests = nodes[at, 3]
    kind = tests & 3
    if kind.max(initial=0) > max(TWO_PROBES, ONE_PROBE, SCALAR):
        raise ValueError("a test is of an unknown kind")
    scalar = kind == SCALAR
    most = [tests.max(where=each, initial=-1) >> 2 for each in (~scalar, scalar)]
    if tests.min(initial=0) < 0 or most[0] >= n_views or most[1] >= n_scalars:
        raise ValueError(
            f"a test reads more than the {n_views} views and {n_scalars} scalars there are"
        )


def check_samples(forest: Forest, samples: "Samples") -> None:
    """Check that samples contain all that the tests of a forest read.

    Args:
        forest: the forest.
        samples: its input.

    Raises:
        ValueError: the samples have fewer views or scalars than a test reads.
    """
    n_views, n_scalars = forest.reads
    width = samples.views.shape[1], samples.scalars.shape[1]
    if width[0] < n_views or width[1] < n_scalars:
        raise ValueError(
            f"the forest reads {n_views} views and {n_scalars} scalars, but its samples have "
            f"{width[0]} and {width[1]}; use samples of the kind that it was trained on"
        )


@dataclass(frozen=True)
class Samples(Rows):
    """Input of a forest in training or prediction: n samples on a set of height maps.

    Attributes:
        heights: (n_images, S, S) int16 height maps, 1/16 mm, 0 outside the animal.
        image: (n,) int32 index of each sample's height map.
        inverse_size: (n,) float32 home size over the animal's size.
        views: (n, V, 9) float32 linearised projections of the sample's V joints, see `_kernels`.
        scalars: (n, n_scalars) float32 numbers that describe the whole animal.
    """

    SHARED = ("heights",)
    heights: NDArray[np.int16]
    image: NDArray[np.int32]
    inverse_size: NDArray[np.float32]
    views: NDArray[np.float32]
    scalars: NDArray[np.float32]

    def __post_init__(self) -> None:
        """Check that the shapes match, as kernels do not."""
        check_shapes(
            "samples",
            ("heights", self.heights, ("images", "S", "S")),
            ("image", self.image, ("n",)),
            ("inverse_size", self.inverse_size, ("n",)),
            ("views", self.views, ("n", "V", VIEW)),
            ("scalars", self.scalars, ("n", "n_scalars")),
        )
        check_index("height maps", self.image, len(self.heights))

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.image)


def predict(
    forest: Forest, samples: Samples, in_bag: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """Mean leaf value of each sample.

    Args:
        forest: the forest.
        samples: n samples.
        in_bag: (T, n_images) bool, the images each tree was grown on. Trees grown on a sample's
            image are excluded (out-of-bag prediction), unless all of them were: predictions on
            training images are otherwise too good to train a next stage on. None uses all trees.

    Returns:
        (n, D) float32 predictions.
    """
    check_samples(forest, samples)
    out = np.zeros((len(samples), forest.leaves.shape[1]), np.float32)
    bag = np.zeros((forest.n_trees, 1), np.bool_) if in_bag is None else in_bag
    if in_bag is not None:
        check_shapes("a forest", ("in_bag", bag, (forest.n_trees, len(samples.heights))))
    in_parallel(
        _predict,
        len(samples),
        forest.nodes,
        forest.roots,
        forest.leaves,
        samples.heights,
        samples.image,
        samples.inverse_size,
        samples.views,
        samples.scalars,
        bag,
        out,
    )
    return out


def predict_each(forest: Forest, samples: Samples) -> NDArray[np.float32]:
    """Leaf value of each tree for each sample.

    Args:
        forest: the forest.
        samples: n samples.

    Returns:
        (n, T, D) float32, the votes of the single trees.
    """
    check_samples(forest, samples)
    out = np.empty((len(samples), forest.n_trees, forest.leaves.shape[1]), np.float32)
    in_parallel(
        _predict_each,
        len(samples),
        forest.nodes,
        forest.roots,
        forest.leaves,
        samples.heights,
        samples.image,
        samples.inverse_size,
        samples.views,
        samples.scalars,
        out,
    )
    return out


@kernel(nogil=True)
def _predict_each(
    nodes, roots, leaves, heights, image, inverse_size, views, scalars, out, start, stop
):
    for s in range(start, stop):
        for t in range(roots.size):
            leaf = descend(
                nodes, roots[t], heights[image[s]], inverse_size[s], views[s], scalars[s]
            )
            out[s, t] = leaves[leaf]


@kernel(nogil=True)
def _predict(
    nodes, roots, leaves, heights, image, inverse_size, views, scalars, in_bag, out, start, stop
):
    n_trees = roots.size
    n_values = leaves.shape[1]
    for s in range(start, stop):
        i = image[s]
        column = i if in_bag.shape[1] > 1 else 0
        n_used = 0
        for t in range(n_trees):
            n_used += not in_bag[t, column]
        use_all = n_used == 0
        for t in range(n_trees):
            if use_all or not in_bag[t, column]:
                leaf = descend(nodes, roots[t], heights[i], inverse_size[s], views[s], scalars[s])
                for d in range(n_values):
                    out[s, d] += leaves[leaf, d]
        for d in range(n_values):
            out[s, d] /= n_trees if use_all else n_used
