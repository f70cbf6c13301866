"""Kernels of geodesic extrema: the ends of surfaces that enter the image, such as the hand of an
arm.

The geodesic distance from where a surface leaves the image is found by breadth-first search over
its blocks; its maxima are the extrema (accumulative geodesic extrema, Plagemann et al., ICRA 2010).
A maximum is rated by its persistence (Edelsbrunner et al. 2002): blocks are added from the far end
inwards and form islands that a union-find merges; when two islands meet, the lower one has
protruded by the difference.

Arrays shared by all kernels: blocks (h, w) float32, the nearest depth in mm in every block of BLOCK
x BLOCK pixels, 0 for nothing within range; labels (h, w) int32, the surface of each block, -1 for
none. The blocks of one surface are also listed (`SurfaceBlocks`), as most of an image belongs to
none.
"""

from typing import Any, NamedTuple

import numpy as np

from liex_lab.runtime.kernels import inner_kernel, kernel
from liex_lab.scene import _blob_kernels as blob_kernels
from liex_lab.scene._blob_kernels import BLOCK, find_root

MAX_SURFACES = 24
MAX_TIPS = 256
# of a home-sized hand: distance of its points and of the start of its arm from its middle
AROUND_MM = 190.0
_JUMP_MM = 50.0  # neighbouring blocks differ by less on one surface
# of a home-sized hand: least persistence of an end, which an elbow does not reach
_STICKS_OUT_MM = 90.0
_MARGIN = 2  # blocks: many cameras have no readings along the image border
# columns of a geodesic extremum: rank (depth mm, reduced for large persistence); block row; block
# column; depth mm
N_END = 4
END_RANK, END_ROW, END_COLUMN, END_DEPTH = range(N_END)


class SurfaceBlocks(NamedTuple):
    """The n blocks of a surface, row by row.

    Attributes:
        slot: its label.
        cells: (n, 2) int32 row and column.
        points: (n, 3) x, y, z mm of their centres, camera frame.
    """

    slot: Any
    cells: Any
    points: Any


@inner_kernel()
def block_depths(depth, near, far, blocks):
    """The nearest depth in every block.

    The mean of the readings up to 25 mm behind the block's second nearest.

    Args:
        depth: (H, W) mm, 0 where unread.
        near: nearer readings are ignored, mm.
        far: farther readings are ignored, mm.
        blocks: (h, w) float32 mm, out; 0 if fewer than 5 readings agree.
    """
    nothing = np.float32(1e9)
    for i in range(blocks.shape[0]):
        for j in range(blocks.shape[1]):
            first = nothing
            second = nothing
            for r in range(i * BLOCK, i * BLOCK + BLOCK):
                for c in range(j * BLOCK, j * BLOCK + BLOCK):
                    z = np.float32(depth[r, c])
                    z = z if near < z < far else nothing
                    second = min(
                        second, max(first, z)
                    )  # branch-free, as branches would be unpredictable
                    first = min(first, z)
            total = 0.0
            n = 0
            if second < 1e8:
                for r in range(i * BLOCK, i * BLOCK + BLOCK):
                    for c in range(j * BLOCK, j * BLOCK + BLOCK):
                        z = depth[r, c]
                        if near < z < second + 25.0:  # farther is another surface
                            total += z
                            n += 1
            blocks[i, j] = total / n if n >= 5 else 0.0


