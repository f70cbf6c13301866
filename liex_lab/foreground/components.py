"""Connected components of a mask, looked for in the box that holds all of it.

A mask of what moves or stands out fills a hundredth of a picture, and labelling costs as much as
the pixels that are looked at.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Components(NamedTuple):
    """Connected components (8-connected) of a mask, in the order of `cv2.connectedComponents`.

    Attributes:
        labels: (H, W) int32, 0 outside, 1 and up inside.
        stats: (n, 5) int32, row k of component k: left, top, width, height, pixels (`cv2.CC_STAT_*`
            columns); row 0 is not filled in.
    """

    labels: NDArray[np.int32]
    stats: NDArray[np.int32]


def components(mask: NDArray[np.uint8]) -> Components:
    """The connected components of a mask.

    Args:
        mask: (H, W) uint8, nonzero inside.
    """
    import cv2

    left, top, width, height = cv2.boundingRect(mask)
    # OpenCV numbers components as it meets them in blocks of 2 x 2 pixels: they stay where they are
    box = (slice(top - top % 2, top + height), slice(left - left % 2, left + width))
    labels = np.zeros(mask.shape, np.int32)
    if not width:
        return Components(labels, np.zeros((1, 5), np.int32))
    _, labels[box], stats, _ = cv2.connectedComponentsWithStats(mask[box])
    stats[:, cv2.CC_STAT_LEFT] += box[1].start
    stats[:, cv2.CC_STAT_TOP] += box[0].start
    stats[0] = 0
    return Components(labels, np.asarray(stats, np.int32))
