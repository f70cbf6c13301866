"""How stored numbers mean depth, the ways that cameras and data sets of the field have come up
with, and millimetres as the whole steps that 16-bit pictures store, exactly or not at all.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.recordings.frame import Depth, depth_mm

Stored = NDArray[Any]

COLOUR = "nyu-hand"  # the one encoding of 8-bit colour pictures
LARGEST_STEP = 0xFFFF
_NO_DISPARITY = 2047  # of 11 bits


def _rotated(stored: Stored) -> Stored:
    """SUN RGB-D: millimetres, their 16 bits turned left by 3."""
    return (stored >> 3) | (stored << 13)


def _disparity(stored: Stored) -> Stored:
    """Kinect v1 as NYU Depth v2 keeps it: 11 bits of disparity, metres = 351.3 / (1092.5 -
    value).
    """
    ahead = 1092.5 - stored.astype(np.float32)
    read = (ahead > 0) & (stored != _NO_DISPARITY)
    return np.where(read, 351_300.0 / np.where(read, ahead, 1.0), 0.0).astype(np.float32)


def _green_blue(stored: Stored) -> Stored:
    """NYU hands: (H, W, 3) 8 bits in the order blue, green, red; millimetres = 256 green + blue."""
    return stored[..., 1].astype(np.uint16) << 8 | stored[..., 0]


_MILLIMETRES: dict[
    str, tuple[float, Callable[[Stored], Stored]]
] = {  # name: mm per step of what the function gives
    "linear": (1.0, lambda stored: stored),
    "tum": (0.2, lambda stored: stored),  # 5000 steps per metre
    "sun": (1.0, _rotated),
    "kinect1-disparity": (1.0, _disparity),
    COLOUR: (1.0, _green_blue),
}
ENCODINGS = tuple(_MILLIMETRES)


def own_unit_mm(encoding: str) -> float:
    """Millimetres per step of what an encoding gives."""
    return _MILLIMETRES[encoding][0]


def decode(
    stored: Stored, encoding: str, unit_mm: float, unread: Sequence[float] = (0.0,)
) -> Depth:
    """Stored values (H, W) -> float32 mm (H, W), 0 = unread.

    unit_mm: millimetres per step of what `encoding` gives; unread: *stored* values that mean "no
    reading" (of what the encoding gives for colour pictures), besides those that it has by itself.
    """
    values = _MILLIMETRES[encoding][1](stored)
    if values is stored or stored.ndim == 3:
        return depth_mm(values, unit_mm, unread)
    depth = depth_mm(values, unit_mm)
    for value in unread:
        depth[stored == value] = 0.0
    return depth


def whole_steps(depth: Depth, step_mm: float) -> NDArray[np.uint16] | None:
    """The steps (H, W) that are read back as exactly this depth; None where there are none, or more
    than 16 bits.
    """
    if depth.size and float(depth.max()) > LARGEST_STEP * step_mm:
        return None
    steps = (depth if step_mm == 1.0 else np.rint(depth / np.float32(step_mm))).astype(np.uint16)
    # compared as `depth_mm` will compute it: 0.1 is no number of a float32
    read = steps.astype(np.float32)
    return (
        steps
        if np.array_equal(read if step_mm == 1.0 else read * np.float32(step_mm), depth)
        else None
    )


def nearest_steps(depth: Depth, step_mm: float) -> NDArray[np.uint16] | None:
    """The nearest steps (H, W); None where they do not fit into 16 bits."""
    steps = np.rint(depth / np.float32(step_mm))
    return steps.astype(np.uint16) if not depth.size or float(steps.max()) <= LARGEST_STEP else None


def metres(depth: Depth) -> tuple[NDArray[np.float32], int]:
    """Depth (H, W) in m that times 1000 is the depth again, and for how many pixels there is no
    such number.

    Between 1000 and 1024 mm, and at their halves and doubles, neighbouring float32s of metres are
    farther apart than those of millimetres; there the nearest is taken, half a millionth of a
    millimetre per metre off.
    """
    scaled = depth / np.float32(1000.0)
    off = scaled * np.float32(1000.0) != depth
    for direction in (np.float32(np.inf), np.float32(0.0)):
        other = np.nextafter(scaled[off], direction)
        fits = other * np.float32(1000.0) == depth[off]
        scaled[off] = np.where(fits, other, scaled[off])
        off[off] = ~fits
    return scaled, int(off.sum())
