"""Numba kernels of the baselines: Hough votes of the RF's pixels, and the CNN's depth patches.

F1's trees vote from pixels for the base's position and heading, F2's trees for the pose; the result
is the mean-shift mode of the votes (Lie-X section 5.2).
"""

from typing import Any, NamedTuple

import numpy as np

from liex_lab.estimation._cascade_kernels import mode_of_votes
from liex_lab.estimation._feature_kernels import correct_base, correct_joint, fill_view, place_joint
from liex_lab.forests._kernels import VIEW, descend
from liex_lab.runtime.kernels import inner_kernel, kernel
from liex_lab.scene._height_map_kernels import crop_camera

_BINS = 72  # heading bins of the circle: 5 degrees each
_SMOOTH = 3  # bins to either side that a heading's vote also counts in
_SETTLE = 2  # times the few mean-shift steps of `mode_of_votes`
PATCH = 224  # side of a patch, pixels
PATCH_MARGIN = 1.1
HEIGHTS_PER_MM = 16.0


class VotingForest(NamedTuple):
    """A forest whose leaves are votes.

    Attributes:
        nodes: (N, 4) int32 packed nodes.
        roots: (T,) roots of its trees.
        leaves: (n_leaves, D) votes: of F1 the offset to the base, mm, and heading times a length
            (D = 5); of F2 coordinates in lever units.
    """

    nodes: Any
    roots: Any
    leaves: Any


class VoteSettings(NamedTuple):
    """Settings of the votes.

    Attributes:
        n_points: number of pixels that vote.
        reach: largest feature offset, mm.
        bandwidths: (2,) of the mean shifts of F1 and F2, mm.
    """

    n_points: int
    reach: float
    bandwidths: Any


@kernel()
def animal_points(heights, packed_camera, phase, points):
    """Points on the animal's back, evenly spread over its pixels in reading order.

    Args:
        heights: (S, S) int16 height map, 1/16 mm, 0 where there is no animal.
        packed_camera: (17,) packed crop camera.
        phase: in [0, 1), selects the pixels.
        points: (P, 3) filled, mm, view frame.
    """
    camera = crop_camera(packed_camera)
    total = 0
    for h in heights.flat:
        total += h > 0
    n = points.shape[0]
    passed = 0
    k = 0
    for row in range(heights.shape[0]):
        for column in range(heights.shape[1]):
            h = heights[row, column]
            if h <= 0:
                continue
            while k < n and int((k + phase) * total / n) == passed:
                z = camera.distance - h / 16.0
                x = (camera.u0 + camera.step * column - camera.cx) / camera.fx * z
                y = (camera.v0 + camera.step * row - camera.cy) / camera.fy * z
                points[k, 0] = camera.r00 * x + camera.r01 * y + camera.r02 * z
                points[k, 1] = camera.r10 * x + camera.r11 * y + camera.r12 * z
                points[k, 2] = camera.r20 * x + camera.r21 * y + camera.r22 * z
                points[k, 2] += camera.distance
                k += 1
            passed += 1


@kernel(nogil=True)
def points_all(heights, crop_cameras, image, phases, points, start, stop):
    """`animal_points` for a batch of images.

    Args:
        heights: (m, S, S) int16 height maps, 1/16 mm, 0 where there is no animal.
        crop_cameras: (m, 17) packed crop cameras of the height maps.
        image: (n,) index of each sample's height map.
        phases: (n,) in [0, 1).
        points: (n, P, 3) filled, mm, view frame.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for s in range(start, stop):
        animal_points(heights[image[s]], crop_cameras[image[s]], phases[s], points[s])


@kernel(nogil=True)
def views_all(crop_cameras, image, places, headings, reach, views, start, stop):
    """Linearised projections at given positions, with offsets turned by a heading.

    Args:
        crop_cameras: (m, 17) packed crop cameras of the height maps.
        image: (n,) index of each sample's height map.
        places: (n, 3) positions, mm, view frame.
        headings: (n,) rad, about the view's z axis.
        reach: largest feature offset, mm.
        views: (n, 1, 9) float32, filled.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for s in range(start, stop):
        turned = np.eye(3)
        turn_to(headings[s], turned)
        fill_view(turned, places[s], crop_cameras[image[s]], 1.0, reach, views[s, 0])


