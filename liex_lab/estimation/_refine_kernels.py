"""Numba kernels of the Gauss-Newton refinement: articulated ICP of a sphere model.

On the pose manifold with p = (base twist, log scale, free angles), each step solves (J^T W J +
prior) dp = -gradient with damping by Cholesky decomposition, and moves the pose by g <- g exp(dp).
Residuals: depth readings pull the surface of the nearest sphere onto themselves, spheres in front
of the readings are pushed behind them (both with Geman-McClure weights 1 / (1 + (d/robust)^2)^2),
spheres outside the animal are pulled back onto it, and a prior keeps the pose near its start.
"""

from typing import Any, NamedTuple

import numpy as np

from liex_lab.estimation._feature_kernels import place_joint
from liex_lab.estimation._residual_kernels import nearest_ball, place_balls
from liex_lab.geometry._kernels import cholesky, exp_so3, substitute
from liex_lab.runtime.kernels import inner_kernel, kernel
from liex_lab.scene._height_map_kernels import crop_camera, to_pixel, to_point

_STRIDE = 4  # every so many crop pixels a reading pulls
_ROOT = 7  # twist of the base and log of the scale come before the angles
_DAMPING = 0.02
# of log scale, and of an angle (rad), in one step
_MOST_GROWTH = 0.1
_MOST_TURN = 0.5


class FreeAngles(NamedTuple):
    """The F free angles of a kinematic tree.

    Attributes:
        limits: (F, 2) least and most of each angle, rad.
        moves: (J, F) bool, which angles rotate which joint.
        turns: (B, M) the angles that move each sphere, in order, padded with -1.
    """

    limits: Any
    moves: Any
    turns: Any


class Readings(NamedTuple):
    """The readings of one frame.

    Attributes:
        points: (n, 3) every `_STRIDE`-th of them, mm, view frame.
        nearest: (S, S, 2) int32, cache of `nearest_reading`; changed in place.
    """

    points: Any
    nearest: Any


class MovedPoses(NamedTuple):
    """K poses in each of n frames, changed in place.

    Attributes:
        root_rotations: (n, K, 3, 3).
        root_positions: (n, K, 3) mm.
        angles: (n, K, J, 3) rad.
        scales: (n, K).
    """

    root_rotations: Any
    root_positions: Any
    angles: Any
    scales: Any


class ResidualWeights(NamedTuple):
    """Weights of the residuals.

    Attributes:
        robust: readings this far off count a quarter, mm.
        beside: weight of a sphere outside the animal.
        turn: cost of a radian of the base away from the start, squared mm.
        place: cost of a millimetre of the base away from the start, squared mm.
        growth: cost of a unit of log scale away from the start, squared mm.
        bend: cost of a radian of a joint away from the start, squared mm.
    """

    robust: float
    beside: float
    turn: float
    place: float
    growth: float
    bend: float


@kernel()
def nearest_reading(heights, r, c, known):
    """Find the pixel on the animal that is nearest to a crop pixel outside it.

    Only a few pixels are needed, so they are searched in growing squares and cached.

    Args:
        heights: (S, S) int16 height map, 1/16 mm, 0 outside the animal.
        r: row of the pixel.
        c: column of the pixel.
        known: (S, S, 2) int32 cache, -1 if not searched yet; known[r, c] is set to the row and
            column found, row -2 if absent.
    """
    if known[r, c, 0] != -1:
        return
    side = heights.shape[0]
    least = 1 << 30
    known[r, c, 0] = -2
    reach = 1
    while reach < side and reach * reach < least:
        for a in range(max(r - reach, 0), min(r + reach + 1, side)):
            hop = (
                1 if abs(a - r) == reach else 2 * reach
            )  # whole rows above and below, else both ends of the row
            for b in range(c - reach, c + reach + 1, hop):
                if 0 <= b < side and heights[a, b] > 0:
                    off = (a - r) ** 2 + (b - c) ** 2
                    if off < least:
                        least = off
                        known[r, c, 0] = a
                        known[r, c, 1] = b
        reach += 1


@inner_kernel()
def point_of(heights, packed_camera, r, c, out):
    """The point (3,) mm of the view frame of crop pixel (r, c), into `out`."""
    h = heights[r, c] / 16.0
    out[0], out[1] = to_point(crop_camera(packed_camera), r, c, h)
    out[2] = h


@kernel()
def crop_pixel(packed_camera, p):
    """Row and column (rounded) of a point (3,) mm of the view frame in the crop."""
    u, v = to_pixel(crop_camera(packed_camera), p[0], p[1], p[2])
    column = int(u + 0.5)
    row = int(v + 0.5)
    return row, column


