"""Pinhole projection of a crop: points of its view frame to its pixels, and pixels back to points.

A height map is a picture of its own, cut out of a camera's picture in steps of some pixels and
measured above a plane. With the pinhole model a point p of the view frame lies at

    (x, y, z) = R^T (p - (0, 0, distance)),   u = fx x / z + cx,   column = (u - u0) / step

where R is the rotation of T_view_camera (row by row r00 ... r22); rows go alike with v, fy, cy, v0.
All kernels that hold a pose against a height map project with the functions of this module.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numba import njit

N_CROP_CAMERA = 17  # numbers of a packed crop camera


class CropCamera(NamedTuple):
    """The camera of one crop, or columns (n,) of many, in the order in which they are packed.

    Attributes:
        fx: focal length along the picture's rows, px of the whole picture.
        fy: focal length along its columns, px.
        cx: principal point, px of the whole picture.
        cy: principal point, px of the whole picture.
        r00: rotation of T_view_camera, first row; r00 to r22 row by row.
        r01: see r00.
        r02: see r00.
        r10: see r00.
        r11: see r00.
        r12: see r00.
        r20: see r00.
        r21: see r00.
        r22: see r00.
        distance: z of the camera's centre in the view frame, mm.
        u0: column of the whole picture that is the crop's first.
        v0: row of the whole picture that is the crop's first.
        step: pixels of the whole picture from one crop pixel to the next.
    """

    fx: Any
    fy: Any
    cx: Any
    cy: Any
    r00: Any
    r01: Any
    r02: Any
    r10: Any
    r11: Any
    r12: Any
    r20: Any
    r21: Any
    r22: Any
    distance: Any
    u0: Any
    v0: Any
    step: Any


class CropRows(NamedTuple):
    """The rows of a batch of height maps, as a segmenter's kernels fill them.

    Attributes:
        heights: (N, S, S) int16, 1/16 mm.
        origin: (N, 2) int32, picture pixel (u, v) of crop pixel (0, 0).
        step: (N,) int32, picture pixels a crop pixel.
        n_px: (N,) int64, readings on the animal, 0 where it was not found.
        moments: (N, N_MOMENTS), each a packed `BlobMoments`.
        distance: (N,) mm of the view's origin from the camera.
        n_blobs: (N,) int64, components of about the animal's size.
    """

    heights: Any
    origin: Any
    step: Any
    n_px: Any
    moments: Any
    distance: Any
    n_blobs: Any


@njit(cache=True)
def crop_camera(packed):
    """The record of one packed crop camera (17,)."""
    return CropCamera(
        packed[0],
        packed[1],
        packed[2],
        packed[3],
        packed[4],
        packed[5],
        packed[6],
        packed[7],
        packed[8],
        packed[9],
        packed[10],
        packed[11],
        packed[12],
        packed[13],
        packed[14],
        packed[15],
        packed[16],
    )


@njit(cache=True)
def to_camera(camera, x0, y0, z0):
    """x, y, z mm in the camera frame of a point of the view frame; z is at least 1 mm."""
    z0 -= camera.distance
    x = camera.r00 * x0 + camera.r10 * y0 + camera.r20 * z0
    y = camera.r01 * x0 + camera.r11 * y0 + camera.r21 * z0
    z = max(camera.r02 * x0 + camera.r12 * y0 + camera.r22 * z0, 1.0)
    return x, y, z


@njit(cache=True)
def to_pixel(camera, x0, y0, z0):
    """Column and row of the crop, not rounded, at which a point mm of the view frame is seen."""
    x, y, z = to_camera(camera, x0, y0, z0)
    column = (camera.fx * x / z + camera.cx - camera.u0) / camera.step
    row = (camera.fy * y / z + camera.cy - camera.v0) / camera.step
    return column, row


@njit(cache=True)
def to_point(camera, row, column, height):
    """x, y mm of the view frame of what a crop pixel shows, `height` mm above its plane."""
    dx = (camera.u0 + camera.step * column - camera.cx) / camera.fx
    dy = (camera.v0 + camera.step * row - camera.cy) / camera.fy
    z = (height - camera.distance) / (camera.r20 * dx + camera.r21 * dy + camera.r22)
    x = z * (camera.r00 * dx + camera.r01 * dy + camera.r02)
    y = z * (camera.r10 * dx + camera.r11 * dy + camera.r12)
    return x, y
