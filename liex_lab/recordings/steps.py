"""Millimetres as the whole steps that 16-bit pictures store, exactly or not at all."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.recordings.frame import Depth

LARGEST_STEP = 0xFFFF


def whole_steps(depth: Depth, step_mm: float) -> NDArray[np.uint16] | None:
    """The steps (H, W) that are read back as exactly this depth; None where there are none, or more than 16 bits."""
    if depth.size and float(depth.max()) > LARGEST_STEP * step_mm:
        return None
    steps = (depth if step_mm == 1.0 else np.rint(depth / np.float32(step_mm))).astype(np.uint16)
    # compared as `depth_mm` will compute it: 0.1 is no number of a float32
    read = steps.astype(np.float32)
    return steps if np.array_equal(read if step_mm == 1.0 else read * np.float32(step_mm), depth) else None


def nearest_steps(depth: Depth, step_mm: float) -> NDArray[np.uint16] | None:
    """The nearest steps (H, W); None where they do not fit into 16 bits."""
    steps = np.rint(depth / np.float32(step_mm))
    return steps.astype(np.uint16) if not depth.size or float(steps.max()) <= LARGEST_STEP else None


def metres(depth: Depth) -> tuple[NDArray[np.float32], int]:
    """Depth (H, W) in m that times 1000 is the depth again, and for how many pixels there is no such number.

    Between 1000 and 1024 mm, and at their halves and doubles, neighbouring float32s of metres are farther apart than
    those of millimetres; there the nearest is taken, half a millionth of a millimetre per metre off.
    """
    scaled = depth / np.float32(1000.0)
    off = scaled * np.float32(1000.0) != depth
    for direction in (np.float32(np.inf), np.float32(0.0)):
        other = np.nextafter(scaled[off], direction)
        fits = other * np.float32(1000.0) == depth[off]
        scaled[off] = np.where(fits, other, scaled[off])
        off[off] = ~fits
    return scaled, int(off.sum())
