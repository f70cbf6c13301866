"""The depth camera of an Azure Kinect (and the Orbbec Femto, its successor): from its factory
calibration, or typical.

The factory states normalised numbers of the whole sensor; a depth mode shows a part of it, perhaps
binned two by two.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple

import numpy as np

from liex_lab.optics.camera import Camera, Distortion


class Mode(NamedTuple):
    """A depth mode: size of its pictures, pixels; side of the sensor once binned; the picture's
    corner on it.
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
    """What a calibration says. shares: cx, cy, fx, fy of the sensor; distortion: k1 k2 p1 p2 k3 k4
    k5 k6.
    """

    shares: tuple[float, float, float, float]
    distortion: tuple[float, ...]


def mode_of(width: int, height: int) -> Mode | None:
    """The depth mode with pictures of this size."""
    return next((mode for mode in MODES if (mode.width, mode.height) == (width, height)), None)


def read_calibration(data: bytes) -> FactoryLens | None:
    """The depth camera in the JSON that recorders attach to their files; None where it does not
    tell one.
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
    """The camera of a depth mode; pixel (0, 0) is the centre of the top-left pixel, hence
    the half.
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