@kernel()
def label_surfaces(blocks, labels, focal2, least_mm2, areas):
    """Connected surfaces: flood fill over blocks whose depths differ by less than 50 mm.

    If there are more than fit, the largest are kept.

    Args:
        blocks: (h, w) float32 mm.
        labels: (h, w) int32, out: the surface of each block, -1 for none.
        focal2: fx * fy, px^2.
        least_mm2: smaller surfaces are dropped.
        areas: (MAX_SURFACES,) mm^2, out.

    Returns:
        The number of surfaces.
    """
    n_rows, n_columns = blocks.shape
    for i in range(n_rows):
        for j in range(n_columns):
            labels[i, j] = -2 if blocks[i, j] > 0 else -1
    stack = np.empty((n_rows * n_columns, 2), np.int32)
    n_surfaces = 0
    for i in range(n_rows):
        for j in range(n_columns):
            if labels[i, j] != -2:
                continue
            stack[0, 0] = i
            stack[0, 1] = j
            labels[i, j] = MAX_SURFACES
            at = 0
            top = 1
            area = 0.0
            while at < top:
                r, c = stack[at, 0], stack[at, 1]
                at += 1
                here = blocks[r, c]
                area += BLOCK * BLOCK * here * here / focal2
                for a in range(max(r - 1, 0), min(r + 2, n_rows)):
                    for b in range(max(c - 1, 0), min(c + 2, n_columns)):
                        if labels[a, b] == -2 and abs(blocks[a, b] - here) < _JUMP_MM:
                            labels[a, b] = MAX_SURFACES
                            stack[top, 0] = a
                            stack[top, 1] = b
                            top += 1
            slot = -1
            if area >= least_mm2:
                slot = n_surfaces if n_surfaces < MAX_SURFACES else int(np.argmin(areas))
                if n_surfaces < MAX_SURFACES:
                    n_surfaces += 1
                elif areas[slot] > area:
                    slot = -1
                else:
                    blob_kernels.forget(labels, slot)
            for k in range(top):
                labels[stack[k, 0], stack[k, 1]] = slot
            if slot >= 0:
                areas[slot] = area
    return n_surfaces


@kernel()
def list_surfaces(blocks, labels, n_surfaces, intrinsics):
    """The blocks of all surfaces.

    Args:
        blocks: (h, w) float32 mm.
        labels: (h, w) int32.
        n_surfaces: labelled surfaces.
        intrinsics: (4,) fx, fy, cx, cy px.

    Returns:
        A `SurfaceBlocks` for each.
    """
    starts = np.zeros(n_surfaces + 1, np.int64)
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            if labels[i, j] >= 0:
                starts[labels[i, j] + 1] += 1
    starts = np.cumsum(starts)
    cells = np.empty((starts[-1], 2), np.int32)
    points = np.empty((starts[-1], 3))
    filled = starts.copy()
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            slot = labels[i, j]
            if slot >= 0:
                at = filled[slot]
                filled[slot] += 1
                cells[at, 0] = i
                cells[at, 1] = j
                points[at, 0], points[at, 1], points[at, 2] = point_of_block(
                    blocks, i, j, intrinsics
                )
    return [
        SurfaceBlocks(
            slot,
            cells[starts[slot] : starts[slot + 1]],
            points[starts[slot] : starts[slot + 1]],
        )
        for slot in range(n_surfaces)
    ]


@kernel()
def walk(blocks, labels, surface, position, order, hops):
    """All blocks of a surface by geodesic distance from where it leaves the image.

    Breadth-first search in steps of one block. Only the farther part of the border counts as the
    arm, since a hand may touch it, too. If a surface does not leave the image, the search starts at
    its farthest block.

    Args:
        blocks: (h, w) float32 mm.
        labels: (h, w) int32.
        surface: the `SurfaceBlocks`.
        position: (h, w) int32, out: index of each block in the order; -1 on entry.
        order: (n_blocks, 2) int32, out: row and column of the blocks.
        hops: (n_blocks,) int32, out: their distances in blocks.

    Returns:
        The number of blocks reached.
    """
    n = 0
    deepest = np.float32(0.0)
    nearest = np.float32(1e9)
    far_border = np.float32(0.0)
    farthest = 0
    last_i = labels.shape[0] - 1
    last_j = labels.shape[1] - 1
    cells = surface.cells
    for k in range(len(cells)):
        i, j = cells[k, 0], cells[k, 1]
        nearest = min(nearest, blocks[i, j])
        if blocks[i, j] > deepest:
            deepest = blocks[i, j]
            farthest = k
        if min(i, j, last_i - i, last_j - j) < _MARGIN:
            far_border = max(far_border, blocks[i, j])
    # a hand may touch the border, too; the arm is farther away
    arm = 0.5 * (nearest + far_border)
    for k in range(len(cells)):
        i, j = cells[k, 0], cells[k, 1]
        if min(i, j, last_i - i, last_j - j) < _MARGIN and blocks[i, j] >= arm:
            order[n, 0] = i
            order[n, 1] = j
            hops[n] = 0
            position[i, j] = n
            n += 1
    if n == 0:
        i, j = cells[farthest, 0], cells[farthest, 1]
        return walk_from(blocks, labels, surface.slot, i, j, position, order, hops)
    return _spread(blocks, labels, surface.slot, n, position, order, hops)


