"""Per-pixel background model of a depth recording: the farthest mode of its readings over time.

An animal is always nearer than what it covers, so the background of a pixel is the farthest depth
that keeps coming back, neither its median nor its most frequent depth: a pixel that is covered nine
tenths of the time still shows its background. A mode is a cluster of at least a twentieth of the
pixel's readings (and at least 3) within 6 mm or 1.2 % of the depth; its median is the background,
half of its 16 to 84 % range the standard deviation. The kernel is `far_modes`.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from liex_lab.foreground import _background_kernels as kernels
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.shapes import check_shapes

# readings this near to one another, of the depth or in mm, are one surface
_MODE_SHARE = 0.012
_MODE_MM = 6.0
_NEAR_SHARE = 0.05  # of a pixel's readings may be nearer than its nearest usual depth
# an animal of this many pixels is looked at finely enough
_LENGTH_PX = 64.0
_MAX_STRIDE = 4
_ROWS = 32  # of pixels whose readings are sorted at once
# noise changes something in this share of an image's cells, so many to a row and to a column, in
# the median of so many pairs; a moving animal changes the few cells in which it is
_EVERYWHERE = 0.8
_CELLS = 8
_PAIRS = 32


def sampled(n: int, most: int) -> NDArray[np.int64]:
    """Indices of frames spread evenly over a recording.

    Args:
        n: frames of the recording.
        most: frames at most; all where the recording has fewer.
    """
    return np.unique(np.linspace(0, n - 1, min(most, n)).astype(np.int64))


def sample_frames(recording: Recording, n_frames: int, stride: int = 1) -> NDArray[np.float32]:
    """Frames spread evenly over a recording, thinned to every `stride`-th pixel.

    Args:
        recording: where they are read from.
        n_frames: frames at most; all where the recording has fewer.
        stride: pixels from one to the next along rows and columns.

    Returns:
        (n, ceil(H / stride), ceil(W / stride)) float32 mm, 0 where unread.
    """
    chosen = sampled(len(recording), n_frames)
    sample = np.empty(
        (len(chosen), -(-recording.height // stride), -(-recording.width // stride)), np.float32
    )
    if len(chosen) == len(recording):  # in order, which every format reads fastest
        for frames in recording.chunks(32):
            for frame in frames:
                sample[frame.index] = frame.depth[::stride, ::stride]
        return sample
    for k, index in enumerate(chosen):
        sample[k] = recording.frame(int(index)).depth[::stride, ::stride]
    return sample


def has_noise(sample: NDArray[np.float32]) -> bool:
    """Whether the sensor has noise: two depth images differ nearly everywhere, not at the animal.

    Where it has none, as in a rendered recording, an image of a still scene may repeat bit for bit.

    Args:
        sample: (n, H, W) float32 mm, 0 where unread, frames spread over the recording.
    """
    shares = []
    cells = [np.unique(np.arange(_CELLS) * n // _CELLS) for n in sample.shape[1:]]
    for before, after in pairwise(sample[:: max(1, len(sample) // _PAIRS)]):
        changed, read = (
            np.maximum.reduceat(np.maximum.reduceat(where, cells[0]), cells[1], axis=1)
            for where in (before != after, (before > 0) | (after > 0))
        )
        if changed.any():
            shares.append(float(changed.sum() / read.sum()))
    return len(shares) > 0 and float(np.median(shares)) > _EVERYWHERE


def usual_depth(pictures: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Each pixel's median over some pictures, of those in which it was read.

    Args:
        pictures: (n, H, W) uint16 mm, 0 where unread.

    Returns:
        (H, W) uint16 mm, 0 where it was read in none.
    """
    ordered = np.sort(pictures, axis=0)
    unread = (ordered == 0).sum(axis=0)
    middle = np.minimum(unread + (len(ordered) - unread) // 2, len(ordered) - 1)
    return np.asarray(np.take_along_axis(ordered, middle[None], axis=0)[0])


def stride_for(recording: Recording, length_mm: float) -> int:
    """The stride at which an animal is still some pixels long: 64 or more where it is above 1.

    Args:
        recording: its first and middle frame tell the usual depth; 1 where both are unread.
        length_mm: of the smallest animal.

    Returns:
        Pixels from one to the next, 1 to 4.
    """
    for index in {0, len(recording) // 2}:
        depth = recording.frame(index).depth
        if (depth > 0).any():
            px = length_mm * recording.camera.fx / float(np.median(depth[depth > 0]))
            return min(_MAX_STRIDE, max(1, int(px / _LENGTH_PX)))
    return 1


def learn_background(
    sample: NDArray[np.float32] | Recording,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Background depth, its spread, and the nearest usual depth of every pixel.

    Args:
        sample: (n, H, W) float32 mm, 0 where unread, or a recording, of which 96 frames are
            sampled.

    Returns:
        Three arrays (H, W) float32 mm, 0 where never read: depth of the farthest mode, its standard
        deviation, and the depth that a twentieth of the readings are nearer than.
    """
    stack = sample if isinstance(sample, np.ndarray) else sample_frames(sample, 96)
    check_shapes("a sample", ("frames", stack, ("n", "H", "W")))
    found = np.zeros((3, *stack.shape[1:]), np.float32)
    numbers = [np.float32(value) for value in (_MODE_SHARE, _MODE_MM, _NEAR_SHARE)]
    for start in range(0, stack.shape[1], _ROWS):
        rows = slice(start, start + _ROWS)
        # numpy sorts many short rows five times as fast as a compiled loop does
        ordered = np.ascontiguousarray(stack[:, rows].reshape(len(stack), -1).T)
        ordered.sort(axis=1)
        depth, spread, near = (np.ravel(one[rows]) for one in found)
        kernels.far_modes(ordered, *numbers, depth, spread, near)
    return found[0], found[1], found[2]
