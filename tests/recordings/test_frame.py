"""A depth image has readings if any pixel has one."""

import numpy as np

from liex_lab.recordings.frame import has_readings


def test_one_reading_anywhere_is_enough() -> None:
    depth = np.zeros((40, 50), np.float32)
    assert not has_readings(depth)
    depth[-1, -3] = 900.0
    assert has_readings(depth)
