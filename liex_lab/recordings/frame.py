"""One depth picture, and how stored numbers become millimetres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Depth = NDArray[np.float32]


@dataclass(frozen=True)
class DepthFrame:
    """A depth picture: index, its row in the recording it was read from; time_ns on the recording's
    own clock.

    depth (H, W) float32 mm along the optical axis; 0 = unread; finite, never negative.
    """

    index: int
    time_ns: int
    depth: Depth


def depth_mm(stored: NDArray[Any], unit_mm: float = 1.0, unread: Sequence[float] = (0.0,)) -> Depth:
    """Stored values (H, W) -> float32 mm (H, W), a fresh array; 0 = unread.

    unit_mm: millimetres per stored step, negative where the file's depth axis points towards the
    camera; unread: stored values that mean "no reading". They are marked before scaling, while they
    can still be compared exactly. 0, NaN and infinite values are always unread, and so is what lies
    behind the lens.
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
