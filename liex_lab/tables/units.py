"""Units that people read: cm/s and degrees on pages and in replays; tables keep mm/s and rad."""

from __future__ import annotations

from typing import Any

import numpy as np

_SHOWN = {
    "mm/s": ("cm/s", 0.1),
    "mm/s²": ("cm/s²", 0.1),
    "rad": ("°", 180.0 / np.pi),
    "rad/s": ("°/s", 180.0 / np.pi),
}


def shown(value: Any, unit: str) -> tuple[Any, str]:
    """A number, or an array of them, in the unit that people read, and that unit.

    Args:
        value: in the unit of the files.
        unit: as columns.json names it; others than speeds and angles stay as they are.
    """
    name, factor = _SHOWN.get(unit, (unit, 1.0))
    return (value * factor if factor != 1.0 else value), name


def titled(column: str, unit: str) -> str:
    """The name of a column as people read it: without its unit, which stands beside the number.

    Args:
        column: name of the column, such as `mean_speed_mm_s`.
        unit: as columns.json names it.
    """
    tail = "_" + unit.replace("/", "_").replace("²", "2")
    return (column.removesuffix(tail) if unit else column).replace("_", " ")
