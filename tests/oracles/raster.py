"""A slow twin of the renderer: for every pixel the ray through its centre, against every
triangle.
"""

import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera


def ray_cast_depth(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    camera: Camera,
    window: tuple[int, int, int, int],
) -> NDArray[np.float64]:
    """Depth (H, W) mm of a mesh in the camera frame by Moeller and Trumbore's test; 0 where no
    triangle is hit.
    """
    u0, v0, width, height = window
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    edge_b, edge_c = b - a, c - a
    depth = np.zeros((height, width))
    for row in range(height):
        for column in range(width):
            ray = camera.unproject([u0 + column, v0 + row], 1.0)
            across = np.cross(ray, edge_c)
            det = np.sum(edge_b * across, axis=1)
            with np.errstate(divide="ignore", invalid="ignore"):
                s = np.sum(-a * across, axis=1) / det
                other = np.cross(-a, edge_b)
                t = other @ ray / det
                z = np.sum(edge_c * other, axis=1) / det
            hit = (np.abs(det) > 1e-12) & (s >= 0) & (t >= 0) & (s + t <= 1) & (z > 0)
            if hit.any():
                depth[row, column] = z[hit].min()
    return depth