@inner_kernel()
def turn_to(heading, rotation):
    """Rotation (3, 3) about the view's z axis by an angle `heading`, rad, into `rotation`."""
    c = np.cos(heading)
    s = np.sin(heading)
    rotation[:] = 0.0
    rotation[0, 0] = c
    rotation[0, 1] = -s
    rotation[1, 0] = s
    rotation[1, 1] = c
    rotation[2, 2] = 1.0


@kernel()
def heading_of(votes):
    """The heading, rad, that most votes (n, 2) agree on; a vote's weight is its length.

    It is the mean direction of the votes within about 45 degrees of the peak of a smoothed circular
    histogram.
    """
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


@inner_kernel()
def locate(heights, packed_camera, phase, settings, forest, used, place):
    """Position and heading of the animal by the votes of F1's trees.

    Only votes whose own heading agrees with the chosen one contribute to the position: a pixel that
    mistakes the nose for the tail errs in both.

    Args:
        heights: (S, S) int16 height map, 1/16 mm, 0 where there is no animal.
        packed_camera: (17,) packed crop camera.
        phase: in [0, 1), selects the pixels that vote.
        settings: settings of the votes.
        forest: F1.
        used: (T,) bool, the trees that vote.
        place: (3,) filled with the base's position, mm, view frame.

    Returns:
        The heading, rad.
    """
    n_points = settings.n_points
    n_trees = forest.roots.size
    points = np.empty((n_points, 3))
    animal_points(heights, packed_camera, phase, points)
    view = np.empty((1, VIEW), np.float32)
    none = np.zeros(1, np.float32)
    upright = np.eye(3)
    votes = np.empty((n_trees * n_points, 5))
    n = 0
    for p in range(n_points):
        fill_view(upright, points[p], packed_camera, 1.0, settings.reach, view[0])
        for t in range(n_trees):
            if not used[t]:
                continue
            at = descend(forest.nodes, forest.roots[t], heights, np.float32(1.0), view, none)
            leaf = forest.leaves[at]
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
        mode_of_votes(votes[:m, :3], settings.bandwidths[0], place)
    return heading


@kernel(nogil=True)
def locate_all(
    heights, crop_cameras, image, phases, settings, forest, used, places, headings, start, stop
):
    """`locate` for a batch of images.

    Args:
        heights: (m, S, S) int16 height maps, 1/16 mm, 0 where there is no animal.
        crop_cameras: (m, 17) packed crop cameras of the height maps.
        image: (n,) index of each sample's height map.
        phases: (n,) in [0, 1).
        settings: settings of the votes.
        forest: F1.
        used: (n, T) bool, the trees that vote.
        places: (n, 3) filled, mm, view frame.
        headings: (n,) filled, rad.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for s in range(start, stop):
        headings[s] = locate(
            heights[image[s]],
            crop_cameras[image[s]],
            phases[s],
            settings,
            forest,
            used[s],
            places[s],
        )


@kernel()
def unfold(values, levers, place, heading, tree, rotations, positions):
    """Joint frames of the pose at F2's coordinates, relative to F1's position and heading.

    Args:
        values: (D,) coordinates in lever units, see `baselines.baseline.levers`.
        levers: (D,) lever arms.
        place: (3,) base position from F1, mm.
        heading: heading from F1, rad.
        tree: `KinematicTree` of the skeleton.
        rotations: (J, 3, 3) filled.
        positions: (J, 3) filled, mm.

    Returns:
        The scale of the bones.
    """
    twist = np.empty(7)
    for k in range(7):
        twist[k] = values[k] / levers[k]
    turn_to(heading, rotations[0])
    positions[0] = place
    scale = correct_base(rotations[0], positions[0], 1.0, twist, 1.0)
    turns = np.zeros(3)
    at = 7
    for j in range(1, tree.parents.size):
        place_joint(j, tree, tree.rest[j], scale, rotations, positions)
        n = 0
        for k in range(3):
            if tree.axes[j, k]:
                turns[n] = values[at] / levers[at]
                n = n + 1
                at = at + 1
        if n > 0:
            correct_joint(rotations[j], tree.axes[j], turns, 1.0)
    return scale


@kernel(nogil=True)
def guess_all(
    heights, crop_cameras, found, settings, where, pose, levers, tree, positions, start, stop
):
    """Joints of the frames in which an animal was found.

    Args:
        heights: (n, S, S) int16 height maps, 1/16 mm, 0 where there is no animal.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        found: (n,) bool, whether an animal was found.
        settings: settings of the votes.
        where: F1.
        pose: F2.
        levers: (D,) lever arms of F2's coordinates.
        tree: `KinematicTree` of the skeleton.
        positions: (n, J, 3) joints, mm, view frame; filled where an animal was found.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    n_joints = tree.parents.size
    for i in range(start, stop):
        if not found[i]:
            continue
        place = np.empty(3)
        n_trees = pose.roots.size
        width = pose.leaves.shape[1]
        heading = locate(
            heights[i],
            crop_cameras[i],
            0.5,
            settings,
            where,
            np.ones(where.roots.size, np.bool_),
            place,
        )
        turned = np.empty((3, 3))
        view = np.empty((1, VIEW), np.float32)
        none = np.zeros(1, np.float32)
        turn_to(heading, turned)
        fill_view(turned, place, crop_cameras[i], 1.0, settings.reach, view[0])
        votes = np.empty((n_trees, width))
        values = np.zeros(width)
        for t in range(n_trees):
            leaf = descend(pose.nodes, pose.roots[t], heights[i], np.float32(1.0), view, none)
            for d in range(width):
                votes[t, d] = pose.leaves[leaf, d]
                values[d] += votes[t, d] / n_trees
        mode_of_votes(votes, settings.bandwidths[1], values)
        rotations = np.empty((n_joints, 3, 3))
        unfold(values, levers, place, heading, tree, rotations, positions[i])


