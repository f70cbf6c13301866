"""One depth frame, and the linear law by which stored numbers become millimetres.

depth = unit_mm * stored, float32, measured along the optical axis (z of the camera frame, not range
along the ray); 0 means that there is no reading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Depth = NDArray[np.float32]


@dataclass(frozen=True)
class DepthFrame:
    """One depth picture with its row and its time.

    Attributes:
        index: its row in the recording that it was read from.
        time_ns: its time on the recording's own clock, ns.
        depth: (H, W) float32 mm along the optical axis; 0 = unread; finite, never negative.
    """

    index: int
    time_ns: int
    depth: Depth


def in_one_block(frames: Sequence[DepthFrame]) -> list[DepthFrame]:
    """The same frames, their depth copied into one array, which `stacked` then need not do.

    Args:
        frames: at least one, of one size.
    """
    block = np.stack([frame.depth for frame in frames])
    return [
        DepthFrame(frame.index, frame.time_ns, depth)
        for frame, depth in zip(frames, block, strict=True)
    ]


def stacked(frames: Sequence[DepthFrame]) -> NDArray[np.float32]:
    """Depth of frames as one array, not copied where they are those of one `in_one_block`.

    Args:
        frames: at least one, of one size.

    Returns:
        (n, H, W) float32 mm; not to be written to.
    """
    block = frames[0].depth.base
    if (
        isinstance(block, np.ndarray)
        and block.shape == (len(frames), *frames[0].depth.shape)
        and block.dtype == np.float32
        and all(
            frame.depth.base is block and frame.depth.ctypes.data == row.ctypes.data
            for frame, row in zip(frames, block, strict=True)
        )
    ):
        return block
    return np.stack([frame.depth for frame in frames])


def depth_mm(stored: NDArray[Any], unit_mm: float = 1.0, unread: Sequence[float] = (0.0,)) -> Depth:
    """Depth in millimetres of stored values, by a linear law.

    Values that mean "no reading" are marked before scaling, while they can still be compared
    exactly. 0, NaN and infinite values are always unread, and so is what lies behind the lens.

    Args:
        stored: (H, W) or any other shape, integers or floats as the file holds them.
        unit_mm: mm per stored step, negative where the file's depth axis points towards the camera.
        unread: stored values that mean "no reading".

    Returns:
        float32 mm of the same shape, a fresh array; 0 = unread.
    """
    depth = stored.astype(np.float32)
    for value in unread:
        if value != 0.0:
            depth[stored == value] = 0.0
    if unit_mm != 1.0:
        with np.errstate(over="ignore"):  # what overflows is not finite and so becomes unread below
            depth *= np.float32(unit_mm)
    if stored.dtype.kind != "u" or unit_mm < 0:
        depth[~(np.isfinite(depth) & (depth > 0))] = 0.0
    return depth
