"""Depth cameras at the computer, through their makers' packages: pyrealsense2 and pyorbbecsdk2.

A device's frames have its own clock: stamps are the camera's, shifted once so that the first frame
has the computer's time. Frame numbers count what the camera made, so that drops are known.
"""

import time
from collections.abc import Callable, Iterator
from importlib import import_module
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from liex_lab.errors import MissingPackageError, RecordingError, how_to_install, one_line
from liex_lab.optics.camera import Camera, DepthMode, Distortion
from liex_lab.recordings.frame import DepthFrame

_PATIENCE_MS = 5000  # without a frame, the camera is gone
_RATE_HZ = 30
_INSTALL = {
    "pyrealsense2": how_to_install("realsense"),
    # its own list of packages contradicts liex_lab's (NumPy below 2, an older PyAV)
    "pyorbbecsdk": "install it with `pip install --no-deps pyorbbecsdk2`",
}


class Device(NamedTuple):
    """An open depth camera.

    Attributes:
        name: the maker's name of the model.
        serial: its serial number.
        camera: its own calibration.
        frames: its frames, with the camera's frame numbers and stamps; ends with a RecordingError.
        close: stops it.
        notes: sentences about its times.
    """

    name: str
    serial: str
    camera: Camera
    frames: Iterator[DepthFrame]
    close: Callable[[], None]
    notes: list[str]


