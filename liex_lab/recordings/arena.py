"""The arena: the floor plane a camera looks at, and the frame that stands on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.camera import Camera
from liex_lab.errors import EstimationError
from liex_lab.geometry import SE3

Array = NDArray[np.float64]
Indices = NDArray[np.signedinteger]

_N_SAMPLES = 6000  # pixels that vote for the plane
_INLIER_MM = 8.0  # a floor is flat to about this much, depth noise included
_MIN_SHARE = 0.2  # of the readable pixels must lie on the floor
_MAX_TILT_DEG = 60.0


@dataclass(frozen=True)
class Floor:
    """The floor plane `normal . p = distance_mm` in the camera frame, its unit normal (3,) pointing away from the lens.

    In a pinhole picture 1 / z of a plane is linear in the pixel: `inverse_depth` (3,) gives 1 / z = a u + b v + c.
    """

    normal: Array
    distance_mm: float
    inverse_depth: Array

    @staticmethod
    def from_inverse_depth(coefficients: Array, camera: Camera) -> Floor:
        """The plane with 1 / z = a u + b v + c, per mm and pixel."""
        a, b, c = coefficients
        toward = np.array([a * camera.fx, b * camera.fy, c + a * camera.cx + b * camera.cy])
        length = float(np.linalg.norm(toward))
        return Floor(toward / length, 1.0 / length, np.asarray(coefficients, float))

    @staticmethod
    def from_plane(normal: Array, distance_mm: float, camera: Camera) -> Floor:
        """The plane normal . p = distance_mm in the camera frame."""
        n = np.asarray(normal, float) / np.linalg.norm(normal)
        a, b = n[0] / camera.fx / distance_mm, n[1] / camera.fy / distance_mm
        return Floor(n, float(distance_mm), np.array([a, b, n[2] / distance_mm - a * camera.cx - b * camera.cy]))

    @property
    def T_arena_camera(self) -> SE3:
        """Arena frame: z up from the floor, origin at the foot of the camera's perpendicular, x along the camera's."""
        up = -self.normal
        x = np.array([1.0, 0.0, 0.0]) - up[0] * up
        x = x / np.linalg.norm(x)
        return SE3(np.stack([x, np.cross(up, x), up]), np.array([0.0, 0.0, self.distance_mm]))

    def depth(self, width: int, height: int) -> NDArray[np.float32]:
        """Depth (H, W) mm of the bare floor under every pixel; 0 above the horizon."""
        a, b, c = self.inverse_depth
        inverse = a * np.arange(width)[None, :] + b * np.arange(height)[:, None] + c
        return np.where(inverse > 1e-6, 1.0 / np.maximum(inverse, 1e-6), 0.0).astype(np.float32)


def find_floor(background: NDArray[np.float32], camera: Camera, seed: int = 0) -> Floor:
    """The largest plane of an empty scene (H, W) mm, by RANSAC on inverse depth and least squares on its inliers.

    Raises EstimationError where less than a fifth of the readable pixels lie on one plane that faces the camera.
    """
    from sklearn.linear_model import LinearRegression, RANSACRegressor

    if camera.distortion is not None:
        raise EstimationError(
            "a floor is found in pictures of a straight lens, but this camera's distortion was not undone; pass the "
            "recording through liex_lab.recordings.rectify.rectified"
        )
    rows, columns = np.nonzero(background > 0)
    if len(rows) < 500:
        raise EstimationError(
            f"a floor needs at least 500 readable background pixels, got {len(rows)}; check the depth unit and range"
        )
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(rows), min(_N_SAMPLES, len(rows)), replace=False)
    uv = np.stack([columns[chosen], rows[chosen]], axis=1).astype(float)
    inverse = 1.0 / background[rows[chosen], columns[chosen]].astype(float)
    search = RANSACRegressor(
        LinearRegression(),
        min_samples=3,
        max_trials=300,
        loss=lambda true, found: np.abs(1.0 / true - 1.0 / np.maximum(found, 1e-6)),
        residual_threshold=_INLIER_MM,
        random_state=seed,
    )
    search.fit(uv, inverse)
    floor = Floor.from_inverse_depth(np.array([*search.estimator_.coef_, search.estimator_.intercept_]), camera)
    for _ in range(3):  # least squares on all pixels of the picture, not only on the voters
        floor, share = _refit(background, rows, columns, floor, camera)
    tilt = np.degrees(np.arccos(np.clip(floor.normal[2], -1, 1)))
    if share < _MIN_SHARE or tilt > _MAX_TILT_DEG:
        raise EstimationError(
            f"no floor was found: the largest plane holds {share:.0%} of the readable pixels and is tilted by "
            f"{tilt:.0f} degrees; the camera should look down on a floor"
        )
    return floor


def _refit(
    background: NDArray[np.float32], rows: Indices, columns: Indices, floor: Floor, camera: Camera
) -> tuple[Floor, float]:
    """The plane again from every pixel near it, and the share of pixels that are."""
    a, b, c = floor.inverse_depth
    depth = background[rows, columns].astype(float)
    near = np.abs(depth - 1.0 / np.maximum(a * columns + b * rows + c, 1e-6)) < _INLIER_MM
    if near.sum() < 3:
        return floor, 0.0
    design = np.stack([columns[near], rows[near], np.ones(near.sum())], axis=1)
    coefficients, *_ = np.linalg.lstsq(design, 1.0 / depth[near], rcond=None)
    return Floor.from_inverse_depth(coefficients, camera), float(near.mean())
