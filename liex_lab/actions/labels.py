"""Human labels: tables of bouts (CSV or parquet; action, start_s, stop_s) as words of frames.

A track with its labels (`LabelledTrack`) is what recognisers are trained on and evaluated with.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from liex_lab.actions.ethogram import UNLABELLED
from liex_lab.errors import LiexError, one_line
from liex_lab.runtime.text_files import clock_s, number, read_texts
from liex_lab.tracking.track import Track

Array = NDArray[np.float64]

HUMAN = "human"
_NEEDED = ("action", "start_s", "stop_s")
_THOUSANDS = re.compile(r"[1-9]\d{0,2},\d{3}")  # next to 950, 1,034 is not a decimal number


def read_labels(path: str | Path) -> pd.DataFrame:
    """Bouts from a table, checked and in order of time.

    Args:
        path: our bouts.parquet, or a table as CSV or saved by a spreadsheet with the columns
            action, start_s, stop_s and, for several recordings, session_id.

    Returns:
        The table, with the column source set to human.

    Raises:
        LiexError: the file cannot be read, lacks a column, or has a bout that does not stop after
            it starts.
    """
    source = Path(path)
    try:
        table = pd.read_parquet(source) if source.suffix == ".parquet" else read_texts(source)
    except (OSError, ValueError) as error:
        raise LiexError(
            f"{source} should be a table of bouts, as CSV or parquet, but: {one_line(error)}"
        ) from None
    lacking = [name for name in _NEEDED if name not in table]
    if lacking:
        raise LiexError(
            f"{source} should have the columns {', '.join(_NEEDED)} (session_id, too, for several "
            f"recordings); it lacks {', '.join(lacking)}"
        )
    return checked(table.assign(source=HUMAN), str(source))


def checked(table: pd.DataFrame, origin: str) -> pd.DataFrame:
    """A table of bouts in order of time, its times as numbers and its actions as text.

    Args:
        table: columns action, start_s and stop_s at least.
        origin: the table's name in errors.

    Returns:
        A copy, sorted by start_s.

    Raises:
        LiexError: a bout does not start before it stops, in seconds; the message names the first.
    """
    times = pd.DataFrame({name: _numbers(table[name]) for name in ("start_s", "stop_s")})
    start, stop = (times[name].to_numpy() for name in ("start_s", "stop_s"))
    wrong = np.flatnonzero(~np.isfinite(start) | ~np.isfinite(stop) | (stop <= start))
    if len(wrong):
        row = {name: " ".join(str(table[name].iloc[wrong[0]]).split())[:80] for name in _NEEDED}
        raise LiexError(
            f"{origin}: each bout starts before it stops, in seconds or as hh:mm:ss, without "
            f"separators of thousands; the one of {row['action']} in row {wrong[0] + 1} has "
            f"start_s={row['start_s']} and stop_s={row['stop_s']}"
        )
    out = table.reset_index(drop=True).assign(
        action=table["action"].to_numpy().astype(str), **times
    )
    return out.sort_values("start_s", kind="stable").reset_index(drop=True)


def _numbers(column: pd.Series) -> NDArray[np.float64]:
    """A column (n,) of seconds or times as hh:mm:ss as numbers; NaN if not a number."""
    texts = [str(cell) for cell in column]
    commas = [text for text in texts if "," in text]
    thousands = len(commas) < len(texts) and all(map(_THOUSANDS.fullmatch, commas))
    return np.array([np.nan if thousands and "," in text else _seconds(text) for text in texts])


def _seconds(text: str) -> float:
    """Seconds, or a time as hh:mm:ss in seconds; NaN if neither."""
    with suppress(ValueError):
        return float(clock_s(text) if ":" in text else number(text))
    return float("nan")


def sessions_named(table: pd.DataFrame) -> set[str]:
    """The values of session_id in a table of labels; empty without that column."""
    return set(table["session_id"].astype(str)) if "session_id" in table else set()


def words_of(
    table: pd.DataFrame, time_s: NDArray[np.float64], session_id: str = ""
) -> NDArray[np.str_]:
    """The word of each frame, by the bouts of a session.

    Args:
        table: bouts, checked.
        time_s: (n,) s since the first frame, increasing.
        session_id: only bouts of this session; '' or a table without that column uses all.

    Returns:
        (n,) words, `UNLABELLED` outside all bouts; if bouts overlap, the later one.
    """
    if "session_id" in table and session_id:
        table = table[table["session_id"].astype(str) == session_id]
    longest = max([len(word) for word in table["action"]], default=1)
    out = np.full(len(time_s), UNLABELLED, dtype=f"<U{max(1, longest)}")
    for action, start_s, stop_s in zip(
        table["action"], table["start_s"], table["stop_s"], strict=True
    ):
        start, stop = np.searchsorted(time_s, [start_s - 1e-6, stop_s - 1e-6])
        out[start:stop] = action
    return out


@dataclass(frozen=True)
class LabelledTrack:
    """A track and the word of each of its frames.

    Attributes:
        track: one animal's track.
        words: (n,) '' if a frame has none.
        animal: the animal's name.
        wall_mm: (n,) distance of the animal's middle from the nearest wall, mm, NaN if unknown.
        truth: (n, J, 3) mm, true joints of a rendered animal; None otherwise.
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
        """The number of frames."""
        return len(self.words)

    def __getitem__(self, rows: slice | NDArray[np.int64]) -> LabelledTrack:
        """Some of its frames."""
        assert self.wall_mm is not None
        truth = None if self.truth is None else self.truth[rows]
        return LabelledTrack(
            some_rows(self.track, rows), self.words[rows], self.animal, self.wall_mm[rows], truth
        )


def some_rows(track: Track, rows: slice | NDArray[np.int64] | NDArray[np.bool_]) -> Track:
    """A track of some rows (a slice, indices, or a mask (n,)) of a track of n frames."""
    columns = [getattr(track, f.name)[rows] for f in fields(Track) if f.name != "skeleton"]
    return Track(track.skeleton, *columns)
