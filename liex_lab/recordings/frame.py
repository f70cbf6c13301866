"""Depth frames, depth encodings of cameras and data sets, and millimetres as 16-bit steps.

    linear              d = unit_mm * stored
    tum                 5000 steps per metre (TUM RGB-D)
    sun                 mm, their 16 bits rotated left by 3 (SUN RGB-D)
    kinect1-disparity   d = 351.3 m / (1092.5 - disparity), 11 bits (NYU Depth v2)
    nyu-hand            d = 256 green + blue, mm, of an 8-bit colour image (NYU hand pose)

Depth is float32, measured along the optical axis (z of the camera frame, not range along the ray);
0 means no reading. On writing, steps are exact or nearest.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import PlanError

Depth = NDArray[np.float32]

_FEW = 16  # sample every 16th row and column
_ROWS = 64
_LEAST_REGION_PX = 64


@dataclass(frozen=True)
class DepthFrame:
    """One depth image with its row and its time.

    Attributes:
        index: its row in the recording.
        time_ns: its time on the recording's own clock, ns.
        depth: (H, W) float32 mm along the optical axis; 0 = unread; finite, never negative.
        repeats: whether its depth equals that of the previous frame, bit for bit, and has readings;
            set for frames that are read in order, see `marked`.
    """

    index: int
    time_ns: int
    depth: Depth
    repeats: bool = False


def marked(frames: Iterable[DepthFrame], before: Depth | None = None) -> Iterator[DepthFrame]:
    """Consecutive frames, each marked if it repeats the depth image of the previous frame.

    Args:
        frames: in order; the depth of the last one is kept until the next one arrives.
        before: depth (H, W) mm of the frame before the first; None if absent.
    """
    for frame in frames:
        # a few rows distinguish nearly all images
        repeats = (
            before is not None
            and np.array_equal(frame.depth[::_ROWS], before[::_ROWS])
            and np.array_equal(frame.depth, before)
            and has_readings(frame.depth)
        )
        before = frame.depth
        yield replace(frame, repeats=repeats)


def unread_where_damaged(
    read: Callable[[int], Depth | str],
    shape: tuple[int, int],
    problems: list[str],
    known: Iterable[int] = (),
) -> Callable[[int], Depth]:
    """The function that reads a stored frame, with damaged ones wholly unread.

    Args:
        read: depth (H, W) float32 mm of a frame by its number, or what is wrong with it, as in
            " (frame_2.png) is damaged".
        shape: rows and columns of the depth images.
        problems: the recording's sentences; each damaged frame is added once.
        known: numbers of damaged frames that were reported before.
    """
    reported = set(known)

    def read_depth(number: int) -> Depth:
        """Depth (H, W) float32 mm of a frame, 0 where unread."""
        found = read(number)
        if not isinstance(found, str):
            return found
        if number not in reported:
            reported.add(number)
            problems.append(f"frame {number}{found}, and was taken as wholly unread")
        return np.zeros(shape, np.float32)

    return read_depth


def side_by_side(frames: Iterable[DepthFrame], n_frames: int) -> list[DepthFrame]:
    """Up to n frames of one size, the depth of each copied into one array as it arrives.

    Args:
        frames: their source, of which these are taken.
        n_frames: maximum number of frames.
    """
    taken: list[DepthFrame] = []
    block: Depth = np.empty(0, np.float32)
    for frame in islice(frames, n_frames):
        if not taken:
            block = np.empty((n_frames, *frame.depth.shape), np.float32)
        block[len(taken)] = frame.depth
        taken.append(replace(frame, depth=block[len(taken)]))
    return taken


def stacked(frames: Sequence[DepthFrame]) -> Depth:
    """Depth (n, H, W) of frames of one size, mm; without a copy if they lie `side_by_side`.

    Args:
        frames: at least one. The result may share their memory; do not write to it.
    """
    block, depth = frames[0].depth.base, frames[0].depth
    if isinstance(block, np.ndarray) and (block.shape[1:], block.dtype) == (
        depth.shape,
        depth.dtype,
    ):
        rows = block[: len(frames)]
        if len(rows) == len(frames) and all(
            frame.depth.base is block and frame.depth.ctypes.data == row.ctypes.data
            for frame, row in zip(frames, rows, strict=True)
        ):
            return rows
    return np.stack([frame.depth for frame in frames])


def has_readings(depth: Depth) -> bool:
    """Whether a depth image (H, W) has any reading; usually a sparse sample of pixels decides."""
    return bool(depth[::_FEW, ::_FEW].any() or depth.any())


def depth_mm(stored: NDArray[Any], unit_mm: float = 1.0, unread: Sequence[float] = (0.0,)) -> Depth:
    """Convert stored values to depth in millimetres by a linear law.

    Values that mean "no reading" are marked before scaling, while they can still be compared
    exactly. 0, NaN, infinite values and depths behind the lens are always unread.

    Args:
        stored: (H, W) or any other shape, integers or floats as in the file.
        unit_mm: mm per stored step, negative if the file's depth axis points towards the camera.
        unread: stored values that mean "no reading".

    Returns:
        float32 mm of the same shape, a new array; 0 = unread.
    """
    depth = stored.astype(np.float32)
    for value in unread:
        if value != 0.0:
            depth[stored == value] = 0.0
    if unit_mm != 1.0:
        with np.errstate(over="ignore"):  # overflow is not finite and so becomes unread below
            depth *= np.float32(unit_mm)
    if stored.dtype.kind != "u" or unit_mm < 0:
        depth[~(np.isfinite(depth) & (depth > 0))] = 0.0
    return depth


# Depth encodings of cameras and data sets, and millimetres as the steps of 16-bit images.


Stored = NDArray[Any]

# median depth: limits beyond any camera's range and any animal recording
PLAUSIBLE_MM = (100.0, 10_000.0)
COLOUR = "nyu-hand"  # the one encoding of 8-bit colour images
LARGEST_STEP = 0xFFFF


def _disparity(stored: Stored) -> Stored:
    """Kinect v1 disparity of 11 bits, as in NYU Depth v2: z = 351.3 / (1092.5 - value) m."""
    ahead = 1092.5 - stored.astype(np.float32)
    # 2047 of 11 bits is no reading
    read = (ahead > 0) & (stored != 2047)
    return np.where(read, 351_300.0 / np.where(read, ahead, 1.0), 0.0).astype(np.float32)


_MILLIMETRES: dict[
    str, tuple[float, Callable[[Stored], Stored]]
] = {  # name: mm per step of the function's result, function
    "linear": (1.0, lambda stored: stored),
    "tum": (0.2, lambda stored: stored),  # 5000 steps per metre
    "sun": (1.0, lambda stored: (stored >> 3) | (stored << 13)),  # 16 bits, rotated left by 3
    "kinect1-disparity": (1.0, _disparity),
    # (H, W, 3) 8 bits in the order blue, green, red
    COLOUR: (1.0, lambda stored: stored[..., 1].astype(np.uint16) << 8 | stored[..., 0]),
}
# mm per step of an encoding's values
ENCODINGS = {name: unit_mm for name, (unit_mm, _) in _MILLIMETRES.items()}


def decode(
    stored: Stored, encoding: str, unit_mm: float, unread: Sequence[float] = (0.0,)
) -> Depth:
    """Convert stored values in a named encoding to depth in millimetres.

    For integers, the largest value of the type is also unread if it would be farther than 10 m, as
    cameras and programs write it.

    Args:
        stored: (H, W), or (H, W, 3) uint8 (blue, green, red) for colour images.
        encoding: one of `ENCODINGS`.
        unit_mm: mm per step of the encoding's values.
        unread: stored values that mean "no reading" (for colour images, values after decoding).

    Returns:
        (H, W) float32 mm, 0 = unread.
    """
    values = _MILLIMETRES[encoding][1](stored)
    if values is stored and stored.dtype.kind in "iu":
        largest = float(np.iinfo(stored.dtype).max)
        if largest * abs(unit_mm) > 10_000.0:
            unread = (*unread, largest)
    if values is stored or stored.ndim == 3:
        return depth_mm(values, unit_mm, unread)
    depth = depth_mm(values, unit_mm)
    for value in unread:
        depth[stored == value] = 0.0
    return depth


def whole_steps(depth: Depth, step_mm: float) -> NDArray[np.uint16] | None:
    """Depth as 16-bit steps, if they decode to exactly the same depth.

    Args:
        depth: (H, W) float32 mm.
        step_mm: mm of a step.

    Returns:
        (H, W) uint16; None if depths lie between steps or need more than 16 bits.
    """
    if depth.size and float(depth.max()) > LARGEST_STEP * step_mm:
        return None
    steps = (depth if step_mm == 1.0 else np.rint(depth / np.float32(step_mm))).astype(np.uint16)
    # compared as `depth_mm` computes it: 0.1 is not exact in float32
    read = steps.astype(np.float32)
    return (
        steps
        if np.array_equal(read if step_mm == 1.0 else read * np.float32(step_mm), depth)
        else None
    )


def nearest_steps(depth: Depth, step_mm: float) -> NDArray[np.uint16] | None:
    """The nearest 16-bit steps to a depth.

    Args:
        depth: (H, W) float32 mm.
        step_mm: mm of a step.

    Returns:
        (H, W) uint16; None if they do not fit into 16 bits.
    """
    steps = np.rint(depth / np.float32(step_mm))
    return steps.astype(np.uint16) if not depth.size or float(steps.max()) <= LARGEST_STEP else None


def metres(depth: Depth) -> tuple[NDArray[np.float32], int]:
    """Depth in metres, chosen so that times 1000 in float32 gives the same millimetres.

    Between 1000 and 1024 mm, and at their halves and doubles, neighbouring float32 values of metres
    are farther apart than those of millimetres. There the nearest value is used, with an error of
    half a millionth of a millimetre per metre.

    Args:
        depth: (H, W) float32 mm.

    Returns:
        (H, W) float32 m, and the number of pixels without an exact value.
    """
    scaled = depth / np.float32(1000.0)
    inexact = scaled * np.float32(1000.0) != depth
    for direction in (np.float32(np.inf), np.float32(0.0)):
        other = np.nextafter(scaled[inexact], direction)
        fits = other * np.float32(1000.0) == depth[inexact]
        scaled[inexact] = np.where(fits, other, scaled[inexact])
        inexact[inexact] = ~fits
    return scaled, int(inexact.sum())


def region_mask(corners: Sequence[Sequence[float]], width: int, height: int) -> NDArray[np.bool_]:
    """The pixels inside a polygon.

    Args:
        corners: (u, v) pixels, at least three.
        width: of the image, px.
        height: of the image, px.

    Returns:
        (height, width) bool.

    Raises:
        PlanError: the corners are not a polygon, or it covers too little of the image.
    """
    import cv2

    points = np.asarray([list(corner)[:2] for corner in corners], float)
    if len(points) < 3 or points.shape[1:] != (2,) or not np.isfinite(points).all():
        raise PlanError(
            f"arena.region takes three or more corners x,y in pixels, got {len(points)}; name the "
            "corners of a polygon around the arena"
        )
    x, y = points.T
    area = 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))
    if area < _LEAST_REGION_PX:
        raise PlanError(
            f"arena.region encloses {area:.0f} pixels, too few to hold an arena; its corners "
            "should go round it in order"
        )
    mask = np.zeros((height, width), np.uint8)
    cv2.fillPoly(mask, [np.rint(np.clip(points, -30_000, 30_000)).astype(np.int32)], 1)
    if int(mask.sum()) < _LEAST_REGION_PX:
        raise PlanError(
            f"arena.region lies outside the image, whose columns are 0 to {width - 1} and rows "
            f"0 to {height - 1}; its corners are x,y in pixels"
        )
    return mask.astype(bool)
