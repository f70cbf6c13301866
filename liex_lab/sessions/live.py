"""Live stream of depth and skeletons to a Rerun viewer, in a scene of metres."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from liex_lab.body.skeleton import Skeleton
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.recordings.frame import DepthFrame
from liex_lab.sessions.drawn import dot_mm
from liex_lab.sessions.rrd import BONE_COLOUR, JOINT_COLOUR, SKELETON
from liex_lab.sessions.rrd_depth import DEPTH, IMAGE, MM_PER_UNIT, colour_range
from liex_lab.sessions.viewer import begin_viewer
from liex_lab.tracking.track import Track

ERROR = "error/predicted"
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
        blueprint: the layout, a Rerun blueprint; None for none.

    Raises:
        LiexError: there is no screen for a viewer.
    """

    def __init__(
        self,
        name: str,
        camera: Camera,
        T_arena_camera: SE3,
        skeleton: Skeleton,
        to: str,
        blueprint: Any = None,
    ) -> None:
        self._edges = skeleton.edges
        self._stream = rr.RecordingStream(
            "liex_lab", recording_id=f"live-{name}", send_properties=False
        )
        if to.endswith(".rrd"):
            self._stream.save(Path(to))
        else:
            self._stream.connect_grpc(begin_viewer() if to == "viewer" else to)
        if blueprint is not None:
            self._stream.send_blueprint(blueprint)
        self._floor_mm = float(T_arena_camera.translation[2])
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
        dot_m = dot_mm(skeleton) / MM_PER_UNIT
        dots = rr.Points3D.from_fields(radii=dot_m, colors=JOINT_COLOUR)
        self._stream.log(f"{SKELETON}/joints", dots, static=True)
        lines = rr.LineStrips3D.from_fields(radii=dot_m / 2.0, colors=BONE_COLOUR)
        self._stream.log(f"{SKELETON}/bones", lines, static=True)
        self._first_ns: int | None = None
        self._range: Any = None

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
            self._stream.log(f"{SKELETON}/joints", rr.Points3D(joints_m))
            self._stream.log(f"{SKELETON}/bones", rr.LineStrips3D(bones))
            self._stream.log(ERROR, rr.Scalars(float(row.predicted_error_mm[0])))
        else:
            self._stream.log(f"{SKELETON}/joints", rr.Points3D([]))
            self._stream.log(f"{SKELETON}/bones", rr.LineStrips3D([]))
        if frame.index % _DEPTH_EVERY == 0:
            depth = np.clip(np.rint(frame.depth), 0, 65535).astype(np.uint16)
            if not self._range:
                self._range = colour_range(depth, self._floor_mm)
            look: dict[str, Any] = {"colormap": "viridis", "point_fill_ratio": 0.25}
            picture = rr.DepthImage(depth, meter=MM_PER_UNIT, depth_range=self._range, **look)
            self._stream.log(DEPTH, picture)

    def close(self) -> None:
        """Send what is held back, and end the stream."""
        self._stream.flush()
        self._stream.disconnect()
