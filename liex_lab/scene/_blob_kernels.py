"""Kernels of connected components, height maps and image moments of one frame.

- Components: flood fill over blocks of 4 x 4 pixels, 8-connected; within a crop, run-length
  labelling with union-find.
- Smoothing: box filter by a summed-area table (Crow 1984).
- Moments: area, volume, centroid and covariance of the foreground points; the long axis at angle
  1/2 atan2(2 cov_xy, cov_xx - cov_yy) (Hu 1962).
- Slope of the back: line fit by iteratively reweighted least squares with Geman and McClure's
  weights w = 1 / (1 + (r / s)^2)^2.
"""

from typing import Any, NamedTuple

import numpy as np

from liex_lab.runtime.kernels import inner_kernel, kernel

BLOCK = 4  # pixels per side; blobs are connected in blocks
MAX_BLOBS = 32


class Blob(NamedTuple):
    """The counts of one component, in packing order.

    Attributes:
        n_px: foreground pixels.
        first_row: first row of blocks.
        last_row: last row of blocks.
        first_column: first column of blocks.
        last_column: last column of blocks.
        depth_sum: sum of the depths of its pixels, mm.
        n_on_floor: its pixels on the floor.
    """

    n_px: Any
    first_row: Any
    last_row: Any
    first_column: Any
    last_column: Any
    depth_sum: Any
    n_on_floor: Any


N_BLOB = len(Blob._fields)


class BlobMoments(NamedTuple):
    """The moments of one component, or columns (n,) of many, in packing order.

    Attributes:
        n_px: readings on the animal, pixels of the height map.
        area_mm2: area from above, mm^2.
        volume_mm3: volume under the back, mm^3.
        x: centroid, mm, view frame.
        y: centroid, mm, view frame.
        angle: direction of the long axis, rad, modulo pi.
        sd_along: standard deviation along the long axis, mm.
        sd_across: standard deviation across it, mm.
        slope: slope of the back along it; 0 if not measured.
    """

    n_px: Any
    area_mm2: Any
    volume_mm3: Any
    x: Any
    y: Any
    angle: Any
    sd_along: Any
    sd_across: Any
    slope: Any


N_MOMENTS = len(BlobMoments._fields)
N_PX, AREA, VOLUME, X, Y, ANGLE, SD_ALONG, SD_ACROSS, SLOPE = range(N_MOMENTS)


@inner_kernel()
def unpack_blob(packed):
    """The record of one component's packed counts (N_BLOB,)."""
    return Blob(packed[0], packed[1], packed[2], packed[3], packed[4], packed[5], packed[6])


@inner_kernel()
def unpack_moments(packed):
    """The record of one component's packed moments (N_MOMENTS,)."""
    return BlobMoments(
        packed[0],
        packed[1],
        packed[2],
        packed[3],
        packed[4],
        packed[5],
        packed[6],
        packed[7],
        packed[8],
    )


@inner_kernel()
def label_blobs(depth, limit, on_floor, bridge, labels, blobs):
    """Connected components of the pixels nearer than a limit, in blocks.

    Every other row is read; a block counts if 3 of its 8 pixels do. Up to `bridge` unread blocks do
    not split a component.

    Args:
        depth: (H, W) mm, 0 where unread.
        limit: (H, W) mm; a reading below it is foreground.
        on_floor: (H, W) bool, the floor.
        bridge: unread blocks allowed between the parts of one component.
        labels: (H // BLOCK, W // BLOCK) int32, out: the component of each block, -1 for none.
        blobs: (MAX_BLOBS, N_BLOB), out: a packed `Blob` for each component.

    Returns:
        The number of components; the largest ones if there are more than fit.
    """
    n_rows, n_columns = labels.shape
    hits = np.empty(n_columns * BLOCK, np.uint8)
    for i in range(n_rows):
        hits[:] = 0
        for r in range(0, BLOCK, 2):  # reading takes longer than processing
            row_depth = depth[i * BLOCK + r]
            row_limit = limit[i * BLOCK + r]
            for c in range(hits.size):
                z = row_depth[c]
                hits[c] += (z > 0) & (z < row_limit[c])
        for j in range(n_columns):
            count = 0
            for c in range(BLOCK):
                count += hits[j * BLOCK + c]
            labels[i, j] = -2 if count >= 3 else -1  # of the 8 inspected pixels
    n_blobs = 0
    stack = np.empty((n_rows * n_columns, 3), np.int32)
    for i in range(n_rows):
        for j in range(n_columns):
            if labels[i, j] != -2:
                continue
            if n_blobs == MAX_BLOBS:
                slot = int(np.argmin(blobs[:, 0]))  # that of the fewest pixels
                forget(labels, slot)
            else:
                slot = n_blobs
                n_blobs += 1
            _flood(depth, limit, on_floor, bridge, labels, i, j, slot, stack, blobs[slot])
    return n_blobs


