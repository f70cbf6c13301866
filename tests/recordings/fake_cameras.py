"""Cameras at the interface of their makers' packages: modules with the same names, and no device.

What a camera sends is a list of (number, stamp in microseconds, steps); after it, it is unplugged.
"""

from collections.abc import Sequence
from types import SimpleNamespace as Names
from typing import Any

import numpy as np
from numpy.typing import NDArray

Sent = Sequence[tuple[int, int, NDArray[np.uint16]]]
LENS = {"fx": 424.2, "fy": 424.2}


class FakeRealSense(Names):
    """pyrealsense2 2.59 as far as `open_realsense` uses it."""

    def __init__(
        self, sent: Sent, unit_m: float = 0.001, domain: str = "timestamp_domain.global_time"
    ) -> None:
        coming = iter(sent)
        height, width = sent[0][2].shape

        def wait(timeout_ms: int) -> Any:
            if (one := next(coming, None)) is None:
                raise RuntimeError(f"Frame didn't arrive within {timeout_ms}")
            number, us, steps = one
            frame = Names(
                get_frame_timestamp_domain=lambda: domain,
                get_data=lambda: steps,
                get_frame_number=lambda: number,
                get_timestamp=lambda: us / 1000.0,
            )
            return Names(get_depth_frame=lambda: frame)

        lens = Names(
            **LENS,
            ppx=(width - 1) / 2,
            ppy=(height - 1) / 2,
            width=width,
            height=height,
            model="distortion.brown_conrady",
            coeffs=[0.0] * 5,
        )
        video = Names(get_intrinsics=lambda: lens)
        device = Names(
            first_depth_sensor=lambda: Names(get_depth_scale=lambda: unit_m),
            get_info=lambda key: {"name": "Intel RealSense D435", "serial": "8312"}[key],
        )
        profile = Names(
            get_device=lambda: device,
            get_stream=lambda kind: Names(as_video_stream_profile=lambda: video),
        )
        asked: list[Any] = []
        super().__init__(
            asked=asked,
            stream=Names(depth="depth"),
            format=Names(z16="z16"),
            camera_info=Names(name="name", serial_number="serial"),
            config=lambda: Names(enable_stream=lambda *what: asked.append(what)),
            pipeline=lambda: Names(
                start=lambda config: profile, wait_for_frames=wait, stop=lambda: None
            ),
        )


class FakeOrbbec(Names):
    """pyorbbecsdk2 2.1 as far as `open_orbbec` uses it."""

    def __init__(self, sent: Sent, unit_mm: float = 1.0, size: Any = None) -> None:
        coming = iter(sent)
        height, width = sent[0][2].shape

        def wait(timeout_ms: int) -> Any:
            if (one := next(coming, None)) is None:
                return None
            number, us, steps = one
            frame = Names(
                get_data=lambda: steps.view(np.uint8).ravel(),
                get_index=lambda: number,
                get_timestamp_us=lambda: us,
                get_system_timestamp_us=lambda: 10**15 + number * 33_333,
                get_width=lambda: width,
                get_height=lambda: height,
                get_depth_scale=lambda: unit_mm,
            )
            return Names(get_depth_frame=lambda: frame)

        lens_size = dict(zip(("width", "height"), size or (width, height), strict=True))
        lens = Names(**LENS, cx=(width - 1) / 2, cy=(height - 1) / 2, **lens_size)
        bent = Names(
            model="OBCameraDistortionModel.BROWN_CONRADY_K6",
            **dict.fromkeys(("p1", "p2", "k2", "k3", "k4", "k5", "k6"), 0.0),
            k1=0.01,
        )
        profile = Names(get_intrinsic=lambda: lens, get_distortion=lambda: bent)
        info = Names(get_name=lambda: "Femto Bolt", get_serial_number=lambda: "CL8F")
        modes = Names(
            get_default_video_stream_profile=lambda: profile,
            get_video_stream_profile=lambda *what: profile,
        )
        super().__init__(
            OBSensorType=Names(DEPTH_SENSOR=3),
            OBFormat=Names(Y16=9),
            Config=lambda: Names(enable_stream=lambda profile: None),
            Pipeline=lambda: Names(
                get_stream_profile_list=lambda kind: modes,
                start=lambda config: None,
                stop=lambda: None,
                wait_for_frames=wait,
                get_device=lambda: Names(get_device_info=lambda: info),
            ),
        )
