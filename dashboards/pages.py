"""HTML pages from jinja2 templates."""

from __future__ import annotations

from pathlib import Path
from typing import Any


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