@kernel()
def forward(tree, root_rotation, root_position, angles, scale, rotations, positions):
    """Forward kinematics of one pose, as `body.pose.forward_kinematics`.

    Args:
        tree: the kinematic tree.
        root_rotation: (3, 3) of the base.
        root_position: (3,) of the base, mm.
        angles: (J, 3) rotation vectors of the joints, rad.
        scale: of the bones.
        rotations: (J, 3, 3) joint frames, filled.
        positions: (J, 3) joints, mm, filled.
    """
    turn = np.empty((3, 3))
    local = np.empty((3, 3))
    for i in range(3):
        positions[0, i] = root_position[i]
        for k in range(3):
            rotations[0, i, k] = root_rotation[i, k]
    for j in range(1, tree.parents.size):
        exp_so3(angles[j, 0], angles[j, 1], angles[j, 2], turn)
        for i in range(3):
            for k in range(3):
                local[i, k] = 0.0
                for m in range(3):
                    local[i, k] += tree.rest[j, i, m] * turn[m, k]
        place_joint(j, tree, local, scale, rotations, positions)


@kernel()
def turning_axes(free, angles, rotations, axes):
    """Rotation axes of the free angles in the view frame: R J_r(w) e.

    J_r is the right Jacobian of SO(3) at the joint's rotation vector w, and e the axis of the
    angle.

    Args:
        free: (F, 2) joint and axis of every free angle.
        angles: (J, 3) rotation vectors of the joints, rad.
        rotations: (J, 3, 3) joint frames.
        axes: (F, 3) filled.
    """
    e = np.empty(3)
    for f in range(len(free)):
        j = free[f, 0]
        k = free[f, 1]
        w0 = angles[j, 0]
        w1 = angles[j, 1]
        w2 = angles[j, 2]
        th2 = w0 * w0 + w1 * w1 + w2 * w2
        e[0] = 0.0
        e[1] = 0.0
        e[2] = 0.0
        e[k] = 1.0
        if th2 > 1e-8:
            th = np.sqrt(th2)
            b = (1.0 - np.cos(th)) / th2
            c = (th - np.sin(th)) / (th2 * th)
            # w x e and w x (w x e)
            x = w1 * e[2] - w2 * e[1]
            y = w2 * e[0] - w0 * e[2]
            z = w0 * e[1] - w1 * e[0]
            e[0] += c * (w1 * z - w2 * y) - b * x
            e[1] += c * (w2 * x - w0 * z) - b * y
            e[2] += c * (w0 * y - w1 * x) - b * z
        for i in range(3):
            axes[f, i] = (
                rotations[j, i, 0] * e[0] + rotations[j, i, 1] * e[1] + rotations[j, i, 2] * e[2]
            )


@kernel()
def ball_slope(b, ball, body, tree, free_angles, axes, rotations, positions, scale, slope):
    """Jacobian of a sphere's centre by base twist, log scale and free angles.

    Args:
        b: number of the sphere.
        ball: (3,) its centre, mm.
        body: the sphere model.
        tree: the kinematic tree.
        free_angles: what its free angles do.
        axes: (F, 3) axes of the free angles, from `turning_axes`.
        rotations: (J, 3, 3) joint frames.
        positions: (J, 3) joints, mm.
        scale: of the bones.
        slope: (3, P) filled.
    """
    slope[:] = 0.0
    x0 = ball[0] - positions[0, 0]
    y0 = ball[1] - positions[0, 1]
    z0 = ball[2] - positions[0, 2]
    for k in range(3):
        ax = rotations[0, 0, k]
        ay = rotations[0, 1, k]
        az = rotations[0, 2, k]
        slope[0, k] = ay * z0 - az * y0
        slope[1, k] = az * x0 - ax * z0
        slope[2, k] = ax * y0 - ay * x0
        slope[0, 3 + k] = ax
        slope[1, 3 + k] = ay
        slope[2, 3 + k] = az
    slope[0, 6] = x0
    slope[1, 6] = y0
    slope[2, 6] = z0
    for e in range(2):
        j = body.joints[b, e]
        share = body.share[b] if e == 1 else 1.0 - body.share[b]
        if share == 0.0:
            continue
        u = scale * body.offsets[b, e, 0]
        v = scale * body.offsets[b, e, 1]
        w = scale * body.offsets[b, e, 2]
        ex = (
            positions[j, 0]
            + rotations[j, 0, 0] * u
            + rotations[j, 0, 1] * v
            + rotations[j, 0, 2] * w
        )
        ey = (
            positions[j, 1]
            + rotations[j, 1, 0] * u
            + rotations[j, 1, 1] * v
            + rotations[j, 1, 2] * w
        )
        ez = (
            positions[j, 2]
            + rotations[j, 2, 0] * u
            + rotations[j, 2, 1] * v
            + rotations[j, 2, 2] * w
        )
        for m in range(free_angles.turns.shape[1]):
            f = free_angles.turns[b, m]
            if f < 0:
                break
            if free_angles.moves[j, f]:
                a = tree.free[f, 0]
                x = ex - positions[a, 0]
                y = ey - positions[a, 1]
                z = ez - positions[a, 2]
                ax = axes[f, 0]
                ay = axes[f, 1]
                az = axes[f, 2]
                slope[0, _ROOT + f] += share * (ay * z - az * y)
                slope[1, _ROOT + f] += share * (az * x - ax * z)
                slope[2, _ROOT + f] += share * (ax * y - ay * x)


