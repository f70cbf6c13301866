"""`liex dashboard`: a study in the browser, a Flask app served from this machine by waitress.

The content security policy allows no other source than this server.
"""

from __future__ import annotations

import logging
import signal
import socket
import threading
from collections.abc import Callable
from pathlib import Path

from flask import Flask
from jinja2 import StrictUndefined
from waitress.server import create_server

from liex_lab.errors import LiexError
from liex_lab.runtime.processes import Ended

from . import page_region, page_review, pages
from .data import StudyData
from .desk import Desks, Suggest
from .desk_routes import Clerk, add_routes
from .frames import Frames
from .guard import LOOPBACK, MOST_BYTES, add_downloads, guard
from .saver import Correct, Report, Saver

_SAVER = "liex_saver"
_IDLE_S = 30  # browsers open connections before they need them; an idle one is closed
_CONNECTIONS = 256  # open at the same time; a browser opens six
_THREADS = 12
# addresses to listen on that a browser cannot open
_EVERYWHERE = ("", "0.0.0.0", "::")  # nosec B104: only compared with


def make_app(
    data: StudyData,
    *,
    token: str = "",
    alone: bool = True,
    show_replay: pages.ShowReplay | None = None,
    correct: Correct | None = None,
    report: Report | None = None,
    suggest: Suggest | None = None,
    reviews: Path | None = None,
    regions: page_region.Regions | None = None,
) -> Flask:
    """Make the dashboard of a study; `serve` serves it.

    Args:
        data: the study.
        token: required of every visitor; empty requires none.
        alone: only accept requests from this machine.
        show_replay: opens the replay of a .rrd at a time (s), or raises LiexError; None only shows
            the command.
        correct: adds corrections to the session in a folder, or undoes some; None makes the pages
            read-only.
        report: makes the report of the session in a folder again after a correction; None if
            `correct` does.
        suggest: finds the stretches of a session whose actions are least certain; None finds none.
        reviews: folder of blinded reviews, created with the first one; None accepts none.
        regions: writes the regions of arenas to plans; None writes none.
    """
    app = Flask(
        "liex_lab_dashboard",
        root_path=str(Path(__file__).parent),
        static_folder="assets",
        static_url_path="/assets",
    )
    app.jinja_env.undefined = StrictUndefined
    app.jinja_env.trim_blocks = app.jinja_env.lstrip_blocks = True
    guard(app, token, alone=alone)
    frames = Frames()
    desks = Desks(data.session, frames, suggest)
    saver = Saver(correct, report) if correct is not None else None
    app.extensions[_SAVER] = saver
    pages.add_pages(
        app,
        data,
        desks,
        show_replay,
        may_correct=saver is not None,
        of_recordings=regions is not None and regions.of_recordings,
    )
    add_downloads(app, data)
    add_routes(app, desks, None if saver is None else Clerk(desks, saver))
    page_region.add_scenes(app, data, frames, regions)
    if reviews is not None:
        page_review.add_reviews(app, page_review.Reviews(data, desks, reviews))
    return app


def serve(app: Flask, host: str, port: int, told: Callable[[int], None]) -> None:
    """Serve until interrupted; requests and corrections in progress are then completed.

    Args:
        app: the dashboard.
        host: the address to listen on.
        port: the port; 0 uses any free one.
        told: called with the port once the server listens.

    Raises:
        LiexError: the server cannot listen there.
    """
    logging.getLogger("waitress").setLevel(logging.ERROR)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listening = socket.create_server((host, port), family=family)
    except OSError as error:
        raise LiexError(
            f"the dashboard cannot listen on {host}, port {port} ({error.strerror or error}); name "
            "another with --port, or 0 for any that is free"
        ) from None
    server = create_server(
        app,
        sockets=[listening],
        threads=_THREADS,
        connection_limit=_CONNECTIONS,
        channel_timeout=_IDLE_S,
        cleanup_interval=_IDLE_S,
        max_request_body_size=MOST_BYTES,
        asyncore_use_poll=True,
        ident=None,
    )
    loop = threading.Thread(target=server.run, daemon=True)
    loop.start()
    try:
        told(int(server.effective_port))
        loop.join()
    except KeyboardInterrupt:
        pass
    except Ended as ended:
        if ended.signal != signal.SIGINT:  # Ctrl-C ends it normally
            raise
    finally:
        server.task_dispatcher.shutdown()
        saver: Saver | None = app.extensions[_SAVER]
        if saver is not None:
            saver.finish()


def address(host: str, port: int, token: str) -> str:
    """The address to open in a browser.

    Args:
        host: the address the server listens on; an unspecified address becomes this machine's name.
        port: its port.
        token: required of every visitor; may be empty.
    """
    shown = "127.0.0.1" if host in LOOPBACK else host
    if host in _EVERYWHERE:
        shown = socket.gethostname()
    return f"http://{f'[{shown}]' if ':' in shown else shown}:{port}/" + (
        f"?token={token}" if token else ""
    )
