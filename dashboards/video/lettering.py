"""Letters upon pictures, in any language that the font knows."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray


@lru_cache(maxsize=8)
def _font(size: int) -> Any:
    """The font that comes with matplotlib, so that every machine has it."""
    from matplotlib.font_manager import findfont
    from PIL import ImageFont

    return ImageFont.truetype(findfont("DejaVu Sans"), size)


@lru_cache(maxsize=512)
def _stencil(text: str, size: int) -> NDArray[np.float32]:
    """How much of each pixel a text covers, 0 to 1."""
    from PIL import Image, ImageDraw

    font = _font(size)
    left, _, right, bottom = font.getbbox(text)
    image = Image.new("L", (max(int(right - min(left, 0)), 1), max(int(bottom), 1)))
    ImageDraw.Draw(image).text((-min(left, 0), 0), text, font=font, fill=255)
    return np.asarray(image, np.float32) / 255.0


def text_width(text: str, size: int) -> int:
    """Width of a text, px.

    Args:
        text: the text.
        size: of its letters, px.
    """
    return int(_stencil(text, size).shape[1])


def write(
    picture: NDArray[np.uint8],
    text: str,
    x: int,
    y: int,
    size: int,
    colour: tuple[int, int, int] = (240, 240, 240),
) -> None:
    """Write a text into a picture; what does not fit is cut off.

    Args:
        picture: (H, W, 3) uint8 RGB, changed in place.
        text: the text.
        x: its left end, px.
        y: its upper end, px.
        size: of its letters, px.
        colour: RGB.
    """
    if not text:
        return
    x = max(x, 0)
    y = max(y, 0)
    stencil = _stencil(text, size)[: max(picture.shape[0] - y, 0), : max(picture.shape[1] - x, 0)]
    if not stencil.size:
        return
    there = picture[y : y + stencil.shape[0], x : x + stencil.shape[1]]
    share = stencil[..., None]
    there[:] = (there * (1.0 - share) + share * np.array(colour, np.float32)).astype(np.uint8)
