"""Units, numbers and dates in the form shown on pages; see `tables.units`."""

import math
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.tables.schema import shown, titled

__all__ = ["counted", "day", "read_as", "reading", "shown", "titled"]


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
    decimals = {"s": 2, "m": 2, "mm": 1, "cm/s": 1, "°": 1, "°/s": 1, "Hz": 1, "1/min": 1}.get(
        unit, 2
    )
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
    offset = f" (UTC{zone[:3]}:{zone[3:5]})" if zone else ""
    return f"{when.day} {when:%B %Y, %H:%M:%S}{offset}"


# Texts from Jinja templates


@cache
def _template(file: Path) -> Any:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

    texts = Environment(
        loader=FileSystemLoader(file.parent),
        autoescape=select_autoescape(("html.j2",)),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return texts.get_template(file.name)


def page(template: Path, **shown: Any) -> str:
    """A text from its Jinja template; in HTML values are escaped; a missing value is an error.

    Args:
        template: the file; HTML if its name ends in .html.j2.
        shown: the values of the template's variables.
    """
    return str(_template(template).render(**shown))


def paragraphs(template: Path, **shown: Any) -> list[str]:
    """The paragraphs of a text; <paragraph> begins one, and spaces do not matter.

    Args:
        template: the file, see `page`.
        shown: the values of the template's variables.
    """
    parts = (" ".join(part.split()) for part in page(template, **shown).split("<paragraph>"))
    return [part for part in parts if part]