@inner_kernel()
def walk_from(blocks, labels, slot, i, j, position, order, hops):
    """`walk` from one block of the surface.

    Args:
        blocks: (h, w) float32 mm.
        labels: (h, w) int32.
        slot: the surface.
        i: row of the block.
        j: column of the block.
        position: (h, w) int32, out; -1 on entry.
        order: (n_blocks, 2) int32, out.
        hops: (n_blocks,) int32, out.

    Returns:
        The number of blocks reached.
    """
    order[0, 0] = i
    order[0, 1] = j
    hops[0] = 0
    position[i, j] = 0
    return _spread(blocks, labels, slot, 1, position, order, hops)


@kernel()
def _spread(blocks, labels, slot, n, position, order, hops):
    """Breadth-first search from the first n blocks; returns the final number of blocks."""
    at = 0
    while at < n:
        i, j = order[at, 0], order[at, 1]
        for a in range(max(i - 1, 0), min(i + 2, labels.shape[0])):
            for b in range(max(j - 1, 0), min(j + 2, labels.shape[1])):
                if position[a, b] >= 0 or labels[a, b] != slot:
                    continue
                if abs(blocks[a, b] - blocks[i, j]) < _JUMP_MM:
                    order[n, 0] = a
                    order[n, 1] = b
                    hops[n] = hops[at] + 1
                    position[a, b] = n
                    n += 1
        at += 1
    return n


@kernel()
def ends(blocks, order, hops, position, n, focal, least_mm, tips, n_tips):
    """The geodesic extrema of a traversed surface whose persistence is at least `least_mm`.

    From the far end inwards, islands appear and grow together; when two islands meet, the lower one
    has protruded by the difference (its persistence). The farthest block is always an extremum.

    Args:
        blocks: (h, w) float32 mm.
        order: (n, 2) int32, blocks in the order of the search.
        hops: (n,) int32, their distances in blocks.
        position: (h, w) int32, index of each block in the order.
        n: blocks reached.
        focal: px.
        least_mm: least persistence, mm.
        tips: (MAX_TIPS, N_END), out: the extrema, columns END_RANK to END_DEPTH.
        n_tips: rows filled so far.

    Returns:
        The number of rows filled now.
    """
    parent = np.arange(n)
    for k in range(n - 1, -1, -1):
        i, j = order[k, 0], order[k, 1]
        mine = k
        for a in range(max(i - 1, 0), min(i + 2, blocks.shape[0])):
            for b in range(max(j - 1, 0), min(j + 2, blocks.shape[1])):
                other = position[a, b]
                if other <= k or other >= n or order[other, 0] != a or order[other, 1] != b:
                    continue
                if parent[other] == mine:  # most blocks are of the same island, one step away
                    continue
                theirs = find_root(parent, other)
                if mine == theirs:
                    continue
                # an island is identified by its outermost block, which is last in the order
                low = min(mine, theirs)
                high = max(mine, theirs)
                parent[low] = high
                mine = high
                z = blocks[order[low, 0], order[low, 1]]
                out_mm = (hops[low] - hops[k]) * BLOCK * z / focal
                if out_mm >= least_mm:
                    n_tips = _note(tips, n_tips, z, out_mm / least_mm, order[low])
    i = order[n - 1, 0]
    j = order[n - 1, 1]
    return _note(
        tips,
        n_tips,
        blocks[i, j],
        hops[n - 1] * BLOCK * blocks[i, j] / focal / least_mm,
        order[n - 1],
    )


