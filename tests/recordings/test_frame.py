"""Frames that share one array are stacked without a copy, and others with one."""

from __future__ import annotations

import numpy as np

from liex_lab.recordings.frame import DepthFrame, in_one_block, stacked

FRAMES = [DepthFrame(3 + k, 10 * k, np.full((4, 5), k, np.float32)) for k in range(6)]


def test_frames_in_one_block_are_the_same_frames() -> None:
    for one, other in zip(in_one_block(FRAMES), FRAMES, strict=True):
        assert (one.index, one.time_ns) == (other.index, other.time_ns)
        np.testing.assert_array_equal(one.depth, other.depth)


def test_only_frames_of_one_block_in_their_order_are_not_copied() -> None:
    together = in_one_block(FRAMES)
    assert stacked(together) is together[0].depth.base
    turned = together[::-1]
    for frames in (FRAMES, turned, together[:4], together[1:], FRAMES[:3] + together[3:]):
        block = stacked(frames)
        assert not any(np.shares_memory(block, frame.depth) for frame in frames)
        for frame, depth in zip(frames, block, strict=True):
            np.testing.assert_array_equal(depth, frame.depth)
