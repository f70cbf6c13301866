"""Numba kernels of the features and of the pose updates on SE(3) in the cascade.

Features: the linearised pinhole projection of a joint's frame into its height map, the input of
Lie-X Eq. 15, and scalars of the whole animal. Updates: g <- g exp(r) (Eq. 10) by the exponential
map of SE(3) (Eq. 4, 5) and Rodrigues' formula,

    exp(w^) = I + sin(th)/th w^ + (1 - cos(th))/th^2 w^^2,   th = |w|.

A packed crop camera, 17 float64, is the geometry of one height map: fx fy cx cy, rotation (9,
row-major) of T_view_camera, distance of the camera above the view's origin (its translation is (0,
0, distance)), crop origin u v, and crop step. Candidates are in that view frame: the arena frame,
or the upright camera frame of the paper's variant.
"""

from typing import Any, NamedTuple

import numpy as np

from liex_lab.forests._kernels import (
    COLUMN_SLOPE,
    ROW_SLOPE,
    VIEW_COLUMN,
    VIEW_HEIGHT,
    VIEW_ROW,
)
from liex_lab.geometry._kernels import exp_so3
from liex_lab.runtime.kernels import kernel
from liex_lab.scene._blob_kernels import unpack_moments
from liex_lab.scene._height_map_kernels import crop_camera, to_camera, to_pixel

N_SCALARS = 11
# a threshold is an integer: logarithms and sines are scaled up to resolve a few thousandths
_LOG_UNIT = 500.0
_MM_UNIT = 16.0


class FeatureRows(NamedTuple):
    """The features of n candidates, filled.

    Attributes:
        views: (n, V, 9) float32, from V joints.
        scalars: (n, N_SCALARS) float32, not filled if it has no columns.
    """

    views: Any
    scalars: Any


@kernel()
def fill_view(rotation, position, packed_camera, size, reach, view):
    """Linearise the projection of a joint's frame into a height map.

    Args:
        rotation: (3, 3) of the joint, view frame.
        position: (3,) of the joint, mm, view frame.
        packed_camera: (17,) packed crop camera.
        size: the animal's size over home size.
        reach: range of offsets, mm at home size.
        view: (9,) float32, filled: crop pixel (column, row) of the joint, 2x3 matrix from offsets
            (1/127 of the reach) to crop pixels, and the joint's height, 1/16 mm at home size.
    """
    camera = crop_camera(packed_camera)
    x, y, z = to_camera(camera, position[0], position[1], position[2])
    per_px = 1.0 / camera.step
    iu = camera.fx / z * per_px
    iv = camera.fy / z * per_px
    view[VIEW_COLUMN] = (camera.fx * x / z + camera.cx - camera.u0) * per_px
    view[VIEW_ROW] = (camera.fy * y / z + camera.cy - camera.v0) * per_px
    unit = reach * size / 127.0
    for k in range(3):
        ax = camera.r00 * rotation[0, k] + camera.r10 * rotation[1, k] + camera.r20 * rotation[2, k]
        ay = camera.r01 * rotation[0, k] + camera.r11 * rotation[1, k] + camera.r21 * rotation[2, k]
        az = camera.r02 * rotation[0, k] + camera.r12 * rotation[1, k] + camera.r22 * rotation[2, k]
        view[COLUMN_SLOPE + k] = unit * iu * (ax - x / z * az)
        view[ROW_SLOPE + k] = unit * iv * (ay - y / z * az)
    view[VIEW_HEIGHT] = 16.0 * position[2] / size


