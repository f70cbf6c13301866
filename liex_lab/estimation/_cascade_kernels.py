"""Numba kernels of Lie-X Algorithm 1: cascaded regression of all candidates, pruning, metric.

Joint by joint, base first, and round by round, g_{1:j} <- g_{1:j} exp(r) with r from a regression
forest (Eq. 10). A forest predicts the mean of its trees' votes or their mean-shift mode (the
paper's Hough votes). A thread processes `FRAMES` frames at once. Their candidates descend each tree
together, LANES at a time, so that a tree stays in the cache and all vector registers are used.
"""

from typing import Any, NamedTuple

import numpy as np

from liex_lab.estimation._feature_kernels import (
    N_SCALARS,
    correct_base,
    correct_joint,
    fill_scalars,
    fill_view,
    place_joint,
    place_rest,
)
from liex_lab.estimation._residual_kernels import N_FIT, explain_pose
from liex_lab.forests._kernels import VIEW
from liex_lab.forests._walk import LANES, walk_one_view, walk_views
from liex_lab.runtime.kernels import inner_kernel, kernel
from liex_lab.scene._blob_kernels import ANGLE

FRAMES = 8
_SHIFTS = 4  # mean-shift steps; the mode of ten votes settles within these


class FrameBatch(NamedTuple):
    """The height maps of n frames.

    Attributes:
        heights: (n, S, S) int16 height maps, 1/16 mm, 0 where there is no animal.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        moments: (n, 9) moments of the height maps.
        size: the animal's size over home size.
    """

    heights: Any
    crop_cameras: Any
    moments: Any
    size: float


class CandidatePoses(NamedTuple):
    """K candidates in each of n frames, changed in place.

    Attributes:
        rotations: (n, K, J, 3, 3) joint frames, view frame.
        positions: (n, K, J, 3) joints, mm, view frame.
        scales: (n, K) of the bones.
    """

    rotations: Any
    positions: Any
    scales: Any


class Trees(NamedTuple):
    """Forests in one node array.

    Attributes:
        nodes: (N, 4) int32 packed nodes, see `forests._kernels`.
        roots: (F, T) root of each tree of each forest.
        leaves: float32 leaf values of all forests, in one row.
        bases: (F,) start of each forest's leaves.
        widths: (F,) number of values of a leaf.
    """

    nodes: Any
    roots: Any
    leaves: Any
    bases: Any
    widths: Any


class Forests(NamedTuple):
    """The forests of a method.

    Attributes:
        regressors: `Trees`, one forest per solved joint and round, in order.
        pruner: one forest, which scores candidates by the base joint alone.
        metric: one forest, the learned metric.
    """

    regressors: Trees
    pruner: Trees
    metric: Trees


class CascadeSettings(NamedTuple):
    """The method's settings of the cascade.

    Attributes:
        base_rounds: regression rounds of the base joint.
        rounds: regression rounds C of the other joints.
        reach: (J,) range of feature offsets from each joint, mm at home size.
        base_lever: lever arm of the base's rotation, mm.
        joint_lever: lever arm of the other joints' rotations, mm.
        scale_lever: lever arm of the log scale, mm.
        bandwidth: of the mean shift over tree votes, regressors' and metric's, in label units; 0
            for the mean.
        keep: candidates kept after the base joint.
        solved: the joints with regressors, in order, base first.
    """

    base_rounds: int
    rounds: int
    reach: Any
    base_lever: float
    joint_lever: float
    scale_lever: float
    bandwidth: float
    keep: int
    solved: Any


class _Lanes(NamedTuple):
    """Inputs of the forests for n candidates, one per lane, see `forests._walk`.

    frame (n,) and pose (n,) identify the candidate of each lane.
    """

    pixels: Any
    base: Any
    scalar_base: Any
    inverse: Any
    views: Any
    leaf: Any
    frame: Any
    pose: Any


@kernel()
def mode_of_votes(votes, bandwidth, out):
    """Mean-shift mode of votes with a Gaussian kernel (Comaniciu and Meer 2002), in four steps.

    Args:
        votes: (T, D) votes.
        bandwidth: of the kernel, in units of the votes.
        out: (D,) the start, usually the mean of the votes; moved to the mode in place.
    """
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


