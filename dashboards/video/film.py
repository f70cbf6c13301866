"""One session as a film: its image at any time, with skeletons, trail, action and time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.vocabulary import action_colours
from liex_lab.errors import SessionError
from liex_lab.optics.camera import Camera
from liex_lab.sessions import Session

from ..figures.seen import Array, DepthReader, Seen, animals, joints_in_picture
from .relief import Relief


@lru_cache(maxsize=8)
def _font(size: int) -> Any:
    """The font of matplotlib, which is the same on every machine."""
    from matplotlib.font_manager import findfont
    from PIL import ImageFont

    return ImageFont.truetype(findfont("DejaVu Sans"), size)


@lru_cache(maxsize=512)
def _stencil(text: str, size: int) -> NDArray[np.float32]:
    """The coverage of each pixel by a text, 0 to 1."""
    from PIL import Image, ImageDraw

    font = _font(size)
    left, _, right, bottom = font.getbbox(text)
    image = Image.new("L", (max(int(right - min(left, 0)), 1), max(int(bottom), 1)))
    ImageDraw.Draw(image).text((-min(left, 0), 0), text, font=font, fill=255)
    return np.asarray(image, np.float32) / 255.0


def text_width(text: str, size: int) -> int:
    """Width of a text, px, with letters of `size` px."""
    return int(_stencil(text, size).shape[1])


def write(
    picture: NDArray[np.uint8],
    text: str,
    x: int,
    y: int,
    size: int,
    colour: tuple[int, int, int] = (240, 240, 240),
) -> None:
    """Write a text into an image; it is clipped to the image.

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


_TRAIL_S = 2.0
_LEAST_PX = 24  # half the side of the view around an animal
_REACH = 1.9  # side of the view around an animal, in body lengths
_MARGIN = 0.05  # around the arena
_LOST = (255, 190, 90)


@dataclass(frozen=True)
class View:
    """The displayed part of a depth image.

    Attributes:
        left: its first column, px; may be outside the image.
        top: its first row, px.
        width: columns, px.
        height: rows, px.
    """

    left: int
    top: int
    width: int
    height: int


