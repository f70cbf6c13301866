"""Kernels that select the animal among connected components and cut its height map, frame by frame.

Every frame: `label_blobs` connects foreground pixels to components; the component whose area in
mm^2 (pixels times the squared mean depth over fx fy) is nearest to the animal's on a logarithmic
scale is the animal; `cut_heights`, `keep_largest`, `smooth_heights` and `blob_moments` make its
height map. In camera view, objects that merely overlap the animal in the image are separated by the
largest gap in depth.
"""

from typing import Any, NamedTuple

import numpy as np

from liex_lab.runtime.kernels import inner_kernel, kernel
from liex_lab.scene import _blob_kernels as blob_kernels

AREA_FACTOR = 4.0  # a blob this many times larger or smaller than the animal is not the animal
BRIDGE = 4  # blocks without readings that may lie between the parts of an animal of the camera view
_ON_FLOOR_SHARE = 0.3  # least share on the floor of an animal that leans over its edge


class Sight(NamedTuple):
    """How a camera views the floor, and how heights above it are measured.

    Attributes:
        intrinsics: (4,) fx, fy, cx, cy px.
        plane: (3,) the floor, 1 / z = a u + b v + c.
        rotation: (3, 3) of T_view_camera.
        behind_mm: 0 measures heights above the floor, else along the optical axis from this
            distance behind the mean depth.
        smooth_mm: width over which heights are averaged, mm.
    """

    intrinsics: Any
    plane: Any
    rotation: Any
    behind_mm: Any
    smooth_mm: Any