@kernel(nogil=True)
def modes_of_votes(votes, bandwidth, modes, start, stop):
    """Mean-shift modes of the votes of n samples, each from the mean of its own.

    Args:
        votes: (n, T, D) votes.
        bandwidth: of the kernel, in units of the votes.
        modes: (n, D) float64, filled.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for k in range(start, stop):
        for d in range(votes.shape[2]):
            modes[k, d] = 0.0
            for t in range(votes.shape[1]):
                modes[k, d] += votes[k, t, d]
            modes[k, d] /= votes.shape[1]
        mode_of_votes(votes[k], bandwidth, modes[k])


@kernel()
def _predict(trees, forest, lanes, n, n_views, side, bandwidth, out):
    """A forest's prediction for n lanes into out (n, width): mean or mean-shift mode of the votes.

    n_views: views per lane; 0 if all nodes use the only one.
    """
    width = trees.widths[forest]
    leaf_base = trees.bases[forest]
    n_trees = trees.roots.shape[1]
    n_lanes = lanes.base.size
    votes = np.empty((n if bandwidth > 0 else 1, n_trees, width), np.float32)
    for k in range(n):
        for d in range(width):
            out[k, d] = 0.0
    for t in range(n_trees):
        root = trees.roots[forest, t]
        for first in range(0, n, LANES):
            if n_views == 0:
                walk_one_view(
                    trees.nodes,
                    root,
                    lanes.pixels,
                    lanes.base,
                    lanes.scalar_base,
                    lanes.inverse,
                    lanes.views,
                    n_lanes,
                    side,
                    lanes.leaf,
                    first,
                )
            else:
                walk_views(
                    trees.nodes,
                    root,
                    lanes.pixels,
                    lanes.base,
                    lanes.scalar_base,
                    lanes.inverse,
                    lanes.views,
                    VIEW * n_views,
                    side,
                    lanes.leaf,
                    first,
                )
        for k in range(n):
            at = leaf_base + lanes.leaf[k] * width
            for d in range(width):
                out[k, d] += trees.leaves[at + d]
                if bandwidth > 0:
                    votes[k, t, d] = trees.leaves[at + d]
    for k in range(n):
        for d in range(width):
            out[k, d] /= n_trees
        if bandwidth > 0:
            mode_of_votes(votes[k], bandwidth, out[k, :width])


@inner_kernel()
def _write_scalars(lanes, k, first, scalars):
    """Write a lane's scalars behind the pixels, from number `first` on, rounded down."""
    at = lanes.scalar_base[k] + first
    for c in range(scalars.size):
        lanes.pixels[at + c] = np.int16(
            np.floor(min(max(scalars[c], np.float32(-32768.0)), np.float32(32767.0)))
        )


@inner_kernel()
def _fill_inputs(lanes, n, joint, batch, reach, candidates):
    """Fill the lanes' only view, from one joint, and their scalars."""
    rotations = candidates.rotations
    positions = candidates.positions
    size = batch.size
    n_lanes = lanes.base.size
    view = np.empty(VIEW, np.float32)
    scalars = np.empty(N_SCALARS, np.float32)
    for s in range(n):
        i = lanes.frame[s]
        k = lanes.pose[s]
        fill_view(
            rotations[i, k, joint],
            positions[i, k, joint],
            batch.crop_cameras[i],
            size,
            reach[joint],
            view,
        )
        for c in range(VIEW):
            lanes.views[c * n_lanes + s] = view[c]
        fill_scalars(
            rotations[i, k, joint],
            positions[i, k, joint],
            candidates.scales[i, k],
            batch.moments[i],
            size,
            scalars,
        )
        _write_scalars(lanes, s, np.int64(0), scalars)


