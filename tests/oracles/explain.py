"""How well a body of balls explains a height map, as one would write it down: ball by ball and
pixel by pixel.
"""

import numpy as np

from liex_lab.body.shape import Spheres

STRIDE = 6  # every so many crop pixels a reading is looked at


def placed(
    balls: Spheres, rotations: np.ndarray, positions: np.ndarray, scale: float
) -> np.ndarray:
    """Middles (B, 3) mm of the balls of one pose."""
    ends = [
        [positions[j] + scale * rotations[j] @ offset for j, offset in zip(pair, at, strict=True)]
        for pair, at in zip(balls.joints, balls.offsets, strict=True)
    ]
    return np.array([a + s * (b - a) for (a, b), s in zip(ends, balls.share, strict=True)])


def explained(
    heights: np.ndarray,
    look: np.ndarray,
    axis: float,
    balls: Spheres,
    rotations: np.ndarray,
    positions: np.ndarray,
    scale: float,
    size: float,
) -> np.ndarray:
    """The eight numbers of `_residual_kernels.explain_pose`."""
    middles, radii = placed(balls, rotations, positions, scale), balls.radius * scale
    own, per_mm = balls.n_own, 1.0 / (size * balls.unit_mm)
    R, distance = look[4:13].reshape(3, 3), look[13]
    beside, above = 0, []
    for ball, radius in zip(middles[:own], radii[:own], strict=True):
        x, y, z = R.T @ (ball - [0.0, 0.0, distance])
        uv = (look[:2] * [x / z, y / z] + look[2:4] - look[14:16]) / look[16]
        column, row = (min(max(int(value + 0.5), 0), 95) for value in uv)
        if heights[row, column] == 0:
            beside += 1
        else:
            above.append((heights[row, column] / 16.0 - ball[2] - radius) * per_mm)
    over = np.array(above)
    off, out = np.minimum(np.abs(over), 30.0), np.minimum(np.maximum(-over, 0.0), 30.0)
    gaps = []
    for r in range(STRIDE // 2, 96, STRIDE):
        for c in range(STRIDE // 2, 96, STRIDE):
            if heights[r, c] == 0:
                continue
            uv = look[14:16] + look[16] * np.array([c, r])
            ray = np.array([*((uv - look[2:4]) / look[:2]), 1.0])
            turned = R @ ray
            point = turned * (heights[r, c] / 16.0 - distance) / turned[2]
            point[2] = heights[r, c] / 16.0
            gap = np.linalg.norm(middles - point, axis=1) - radii
            if gap.argmin() < own:
                gaps.append(gap.min() * per_mm)
    gap = np.array(gaps)
    n, seen = max(len(gap), 1), max(len(over), 1)
    return np.array(
        [
            1000 * beside / own,
            50 * off.sum() / seen,
            50 * out.sum() / seen,
            1000 * (over > 12.0).sum() / own,
            50 * np.clip(gap, 0, 30).sum() / n,
            1000 * (gap > 8.0).sum() / n,
            50 * np.clip(-gap, 0, 30).sum() / n,
            1000 * (np.cos(axis) * rotations[0, 0, 0] + np.sin(axis) * rotations[0, 1, 0]),
        ]
    )