@kernel(nogil=True)
def frames_all(heights, crop_cameras, frames, start, stop):
    for k in range(start, stop):
        camera = crop_camera(crop_cameras[k])
        low = np.full(2, 1 << 30)
        high = np.full(2, -1)
        total = 0.0
        n = 0
        for row in range(heights.shape[1]):
            for column in range(heights.shape[2]):
                h = heights[k, row, column]
                if h > 0:
                    low[0], low[1] = min(low[0], column), min(low[1], row)
                    high[0], high[1] = max(high[0], column), max(high[1], row)
                    total = total + h
                    n = n + 1
        side = max(high[0] - low[0], high[1] - low[1]) + 1
        frames[k, 0] = camera.u0 + camera.step * (low[0] + high[0]) / 2
        frames[k, 1] = camera.v0 + camera.step * (low[1] + high[1]) / 2
        frames[k, 2] = 0.5 * PATCH_MARGIN * side * camera.step
        frames[k, 3] = camera.distance - total / max(n, 1) / HEIGHTS_PER_MM
        frames[k, 4] = frames[k, 2] * frames[k, 3] / np.sqrt(camera.fx * camera.fy)


@kernel()
def shade(heights, row, column, level, per_mm):
    """Brightness of one pixel of a height map; `level` is the animal's mean height, 1/16 mm."""
    if (
        not (0 <= row < heights.shape[0] and 0 <= column < heights.shape[1])
        or heights[row, column] <= 0
    ):
        return 0.0
    return min(
        max(127.5 * (1.0 + (heights[row, column] - level) / HEIGHTS_PER_MM * per_mm), 1.0), 255.0
    )


@kernel(nogil=True)
def patches_all(heights, crop_cameras, frames, patches, start, stop):
    for k in range(start, stop):
        camera = crop_camera(crop_cameras[k])
        scale = 2.0 * frames[k, 2] / camera.step / PATCH  # height map pixels per patch pixel
        left = (frames[k, 0] - frames[k, 2] - camera.u0) / camera.step
        top = (frames[k, 1] - frames[k, 2] - camera.v0) / camera.step
        level = (camera.distance - frames[k, 3]) * HEIGHTS_PER_MM
        per_mm = 1.0 / frames[k, 4]
        for i in range(PATCH):
            y = top + (i + 0.5) * scale
            row = int(np.floor(y))
            for j in range(PATCH):
                x = left + (j + 0.5) * scale
                column = int(np.floor(x))
                a = x - column
                b = y - row
                above = (1 - a) * shade(heights[k], row, column, level, per_mm)
                above += a * shade(heights[k], row, column + 1, level, per_mm)
                below = (1 - a) * shade(heights[k], row + 1, column, level, per_mm)
                below += a * shade(heights[k], row + 1, column + 1, level, per_mm)
                patches[k, i, j] = (1 - b) * above + b * below