@inner_kernel()
def _fill_all_inputs(lanes, n, batch, reach, body, candidates):
    """Fill the lanes' views from all joints, their scalars, and the residuals of the posed body."""
    rotations = candidates.rotations
    positions = candidates.positions
    scales = candidates.scales
    size = batch.size
    n_joints = positions.shape[2]
    view = np.empty(VIEW, np.float32)
    scalars = np.empty(N_SCALARS, np.float32)
    fit = np.empty(N_FIT, np.float32)
    for s in range(n):
        i = lanes.frame[s]
        k = lanes.pose[s]
        for joint in range(n_joints):
            fill_view(
                rotations[i, k, joint],
                positions[i, k, joint],
                batch.crop_cameras[i],
                size,
                reach[joint],
                view,
            )
            for c in range(VIEW):
                lanes.views[(s * n_joints + joint) * VIEW + c] = view[c]
        fill_scalars(
            rotations[i, k, 0], positions[i, k, 0], scales[i, k], batch.moments[i], size, scalars
        )
        _write_scalars(lanes, s, np.int64(0), scalars)
        if body.radius.size > 0:
            explain_pose(
                batch.heights[i],
                batch.crop_cameras[i],
                batch.moments[i, ANGLE],
                rotations[i, k],
                positions[i, k],
                scales[i, k],
                size,
                body,
                fit,
            )
            _write_scalars(lanes, s, np.int64(N_SCALARS), fit)


