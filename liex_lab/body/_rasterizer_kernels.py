"""Z-buffer rasteriser of triangle meshes: depth images, one or a batch.

Pinhole projection u = fx x / z + cx, v = fy y / z + cy; inside a triangle, the inverse depth 1 / z
is interpolated in barycentric coordinates, which is linear in the pixel for a plane and therefore
free of perspective error; the buffer keeps the largest 1 / z (Catmull 1974). Both sides of a
triangle are drawn: in a closed surface the nearer side hides the other anyway, and where a bent
body folds into itself the back of a triangle can be the visible side.
"""

import math

import numpy as np

from liex_lab.runtime.kernels import kernel

NEAR_MM = 1.0


@kernel()
def project(vertices, rotation, translation, intrinsics, projected):
    """Project the vertices of a mesh.

    Args:
        vertices: (V, 3) mm in a frame that (rotation, translation) transforms to the camera's.
        rotation: (3, 3).
        translation: (3,) mm.
        intrinsics: (4,) fx, fy, cx, cy, px.
        projected: (V, 3) u and v px and 1 / z, out; 1 / z is 0 up to NEAR_MM before the camera.
    """
    for i in range(vertices.shape[0]):
        x = vertices[i, 0]
        y = vertices[i, 1]
        z = vertices[i, 2]
        xc = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
        yc = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
        zc = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
        if zc > NEAR_MM:
            projected[i, 0] = intrinsics[0] * xc / zc + intrinsics[2]
            projected[i, 1] = intrinsics[1] * yc / zc + intrinsics[3]
            projected[i, 2] = 1.0 / zc
        else:
            projected[i, 2] = 0.0


@kernel()
def draw_projected(projected, faces, u0, v0, inverse):
    """Draw triangles into an image of inverse depth.

    Keeps the largest 1 / z under each pixel's centre. Triangles that reach behind NEAR_MM are
    omitted.

    Args:
        projected: (V, 3) as in `project`; shifted in place.
        faces: (F, 3) int32.
        u0: image column of `inverse[0, 0]`.
        v0: image row of `inverse[0, 0]`.
        inverse: (H, W) 1/mm, changed in place; 0 for empty pixels.
    """
    for i in range(projected.shape[0]):
        projected[i, 0] -= u0
        projected[i, 1] -= v0
    for f in range(faces.shape[0]):
        _draw_triangle(projected, faces[f, 0], faces[f, 1], faces[f, 2], inverse)


@kernel()
def _draw_triangle(p, a, b, c, inverse):
    """Draw the triangle of rows a, b, c of `p` (V, 3): pixel column, pixel row, 1 / z."""
    if p[a, 2] <= 0.0 or p[b, 2] <= 0.0 or p[c, 2] <= 0.0:
        return
    height, width = inverse.shape
    ax = p[a, 0]
    ay = p[a, 1]
    bx = p[b, 0]
    by = p[b, 1]
    kx = p[c, 0]
    ky = p[c, 1]
    left = max(0, int(math.ceil(min(ax, bx, kx))))
    right = min(width - 1, int(math.floor(max(ax, bx, kx))))
    top = max(0, int(math.ceil(min(ay, by, ky))))
    bottom = min(height - 1, int(math.floor(max(ay, by, ky))))
    if left > right or top > bottom:
        return
    area = (bx - ax) * (ky - ay) - (by - ay) * (kx - ax)
    if abs(area) < 1e-12:
        return
    # barycentric weights of b and c, and from them 1 / z, are linear in the pixel
    wb_u = (ky - ay) / area
    wb_v = -(kx - ax) / area
    wc_u = -(by - ay) / area
    wc_v = (bx - ax) / area
    db = p[b, 2] - p[a, 2]
    dc = p[c, 2] - p[a, 2]
    slack = 1e-9  # a pixel centre on a shared edge belongs to both triangles: no gaps
    for row in range(top, bottom + 1):
        wb = wb_u * (left - ax) + wb_v * (row - ay)
        wc = wc_u * (left - ax) + wc_v * (row - ay)
        for column in range(left, right + 1):
            if wb >= -slack and wc >= -slack and wb + wc <= 1.0 + slack:
                value = p[a, 2] + wb * db + wc * dc
                if value > inverse[row, column]:
                    inverse[row, column] = value
            wb += wb_u
            wc += wc_u


@kernel(nogil=True)
def draw_batch(vertices, faces, rotation, translation, intrinsics, origin, depth, start, stop):
    """Depth images of n meshes; see `draw_projected`.

    Args:
        vertices: (n, V, 3) mm.
        faces: (F, 3) int32, shared.
        rotation: (n, 3, 3).
        translation: (n, 3) mm.
        intrinsics: (n, 4) fx, fy, cx, cy px.
        origin: (n, 2) image pixel (u, v) at the window's top left.
        depth: (n, H, W) mm, out; 0 for empty pixels.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    inverse = np.empty(depth.shape[1:])
    projected = np.empty((vertices.shape[1], 3))
    for i in range(start, stop):
        inverse[:] = 0.0
        project(vertices[i], rotation[i], translation[i], intrinsics[i], projected)
        draw_projected(projected, faces, origin[i, 0], origin[i, 1], inverse)
        for row in range(inverse.shape[0]):
            for column in range(inverse.shape[1]):
                value = inverse[row, column]
                depth[i, row, column] = 1.0 / value if value > 0.0 else 0.0
