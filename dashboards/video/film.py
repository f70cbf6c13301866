"""One session as a film: its image at any time, with skeletons, trail, action and time.

Several animals of one arena have a colour and a name each, and their interactions are named.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.font_manager import findfont
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from liex_lab.actions.vocabulary import INTERACTIONS, action_colours, individual_colours
from liex_lab.errors import SessionError
from liex_lab.optics.camera import Camera
from liex_lab.sessions import Session
from liex_lab.sessions.individuals import individuals_of

from ..figures.animals import (
    Array,
    DepthImages,
    joints_in_image,
    keeps_depth,
    paste,
    session_animals,
)
from ..figures.places import in_image

_MOST_FRAMES = 120_000  # whose heights give the scale
_PLAIN = 128  # neutral light
_LIGHT = np.array([-0.5, -0.6])
_WHITE = (255, 255, 255)


class Relief:
    """The colours of a session's depth images.

    Args:
        session: its camera and floor are used.
        top_mm: height of the lightest colour, mm.
    """

    def __init__(self, session: Session, top_mm: float) -> None:
        camera = session.camera
        up = np.asarray(session.T_arena_camera.rotation, float)[2]
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        self._per_mm = (up[0] * rays[0] + up[1] * rays[1] + up[2]).astype(np.float32)
        self._above_mm = np.float32(np.asarray(session.T_arena_camera.translation, float)[2])
        self.pixel_mm = float(self._above_mm) / camera.fx
        self.top_mm = top_mm
        self.shape = (camera.height, camera.width)
        shades = colormaps["viridis"](np.linspace(0.08, 1.0, 256))
        self._colours = (255.0 * np.asarray(shades)[:, :3]).astype(np.uint8)
        self._outside = _beyond_walls(session, np.stack([*rays, np.ones_like(rays[0])], axis=-1))

    def heights(self, depth: NDArray[np.uint16]) -> NDArray[np.float32]:
        """(H, W) heights above the floor, mm, of depth (H, W) uint16 mm; NaN where unread (0)."""
        heights = depth.astype(np.float32) * self._per_mm + self._above_mm
        heights[depth == 0] = np.nan
        return heights

    def image(
        self,
        depth: NDArray[np.uint16],
        left: int,
        top: int,
        side: tuple[int, int],
        size: tuple[int, int],
    ) -> NDArray[np.uint8]:
        """A part of a depth image in colours, enlarged smoothly.

        Args:
            depth: (H, W) uint16 mm, 0 where unread.
            left: first column of the part, px; may be outside the image.
            top: its first row, px.
            side: width and height of the part, px.
            size: width and height of the result, px.

        Returns:
            (height, width, 3) uint8 RGB.
        """
        heights = _part(self.heights(depth), left, top, side)
        read = np.isfinite(heights)
        # unread pixels are floor while they are enlarged, and painted over afterwards
        clipped = np.clip(np.where(read, heights, 0.0), -10.0, 3.0 * self.top_mm)
        even = cv2.GaussianBlur(clipped.astype(np.float32), (0, 0), 1.0)
        smooth = cv2.resize(even, size, interpolation=cv2.INTER_CUBIC)
        share = np.clip(255.0 / self.top_mm * smooth, 0.0, 255.0).astype(np.uint8)
        colours = cv2.LUT(cv2.merge([share] * 3), self._colours[None])
        slope_y, slope_x = np.gradient(np.asarray(even, np.float32), self.pixel_mm)
        light = (
            _PLAIN * np.clip(1.0 + 0.3 * (_LIGHT[0] * slope_x + _LIGHT[1] * slope_y), 0.6, 1.4)
        ).astype(np.uint8)
        light = cv2.resize(light, size, interpolation=cv2.INTER_LINEAR)
        colours = cv2.multiply(colours, cv2.merge([light] * 3), scale=1.0 / _PLAIN)
        outside = _part(self._outside, left, top, side) > 0.5
        # walls are dimmed; an animal that rears at a wall remains visible in front of it
        # higher pixels are not the animal
        dim = _enlarged(outside | (clipped > 1.6 * self.top_mm), size)
        colours[dim] = colours[dim] // 4
        # grey
        colours[_enlarged(~read, size)] = 34
        return np.asarray(colours, np.uint8)

    def scale(self, height: int) -> NDArray[np.uint8]:
        """The colours from 0 to `top_mm`, the highest on top: (height, 6, 3) uint8 RGB."""
        return np.repeat(
            self._colours[np.linspace(255.0, 0.0, height).astype(np.uint8)][:, None], 6, axis=1
        )


def scale_mm(sessions: Sequence[Session]) -> float:
    """The common height scale of some sessions, mm.

    A tenth more than the joints' heights, so that the surface above them has colours.
    """
    reached = []
    for session in sessions:
        index = session.table("frames", ["frame_index"])["frame_index"]
        # all frames of an hour, or every second one of two
        some = (
            index[:: -(-len(index) // _MOST_FRAMES)].tolist() if len(index) > _MOST_FRAMES else None
        )
        reached.append(1.1 * float(session.table("poses", ["z_mm"], some)["z_mm"].quantile(0.995)))
    known = [height for height in reached if np.isfinite(height)]
    return max(10.0 * float(np.ceil(max(known) / 10.0)), 20.0) if known else 80.0


def _part(
    heights: NDArray[np.float32], left: int, top: int, side: tuple[int, int]
) -> NDArray[np.float32]:
    """A part of a map, NaN outside the map."""
    out = np.full(side[::-1], np.nan, np.float32)
    paste(out, heights, -left, -top)
    return out


def _beyond_walls(session: Session, rays: Array) -> NDArray[np.float32]:
    """(H, W) 1 where a view ray (H, W, 3) meets the floor's plane outside the arena, else 0."""
    T = session.T_arena_camera
    turned = rays @ np.asarray(T.rotation, float).T
    place = np.asarray(T.translation, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        on_floor = place[:2] - turned[..., :2] / turned[..., 2:] * place[2]
    distance = session.arena.wall_distance_mm(on_floor)
    # 8 mm: the outline's uncertainty
    return np.asarray(distance < -8.0, np.float32)


def _enlarged(mask: NDArray[np.bool_], size: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask in another size, with smooth edges."""
    return np.asarray(
        cv2.resize(mask.astype(np.uint8) * 255, size, interpolation=cv2.INTER_LINEAR) > 127
    )


@lru_cache(maxsize=512)
def _stencil(text: str, size: int) -> NDArray[np.float32]:
    """The coverage of each pixel by a text, 0 to 1."""
    # the font of matplotlib, which is the same on every machine
    font = ImageFont.truetype(findfont("DejaVu Sans"), size)
    left, _, right, bottom = font.getbbox(text)
    image = Image.new("L", (max(int(right - min(left, 0)), 1), max(int(bottom), 1)))
    ImageDraw.Draw(image).text((-min(left, 0), 0), text, font=font, fill=255)
    return np.asarray(image, np.float32) / 255.0


def write(
    image: NDArray[np.uint8],
    text: str,
    x: int,
    y: int,
    size: int,
    colour: tuple[int, int, int] = (240, 240, 240),
    right: bool = False,
) -> int:
    """Write a text into an image, clipped to the image; returns its width, px.

    Args:
        image: (H, W, 3) uint8 RGB, changed in place.
        text: the text.
        x: its left end, px.
        y: its upper end, px.
        size: of its letters, px.
        colour: RGB.
        right: whether x is its right end.
    """
    whole = _stencil(text, size)
    x, y = max(x - whole.shape[1] if right else x, 0), max(y, 0)
    stencil = whole[: max(image.shape[0] - y, 0), : max(image.shape[1] - x, 0)]
    there = image[y : y + stencil.shape[0], x : x + stencil.shape[1]]
    share = stencil[..., None]
    there[:] = (there * (1.0 - share) + share * np.array(colour, np.float32)).astype(np.uint8)
    return int(whole.shape[1])


_LEAST_PX = 24  # half the side of the view around an animal


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


def smooth_path(joints: Array, camera: Camera) -> tuple[Array, int]:
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
        return np.tile([camera.width / 2, camera.height / 2], (len(middle), 1)), max(
            camera.height // 2, _LEAST_PX
        )
    whole = np.column_stack([np.interp(rows, rows[known], middle[known, axis]) for axis in (0, 1)])
    width = min(15, len(rows) | 1)
    padded = np.pad(whole, ((width // 2, width // 2), (0, 0)), mode="edge")
    kernel = np.ones(width) / width
    smooth = np.column_stack(
        [np.convolve(padded[:, axis], kernel, "valid")[: len(rows)] for axis in (0, 1)]
    )
    length = np.linalg.norm(np.diff(joints[known], axis=1), axis=-1).sum(axis=1)
    # the view has a side of 1.9 body lengths
    return smooth, max(int(1.9 * float(np.quantile(length, 0.95)) * 0.6), _LEAST_PX)


class Footage:
    """What the images of a session need: frame times, joints, following views, and depth.

    Args:
        session: the opened session.
        images: the depth images.
        top_mm: height of the lightest colour, mm; None takes the session's own scale.
        others: the sessions of other animals of its arena.
    """

    def __init__(
        self,
        session: Session,
        images: DepthImages,
        top_mm: float | None = None,
        others: Sequence[Session] = (),
    ) -> None:
        self.session = session
        self._of_each = [session_animals(one) for one in (session, *others)]
        self.animals = [animal for some in self._of_each for animal in some]
        self.bones = [(int(a), int(b)) for a, b in session.metadata["animal"]["bones"]]
        self._images = images
        self._top_mm = top_mm

    @cached_property
    def time_s(self) -> Array:
        """(n,) times of the frames, s."""
        return self.animals[0].frames["time_s"].to_numpy(float)

    @cached_property
    def uv(self) -> list[Array]:
        """The joints of each animal (n, J, 2), px; NaN without a pose."""
        return [uv for some in self._of_each for uv in joints_in_image(some, len(self.time_s))]

    @cached_property
    def paths(self) -> list[tuple[Array, int]]:
        """The view that follows each animal, see `smooth_path`."""
        return [smooth_path(joints, self.session.camera) for joints in self.uv]

    @cached_property
    def relief(self) -> Relief:
        """The colours of the depth images."""
        return Relief(self.session, self._top_mm or scale_mm([self.session]))

    def depth(self, row: int) -> NDArray[np.uint16]:
        """(H, W) uint16 mm, 0 where unread; all 0 if the session has no depth of this frame."""
        depth = self._images.depth(self.session, row)
        camera = self.session.camera
        return np.zeros((camera.height, camera.width), np.uint16) if depth is None else depth


class Film(Footage):
    """The images of a session; `close` closes its files.

    Args:
        session: the opened session.
        top_mm: height of the lightest colour, mm.
        others: the sessions of other animals of its arena.

    Raises:
        SessionError: the session has no depth.
    """

    def __init__(self, session: Session, top_mm: float, others: Sequence[Session] = ()) -> None:
        images = DepthImages()
        super().__init__(session, images, top_mm, others)
        self.close = images.close
        if not keeps_depth(session) or images.depth(session, 0) is None:
            self.close()
            raise SessionError(
                f"the session {session.path} keeps no depth images, and a video shows them; "
                "run `liex run` on its recording again, without --no-depth"
            )
        self._colours = action_colours(self.animals[0].words)
        self._own = individual_colours(individuals_of(session)) if others else {}
        self._last: tuple[int, NDArray[np.uint16]] | None = None

    @property
    def fps(self) -> float:
        """Median frames per second of this session."""
        return float(self.session.metadata["frames"]["fps_median"] or 30.0)

    def row_at(self, time_s: float) -> int:
        """The row of the frame displayed at a time, s."""
        return int(
            np.clip(np.searchsorted(self.time_s, time_s + 1e-6) - 1, 0, len(self.time_s) - 1)
        )

    def whole_view(self) -> View:
        """The arena and all positions of the animals; the whole image if the arena is unknown."""
        camera = self.session.camera
        outline = in_image(self.session, self.session.arena.outline_mm())
        known = np.concatenate([outline, *(joints.reshape(-1, 2) for joints in self.uv)])
        known = known[np.isfinite(known).all(axis=1)]
        if not len(outline):
            return View(0, 0, camera.width, camera.height)
        low, high = known.min(axis=0), known.max(axis=0)
        # a margin around the arena
        margin = 0.05 * float((high - low).max())
        x0, y0 = np.maximum(np.floor(low - margin), 0).astype(int).tolist()
        x1, y1 = (
            np.minimum(np.ceil(high + margin), [camera.width, camera.height]).astype(int).tolist()
        )
        return View(x0, y0, max(x1 - x0, 2), max(y1 - y0, 2))

    def near_view(self, row: int, animal: int = 0) -> View:
        """The square around an animal, which follows it smoothly.

        Args:
            row: the frame's row.
            animal: its number in the session.
        """
        centre, half = self.paths[animal]
        left, top = (round(float(at)) for at in centre[row] - half)
        return View(left, top, 2 * half, 2 * half)

    def words_at(self, time_s: float) -> list[str]:
        """The action of each animal at a time, s; "" if unlabelled."""
        words = []
        for actions, start, stop in self._bouts:
            at = int(np.searchsorted(start, time_s + 1e-6)) - 1
            words.append(str(actions[at]) if at >= 0 and stop[at] > time_s + 1e-6 else "")
        return words

    def interactions_at(self, time_s: float) -> list[tuple[str, str, str]]:
        """What the animals do to each other at a time, s: agent, target and word."""
        if not self._own:
            return []
        table = self._interactions
        now = table[(table["start_s"] <= time_s + 1e-6) & (table["stop_s"] > time_s + 1e-6)]
        return [*now[["agent", "target", "action"]].itertuples(index=False, name=None)]

    @cached_property
    def _interactions(self) -> pd.DataFrame:
        return self.session.interactions.query("target != ''")

    @cached_property
    def _bouts(self) -> list[list[Any]]:
        names = ("action", "start_s", "stop_s")
        return [[animal.bouts[name].to_numpy() for name in names] for animal in self.animals]

    def image(
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
            self._last = (row, self.depth(row))
        side = (view.width, view.height)
        shown = self.relief.image(self._last[1], view.left, view.top, side, size)
        scale = np.divide(size, side)
        words = self.words_at(time_s)
        placed = [(joints + 0.5 - [view.left, view.top]) * scale for joints in self.uv]
        for at, word, animal in zip(placed, words, self.animals, strict=True):
            colour = self._own.get(animal.individual) or self._colours.get(word, "#ffffff")
            self._draw_animal(shown, at, row, _rgb(colour))
        if self._own:
            self._write_names(shown, np.stack([at[row] for at in placed]))
        self._write(shown, time_s, row, words, title)
        self._write_length(shown, self.relief.pixel_mm * view.width / size[0])
        return shown

    def _draw_animal(
        self, image: NDArray[np.uint8], at: Array, row: int, colour: tuple[int, int, int]
    ) -> None:
        """Draw trail and skeleton; `at` (n, J, 2) are the joints in the image, px."""
        size = max(image.shape[1] / 320.0, 0.9)
        first = self.row_at(self.time_s[row] - 2.0)  # the trail of the last two seconds
        trail = at[first : row + 1].mean(axis=1)
        trail = trail[np.isfinite(trail).all(axis=1)]
        if len(trail) > 1:
            fixed = np.rint(16.0 * trail).astype(np.int32)
            shade = colour if self._own else (235, 235, 235)
            cv2.polylines(image, [fixed], False, shade, 1, cv2.LINE_AA, 4)
        joints = at[row]
        if not np.isfinite(joints).all():
            return
        fixed = np.rint(16.0 * joints).astype(int).tolist()
        thick = max(int(round(1.6 * size)), 2)
        for shade, width in (((0, 0, 0), thick + 2), (colour, thick)):
            for a, b in self.bones:
                cv2.line(image, fixed[a], fixed[b], shade, width, cv2.LINE_AA, 4)
        fill, front = (colour, _WHITE) if self._own else (_WHITE, (238, 102, 119))
        for at_px, shade in zip(fixed, [fill] * (len(fixed) - 1) + [front], strict=True):
            cv2.circle(image, at_px, int(16 * 2.0 * size), shade, -1, cv2.LINE_AA, 4)

    def _write_names(self, image: NDArray[np.uint8], joints: Array) -> None:
        """Write the name of each animal above or below its joints (A, J, 2) px, away from the
        others.
        """
        size = _size_of(image)
        posed = np.isfinite(joints).all(axis=(1, 2))
        middle = joints[posed, :, 1].mean() if posed.any() else 0.0
        for animal, own in zip(np.array(self.animals)[posed], joints[posed], strict=True):
            above = own[:, 1].mean() <= middle
            x, y = own[:, 0].min(), own[:, 1].min() - 2 * size if above else own[:, 1].max() + size
            colour = _rgb(self._own[animal.individual])
            write(image, animal.individual, int(x), int(y), size, colour)

    def _write(
        self, image: NDArray[np.uint8], time_s: float, row: int, words: list[str], title: str
    ) -> None:
        """Draw title, action, time, and the height scale."""
        height, width = image.shape[:2]
        size = _size_of(image)
        edge = size // 2
        write(image, title, edge, edge, size)
        write(image, f"{time_s:.2f} s", width - edge, height - 2 * size, size, right=True)
        self._write_words(image, time_s, row, words)
        if not self._own and not self._posed(row).any():
            write(image, "no pose", edge, height - 4 * size, size, (255, 190, 90))
        bar = self.relief.scale(min(6 * size, height // 3))
        right = width - edge - 6
        image[edge : edge + len(bar), right : right + 6] = bar
        for text, y in ((f"{self.relief.top_mm:.0f} mm", edge), ("0", edge + len(bar) - size)):
            write(image, text, right - 4, y, max(size - 2, 8), right=True)

    def _posed(self, row: int) -> NDArray[np.bool_]:
        """(A,) whether each animal has a pose in a frame."""
        return np.array([np.isfinite(joints[row]).all() for joints in self.uv])

    def _write_words(
        self, image: NDArray[np.uint8], time_s: float, row: int, words: list[str]
    ) -> None:
        """Draw the actions below, a line for each of several animals, and interactions above."""
        size = _size_of(image)
        edge = size // 2
        if not self._own:
            x, top = edge, image.shape[0] - 2 * size
            for word in dict.fromkeys(word for word in words if word):
                image[top + 2 : top + size, x : x + size - 2] = _rgb(self._colours[word])
                x += write(image, word.replace("_", " "), x + size + 2, top, size) + 2 * size
            return
        below = [
            (animal.individual, f"{animal.individual}: {word if posed else 'no pose'}")
            for animal, word, posed in zip(self.animals, words, self._posed(row), strict=True)
        ]
        above = [
            (a, f"{a} {'–' if INTERACTIONS[word].mutual else '→'} {b}: {word}")
            for a, b, word in self.interactions_at(time_s)
        ]
        for some, top in ((above, 2 * size), (below, image.shape[0] - (len(below) + 1) * size)):
            for k, (name, text) in enumerate(some):
                y = top + k * size
                image[y + 2 : y + size, edge : edge + size - 2] = _rgb(self._own[name])
                write(image, text.replace("_", " "), edge + size + 2, y, size)

    def _write_length(self, image: NDArray[np.uint8], pixel_mm: float) -> None:
        """Draw a scale bar of 1, 2 or 5 times a power of ten mm; `pixel_mm` is mm/px on the
        floor.
        """
        height, width = image.shape[:2]
        size = _size_of(image)
        longest_mm = pixel_mm * width / 5.0
        step_mm = 10.0 ** np.floor(np.log10(longest_mm))
        length_mm = max(step_mm * k for k in (1, 2, 5) if step_mm * k <= longest_mm)
        right = width - size // 2
        left = right - round(length_mm / pixel_mm)
        y = height - 5 * size // 2
        image[y - 2 : y, left:right] = 240
        write(image, f"{length_mm:g} mm", left - size // 2, y - size // 2, size, right=True)


def _rgb(colour: str) -> tuple[int, int, int]:
    """#rrggbb as numbers."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def _size_of(image: NDArray[np.uint8]) -> int:
    """The height of letters in an image, px."""
    return max(image.shape[0] // 26, 9)
