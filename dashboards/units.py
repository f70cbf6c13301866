"""Units, numbers and dates as people read them on pages; see `tables.units`."""

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
    """A measure as people read it: its name, and the unit that its values are shown in.

    Args:
        measure: a column of the summary.
        unit: its unit there; "" for none.
    """
    return f"{titled(measure, unit)}{f', {shown(1.0, unit)[1]}' if unit else ''}"


def counted(n: int, one: str, more: str = "") -> str:
    """A number with its noun: 1 stretch, 2 stretches.

    Args:
        n: how many.
        one: the noun for one.
        more: for several; "" adds an s.
    """
    return f"{n:,} {one if n == 1 else more or one + 's'}"


def reading(value: Any, unit: str) -> str:
    """A number as a person would write it, as text: counts whole, all numbers of a unit with as
    many decimals, more where one would not have two digits left; NaN is a dash.

    Args:
        value: in the unit that people read.
        unit: that unit, as `shown` gives it; "" for counts and ratios.
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
    """A date and time of day as people write it; a text that is none as it is.

    Args:
        iso: such as 2026-08-21T10:00:00+02:00.
    """
    try:
        when = datetime.fromisoformat(iso)
    except ValueError:
        return iso
    zone = when.strftime("%z")
    told = f" (UTC{zone[:3]}:{zone[3:5]})" if zone else ""
    return f"{when.day} {when:%B %Y, %H:%M:%S}{told}"


# HTML pages from jinja2 templates.


def page(template: Path, **shown: Any) -> str:
    """A page from its template; what is shown is escaped, and nothing that it names may be missing.

    Args:
        template: the file, HTML with jinja2's marks.
        shown: what the template names.
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