@kernel()
def layers(depth, limit, labels, slot, blob, apart):
    """The depth that separates a component into a near and a far layer, and the extent of both.

    The largest gap in the sorted depths of its blocks that is wider than `apart`. A block counts
    with its middle depth, so one on an edge belongs to one side of it.

    Args:
        depth: (H, W) mm, 0 where unread.
        limit: (H, W) mm; a reading below it is foreground.
        labels: (H // BLOCK, W // BLOCK) int32, component of each block.
        slot: the component.
        blob: the component's counts.
        apart: least width of the gap, mm.

    Returns:
        The depth mm in the middle of the gap, 0 for none; and the sums of the squared depths of the
        pixels in the near and in the far layer, mm^2.
    """
    found = np.empty(labels.size, np.float32)
    values = np.empty(BLOCK * BLOCK, np.float32)
    n = 0
    for i in range(int(blob.first_row), int(blob.last_row) + 1):
        for j in range(int(blob.first_column), int(blob.last_column) + 1):
            if labels[i, j] != slot:
                continue
            m = 0
            for v in range(i * BLOCK, i * BLOCK + BLOCK):
                for u in range(j * BLOCK, j * BLOCK + BLOCK):
                    if 0 < depth[v, u] < limit[v, u]:
                        values[m] = depth[v, u]
                        m += 1
            if m > 0:
                found[n] = np.sort(values[:m])[m // 2]
                n += 1
    ordered = np.sort(found[:n])
    gap = apart
    cut = 0.0
    for k in range(1, n):
        if ordered[k] - ordered[k - 1] > gap:
            gap = ordered[k] - ordered[k - 1]
            cut = 0.5 * (ordered[k] + ordered[k - 1])
    near = far = 0.0
    for z in ordered:
        near += BLOCK * BLOCK * z * z * (z < cut)
        far += BLOCK * BLOCK * z * z * (z >= cut)
    return cut, near, far


@kernel()
def forget(labels, slot):
    """Turn the blocks labelled `slot` in labels (h, w) into background, -1."""
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            if labels[i, j] == slot:
                labels[i, j] = -1


@inner_kernel()
def _is_unread(depth, row, column):
    """Whether most of a block has no reading."""
    n = 0
    for v in range(row * BLOCK, row * BLOCK + BLOCK):
        for u in range(column * BLOCK, column * BLOCK + BLOCK):
            n += depth[v, u] == 0
    return n >= 9  # of 16 pixels


@inner_kernel()
def _flood(depth, limit, on_floor, bridge, labels, i, j, slot, stack, packed):
    """Flood fill: blocks connected with (i, j) get the label `slot`, and `packed` their counts."""
    n_px = 0
    first_row = last_row = i
    first_column = last_column = j
    depth_sum = 0.0
    n_on_floor = 0
    top = 1
    stack[0, 0] = i
    stack[0, 1] = j
    stack[0, 2] = 0
    labels[i, j] = slot
    while top > 0:
        top -= 1
        row, column, gone = stack[top, 0], stack[top, 1], stack[top, 2]
        if gone == 0:
            first_row = min(first_row, row)
            last_row = max(last_row, row)
            first_column = min(first_column, column)
            last_column = max(last_column, column)
        for v in range(row * BLOCK, row * BLOCK + BLOCK):
            for u in range(column * BLOCK, column * BLOCK + BLOCK):
                z = depth[v, u]
                if z > 0 and z < limit[v, u]:
                    n_px += 1
                    depth_sum += float(z)
                    n_on_floor += on_floor[v, u]
        for di in range(-1, 2):
            for dj in range(-1, 2):
                a = row + di
                b = column + dj
                if not (0 <= a < labels.shape[0] and 0 <= b < labels.shape[1]):
                    continue
                on = labels[a, b] == -2
                if on or (labels[a, b] == -1 and gone < bridge and _is_unread(depth, a, b)):
                    labels[a, b] = slot
                    stack[top, 0] = a
                    stack[top, 1] = b
                    stack[top, 2] = 0 if on else gone + 1
                    top += 1
    packed[0] = n_px
    packed[1] = first_row
    packed[2] = last_row
    packed[3] = first_column
    packed[4] = last_column
    packed[5] = depth_sum
    packed[6] = n_on_floor


@inner_kernel()
def is_animal_block(labels, row, column, slot):
    """Whether a block belongs to the component or borders it without belonging to another one.

    Args:
        labels: (H // BLOCK, W // BLOCK) int32, component of each block.
        row: of the block; may lie outside.
        column: of the block; may lie outside.
        slot: the component.
    """
    if row < 0 or column < 0 or row >= labels.shape[0] or column >= labels.shape[1]:
        return False
    if labels[row, column] >= 0:
        return labels[row, column] == slot
    for di in range(-1, 2):
        for dj in range(-1, 2):
            a = row + di
            b = column + dj
            if 0 <= a < labels.shape[0] and 0 <= b < labels.shape[1] and labels[a, b] == slot:
                return True
    return False


@inner_kernel()
def cut_heights(depth, limit, labels, slot, plane, distance, origin, step, raw):
    """Heights above a plane of a component's pixels, on a crop.

    The height of a point at depth z in pixel (u, v) is `distance * (1 - z (a u + b v + c))`. Crop
    pixel (r, c) is image pixel origin + step * (c, r). The outermost ring stays background, so a
    probe clamped to the border reads background.

    Args:
        depth: (H, W) mm, 0 where unread.
        limit: (H, W) mm; a reading below it is foreground.
        labels: (H // BLOCK, W // BLOCK) int32, component of each block.
        slot: the component.
        plane: (3,) a, b, c of the plane, 1 / z = a u + b v + c.
        distance: of the camera from it, mm.
        origin: (2,) int32, image pixel (u, v) of crop pixel (0, 0).
        step: image pixels per crop pixel.
        raw: (S, S) float32 mm, out: heights, -1 background, -2 unread.
    """
    size = raw.shape[0]
    height, width = depth.shape
    a, b, c0 = plane[0], plane[1], plane[2]
    for r in range(size):
        v = origin[1] + step * r
        for c in range(size):
            u = origin[0] + step * c
            value = np.float32(-1.0)
            if 0 < r < size - 1 and 0 < c < size - 1 and 0 <= v < height and 0 <= u < width:
                z = depth[v, u]
                if (z == 0 or z < limit[v, u]) and is_animal_block(
                    labels, v // BLOCK, u // BLOCK, slot
                ):
                    above = max(0.0, distance * (1.0 - z * (a * u + b * v + c0)))
                    value = np.float32(-2.0) if z == 0 else np.float32(above)
            raw[r, c] = value


@inner_kernel()
def find_root(parent, k):
    """The root of k in a union-find forest, with path halving.

    Args:
        parent: (n,) parents; a root is its own.
        k: the element.
    """
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@inner_kernel()
def keep_largest(raw, runs):
    """Erase all pixels of a crop except the largest group, in which no gap is wider than a pixel.

    Blocks connect what is a few pixels apart; this separates a neighbour from the animal pixel by
    pixel. Rows are split into runs of pixels, and union-find joins the runs that touch, or nearly
    touch, those in the two rows above.

    Args:
        raw: (S, S) float32, -1 background; changed in place.
        runs: (S * S, 5) int32, scratch: row, first and last column, readings, parent.
    """
    size = raw.shape[0]
    n = 0
    parent = runs[:, 4]
    # the first run of the row above, and of the one above that
    above = higher = 0
    for r in range(1, size - 1):
        begin = n
        for c in range(1, size - 1):
            if raw[r, c] == -1.0:
                continue
            if n == begin or c > runs[n - 1, 2] + 2:
                runs[n, 0] = r
                runs[n, 1] = c
                runs[n, 3] = 0
                parent[n] = n
                n += 1
            runs[n - 1, 2] = c
            runs[n - 1, 3] += raw[r, c] >= 0.0
        for k in range(begin, n):
            for other in range(higher, begin):
                if runs[other, 1] <= runs[k, 2] + 2 and runs[k, 1] <= runs[other, 2] + 2:
                    a = find_root(parent, other)
                    b = find_root(parent, k)
                    parent[max(a, b)] = min(a, b)
        higher = above
        above = begin
    best = -1
    best_count = 0
    for k in range(n):
        root = find_root(parent, k)
        if root != k:
            runs[root, 3] += runs[k, 3]
    for k in range(n):
        if parent[k] == k and runs[k, 3] > best_count:
            best = k
            best_count = runs[k, 3]
    for k in range(n):
        if find_root(parent, k) != best:
            for c in range(runs[k, 1], runs[k, 2] + 1):
                raw[runs[k, 0], c] = -1.0


@kernel()
def level_heights(raw, behind_mm):
    """Shift all heights so that their mean becomes behind_mm, and erase those not above 0.

    The mean excludes heights farther than behind_mm from it (three passes).

    Args:
        raw: (S, S) float32 mm; changed in place.
        behind_mm: height of the mean.

    Returns:
        The shift, mm.
    """
    mean = 0.0
    reach = np.inf
    for _ in range(3):
        total = 0.0
        n = 0
        for r in range(raw.shape[0]):
            for c in range(raw.shape[1]):
                if raw[r, c] >= 0.0 and abs(raw[r, c] - mean) <= reach:
                    total += raw[r, c]
                    n += 1
        mean = total / max(n, 1)
        reach = behind_mm
    lift = behind_mm - mean
    for r in range(raw.shape[0]):
        for c in range(raw.shape[1]):
            if raw[r, c] >= 0.0:
                raw[r, c] += lift
                if raw[r, c] <= 0.0:
                    raw[r, c] = -1.0
    return lift


@inner_kernel()
def smooth_heights(raw, radius, out):
    """Box-filtered heights, with holes filled from their surroundings.

    A pixel of the animal becomes the mean of the animal's pixels within `radius`; an unread pixel
    becomes that mean within one pixel more if at least 5 of the pixels there are the animal and
    more than twice as many of them as are background. Sums over boxes are differences of running
    sums (a summed-area table).

    Args:
        raw: (S, S) float32 mm, -1 background, -2 unread.
        radius: of the box, px; its side is 2 radius + 1.
        out: (S, S) int16, 1/16 mm, out: 0 background, at most 32000.
    """
    size = raw.shape[0]
    top = size
    bottom = 0
    for r in range(1, size - 1):
        for c in range(1, size - 1):
            if raw[r, c] != -1.0:
                top = min(top, r)
                bottom = r
                break
    out[:] = 0
    total = np.zeros((size + 1, size + 1))
    animal = np.zeros((size + 1, size + 1), np.int32)
    background = np.zeros((size + 1, size + 1), np.int32)
    for r in range(max(top - radius - 1, 0), min(bottom + radius + 2, size)):
        row_total = 0.0
        row_animal = row_background = 0
        for c in range(size):
            value = raw[r, c]
            row_total += value if value >= 0.0 else 0.0
            row_animal += value >= 0.0
            row_background += value == -1.0
            total[r + 1, c + 1] = total[r, c + 1] + row_total
            animal[r + 1, c + 1] = animal[r, c + 1] + row_animal
            background[r + 1, c + 1] = background[r, c + 1] + row_background
    for r in range(top, bottom + 1):
        for c in range(1, size - 1):
            here = raw[r, c]
            if here == -1.0:
                continue
            reach = radius if here >= 0.0 else radius + 1
            a = max(r - reach, 0)
            b = min(r + reach + 1, size)
            e = max(c - reach, 0)
            f = min(c + reach + 1, size)
            n = animal[b, f] - animal[a, f] - animal[b, e] + animal[a, e]
            n_background = background[b, f] - background[a, f] - background[b, e] + background[a, e]
            if here >= 0.0 or (n >= 5 and n > 2 * n_background):
                mean = (total[b, f] - total[a, f] - total[b, e] + total[a, e]) / n
                out[r, c] = min(32000, int(mean * 16.0 + 0.5))


@inner_kernel()
def blob_moments(heights, origin, step, plane, intrinsics, rotation, distance, moments):
    """Mass, area and principal axes of an animal from its height map, in the view frame.

    Args:
        heights: (S, S) int16, 1/16 mm, 0 background.
        origin: (2,) int32, image pixel (u, v) of crop pixel (0, 0).
        step: image pixels per crop pixel.
        plane: (3,) a, b, c of the reference plane, 1 / z = a u + b v + c.
        intrinsics: (4,) fx, fy, cx, cy px.
        rotation: (3, 3) of T_view_camera, whose translation is (0, 0, distance).
        distance: of the camera from the plane, mm.
        moments: (N_MOMENTS,), out: pixels, area mm^2 (from the camera), volume mm^3, x, y mm
            of the centroid, angle rad of the long axis (mod pi), the standard deviations mm along
            and across it, and 0, reserved for `back_slope`. All 0 for an empty map.
    """
    n = 0
    area = volume = sx = sy = sxx = sxy = syy = 0.0
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    for r in range(1, heights.shape[0] - 1):
        v = origin[1] + step * r
        for c in range(1, heights.shape[1] - 1):
            if heights[r, c] <= 0:
                continue
            u = origin[0] + step * c
            h = heights[r, c] / 16.0
            z = (1.0 - h / distance) / (plane[0] * u + plane[1] * v + plane[2])
            xc = (u - cx) / fx * z
            yc = (v - cy) / fy * z
            x = rotation[0, 0] * xc + rotation[0, 1] * yc + rotation[0, 2] * z
            y = rotation[1, 0] * xc + rotation[1, 1] * yc + rotation[1, 2] * z
            w = step * step * z * z / (fx * fy)
            n += 1
            area += w
            volume += w * h
            sx += w * x
            sy += w * y
            sxx += w * x * x
            sxy += w * x * y
            syy += w * y * y
    for k in range(N_MOMENTS):
        moments[k] = 0.0
    if n == 0:
        return
    mx = sx / area
    my = sy / area
    vxx = sxx / area - mx * mx
    vxy = sxy / area - mx * my
    vyy = syy / area - my * my
    angle = 0.5 * np.arctan2(2.0 * vxy, vxx - vyy)
    half = 0.5 * (vxx + vyy)
    root = np.sqrt(0.25 * (vxx - vyy) ** 2 + vxy * vxy)
    moments[N_PX] = n
    moments[AREA] = area
    moments[VOLUME] = volume
    moments[X] = mx
    moments[Y] = my
    moments[ANGLE] = angle
    moments[SD_ALONG] = np.sqrt(max(half + root, 0.0))
    moments[SD_ACROSS] = np.sqrt(max(half - root, 0.0))


@inner_kernel()
def back_slope(heights, origin, step, intrinsics, distance, moments):
    """Slope of the back along the long axis, in a height map cut along the optical axis.

    A line fit to the heights that downweights outliers with every pass (Geman and McClure's
    weights), as light fields have large errors in patches.

    Args:
        heights: (S, S) int16, 1/16 mm, 0 background.
        origin: (2,) int32, image pixel (u, v) of crop pixel (0, 0).
        step: image pixels per crop pixel.
        intrinsics: (4,) fx, fy, cx, cy px.
        distance: of the camera from the reference plane, mm.
        moments: (N_MOMENTS,) of the map, see `blob_moments`.

    Returns:
        Height mm per mm along the axis.
    """
    size = heights.shape[0]
    along = np.empty(size * size)
    height = np.empty(size * size)
    c = np.cos(moments[ANGLE])
    s = np.sin(moments[ANGLE])
    n = 0
    for r in range(1, size - 1):
        for k in range(1, size - 1):
            if heights[r, k] > 0:
                z = distance - heights[r, k] / 16.0
                x = (origin[0] + step * k - intrinsics[2]) / intrinsics[0] * z
                y = -(origin[1] + step * r - intrinsics[3]) / intrinsics[1] * z
                along[n] = c * (x - moments[X]) + s * (y - moments[Y])
                height[n] = heights[r, k] / 16.0
                n += 1
    level = slope = 0.0
    scale = np.inf
    for _ in range(5):
        sw = sx = sh = sxx = sxh = 0.0
        for i in range(n):
            off = (height[i] - level - slope * along[i]) / scale
            w = 1.0 / (1.0 + off * off) ** 2
            sw += w
            sx += w * along[i]
            sh += w * height[i]
            sxx += w * along[i] * along[i]
            sxh += w * along[i] * height[i]
        spread = sw * sxx - sx * sx
        if spread <= 1e-9:
            return slope
        slope = (sw * sxh - sx * sh) / spread
        level = (sh - slope * sx) / sw
        total = weight = 0.0
        for i in range(n):
            off = abs(height[i] - level - slope * along[i])
            w = 1.0 if scale == np.inf else 1.0 / (1.0 + (off / scale) ** 2)
            total += w * off
            weight += w
        scale = max(2.0 * total / weight, 1e-3)
    return slope
