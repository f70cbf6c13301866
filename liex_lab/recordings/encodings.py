"""How stored numbers mean depth: the ways that cameras and data sets of the field have come up with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.recordings.frame import Depth, depth_mm

Stored = NDArray[Any]

COLOUR = "nyu-hand"  # the one encoding of 8-bit colour pictures
_NO_DISPARITY = 2047  # of 11 bits


def _rotated(stored: Stored) -> Stored:
    """SUN RGB-D: millimetres, their 16 bits turned left by 3."""
    return (stored >> 3) | (stored << 13)


def _disparity(stored: Stored) -> Stored:
    """Kinect v1 as NYU Depth v2 keeps it: 11 bits of disparity, metres = 351.3 / (1092.5 - value)."""
    ahead = 1092.5 - stored.astype(np.float32)
    read = (ahead > 0) & (stored != _NO_DISPARITY)
    return np.where(read, 351_300.0 / np.where(read, ahead, 1.0), 0.0).astype(np.float32)


def _green_blue(stored: Stored) -> Stored:
    """NYU hands: (H, W, 3) 8 bits in the order blue, green, red; millimetres = 256 green + blue."""
    return stored[..., 1].astype(np.uint16) << 8 | stored[..., 0]


_MILLIMETRES: dict[str, tuple[float, Callable[[Stored], Stored]]] = {  # name: mm per step of what the function gives
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


def decode(stored: Stored, encoding: str, unit_mm: float, unread: Sequence[float] = (0.0,)) -> Depth:
    """Stored values (H, W) -> float32 mm (H, W), 0 = unread.

    unit_mm: millimetres per step of what `encoding` gives; unread: *stored* values that mean "no reading" (of what the
    encoding gives for colour pictures), besides those that it has by itself.
    """
    values = _MILLIMETRES[encoding][1](stored)
    if values is stored or stored.ndim == 3:
        return depth_mm(values, unit_mm, unread)
    depth = depth_mm(values, unit_mm)
    for value in unread:
        depth[stored == value] = 0.0
    return depth