@kernel()
def fill_scalars(rotation, position, scale, moments, size, scalars):
    """Numbers that describe the whole animal relative to a joint, at home size.

    In order: log area, log volume, spread along and across the long axis, the centroid (x, y) in
    the joint's frame, the joint's height, its pitch relative to the back's slope, its roll, the
    sine of twice the angle to the long axis times the elongation, log scale. Lengths are 1/16 mm;
    logarithms and sines are times 500, since thresholds are integers.

    Args:
        rotation: (3, 3) of the joint, view frame.
        position: (3,) of the joint, mm, view frame.
        scale: of the candidate's bones.
        moments: (9,) moments of the height map.
        size: the animal's size over home size.
        scalars: (N_SCALARS,) float32, filled.
    """
    blob = unpack_moments(moments)
    area = max(blob.area_mm2, 1.0)
    volume = max(blob.volume_mm3, 1.0)
    scalars[0] = _LOG_UNIT * np.log(area / (size * size))
    scalars[1] = _LOG_UNIT * np.log(volume / (size * size * size))
    scalars[2] = _MM_UNIT * blob.sd_along / size
    scalars[3] = _MM_UNIT * blob.sd_across / size
    dx = blob.x - position[0]
    dy = blob.y - position[1]
    scalars[4] = _MM_UNIT * (rotation[0, 0] * dx + rotation[1, 0] * dy) / size
    scalars[5] = _MM_UNIT * (rotation[0, 1] * dx + rotation[1, 1] * dy) / size
    scalars[6] = _MM_UNIT * position[2] / size
    c = rotation[0, 0]
    s = rotation[1, 0]
    norm = max(c * c + s * s, 1e-12)
    # pitch of the joint, relative to the back's slope along the long axis if measured
    rise = blob.slope * (np.cos(blob.angle) * c + np.sin(blob.angle) * s) / np.sqrt(norm)
    scalars[7] = _LOG_UNIT * (rotation[2, 0] - rise)
    scalars[8] = _LOG_UNIT * rotation[2, 1]
    # the sine of twice the angle from the joint's heading to the long axis, without trigonometry
    twice = np.sin(2.0 * blob.angle) * (c * c - s * s) - np.cos(2.0 * blob.angle) * 2.0 * s * c
    longer = blob.sd_along - blob.sd_across
    scalars[9] = _LOG_UNIT * twice / norm * longer / max(blob.sd_along + blob.sd_across, 1e-6)
    scalars[10] = _LOG_UNIT * np.log(scale / size)


@kernel()
def turn(rotation, wx, wy, wz):
    """Rotate a frame about its own axes: rotation <- rotation exp(w), for corrections are local.

    Args:
        rotation: (3, 3), changed in place.
        wx: x component of w, rad.
        wy: y component, rad.
        wz: z component, rad.
    """
    step = np.empty((3, 3))
    exp_so3(wx, wy, wz, step)
    for i in range(3):
        a = rotation[i, 0]
        b = rotation[i, 1]
        c = rotation[i, 2]
        for k in range(3):
            rotation[i, k] = a * step[0, k] + b * step[1, k] + c * step[2, k]


@kernel()
def correct_base(rotation, position, scale, twist, size):
    """Move the base by a twist: g <- g exp(twist) (Lie-X Eq. 10, with A of Eq. 5).

    Args:
        rotation: (3, 3) of the base, changed in place.
        position: (3,) of the base, mm, changed in place.
        scale: of the bones.
        twist: (7,) rotation, rad; translation, mm at home size; change of the log scale.
        size: the animal's size over home size.

    Returns:
        The new scale.
    """
    wx = twist[0]
    wy = twist[1]
    wz = twist[2]
    th2 = wx * wx + wy * wy + wz * wz
    if th2 < 1e-6:
        b = 0.5 - th2 / 24.0
        c = 1.0 / 6.0 - th2 / 120.0
    else:
        th = np.sqrt(th2)
        b = 2.0 * np.sin(th / 2.0) ** 2 / th2
        c = (th - np.sin(th)) / (th2 * th)
    nx = twist[3] * size
    ny = twist[4] * size
    nz = twist[5] * size
    # A nu = nu + b w x nu + c w x (w x nu), Eq. 5
    px = wy * nz - wz * ny
    py = wz * nx - wx * nz
    pz = wx * ny - wy * nx
    tx = nx + b * px + c * (wy * pz - wz * py)
    ty = ny + b * py + c * (wz * px - wx * pz)
    tz = nz + b * pz + c * (wx * py - wy * px)
    for i in range(3):
        position[i] += rotation[i, 0] * tx + rotation[i, 1] * ty + rotation[i, 2] * tz
    turn(rotation, wx, wy, wz)
    return scale * np.exp(twist[6])


@kernel()
def correct_joint(rotation, axes, values, lever):
    """Rotate a joint about its free axes: g <- g exp(r) (Lie-X Eq. 10).

    Args:
        rotation: (3, 3) of the joint, changed in place.
        axes: (3,) bool, the free axes.
        values: rotation about each free axis in turn, rad times the lever arm.
        lever: the lever arm, mm.
    """
    w = np.zeros(3)
    used = 0
    for k in range(3):
        if axes[k]:
            w[k] = values[used] / lever
            used += 1
    turn(rotation, w[0], w[1], w[2])


