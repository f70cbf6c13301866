"""A session written by a process of its own, which may be killed at any moment and started
again.
"""

import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from tests.sessions.walking_mouse import WalkingMouse, steady

MOUSE = WalkingMouse(steady(8.0), rear_s=(1.0, 2.0), lost=(20, 21))
CHUNK = 16
_PRELOADED = [
    "pandas",
    "rerun",
    "foxglove",
    "cv2",
    "pyarrow.parquet",
    "tests.sessions.walking_mouse",
    "liex_lab.sessions.rrd",
    "liex_lab.sessions.mcap",
    "liex_lab.behaviour",
]


def write_session(place: str, pause_s: float = 0.0, every_s: float = 0.0) -> None:
    """Write the session, or go on writing it; pause_s: after each chunk, for the work itself takes
    no time.
    """
    from liex_lab.sessions import checkpoint

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint, "EVERY_S", every_s)
        _write(place, pause_s)


def _write(place: str, pause_s: float) -> None:
    from liex_lab import behaviour
    from liex_lab.sessions import SessionWriter
    from liex_lab.tracking.track import Track

    with SessionWriter(place, MOUSE.provenance(), overwrite=True) as writer:
        writer.resume(lambda row: MOUSE.frame(row).depth)
        for frames, track in MOUSE.chunks(CHUNK):
            if frames[0].index >= writer.n_frames:
                writer.add(frames, observations=track)
                time.sleep(pause_s)
        writer.track = writer.observations(Track)
        writer.close(**behaviour.measure_rows(writer.rows).for_session())


def start(place: Path, pause_s: float = 0.0, every_s: float = 0.0) -> BaseProcess:
    """A process that writes the session."""
    return forked(write_session, str(place), pause_s, every_s)


def forked(work: Callable[..., object], *arguments: object) -> BaseProcess:
    """A process forked off a server that has everything imported, and no threads."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    process = context.Process(target=work, args=arguments)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RUST_LOG", "off")  # of the server, when it is started
        process.start()
    return process