def way_of(joints: Array, camera: Camera) -> tuple[Array, int]:
    """Centre and size of a view that follows an animal smoothly.

    Args:
        joints: (n, J, 2) joints of every frame, px; NaN without a pose.
        camera: the depth camera.

    Returns:
        The smoothed centre (n, 2), px, interpolated without a pose, and half the side of a square
            around the animal, px.
    """
    middle = joints.mean(axis=1)
    known = np.isfinite(middle).all(axis=1)
    rows = np.arange(len(middle))
    if not known.any():
        still = np.tile([camera.width / 2, camera.height / 2], (len(middle), 1))
        return still, max(camera.height // 2, _LEAST_PX)
    whole = np.column_stack([np.interp(rows, rows[known], middle[known, axis]) for axis in (0, 1)])
    width = min(15, len(rows) | 1)
    padded = np.pad(whole, ((width // 2, width // 2), (0, 0)), mode="edge")
    kernel = np.ones(width) / width
    smooth = np.column_stack(
        [np.convolve(padded[:, axis], kernel, "valid")[: len(rows)] for axis in (0, 1)]
    )
    length = np.linalg.norm(np.diff(joints[known], axis=1), axis=-1).sum(axis=1)
    return smooth, max(int(_REACH * float(np.quantile(length, 0.95)) * 0.6), _LEAST_PX)


class Film:
    """The images of a session; `close` closes its files.

    Args:
        session: the opened session.
        top_mm: height of the lightest colour, mm.

    Raises:
        SessionError: the session has no depth.
    """

    def __init__(self, session: Session, top_mm: float) -> None:
        self.session = session
        self.seen: list[Seen] = animals(session)
        self._depth = DepthReader(session)
        if not self._depth.whole or self._depth.picture(0) is None:
            self._depth.close()
            raise SessionError(
                f"the session {session.path} keeps no depth pictures, and a video shows them; "
                "run `liex run` on its recording again, without --no-depth"
            )
        self._relief = Relief(session, top_mm)
        self._bones = [(int(a), int(b)) for a, b in session.metadata["animal"]["bones"]]
        self._colours = action_colours(self.seen[0].words)
        self._last: tuple[int, NDArray[np.uint16]] | None = None

    def close(self) -> None:
        """Close the open files."""
        self._depth.close()

    @cached_property
    def time_s(self) -> Array:
        """(n,) times of the frames, s."""
        return self.seen[0].frames["time_s"].to_numpy(float)

    @property
    def fps(self) -> float:
        """Median frames per second of this session."""
        return float(self.session.metadata["frames"]["fps_median"] or 30.0)

    @cached_property
    def uv(self) -> list[Array]:
        """The joints of each animal (n, J, 2), px; NaN without a pose."""
        return joints_in_picture(self.seen, len(self.time_s))

    def row_at(self, time_s: float) -> int:
        """The row of the frame displayed at a time, s."""
        return int(
            np.clip(np.searchsorted(self.time_s, time_s + 1e-6) - 1, 0, len(self.time_s) - 1)
        )

    def whole_view(self) -> View:
        """The arena and all positions of the animals; the whole image if the arena is unknown."""
        camera = self.session.camera
        points = [joints.reshape(-1, 2) for joints in self.uv]
        outline = self.session.arena.outline_mm()
        if len(outline):
            floor = np.column_stack([outline, np.zeros(len(outline))])
            rays = self.session.T_arena_camera.inverse() @ floor
            points.append(
                rays[:, :2] / rays[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
            )
        known = np.concatenate(points)
        known = known[np.isfinite(known).all(axis=1)]
        if not len(outline) or not len(known):
            return View(0, 0, camera.width, camera.height)
        low = known.min(axis=0)
        high = known.max(axis=0)
        margin = _MARGIN * float((high - low).max())
        x0, y0 = (int(max(np.floor(a - margin), 0)) for a in low)
        x1 = int(min(np.ceil(high[0] + margin), camera.width))
        y1 = int(min(np.ceil(high[1] + margin), camera.height))
        return View(x0, y0, max(x1 - x0, 2), max(y1 - y0, 2))

    def near_view(self, row: int, animal: int = 0) -> View:
        """The square around an animal, which follows it smoothly.

        Args:
            row: the frame's row.
            animal: its number in the session.
        """
        centre, half = self._ways[animal]
        u, v = centre[row]
        left = int(round(u - half))
        top = int(round(v - half))
        return View(left, top, 2 * half, 2 * half)

    @cached_property
    def _ways(self) -> list[tuple[Array, int]]:
        """For each animal the smoothed centre (n, 2), px, and half the side of the square, px."""
        return [way_of(joints, self.session.camera) for joints in self.uv]

    def words_at(self, time_s: float) -> list[str]:
        """The action of each animal at a time, s; "" if unlabelled."""
        words = []
        for seen, (start, stop) in zip(self.seen, self._spans, strict=True):
            at = int(np.searchsorted(start, time_s + 1e-6)) - 1
            inside = at >= 0 and stop[at] > time_s + 1e-6
            words.append(str(seen.bouts["action"].iloc[at]) if inside else "")
        return words

    @cached_property
    def _spans(self) -> list[tuple[Array, Array]]:
        return [
            (seen.bouts["start_s"].to_numpy(float), seen.bouts["stop_s"].to_numpy(float))
            for seen in self.seen
        ]

    def picture(
        self, time_s: float, view: View, size: tuple[int, int], title: str
    ) -> NDArray[np.uint8]:
        """The image at a time.

        Args:
            time_s: the time, s.
            view: the displayed part of the depth image.
            size: width and height of the result, px.
            title: in the upper left corner.

        Returns:
            (height, width, 3) uint8 RGB.
        """
        row = self.row_at(time_s)
        if self._last is None or self._last[0] != row:
            depth = self._depth.picture(row)
            if depth is None:
                camera = self.session.camera
                depth = np.zeros((camera.height, camera.width), np.uint16)
            self._last = (row, depth)
        shown = self._relief.picture(
            self._last[1], view.left, view.top, (view.width, view.height), size
        )
        scale = np.array([size[0] / view.width, size[1] / view.height])
        words = self.words_at(time_s)
        for joints, word in zip(self.uv, words, strict=True):
            self._draw_animal(shown, (joints + 0.5 - [view.left, view.top]) * scale, row, word)
        self._write(shown, time_s, row, words, title)
        self._write_length(shown, self._relief.pixel_mm * view.width / size[0])
        return shown

    def _draw_animal(self, picture: NDArray[np.uint8], at: Array, row: int, word: str) -> None:
        """Draw trail and skeleton; `at` (n, J, 2) are the joints in the image, px."""
        import cv2

        size = max(picture.shape[1] / 320.0, 0.9)
        first = self.row_at(self.time_s[row] - _TRAIL_S)
        trail = at[first : row + 1].mean(axis=1)
        trail = trail[np.isfinite(trail).all(axis=1)]
        if len(trail) > 1:
            fixed = np.rint(16.0 * trail).astype(np.int32)
            cv2.polylines(picture, [fixed], False, (235, 235, 235), 1, cv2.LINE_AA, 4)
        joints = at[row]
        if not np.isfinite(joints).all():
            return
        colour = _rgb(self._colours.get(word, "#ffffff"))
        fixed = np.rint(16.0 * joints).astype(int)
        thick = max(int(round(1.6 * size)), 2)
        for shade, width in (((0, 0, 0), thick + 2), (colour, thick)):
            for a, b in self._bones:
                p, q = (int(fixed[a, 0]), int(fixed[a, 1])), (int(fixed[b, 0]), int(fixed[b, 1]))
                cv2.line(picture, p, q, shade, width, cv2.LINE_AA, 4)
        for k, (x, y) in enumerate(fixed):
            fill = (238, 102, 119) if k == len(fixed) - 1 else (255, 255, 255)
            radius = int(16 * 2.0 * size)
            cv2.circle(picture, (int(x), int(y)), radius, fill, -1, cv2.LINE_AA, 4)

    def _write(
        self, picture: NDArray[np.uint8], time_s: float, row: int, words: list[str], title: str
    ) -> None:
        """Draw title, action, time, and the height scale."""
        height, width = picture.shape[:2]
        size = max(height // 26, 9)
        edge = size // 2
        write(picture, title, edge, edge, size)
        clock = f"{time_s:.2f} s"
        write(picture, clock, width - edge - text_width(clock, size), height - 2 * size, size)
        x = edge
        for word in dict.fromkeys(word for word in words if word):
            text = word.replace("_", " ")
            top = height - 2 * size
            picture[top + 2 : top + size, x : x + size - 2] = _rgb(self._colours[word])
            write(picture, text, x + size + 2, top, size)
            x += text_width(text, size) + 2 * size
        if not any(np.isfinite(joints[row]).all() for joints in self.uv):
            write(picture, "no pose", edge, height - 4 * size, size, _LOST)
        bar = self._relief.scale(min(6 * size, height // 3))
        right = width - edge - 6
        picture[edge : edge + len(bar), right : right + 6] = bar
        for text, y in ((f"{self._relief.top_mm:.0f} mm", edge), ("0", edge + len(bar) - size)):
            small = max(size - 2, 8)
            write(picture, text, right - 4 - text_width(text, small), y, small)

    def _write_length(self, picture: NDArray[np.uint8], pixel_mm: float) -> None:
        """Draw a scale bar of 1, 2 or 5 times a power of ten mm; `pixel_mm` is mm/px on the
        floor.
        """
        height, width = picture.shape[:2]
        size = max(height // 26, 9)
        longest_mm = pixel_mm * width / 5.0
        step_mm = 10.0 ** np.floor(np.log10(longest_mm))
        length_mm = max(step_mm * k for k in (1, 2, 5) if step_mm * k <= longest_mm)
        right = width - size // 2
        left = right - round(length_mm / pixel_mm)
        y = height - 5 * size // 2
        picture[y - 2 : y, left:right] = 240
        text = f"{length_mm:g} mm"
        write(picture, text, left - size // 2 - text_width(text, size), y - size // 2, size)


def _rgb(colour: str) -> tuple[int, int, int]:
    """#rrggbb as numbers."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
