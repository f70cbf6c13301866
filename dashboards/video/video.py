"""Videos of sessions: a whole session, several sessions in a grid, or clips of an action.

Clips are aligned: all begin a moment before the onset of their bout, and a finished clip is frozen
and dimmed until the longest ends. Of too many bouts, an evenly spaced selection is used.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import SessionError
from liex_lab.runtime.durable import replacing, unlinked
from liex_lab.runtime.progress import Progress, silent
from liex_lab.sessions import Session
from liex_lab.sessions.individuals import arena_name

from ..figures.groups import NO_GROUP
from ..units import counted
from .film import Film, scale_mm, write

_CODECS = ("libx264", "libopenh264")
_CLOCK = Fraction(1, 90_000)  # s, the common time unit of MP4


def h264() -> str:
    """The name of an available H.264 encoder of PyAV.

    Raises:
        SessionError: no H.264 encoder is available.
    """
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


@contextmanager
def video_file(path: Path, fps: float) -> Iterator[Callable[[NDArray[np.uint8], float], None]]:
    """A video file that is written frame by frame; after an error no file remains.

    Yields:
        A function that appends an image (H, W, 3) uint8 RGB, all of the size of the first, at a
            time, s, later than the previous one; 0 at the first. An odd row or column is left out.

    Args:
        path: the file to write.
        fps: its nominal frames per second; each frame is shown at its own time.

    Raises:
        SessionError: there is no encoder.
        PlaceError: the path is a symbolic link.
    """
    codec = h264()
    # the index at the beginning, for streaming players; no writer's name
    options = {"movflags": "+faststart", "fflags": "+bitexact"}
    with (
        replacing(unlinked(path)) as part,
        av.open(str(part), "w", format="mp4", options=options) as container,
    ):
        stream: Any = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001))
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = _CLOCK
        # fixed, because the output depends on it
        stream.codec_context.thread_count = 2
        if codec == "libx264":
            stream.options = {"crf": "20", "preset": "veryfast"}

        def add(image: NDArray[np.uint8], time_s: float) -> None:
            height, width = (n - n % 2 for n in image.shape[:2])
            if not stream.codec_context.is_open:  # at the first image
                stream.height, stream.width = height, width
            frame = av.VideoFrame.from_ndarray(
                np.ascontiguousarray(image[:height, :width]), format="rgb24"
            )
            frame.time_base = _CLOCK
            frame.pts = round(time_s / _CLOCK)
            container.mux(stream.encode(frame))

        yield add
        container.mux(stream.encode())


_WHOLE_PX = 640
_CELL_PX = 240
_HEAD_PX = 26
_GAP_PX = 3
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

    def image(self, after_s: float, size: tuple[int, int]) -> NDArray[np.uint8]:
        """The image at a time after the beginning; dimmed after the end.

        Args:
            after_s: time from its beginning, s.
            size: width and height, px.
        """
        film = self.film
        time_s = min(self.start_s + after_s, self.stop_s)
        if self.animal is None:
            view = film.whole_view()
        else:
            view = film.near_view(film.row_at(time_s), self.animal)
        shown = film.image(time_s, view, _fitted(view.width, view.height, size), self.title)
        placed = np.full((size[1], size[0], 3), _PAPER, np.uint8)
        y, x = np.subtract(placed.shape[:2], shown.shape[:2]) // 2
        placed[y : y + shown.shape[0], x : x + shown.shape[1]] = shown
        over = self.start_s + after_s > self.stop_s
        return (placed * 0.4).astype(np.uint8) if over else placed


def write_session(
    sessions: Sequence[Session],
    path: Path,
    *,
    start_s: float | None = None,
    stop_s: float | None = None,
    slower: float = 1.0,
    progress: Progress = silent,
) -> Path:
    """Write a session, or those of the animals of one arena, or a stretch, as a video.

    Frame k of the video is row k of the tables (of the stretch), shown at its own time, so the rate
    varies: the time t of the video of a whole session is the time t of the tables.

    Args:
        sessions: the opened session, or those of the animals of one arena over one depth image.
        path: the file to write.
        start_s: start of the stretch, s; None for the beginning.
        stop_s: end of the stretch, s; None for the end.
        slower: slow-motion factor; above 1 is slow motion.
        progress: reports the frames.

    Returns:
        The path.

    Raises:
        SessionError: the session has no depth, the stretch is empty, or there is no encoder.
    """
    h264()
    session, alone = sessions[0], len(sessions) == 1
    with closing(Film(session, scale_mm(sessions), sessions[1:])) as film:
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
        near = alone and (start_s is not None or stop_s is not None)
        title = session.name if alone else arena_name(session)
        cell = Cell(film, low, high, title, 0 if near else None)
        view = film.whole_view()
        size = (480, 480) if near else _fitted(view.width, view.height, (_WHOLE_PX, _WHOLE_PX))
        _write(path, film.fps, after_s, slower, lambda t: cell.image(t, size), progress)
    return path


def write_clips(
    arenas: Sequence[tuple[Sequence[Session], str]],
    path: Path,
    actions: Sequence[str] = (),
    *,
    most: int = 12,
    slower: float = 1.0,
    progress: Progress = silent,
) -> Path:
    """Write clips of actions, or whole sessions, in a grid as one video; returns its path.

    Args:
        arenas: each opened session, or those of the animals of one arena, and its group, "" for
            none. Groups are next to each other.
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
        sessions = [session for some, _ in arenas for session in some]
        top_mm = scale_mm(sessions)
        blocks: dict[str, list[Cell]] = {}
        for (first, *others), group in arenas:
            film = stack.enter_context(closing(Film(first, top_mm, others)))
            blocks.setdefault(group, []).extend(_cells(film, actions))
        if not any(blocks.values()):
            known = sorted({word for session in sessions for word in session.bouts["action"]})
            raise SessionError(
                f"no bout is named {' or '.join(actions)} in {counted(len(sessions), 'session')}; "
                f"named are {', '.join(map(str, known)) or 'none'}"
            )
        chosen: dict[str, list[Cell]] = {}
        for name, some in sorted(blocks.items()):
            rows = np.linspace(0, len(some) - 1, min(most, len(some))).round().astype(int)
            chosen |= {name: [some[k] for k in np.unique(rows)]} if some else {}
        cells = [cell for some in chosen.values() for cell in some]
        fps = max(cell.film.fps for cell in cells)
        longest = max(cell.stop_s - cell.start_s for cell in cells)
        what = (" or ".join(actions) or "session").replace("_", " ")
        heads = {}
        for name, some in chosen.items():
            total = len(blocks[name])
            count = f"n = {len(some)} of {total}" if len(some) < total else f"n = {total}"
            group = name or (NO_GROUP if len(chosen) > 1 else "")
            heads[name] = ", ".join(filter(None, (group, what, count)))
        _write(
            path,
            fps,
            np.arange(max(round(longest * fps * slower), 1)) / (fps * slower),
            slower,
            lambda t: _grid(chosen, heads, t),
            progress,
        )
    return path


