"""Kernels that segment the hand at a geodesic extremum and cut its height map from the image.

At an extremum a step of mean shift with a flat kernel of 60 mm (Fukunaga and Hostetler 1975) finds
the middle of its end; a sphere of 190 mm is centred on the hand in three passes, in which the part
that leaves the sphere gives the direction of the arm, and the surface is cut across it a hand's
length (185 mm) behind the fingertips. All lengths are those of a home-sized hand.

blocks and labels are those of `_geodesic_kernels`.
"""

from typing import Any, NamedTuple

import numpy as np

from liex_lab.runtime.kernels import inner_kernel, kernel
from liex_lab.scene import _blob_kernels as blob_kernels
from liex_lab.scene._blob_kernels import BLOCK
from liex_lab.scene._geodesic_kernels import (
    AROUND_MM,
    END_COLUMN,
    END_ROW,
    MAX_SURFACES,
    N_END,
    block_depths,
    label_surfaces,
    list_surfaces,
    nearest_ends,
    point_of_block,
    relabel,
)

_WRIST_MM = 50.0  # of a home-sized hand: the arm is inspected this far behind the cut


class HandFind(NamedTuple):
    """Position of a hand, camera frame.

    Attributes:
        middle: (3,) mm.
        fingers: (3,) direction of the fingers, 0 without an arm.
        cut: position along `fingers` of the cut through the arm, mm from the camera.
        area_mm2: area beyond the cut, mm^2.
    """

    middle: Any
    fingers: Any
    cut: Any
    area_mm2: Any


@inner_kernel()
def unlikeness(blocks, labels, surface, mark, found, size, intrinsics):
    """Mean depth of the blocks labelled `mark`, and how unlike a hand they are.

    Args:
        blocks: (h, w) float32 mm.
        labels: (h, w) int32; the blocks' own label is restored.
        surface: their `SurfaceBlocks`.
        mark: the label of the blocks.
        found: `HandFind` of the hand.
        size: the hand's length over the skeleton's home length.
        intrinsics: (4,) fx, fy, cx, cy px.

    Returns:
        The mean depth, mm, and the score: lower is more hand-like.
    """
    n_rows, n_columns = labels.shape
    focal = np.sqrt(intrinsics[0] * intrinsics[1])
    area = around = behind = 0.0
    on_border = n = 0
    depth = 0.0
    cells = surface.cells
    for k in range(len(cells)):
        i, j = cells[k, 0], cells[k, 1]
        side = _side(blocks[i, j], focal)
        if labels[i, j] != mark:
            behind += side * side * _behind_cut(surface.points[k], found, size)
            continue
        area += side * side
        depth += blocks[i, j]
        n += 1
        on_border += min(i, j, n_rows - 1 - i, n_columns - 1 - j) < 2
        for a, b in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            r = i + a
            c = j + b
            inside = 0 <= r < n_rows and 0 <= c < n_columns
            if not inside or (labels[r, c] != mark and labels[r, c] != surface.slot):
                around += side
    relabel(labels, surface)
    area = max(area, 1.0)
    n = max(n, 1)
    width = min(behind / (_WRIST_MM * 100.0 * size * size), 4.0)
    # weights of size, border and wrist separate rendered hands from elbows, chests and heads by
    # logistic regression, in units of the last term, which fingers make large
    unlike = 0.55 * (np.log(area / (size * size)) - 9.55) ** 2
    return depth / n, unlike + 0.6 * on_border / n + 0.25 * width - np.log(
        max(around, 1.0) ** 2 / area
    )


@kernel()
def _side(depth, focal):
    """The side of a block at this depth, mm."""
    return BLOCK * depth / focal


@inner_kernel()
def _behind_cut(point, found, size):
    """Whether a point (3,) lies close behind the cut through the arm."""
    x, y, z = point[0], point[1], point[2]
    fingers = found.fingers
    middle = found.middle
    along = x * fingers[0] + y * fingers[1] + z * fingers[2] - found.cut
    off = (x - middle[0]) ** 2 + (y - middle[1]) ** 2 + (z - middle[2]) ** 2
    return -_WRIST_MM * size < along <= 0.0 and off < (1.4 * AROUND_MM * size) ** 2


