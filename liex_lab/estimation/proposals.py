"""Initial poses that are seen and not drawn: every tree of a forest says how the animal may lie,
from one look at it.

An animal that turns any side to the camera has no usual orientation to start from. Trees are asked
one by one and their answers never averaged: two orientations that look alike have no useful mean,
but both are worth a candidate.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.estimation import _feature_kernels as kernels
from liex_lab.estimation.cascade import ImageSet
from liex_lab.estimation.method import Method
from liex_lab.forests._kernels import VIEW
from liex_lab.forests.forest import Forest, Samples, predict_each
from liex_lab.forests.grow import grow_forest
from liex_lab.geometry import so3

Array = NDArray[np.float64]

N_WAYS = 2  # both ways along the animal's long axis
_SIZE_SD = 0.08  # how far off (log) a session's estimated size may be


def views_along_axis(
    images: ImageSet, size: Array, reach_mm: float
) -> tuple[Samples, Array, Array]:
    """Each of m animals as seen from its centre, x along its long axis, one way and the other.

    size (m,) over home size. Samples (2 m), an image's two in a row, and the frames: (2 m, 3, 3)
    and (2 m, 3) mm.
    """
    m = len(size)
    image = np.repeat(np.arange(m, dtype=np.int32), N_WAYS)
    moments = images.moments[image]
    heading = moments[:, 5] + np.pi * (np.arange(N_WAYS * m) % N_WAYS)
    turn = np.zeros((N_WAYS * m, 3))
    turn[:, 2] = heading
    rotation = so3.exp(turn)
    position = np.column_stack([moments[:, 3:5], moments[:, 2] / np.maximum(moments[:, 1], 1.0)])
    each = size[image]
    views = np.empty((N_WAYS * m, 1, VIEW), np.float32)
    scalars = np.empty((N_WAYS * m, kernels.N_SCALARS), np.float32)
    # which way is which: some foregrounds know where an animal's long axis points
    ways = (1000.0 - 2000.0 * (np.arange(N_WAYS * m) % N_WAYS)).astype(np.float32)
    kernels.look_all(
        np.zeros(1, np.int64),
        images.looks,
        images.moments,
        image,
        each,
        np.array([reach_mm]),
        rotation[:, None],
        position[:, None],
        each,
        views,
        scalars,
    )
    told = np.column_stack([scalars, ways])
    return (
        Samples(images.heights, image, (1.0 / each).astype(np.float32), views, told),
        rotation,
        position,
    )


def train_proposals(
    images: ImageSet,
    rotations: Array,
    positions: Array,
    size: Array,
    keep: NDArray[np.bool_],
    method: Method,
    rng: np.random.Generator,
) -> tuple[Forest, NDArray[np.bool_]]:
    """A forest from the true bases of m images, (m, 3, 3) and (m, 3) mm, and which images each tree
    saw (T, m).

    keep (m,): the images to learn from.
    """
    assert method.proposals is not None
    guess = size * np.exp(_SIZE_SD * rng.standard_normal(len(size)))
    samples, frame, centre = views_along_axis(images, guess, method.proposal_reach_mm)
    i = samples.image
    turned = np.swapaxes(frame, 1, 2) @ rotations[i]
    off = np.einsum("nji,nj->ni", frame, positions[i] - centre) / guess[i][:, None]
    labels = np.concatenate([method.base_lever_mm * turned.reshape(-1, 9), off], axis=1).astype(
        np.float32
    )
    forest, in_bag = grow_forest(samples, labels, keep[i], method.proposals, rng)
    return Forest(
        forest.nodes, forest.roots, forest.leaves.astype(np.float16).astype(np.float32)
    ), in_bag


def propose(forest: Forest, images: ImageSet, size: Array, method: Method) -> tuple[Array, Array]:
    """What every tree says of m animals from both sides: bases (m, 2 T, 3, 3) and (m, 2 T, 3) mm.

    Candidate 2 t + w is tree t's, with the axis taken in way w.
    """
    samples, frame, centre = views_along_axis(images, size, method.proposal_reach_mm)
    votes = predict_each(forest, samples).astype(float)
    turned = so3.nearest_rotation(votes[..., :9].reshape(*votes.shape[:2], 3, 3))
    rotation = frame[:, None] @ turned
    off = np.einsum("nij,ntj->nti", frame, votes[..., 9:]) * size[samples.image][:, None, None]
    position = centre[:, None] + off

    def in_order(values: Array) -> Array:
        by_way = values.reshape(len(size), N_WAYS, forest.n_trees, *values.shape[2:])
        return np.swapaxes(by_way, 1, 2).reshape(
            len(size), N_WAYS * forest.n_trees, *values.shape[2:]
        )

    return in_order(rotation), in_order(position)