@kernel()
def _add(row, residual, weight, gradient, curvature):
    """Add one residual to the normal equations (lower half of the curvature)."""
    n = row.size
    for i in range(n):
        if row[i] == 0.0:
            continue
        wi = weight * row[i]
        gradient[i] += wi * residual
        for k in range(i + 1):
            curvature[i, k] += wi * row[k]


@kernel()
def _solve(curvature, gradient, step):
    """Solve the positive definite system by Cholesky decomposition, given its lower half.

    Returns False if it is not definite.
    """
    definite = cholesky(curvature, curvature, 1e-12)
    for i in range(gradient.size):
        step[i] = -gradient[i]
    if definite:
        substitute(curvature, step)
    return definite


@inner_kernel()
def _pull(points, balls, radius, slopes, robust, gradient, curvature):
    """Residuals of readings (n, 3) mm: distance from the surface of the nearest sphere.

    slopes (n_own, 3, P) are of the body's own spheres, which come first; readings nearest to
    another sphere are excluded.
    """
    row = np.empty(gradient.size)
    gaps = np.empty(len(balls))
    for i in range(len(points)):
        best, which = nearest_ball(points[i, 0], points[i, 1], points[i, 2], balls, radius, gaps)
        if which >= len(slopes):
            continue
        length = max(best + radius[which], 1e-6)
        weight = 1.0 / (1.0 + (best / robust) ** 2) ** 2
        row[:] = 0.0
        for a in range(3):
            direction = (points[i, a] - balls[which, a]) / length
            for p in range(row.size):
                row[p] -= direction * slopes[which, a, p]
        row[6] -= radius[which]
        _add(row, best, weight, gradient, curvature)


@inner_kernel()
def _push(
    heights, packed_camera, known, balls, radius, slopes, robust, beside, gradient, curvature
):
    """Residuals of spheres: in front of the readings, or outside the animal.

    slopes (n_own, 3, P) are of the body's own spheres, which come first.
    """
    row = np.empty(gradient.size)
    target = np.empty(3)
    last = heights.shape[0] - 1
    for b in range(len(slopes)):
        r, c = crop_pixel(packed_camera, balls[b])
        r = min(max(r, 0), last)
        c = min(max(c, 0), last)
        if heights[r, c] > 0:
            out = balls[b, 2] + radius[b] - heights[r, c] / 16.0
            if out > 0.0:
                weight = 1.0 / (1.0 + (out / robust) ** 2) ** 2
                row[:] = slopes[b, 2]
                row[6] += radius[b]
                _add(row, out, weight, gradient, curvature)
            continue
        nearest_reading(heights, r, c, known)
        a = known[r, c, 0]
        d = known[r, c, 1]
        if a < 0:
            continue
        point_of(heights, packed_camera, a, d, target)
        for axis in range(2):
            off = balls[b, axis] - target[axis]
            weight = beside / (1.0 + (off / (2.0 * robust)) ** 2)
            row[:] = slopes[b, axis]
            _add(row, off, weight, gradient, curvature)


@inner_kernel()
def _add_prior(tree, weights, moved, growth, turned, gradient, curvature):
    """Residuals of the prior: the distance from the start.

    It consists of a twist `moved` (6,), log scale `growth` and angles `turned` (J, 3).
    """
    for k in range(3):
        gradient[k] += weights.turn * moved[k]
        gradient[3 + k] += weights.place * moved[3 + k]
        curvature[k, k] += weights.turn
        curvature[3 + k, 3 + k] += weights.place
    gradient[6] += weights.growth * growth
    curvature[6, 6] += weights.growth
    for f in range(len(tree.free)):
        j = tree.free[f, 0]
        k = tree.free[f, 1]
        gradient[_ROOT + f] += weights.bend * turned[j, k]
        curvature[_ROOT + f, _ROOT + f] += weights.bend