@kernel(nogil=True)
def blob_areas(depths, limit, on_floor, bridge, mm2_per_px, areas, start, stop):
    """Areas of the connected components of every frame; 0 for one that does not stand on the floor.

    Args:
        depths: (n, H, W) mm, 0 where unread.
        limit: (H, W) mm; a reading below it is foreground.
        on_floor: (H, W) bool, the floor; a component stands on it with 30 % of its pixels.
        bridge: unread blocks allowed between the parts of one component.
        mm2_per_px: 1 / (fx fy).
        areas: (n, MAX_BLOBS) mm^2, out; 0 on entry.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for k in range(start, stop):
        labels = np.empty(
            (depths.shape[1] // blob_kernels.BLOCK, depths.shape[2] // blob_kernels.BLOCK), np.int32
        )
        blobs = np.empty((blob_kernels.MAX_BLOBS, blob_kernels.N_BLOB))
        for slot in range(
            blob_kernels.label_blobs(depths[k], limit, on_floor, bridge, labels, blobs)
        ):
            blob = blob_kernels.unpack_blob(blobs[slot])
            if blob.n_on_floor >= _ON_FLOOR_SHARE * blob.n_px:
                areas[k, slot] = blob_area(blob, mm2_per_px)


@inner_kernel()
def blob_area(blob, mm2_per_px):
    """Area mm^2, from the camera, of a component at its mean depth.

    Args:
        blob: the component's counts.
        mm2_per_px: 1 / (fx fy).
    """
    return blob.n_px * (blob.depth_sum / blob.n_px) ** 2 * mm2_per_px


@kernel()
def order_blobs(blobs, n_blobs, area, mm2_per_px):
    """Order the components by similarity of their areas to the animal's, and count the similar
    ones.

    While `area` is 0 the largest is first.

    Args:
        blobs: (MAX_BLOBS, N_BLOB) as `label_blobs` fills it.
        n_blobs: filled rows.
        area: the animal's usual area, mm^2, 0 while unknown.
        mm2_per_px: 1 / (fx fy).

    Returns:
        Rows of blobs, nearest first, and how many stand on the floor and have about the animal's
        area (within a factor of 4).
    """
    distances = np.full(n_blobs, np.inf)
    n_near = 0
    for slot in range(n_blobs):
        blob = blob_kernels.unpack_blob(blobs[slot])
        if blob.n_on_floor < _ON_FLOOR_SHARE * blob.n_px:
            continue
        here = blob_area(blob, mm2_per_px)
        distances[slot] = abs(np.log(here / area)) if area > 0 else 1.0 / here
        if area > 0 and distances[slot] > np.log(AREA_FACTOR):
            distances[slot] = np.inf
        else:
            n_near += 1
    order = np.empty(n_blobs, np.int64)
    for slot in range(n_blobs):  # by insertion, in the order of equals: they are few
        place = slot
        while place > 0 and distances[order[place - 1]] > distances[slot]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = slot
    return order, n_near


@kernel()
def parted(depth, limit, labels, blobs, area, mm2_per_px):
    """The image without objects that merely overlap the animal in it, separated by a gap in depth.

    Of two layers far apart, the animal is the one whose area is nearer to its own. A layer in front
    hides parts of the animal and is set to unread; a layer behind becomes background. Elsewhere the
    image is unchanged: among a bar and some specks the bar resembles the animal most, which may
    swim next to them.

    Args:
        depth: (H, W) mm, 0 where unread.
        limit: (H, W) mm; a reading below it is foreground.
        labels: (H // BLOCK, W // BLOCK) int32, component of each block.
        blobs: (n_blobs, N_BLOB) as `label_blobs` fills it.
        area: the animal's usual area, mm^2.
        mm2_per_px: 1 / (fx fy).

    Returns:
        The image, a copy if changed, and whether it changed.
    """
    for slot in range(len(blobs)):
        blob = blob_kernels.unpack_blob(blobs[slot])
        if blob_area(blob, mm2_per_px) > 1.3 * area:  # may contain another object
            cut, near, far = blob_kernels.layers(
                depth, limit, labels, slot, blob, 2.0 * np.sqrt(area)
            )
            if cut > 0.0:
                behind = abs(np.log(far * mm2_per_px / area)) < abs(
                    np.log(near * mm2_per_px / area)
                )
                out = depth.copy()
                if behind:
                    for v in range(depth.shape[0]):
                        for u in range(depth.shape[1]):
                            if depth[v, u] < cut:
                                out[v, u] = 0
                else:
                    _push_back(out, labels, slot, cut)
                return out, True
    return depth, False


@inner_kernel()
def _push_back(depth, labels, slot, cut):
    """Turn pixels farther than `cut` mm in a component and at its border into background."""
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            if blob_kernels.is_animal_block(labels, i, j, slot):
                for v in range(i * blob_kernels.BLOCK, (i + 1) * blob_kernels.BLOCK):
                    for u in range(j * blob_kernels.BLOCK, (j + 1) * blob_kernels.BLOCK):
                        if depth[v, u] > cut:
                            depth[v, u] = 65_535  # mm, behind everything


@inner_kernel()
def extract_one(depth, limit, on_floor, area, n_candidates, parts, sight, crops, k):
    """Find the animal in one frame and fill its row of the batch.

    With n_candidates 2, the batch has two rows per frame, and its second half receives the second
    best component.

    Args:
        depth: (H, W) mm, 0 where unread.
        limit: (H, W) mm; a reading below it is foreground.
        on_floor: (H, W) bool, the floor.
        area: the animal's usual area, mm^2, 0 while unknown.
        n_candidates: per frame, 1 or 2.
        parts: whether overlapping objects are separated by depth, see `parted`.
        sight: `Sight` of the image.
        crops: `CropRows`, out.
        k: the frame's row.
    """
    labels = np.empty(
        (depth.shape[0] // blob_kernels.BLOCK, depth.shape[1] // blob_kernels.BLOCK), np.int32
    )
    blobs = np.empty((blob_kernels.MAX_BLOBS, blob_kernels.N_BLOB))
    mm2_per_px = 1.0 / (sight.intrinsics[0] * sight.intrinsics[1])
    bridge = BRIDGE if sight.behind_mm > 0.0 else 0
    n_found = blob_kernels.label_blobs(depth, limit, on_floor, bridge, labels, blobs)
    # a bar in front of the animal, a speck behind it
    for _ in range(3 if parts and area > 0.0 else 0):
        depth, changed = parted(depth, limit, labels, blobs[:n_found], area, mm2_per_px)
        if not changed:
            break
        n_found = blob_kernels.label_blobs(depth, limit, on_floor, bridge, labels, blobs)
    order, n_near = order_blobs(blobs, n_found, area, mm2_per_px)
    for rank in range(n_candidates):
        row = k + rank * (len(crops.n_px) // n_candidates)
        crops.n_blobs[row] = n_near
        if rank < n_near:
            slot = order[rank]
            blob = blob_kernels.unpack_blob(blobs[slot])
            cut_crop(depth, limit, labels, slot, blob, sight, crops, row)
            crops.n_px[row] = int(blob.n_px)


@inner_kernel()
def cut_crop(depth, limit, labels, slot, blob, sight, crops, k):
    """The smoothed height map of one component, and its moments, into row k of the batch.

    The crop is a square around the component in steps of whole pixels. If heights are measured
    along the optical axis, the row's distance moves to behind_mm behind the animal.

    Args:
        depth: (H, W) mm, 0 where unread.
        limit: (H, W) mm; a reading below it is foreground.
        labels: (H // BLOCK, W // BLOCK) int32, component of each block.
        slot: the component.
        blob: its counts.
        sight: `Sight` of the image.
        crops: `CropRows`, out.
        k: the row.
    """
    crop = crops.heights.shape[1]
    v0 = blob.first_row * blob_kernels.BLOCK
    v1 = (blob.last_row + 1) * blob_kernels.BLOCK
    u0 = blob.first_column * blob_kernels.BLOCK
    u1 = (blob.last_column + 1) * blob_kernels.BLOCK
    span = max(v1 - v0, u1 - u0) + 2 * blob_kernels.BLOCK
    step = max(1, int(np.ceil(span / (crop - 4))))
    mean_depth = blob.depth_sum / blob.n_px
    heights = crops.heights[k]
    origin = crops.origin[k]
    origin[0] = int((u0 + u1) / 2 - step * crop / 2)
    origin[1] = int((v0 + v1) / 2 - step * crop / 2)
    crops.step[k] = step
    raw = np.empty((crop, crop), np.float32)
    view_plane = sight.plane
    if (
        sight.behind_mm > 0.0
    ):  # first from far behind, as the blob's mean depth includes everything connected
        crops.distance[k] = mean_depth + 8.0 * sight.behind_mm
        view_plane = np.array([0.0, 0.0, 1.0 / crops.distance[k]])
    blob_kernels.cut_heights(
        depth, limit, labels, slot, view_plane, crops.distance[k], origin, step, raw
    )
    blob_kernels.keep_largest(raw, np.empty((crop * crop, 5), np.int32))
    if sight.behind_mm > 0.0:
        crops.distance[k] += blob_kernels.level_heights(raw, sight.behind_mm)
        view_plane[2] = 1.0 / crops.distance[k]
    mm_per_px = step * mean_depth / np.sqrt(sight.intrinsics[0] * sight.intrinsics[1])
    radius = min(3, max(1, int(sight.smooth_mm / mm_per_px + 0.5)))
    blob_kernels.smooth_heights(raw, radius, heights)
    distance = crops.distance[k]
    moments = crops.moments[k]
    blob_kernels.blob_moments(
        heights, origin, step, view_plane, sight.intrinsics, sight.rotation, distance, moments
    )
    if sight.behind_mm > 0.0:
        moments[blob_kernels.SLOPE] = blob_kernels.back_slope(
            heights, origin, step, sight.intrinsics, distance, moments
        )


@kernel(nogil=True)
def extract_all(depths, limit, on_floor, area, n_candidates, parts, sight, crops, start, stop):
    """Find the animal in every frame of one camera and fill the batch.

    Args:
        depths: (n, H, W) mm, 0 where unread.
        limit: (H, W) mm; a reading below it is foreground.
        on_floor: (H, W) bool, the floor.
        area: the animal's usual area, mm^2, 0 while unknown.
        n_candidates: per frame; the batch has N = n_candidates n rows, best candidates first.
        parts: whether layers far apart in depth are separated, see `parted`.
        sight: `Sight` of all images.
        crops: `CropRows`, out.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for k in range(start, stop):
        extract_one(depths[k], limit, on_floor, area, n_candidates, parts, sight, crops, k)


@kernel(nogil=True)
def extract_windows(depths, background, margin, area, n_candidates, sights, crops, start, stop):
    """Find the animal in image patches from many cameras and fill the batch.

    The limit of each patch is its background, or the floor where that is unread, less its margin;
    all of it counts as floor.

    Args:
        depths: (n, H, W) mm, 0 where unread.
        background: (n, H, W) mm, 0 where unread.
        margin: (n,) mm, least height of the animal.
        area: (n,) usual areas of the animals, mm^2.
        n_candidates: per patch; the batch has N = n_candidates n rows, best candidates first.
        sights: `Sight` of the patches, each field with a leading axis (n,), in pixels of the
            patches.
        crops: `CropRows`, out.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for k in range(start, stop):
        plane = sights.plane[k]
        limit = np.empty(depths.shape[1:], np.float32)
        everywhere = np.ones(depths.shape[1:], np.bool_)
        for v in range(limit.shape[0]):
            for u in range(limit.shape[1]):
                behind = float(background[k, v, u])
                if behind == 0.0:
                    inverse = plane[0] * u + plane[1] * v + plane[2]
                    behind = 1.0 / inverse if inverse > 1e-6 else 0.0
                limit[v, u] = max(behind - margin[k], 0.0)
        sight = Sight(
            sights.intrinsics[k],
            plane,
            sights.rotation[k],
            sights.behind_mm[k],
            sights.smooth_mm[k],
        )
        extract_one(depths[k], limit, everywhere, area[k], n_candidates, False, sight, crops, k)


# Pinhole projection of a crop: points of its view frame to its pixels, and pixels back to points.


N_CROP_CAMERA = 17  # numbers of a packed crop camera


class CropCamera(NamedTuple):
    """The camera of one crop, or columns (n,) of many, in packing order.

    Attributes:
        fx: focal length along the image's rows, px of the full image.
        fy: focal length along its columns, px.
        cx: principal point, px of the full image.
        cy: principal point, px of the full image.
        r00: rotation of T_view_camera, first row; r00 to r22 row by row.
        r01: see r00.
        r02: see r00.
        r10: see r00.
        r11: see r00.
        r12: see r00.
        r20: see r00.
        r21: see r00.
        r22: see r00.
        distance: z of the camera's centre in the view frame, mm.
        u0: column of the full image at the crop's first pixel.
        v0: row of the full image at the crop's first pixel.
        step: pixels of the full image per crop pixel.
    """

    fx: Any
    fy: Any
    cx: Any
    cy: Any
    r00: Any
    r01: Any
    r02: Any
    r10: Any
    r11: Any
    r12: Any
    r20: Any
    r21: Any
    r22: Any
    distance: Any
    u0: Any
    v0: Any
    step: Any


class CropRows(NamedTuple):
    """The rows of a batch of height maps, as a segmenter's kernels fill them.

    Attributes:
        heights: (N, S, S) int16, 1/16 mm.
        origin: (N, 2) int32, image pixel (u, v) of crop pixel (0, 0).
        step: (N,) int32, image pixels per crop pixel.
        n_px: (N,) int64, readings on the animal, 0 where it was not found.
        moments: (N, N_MOMENTS), each a packed `BlobMoments`.
        distance: (N,) mm of the view's origin from the camera.
        n_blobs: (N,) int64, components of about the animal's size.
    """

    heights: Any
    origin: Any
    step: Any
    n_px: Any
    moments: Any
    distance: Any
    n_blobs: Any


@inner_kernel()
def crop_camera(packed):
    """The record of one packed crop camera (17,)."""
    return CropCamera(
        packed[0],
        packed[1],
        packed[2],
        packed[3],
        packed[4],
        packed[5],
        packed[6],
        packed[7],
        packed[8],
        packed[9],
        packed[10],
        packed[11],
        packed[12],
        packed[13],
        packed[14],
        packed[15],
        packed[16],
    )


@kernel()
def to_camera(camera, x0, y0, z0):
    """x, y, z mm in the camera frame of a point of the view frame; z is at least 1 mm."""
    z0 -= camera.distance
    x = camera.r00 * x0 + camera.r10 * y0 + camera.r20 * z0
    y = camera.r01 * x0 + camera.r11 * y0 + camera.r21 * z0
    z = max(camera.r02 * x0 + camera.r12 * y0 + camera.r22 * z0, 1.0)
    return x, y, z


@kernel()
def to_pixel(camera, x0, y0, z0):
    """Column and row of the crop, not rounded, of a point mm of the view frame."""
    x, y, z = to_camera(camera, x0, y0, z0)
    column = (camera.fx * x / z + camera.cx - camera.u0) / camera.step
    row = (camera.fy * y / z + camera.cy - camera.v0) / camera.step
    return column, row


@inner_kernel()
def to_point(camera, row, column, height):
    """x, y mm of the view frame of a crop pixel, `height` mm above its plane."""
    dx = (camera.u0 + camera.step * column - camera.cx) / camera.fx
    dy = (camera.v0 + camera.step * row - camera.cy) / camera.fy
    z = (height - camera.distance) / (camera.r20 * dx + camera.r21 * dy + camera.r22)
    x = z * (camera.r00 * dx + camera.r01 * dy + camera.r02)
    y = z * (camera.r10 * dx + camera.r11 * dy + camera.r12)
    return x, y


# Kernels of the per-pixel background model: the farthest mode of a pixel's sorted readings.


@inner_kernel()
def far_mode(values, window):
    """Depth and spread of the farthest cluster in sorted readings; (0, 0) without one.

    An animal is always nearer than what it covers, so the background is the farthest recurring
    depth, not the most frequent: a pixel covered nine tenths of the time still shows it. A cluster
    needs a twentieth of the readings (at least 3) within `window` mm, which excludes isolated
    outliers beyond the floor.

    Args:
        values: (n,) readings of one pixel, mm, ascending.
        window: largest distance between readings of one surface, mm.

    Returns:
        The cluster's median, mm, and half of its range from 16 to 84 %, mm.
    """
    n = values.size
    need = max(3, (n + 19) // 20)
    if n < need:
        return 0.0, 0.0
    top = n - 1
    while top - need + 1 >= 0:
        if values[top] - values[top - need + 1] <= window:
            low = top
            while low > 0 and values[top] - values[low - 1] <= window:
                low -= 1
            middle = values[(low + top) // 2]
            # re-centre on the cluster's own middle, so that a few far readings do not cut its near
            # half off
            low = top
            while low > 0 and middle - values[low - 1] <= window:
                low -= 1
            count = top - low + 1
            middle = values[low + count // 2]
            spread = 0.5 * (
                values[low + int(0.84 * (count - 1))] - values[low + int(0.16 * (count - 1))]
            )
            return middle, spread
        top -= 1
    return 0.0, 0.0


@kernel(nogil=True)
def far_modes(ordered, window_share, window_mm, near_share, depth, spread, near, start, stop):
    """Background depth, its spread and the nearest usual depth of every pixel.

    Runs `far_mode` in every pixel, pixels in parallel.

    Args:
        ordered: (n_pixels, n) float32 mm, each pixel's readings, ascending; 0 where unread.
        window_share: width of a cluster, relative to the pixel's farthest reading.
        window_mm: least width of a cluster, mm.
        near_share: share of a pixel's readings that are nearer than `near`.
        depth: (n_pixels,) float32 mm, out: the farthest mode, 0 without one.
        spread: (n_pixels,) float32 mm, out: its standard deviation.
        near: (n_pixels,) float32 mm, out: the `near_share` quantile of the readings, 0 where never
            read.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for pixel in range(start, stop):
        first = 0
        while first < ordered.shape[1] and not ordered[pixel, first] > 0:
            first += 1
        values = ordered[pixel, first:]
        n = values.size
        window = window_mm if n == 0 else max(window_mm, window_share * values[-1])
        depth[pixel], spread[pixel] = far_mode(values, window)
        near[pixel] = values[int(near_share * n)] if n > 0 else 0.0
