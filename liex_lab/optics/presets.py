"""Depth cameras by name, for recordings that do not say what took them.

Every number is a nominal value or one unit's factory calibration; units of a make differ by one or
two per cent in focal length and by some pixels in the principal point, so a camera's own
calibration is always better.

Sources:

- kinect-v2, primesense, primesense-qvga, raytrix-r5: as `liex_lab.optics.camera` has them; OpenNI
  states a horizontal field of view of 1.0145 rad for PrimeSense's sensors, f = 320 / tan(0.507).
- azure-nfov: factory calibration of one Azure Kinect DK, in microsoft/Azure-Kinect-Sensor-SDK
  issue 1617 (in units of 1024 px); the narrow mode, 640 x 576, is the part of the sensor's 1024 x
  1024 px that begins at pixel (192, 180), as the SDK cuts it.
- femto-bolt: factory calibration of one Orbbec Femto Bolt, in orbbec/OrbbecSDK issue 56; the sensor
  and its modes are those of the Azure Kinect.
- d435: `rs-enumerate-devices -c` of one RealSense D435, in realsenseai/realsense-ros issue 2788;
  for 1280 x 720 librealsense issue 3314. Its depth pictures are rectified: there is no distortion.
"""

from __future__ import annotations

from liex_lab.errors import LiexError
from liex_lab.optics.camera import (
    BROWN_CONRADY,
    KINECT_V2,
    PRIMESENSE,
    PRIMESENSE_QVGA,
    RAYTRIX_R5,
    Camera,
    Distortion,
)

_AZURE = Distortion(
    BROWN_CONRADY, (4.72474, 3.20922, 5.9e-6, 0.000124, 0.170596, 5.05586, 4.77578, 0.886494)
)
_FEMTO = Distortion(
    BROWN_CONRADY, (8.68957, 4.46817, 0.0, 0.0, 0.172922, 9.01699, 7.37854, 1.05598)
)
# of each name, one camera for each size of its pictures
PRESETS = {
    "kinect-v2": (KINECT_V2,),
    "primesense": (PRIMESENSE, PRIMESENSE_QVGA),
    "azure-nfov": (Camera(503.9, 503.7, 321.0, 328.5, 640, 576, distortion=_AZURE),),
    "femto-bolt": (Camera(505.3, 505.2, 338.2, 325.0, 640, 576, distortion=_FEMTO),),
    "d435": (
        Camera(424.2, 424.2, 423.4, 239.5, 848, 480),
        Camera(384.2, 384.2, 319.5, 239.5, 640, 480),
        Camera(638.0, 638.0, 639.5, 359.5, 1280, 720),
        Camera(320.2, 320.2, 319.6, 179.5, 640, 360),
    ),
    "raytrix-r5": (RAYTRIX_R5,),
}

_LIKE = 0.1  # units of a make, and pictures mapped onto another lens, differ by less than this
# sizes that few kinds of camera have; of others there are too many to call a lens unusual
_TELLING = ((640, 480), (512, 424), (320, 240), (640, 576))


def preset(name: str, width: int, height: int) -> Camera:
    """The camera of a name, for pictures of a size.

    Args:
        name: a key of `PRESETS`.
        width: columns of the pictures, px.
        height: rows of the pictures, px.

    Raises:
        LiexError: there is no such name, or that camera takes no pictures of this size.
    """
    cameras = PRESETS.get(name)
    if cameras is None:
        raise LiexError(
            f"camera.preset is one of {', '.join(PRESETS)}, got '{name}'; choose one of them, or "
            "state fx, fy, cx and cy"
        )
    for camera in cameras:
        if (camera.width, camera.height) == (width, height):
            return Camera(
                camera.fx,
                camera.fy,
                camera.cx,
                camera.cy,
                width,
                height,
                source=f"preset {name}",
                distortion=camera.distortion,
            )
    sizes = " or ".join(f"{camera.width} x {camera.height}" for camera in cameras)
    raise LiexError(
        f"the camera '{name}' takes pictures of {sizes} px, but these have {width} x {height}; "
        "name the camera that took them, or state fx, fy, cx and cy"
    )


def of_size(width: int, height: int) -> list[str]:
    """Names of the cameras that take pictures of a size.

    Args:
        width: columns of the pictures, px.
        height: rows of the pictures, px.
    """
    return [
        name
        for name, cameras in PRESETS.items()
        if any((camera.width, camera.height) == (width, height) for camera in cameras)
    ]


def unusual_lens(camera: Camera) -> str:
    """That a focal length is unlike that of every known camera with such pictures; "" if it is not.

    A focal length that is wrong makes every length across the picture wrong by as much, and the
    animal another one of the same look: nothing else in a recording tells.

    Args:
        camera: as the recording or the plan states it, of pictures above no water.
    """
    size = (camera.width, camera.height)
    known = {
        name: one.fx
        for name, cameras in PRESETS.items()
        for one in cameras
        if (one.width, one.height) == size and size in _TELLING
    }
    if not known or any(abs(camera.fx / fx - 1.0) <= _LIKE for fx in known.values()):
        return ""
    usual = ", ".join(f"{name} {fx:.0f}" for name, fx in known.items())
    return (
        f"the focal length of {camera.fx:.0f} px is unlike that of the known cameras with pictures "
        f"of {camera.width} x {camera.height} px ({usual}); where it is wrong, every length is: "
        "put something of known length on the floor"
    )


def is_central(cx: float, cy: float, width: int, height: int, share: float = 0.4) -> bool:
    """Whether a principal point lies in the middle of a picture.

    Args:
        cx: its column, px.
        cy: its row, px.
        width: columns of the picture, px.
        height: rows of the picture, px.
        share: how much of the width and height the middle is.
    """
    off = max(abs((cx + 0.5) / width - 0.5), abs((cy + 0.5) / height - 0.5))
    return off <= share / 2


def unusual_centre(camera: Camera) -> tuple[str, bool]:
    """That a principal point lies far from the middle of the picture, and whether at its edge.

    Args:
        camera: as the recording or the plan states it.

    Returns:
        A sentence, "" where it lies in the middle 40 %; True outside of the middle 80 %.
    """
    where = (camera.cx, camera.cy, camera.width, camera.height)
    if is_central(*where):
        return "", False
    return (
        f"the principal point ({camera.cx:.1f}, {camera.cy:.1f}) lies far from the middle of the "
        f"picture of {camera.width} x {camera.height} px, as if cx and cy belonged to another "
        "picture size or to a larger picture: lengths and the tilt are wrong if they do",
        not is_central(*where, 0.8),
    )
