"""One depth frame, and the linear law by which stored numbers become millimetres.

depth = unit_mm * stored, float32, measured along the optical axis (z of the camera frame, not range
along the ray); 0 means that there is no reading.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

Depth = NDArray[np.float32]

_FEW = 16  # one row and column of so many
_ROWS = 64
_MOST_ROOMS = 6  # that are kept: being filled, waiting, looked at (two at once), written


@dataclass(frozen=True)
class DepthFrame:
    """One depth picture with its row and its time.

    Attributes:
        index: its row in the recording that it was read from.
        time_ns: its time on the recording's own clock, ns.
        depth: (H, W) float32 mm along the optical axis; 0 = unread; finite, never negative.
        repeats: whether its depth is, bit for bit, that of the frame before it, and holds readings;
            known of frames that are read in order, see `marked`.
    """

    index: int
    time_ns: int
    depth: Depth
    repeats: bool = False


def marked(frames: Iterable[DepthFrame], before: Depth | None = None) -> Iterator[DepthFrame]:
    """Consecutive frames, each marked where it repeats the depth image of the frame before it.

    Args:
        frames: in order; the depth of the last one is held until the next one has come.
        before: depth (H, W) mm of the frame before the first; None where there is none.
    """
    for frame in frames:
        # a few rows tell nearly all images apart
        repeats = (
            before is not None
            and np.array_equal(frame.depth[::_ROWS], before[::_ROWS])
            and np.array_equal(frame.depth, before)
            and has_readings(frame.depth)
        )
        before = frame.depth
        yield replace(frame, repeats=repeats)


class FrameRooms:
    """Room for frames that lie side by side, used again once nobody holds a frame in it.

    What is new in memory has to be blanked by the system first, which takes longer than copying a
    picture into room that was used before.
    """

    def __init__(self) -> None:
        self._rooms: list[Depth] = []

    def filled(self, frames: Iterable[DepthFrame], n_frames: int) -> list[DepthFrame]:
        """The same frames, the depth of each copied into one array as it comes.

        `stacked` then need not copy them.

        Args:
            frames: of one size.
            n_frames: so many are taken at most.
        """
        taken: list[DepthFrame] = []
        room = None
        for frame in islice(frames, n_frames):
            if room is None:
                room = self._free((n_frames, *frame.depth.shape))
            depth = room[len(taken)]
            depth[...] = frame.depth
            taken.append(replace(frame, depth=depth))
        return taken

    def _free(self, shape: tuple[int, ...]) -> Depth:
        """Room of this shape in which nobody holds a frame: a frame's depth refers to its room."""
        for k in range(len(self._rooms)):
            if self._rooms[k].shape == shape and _references(self._rooms, k) == _UNUSED:
                return self._rooms[k]
        alike = [room for room in self._rooms if room.shape == shape]
        self._rooms = [*alike[1 - _MOST_ROOMS :], np.empty(shape, np.float32)]
        return self._rooms[-1]


def _references(rooms: list[Depth], k: int) -> int:
    """How often room k of a list is referred to, by the list and by whoever holds a frame in it."""
    return sys.getrefcount(rooms[k])


_UNUSED = _references([np.empty(0, np.float32)], 0)  # by its list alone


def stacked(frames: Sequence[DepthFrame]) -> NDArray[np.float32]:
    """Depth of frames as one array, not copied where they lie side by side in one of `FrameRooms`.

    Args:
        frames: at least one, of one size.

    Returns:
        (n, H, W) float32 mm; not to be written to.
    """
    room = frames[0].depth.base
    if (
        isinstance(room, np.ndarray)
        and room.ndim == 3
        and len(room) >= len(frames)
        and room.shape[1:] == frames[0].depth.shape
        and room.dtype == np.float32
        and all(
            frame.depth.base is room and frame.depth.ctypes.data == row.ctypes.data
            for frame, row in zip(frames, room, strict=False)
        )
    ):
        return room[: len(frames)]
    return np.stack([frame.depth for frame in frames])


def has_readings(depth: Depth) -> bool:
    """Whether a picture shows anything at all; of one that does a few pixels tell, as a rule.

    Args:
        depth: (H, W) float32 mm, 0 where unread.
    """
    return bool(depth[::_FEW, ::_FEW].any() or depth.any())


def depth_mm(stored: NDArray[Any], unit_mm: float = 1.0, unread: Sequence[float] = (0.0,)) -> Depth:
    """Depth in millimetres of stored values, by a linear law.

    Values that mean "no reading" are marked before scaling, while they can still be compared
    exactly. 0, NaN and infinite values are always unread, and so is what lies behind the lens.

    Args:
        stored: (H, W) or any other shape, integers or floats as the file holds them.
        unit_mm: mm per stored step, negative where the file's depth axis points towards the camera.
        unread: stored values that mean "no reading".

    Returns:
        float32 mm of the same shape, a fresh array; 0 = unread.
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
