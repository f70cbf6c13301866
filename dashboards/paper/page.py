"""index.html: all tables and figures of the Lie-X paper on one page, by a Jinja template.

The page holds its pictures and asks nothing of any other machine. Glue: what it says is handed in.
"""

from __future__ import annotations

import base64
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup, escape

from liex_lab.runtime.durable import write_whole

from ..pages import page

TEMPLATES = Path(__file__).parent / "templates"
_DPI_SHOWN = 0.72  # of a picture's pixels, so that its letters are as large as the page's


def write_page(about: Mapping[str, Any], exhibits: Sequence[Mapping[str, Any]], path: Path) -> Path:
    """Write the page of tables and figures.

    Args:
        about: `title`, paragraphs `about`, `warnings` and `differences`, all in sentences.
        exhibits: in order, each with `label`, `title`, `said`, `tables` (caption, head, rows),
            `notes`, `pictures` (PNG files) and `missing`.
        path: of the page.

    Returns:
        `path`.
    """
    shown = [
        {
            **one,
            "said": _with_code(one["said"]),
            "missing": _with_code(one["missing"]),
            "notes": [_with_code(note) for note in one["notes"]],
            "tables": [_table(*table) for table in one["tables"]],
            "id": one["label"].lower().replace(".", "").replace(" ", "-"),
            "pictures": [_picture(file) for file in one["pictures"]],
            "empty": not one["tables"] and not one["pictures"],
        }
        for one in exhibits
    ]
    write_whole(path, page(TEMPLATES / "page.html.j2", **about, exhibits=shown))
    return path


def _table(
    caption: str, head: Sequence[str], rows: Sequence[Sequence[str]]
) -> tuple[str, Sequence[str], list[list[Markup]], list[str]]:
    """A table as it stands in the page; its columns of words are of the class `text`."""
    kinds = []
    for column in zip(*rows, strict=True):
        cells = [cell for cell in column if cell]
        numbers = sum(cell[0].isdigit() or cell[0] == "-" for cell in cells)
        kinds.append("number" if cells and 2 * numbers > len(cells) else "text")
    return caption, head, [[_with_code(cell) for cell in row] for row in rows], kinds


def _with_code(text: str) -> Markup:
    """A text of ours, what stands between backticks as code."""
    parts = [escape(part) for part in text.split("`")]
    for k in range(1, len(parts) - 1, 2):
        parts[k] = Markup("<code>{}</code>").format(parts[k])
    return Markup("").join(parts)


def _picture(path: Path) -> dict[str, Any]:
    """A PNG as it stands in the page."""
    content = path.read_bytes()
    (width,) = struct.unpack(">I", content[16:20])  # of the header chunk
    return {
        "name": path.stem.replace("_", " "),
        "width": round(_DPI_SHOWN * width),
        "data": "data:image/png;base64," + base64.b64encode(content).decode("ascii"),
    }