def _package(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise MissingPackageError(
            f"this camera needs the package {name} ({one_line(error)}); {_INSTALL[name]}"
        ) from None


def _gone(why: object) -> RecordingError:
    return RecordingError(
        f"the camera sends no more frames ({why}); check its cable and its port, USB 3 and without "
        "a hub, and record again under another name"
    )


def _started(start: Callable[[], Any], mode: DepthMode | None) -> Any:
    """What a maker's call that starts the stream returns."""
    try:
        return start()
    except RuntimeError as error:  # both packages know only this
        asked = "" if mode is None else f" for {mode.name}, {mode.mode}"
        raise RecordingError(
            f"the camera could not be started{asked}: {one_line(error)}; plug it in, close other "
            "programs that use it, or choose another --preset"
        ) from None


def _stamped(
    raw: Iterator[tuple[int, int, Any]], first: tuple[int, int, Any], unit_mm: float
) -> Iterator[DepthFrame]:
    """Depth frames of (number, ns on the camera's clock, steps), dated by the first one."""
    shift_ns = time.time_ns() - first[1]
    for number, clock_ns, steps in chain((first,), raw):
        yield DepthFrame(number, clock_ns + shift_ns, steps * np.float32(unit_mm))


def open_realsense(mode: DepthMode | None = None) -> Device:
    """The first RealSense camera, streaming depth.

    Args:
        mode: image size to ask for, at 30 frames/s; None leaves it to the camera.

    Raises:
        MissingPackageError: pyrealsense2 is not installed.
        RecordingError: there is no camera, or it has no such mode.
    """
    rs = _package("pyrealsense2")
    pipeline, config = rs.pipeline(), rs.config()
    if mode is None:
        config.enable_stream(rs.stream.depth)
    else:
        size = mode.camera.width, mode.camera.height
        config.enable_stream(rs.stream.depth, *size, rs.format.z16, _RATE_HZ)
    profile = _started(lambda: pipeline.start(config), mode)
    device = profile.get_device()
    unit_mm = round(1000.0 * device.first_depth_sensor().get_depth_scale(), 6)
    lens = profile.get_stream(rs.stream.depth).as_video_stream_profile().get_intrinsics()
    name, serial = (
        device.get_info(getattr(rs.camera_info, key)) for key in ("name", "serial_number")
    )

    def raw() -> Iterator[tuple[int, int, Any]]:
        while True:
            try:
                frame = pipeline.wait_for_frames(_PATIENCE_MS).get_depth_frame()
            except RuntimeError as error:
                raise _gone(one_line(error)) from None
            if frame:
                domains.add(str(frame.get_frame_timestamp_domain()))
                steps = np.asanyarray(frame.get_data()).copy()
                yield frame.get_frame_number(), round(frame.get_timestamp() * 1e6), steps

    domains: set[str] = set()
    frames = raw()
    first = next(frames)
    notes = [
        "the driver states the time of arrival instead of the camera's clock; update its firmware"
        for domain in domains
        if "system_time" in domain
    ]
    model = str(lens.model).rpartition(".")[2]
    camera = Camera(
        lens.fx,
        lens.fy,
        lens.ppx,
        lens.ppy,
        lens.width,
        lens.height,
        f"{name} {serial}",
        distortion=Distortion.of(model, lens.coeffs),
    )
    return Device(name, serial, camera, _stamped(frames, first, unit_mm), pipeline.stop, notes)


def open_orbbec(mode: DepthMode | None = None) -> Device:
    """The first Orbbec camera, streaming depth.

    Args:
        mode: image size to ask for, at 30 frames/s; None leaves it to the camera.

    Raises:
        MissingPackageError: pyorbbecsdk2 is not installed.
        RecordingError: there is no camera, it has no such mode, or states the lens of another one.
    """
    ob = _package("pyorbbecsdk")
    pipeline = _started(ob.Pipeline, None)
    modes = pipeline.get_stream_profile_list(ob.OBSensorType.DEPTH_SENSOR)
    if mode is None:
        profile = modes.get_default_video_stream_profile()
    else:
        size = mode.camera.width, mode.camera.height
        profile = _started(
            lambda: modes.get_video_stream_profile(*size, ob.OBFormat.Y16, _RATE_HZ), mode
        )
    config = ob.Config()
    config.enable_stream(profile)
    _started(lambda: pipeline.start(config), mode)
    info = pipeline.get_device().get_device_info()
    name, serial = info.get_name(), info.get_serial_number()

    def shown() -> Iterator[Any]:
        while True:
            try:
                together = pipeline.wait_for_frames(_PATIENCE_MS)
            except RuntimeError as error:
                raise _gone(one_line(error)) from None
            if together is None:
                raise _gone(f"none within {_PATIENCE_MS / 1000:g} s")
            if (frame := together.get_depth_frame()) is not None:
                yield frame

    coming = shown()
    first = next(coming)
    width, height, unit_mm = first.get_width(), first.get_height(), first.get_depth_scale()
    # some firmware has no clock: all its stamps are 0
    has_clock = first.get_timestamp_us() > 0
    notes = [] if has_clock else ["the camera states no times; those of arrival were stored"]

    def raw(frame: Any) -> tuple[int, int, Any]:
        steps = np.frombuffer(frame.get_data(), np.uint16).reshape(height, width).copy()
        us = frame.get_timestamp_us() if has_clock else frame.get_system_timestamp_us()
        return frame.get_index(), 1000 * us, steps

    lens, bent = profile.get_intrinsic(), profile.get_distortion()
    if (lens.width, lens.height) != (width, height):
        pipeline.stop()
        raise RecordingError(
            f"the camera states the lens of images of {lens.width} x {lens.height} px, but sends "
            f"{width} x {height}; update its firmware and pyorbbecsdk2"
        )
    model = str(bent.model).rpartition(".")[2].removesuffix("_K6").removesuffix("4")
    keys = "k1 k2 k3 k4" if model == "KANNALA_BRANDT" else "k1 k2 p1 p2 k3 k4 k5 k6"
    camera = Camera(
        lens.fx,
        lens.fy,
        lens.cx,
        lens.cy,
        width,
        height,
        f"{name} {serial}",
        distortion=Distortion.of(model, [getattr(bent, key) for key in keys.split()]),
    )
    frames = _stamped(map(raw, coming), raw(first), unit_mm)
    return Device(name, serial, camera, frames, pipeline.stop, notes)


MAKERS = {"orbbec": open_orbbec, "realsense": open_realsense}
