"""Initial poses proposed by a regression forest, for an animal of any orientation (ours).

An animal that turns any side to the camera has no usual orientation to start from. One forest
regresses the base's rotation matrix and position from a view along the principal axis of the
foreground. Each tree's vote, projected onto SO(3) (orthogonal Procrustes), is one initial pose of
Lie-X Algorithm 1. Votes are never averaged: two orientations that look alike have no useful mean,
but both are worth a candidate.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.estimation import _feature_kernels as kernels
from liex_lab.estimation.cascade import ImageSet
from liex_lab.estimation.method import Method
from liex_lab.foreground.height_maps import moment_columns
from liex_lab.forests._kernels import VIEW
from liex_lab.forests.forest import Forest, Samples, predict_each
from liex_lab.forests.grow import grow_forest
from liex_lab.geometry import so3
from liex_lab.runtime.shapes import check_shapes

Array = NDArray[np.float64]

N_WAYS = 2  # both ways along the animal's long axis
_SIZE_SD = 0.08  # how far off (log) a session's estimated size may be


def views_along_axis(
    images: ImageSet, size: Array, reach_mm: float
) -> tuple[Samples, Array, Array]:
    """Features of each animal from its centre, with x along its long axis in both directions.

    Args:
        images: m images.
        size: (m,) the animals' size over home size.
        reach_mm: offsets reach this far from the centre, mm at home size.

    Returns:
        2 m samples, an image's two in a row, and the frames they are taken in: rotations (2 m, 3,
        3) and centres (2 m, 3) mm, view frame.
    """
    m = len(images.heights)
    check_shapes("proposals", ("size", size, (m,)))
    image = np.repeat(np.arange(m, dtype=np.int32), N_WAYS)
    moments = images.moments[image]
    blob = moment_columns(moments)
    heading = blob.angle + np.pi * (np.arange(N_WAYS * m) % N_WAYS)
    turn = np.zeros((N_WAYS * m, 3))
    turn[:, 2] = heading
    rotation = so3.exp(turn)
    position = np.column_stack([blob.x, blob.y, blob.volume_mm3 / np.maximum(blob.area_mm2, 1.0)])
    each = size[image]
    views = np.empty((N_WAYS * m, 1, VIEW), np.float32)
    scalars = np.empty((N_WAYS * m, kernels.N_SCALARS), np.float32)
    # which way is which: some foregrounds know where an animal's long axis points
    ways = (1000.0 - 2000.0 * (np.arange(N_WAYS * m) % N_WAYS)).astype(np.float32)
    kernels.look_all(
        np.zeros(1, np.int64),
        images.crop_cameras,
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
    rows = np.column_stack([scalars, ways])
    return (
        Samples(images.heights, image, (1.0 / each).astype(np.float32), views, rows),
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
    """Train the forest that proposes base poses.

    Args:
        images: m images.
        rotations: (m, 3, 3) true base rotations, view frame.
        positions: (m, 3) true base positions, mm, view frame.
        size: (m,) the animals' true size over home size; the forest sees it with an error.
        keep: (m,) bool, the images to learn from.
        method: states the plan, the reach of the features and the lever arm of rotations.
        rng: source of bags, seeds and size errors.

    Returns:
        The forest, with leaves of float16 precision, and (T, m) bool, which images each tree was
        grown on.
    """
    assert method.proposals is not None
    guess = size * np.exp(_SIZE_SD * rng.standard_normal(len(size)))
    samples, frame, centre = views_along_axis(images, guess, method.proposal_reach_mm)
    i = samples.image
    turned = np.swapaxes(frame, 1, 2) @ rotations[i]
    offset = np.einsum("nji,nj->ni", frame, positions[i] - centre) / guess[i][:, None]
    labels = np.concatenate([method.base_lever_mm * turned.reshape(-1, 9), offset], axis=1).astype(
        np.float32
    )
    forest, in_bag = grow_forest(samples, labels, keep[i], method.proposals, rng)
    return Forest(
        forest.nodes, forest.roots, forest.leaves.astype(np.float16).astype(np.float32)
    ), in_bag


def propose(forest: Forest, images: ImageSet, size: Array, method: Method) -> tuple[Array, Array]:
    """Base poses that each tree votes for, from both directions of the long axis.

    Args:
        forest: the forest of T trees.
        images: m images.
        size: (m,) the animals' size over home size.
        method: the method that the forest was trained for.

    Returns:
        Rotations (m, 2 T, 3, 3) and positions (m, 2 T, 3) mm, view frame; candidate 2 t + w is tree
        t's, with the axis taken in direction w.
    """
    samples, frame, centre = views_along_axis(images, size, method.proposal_reach_mm)
    votes = predict_each(forest, samples).astype(float)
    turned = so3.nearest_rotation(votes[..., :9].reshape(*votes.shape[:2], 3, 3))
    rotation = frame[:, None] @ turned
    offset = np.einsum("nij,ntj->nti", frame, votes[..., 9:]) * size[samples.image][:, None, None]
    position = centre[:, None] + offset

    def in_order(values: Array) -> Array:
        """`values` (2 m, T, ...) reordered to (m, 2 T, ...), the tree varying more slowly."""
        by_way = values.reshape(len(size), N_WAYS, forest.n_trees, *values.shape[2:])
        return np.swapaxes(by_way, 1, 2).reshape(
            len(size), N_WAYS * forest.n_trees, *values.shape[2:]
        )

    return in_order(rotation), in_order(position)
