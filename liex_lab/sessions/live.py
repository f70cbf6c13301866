"""Live stream of depth and skeletons to a Rerun viewer, in a scene of metres."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import rerun as rr

from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.recordings.frame import DepthFrame
from liex_lab.sessions.rrd import SKELETON
from liex_lab.sessions.rrd_depth import DEPTH, IMAGE, MM_PER_UNIT
from liex_lab.tracking.track import Track

_DEPTH_EVERY = 5  # frames; a picture takes longer to send than a skeleton


class LiveView:
    """A stream of depth and skeletons while the recording goes on.

    Args:
        name: the recording's name.
        camera: the depth camera.
        T_arena_camera: carries the camera frame (mm) into the arena frame.
        skeleton: the animal's skeleton.
        to: 'viewer' starts a viewer on this machine; a name ending in .rrd is a file to write; else
            the address of a viewer.
    """

    def __init__(
        self, name: str, camera: Camera, T_arena_camera: SE3, skeleton: Skeleton, to: str
    ) -> None:
        self._edges = skeleton.edges
        self._stream = rr.RecordingStream(
            "liex_lab", recording_id=f"live-{name}", send_properties=False
        )
        if to == "viewer":
            os.environ["RERUN_ANALYTICS"] = "0"
            self._stream.spawn(connect=True)
        elif to.endswith(".rrd"):
            self._stream.save(Path(to))
        else:
            self._stream.connect_grpc(to)
        self._stream.log("arena", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        place = rr.Transform3D(
            translation=T_arena_camera.translation / MM_PER_UNIT, mat3x3=T_arena_camera.rotation
        )
        self._stream.log("arena/camera", place, static=True)
        matrix = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
        lens = rr.Pinhole(
            image_from_camera=matrix,
            resolution=[camera.width, camera.height],
            camera_xyz=rr.ViewCoordinates.RDF,
        )
        self._stream.log(IMAGE, lens, static=True)
        self._first_ns: int | None = None

    def show(self, frame: DepthFrame, row: Track) -> None:
        """Show the skeleton of one frame and, every fifth frame, the depth picture.

        Args:
            frame: the frame.
            row: its track of one row; without a pose the last skeleton goes.
        """
        self._first_ns = frame.time_ns if self._first_ns is None else self._first_ns
        self._stream.set_time("frame", sequence=frame.index)
        self._stream.set_time("time", duration=np.timedelta64(frame.time_ns - self._first_ns, "ns"))
        if row.posed[0]:
            joints_m = row.joints_mm[0] / MM_PER_UNIT
            bones = [joints_m[list(edge)] for edge in self._edges]
            self._stream.log(f"{SKELETON}/joints", rr.Points3D(joints_m, radii=0.002))
            self._stream.log(f"{SKELETON}/bones", rr.LineStrips3D(bones))
        else:
            self._stream.log(SKELETON, rr.Clear(recursive=True))
        if frame.index % _DEPTH_EVERY == 0:
            depth = np.clip(np.rint(frame.depth), 0, 65535).astype(np.uint16)
            self._stream.log(DEPTH, rr.DepthImage(depth, meter=MM_PER_UNIT))

    def close(self) -> None:
        """Send what is held back, and end the stream."""
        self._stream.flush()
        self._stream.disconnect()
