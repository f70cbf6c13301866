"""Units, numbers and dates in the form shown on pages; see `tables.units`."""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.tables.schema import shown, titled

__all__ = ["counted", "day", "read_as", "reading", "shown", "titled"]

_DECIMALS = {"s": 2, "m": 2, "mm": 1, "cm/s": 1, "°": 1, "°/s": 1, "Hz": 1, "1/min": 1}


def read_as(measure: str, unit: str) -> str:
    """The displayed name of a summary column, with the unit of its displayed values.

    `unit` is the column's unit in the table; "" for a dimensionless column.
    """
    return f"{titled(measure, unit)}{f', {shown(1.0, unit)[1]}' if unit else ''}"


def counted(n: int, one: str, more: str = "") -> str:
    """A number with its noun: 1 stretch, 2 stretches; an empty `more` adds an s to `one`."""
    return f"{n:,} {one if n == 1 else more or one + 's'}"


def reading(value: Any, unit: str) -> str:
    """A number as text, with the decimals of its unit; NaN is a dash.

    Counts are integers. A number has more decimals if fewer than two digits would remain.

    Args:
        value: in the displayed unit.
        unit: that unit, as `shown` returns it; "" for counts and ratios.
    """
    if isinstance(value, int | np.integer):
        return f"{value:,}"
    if not np.isfinite(value):
        return "–"
    if float(value).is_integer() and not unit:
        return f"{value:,.0f}"
    decimals = _DECIMALS.get(unit, 2)
    if value:
        decimals = max(decimals, min(1 - math.floor(math.log10(abs(value))), 4))
    return f"{value:,.{decimals}f}"


def day(iso: str) -> str:
    """An ISO date and time (2026-08-21T10:00:00+02:00) in words; other text is returned
    unchanged.
    """
    try:
        when = datetime.fromisoformat(iso)
    except ValueError:
        return iso
    zone = when.strftime("%z")
    told = f" (UTC{zone[:3]}:{zone[3:5]})" if zone else ""
    return f"{when.day} {when:%B %Y, %H:%M:%S}{told}"


# HTML pages from Jinja templates.


def page(template: Path, **shown: Any) -> str:
    """An HTML page from its Jinja template; values are escaped, a missing value is an error.

    Args:
        template: the file, HTML with Jinja's marks.
        shown: the values of the template's variables.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    pages = Environment(
        loader=FileSystemLoader(template.parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return pages.get_template(template.name).render(**shown)
