"""Frames that lie side by side are stacked without a copy."""

import numpy as np

from liex_lab.recordings.frame import DepthFrame, side_by_side, stacked

FRAMES = [DepthFrame(3 + k, 10 * k, np.full((4, 5), k, np.float32)) for k in range(6)]


def test_so_many_frames_are_taken_unchanged_and_the_rest_waits() -> None:
    frames = iter(FRAMES)
    taken = [side_by_side(frames, 4) for _ in range(3)]
    assert [len(some) for some in taken] == [4, 2, 0]
    for one, other in zip(taken[0] + taken[1], FRAMES, strict=True):
        assert (one.index, one.time_ns) == (other.index, other.time_ns)
        np.testing.assert_array_equal(one.depth, other.depth)


def test_only_frames_side_by_side_in_their_order_are_not_copied() -> None:
    together = side_by_side(iter(FRAMES), 8)
    for few in (together, together[:4]):
        assert np.shares_memory(stacked(few), few[0].depth)
        np.testing.assert_array_equal(stacked(few), [frame.depth for frame in few])
    for frames in (FRAMES, together[::-1], together[1:], FRAMES[:3] + together[3:]):
        block = stacked(frames)
        assert not any(np.shares_memory(block, frame.depth) for frame in frames)
        np.testing.assert_array_equal(block, [frame.depth for frame in frames])
