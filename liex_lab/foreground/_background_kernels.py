"""Kernels of the per-pixel background model: the farthest mode of a pixel's sorted readings."""

from __future__ import annotations

from numba import njit, prange


@njit(cache=True)
def far_mode(values, window):
    """Depth and spread of the farthest cluster in sorted readings; (0, 0) without one.

    An animal is always nearer than what it covers, so the background is the farthest depth that
    comes back, not the most frequent: a pixel covered nine tenths of the time still shows it. A
    cluster needs a twentieth of the readings (at least 3) within `window` mm, which lone outliers
    beyond the floor do not reach.

    Args:
        values: (n,) readings of one pixel, mm, ascending.
        window: how far apart the readings of one surface lie, mm.

    Returns:
        The cluster's median, mm, and half of its range from 16 to 84 %, mm.
    """
    n = values.size
    need = max(3, (n + 19) // 20)
    if n < need:
        return 0.0, 0.0
    top = n - 1
    while top - need + 1 >= 0:
        if values[top] - values[top - need + 1] <= window:
            low = top
            while low > 0 and values[top] - values[low - 1] <= window:
                low -= 1
            middle = values[(low + top) // 2]
            # re-centre on the cluster's own middle, so that a few far readings do not cut its near
            # half off
            low = top
            while low > 0 and middle - values[low - 1] <= window:
                low -= 1
            count = top - low + 1
            middle = values[low + count // 2]
            spread = 0.5 * (
                values[low + int(0.84 * (count - 1))] - values[low + int(0.16 * (count - 1))]
            )
            return middle, spread
        top -= 1
    return 0.0, 0.0


@njit(cache=True, parallel=True, nogil=True)
def far_modes(ordered, window_share, window_mm, near_share, depth, spread, near):
    """Background depth, its spread and the nearest usual depth of every pixel.

    Runs `far_mode` in every pixel, pixels in parallel.

    Args:
        ordered: (n_pixels, n) float32 mm, each pixel's readings, ascending; 0 where unread.
        window_share: width of a cluster, of the pixel's farthest reading.
        window_mm: width of a cluster at least, mm.
        near_share: share of a pixel's readings that are nearer than `near`.
        depth: (n_pixels,) float32 mm, out: the farthest mode, 0 without one.
        spread: (n_pixels,) float32 mm, out: its standard deviation.
        near: (n_pixels,) float32 mm, out: the depth that only `near_share` of the readings are
            nearer than, 0 where never read.
    """
    for pixel in prange(ordered.shape[0]):
        first = 0
        while first < ordered.shape[1] and not ordered[pixel, first] > 0:
            first += 1
        values = ordered[pixel, first:]
        n = values.size
        window = window_mm if n == 0 else max(window_mm, window_share * values[-1])
        depth[pixel], spread[pixel] = far_mode(values, window)
        near[pixel] = values[int(near_share * n)] if n > 0 else 0.0
