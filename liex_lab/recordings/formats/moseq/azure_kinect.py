"""Pinhole camera of an Azure Kinect depth mode, from its factory calibration or typical.

The Orbbec Femto, its successor, has the same modes. The factory states normalised intrinsics of the
whole sensor; a depth mode is a crop of it, perhaps binned two by two:

    fx_px = fx side,    cx_px = cx side - left - 1/2.

Distortion is Brown-Conrady with eight coefficients (ROS: rational_polynomial).
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np

from liex_lab.optics.camera import Camera, Distortion


class Mode(NamedTuple):
    """A depth mode.

    Attributes:
        name: its name in the Azure Kinect sensor SDK.
        width: columns of its pictures, px.
        height: rows of its pictures, px.
        side: side of the sensor once binned, px.
        left: column of the picture's corner on it, px.
        top: row of the picture's corner on it, px.
    """

    name: str
    width: int
    height: int
    side: int
    left: int
    top: int


MODES = (  # of the Azure Kinect sensor SDK
    Mode("NFOV_UNBINNED", 640, 576, 1024, 192, 180),
    Mode("NFOV_2X2BINNED", 320, 288, 512, 96, 90),
    Mode("WFOV_2X2BINNED", 512, 512, 512, 0, 0),
    Mode("WFOV_UNBINNED", 1024, 1024, 1024, 0, 0),
)
_TYPICAL = (
    0.5,
    0.5,
    0.492,
    0.492,
)  # cx, cy, fx, fy as shares of the sensor's side; units differ by about 1 %
_DEPTH_CAMERA = ("CALIBRATION_CameraLocationD0", "CALIBRATION_CameraPurposeDepth")


class FactoryLens(NamedTuple):
    """What a factory calibration says of the depth camera.

    Attributes:
        shares: cx, cy, fx, fy as shares of the sensor's side.
        distortion: k1 k2 p1 p2 k3 k4 k5 k6.
    """

    shares: tuple[float, float, float, float]
    distortion: tuple[float, ...]


def mode_of(width: int, height: int) -> Mode | None:
    """The depth mode with pictures of a given size.

    Args:
        width: columns, px.
        height: rows, px.

    Returns:
        The mode; None where there is none.
    """
    return next((mode for mode in MODES if (mode.width, mode.height) == (width, height)), None)


def read_calibration(data: bytes) -> FactoryLens | None:
    """The depth camera in the calibration (JSON) that recorders attach to their files.

    Args:
        data: the JSON, perhaps with zeros at its end.

    Returns:
        The lens; None where the data do not state one.
    """
    try:
        cameras = json.loads(data.rstrip(b"\0"))["CalibrationInformation"]["Cameras"]
        depth = next(
            c
            for c in cameras
            if c.get("Location") == _DEPTH_CAMERA[0] or c.get("Purpose") == _DEPTH_CAMERA[1]
        )
        values = [float(value) for value in depth["Intrinsics"]["ModelParameters"]]
    except (ValueError, KeyError, TypeError, AttributeError, StopIteration, RecursionError):
        return None
    if len(values) < 14 or not np.isfinite(values).all() or min(values[2:4]) <= 0:
        return None
    cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = values[:14]
    return FactoryLens((cx, cy, fx, fy), (k1, k2, p1, p2, k3, k4, k5, k6))


def azure_camera(mode: Mode, lens: FactoryLens | None) -> Camera:
    """The camera of a depth mode, in pixels of its pictures.

    Pixel (0, 0) is the centre of the top-left pixel, hence the half that is taken off.

    Args:
        mode: the depth mode.
        lens: the factory's calibration; None for typical numbers, which differ by about 1 % from
            unit to unit.

    Returns:
        The camera, with distortion where lens is given.
    """
    cx, cy, fx, fy = _TYPICAL if lens is None else lens.shares
    facts: dict[str, Any] = {
        "fx": fx * mode.side,
        "fy": fy * mode.side,
        "cx": cx * mode.side - mode.left - 0.5,
        "cy": cy * mode.side - mode.top - 0.5,
        "width": mode.width,
        "height": mode.height,
    }
    if lens is None:
        return Camera(**facts, source=f"typical Azure Kinect, {mode.name}")
    distortion = Distortion.of("rational_polynomial", lens.distortion)
    return Camera(
        **facts, source="the camera's factory calibration in the file", distortion=distortion
    )
