"""Depth encodings of cameras and data sets, and millimetres as the steps of 16-bit pictures.

    linear              d = unit_mm * stored
    tum                 5000 steps per metre (TUM RGB-D)
    sun                 mm, their 16 bits rotated left by 3 (SUN RGB-D)
    kinect1-disparity   d = 351.3 m / (1092.5 - disparity), 11 bits (NYU Depth v2)
    nyu-hand            d = 256 green + blue, mm, of an 8-bit colour picture (NYU hand pose)

On writing, steps are exact or nearest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.recordings.frame import Depth, depth_mm

Stored = NDArray[Any]

# median depth: nearer than any camera reads, farther than any animal is watched
PLAUSIBLE_MM = (100.0, 10_000.0)
COLOUR = "nyu-hand"  # the one encoding of 8-bit colour pictures
LARGEST_STEP = 0xFFFF
_NO_DISPARITY = 2047  # of 11 bits
_FARTHEST_MM = 10_000.0


def _rotated(stored: Stored) -> Stored:
    """SUN RGB-D: millimetres, their 16 bits turned left by 3."""
    return (stored >> 3) | (stored << 13)


def _disparity(stored: Stored) -> Stored:
    """Kinect v1 disparity of 11 bits, as NYU Depth v2 keeps it: z = 351.3 / (1092.5 - value) m."""
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
    """Millimetres per step of what an encoding gives.

    Args:
        encoding: one of `ENCODINGS`.

    Returns:
        mm per step: 0.2 for "tum", else 1.
    """
    return _MILLIMETRES[encoding][0]


def decode(
    stored: Stored, encoding: str, unit_mm: float, unread: Sequence[float] = (0.0,)
) -> Depth:
    """Depth in millimetres of stored values in a named encoding.

    Args:
        stored: (H, W), or (H, W, 3) uint8 (blue, green, red) for colour pictures.
        encoding: one of `ENCODINGS`.
        unit_mm: mm per step of what `encoding` gives.
        unread: *stored* values that mean "no reading" (of what the encoding gives for colour
            pictures), besides those that it has by itself: the largest of a type of integers where
            it would lie farther than any animal is watched, as cameras and programs write it.

    Returns:
        (H, W) float32 mm, 0 = unread.
    """
    values = _MILLIMETRES[encoding][1](stored)
    if values is stored and stored.dtype.kind in "iu":
        largest = float(np.iinfo(stored.dtype).max)
        if largest * abs(unit_mm) > _FARTHEST_MM:
            unread = (*unread, largest)
    if values is stored or stored.ndim == 3:
        return depth_mm(values, unit_mm, unread)
    depth = depth_mm(values, unit_mm)
    for value in unread:
        depth[stored == value] = 0.0
    return depth


def whole_steps(depth: Depth, step_mm: float) -> NDArray[np.uint16] | None:
    """The 16-bit steps that are read back as exactly this depth.

    Args:
        depth: (H, W) float32 mm.
        step_mm: mm of a step.

    Returns:
        (H, W) uint16; None where there are none, or they need more than 16 bits.
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
    """The nearest 16-bit steps to a depth.

    Args:
        depth: (H, W) float32 mm.
        step_mm: mm of a step.

    Returns:
        (H, W) uint16; None where they do not fit into 16 bits.
    """
    steps = np.rint(depth / np.float32(step_mm))
    return steps.astype(np.uint16) if not depth.size or float(steps.max()) <= LARGEST_STEP else None


def metres(depth: Depth) -> tuple[NDArray[np.float32], int]:
    """Depth in metres that times 1000 is the depth again, in float32.

    Between 1000 and 1024 mm, and at their halves and doubles, neighbouring float32s of metres are
    farther apart than those of millimetres. There the nearest is taken, half a millionth of a
    millimetre per metre off.

    Args:
        depth: (H, W) float32 mm.

    Returns:
        (H, W) float32 m, and for how many pixels there is no exact number.
    """
    scaled = depth / np.float32(1000.0)
    inexact = scaled * np.float32(1000.0) != depth
    for direction in (np.float32(np.inf), np.float32(0.0)):
        other = np.nextafter(scaled[inexact], direction)
        fits = other * np.float32(1000.0) == depth[inexact]
        scaled[inexact] = np.where(fits, other, scaled[inexact])
        inexact[inexact] = ~fits
    return scaled, int(inexact.sum())
