"""index.html: all tables and figures of the Lie-X paper on one page, by a Jinja template.

The page holds its pictures and asks nothing of any other machine. Glue: what it says is handed in.
"""

from __future__ import annotations

import base64
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

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
            "id": one["label"].lower().replace(".", "").replace(" ", "-"),
            "pictures": [_picture(file) for file in one["pictures"]],
            "empty": not one["tables"] and not one["pictures"],
        }
        for one in exhibits
    ]
    write_whole(path, page(TEMPLATES / "page.html.j2", **about, exhibits=shown))
    return path


def _picture(path: Path) -> dict[str, Any]:
    """A PNG as it stands in the page."""
    content = path.read_bytes()
    (width,) = struct.unpack(">I", content[16:20])  # of the header chunk
    return {
        "name": path.stem.replace("_", " "),
        "width": round(_DPI_SHOWN * width),
        "data": "data:image/png;base64," + base64.b64encode(content).decode("ascii"),
    }
