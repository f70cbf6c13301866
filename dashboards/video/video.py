"""Videos of sessions: a whole session, several sessions in a grid, or clips of an action.

Clips are aligned: all begin a moment before the onset of their bout, and a finished clip is frozen
and dimmed until the longest ends. Of too many bouts, an evenly spaced selection is used.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import SessionError
from liex_lab.runtime.durable import replacing
from liex_lab.runtime.places import unlinked
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Session

from ..figures.groups import NO_GROUP
from ..units import counted
from .film import Film, write
from .relief import scale_mm

_CODECS = ("libx264", "libopenh264")
_CLOCK = Fraction(1, 90_000)  # s, the common time unit of MP4
_THREADS = 2  # fixed, because the output depends on it


def h264() -> str:
    """The name of an available H.264 encoder of PyAV.

    Raises:
        SessionError: there is none.
    """
    import av

    for name in _CODECS:
        try:
            av.codec.Codec(name, "w")
        except ValueError:  # av's UnknownCodecError is one
            continue
        return name
    raise SessionError(
        f"a video is written as H.264, and the PyAV that is installed here ({av.__version__}) has "
        f"neither {' nor '.join(_CODECS)}; `pip install --force-reinstall --no-binary :none: av` "
        "brings one that has"
    )


class Video:
    """A video file that is written frame by frame (a context manager).

    It is written under another name and renamed at the end; after an error no file remains.

    Args:
        path: the file to write.
        fps: its nominal frames per second; each frame is shown at its own time.

    Raises:
        SessionError: there is no encoder.
        PlaceError: the path is a symbolic link.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self._codec = h264()
        self._path = unlinked(path)
        self._files = ExitStack()
        self._fps = Fraction(fps).limit_denominator(1001)
        self._box: Any = None
        self._stream: Any = None

    def __enter__(self) -> Video:
        return self

    def add(self, picture: NDArray[np.uint8], time_s: float) -> None:
        """Append an image; all have the size of the first.

        Args:
            picture: (H, W, 3) uint8 RGB; an odd row or column is left out.
            time_s: its time, s, later than the previous one; 0 at the first.
        """
        import av

        height, width = (n - n % 2 for n in picture.shape[:2])
        if self._box is None:
            part = self._files.enter_context(replacing(self._path))
            self._box = av.open(str(part), "w", format="mp4", options=_box_options())
            self._files.push(self._end)
            self._stream = self._box.add_stream(self._codec, rate=self._fps)
            self._stream.width = width
            self._stream.height = height
            self._stream.pix_fmt = "yuv420p"
            self._stream.codec_context.time_base = _CLOCK
            self._stream.codec_context.thread_count = _THREADS
            if self._codec == "libx264":
                self._stream.options = {"crf": "20", "preset": "veryfast"}
        frame = av.VideoFrame.from_ndarray(
            np.ascontiguousarray(picture[:height, :width]), format="rgb24"
        )
        frame.time_base = _CLOCK
        frame.pts = round(time_s / _CLOCK)
        self._box.mux(self._stream.encode(frame))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._files.__exit__(kind, error, trace)

    def _end(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the container, after the last frames if there was no error."""
        if kind is None:
            self._box.mux(self._stream.encode())
        self._box.close()


def _box_options() -> dict[str, str]:
    """The index at the beginning, for streaming players; no writer's name."""
    return {"movflags": "+faststart", "fflags": "+bitexact"}


_BEFORE_S = 0.5  # before a bout
_AFTER_S = 0.5
_LONGEST_S = 6.0  # of a clip
_MOST = 12  # clips of a group
_WHOLE_PX = 640
_CELL_PX = 240
_HEAD_PX = 26
_GAP_PX = 3
_DIMMED = 0.4
_PAPER = 18


@dataclass(frozen=True)
class Cell:
    """A cell of the grid: a stretch of a session.

    Attributes:
        film: the session.
        start_s: its beginning, s.
        stop_s: its end, s.
        title: drawn in the cell.
        animal: number of the animal to follow; None shows the whole arena.
    """

    film: Film
    start_s: float
    stop_s: float
    title: str
    animal: int | None = None

    def picture(self, after_s: float, size: tuple[int, int]) -> NDArray[np.uint8]:
        """The image at a time after the beginning; dimmed after the end.

        Args:
            after_s: time from its beginning, s.
            size: width and height, px.
        """
        over = self.start_s + after_s > self.stop_s
        time_s = min(self.start_s + after_s, self.stop_s)
        film = self.film
        view = (
            film.whole_view()
            if self.animal is None
            else film.near_view(film.row_at(time_s), self.animal)
        )
        shown = film.picture(time_s, view, _fitted(view.width, view.height, size), self.title)
        placed = np.full((size[1], size[0], 3), _PAPER, np.uint8)
        y = (size[1] - shown.shape[0]) // 2
        x = (size[0] - shown.shape[1]) // 2
        placed[y : y + shown.shape[0], x : x + shown.shape[1]] = shown
        return (placed * _DIMMED).astype(np.uint8) if over else placed


def write_session(
    session: Session,
    path: Path,
    *,
    start_s: float | None = None,
    stop_s: float | None = None,
    slower: float = 1.0,
    progress: Progress = silent,
) -> Path:
    """Write a session, or a stretch of it, as a video; returns its path.

    Frame k of the video is row k of the tables (of the stretch), shown at its own time, so the rate
    varies: the time t of the video of a whole session is the time t of the tables.

    Args:
        session: the opened session.
        path: the file to write.
        start_s: start of the stretch, s; None for the beginning.
        stop_s: end of the stretch, s; None for the end.
        slower: slow-motion factor; above 1 is slow motion.
        progress: reports the frames.

    Raises:
        SessionError: the session has no depth, the stretch is empty, or there is no encoder.
    """
    h264()
    with closing(Film(session, scale_mm([session]))) as film:
        end = float(film.time_s[-1]) + 1.0 / film.fps
        low = 0.0 if start_s is None else max(start_s, 0.0)
        high = end if stop_s is None else min(stop_s, end)
        if not high > low:
            raise SessionError(
                f"the session {session.name} lasts {end:.2f} s, and {low:.2f} to {high:.2f} s is "
                "no part of it; name other times"
            )
        first, last = np.searchsorted(film.time_s, np.array([low, high]) - 1e-6)
        rows = range(first, last) or [film.row_at(low)]  # in a gap, the frame before the gap
        after_s = film.time_s[rows] - low
        near = start_s is not None or stop_s is not None
        cell = Cell(film, low, high, session.name, 0 if near else None)
        view = film.whole_view()
        size = (480, 480) if near else _fitted(view.width, view.height, (_WHOLE_PX, _WHOLE_PX))
        _write(path, film.fps, after_s, slower, lambda t: cell.picture(t, size), progress)
    return path


def write_clips(
    sessions: Sequence[tuple[Session, str]],
    path: Path,
    actions: Sequence[str] = (),
    *,
    most: int = _MOST,
    slower: float = 1.0,
    progress: Progress = silent,
) -> Path:
    """Write clips of actions, or whole sessions, in a grid as one video; returns its path.

    Args:
        sessions: each opened session and its group, "" for none. Groups are next to each other.
        path: the file to write.
        actions: words, or the beginnings of words (rear includes rear_supported); () shows the
            whole sessions.
        most: the maximum number of clips per group.
        slower: slow-motion factor.
        progress: reports the frames.

    Raises:
        SessionError: a session has no depth, no bout has such a name, or there is no encoder.
    """
    h264()
    with ExitStack() as stack:
        top_mm = scale_mm([session for session, _ in sessions])
        blocks: dict[str, list[Cell]] = {}
        for session, group in sessions:
            film = stack.enter_context(closing(Film(session, top_mm)))
            blocks.setdefault(group, []).extend(_cells(film, actions))
        if not any(blocks.values()):
            known = sorted({word for session, _ in sessions for word in session.bouts["action"]})
            raise SessionError(
                f"no bout is named {' or '.join(actions)} in {counted(len(sessions), 'session')}; "
                f"named are {', '.join(map(str, known)) or 'none'}"
            )
        chosen = {name: _evenly(cells, most) for name, cells in sorted(blocks.items()) if cells}
        cells = [cell for some in chosen.values() for cell in some]
        fps = max(cell.film.fps for cell in cells)
        longest = max(cell.stop_s - cell.start_s for cell in cells)
        counts = {name: len(some) for name, some in blocks.items()}
        grid = _Grid(chosen, counts, " or ".join(actions) or "session")
        n = max(int(round(longest * fps * slower)), 1)
        _write(path, fps, np.arange(n) / (fps * slower), slower, grid.picture, progress)
    return path


def matches(word: str, actions: Iterable[str]) -> bool:
    """Whether a word is one of some actions, or a kind of one: rear_supported is a rear."""
    return any(word == action or word.startswith(f"{action}_") for action in actions)


class _Grid:
    """Groups of clips next to each other, under headings with their n."""

    def __init__(self, chosen: dict[str, list[Cell]], counts: dict[str, int], what: str) -> None:
        self._chosen = chosen
        self._counts = counts
        self._what = what
        n = max(len(cells) for cells in chosen.values())
        self._columns = int(np.ceil(np.sqrt(n)))
        self._rows = -(-n // self._columns)

    def picture(self, after_s: float) -> NDArray[np.uint8]:
        """All cells at a time after their beginnings, s."""
        step = _CELL_PX + _GAP_PX
        wide = self._columns * step + 4 * _GAP_PX
        out = np.full(
            (_HEAD_PX + self._rows * step, max(wide * len(self._chosen), 2 * step), 3),
            _PAPER,
            np.uint8,
        )
        for b, (group, cells) in enumerate(self._chosen.items()):
            name = group or (NO_GROUP if len(self._chosen) > 1 else "")
            shown = len(cells)
            n = self._counts[group]
            of = f"{shown} of {n}" if shown < n else f"{n}"
            head = ", ".join(
                part for part in (name, self._what.replace("_", " "), f"n = {of}") if part
            )
            write(out, head, b * wide + 4, 5, 15)
            for k, cell in enumerate(cells):
                row, column = divmod(k, self._columns)
                x = b * wide + column * step
                y = _HEAD_PX + row * step
                out[y : y + _CELL_PX, x : x + _CELL_PX] = cell.picture(
                    after_s, (_CELL_PX, _CELL_PX)
                )
        return out


def _cells(film: Film, actions: Sequence[str]) -> list[Cell]:
    """The bouts of some actions in a session, or the whole session without actions."""
    end = float(film.time_s[-1]) + 1.0 / film.fps
    if not actions:
        return [Cell(film, 0.0, end, film.session.name)]
    found = []
    for animal, seen in enumerate(film.seen):
        for row in seen.bouts.itertuples():
            if matches(str(row.action), actions):
                start = max(float(row.start_s) - _BEFORE_S, 0.0)  # type: ignore[arg-type]
                stop = min(float(row.stop_s) + _AFTER_S, end)  # type: ignore[arg-type]
                found.append(Cell(film, start, min(stop, start + _LONGEST_S), seen.who, animal))
    return found


def _evenly(cells: list[Cell], most: int) -> list[Cell]:
    """At most `most` cells, evenly spaced over all."""
    if len(cells) <= most:
        return cells
    return [cells[int(k)] for k in np.unique(np.linspace(0, len(cells) - 1, most).round())]


def _fitted(width: int, height: int, room: tuple[int, int]) -> tuple[int, int]:
    """The largest size of this aspect ratio within `room`, in even numbers of px."""
    scale = min(room[0] / width, room[1] / height)
    return max(int(width * scale) // 2 * 2, 2), max(int(height * scale) // 2 * 2, 2)


def _write(
    path: Path,
    fps: float,
    after_s: NDArray[np.float64],
    slower: float,
    picture: Callable[[float], NDArray[np.uint8]],
    progress: Progress,
) -> None:
    """Write the images at the times (n,) s after the beginning, each shown at its time."""
    unlinked(path).parent.mkdir(parents=True, exist_ok=True)
    n = len(after_s)
    with Video(path, fps) as video:
        for k, at_s in enumerate(after_s.tolist()):
            if k % 20 == 0:
                progress(k, n, "drawing the video")
            video.add(picture(at_s), slower * (at_s - after_s[0]))
        progress(n, n, "drawing the video")
