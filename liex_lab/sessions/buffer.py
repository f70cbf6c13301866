"""Growing array buffer of a track, filled part by part."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from liex_lab.tracking.track import Track

if TYPE_CHECKING:
    from liex_lab.body.skeleton import Skeleton


class Columnar(Protocol):
    """A dataclass of a skeleton and arrays with one row per frame: `Observations`, `Track`."""

    __dataclass_fields__: ClassVar[dict[str, Any]]


def columns_of(rows: Columnar) -> dict[str, NDArray[Any]]:
    """Arrays of a dataclass by name, in the order of its fields.

    Args:
        rows: the dataclass; fields that are no arrays are left out.
    """
    return {
        one.name: value
        for one in fields(rows)
        if isinstance(value := getattr(rows, one.name), np.ndarray)
    }


class TrackBuffer:
    """A track that grows by parts, in arrays made for the expected number of frames.

    Nothing is held twice as long as the expectation holds; beyond it the arrays grow by half.

    Args:
        skeleton: the skeleton of the track.
        n_expected: frames to make room for.
    """

    def __init__(self, skeleton: Skeleton, n_expected: int) -> None:
        self._room = Track.empty(skeleton, np.zeros(n_expected, np.int64))
        self._n = 0

    @staticmethod
    def of(track: Track) -> TrackBuffer:
        """A buffer that holds a track as it is, not copied.

        Args:
            track: all rows so far.
        """
        held = TrackBuffer(track.skeleton, 0)
        held._room = track
        held._n = track.n_frames
        return held

    def append(self, part: Track) -> None:
        """Append the next rows.

        Args:
            part: a track of the same skeleton.
        """
        needed = self._n + part.n_frames
        if needed > self._room.n_frames:
            more = max(needed - self._room.n_frames, self._room.n_frames // 2)
            self._room = Track.join(
                [self._room, Track.empty(part.skeleton, np.zeros(more, np.int64))]
            )
        for column in fields(Track):
            if column.name != "skeleton":
                getattr(self._room, column.name)[self._n : needed] = getattr(part, column.name)
        self._n = needed

    @property
    def track(self) -> Track:
        """The rows so far, not copied."""
        columns = [column.name for column in fields(Track) if column.name != "skeleton"]
        return Track(
            self._room.skeleton, *(getattr(self._room, name)[: self._n] for name in columns)
        )
