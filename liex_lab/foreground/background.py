"""What a camera sees without the animal: the depth behind it at every pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from liex_lab.foreground import _background_kernels as kernels
from liex_lab.recordings.recording import Recording

# readings this near to one another, of the depth or in mm, are one surface
_MODE_SHARE = 0.012
_MODE_MM = 6.0
_NEAR_SHARE = 0.05  # of a pixel's readings may be nearer than its nearest usual depth
# an animal of this many pixels is looked at finely enough
_LENGTH_PX = 64.0
_MAX_STRIDE = 4


def sample_frames(recording: Recording, n_frames: int, stride: int = 1) -> NDArray[np.float32]:
    """Every `stride`-th pixel of up to `n_frames` frames (n, H, W) mm spread evenly over the
    recording.
    """
    chosen = np.unique(
        np.linspace(0, len(recording) - 1, min(n_frames, len(recording))).astype(int)
    )
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


def stride_for(recording: Recording, length_mm: float) -> int:
    """How many pixels apart the picture may be looked at so that an animal of length_mm is still
    some pixels long.
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
    """Background depth, its spread, and the nearest usual depth (H, W) mm of a sample (n, H, W) mm
    or of a recording; 0 = never read.
    """
    stack = sample if isinstance(sample, np.ndarray) else sample_frames(sample, 96)
    depth, spread, near = np.zeros((3, *stack.shape[1:]), np.float32)
    numbers = [np.float32(value) for value in (_MODE_SHARE, _MODE_MM, _NEAR_SHARE)]
    kernels.far_modes(stack, *numbers, depth, spread, near)
    return depth, spread, near
