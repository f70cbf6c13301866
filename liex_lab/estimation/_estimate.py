"""Numba kernels of Algorithm 1: all candidates of one frame through the cascade and the metric."""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from liex_lab.estimation._explain import N_FIT, explain_pose
from liex_lab.estimation._kernels import (
    N_SCALARS,
    correct_base,
    correct_joint,
    fill_scalars,
    fill_view,
    place_joint,
    place_rest,
)
from liex_lab.forests._kernels import VIEW, descend_many

_SHIFTS = 4  # mean-shift steps; the mode of ten votes settles within these


@njit(cache=True)
def mode_of_votes(votes, bandwidth, out):
    """Mean-shift mode of votes (T, D) from their mean, with a Gaussian kernel, into out (D,)."""
    n, d = votes.shape
    for _ in range(_SHIFTS):
        total = 0.0
        shifted = np.zeros(d)
        for t in range(n):
            distance = 0.0
            for k in range(d):
                distance += (votes[t, k] - out[k]) ** 2
            weight = np.exp(-0.5 * distance / (bandwidth * bandwidth))
            total += weight
            for k in range(d):
                shifted[k] += weight * votes[t, k]
        if total < 1e-12:
            return
        for k in range(d):
            out[k] = shifted[k] / total


@njit(cache=True)
def predict_many(
    nodes, roots, leaves, leaf_base, width, heights, inverse_size, views, scalars, bandwidth, scratch, out
):
    """A forest's prediction for K samples of one height map into out (K, width)."""
    n, n_trees = views.shape[0], roots.size
    at, active, leaf = scratch[0], scratch[1], scratch[2]
    votes = np.empty((n, n_trees if bandwidth > 0 else 1, width), np.float32)
    for k in range(n):
        for d in range(width):
            out[k, d] = 0.0
    for t in range(n_trees):
        descend_many(nodes, roots[t], heights, inverse_size, views, scalars, at, active, leaf)
        for k in range(n):
            first = leaf_base + leaf[k] * width
            for d in range(width):
                out[k, d] += leaves[first + d]
                if bandwidth > 0:
                    votes[k, t, d] = leaves[first + d]
    for k in range(n):
        for d in range(width):
            out[k, d] /= n_trees
        if bandwidth > 0:
            mode_of_votes(votes[k], bandwidth, out[k, :width])


@njit(cache=True)
def estimate_one(
    heights, look, moments, size, parents, offsets, rest, axes, solved, n_rounds, reach, levers, bandwidth,
    explains, unit_mm, ball_joints, ball_offsets, ball_share, ball_radius, nodes, roots, leaves, leaf_bases, widths,
    metric_nodes, metric_roots, metric_leaves,
    rotations, positions, scales, scores,
):  # fmt: skip
    """K candidates of one frame: rotations (K, J, 3, 3), positions (K, J, 3), scales (K,) in place; scores (K,)."""
    n, n_joints = positions.shape[0], positions.shape[1]
    inverse_size = np.float32(1.0 / size)
    scratch = np.empty((3, n), np.int64)
    values = np.empty((n, 7))
    views = np.empty((n, 1, VIEW), np.float32)
    scalars = np.empty((n, N_SCALARS), np.float32)
    forest = 0
    for joint in solved:
        for k in range(n):
            if joint > 0:
                place_joint(joint, parents, offsets, rest, scales[k], rotations[k], positions[k])
        for _ in range(n_rounds[0] if joint == 0 else n_rounds[1]):
            for k in range(n):
                fill_view(rotations[k, joint], positions[k, joint], look, size, reach, views[k, 0])
                fill_scalars(rotations[k, joint], positions[k, joint], scales[k], moments, size, scalars[k])
            predict_many(nodes, roots[forest], leaves, leaf_bases[forest], widths[forest], heights, inverse_size,
                         views, scalars, bandwidth, scratch, values)  # fmt: skip
            for k in range(n):
                if joint > 0:
                    correct_joint(rotations[k, joint], axes[joint], values[k], levers[1])
                    continue
                for d in range(3):
                    values[k, d] /= levers[0]
                values[k, 6] = values[k, 6] / levers[2] if widths[forest] > 6 else 0.0
                scales[k] = correct_base(rotations[k, 0], positions[k, 0], scales[k], values[k], size)
            forest += 1
    all_views = np.empty((n, n_joints, VIEW), np.float32)
    facts = np.empty((n, N_SCALARS + (N_FIT if explains else 0)), np.float32)
    for k in range(n):
        place_rest(solved, parents, offsets, rest, scales[k], rotations[k], positions[k])
        for joint in range(n_joints):
            fill_view(rotations[k, joint], positions[k, joint], look, size, reach, all_views[k, joint])
        fill_scalars(rotations[k, 0], positions[k, 0], scales[k], moments, size, facts[k])
        if explains:
            explain_pose(heights, look, rotations[k], positions[k], scales[k], size, unit_mm, ball_joints,
                         ball_offsets, ball_share, ball_radius, facts[k, N_SCALARS:])  # fmt: skip
    predict_many(metric_nodes, metric_roots, metric_leaves, 0, 1, heights, inverse_size, all_views, facts, 0.0,
                 scratch, values)  # fmt: skip
    for k in range(n):
        scores[k] = values[k, 0]


@njit(cache=True, parallel=True)
def estimate_all(
    heights, looks, moments, found, size, parents, offsets, rest, axes, solved, n_rounds, reach, levers, bandwidth,
    explains, unit_mm, ball_joints, ball_offsets, ball_share, ball_radius, nodes, roots, leaves, leaf_bases, widths,
    metric_nodes, metric_roots, metric_leaves,
    rotations, positions, scales, scores,
):  # fmt: skip
    for i in prange(heights.shape[0]):
        if found[i]:
            estimate_one(
                heights[i], looks[i], moments[i], size, parents, offsets, rest, axes, solved, n_rounds, reach, levers,
                bandwidth, explains, unit_mm, ball_joints, ball_offsets, ball_share, ball_radius, nodes, roots, leaves,
                leaf_bases, widths, metric_nodes, metric_roots, metric_leaves,
                rotations[i], positions[i], scales[i], scores[i],
            )  # fmt: skip
