"""What draws the figures and writes the page; handed in, for measuring knows no drawing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Drawers:
    """The functions that turn what was measured into files.

    Attributes:
        figures: of `vars` of the results by animal, into a folder; returns the files.
        tracking: of a test sequence and what was made of it, into a PNG.
        confusions: of what the actions' evaluation found, into a PNG.
        key_frames: of `key_frames.acted_key_frames`, into a PNG.
        nyu_hands: of `nyu.shown_hands`, into a PNG.
        page: of what stands on top and `exhibits.exhibits`, into a folder with the figures; returns
            the file.
    """

    figures: Callable[[Mapping[str, Any], Path], list[Path]]
    tracking: Callable[[Any, Any, Path], Path]
    confusions: Callable[[Mapping[str, Any], Path], Path]
    key_frames: Callable[[Sequence[Mapping[str, Any]], Path], Path]
    nyu_hands: Callable[[Sequence[Mapping[str, Any]], Path], Path]
    page: Callable[[Mapping[str, Any], Sequence[Mapping[str, Any]], Path], Path]