_BIN_MM = 5.0


# columns of a point of a surface: x, y, z mm, distance from the middle mm, block row, block column
_N_POINT = 6
_POINT_X, _POINT_Y, _POINT_Z, _POINT_DISTANCE, _POINT_ROW, _POINT_COLUMN = range(_N_POINT)


class HandSight(NamedTuple):
    """How a camera views a hand, and how its heights are measured.

    Attributes:
        near: least depth of a hand, mm.
        far: largest depth of a hand, mm.
        size: the hand's length over the skeleton's home length.
        behind: distance of the reference plane behind the hand's middle, mm.
        smooth: width over which heights are averaged, mm.
        intrinsics: (4,) fx, fy, cx, cy px.
        along_axis: whether heights are measured along the optical axis, else along the line of
            sight.
    """

    near: Any
    far: Any
    size: Any
    behind: Any
    smooth: Any
    intrinsics: Any
    along_axis: Any


@inner_kernel()
def locate(blocks, labels, surface, tip, size, intrinsics):
    """Locate the hand at an extremum of a surface; its blocks get the label MAX_SURFACES.

    The part that leaves the sphere around it is the arm; the hand is at the other end, one hand's
    length long.

    Args:
        blocks: (h, w) float32 mm.
        labels: (h, w) int32; the hand's blocks are marked in it.
        surface: the `SurfaceBlocks`.
        tip: (N_END,) the extremum, a row of `_geodesic_kernels.ends`.
        size: the hand's length over the skeleton's home length.
        intrinsics: (4,) fx, fy, cx, cy px.

    Returns:
        A `HandFind`.
    """
    fingers = np.zeros(3)
    row = int(tip[END_ROW])
    column = int(tip[END_COLUMN])
    middle = np.array(point_of_block(blocks, row, column, intrinsics))
    around = AROUND_MM * size
    focal2 = intrinsics[0] * intrinsics[1]
    cut = -1e9
    area = base = 0.0
    near = np.empty((len(surface.cells), _N_POINT))
    # the step of mean shift, before any cut
    tips = near[: _within(surface, 60.0 * size, middle, near)]  # of a home-sized hand, mm
    _beyond(tips, middle, fingers, cut, labels, False)
    for step in range(3):
        points = near[: _within(surface, around, middle, near)]
        has_arm = _away_from_arm(points, size, focal2, middle, fingers)
        cut = _wrist(points, size, focal2, middle, fingers) if has_arm else -1e9
        base = middle[0] * fingers[0] + middle[1] * fingers[1] + middle[2] * fingers[2]
        area = BLOCK * BLOCK * _beyond(points, middle, fingers, cut, labels, step == 2) / focal2
    return HandFind(middle, fingers, cut + base, area)


@kernel()
def _within(surface, radius, middle, near):
    """Copy the points of a surface within `radius` mm of the middle into rows of x, y, z, distance,
    block row, block column; returns their number.
    """
    points = surface.points
    n = 0
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        off2 = (x - middle[0]) ** 2 + (y - middle[1]) ** 2 + (z - middle[2]) ** 2
        if off2 < radius * radius:
            near[n, _POINT_X] = x
            near[n, _POINT_Y] = y
            near[n, _POINT_Z] = z
            near[n, _POINT_DISTANCE] = np.sqrt(off2)
            near[n, _POINT_ROW] = surface.cells[k, 0]
            near[n, _POINT_COLUMN] = surface.cells[k, 1]
            n += 1
    return n


