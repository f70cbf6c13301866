"""The fast RVL encoder against the slow decoder."""

import struct

import numpy as np
import pytest

from liex_lab.recordings.depth_kernels import pack_rvl, rvl_message, to_millimetres
from liex_lab.recordings.depth_kernels import unpack_rvl as unpack
from tests.oracles.rvl import unpack_rvl


@pytest.mark.parametrize("share_unread", [0.0, 0.05, 0.5, 1.0])
@pytest.mark.parametrize("spread", [2, 60000])
def test_packed_depth_is_what_a_slow_decoder_reads(share_unread, spread):
    rng = np.random.default_rng(int(100 * share_unread) + spread)
    depth = (1 + rng.integers(0, spread, (23, 31))).astype(np.uint16)
    depth[rng.random(depth.shape) < share_unread] = 0
    np.testing.assert_array_equal(unpack_rvl(pack_rvl(depth), depth.size), depth.ravel())
    np.testing.assert_array_equal(unpack(pack_rvl(depth).tobytes(), 31, 23), depth)


def test_words_that_end_too_early_or_hold_too_much_are_no_picture():
    words = pack_rvl(
        np.random.default_rng(3).integers(0, 900, (23, 31)).astype(np.uint16)
    ).tobytes()
    assert unpack(words, 31, 23) is not None
    assert all(unpack(words[:n], 31, 23) is None for n in range(0, len(words) - 4, 4))
    assert unpack(words, 31, 20) is None
    assert unpack(b"\xff" * 400, 31, 23) is None


def test_the_largest_steps_fit_into_the_space_that_is_set_aside():
    depth = np.tile(np.array([1, 65535, 0, 65535], np.uint16), 64).reshape(8, 32)
    np.testing.assert_array_equal(unpack_rvl(pack_rvl(depth), depth.size), depth.ravel())


def test_a_message_states_the_picture_s_size_before_its_words():
    depth = np.arange(12, dtype=np.uint16).reshape(3, 4)
    message = rvl_message(depth).tobytes()
    assert struct.unpack("<iffII", message[:20]) == (0, 0.0, 0.0, 4, 3)
    np.testing.assert_array_equal(unpack_rvl(np.frombuffer(message[20:], "<u4"), 12), depth.ravel())


def test_depth_is_rounded_to_whole_millimetres_and_what_does_not_fit_is_unread():
    depth = np.array([[0.0, 0.4, 0.6, 699.5], [65534.9, 65536.0, 1e9, 12.49]], np.float32)
    np.testing.assert_array_equal(to_millimetres(depth), [[0, 0, 1, 700], [65535, 0, 0, 12]])
