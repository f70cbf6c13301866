"""Which of the components of a picture is likest to the animal."""

from __future__ import annotations

import numpy as np

from liex_lab.scene._blob_kernels import MAX_BLOBS, N_BLOB, Blob
from liex_lab.scene._height_map_kernels import AREA_FACTOR, order_blobs


def test_components_come_in_the_order_of_their_areas_distance_and_equal_ones_in_their_own():
    rng = np.random.default_rng(8)
    for _ in range(50):
        n = int(rng.integers(1, MAX_BLOBS + 1))
        blobs = np.zeros((MAX_BLOBS, N_BLOB))
        n_px = rng.choice([40.0, 80.0, 120.0, 400.0, 3000.0], n)  # many are alike
        for slot in range(n):
            on_floor = n_px[slot] * rng.choice([0.0, 1.0])
            blobs[slot] = Blob(n_px[slot], 0, 1, 0, 1, n_px[slot] * 1000.0, on_floor)
        order, n_near = order_blobs(blobs, n, 100.0, 1e-6)
        stands = blobs[:n, Blob._fields.index("n_on_floor")] > 0
        off = np.abs(np.log(n_px / 100.0))
        near = stands & (off <= np.log(AREA_FACTOR))
        assert n_near == near.sum()
        expected = np.argsort(np.where(near, off, np.inf), kind="stable")
        np.testing.assert_array_equal(order, expected)
