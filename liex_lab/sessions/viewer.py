"""Launcher of the Rerun viewer that shows a session's replay at a moment in time."""

from __future__ import annotations

import atexit
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from liex_lab.errors import LiexError
from liex_lab.runtime.processes import own_python

_PATIENCE_S = 30.0  # for a viewer to come up


@dataclass(frozen=True)
class Shown:
    """A viewer that shows a replay.

    Attributes:
        process: the viewer's process.
        client: Rerun's client that commands it.
    """

    process: subprocess.Popen[bytes]
    client: Any

    def wait(self) -> None:
        """Wait until the viewer is closed."""
        self.process.wait()

    def close(self) -> None:
        """End the viewer."""
        _end(self.process)


def has_screen() -> bool:
    """Whether a window can be shown here."""
    return sys.platform != "linux" or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    )


def need_screen(instead: str) -> None:
    """Go on only where a window can be shown.

    Args:
        instead: what to do where it cannot.

    Raises:
        LiexError: there is no screen.
    """
    if not has_screen():
        raise LiexError(f"Rerun needs a screen and there is none here; {instead}")


def replays_with(replay: Path, more: Sequence[Path] = ()) -> list[Path]:
    """Files to open for a session's replay, in order.

    Where there are corrections, their replay comes first, for the first file's layout holds.

    Args:
        replay: the session's own .rrd, or one that lies somewhere by itself.
        more: further files of the same replay.
    """
    from liex_lab.sessions.corrections import REPLAY
    from liex_lab.sessions.session import Session

    try:
        corrected = Session.open(replay.parent).file(REPLAY)
    except LiexError:  # a replay that lies somewhere by itself
        return [replay, *more]
    return [*([corrected] if corrected.is_file() else []), replay, *more]


def show_replay(
    replay: Path, at_s: float, more: Sequence[Path] = (), *, headless: bool = False
) -> Shown:
    """Open a replay in a window at a moment; returns the viewer.

    The viewer listens on 127.0.0.1 alone and ends with this process.

    Args:
        replay: the .rrd file.
        at_s: the moment, s since its first frame.
        more: further files of the same replay.
        headless: show no window, for tests.

    Raises:
        LiexError: there is no such file, no screen, or the viewer does not come up within 30 s.
    """
    if not replay.is_file():
        raise LiexError(f"there is no replay {replay}; run `liex run` on the recording again")
    if not headless:
        need_screen(f"open {replay} on a computer with a screen")
    from rerun.experimental import ViewerClient

    port = _free_port()
    process = _begin(
        "--port", str(port), "--hide-welcome-screen", *(["--headless"] if headless else [])
    )
    ends = time.monotonic() + _PATIENCE_S
    seen = ""
    while time.monotonic() < ends and process.poll() is None:
        try:
            client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
            for file in replays_with(replay, more):
                client.open(str(file.resolve()))
            client.set_time("time", duration=at_s, play_state="paused")
            return Shown(process, client)
        except Exception as error:  # not up yet; what it raises then is not documented
            seen = str(error).partition("\n")[0][:200]
            time.sleep(0.3)
    _end(process)
    raise LiexError(
        f"Rerun did not show {replay} ({seen or 'it ended at once'}); try `liex show` in a terminal"
    )


def begin_viewer() -> str:
    """Open a viewer that shows what is sent to it, and stays when this process ends.

    Returns:
        Its address. It listens on 127.0.0.1 alone.

    Raises:
        LiexError: there is no screen, or the viewer does not come up within 30 s.
    """
    need_screen("have it written to a file, or name the address of a viewer elsewhere")
    port = _free_port()
    process = _begin("--port", str(port), "--hide-welcome-screen", stays=True)
    ends = time.monotonic() + _PATIENCE_S
    while time.monotonic() < ends and process.poll() is None:
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
        except OSError:  # not up yet
            time.sleep(0.1)
        else:
            return f"rerun+http://127.0.0.1:{port}/proxy"
    _end(process)
    raise LiexError("Rerun's viewer did not open; have it written to a file NAME.rrd instead")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _begin(*arguments: str, stays: bool = False) -> subprocess.Popen[bytes]:
    # RERUN_ANALYTICS: what a laboratory looks at is nobody else's business
    command = own_python("-m", "rerun", *arguments, "--bind", "127.0.0.1")
    viewer = subprocess.Popen(
        command,
        env={**os.environ, "RERUN_ANALYTICS": "0"},
        start_new_session=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    if not stays:
        atexit.register(_end, viewer)
    return viewer


def _end(viewer: subprocess.Popen[bytes]) -> None:
    """End a viewer with what it has started: `rerun` is a wrapper around the real one."""
    if viewer.poll() is None:
        if hasattr(os, "killpg"):
            os.killpg(viewer.pid, signal.SIGTERM)
        else:
            viewer.terminate()
        viewer.wait(timeout=10)