@inner_kernel()
def _away_from_arm(points, size, focal2, middle, fingers):
    """The direction (3,) from the arm to the middle of the hand; False, and zeros, if no arm leaves
    the sphere.
    """
    shell = 0.0
    for k in range(3):
        fingers[k] = 0.0
    for n in range(len(points)):
        off = points[n, _POINT_DISTANCE]
        if off > 0.75 * AROUND_MM * size:  # only the arm is this far out
            w = BLOCK * BLOCK * points[n, _POINT_Z] * points[n, _POINT_Z] / focal2
            shell += w
            for k in range(3):
                fingers[k] -= w * (points[n, k] - middle[k]) / off
    norm = np.sqrt(fingers[0] ** 2 + fingers[1] ** 2 + fingers[2] ** 2)
    has_arm = shell > 900.0 * size * size and norm > 0.3 * shell
    for k in range(3):
        fingers[k] = fingers[k] / norm if has_arm else 0.0
    return has_arm


@inner_kernel()
def _wrist(points, size, focal2, middle, fingers):
    """Position of the cut through the arm along `fingers` (3,) from the middle, mm: a hand's length
    behind the fingertips.
    """
    around = AROUND_MM * size
    along = np.zeros(int(2.0 * around / _BIN_MM) + 2)
    for n in range(len(points)):
        s = _along(points[n], middle, fingers)
        along[int((s + around) / _BIN_MM)] += (
            BLOCK * BLOCK * points[n, _POINT_Z] * points[n, _POINT_Z] / focal2
        )
    b = along.size - 1
    tip = 0.0
    while b > 0 and tip < 100.0 * size * size:
        tip += along[b]
        b -= 1
    return b * _BIN_MM - around - 185.0 * size  # the length of a home-sized hand, mm


@kernel()
def _beyond(points, middle, fingers, cut, labels, mark):
    """Move `middle` (3,) to the middle of the blocks beyond the cut, optionally marked in labels;
    returns the sum of z^2.
    """
    total = x = y = z = 0.0
    for n in range(len(points)):
        if _along(points[n], middle, fingers) > cut:
            w = points[n, _POINT_Z] * points[n, _POINT_Z]
            total += w
            x += w * points[n, _POINT_X]
            y += w * points[n, _POINT_Y]
            z += w * points[n, _POINT_Z]
            if mark:
                labels[int(points[n, _POINT_ROW]), int(points[n, _POINT_COLUMN])] = MAX_SURFACES
    least = max(total, 1e-9)
    middle[0] = x / least
    middle[1] = y / least
    middle[2] = z / least
    return total


@kernel()
def _along(p, middle, fingers):
    """Distance of p (3,) from `middle` along `fingers`."""
    return (
        (p[0] - middle[0]) * fingers[0]
        + (p[1] - middle[1]) * fingers[1]
        + (p[2] - middle[2]) * fingers[2]
    )


@inner_kernel()
def compare_ends(blocks, labels, surfaces, ends, size, intrinsics, unlike):
    """How unlike a hand the segmentation at each extremum is.

    The score of `unlikeness`, and 0.012 for every mm behind the nearest one (up to 800 mm).

    Args:
        blocks: (h, w) float32 mm.
        labels: (h, w) int32; restored on return.
        surfaces: a `SurfaceBlocks` for each.
        ends: (n, N_END) rows of `_geodesic_kernels.ends`.
        size: the hand's length over the skeleton's home length.
        intrinsics: (4,) fx, fy, cx, cy px.
        unlike: (n,), out: lower is more hand-like.
    """
    depth = np.empty(len(unlike))
    nearest = 1e9
    for k in range(len(unlike)):
        surface = surfaces[labels[int(ends[k, END_ROW]), int(ends[k, END_COLUMN])]]
        found = locate(blocks, labels, surface, ends[k], size, intrinsics)
        depth[k], unlike[k] = unlikeness(
            blocks, labels, surface, MAX_SURFACES, found, size, intrinsics
        )
        nearest = min(nearest, depth[k])
    for k in range(len(unlike)):
        unlike[k] += 0.012 * min(depth[k] - nearest, 800.0)


@inner_kernel()
def box_of(labels, surface, mark, box):
    """The bounding box of the blocks of a surface that are labelled `mark`.

    Args:
        labels: (h, w) int32.
        surface: the `SurfaceBlocks`.
        mark: the label.
        box: (4,) int64, out: first and last row, first and last column; first beyond last for none.
    """
    box[0] = labels.shape[0]
    box[1] = -1
    box[2] = labels.shape[1]
    box[3] = -1
    cells = surface.cells
    for k in range(len(cells)):
        i, j = cells[k, 0], cells[k, 1]
        if labels[i, j] == mark:
            box[0], box[1] = min(box[0], i), max(box[1], i)
            box[2], box[3] = min(box[2], j), max(box[3], j)


