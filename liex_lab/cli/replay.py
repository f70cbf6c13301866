"""The verb `liex show`: a session's replay in Rerun, with whole depth pictures where asked for."""

from __future__ import annotations

import os
import socket
import subprocess
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import quote

import typer

from liex_lab.cli.options import SessionPath, say
from liex_lab.errors import LiexError
from liex_lab.runtime.progress import progress_bar

_HERE = "127.0.0.1"


def show(
    session: SessionPath,
    web: Annotated[
        bool,
        typer.Option(
            "--web", help="Open it in the browser; Rerun's viewer there calls tel.rerun.io."
        ),
    ] = False,
    at_s: Annotated[
        float | None, typer.Option("--at", metavar="S", min=0.0, help="Open it at this time.")
    ] = None,
    depth: Annotated[
        Literal["kept", "all"],
        typer.Option("--depth", help="all: whole depth pictures, read from the recording."),
    ] = "kept",
    recording: Annotated[
        str | None,
        typer.Option(
            "--recording", metavar="FILE", help="The recording, for --depth all if it has moved."
        ),
    ] = None,
) -> None:
    """Open a session's replay in Rerun."""
    from liex_lab.sessions import Session
    from liex_lab.sessions.viewer import has_screen

    if web and at_s is not None:
        raise typer.BadParameter("a moment can be shown in a window only; leave out --web or --at")
    if recording is not None and depth != "all":
        raise typer.BadParameter("a recording is read for whole pictures only; add --depth all")
    replay = Session.open(session).path / "session.rrd"
    if at_s is None and not web and not has_screen():
        raise LiexError(
            f"Rerun needs a screen and there is none here; open {replay} on a computer with a "
            "screen, or add --web"
        )
    with tempfile.TemporaryDirectory(prefix="liex-show-") as scratch:
        more = [] if depth == "kept" else _whole_depth(session, Path(scratch), recording)
        _show(replay, more, at_s, web)


def _whole_depth(session: Path, scratch: Path, recording: str | None) -> list[Path]:
    """A replay of a session's whole depth pictures; none, said, where its recording is gone."""
    from liex_lab.pipelines.show import whole_pictures

    try:
        with progress_bar() as progress:
            return [whole_pictures(session, scratch / "depth.rrd", recording, progress)]
    except LiexError as error:
        say(f"note: {error}")
        say("note: the replay shows what the session keeps of the depth")
        return []


def _show(replay: Path, more: list[Path], at_s: float | None, web: bool) -> None:
    """Open a replay and wait until its viewer is closed."""
    from liex_lab.runtime.processes import own_python
    from liex_lab.sessions.viewer import replays_with, show_replay

    if at_s is not None:
        show_replay(replay, at_s, more).wait()
        return
    # RERUN_ANALYTICS: what a laboratory looks at is nobody else's business; the viewer in a browser
    # does not heed it
    hosted: list[str] = []
    if web:
        say(
            "Rerun's viewer in the browser calls tel.rerun.io, its makers' count of uses; the "
            "window does not"
        )
        page, data = _free_ports(2)
        source = quote(f"rerun+http://{_HERE}:{data}/proxy", safe="")
        say(f"replay: http://{_HERE}:{page}?url={source}   (Ctrl+C ends it)")
        hosted = ["--web-viewer", "--web-viewer-port", str(page), "--port", str(data)]
    shown = [str(file) for file in replays_with(replay, more)]
    command = own_python("-m", "rerun", *shown, "--bind", _HERE, *hosted)
    quiet = {"RUST_LOG": "warn"} if web else {}  # its own lines would hide the address
    around = {**quiet, **os.environ, "RERUN_ANALYTICS": "0"}
    raise typer.Exit(subprocess.run(command, env=around, check=False).returncode)


def _free_ports(n: int) -> list[int]:
    """Ports of this machine that nobody listens at."""
    with ExitStack() as held:
        sockets = [held.enter_context(socket.socket()) for _ in range(n)]
        for one in sockets:
            one.bind((_HERE, 0))
        return [int(one.getsockname()[1]) for one in sockets]
