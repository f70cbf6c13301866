"""Frames that lie side by side are stacked without a copy, and their room is used again."""

import numpy as np

from liex_lab.recordings.frame import DepthFrame, FrameRooms, has_readings, stacked

FRAMES = [DepthFrame(3 + k, 10 * k, np.full((4, 5), k, np.float32)) for k in range(6)]


def test_frames_side_by_side_are_the_same_frames() -> None:
    for one, other in zip(FrameRooms().filled(FRAMES, 6), FRAMES, strict=True):
        assert (one.index, one.time_ns) == (other.index, other.time_ns)
        np.testing.assert_array_equal(one.depth, other.depth)


def test_so_many_are_taken_and_the_rest_waits() -> None:
    rooms, frames = FrameRooms(), iter(FRAMES)
    taken = [[frame.index for frame in rooms.filled(frames, 4)] for _ in range(3)]
    assert taken == [[3, 4, 5, 6], [7, 8], []]


def test_only_frames_side_by_side_in_their_order_are_not_copied() -> None:
    together = FrameRooms().filled(FRAMES, 8)
    for few in (together, together[:4]):
        assert np.shares_memory(stacked(few), few[0].depth)
        np.testing.assert_array_equal(stacked(few), [frame.depth for frame in few])
    turned = together[::-1]
    for frames in (FRAMES, turned, together[1:], FRAMES[:3] + together[3:]):
        block = stacked(frames)
        assert not any(np.shares_memory(block, frame.depth) for frame in frames)
        for frame, depth in zip(frames, block, strict=True):
            np.testing.assert_array_equal(depth, frame.depth)


def test_room_is_used_again_only_when_nobody_holds_a_frame_in_it() -> None:
    rooms = FrameRooms()
    first = rooms.filled(FRAMES, 6)
    held = first[2].depth[1:]  # a part of one frame
    at = first[0].depth.ctypes.data
    del first
    second = rooms.filled(FRAMES[::-1], 6)
    assert second[0].depth.ctypes.data != at
    np.testing.assert_array_equal(held, FRAMES[2].depth[1:])
    del held
    third = rooms.filled(FRAMES, 6)
    assert third[0].depth.ctypes.data == at


def test_one_reading_anywhere_is_enough() -> None:
    depth = np.zeros((40, 50), np.float32)
    assert not has_readings(depth)
    depth[-1, -3] = 900.0
    assert has_readings(depth)