@kernel()
def sight_rotation(x, y, rotation):
    """Rotation of T_view_camera for a line of sight (x, y, 1): z points at the camera along it.

    The view's x axis is the camera's, as far as the line of sight allows.

    Args:
        x: of the line of sight at z = 1.
        y: of the line of sight at z = 1.
        rotation: (3, 3), out.
    """
    length = np.sqrt(x * x + y * y + 1.0)
    up = np.array([-x / length, -y / length, -1.0 / length])
    rotation[0, 0] = 1.0 - up[0] * up[0]
    rotation[0, 1] = -up[0] * up[1]
    rotation[0, 2] = -up[0] * up[2]
    norm = np.sqrt(rotation[0, 0] ** 2 + rotation[0, 1] ** 2 + rotation[0, 2] ** 2)
    for k in range(3):
        rotation[0, k] /= norm
        rotation[2, k] = up[k]
    rotation[1, 0] = up[1] * rotation[0, 2] - up[2] * rotation[0, 1]
    rotation[1, 1] = up[2] * rotation[0, 0] - up[0] * rotation[0, 2]
    rotation[1, 2] = up[0] * rotation[0, 1] - up[1] * rotation[0, 0]


@inner_kernel()
def cut_heights(
    depth, blocks, labels, found, plane, distance, intrinsics, origin, step, near, far, raw
):
    """Heights of the hand's pixels above the plane behind it, on a crop.

    A pixel belongs to the hand if a block of the hand is at or next to it, if it is at most 45 mm
    farther than that block, and if it is beyond the cut through the arm.

    Args:
        depth: (H, W) mm, 0 where unread.
        blocks: (h, w) float32 mm.
        labels: (h, w) int32, the hand's blocks labelled MAX_SURFACES.
        found: `HandFind` of the hand.
        plane: (3,) a, b, c of the plane behind the hand, 1 / z = a u + b v + c.
        distance: of the camera from it, mm.
        intrinsics: (4,) fx, fy, cx, cy px.
        origin: (2,) int32, image pixel (u, v) of crop pixel (0, 0).
        step: image pixels per crop pixel.
        near: nearer readings count as unread, mm.
        far: farther readings are not the hand, mm.
        raw: (S, S) float32 mm, out: heights, -1 background, -2 unread.
    """
    size = raw.shape[0]
    reaches = np.full((labels.shape[0] + 1, labels.shape[1] + 1), -1.0, np.float32)
    for r in range(size):
        v = origin[1] + step * r
        for c in range(size):
            u = origin[0] + step * c
            raw[r, c] = -1.0
            if not (
                0 < r < size - 1
                and 0 < c < size - 1
                and 0 <= v < depth.shape[0]
                and 0 <= u < depth.shape[1]
            ):
                continue
            row = v // BLOCK
            column = u // BLOCK
            if reaches[row, column] < 0.0:
                reaches[row, column] = _reach(blocks, labels, row, column)
            reach = reaches[row, column]
            z = depth[v, u]
            if reach == 0.0 or z >= min(reach, far):
                continue
            if z <= near:
                raw[r, c] = -2.0
                continue
            x = (u - intrinsics[2]) / intrinsics[0] * z
            y = (v - intrinsics[3]) / intrinsics[1] * z
            if x * found.fingers[0] + y * found.fingers[1] + z * found.fingers[2] <= found.cut:
                continue
            above = distance * (1.0 - z * (plane[0] * u + plane[1] * v + plane[2]))
            if above > 0.0:
                raw[r, c] = above


