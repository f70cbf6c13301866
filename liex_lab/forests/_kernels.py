"""Numba kernels of the forests: pose-indexed depth features, binary tests, descent of a tree.

The feature is Lie-X Eq. 15, phi = depth(Proj(x + g(u))) - depth(Proj(x + g(v))), for offsets u, v
that rotate with the joint's frame g; it extends the two-point depth features of Shotton et al.
(2013). Depth is read from a height map, and the projection is linearised at the joint.

A node is four int32, 16 bytes, one quarter of a cache line:
    word 0: u_x, u_y, u_z, v_x as int8, lowest byte first
    word 1: v_y, v_z as int8, then the threshold as int16
    word 2: index of the left child (the right one follows it); negative: leaf -(word 2) - 1
    word 3: kind + 4 * channel: the test, and its view or scalar

Tests compare a response with the threshold and go right if it is at least as large:
    TWO_PROBES  height under x + g(u) minus height under x + g(v)         (Lie-X Eq. 15)
    ONE_PROBE   height under x + g(u) minus the joint's own height
    SCALAR      a number that describes the whole animal relative to the joint

Heights are 1/16 mm of an animal of home size, so one forest serves animals of every size.

A view, 9 float32, is the linearised projection of a joint of a candidate pose into a height map:
crop pixel (column, row) of the joint, a 2x3 matrix from offsets (1/127 of the reach, in the joint's
frame) to crop pixels, and the joint's own height.
"""

import numpy as np

from liex_lab.runtime.kernels import inner_kernel, kernel

TWO_PROBES, ONE_PROBE, SCALAR = range(3)
VIEW = 9
# columns of a view, see above; each of the two slopes takes three
VIEW_COLUMN = 0
VIEW_ROW = 1
COLUMN_SLOPE = 2
ROW_SLOPE = 5
VIEW_HEIGHT = 8


@kernel(inline="always")
def probe(heights, view, a, b, c):
    """Read the height map under an offset from a joint.

    A probe outside the map reads its border, which is background. The arithmetic is float32 in the
    same order as in `_walk`, so that all code paths give identical answers.

    Args:
        heights: (S, S) int16 height map, 1/16 mm.
        view: (9,) float32 linearised projection of the joint.
        a: x component of the offset, -127..127, in 1/127 of the reach, in the joint's frame.
        b: y component of the offset.
        c: z component of the offset.

    Returns:
        The height, int16.
    """
    limit = heights.shape[0] - 1
    x = np.float32(a)
    y = np.float32(b)
    z = np.float32(c)
    half = np.float32(0.5)
    column = int(
        ((view[VIEW_COLUMN] + half) + view[COLUMN_SLOPE] * x)
        + view[COLUMN_SLOPE + 1] * y
        + view[COLUMN_SLOPE + 2] * z
    )
    row = int(
        ((view[VIEW_ROW] + half) + view[ROW_SLOPE] * x)
        + view[ROW_SLOPE + 1] * y
        + view[ROW_SLOPE + 2] * z
    )
    column = min(max(column, 0), limit)
    row = min(max(row, 0), limit)
    return heights[row, column]


@kernel(inline="always")
def byte(word, index):
    """Signed byte `index` (0 is the lowest) of the int32 `word`."""
    return (((word >> (8 * index)) & 0xFF) ^ 0x80) - 0x80


@kernel(inline="always")
def response(heights, inverse_size, views, scalars, word0, word1, word3):
    """Response of one sample to a test: the number that is compared with the threshold.

    Args:
        heights: (S, S) int16 height map, 1/16 mm.
        inverse_size: home size over the animal's size.
        views: (V, 9) float32 linearised projections of the sample's joints.
        scalars: (n,) float32 numbers that describe the animal.
        word0: word 0 of the node.
        word1: word 1 of the node.
        word3: word 3 of the node.

    Returns:
        The response, 1/16 mm at home size for tests on heights.
    """
    kind = word3 & 3
    channel = word3 >> 2
    if kind == SCALAR:
        return scalars[channel]
    view = views[channel]
    first = probe(heights, view, byte(word0, 0), byte(word0, 1), byte(word0, 2)) * inverse_size
    if kind == ONE_PROBE:
        return first - view[VIEW_HEIGHT]
    return (
        first - probe(heights, view, byte(word0, 3), byte(word1, 0), byte(word1, 1)) * inverse_size
    )


@kernel(inline="always")
def descend(nodes, root, heights, inverse_size, views, scalars):
    """Descend one tree with one sample.

    Args:
        nodes: (N, 4) int32 packed nodes.
        root: index of the tree's root.
        heights: (S, S) int16 height map, 1/16 mm.
        inverse_size: home size over the animal's size.
        views: (V, 9) float32 linearised projections of the sample's joints.
        scalars: (n,) float32 numbers that describe the animal.

    Returns:
        Number of the leaf reached.
    """
    at = root
    child = nodes[at, 2]
    while child >= 0:
        value = response(
            heights, inverse_size, views, scalars, nodes[at, 0], nodes[at, 1], nodes[at, 3]
        )
        at = child + (value >= (nodes[at, 1] >> 16))
        child = nodes[at, 2]
    return -child - 1


@kernel(inline="always")
def pack_offsets(u, v, threshold):
    """Pack two offsets and a threshold into words 0 and 1 of a node.

    Args:
        u: (3,) integer offset of the first probe, -127..127.
        v: (3,) integer offset of the second probe, -127..127.
        threshold: the threshold, int16.

    Returns:
        The two words, int32.
    """
    word0 = (
        (np.int32(u[0]) & 0xFF)
        | ((np.int32(u[1]) & 0xFF) << 8)
        | ((np.int32(u[2]) & 0xFF) << 16)
        | ((np.int32(v[0]) & 0xFF) << 24)
    )
    word1 = (
        (np.int32(v[1]) & 0xFF)
        | ((np.int32(v[2]) & 0xFF) << 8)
        | ((np.int32(threshold) & 0xFFFF) << 16)
    )
    return np.int32(word0), np.int32(word1)


@inner_kernel(inline="always")
def next_random(state):
    """The next 64 random bits of a splitmix64 sequence; `state` (1,) uint64 is advanced."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@inner_kernel(inline="always")
def random_below(state, n):
    """A random integer of 0 .. n - 1 from the splitmix64 sequence `state` (1,)."""
    return np.int64((next_random(state) >> np.uint64(33)) % np.uint64(n))


@kernel()
def number_nodes(is_leaf, starts, nodes):
    """Write the child pointers of trees into word 2 of their nodes, in the order of their growth.

    A tree's children are appended as a pair when their parent splits, the left side of the stack
    first, so the pointers follow from which nodes are leaves. Leaves are numbered in the same
    order.

    Args:
        is_leaf: (n,) bool.
        starts: (trees + 1,) index of each tree's first node, and the end of the last.
        nodes: (n, 4) int32, word 2 of which is filled.
    """
    leaf = 0
    stack = np.empty(is_leaf.size + 1, np.int64)
    for tree in range(starts.size - 1):
        root = starts[tree]
        stack[0] = 0
        n = 1
        made = 1
        while n > 0:
            n -= 1
            at = stack[n]
            if is_leaf[root + at]:
                leaf += 1
                nodes[root + at, 2] = -leaf
            else:
                nodes[root + at, 2] = root + made
                stack[n] = made + 1
                stack[n + 1] = made
                n += 2
                made += 2