@inner_kernel()
def _go(step, tree, limits, root_rotation, root_position, angles, scale):
    """Take a step (P,) in place, angles and scale limited; returns the new scale."""
    turn = np.empty((3, 3))
    exp_so3(step[0], step[1], step[2], turn)
    for i in range(3):
        x = root_rotation[i, 0]
        y = root_rotation[i, 1]
        z = root_rotation[i, 2]
        root_position[i] += x * step[3] + y * step[4] + z * step[5]
        for k in range(3):
            root_rotation[i, k] = x * turn[0, k] + y * turn[1, k] + z * turn[2, k]
    for f in range(len(tree.free)):
        j = tree.free[f, 0]
        k = tree.free[f, 1]
        turned = angles[j, k] + min(max(step[_ROOT + f], -_MOST_TURN), _MOST_TURN)
        angles[j, k] = min(max(turned, limits[f, 0]), limits[f, 1])
    return scale * np.exp(min(max(step[6], -_MOST_GROWTH), _MOST_GROWTH))


@inner_kernel()
def _readings(heights, packed_camera):
    """The points (n, 3) mm of the view frame of every `_STRIDE`-th crop pixel."""
    side = heights.shape[0]
    points = np.empty((side * side // (_STRIDE * _STRIDE) + side, 3))
    n = 0
    for r in range(_STRIDE // 2, side, _STRIDE):
        for c in range(_STRIDE // 2, side, _STRIDE):
            if heights[r, c] > 0:
                point_of(heights, packed_camera, r, c, points[n])
                n += 1
    return points[:n]


@inner_kernel()
def refine_one(
    heights,
    packed_camera,
    readings,
    tree,
    free_angles,
    body,
    weights,
    n_steps,
    root_rotation,
    root_position,
    angles,
    scale,
):
    """Refine one pose in place by Gauss-Newton steps, fewer if the system is not definite.

    Changed are the base's root_rotation (3, 3) and root_position (3,) mm, and the joints' angles
    (J, 3), rad. heights (S, S) int16 are 1/16 mm, 0 outside the animal. Returns the bones' scale.
    """
    n_values = _ROOT + len(tree.free)
    n_joints = tree.parents.size
    rotations = np.empty((n_joints, 3, 3))
    positions = np.empty((n_joints, 3))
    balls = np.empty((len(body.joints), 3))
    axes = np.empty((len(tree.free), 3))
    slopes = np.empty((body.n_own, 3, n_values))
    step = np.empty(n_values)
    first_angles = angles.copy()
    first_scale = scale
    moved = np.zeros(6)  # of the base since the start, step by step
    for _ in range(n_steps):
        forward(tree, root_rotation, root_position, angles, scale, rotations, positions)
        place_balls(rotations, positions, scale, body, balls)
        turning_axes(tree.free, angles, rotations, axes)
        for b in range(body.n_own):
            ball_slope(
                b, balls[b], body, tree, free_angles, axes, rotations, positions, scale, slopes[b]
            )
        gradient = np.zeros(n_values)
        curvature = np.zeros((n_values, n_values))
        radius = body.radius * scale
        _pull(readings.points, balls, radius, slopes, weights.robust, gradient, curvature)
        _push(
            heights,
            packed_camera,
            readings.nearest,
            balls,
            radius,
            slopes,
            weights.robust,
            weights.beside,
            gradient,
            curvature,
        )
        _add_prior(
            tree,
            weights,
            moved,
            np.log(scale / first_scale),
            angles - first_angles,
            gradient,
            curvature,
        )
        for i in range(n_values):
            curvature[i, i] *= 1.0 + _DAMPING
        if not _solve(curvature, gradient, step):
            return scale
        moved += step[:6]
        scale = _go(step, tree, free_angles.limits, root_rotation, root_position, angles, scale)
    return scale


@kernel(nogil=True)
def refine_all(
    heights, crop_cameras, tree, free_angles, body, weights, n_steps, poses, start, stop
):
    """`refine_one` for the K poses of each of n frames.

    Args:
        heights: (n, S, S) int16 height maps, 1/16 mm, 0 outside the animal.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        tree: the kinematic tree.
        free_angles: its free angles.
        body: the sphere model.
        weights: of the residuals.
        n_steps: number of steps.
        poses: `MovedPoses`, changed in place.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for i in range(start, stop):
        readings = Readings(
            _readings(heights[i], crop_cameras[i]),
            np.full((heights.shape[1], heights.shape[1], 2), -1, np.int32),
        )
        for k in range(poses.scales.shape[1]):
            poses.scales[i, k] = refine_one(
                heights[i],
                crop_cameras[i],
                readings,
                tree,
                free_angles,
                body,
                weights,
                n_steps,
                poses.root_rotations[i, k],
                poses.root_positions[i, k],
                poses.angles[i, k],
                poses.scales[i, k],
            )