@inner_kernel()
def _reach(blocks, labels, row, column):
    """Largest depth of a pixel of the hand in this block, mm; 0 if no block near it belongs to the
    hand.
    """
    farthest = np.float32(0.0)
    for a in range(max(row - 1, 0), min(row + 2, labels.shape[0])):
        for b in range(max(column - 1, 0), min(column + 2, labels.shape[1])):
            if labels[a, b] == MAX_SURFACES:
                farthest = max(farthest, blocks[a, b])
    return farthest + np.float32(45.0) if farthest > 0 else farthest  # mm, its thickness there


@inner_kernel()
def extract_one(depth, n_candidates, sight, crops, k):
    """Find the hand in one frame and fill its row of the batch; see `HandSegmenter.extract`.

    With n_candidates 2, the batch has two rows per frame, and its second half receives the second
    candidate: an extremum whose unlikeness exceeds that of the first by at most 1.

    Args:
        depth: (H, W) mm, 0 where unread.
        n_candidates: per frame, 1 or 2.
        sight: `HandSight` of the image.
        crops: `CropRows`, out; the long axis points away from the arm, if visible.
        k: the frame's row.
    """
    size = sight.size
    intrinsics = sight.intrinsics
    blocks = np.empty((depth.shape[0] // BLOCK, depth.shape[1] // BLOCK), np.float32)
    labels = np.empty(blocks.shape, np.int32)
    areas = np.empty(MAX_SURFACES)
    ends = np.empty((8, N_END))
    focal2 = intrinsics[0] * intrinsics[1]
    block_depths(depth, sight.near, sight.far, blocks)
    # no hand is smaller
    n_surfaces = label_surfaces(blocks, labels, focal2, 2500.0 * size * size, areas)
    surfaces = list_surfaces(blocks, labels, n_surfaces, intrinsics)
    n_ends = nearest_ends(blocks, labels, surfaces, size, intrinsics, ends)
    unlike = np.empty(n_ends)
    compare_ends(blocks, labels, surfaces, ends, size, intrinsics, unlike)
    ranked = np.argsort(unlike)
    n_alike = min(n_ends, 2)
    if n_ends > 1 and unlike[ranked[1]] > unlike[ranked[0]] + 1.0:  # the second is no hand
        n_alike = 1
    for rank in range(n_candidates):
        row = k + rank * (len(crops.n_px) // n_candidates)
        crops.n_blobs[row] = n_alike
        if rank < n_alike:
            end = ends[ranked[rank]]
            surface = surfaces[labels[int(end[END_ROW]), int(end[END_COLUMN])]]
            cut_end(depth, blocks, labels, surface, end, sight, crops, row)


@inner_kernel()
def cut_end(depth, blocks, labels, surface, end, sight, crops, k):
    """The height map of the hand at an extremum, and its moments; labels are preserved.

    Args:
        depth: (H, W) mm, 0 where unread.
        blocks: (h, w) float32 mm.
        labels: (h, w) int32.
        surface: the `SurfaceBlocks` of the extremum.
        end: (N_END,) the extremum.
        sight: `HandSight` of the image.
        crops: `CropRows`, out.
        k: the row.
    """
    intrinsics = sight.intrinsics
    box = np.empty(4, np.int64)
    found = locate(blocks, labels, surface, end, sight.size, intrinsics)
    box_of(labels, surface, MAX_SURFACES, box)
    if box[1] < 0:
        return
    heights = crops.heights[k]
    origin = crops.origin[k]
    moments = crops.moments[k]
    crop = heights.shape[0]
    span = BLOCK * (max(box[1] - box[0], box[3] - box[2]) + 3)
    step = max(1, int(np.ceil(span / (crop - 4))))
    middle_u = 0.5 * BLOCK * (box[2] + box[3] + 1)
    middle_v = 0.5 * BLOCK * (box[0] + box[1] + 1)
    origin[0] = int(middle_u - step * crop / 2)
    origin[1] = int(middle_v - step * crop / 2)
    crops.step[k] = step
    rotation = np.empty((3, 3))
    x, y = view_axis(origin, step, crop, intrinsics, sight.along_axis)
    sight_rotation(x, y, rotation)
    distance = sight.behind - (
        rotation[2, 0] * found.middle[0]
        + rotation[2, 1] * found.middle[1]
        + rotation[2, 2] * found.middle[2]
    )
    crops.distance[k] = distance
    plane = view_plane(rotation, distance, intrinsics)
    raw = np.empty((crop, crop), np.float32)
    cut_heights(
        depth,
        blocks,
        labels,
        found,
        plane,
        distance,
        intrinsics,
        origin,
        step,
        sight.near,
        sight.far,
        raw,
    )
    relabel(labels, surface)
    blob_kernels.keep_largest(raw, np.empty((crop * crop, 5), np.int32))
    mm_per_px = step * found.middle[2] / np.sqrt(intrinsics[0] * intrinsics[1])
    radius = min(3, max(1, int(sight.smooth / mm_per_px + 0.5)))
    blob_kernels.smooth_heights(raw, radius, heights)
    blob_kernels.blob_moments(heights, origin, step, plane, intrinsics, rotation, distance, moments)
    # the arm decides the direction of the fingers along the long axis
    along = rotation @ found.fingers
    angle = moments[blob_kernels.ANGLE]
    if along[0] * np.cos(angle) + along[1] * np.sin(angle) < 0.0:
        moments[blob_kernels.ANGLE] += np.pi
    crops.n_px[k] = int(moments[blob_kernels.N_PX])


@inner_kernel()
def view_axis(origin, step, crop, intrinsics, along_axis):
    """Direction of the view's axis: through the middle of the crop, or the optical axis.

    Args:
        origin: (2,) image pixel (u, v) of crop pixel (0, 0).
        step: image pixels per crop pixel.
        crop: side of the crop, px.
        intrinsics: (4,) fx, fy, cx, cy px.
        along_axis: whether along the optical axis.

    Returns:
        x and y at z = 1, camera frame.
    """
    if along_axis:
        return 0.0, 0.0
    return (
        (origin[0] + step * crop / 2.0 - intrinsics[2]) / intrinsics[0],
        (origin[1] + step * crop / 2.0 - intrinsics[3]) / intrinsics[1],
    )


@inner_kernel()
def view_plane(rotation, distance, intrinsics):
    """Coefficients (3,) a, b, c of a view's reference plane: 1 / z = a u + b v + c.

    Args:
        rotation: (3, 3) of T_view_camera.
        distance: of the camera from the plane, mm.
        intrinsics: (4,) fx, fy, cx, cy px.
    """
    a = -rotation[2, 0] / intrinsics[0] / distance
    b = -rotation[2, 1] / intrinsics[1] / distance
    return np.array([a, b, -rotation[2, 2] / distance - a * intrinsics[2] - b * intrinsics[3]])


@kernel(nogil=True)
def extract_all(depths, n_candidates, sights, crops, start, stop):
    """Find the hand in every image and fill the batch.

    Args:
        depths: (n, H, W) mm, 0 where unread.
        n_candidates: per image; the batch has N = n_candidates n rows, best candidates first.
        sights: `HandSight` of the images: size, behind, smooth and intrinsics with a leading axis
            (n,).
        crops: `CropRows`, out.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for k in range(start, stop):
        sight = HandSight(
            sights.near,
            sights.far,
            sights.size[k],
            sights.behind[k],
            sights.smooth[k],
            sights.intrinsics[k],
            sights.along_axis,
        )
        extract_one(depths[k], n_candidates, sight, crops, k)


@kernel()
def fill_rotations(intrinsics, origin, step, crop, along_axis, rotations):
    """Rotations of T_view_camera along the lines of sight through the middles of crops.

    Args:
        intrinsics: (n, 4) fx, fy, cx, cy px.
        origin: (n, 2) image pixel (u, v) of crop pixel (0, 0).
        step: (n,) image pixels per crop pixel.
        crop: side of the crops, px.
        along_axis: whether along the optical axis instead.
        rotations: (n, 3, 3), out.
    """
    for k in range(len(step)):
        x, y = view_axis(origin[k], step[k], crop, intrinsics[k], along_axis)
        sight_rotation(x, y, rotations[k])