@kernel()
def place_joint(j, tree, own, scale, rotations, positions):
    """Place a joint relative to its parent.

    Args:
        j: number of the joint.
        tree: `KinematicTree` of the skeleton.
        own: (3, 3) rotation in the parent's frame; `tree.rest[j]` is the home angle.
        scale: of the bones.
        rotations: (J, 3, 3) joint frames; that of j is filled.
        positions: (J, 3) joints, mm; that of j is filled.
    """
    p = tree.parents[j]
    for i in range(3):
        total = positions[p, i]
        for k in range(3):
            total += scale * rotations[p, i, k] * tree.offsets[j, k]
        positions[j, i] = total
        for k in range(3):
            value = 0.0
            for m in range(3):
                value += rotations[p, i, m] * own[m, k]
            rotations[j, i, k] = value


@kernel()
def place_rest(solved, tree, scale, rotations, positions):
    """Place every joint without a regressor relative to its parent.

    Args:
        solved: the joints with regressors, unchanged.
        tree: `KinematicTree` of the skeleton.
        scale: of the bones.
        rotations: (J, 3, 3) joint frames, changed in place.
        positions: (J, 3) joints, mm, changed in place.
    """
    for j in range(1, tree.parents.size):
        is_solved = False
        for s in solved:
            is_solved |= s == j
        if not is_solved:
            place_joint(j, tree, tree.rest[j], scale, rotations, positions)


@kernel(nogil=True)
def place_all(j, tree, scale, rotations, positions, start, stop):
    """`place_joint` for a batch of candidates.

    Args:
        j: number of the joint.
        tree: `KinematicTree` of the skeleton.
        scale: (n,) of the bones.
        rotations: (n, J, 3, 3) joint frames, changed in place.
        positions: (n, J, 3) joints, mm, changed in place.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for s in range(start, stop):
        place_joint(j, tree, tree.rest[j], scale[s], rotations[s], positions[s])


@kernel(nogil=True)
def all_features(
    joints,
    crop_cameras,
    moments,
    image,
    size,
    reach,
    rotations,
    positions,
    scale,
    rows,
    start,
    stop,
):
    """Features of a batch of candidates: views from the given joints and scalars from the first.

    Args:
        joints: (V,) the joints.
        crop_cameras: (m, 17) packed crop cameras of the height maps.
        moments: (m, 9) moments of the height maps.
        image: (n,) index of each candidate's height map.
        size: (n,) the animals' size over home size.
        reach: (V,) range of offsets from each of the joints, mm at home size.
        rotations: (n, J, 3, 3) joint frames, view frame.
        positions: (n, J, 3) joints, mm, view frame.
        scale: (n,) of the bones.
        rows: `FeatureRows`, filled.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for s in range(start, stop):
        i = image[s]
        for v in range(joints.size):
            fill_view(
                rotations[s, joints[v]],
                positions[s, joints[v]],
                crop_cameras[i],
                size[s],
                reach[v],
                rows.views[s, v],
            )
        if rows.scalars.shape[1] > 0:
            fill_scalars(
                rotations[s, joints[0]],
                positions[s, joints[0]],
                scale[s],
                moments[i],
                size[s],
                rows.scalars[s],
            )


@kernel(nogil=True)
def correct_base_all(rotations, positions, scale, values, levers, size, start, stop):
    """`correct_base` for a batch of candidates.

    Args:
        rotations: (n, J, 3, 3) joint frames, changed in place.
        positions: (n, J, 3) joints, mm, changed in place.
        scale: (n,) of the bones, changed in place.
        values: (n, 6 or 7) twist and, with 7, log scale, in lever units.
        levers: (2,) lever arms of rotation and log scale, mm.
        size: (n,) the animals' size over home size.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for s in range(start, stop):
        twist = np.zeros(7)
        for k in range(3):
            twist[k] = values[s, k] / levers[0]
            twist[3 + k] = values[s, 3 + k]
        if values.shape[1] > 6:
            twist[6] = values[s, 6] / levers[1]
        scale[s] = correct_base(rotations[s, 0], positions[s, 0], scale[s], twist, size[s])


@kernel(nogil=True)
def correct_joint_all(j, rotations, axes, values, lever, start, stop):
    """`correct_joint` of one joint for a batch of candidates.

    Args:
        j: number of the joint.
        rotations: (n, J, 3, 3) joint frames, changed in place.
        axes: (3,) bool, the joint's free axes.
        values: (n, free axes) rotations, rad times the lever arm.
        lever: the lever arm, mm.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for s in range(start, stop):
        correct_joint(rotations[s, j], axes, values[s], lever)