@inner_kernel()
def _lanes_for(heights, frames, n_poses, n_joints, size):
    """Lanes for n_poses candidates of each of the frames.

    The frames' height maps are consecutive in the lanes' pixels.
    """
    side = heights.shape[1]
    n = frames.size * n_poses
    area = side * side
    n_lanes = LANES * ((n + LANES - 1) // LANES)
    n_scalars = N_SCALARS + N_FIT
    pixels = np.zeros(frames.size * area + n_lanes * n_scalars, np.int16)
    base = np.zeros(n_lanes, np.int32)
    scalar_base = np.zeros(n_lanes, np.int32)
    frame = np.zeros(n_lanes, np.int64)
    pose = np.zeros(n_lanes, np.int64)
    for m in range(frames.size):
        for r in range(side):
            for c in range(side):
                pixels[m * area + r * side + c] = heights[frames[m], r, c]
    for s in range(n_lanes):
        scalar_base[s] = frames.size * area + s * n_scalars
        if s < n:
            base[s] = (s // n_poses) * area
            frame[s] = frames[s // n_poses]
            pose[s] = s % n_poses
    inverse = np.full(n_lanes, 1.0 / size, np.float32)
    views = np.zeros(VIEW * n_lanes * n_joints, np.float32)
    return _Lanes(
        pixels, base, scalar_base, inverse, views, np.zeros(n_lanes, np.int32), frame, pose
    )


@kernel()
def choose_survivors(rotations, scores, chosen):
    """Choose the candidates to keep after the base joint.

    They are those with the lowest scores, and always the best one in the opposite direction, as the
    whole chain distinguishes head and tail better than the base alone.

    Args:
        rotations: (K, 3, 3) rotations of the base.
        scores: (K,) predicted errors.
        chosen: (n_keep,) int64, filled with the candidates to keep, best first.
    """
    keep = chosen.size
    order = np.empty(scores.size, np.int64)
    for k in range(scores.size):  # by insertion: they are few
        place = k
        while place > 0 and scores[order[place - 1]] > scores[k]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = k
    best = order[0]
    for place in range(keep):
        chosen[place] = order[place]
    opposite = -1
    for place in range(order.size):
        along = 0.0
        for i in range(3):
            along += rotations[order[place], i, 0] * rotations[best, i, 0]
        if along < 0.0:
            opposite = place
            break
    if opposite >= keep:
        chosen[keep - 1] = order[opposite]


@inner_kernel()
def _solve_joint(joint, j, tree, regressors, tuning, lanes, n, batch, candidates, values):
    """All regression rounds of one joint, the j-th solved one, for n lanes."""
    rotations = candidates.rotations
    positions = candidates.positions
    scales = candidates.scales
    side = batch.heights.shape[1]
    for s in range(n):
        if joint > 0:
            i = lanes.frame[s]
            k = lanes.pose[s]
            place_joint(
                joint, tree, tree.rest[joint], scales[i, k], rotations[i, k], positions[i, k]
            )
    first = 0 if j == 0 else tuning.base_rounds + (j - 1) * tuning.rounds
    for c in range(tuning.base_rounds if j == 0 else tuning.rounds):
        forest = first + c
        _fill_inputs(lanes, n, joint, batch, tuning.reach, candidates)
        _predict(regressors, forest, lanes, n, np.int64(0), side, tuning.bandwidth, values)
        for s in range(n):
            i = lanes.frame[s]
            k = lanes.pose[s]
            if joint > 0:
                correct_joint(
                    rotations[i, k, joint], tree.axes[joint], values[s], tuning.joint_lever
                )
                continue
            for d in range(3):
                values[s, d] /= tuning.base_lever
            values[s, 6] = (
                values[s, 6] / tuning.scale_lever if regressors.widths[forest] > 6 else 0.0
            )
            scales[i, k] = correct_base(
                rotations[i, k, 0], positions[i, k, 0], scales[i, k], values[s], batch.size
            )


@inner_kernel()
def _estimate_block(
    batch, frames, tree, regressors, pruner, metric, tuning, body, starts, poses, scores
):
    """Process the candidates of a few frames by cascade, pruner and metric.

    `starts` contains their bases and is changed; `poses` receives the surviving candidates and
    `scores` their scores.
    """
    heights = batch.heights
    side = heights.shape[1]
    n_joints = poses.positions.shape[2]
    n_starts = starts.scales.shape[1]
    lanes = _lanes_for(heights, frames, n_starts, np.int64(1), batch.size)
    n = frames.size * n_starts
    values = np.empty((lanes.base.size, 7))
    # typed as numbers: a kernel would be compiled for every literal
    first = np.int64(0)
    no_view = np.int64(0)
    _solve_joint(tuning.solved[0], first, tree, regressors, tuning, lanes, n, batch, starts, values)
    if tuning.keep < n_starts:
        _fill_inputs(lanes, n, np.int64(0), batch, tuning.reach, starts)
        _predict(pruner, first, lanes, n, no_view, side, 0.0, values)
    chosen = np.arange(tuning.keep)
    early = np.empty(n_starts)
    for m in range(frames.size):
        i = frames[m]
        if tuning.keep < n_starts:
            for k in range(n_starts):
                early[k] = values[m * n_starts + k, 0]
            choose_survivors(starts.rotations[i, :, 0], early, chosen)
        for p in range(tuning.keep):
            start = chosen[p]
            poses.scales[i, p] = starts.scales[i, start]
            for a in range(3):
                poses.positions[i, p, 0, a] = starts.positions[i, start, 0, a]
                for b in range(3):
                    poses.rotations[i, p, 0, a, b] = starts.rotations[i, start, 0, a, b]
    lanes = _lanes_for(heights, frames, tuning.keep, n_joints, batch.size)
    n = frames.size * tuning.keep
    for j in range(1, tuning.solved.size):
        _solve_joint(tuning.solved[j], j, tree, regressors, tuning, lanes, n, batch, poses, values)
    for s in range(n):
        i = lanes.frame[s]
        k = lanes.pose[s]
        place_rest(
            tuning.solved, tree, poses.scales[i, k], poses.rotations[i, k], poses.positions[i, k]
        )
    _fill_all_inputs(lanes, n, batch, tuning.reach, body, poses)
    _predict(metric, first, lanes, n, n_joints, side, tuning.bandwidth, values)
    for s in range(n):
        scores[lanes.frame[s], lanes.pose[s]] = values[s, 0]


@kernel(nogil=True)
def estimate_all(batch, frames, tree, forests, tuning, body, starts, poses, scores, start, stop):
    """Run Lie-X Algorithm 1 for blocks of `FRAMES` frames with an animal.

    Args:
        batch: `FrameBatch`.
        frames: (m,) the frames with an animal.
        tree: `KinematicTree` of the skeleton.
        forests: `Forests`.
        tuning: the method's settings.
        body: sphere model whose residuals the metric uses; empty if it uses none.
        starts: `CandidatePoses` of the K bases alone (J = 1); changed in place.
        poses: `CandidatePoses` of the P kept candidates; filled, except in frames without an
            animal.
        scores: (n, P) of the kept candidates; filled likewise.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for b in range(start, stop):
        _estimate_block(
            batch,
            frames[b * FRAMES : (b + 1) * FRAMES],
            tree,
            forests.regressors,
            forests.pruner,
            forests.metric,
            tuning,
            body,
            starts,
            poses,
            scores,
        )
