"""Animals of a session for figures and pages: rows of the tables, names, and depth images."""

import threading
from collections.abc import Callable, Hashable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import cv2
import numpy as np
import pandas as pd

from liex_lab.arrays import Array, NDArray
from liex_lab.behaviour.activity import hold_times
from liex_lab.errors import LiexError
from liex_lab.sessions import Session, cutouts

Held = TypeVar("Held")
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
class SessionAnimal:
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
    def label(self) -> str:
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
        return self.rows_of(self.session.frames)

    @cached_property
    def bouts(self) -> pd.DataFrame:
        """Its rows of the table `bouts`."""
        return self.rows_of(self.session.bouts)

    @cached_property
    def kinematics(self) -> pd.DataFrame | None:
        """Its rows of the table `kinematics`; None for a session without behaviour measures."""
        known = self.session.has("kinematics.parquet")
        return self.rows_of(self.session.kinematics) if known else None

    def table(self, name: str) -> pd.DataFrame | None:
        """Its rows of another table, such as 'transitions'; None if absent."""
        known = self.session.has(f"{name}.parquet")
        return self.rows_of(self.session.table(name)) if known else None

    @cached_property
    def summary(self) -> "pd.Series[float] | None":
        """Its row of the summary; None if absent."""
        if not self.session.has("summary.csv"):
            return None
        own = self.rows_of(self.session.summary)
        return own.iloc[0] if len(own) else None

    @cached_property
    def lost_s(self) -> Array:
        """(k, 2) spans without a pose, or without frames of the camera, s."""
        gaps = self.rows_of(self.session.gaps)
        empty = gaps[gaps["n_frames_missing"] > 0]  # the others are corrected timestamps
        return empty[["start_s", "stop_s"]].to_numpy(float)

    @property  # not kept: those of a day are large
    def xy_mm(self) -> Array:
        """(n, 2) positions of the body's centre, mm, arena frame; NaN without a pose."""
        if self.kinematics is None:
            return np.empty((0, 2))
        return self.kinematics[["x_mm", "y_mm"]].to_numpy(float)

    @cached_property
    def hold_s(self) -> Array:
        """(n,) duration of each frame, s."""
        return hold_times(self.frames["time_s"].to_numpy(float))

    def column(self, name: str) -> Array:
        """A column of `kinematics`, interrupted at gaps of the camera; no line crosses them."""
        if self.kinematics is None or name not in self.kinematics:
            return np.full(len(self.frames), np.nan)
        return self.broken(self.kinematics[name])

    def broken(self, values: "pd.Series[float]") -> Array:
        """Values of every frame, with NaN for the first one after a gap of the camera."""
        return np.where(self.frames["gap_before"].to_numpy() == 0, values.to_numpy(float), np.nan)

    def rows_of(self, table: pd.DataFrame) -> pd.DataFrame:
        """The rows of a table that are of this animal."""
        if self.alone or "individual" not in table:
            return table
        return table[table["individual"].astype(str) == self.individual].reset_index(drop=True)


def session_animals(session: Session) -> list[SessionAnimal]:
    """Every animal of a session; only the drawn columns are read."""
    table = session.table("sessions")
    names = [str(name) for name in table["individual"]] or [str(session.metadata["individual"])]
    alone = len(set(names)) == 1
    more = () if alone else ("individual",)
    narrow = session.narrowed(frames=(*FRAMES, *more), kinematics=(*KINEMATICS, *more))
    found = {}
    for k, name in enumerate(names):
        stated = [
            table[key].iloc[k] if k < len(table) and key in table else ""
            for key in ("subject_id", "group")
        ]
        subject, group = (value if isinstance(value, str) else "" for value in stated)
        found[name] = SessionAnimal(narrow, name, alone, subject, group)
    return list(found.values())


def joints_in_image(animals: Sequence[SessionAnimal], n: int) -> list[Array]:
    """Image positions of the joints of each animal of a session.

    Args:
        animals: the animals of one session, see `session_animals`.
        n: frames of the session.

    Returns:
        For each animal (n, J, 2) px; NaN without a pose. Of imported points it is a view from
            above.
    """
    session = animals[0].session
    if session.metadata.get("imported"):  # no images: a view from above
        xyz = session.pose_arrays().xyz_mm
        return [session.camera.project(session.T_arena_camera.inverse() @ xyz)]
    table = session.table("poses", ["u_px", "v_px", *([] if animals[0].alone else ["individual"])])
    return [
        animal.rows_of(table)[["u_px", "v_px"]].to_numpy(float).reshape(n, -1, 2)
        for animal in animals
    ]


