"""Rerun viewer: starting it, opening a session's replay, and live streaming."""

import atexit
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import rerun as rr
from rerun.experimental import ViewerClient

from liex_lab.actions.vocabulary import individual_colours
from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.geometry import SE3
from liex_lab.optics.camera import Camera
from liex_lab.recordings.frame import DepthFrame
from liex_lab.runtime.processes import own_python
from liex_lab.sessions.corrections import REPLAY
from liex_lab.sessions.rrd import ANIMALS, BONE_COLOUR, JOINT_COLOUR, SKELETON
from liex_lab.sessions.rrd_scene import DEPTH, MM_PER_UNIT, colour_range, dot_mm, log_camera, rgba
from liex_lab.sessions.session import Session
from liex_lab.tracking.track import Track

Made = TypeVar("Made")


def has_screen() -> bool:
    """Whether a window can be opened on this machine."""
    return sys.platform != "linux" or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )


def need_screen(instead: str) -> None:
    """Continue only if a window can be opened.

    Args:
        instead: the remedy without a screen, for the error message.

    Raises:
        LiexError: there is no screen.
    """
    if not has_screen():
        raise LiexError(f"Rerun needs a screen, and this computer has no screen; {instead}")


def replays_with(replay: Path, more: Sequence[Path] = ()) -> list[Path]:
    """Files to open for a session's replay, in order.

    With corrections, their replay is first, because the first file determines the layout.

    Args:
        replay: the session's own .rrd, or a separate one.
        more: further files of the same replay.
    """
    try:
        corrected = Session.open(replay.parent).file(REPLAY)
    except LiexError:  # a separate replay
        return [replay, *more]
    return [*([corrected] if corrected.is_file() else []), replay, *more]


def show_replay(
    replay: Path, at_s: float, more: Sequence[Path] = (), *, headless: bool = False
) -> tuple[subprocess.Popen[bytes], Any]:
    """Open a replay in a window at a given time; returns the viewer and the client controlling it.

    The viewer listens on 127.0.0.1 only and ends with this process.

    Args:
        replay: the .rrd file.
        at_s: time, s since its first frame.
        more: further files of the same replay.
        headless: open no window, for tests.

    Raises:
        LiexError: there is no such file, no screen, or the viewer does not start within 30 s.
    """
    if not replay.is_file():
        raise LiexError(f"there is no replay {replay}; run `liex run` on the recording again")
    if not headless:
        need_screen(f"open {replay} on a computer with a screen")

    port, process = _begin(*(["--headless"] if headless else []))

    def opened() -> tuple[subprocess.Popen[bytes], Any]:
        client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        for file in replays_with(replay, more):
            client.open(str(file.resolve()))
        client.set_time("time", duration=at_s, play_state="paused")
        return process, client

    return _once_up(process, opened, f"Rerun did not show {replay}; try `liex show` in a terminal")


def begin_viewer() -> str:
    """Open a viewer for streamed data that keeps running when this process ends.

    Returns:
        Its address. It listens on 127.0.0.1 only.

    Raises:
        LiexError: there is no screen, or the viewer does not start within 30 s.
    """
    need_screen("have it written to a file, or name the address of a viewer elsewhere")
    port, process = _begin(stays=True)
    connect = partial(socket.create_connection, ("127.0.0.1", port), timeout=1.0)
    failed = "Rerun's viewer did not open; have it written to a file NAME.rrd instead"
    _once_up(process, connect, failed).close()
    return f"rerun+http://127.0.0.1:{port}/proxy"


def _once_up(process: subprocess.Popen[bytes], attempt: Callable[[], Made], failed: str) -> Made:
    """Repeat an attempt until the viewer has started; returns the attempt's result.

    Raises:
        LiexError: the viewer ended, or did not start within 30 s.
    """
    # for a viewer to start
    ends = time.monotonic() + 30.0
    why = "it ended at once"
    while time.monotonic() < ends and process.poll() is None:
        try:
            return attempt()
        except Exception as error:  # not started yet; Rerun's exception is not documented
            why = str(error).partition("\n")[0][:200]
            time.sleep(0.2)
    end_viewer(process)
    sentence, _, remedy = failed.partition("; ")
    raise LiexError(f"{sentence} ({why}); {remedy}")


