"""The depth camera: a pinhole that carries points to pixels and back, and says where its numbers come from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from liex_lab.errors import LiexError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Lens:
    """The intrinsics of a camera, stated without the size of its pictures; pixels, as in `Camera`."""

    fx: float
    fy: float
    cx: float
    cy: float

    def __post_init__(self) -> None:
        if not (self.fx > 0 and self.fy > 0 and np.isfinite([self.fx, self.fy, self.cx, self.cy]).all()):
            raise LiexError(
                f"focal lengths are positive pixels, got fx={self.fx}, fy={self.fy}, cx={self.cx}, cy={self.cy}; "
                "correct them in camera.toml or with --set camera.fx=... --set camera.fy=..."
            )


@dataclass(frozen=True)
class Camera(Lens):
    """A depth camera without lens distortion. Pixels; (0, 0) is the centre of the top-left pixel.

    Camera frame: x right, y down, z away from the lens, mm. `source` names where the intrinsics come from.
    """

    width: int
    height: int
    source: str = "stated"

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.width > 0 and self.height > 0):
            raise LiexError(
                f"a picture has at least one pixel, got {self.width} x {self.height}; correct width and height in "
                "camera.toml"
            )

    def project(self, p_camera: ArrayLike) -> Array:
        """Points (..., 3) mm in the camera frame -> (u, v) pixels (..., 2); NaN behind the lens."""
        x, y, z = np.moveaxis(np.asarray(p_camera, float), -1, 0)
        z = np.where(z > 0, z, np.nan)
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], axis=-1)

    def unproject(self, uv: ArrayLike, depth: ArrayLike) -> Array:
        """Pixels (..., 2) and their depth (...) mm -> points (..., 3) mm in the camera frame."""
        u, v = np.moveaxis(np.asarray(uv, float), -1, 0)
        z = np.asarray(depth, float)
        return np.stack([(u - self.cx) / self.fx * z, (v - self.cy) / self.fy * z, z * np.ones_like(u)], axis=-1)

    def every(self, stride: int) -> Camera:
        """The camera whose picture is every `stride`-th row and column of this one's."""
        if stride == 1:
            return self
        fx, fy, cx, cy = (value / stride for value in (self.fx, self.fy, self.cx, self.cy))
        return Camera(fx, fy, cx, cy, -(-self.width // stride), -(-self.height // stride), self.source)

    @property
    def matrix(self) -> Array:
        """The intrinsic matrix K (3, 3)."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers for session.json and camera.toml."""
        return {name: getattr(self, name) for name in ("fx", "fy", "cx", "cy", "width", "height", "source")}


KINECT_V2 = Camera(365.0, 365.0, 255.5, 211.5, 512, 424, source="typical Kinect v2")
PRIMESENSE = Camera(575.8, 575.8, 319.5, 239.5, 640, 480, source="typical PrimeSense")
RAYTRIX_R5 = Camera(2363.0, 2363.0, 511.5, 511.5, 1024, 1024, source="typical Raytrix R5")
PRIMESENSE_QVGA = Camera(287.9, 287.9, 159.5, 119.5, 320, 240, source="typical PrimeSense at 320 x 240")