def matches(word: str, actions: Iterable[str]) -> bool:
    """Whether a word is one of some actions, or a kind of one: rear_supported is a rear."""
    return any(word == action or word.startswith(f"{action}_") for action in actions)


def _grid(
    chosen: dict[str, list[Cell]], heads: dict[str, str], after_s: float
) -> NDArray[np.uint8]:
    """Groups of clips next to each other under headings, at a time after their beginnings, s."""
    n = max(len(cells) for cells in chosen.values())
    columns = int(np.ceil(np.sqrt(n)))
    step = _CELL_PX + _GAP_PX
    block = columns * step + 4 * _GAP_PX
    out = np.full(
        (_HEAD_PX + -(-n // columns) * step, max(block * len(chosen), 2 * step), 3),
        _PAPER,
        np.uint8,
    )
    for b, (group, cells) in enumerate(chosen.items()):
        write(out, heads[group], b * block + 4, 5, 15)
        for k, cell in enumerate(cells):
            row, column = divmod(k, columns)
            x, y = b * block + column * step, _HEAD_PX + row * step
            out[y : y + _CELL_PX, x : x + _CELL_PX] = cell.image(after_s, (_CELL_PX, _CELL_PX))
    return out


def _cells(film: Film, actions: Sequence[str]) -> list[Cell]:
    """The bouts of some actions in a session, or the whole session without actions."""
    end = float(film.time_s[-1]) + 1.0 / film.fps
    if not actions:
        several = len(film.animals) > 1
        return [Cell(film, 0.0, end, arena_name(film.session) if several else film.session.name)]
    found = []
    for k, animal in enumerate(film.animals):
        for bout in animal.bouts.to_dict("records"):
            if matches(str(bout["action"]), actions):
                # from half a second before a bout to half a second after it, but at most 6 s
                start = max(float(bout["start_s"]) - 0.5, 0.0)
                found.append(
                    Cell(
                        film,
                        start,
                        min(float(bout["stop_s"]) + 0.5, end, start + 6.0),
                        animal.label,
                        k,
                    )
                )
    return found


def _fitted(width: int, height: int, room: tuple[int, int]) -> tuple[int, int]:
    """The largest size of this aspect ratio within `room`, in even numbers of px."""
    scale = min(room[0] / width, room[1] / height)
    return max(int(width * scale) // 2 * 2, 2), max(int(height * scale) // 2 * 2, 2)


def _write(
    path: Path,
    fps: float,
    after_s: NDArray[np.float64],
    slower: float,
    image: Callable[[float], NDArray[np.uint8]],
    progress: Progress,
) -> None:
    """Write the images at the times (n,) s after the beginning, each shown at its time."""
    unlinked(path).parent.mkdir(parents=True, exist_ok=True)
    n = len(after_s)
    with video_file(path, fps) as add:
        for k, at_s in enumerate(after_s.tolist()):
            if k % 20 == 0:
                progress(k, n, "drawing the video")
            add(image(at_s), slower * (at_s - after_s[0]))
        progress(n, n, "drawing the video")
