"""A tree the way a reader would walk it: bytes unpacked by hand, one sample at a time."""

import struct

import numpy as np


def probe_by_hand(heights, view, offset):
    """Height under an offset, the map padded so that nothing lies outside."""
    column = view[0] + sum(view[2 + k] * offset[k] for k in range(3))
    row = view[1] + sum(view[5 + k] * offset[k] for k in range(3))
    column, row = (min(max(int(x + 0.5), 0), heights.shape[0] - 1) for x in (column, row))
    return int(heights[row, column])


def leaf_by_hand(nodes, root, heights, inverse_size, views, scalars):
    """Index of the leaf that one sample reaches."""
    at = root
    while nodes[at][2] >= 0:
        ux, uy, uz, vx, vy, vz, threshold = struct.unpack(
            "<6bh", struct.pack("<2i", *nodes[at][:2].tolist())
        )
        kind, channel = int(nodes[at][3]) % 4, int(nodes[at][3]) // 4
        if kind == 2:
            value = scalars[channel]
        else:
            value = np.float32(probe_by_hand(heights, views[channel], (ux, uy, uz))) * inverse_size
            if kind == 1:
                value -= views[channel][8]
            else:
                value -= (
                    np.float32(probe_by_hand(heights, views[channel], (vx, vy, vz))) * inverse_size
                )
        at = nodes[at][2] + (1 if value >= threshold else 0)
    return -int(nodes[at][2]) - 1