# Numba kernels of the ridge correction's features: height profile of the back along a chain.


_WINDOW = 2  # crop pixels to each side of a joint over which the back's height is averaged
_STEP = 0.5  # crop pixels
# of the chain's length: search range for the animal's end beyond and before the chain's ends
_END_SHARE = 0.15


@kernel()
def back_over(heights, packed_camera, position, most, out):
    """Height of the animal's back over a joint.

    The mean over a window of crop pixels of the readings within `most` of their median.

    Args:
        heights: (S, S) int16 height map, 1/16 mm, 0 outside the animal.
        packed_camera: (17,) packed crop camera.
        position: (3,) the joint, mm, view frame.
        most: readings farther than this from the median are excluded, mm.
        out: (2,) filled with the height above the joint, mm, 0 without readings, and the share of
            the window that shows the animal.
    """
    last = heights.shape[0] - 1
    u, v = to_pixel(crop_camera(packed_camera), position[0], position[1], position[2])
    column = int(np.floor(u + 0.5))
    row = int(np.floor(v + 0.5))
    readings = np.empty((2 * _WINDOW + 1) ** 2)
    n = 0
    for r in range(max(row - _WINDOW, 0), min(row + _WINDOW, last) + 1):
        for c in range(max(column - _WINDOW, 0), min(column + _WINDOW, last) + 1):
            if heights[r, c] > 0:
                readings[n] = heights[r, c] / 16.0 - position[2]
                n += 1
    out[0] = 0.0
    out[1] = n / readings.size
    if n == 0:
        return
    middle = np.sort(readings[:n])[n // 2]
    total = 0.0
    many = 0
    for i in range(n):
        if abs(readings[i] - middle) <= most:
            total += readings[i]
            many += 1
    out[0] = total / many


@kernel()
def end_past(heights, packed_camera, end, before, reach):
    """Distance by which the animal extends past the end of a chain, straight on from the joint
    before it.

    Args:
        heights: (S, S) int16 height map, 1/16 mm, 0 outside the animal.
        packed_camera: (17,) packed crop camera.
        end: (3,) the end joint, mm, view frame.
        before: (3,) the joint before it.
        reach: search range in either direction, mm.

    Returns:
        mm, at most `reach`; negative if the animal ends before the joint.
    """
    last = heights.shape[0] - 1
    camera = crop_camera(packed_camera)
    way = end - before
    length = np.sqrt(np.sum(way * way))
    way = way / max(length, 1e-9)
    first_u, first_v = to_pixel(camera, end[0], end[1], end[2])
    second_u, second_v = to_pixel(camera, before[0], before[1], before[2])
    per_px = length / max(np.hypot(first_u - second_u, first_v - second_v), 0.2)
    n = int(reach / per_px / _STEP)
    for k in range(-n, n + 1):
        past = k * _STEP * per_px
        u, v = to_pixel(
            camera, end[0] + past * way[0], end[1] + past * way[1], end[2] + past * way[2]
        )
        column = int(np.floor(u + 0.5))
        row = int(np.floor(v + 0.5))
        on = False
        for r in range(max(row - 1, 0), min(row + 1, last) + 1):
            for c in range(max(column - 1, 0), min(column + 1, last) + 1):
                on |= heights[r, c] > 0
        if not on:
            return past
    return reach


@kernel(nogil=True)
def back_profiles(heights, crop_cameras, positions, length, most_share, out, start, stop):
    """Profile of each chain: the back's height over all joints, and the extent past both ends.

    Args:
        heights: (n, S, S) int16 height maps, 1/16 mm, 0 outside the animal.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        positions: (n, J, 3) joints, mm, view frame.
        length: (n,) lengths of the animals, mm.
        most_share: of the length; see `most` of `back_over`.
        out: (n, 2 J + 2) filled with heights (J), visible shares (J), and `end_past` of the first
            and the last joint, mm.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    m = positions.shape[1]
    for i in range(start, stop):
        here = np.empty(2)
        for k in range(m):
            back_over(heights[i], crop_cameras[i], positions[i, k], most_share * length[i], here)
            out[i, k] = here[0]
            out[i, m + k] = here[1]
        for end in range(2):
            k, before = (m - 1, m - 2) if end else (0, 1)
            reach = _END_SHARE * length[i]
            out[i, 2 * m + end] = end_past(
                heights[i], crop_cameras[i], positions[i, k], positions[i, before], reach
            )


# Numba kernel of the head-tail classifier: resamples a height map along an animal's direction.


@kernel(nogil=True)
def lay_along(heights, crop_cameras, rump, tip, middle, size, along, across, out, start, stop):
    """Resample height maps on a grid aligned with the animals.

    Grid point (a, b) is middle + size (along[a] d + across[b] d_left), d being the unit direction
    from base to tip in the image plane; the nearest pixel is used.

    Args:
        heights: (n, S, S) int16 height maps, 1/16 mm, 0 outside the animal.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        rump: (n, 3) base joints, mm, view frame.
        tip: (n, 3) tip joints, mm, view frame.
        middle: (n, 3) centres of the grids, mm, view frame.
        size: (n,) the animals' size over home size.
        along: (A,) grid coordinates along the animal, mm at home size.
        across: (B,) grid coordinates to its left, mm at home size.
        out: (n, A, B) filled with heights, mm; 0 outside the animal.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    last = heights.shape[1] - 1
    for i in range(start, stop):
        dx = tip[i, 0] - rump[i, 0]
        dy = tip[i, 1] - rump[i, 1]
        camera = crop_camera(crop_cameras[i])
        length = max(np.sqrt(dx * dx + dy * dy), 1e-9)
        dx = dx / length
        dy = dy / length
        for a in range(len(along)):
            for b in range(len(across)):
                x = middle[i, 0] + size[i] * (along[a] * dx - across[b] * dy)
                y = middle[i, 1] + size[i] * (along[a] * dy + across[b] * dx)
                u, v = to_pixel(camera, x, y, middle[i, 2])
                column = int(np.floor(u + 0.5))
                row = int(np.floor(v + 0.5))
                inside = 0 <= row <= last and 0 <= column <= last
                out[i, a, b] = heights[i, row, column] / 16.0 if inside else 0.0


# Numba kernel of the mean cross-sections: a height map read across the mid-axis of a chain.


@kernel(nogil=True)
def read_across(heights, crop_cameras, points, sideways, lateral, covered, height, start, stop):
    """Read height maps at distances to the left and right of points on the mid-axis.

    Args:
        heights: (n, H, W) int16 height maps, 1/16 mm, 0 outside the animal.
        crop_cameras: (n, 17) packed crop cameras of the height maps.
        points: (n, S, 3) on the mid-axis, mm, view frame.
        sideways: (n, S, 2) unit vectors across the axis, view frame.
        lateral: (T,) distances from the axis, mm.
        covered: (n, S, T) filled with the share of the two sides that shows the animal, 0 to 1.
        height: (n, S, T) filled with the mean height of those over the axis, mm, 0 without any.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for i in range(start, stop):
        camera = crop_camera(crop_cameras[i])
        for s in range(points.shape[1]):
            for t in range(lateral.shape[0]):
                n = 0
                total = 0.0
                for side in (-1.0, 1.0):
                    u, v = to_pixel(
                        camera,
                        points[i, s, 0] + side * lateral[t] * sideways[i, s, 0],
                        points[i, s, 1] + side * lateral[t] * sideways[i, s, 1],
                        points[i, s, 2],
                    )
                    column = int(np.floor(u + 0.5))
                    row = int(np.floor(v + 0.5))
                    inside = 0 <= row < heights.shape[1] and 0 <= column < heights.shape[2]
                    if inside and heights[i, row, column] > 0:
                        n += 1
                        total += heights[i, row, column] / 16.0 - points[i, s, 2]
                covered[i, s, t] = 0.5 * n
                height[i, s, t] = total / n if n > 0 else 0.0
