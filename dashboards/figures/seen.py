"""One animal of one session for figures: its rows of the tables, and its name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from types import TracebackType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from liex_lab.behaviour.activity import hold_times
from liex_lab.sessions import Session
from liex_lab.sessions.cutouts import meant_to_keep_depth

from ..app.frames import Frames

if TYPE_CHECKING:
    import pandas as pd


Array = NDArray[np.float64]
# the drawn columns, beyond those of every table
FRAMES = ("frame_index", "time_s", "gap_before", "predicted_error_mm", "spine_mm")
KINEMATICS = (
    "time_s",
    "x_mm",
    "y_mm",
    "z_mm",
    "step_mm",
    "speed_mm_s",
    "nose_height_mm",
    "tail_beat_hz",
    "bend_rad",
    "opening",
)


@dataclass(frozen=True)
class Seen:
    """An animal in a session.

    Attributes:
        session: the opened session.
        individual: the animal's name in its tables.
        alone: whether it is the session's only animal.
        subject: the subject's name; "" if absent.
        group: its group; "" if absent.
    """

    session: Session
    individual: str
    alone: bool = True
    subject: str = ""
    group: str = ""

    @property
    def who(self) -> str:
        """Its name in titles: the subject if present, else the session."""
        name = self.subject or self.session.name
        return name if self.alone else f"{name}, {self.individual}"

    @cached_property
    def words(self) -> list[str]:
        """The vocabulary, in the order of its colours."""
        return list(self.session.metadata.get("actions", {}))

    @property
    def duration_s(self) -> float:
        """Length of the session, s."""
        return float(self.session.metadata["frames"]["duration_s"])

    @cached_property
    def frames(self) -> pd.DataFrame:
        """Its rows of the table `frames`."""
        return self._own(self.session.frames)

    @cached_property
    def bouts(self) -> pd.DataFrame:
        """Its rows of the table `bouts`."""
        return self._own(self.session.bouts)

    @cached_property
    def kinematics(self) -> pd.DataFrame | None:
        """Its rows of the table `kinematics`; None for a session without behaviour measures."""
        if not self.session.has("kinematics.parquet"):
            return None
        return self._own(self.session.kinematics)

    def table(self, name: str) -> pd.DataFrame | None:
        """Its rows of another table, such as 'transitions'; None if absent."""
        if not self.session.has(f"{name}.parquet"):
            return None
        return self._own(self.session.table(name))

    @cached_property
    def summary(self) -> pd.Series[float] | None:
        """Its row of the summary; None if absent."""
        if not self.session.has("summary.csv"):
            return None
        own = self._own(self.session.summary)
        return own.iloc[0] if len(own) else None

    @cached_property
    def lost_s(self) -> Array:
        """(k, 2) spans without a pose, or without frames of the camera, s."""
        gaps = self._own(self.session.gaps)
        empty = gaps[gaps["n_frames_missing"] > 0]  # the others are corrected timestamps
        return empty[["start_s", "stop_s"]].to_numpy(float)

    @cached_property
    def xy_mm(self) -> Array:
        """(n, 2) positions of the body's centre, mm, arena frame; NaN without a pose."""
        if self.kinematics is None:
            return np.empty((0, 2))
        return self.kinematics[["x_mm", "y_mm"]].to_numpy(float)

    @cached_property
    def hold_s(self) -> Array:
        """(n,) duration of each frame, s."""
        if self.kinematics is None or not len(self.kinematics):
            return np.empty(0)
        return hold_times(self.kinematics["time_s"].to_numpy(float))

    def column(self, name: str) -> Array:
        """A column of `kinematics`, interrupted at gaps of the camera; no line crosses them."""
        if self.kinematics is None or name not in self.kinematics:
            return np.full(len(self.frames), np.nan)
        return self.broken(self.kinematics[name])

    def broken(self, values: pd.Series[float]) -> Array:
        """Values of every frame, with NaN for the first one after a gap of the camera."""
        whole = self.frames["gap_before"].to_numpy() == 0
        return np.where(whole, values.to_numpy(float), np.nan)

    def _own(self, table: pd.DataFrame) -> pd.DataFrame:
        if self.alone or "individual" not in table:
            return table
        return table[table["individual"].astype(str) == self.individual].reset_index(drop=True)


def animals(session: Session) -> list[Seen]:
    """Every animal of a session; only the drawn columns are read."""
    table = session.table("sessions")
    names = [str(name) for name in table["individual"]] or [str(session.metadata["individual"])]
    alone = len(set(names)) == 1
    who = () if alone else ("individual",)
    narrow = session.narrowed(frames=(*FRAMES, *who), kinematics=(*KINEMATICS, *who))
    stated = {
        key: [_text(value) for value in table[key]] if key in table else [""] * len(names)
        for key in ("subject_id", "group")
    }
    rows = zip(names, stated["subject_id"] or [""], stated["group"] or [""], strict=True)
    found = {name: Seen(narrow, name, alone, subject, group) for name, subject, group in rows}
    return list(found.values())


def _text(value: object) -> str:
    """A name; "" if absent."""
    return value if isinstance(value, str) else ""


def joints_in_picture(all_seen: Sequence[Seen], n: int) -> list[Array]:
    """Image positions of the joints of each animal of a session.

    Args:
        all_seen: the animals of one session, see `animals`.
        n: frames of the session.

    Returns:
        For each animal (n, J, 2) px; NaN without a pose.
    """
    names = ["u_px", "v_px", *([] if all_seen[0].alone else ["individual"])]
    table = all_seen[0].session.table("poses", names)
    found = []
    for seen in all_seen:
        own = table if seen.alone else table[table["individual"].astype(str) == seen.individual]
        found.append(own[["u_px", "v_px"]].to_numpy(float).reshape(n, -1, 2))
    return found


# Depth images of a session for figures and videos.


class DepthReader:
    """The depth images of a session's replay (a context manager).

    Args:
        session: the opened session.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._frames = Frames()

    def __enter__(self) -> DepthReader:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the open file."""
        self._frames.close()

    @property
    def whole(self) -> bool:
        """Whether the session's replay contains depth, beyond the thumbnails of the report."""
        return meant_to_keep_depth(self._session) and self._session.has("session.mcap")

    def picture(self, row: int) -> NDArray[np.uint16] | None:
        """(H, W) uint16 mm, 0 where unread; None if the session has no depth of this frame.

        `row` is the frame's row in the table `frames`.
        """
        return self._frames.depth(self._session.name, self._session, row)