@kernel()
def _note(tips, n_tips, z, out, block):
    """Add an extremum at depth z mm whose persistence is `out` times the required one."""
    if n_tips == MAX_TIPS:
        return n_tips
    # each multiple of the required persistence counts as being nearer by 60 mm, up to three
    tips[n_tips, END_RANK] = z - 60.0 * min(out, 3.0)
    tips[n_tips, END_ROW] = block[0]
    tips[n_tips, END_COLUMN] = block[1]
    tips[n_tips, END_DEPTH] = z
    return n_tips + 1


@inner_kernel()
def nearest_ends(blocks, labels, surfaces, size, intrinsics, chosen):
    """Candidate positions of a hand, nearest first and distinct.

    A surface is searched twice: from where it leaves the image, and from the extremum farthest from
    there, as the hand itself may touch the border. The nearest point of a surface is a candidate,
    too: a hand may be in front of a body that it touches.

    Args:
        blocks: (h, w) float32 mm.
        labels: (h, w) int32.
        surfaces: a `SurfaceBlocks` for each.
        size: the hand's length over the skeleton's home length.
        intrinsics: (4,) fx, fy, cx, cy px.
        chosen: (m, N_END), out: rows as in `ends`, at least 0.6 of the hand's sphere apart.

    Returns:
        The number of rows filled, at most m.
    """
    focal = np.sqrt(intrinsics[0] * intrinsics[1])
    n_blocks = blocks.size
    position = np.full(blocks.shape, -1, np.int32)
    order = np.empty((n_blocks, 2), np.int32)
    hops = np.empty(n_blocks, np.int32)
    tips = np.empty((MAX_TIPS, N_END))
    n_tips = 0
    for surface in surfaces:
        n = walk(blocks, labels, surface, position, order, hops)
        n_tips = ends(blocks, order, hops, position, n, focal, _STICKS_OUT_MM * size, tips, n_tips)
        last_i = order[n - 1, 0]
        last_j = order[n - 1, 1]
        nearest = 0
        for k in range(n):
            if blocks[order[k, 0], order[k, 1]] < blocks[order[nearest, 0], order[nearest, 1]]:
                nearest = k
            position[order[k, 0], order[k, 1]] = -1
        i, j = order[nearest, 0], order[nearest, 1]
        n_tips = _note(tips, n_tips, blocks[i, j], 0.5, order[nearest])
        n = walk_from(blocks, labels, surface.slot, last_i, last_j, position, order, hops)
        n_tips = ends(blocks, order, hops, position, n, focal, _STICKS_OUT_MM * size, tips, n_tips)
    ranked = np.argsort(tips[:n_tips, END_RANK])
    n_chosen = 0
    for t in ranked:
        if n_chosen == len(chosen):
            break
        tip = tips[t]
        x, y, z = point_of_block(blocks, int(tip[END_ROW]), int(tip[END_COLUMN]), intrinsics)
        own = True
        for k in range(n_chosen):
            end = chosen[k]
            a, b, c = point_of_block(blocks, int(end[END_ROW]), int(end[END_COLUMN]), intrinsics)
            off = np.sqrt((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2)
            own &= off > 0.6 * AROUND_MM * size  # nearer to each other, they are the same hand
        if own:
            chosen[n_chosen] = tip
            n_chosen += 1
    return n_chosen


@inner_kernel()
def point_of_block(blocks, i, j, intrinsics):
    """The point of a block's centre at its depth.

    Args:
        blocks: (h, w) float32 mm.
        i: row of the block.
        j: column of the block.
        intrinsics: (4,) fx, fy, cx, cy px.

    Returns:
        x, y and z, mm, camera frame: three numbers, to avoid allocating an array for each block.
    """
    z = np.float64(blocks[i, j])
    x = (j * BLOCK + 0.5 * (BLOCK - 1) - intrinsics[2]) / intrinsics[0] * z
    y = (i * BLOCK + 0.5 * (BLOCK - 1) - intrinsics[3]) / intrinsics[1] * z
    return x, y, z


@inner_kernel()
def relabel(labels, surface):
    """Restore the label of all blocks of a surface.

    Args:
        labels: (h, w) int32; changed in place.
        surface: the `SurfaceBlocks`.
    """
    cells = surface.cells
    for k in range(len(cells)):
        labels[cells[k, 0], cells[k, 1]] = surface.slot
