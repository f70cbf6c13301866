"""A forest: all its trees in one packed array, and what it predicts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from liex_lab.forests._kernels import descend

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Forest:
    """Trees on pose-indexed tests. nodes (n, 4) int32, see `_kernels`; roots (T,); leaves
    (n_leaves, D) float32.
    """

    nodes: NDArray[np.int32]
    roots: NDArray[np.int32]
    leaves: NDArray[np.float32]

    @property
    def n_trees(self) -> int:
        """Number of trees."""
        return len(self.roots)

    @staticmethod
    def pack(trees: list[tuple[NDArray[np.int32], NDArray[np.float32]]]) -> Forest:
        """One forest from trees given as (nodes, leaves), each with its root at 0."""
        return Forest.join(
            [Forest(nodes, np.zeros(1, np.int32), leaves) for nodes, leaves in trees]
        )

    @staticmethod
    def join(forests: list[Forest]) -> Forest:
        """One forest of all the trees of several."""
        nodes = []
        roots = []
        leaves = []
        n_nodes = n_leaves = 0
        for forest in forests:
            shifted = forest.nodes.copy()
            inner = shifted[:, 2] >= 0
            shifted[inner, 2] += n_nodes
            shifted[~inner, 2] -= n_leaves
            nodes.append(shifted)
            leaves.append(forest.leaves)
            roots.append(forest.roots + n_nodes)
            n_nodes += len(forest.nodes)
            n_leaves += len(forest.leaves)
        return Forest(
            np.concatenate(nodes), np.concatenate(roots).astype(np.int32), np.concatenate(leaves)
        )


@dataclass(frozen=True)
class Samples:
    """What a forest is trained on or asked about: n samples on a set of height maps.

    heights (n_images, S, S) int16; image (n,) int32 index of each sample's map; inverse_size (n,)
    float32 home size over the animal's size; views (n, V, 9) float32; scalars (n, n_scalars)
    float32.
    """

    heights: NDArray[np.int16]
    image: NDArray[np.int32]
    inverse_size: NDArray[np.float32]
    views: NDArray[np.float32]
    scalars: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.image)

    def __getitem__(self, index: NDArray[np.int64]) -> Samples:
        """Some of the samples, on the same maps."""
        return Samples(
            self.heights,
            self.image[index],
            self.inverse_size[index],
            self.views[index],
            self.scalars[index],
        )

    @staticmethod
    def join(parts: list[Samples]) -> Samples:
        """The samples of several sets on the same maps, one after the other."""
        fields = ("image", "inverse_size", "views", "scalars")
        return Samples(
            parts[0].heights,
            *(np.concatenate([getattr(p, name) for p in parts]) for name in fields),
        )


def predict(
    forest: Forest, samples: Samples, in_bag: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """Mean leaf value (n, D) of each sample.

    in_bag (T, n_images): trees that have seen a sample's image are left out, unless all have
    (METHOD lesson 6).
    """
    out = np.zeros((len(samples), forest.leaves.shape[1]), np.float32)
    bag = np.zeros((forest.n_trees, 1), np.bool_) if in_bag is None else in_bag
    _predict(
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
    """Every tree's own leaf value (n, T, D) of each sample."""
    out = np.empty((len(samples), forest.n_trees, forest.leaves.shape[1]), np.float32)
    _predict_each(
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


@njit(cache=True, parallel=True)
def _predict_each(nodes, roots, leaves, heights, image, inverse_size, views, scalars, out):
    for s in prange(image.size):
        for t in range(roots.size):
            leaf = descend(
                nodes, roots[t], heights[image[s]], inverse_size[s], views[s], scalars[s]
            )
            out[s, t] = leaves[leaf]


@njit(cache=True, parallel=True)
def _predict(nodes, roots, leaves, heights, image, inverse_size, views, scalars, in_bag, out):
    n_trees = roots.size
    n_values = leaves.shape[1]
    for s in prange(image.size):
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
