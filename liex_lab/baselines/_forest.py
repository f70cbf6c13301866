"""Numba kernels of the regression forest: votes of an animal's pixels for its place, then
candidates for its pose.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from liex_lab.estimation._cascade_kernels import mode_of_votes
from liex_lab.estimation._feature_kernels import correct_base, correct_joint, fill_view, place_joint
from liex_lab.forests._kernels import VIEW, descend

_BINS = 72  # of the circle in which headings are counted: 5 degrees each
_SMOOTH = 3  # bins to either side that a vote for a heading also counts in
_SETTLE = 2  # times the few mean-shift steps of `mode_of_votes`


@njit(cache=True)
def animal_points(heights, look, phase, points):
    """P points (P, 3) mm on the animal's back, view frame, evenly spread over its pixels in reading
    order.

    phase in [0, 1) chooses which of the pixels; look (17,) says how the height map (S, S) was cut.
    """
    total = 0
    for h in heights.flat:
        total += h > 0
    n = points.shape[0]
    seen = 0
    k = 0
    for row in range(heights.shape[0]):
        for column in range(heights.shape[1]):
            h = heights[row, column]
            if h <= 0:
                continue
            while k < n and int((k + phase) * total / n) == seen:
                z = look[13] - h / 16.0
                x = (look[14] + look[16] * column - look[2]) / look[0] * z
                y = (look[15] + look[16] * row - look[3]) / look[1] * z
                for i in range(3):
                    points[k, i] = look[4 + 3 * i] * x + look[5 + 3 * i] * y + look[6 + 3 * i] * z
                points[k, 2] += look[13]
                k += 1
            seen += 1


@njit(cache=True, parallel=True)
def points_all(heights, looks, image, phases, points):
    """`animal_points` for a batch: image (n,) and phases (n,) into points (n, P, 3)."""
    for s in prange(image.size):
        animal_points(heights[image[s]], looks[image[s]], phases[s], points[s])


@njit(cache=True, parallel=True)
def views_all(looks, image, places, headings, reach, views):
    """Views (n, 1, 9) of places (n, 3) mm whose offsets are turned by headings (n,) rad in the
    image plane.
    """
    for s in prange(image.size):
        turned = np.eye(3)
        turn_to(headings[s], turned)
        fill_view(turned, places[s], looks[image[s]], 1.0, reach, views[s, 0])


@njit(cache=True)
def turn_to(heading, rotation):
    """Rotation (3, 3) about the view's z axis by an angle, rad."""
    c = np.cos(heading)
    s = np.sin(heading)
    rotation[:] = 0.0
    rotation[0, 0] = c
    rotation[0, 1] = -s
    rotation[1, 0] = s
    rotation[1, 1] = c
    rotation[2, 2] = 1.0


@njit(cache=True)
def heading_of(votes):
    """The heading, rad, that most votes (n, 2) agree on; a vote weighs as much as it is long."""
    counts = np.zeros(_BINS)
    angles = np.empty(len(votes))
    for k in range(len(votes)):
        angles[k] = np.arctan2(votes[k, 1], votes[k, 0])
        weight = np.hypot(votes[k, 0], votes[k, 1])
        middle = int((angles[k] / (2 * np.pi) + 0.5) * _BINS)
        for b in range(-_SMOOTH, _SMOOTH + 1):
            counts[(middle + b) % _BINS] += weight * (_SMOOTH + 1 - abs(b))
    peak = ((np.argmax(counts) + 0.5) / _BINS - 0.5) * 2 * np.pi
    x = y = 0.0
    for k in range(len(votes)):
        if np.cos(angles[k] - peak) > 0.7:
            x = x + votes[k, 0]
            y = y + votes[k, 1]
    return np.arctan2(y, x)