def _begin(*arguments: str, stays: bool = False) -> tuple[int, subprocess.Popen[bytes]]:
    """Start a viewer; returns its port and its process."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    given = ("--port", str(port), "--hide-welcome-screen", "--bind", "127.0.0.1")

    # RERUN_ANALYTICS: no telemetry from a laboratory's data
    viewer = subprocess.Popen(
        own_python("-m", "rerun", *given, *arguments),
        env={**os.environ, "RERUN_ANALYTICS": "0"},
        start_new_session=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    if not stays:
        atexit.register(end_viewer, viewer)
    return port, viewer


def end_viewer(viewer: subprocess.Popen[bytes]) -> None:
    """Terminate a viewer and its child processes: `rerun` is a wrapper around the real viewer."""
    if viewer.poll() is None:
        if hasattr(os, "killpg"):
            os.killpg(viewer.pid, signal.SIGTERM)
        else:
            viewer.terminate()
        viewer.wait(timeout=10)


# Live stream of depth and skeletons to a Rerun viewer, in a scene of metres.


ERROR = "error/predicted"


class LiveView:
    """A stream of depth and skeletons during a recording, as a session's replay shows them.

    Args:
        name: the recording's name.
        camera: the depth camera.
        T_arena_camera: transform from the camera frame (mm) to the arena frame.
        skeleton: the animals' skeleton.
        to: 'viewer' starts a viewer on this machine; a name ending in .rrd is a file to write; else
            the address of a viewer.
        blueprint: the layout, a Rerun blueprint.
        names: of the animals; a single one has no name and the usual colour.

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
        blueprint: Any,
        names: Sequence[str],
    ) -> None:
        self._edges = skeleton.edges
        self._stream = rr.RecordingStream(
            "liex_lab", recording_id=f"live-{name}", send_properties=False
        )
        if to.endswith(".rrd"):
            self._stream.save(Path(to))
        else:
            self._stream.connect_grpc(begin_viewer() if to == "viewer" else to)
        self._stream.send_blueprint(blueprint)
        self._floor_mm = float(T_arena_camera.translation[2])
        log_camera(self._stream, camera, T_arena_camera)
        dot_m = dot_mm(skeleton) / MM_PER_UNIT
        more = [rr.escape_entity_path_part(name) for name in names[1:]]
        self._animals = [
            (SKELETON, ERROR),
            *((f"{ANIMALS}/{part}", f"{ERROR}/{part}") for part in more),
        ]
        colours = individual_colours(names)
        for (entity, _), name in zip(self._animals, names, strict=True):
            own: dict[str, Any] = {"colors": rgba([int(colours[name][1:], 16)])} if more else {}
            dots = rr.Points3D.from_fields(radii=dot_m, **{"colors": JOINT_COLOUR, **own})
            self._stream.log(f"{entity}/joints", dots, static=True)
            own = {"colors": BONE_COLOUR, **own, **({"labels": [name]} if more else {})}
            lines = rr.LineStrips3D.from_fields(radii=dot_m / 2.0, **own)
            self._stream.log(f"{entity}/bones", lines, static=True)
        self._first_ns: int | None = None
        self._range: Any = None

    def show(self, frame: DepthFrame, rows: Sequence[Track]) -> None:
        """Show the skeletons of one frame and, every fifth frame, the depth image.

        Args:
            frame: the frame.
            rows: of each animal its track of one row; without a pose the last skeleton is cleared.
        """
        self._first_ns = frame.time_ns if self._first_ns is None else self._first_ns
        self._stream.set_time("frame", sequence=frame.index)
        self._stream.set_time("time", duration=np.timedelta64(frame.time_ns - self._first_ns, "ns"))
        for (entity, error), row in zip(self._animals, rows, strict=True):
            posed = bool(row.posed[0])
            joints_m = row.joints_mm[0] / MM_PER_UNIT
            bones = [joints_m[list(edge)] for edge in self._edges]
            self._stream.log(f"{entity}/joints", rr.Points3D(joints_m if posed else []))
            self._stream.log(f"{entity}/bones", rr.LineStrips3D(bones if posed else []))
            if posed:
                self._stream.log(error, rr.Scalars(float(row.predicted_error_mm[0])))
        # frames; an image takes longer to send than a skeleton
        if frame.index % 5 == 0:
            depth = np.clip(np.rint(frame.depth), 0, 65535).astype(np.uint16)
            if not self._range:
                self._range = colour_range(depth, self._floor_mm)
            style: dict[str, Any] = {"colormap": "viridis", "point_fill_ratio": 0.25}
            image = rr.DepthImage(depth, meter=MM_PER_UNIT, depth_range=self._range, **style)
            self._stream.log(DEPTH, image)

    def close(self) -> None:
        """Send buffered data, and end the stream."""
        self._stream.flush()
        self._stream.disconnect()
