"""A track that someone has labelled: what recognisers learn from and are judged by."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from liex_lab.tracking.track import Track

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LabelledTrack:
    """A track and the word (n,) of each of its frames, '' where it has none; animal: whose it is; wall_mm (n,): how far
    its middle is from the nearest wall, NaN where nobody knows; truth (n, J, 3) mm: true joints, of rendered animals.
    """

    track: Track
    words: NDArray[np.str_]
    animal: str
    wall_mm: Array | None = None
    truth: Array | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.wall_mm is None:
            object.__setattr__(self, "wall_mm", np.full(len(self.words), np.nan))

    def __len__(self) -> int:
        """Frames."""
        return len(self.words)

    def __getitem__(self, rows: slice | NDArray[np.int64]) -> LabelledTrack:
        """Some of its frames."""
        assert self.wall_mm is not None
        truth = None if self.truth is None else self.truth[rows]
        return LabelledTrack(some_rows(self.track, rows), self.words[rows], self.animal, self.wall_mm[rows], truth)


def some_rows(track: Track, rows: slice | NDArray[np.int64] | NDArray[np.bool_]) -> Track:
    """Some frames of a track."""
    columns = [getattr(track, f.name)[rows] for f in fields(Track) if f.name != "skeleton"]
    return Track(track.skeleton, *columns)