# Depth images


class Recent:
    """The objects used last, by key; one is made again when its stamp changes. Thread-safe.

    Args:
        most: the number of objects to keep.
        close: called with an object that is no longer kept.
    """

    def __init__(self, most: int, close: Callable[[Any], object] = id) -> None:
        self._most = most
        self._close = close
        self._lock = threading.RLock()
        self._kept: dict[Hashable, tuple[Any, Any]] = {}

    def get(self, key: Hashable, stamp: Any, make: Callable[[], Held]) -> Held:
        """The object of a key, made by `make` if it is missing or its stamp differs."""
        with self._lock:
            known = self._kept.pop(key, None)
            if known is None or known[0] != stamp:
                if known is not None:
                    self._close(known[1])
                known = (stamp, make())
            self._kept[key] = known  # at the end: the first ones are removed first
            while len(self._kept) > self._most:
                self._close(self._kept.pop(next(iter(self._kept)))[1])
            made: Held = known[1]
            return made

    def clear(self) -> None:
        """Close all objects."""
        with self._lock:
            while self._kept:
                self._close(self._kept.popitem()[1][1])


class DepthImages:
    """Depth images by session and row, from the sessions' own files. Thread-safe.

    The files stay open for a while; `close` closes them.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open = Recent(3, lambda opened: opened[0].close())

    def depth(self, session: Session, row: int) -> NDArray[np.uint16] | None:
        """(H, W) uint16 mm, 0 where unread; None if the session has no depth of this frame.

        Outside the stored cut-outs, it is the static background. Without a readable replay file, a
        thumbnail of the same frame is used.

        Args:
            session: the opened session.
            row: the frame's row in the table `frames`.
        """

        def opened() -> tuple[ExitStack, Any]:
            stack = ExitStack()
            return stack, stack.enter_context(cutouts.open_depth(session))

        with self._lock:
            try:
                file = (session.path / "session.mcap").stat()
                recording = self._open.get(
                    session.path, (file.st_mtime_ns, file.st_size, file.st_ino), opened
                )[1]
                return np.asarray(recording.frame(row).depth, np.uint16)
            except (LiexError, OSError, IndexError):
                return _thumbnail(session, row)

    def close(self) -> None:
        """Close all files."""
        with self._lock:
            self._open.clear()


def keeps_depth(session: Session) -> bool:
    """Whether the session's replay contains depth, beyond the thumbnails of the report."""
    return cutouts.meant_to_keep_depth(session) and session.has("session.mcap")


def _thumbnail(session: Session, row: int) -> NDArray[np.uint16] | None:
    """The thumbnail of this frame at its position in the whole image; None if absent."""
    index = int(session.frames["frame_index"].iloc[row])
    kept = [one for one in session.metadata.get("thumbnails", []) if one["frame_index"] == index]
    return read_cutout(session, kept[0])[1] if kept else None


def read_cutout(
    session: Session, entry: dict[str, Any]
) -> tuple[NDArray[np.uint16], NDArray[np.uint16]] | tuple[None, None]:
    """A stored cut-out (h, w) uint16 mm, and the whole image (H, W) with 0 around it.

    Args:
        session: the opened session.
        entry: its line in session.json: file, left_px and top_px.

    Returns:
        (None, None) if the file cannot be read.
    """
    cut = cv2.imread(str(session.path / entry["file"]), cv2.IMREAD_UNCHANGED)
    if cut is None:
        return None, None
    whole = np.zeros((session.camera.height, session.camera.width), np.uint16)
    paste(whole, np.asarray(cut, np.uint16), int(entry["left_px"]), int(entry["top_px"]))
    return np.asarray(cut, np.uint16), whole


def paste(whole: NDArray[Any], part: NDArray[Any], left: int, top: int) -> None:
    """Copy a part (h, w) to its place in a map (H, W), in place; what lies outside is left out."""
    (height, width), (h, w) = whole.shape, part.shape
    x0, y0, x1, y1 = max(left, 0), max(top, 0), min(left + w, width), min(top + h, height)
    if x1 > x0 and y1 > y0:
        whole[y0:y1, x0:x1] = part[y0 - top : y1 - top, x0 - left : x1 - left]