@njit(cache=True)
def locate(heights, look, phase, n_points, reach, bandwidth, nodes, roots, leaves, used, place):
    """The base joint's place (3,) mm in the view frame, and the heading, rad, as F1's trees vote;
    used (T,) bool.

    Only votes whose own heading agrees with the chosen one take part in the place: a pixel that
    takes the nose for the tail errs in both.
    """
    points = np.empty((n_points, 3))
    animal_points(heights, look, phase, points)
    view = np.empty((1, VIEW), np.float32)
    none = np.zeros(1, np.float32)
    upright = np.eye(3)
    votes = np.empty((roots.size * n_points, 5))
    n = 0
    for p in range(n_points):
        fill_view(upright, points[p], look, 1.0, reach, view[0])
        for t in range(roots.size):
            if not used[t]:
                continue
            leaf = leaves[descend(nodes, roots[t], heights, np.float32(1.0), view, none)]
            for i in range(3):
                votes[n, i] = points[p, i] + leaf[i]
            votes[n, 3] = leaf[3]
            votes[n, 4] = leaf[4]
            n += 1
    heading = heading_of(votes[:n, 3:])
    c = np.cos(heading)
    s = np.sin(heading)
    place[:] = 0.0
    m = 0
    for k in range(n):
        if votes[k, 3] * c + votes[k, 4] * s > 0:
            votes[m] = votes[k]
            place += votes[m, :3]
            m += 1
    place /= max(m, 1)
    for _ in range(_SETTLE):
        mode_of_votes(votes[:m, :3], bandwidth, place)
    return heading


@njit(cache=True, parallel=True)
def locate_all(
    heights,
    looks,
    image,
    phases,
    n_points,
    reach,
    bandwidth,
    nodes,
    roots,
    leaves,
    used,
    places,
    headings,
):
    """`locate` for a batch: image (n,), phases (n,), used (n, T) into places (n, 3) and headings
    (n,).
    """
    for s in prange(image.size):
        headings[s] = locate(
            heights[image[s]],
            looks[image[s]],
            phases[s],
            n_points,
            reach,
            bandwidth,
            nodes,
            roots,
            leaves,
            used[s],
            places[s],
        )


@njit(cache=True)
def unfold(values, levers, place, heading, parents, offsets, rest, axes, rotations, positions):
    """The pose at F2's coordinates (D,) in lever units, from where F1 put it; all joints' frames.
    Returns the scale.
    """
    twist = np.empty(7)
    for k in range(7):
        twist[k] = values[k] / levers[k]
    turn_to(heading, rotations[0])
    positions[0] = place
    scale = correct_base(rotations[0], positions[0], 1.0, twist, 1.0)
    turns = np.zeros(3)
    at = 7
    for j in range(1, parents.size):
        place_joint(j, parents, offsets, rest, scale, rotations, positions)
        n = 0
        for k in range(3):
            if axes[j, k]:
                turns[n] = values[at] / levers[at]
                n = n + 1
                at = at + 1
        if n > 0:
            correct_joint(rotations[j], axes[j], turns, 1.0)
    return scale


@njit(cache=True, parallel=True)
def guess_all(
    heights,
    looks,
    found,
    n_points,
    reach,
    bandwidths,
    nodes,
    roots,
    leaves,
    pose_nodes,
    pose_roots,
    pose_leaves,
    levers,
    parents,
    offsets,
    rest,
    axes,
    positions,
):
    """Joints (n, J, 3) mm in their view frames, of the frames in which an animal was found."""
    for i in prange(heights.shape[0]):
        if not found[i]:
            continue
        place = np.empty(3)
        n_trees = pose_roots.size
        width = pose_leaves.shape[1]
        heading = locate(
            heights[i],
            looks[i],
            0.5,
            n_points,
            reach,
            bandwidths[0],
            nodes,
            roots,
            leaves,
            np.ones(roots.size, np.bool_),
            place,
        )
        turned = np.empty((3, 3))
        view = np.empty((1, VIEW), np.float32)
        none = np.zeros(1, np.float32)
        turn_to(heading, turned)
        fill_view(turned, place, looks[i], 1.0, reach, view[0])
        votes = np.empty((n_trees, width))
        values = np.zeros(width)
        for t in range(n_trees):
            leaf = descend(pose_nodes, pose_roots[t], heights[i], np.float32(1.0), view, none)
            for d in range(width):
                votes[t, d] = pose_leaves[leaf, d]
                values[d] += votes[t, d] / n_trees
        mode_of_votes(votes, bandwidths[1], values)
        rotations = np.empty((parents.size, 3, 3))
        unfold(
            values, levers, place, heading, parents, offsets, rest, axes, rotations, positions[i]
        )
