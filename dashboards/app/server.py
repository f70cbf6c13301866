"""`liex dashboard`: a study in the browser, a Flask app served from this machine by waitress.

Only requests with the token are answered (host and origin check, token cookie), and pages load
nothing from other sites (content security policy). An internal error gives one line on the terminal
and a message for the visitor.
"""

import hmac
import logging
import signal
import socket
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

import numpy as np
from flask import Flask, Response, abort, redirect, request
from jinja2 import StrictUndefined
from numpy.typing import NDArray
from waitress.server import create_server
from werkzeug.exceptions import HTTPException

from liex_lab.errors import LiexError, SessionError, printable
from liex_lab.runtime.processes import Ended
from liex_lab.scene.background import usual_depth
from liex_lab.sessions import Session

from ..figures.animals import DepthImages, Recent
from ..report.contact_sheet import png, png_uri, scene_marks, shade, svg_marks
from . import corrections, pages
from .data import StudyData
from .desk import Desk, Suggest


@dataclass(frozen=True)
class Scenes:
    """Depth images and facts of scenes.

    Attributes:
        data: the study.
        images: the depth images.
        regions: reads and writes the regions of recordings, see `make_app`.
    """

    data: StudyData
    images: DepthImages
    regions: Any

    def about(self, key: str) -> dict[str, Any]:
        """Facts for the page: image size, marks, and where a region can be saved.

        Raises:
            LiexError: there is no such recording, or it cannot be read.
        """
        session = self._session(key)
        facts = self.regions.about(key, session)
        camera = self.regions.depth_image(key)[1] if session is None else session.camera
        marks = [] if session is None else scene_marks(session)
        found = [
            {"kind": mark.kind, "label": mark.label, "points": mark.points_px.round(1).tolist()}
            for mark in marks
        ]
        size = {"width": camera.width, "height": camera.height}
        return {**facts, **size, "measured": session is not None, "marks": found}

    def save(self, key: str) -> Any:
        """Check and save the requested region or zone; returns the page's new facts.

        The request is JSON with corners (px), and place and was, or zone (name and part).

        Raises:
            LiexError: the region is invalid, or cannot be saved.
        """
        asked = request.get_json(silent=True)  # another site's form cannot send JSON
        if not isinstance(asked, dict):
            return {"message": "no region is saved here"}, 400
        place = str(asked.get("place"))[:40]
        corners, was = asked.get("corners"), asked.get("was")
        if isinstance(zone := asked.get("zone"), dict):
            name, part = (str(zone.get(one))[:40] for one in ("name", "part"))
            report = self.regions.save_zone(key, self._session(key), name, part, corners)
        else:
            report = self.regions.save(key, self._session(key), place, corners, was)
        self.data.refresh()
        return {**self.about(key), "saved": report}

    def image(self, key: str) -> Response:
        """PNG of the usual depth of a session; with ?of=recording, of its recording.

        Raises:
            LiexError: there is no such recording, or it cannot be read.
        """
        session = self._session(key)
        if session is None or request.args.get("of") == "recording":
            depth = self.regions.depth_image(key)[0]
        else:
            depth = self._usual(session)
        return Response(png(_shaded(depth)), mimetype="image/png")

    def scene(self, key: str) -> Response:
        """SVG of the usual depth of a session with its scene.

        Raises:
            SessionError: there is no such session.
        """
        session = self.data.session(key)
        return Response(scene_svg(session, self._usual(session)), mimetype="image/svg+xml")

    def _session(self, key: str) -> Session | None:
        """The results of the recording `key`; None if absent."""
        if key not in self.data.entries:
            raise SessionError(f"there is no recording '{key}'; see the list of sessions")
        return self.data.session(key) if key in {one.key for one in self.data.done} else None

    def _usual(self, session: Session) -> NDArray[np.uint16]:
        """(H, W) uint16 mm: the usual depth of the session's frames."""
        n = len(session.frames)
        # at most nine frames, for each pixel's usual depth
        rows = np.unique(np.linspace(0, n - 1, min(n, 9)).astype(int))
        depths = [self.images.depth(session, int(row)) for row in rows]
        empty = np.zeros((session.camera.height, session.camera.width), np.uint16)
        return usual_depth(np.stack([one for one in depths if one is not None] or [empty]))


def scene_svg(session: Session, depth: NDArray[np.uint16]) -> str:
    """The whole depth image of a session with its scene drawn over it.

    Args:
        session: the opened session.
        depth: (H, W) uint16 mm, 0 where unread.
    """
    h, w = depth.shape
    marks = svg_marks(scene_marks(session), 0, 0, w, h, w / 200.0)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {w} {h}" width="{w}" height="{h}">'
        f'<image href="{png_uri(_shaded(depth))}" width="{w}" height="{h}"/>{marks}</svg>'
    )


def _shaded(depth: NDArray[np.uint16]) -> NDArray[np.uint8]:
    """Colours over the full depth range of an image, including walls and rims."""
    read = depth[depth > 0]
    reach = float(np.ptp(np.percentile(read, [3.0, 95.0]))) if len(read) else 0.0
    return shade(depth, max(reach, 60.0))  # the least range, mm


LOOPBACK = ("127.0.0.1", "localhost", "::1")
MOST_BYTES = 4 << 20  # of a request's body; a correction has a few hundred bytes
_SAVER = "liex_saver"
_IDLE_S = 30  # browsers open connections before they need them; an idle one is closed
_COOKIE = "liex_dashboard"
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: "
    "blob:; connect-src 'self'; font-src 'self' data:; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)


def make_app(
    data: StudyData,
    *,
    token: str,
    alone: bool,
    show_replay: pages.ShowReplay | None,
    correct: corrections.Correct,
    report: corrections.Report,
    suggest: Suggest,
    reviews: Path,
    regions: Any,
    measuring: Any,
) -> Flask:
    """Make the dashboard of a study; `serve` serves it.

    Args:
        data: the study.
        token: required of every visitor; empty requires none.
        alone: only accept requests from this machine.
        show_replay: opens the replay of a .rrd at a time (s), or raises LiexError; None only shows
            the command.
        correct: adds corrections to the session in a folder, or undoes some.
        report: makes the report of the session in a folder again after a correction.
        suggest: finds the stretches of a session whose actions are least certain.
        reviews: folder of blinded reviews, created with the first one.
        regions: reads and writes the regions of recordings: `of_recordings`, whether recordings
            without results are available; `about(key, session)`, facts about a region;
            `save(key, session, place, corners, was)`, which saves corners (px) in a place that
            contained `was`; and `depth_image(key)`, the usual depth (mm) of every pixel, and the
            camera.
        measuring: lists and measures recordings below a folder: `listed(at)`, `start(verb, at,
            plan)`, `stop()` and `state()`. None measures none.
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
    images = DepthImages()
    kept = Recent(6)  # desks that stay in memory

    def desk_of(key: str) -> Desk:
        """The desk of a session, another one when the session changes."""
        session = data.session(key)
        return kept.get(key, id(session), partial(Desk, session, images, suggest))

    app.extensions[_SAVER] = saver = corrections.Saver(correct, report)
    shown = pages.Pages(data, desk_of, show_replay, regions.of_recordings, measuring)
    pages.add_handlers(app, shown)
    clerk = corrections.Clerk(desk_of, saver)
    scenes = Scenes(data, images, regions)
    raters = corrections.Reviews(data, desk_of, reviews)
    clip = "GET /reviews/<path:name>/clip/<int:number>"
    views: dict[str, Callable[..., Any]] = {
        "GET /": shown.sessions,
        "POST /refresh": shown.refresh,
        "GET /table": shown.requested_table,
        "GET /ethograms": shown.ethograms,
        "GET /groups": shown.groups,
        "GET /group-figure/<path:measure>.svg": shown.group_figure,
        "GET /review": shown.review,
        "GET /bench": shown.bench,
        "GET /bench/state": shown.bench_state,
        "GET /bench/done": shown.refresh,
        "POST /bench/start": shown.bench_start,
        "POST /bench/stop": shown.bench_stop,
        "GET /arena/<path:key>": shown.arena,
        "GET /session/<path:key>": shown.session,
        "GET /whole/<path:key>": shown.whole,
        "GET /moment/<path:key>": shown.moment,
        "GET /step/<path:key>": shown.step,
        "POST /replay/<path:key>": shown.replay,
        "GET /figure/<path:key>/<name>.svg": shown.figure,
        "GET /csv/<path:name>.csv": shown.csv,
        "GET /session-csv/<path:key>/<name>.csv": shown.session_csv,
        "GET /report/<path:key>": shown.report,
        "GET /desk/<path:key>/about": clerk.about,
        "GET /desk/<path:key>/times": clerk.times,
        "GET /desk/<path:key>/rows/<int:first>/<int:stop>": lambda key, first, stop: desk_of(
            key
        ).rows(first, stop),
        "GET /desk/<path:key>/bouts": lambda key: desk_of(key).bouts(),
        "GET /desk/<path:key>/doubts": clerk.doubts,
        "GET /desk/<path:key>/crossings": lambda key: desk_of(key).crossings(),
        "GET /desk/<path:key>/frame/<int:row>.png": clerk.frame,
        "GET /desk/<path:key>/state": clerk.state,
        "POST /desk/<path:key>/correct": clerk.correct,
        "GET /region/<path:key>/about": scenes.about,
        "GET /region/<path:key>/image.png": scenes.image,
        "GET /region/<path:key>/scene.svg": scenes.scene,
        "POST /region/<path:key>/save": scenes.save,
        "GET /reviews": raters.names,
        "POST /reviews": raters.begin,
        "GET /reviews/<path:name>/state": raters.state,
        "POST /reviews/<path:name>/answer": raters.answer,
        f"{clip}/about": raters.about,
        f"{clip}/times": raters.times,
        f"{clip}/rows/<int:start>/<int:end>": raters.rows,
        f"{clip}/frame/<int:row>.png": raters.frame,
    }
    for rule, view in views.items():
        method, path = rule.split(" ")
        app.add_url_rule(path, rule.replace(".", "-"), view, methods=[method])
    return app


def serve(app: Flask, host: str, port: int, report: Callable[[int], object]) -> None:
    """Serve until interrupted; requests and corrections in progress are then completed.

    Args:
        app: the dashboard.
        host: the address to listen on.
        port: the port; 0 uses any free one.
        report: called with the port once the server listens.

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
    # open at the same time; a browser opens six
    server = create_server(
        app,
        sockets=[listening],
        threads=12,
        connection_limit=256,
        channel_timeout=_IDLE_S,
        cleanup_interval=_IDLE_S,
        max_request_body_size=MOST_BYTES,
        asyncore_use_poll=True,
        ident=None,
    )
    loop = threading.Thread(target=server.run, daemon=True)
    loop.start()
    try:
        report(int(server.effective_port))
        loop.join()
    except KeyboardInterrupt:
        pass
    except Ended as ended:
        if ended.signal != signal.SIGINT:  # Ctrl-C ends it normally
            raise
    finally:
        server.task_dispatcher.shutdown()
        app.extensions[_SAVER].finish()


def address(host: str, port: int, token: str) -> str:
    """The address to open in a browser.

    Args:
        host: the address the server listens on; an unspecified address becomes this machine's name.
        port: its port.
        token: required of every visitor; may be empty.
    """
    shown = "127.0.0.1" if host in LOOPBACK else host
    # addresses to listen on that a browser cannot open
    if host in ("", "0.0.0.0", "::"):  # nosec B104: only compared with
        shown = socket.gethostname()
    return f"http://{f'[{shown}]' if ':' in shown else shown}:{port}/" + (
        f"?token={token}" if token else ""
    )


# Access


def guard(server: Flask, token: str, *, alone: bool = True) -> None:
    """Refuse unauthorised requests, and set the security headers of every response.

    A request without the token is refused, because other accounts of this machine can reach its
    loopback address. A request from another origin is refused, because it is a form of another site
    (CSRF). With `alone`, a request to another host name is refused as well (DNS rebinding).

    Args:
        server: the Flask server of the dashboard.
        token: required of every visitor; empty requires none.
        alone: only accept requests from this machine.
    """
    server.config["MAX_CONTENT_LENGTH"] = MOST_BYTES

    def refuse(reason: str, status: int) -> None:
        abort(Response(reason, status, mimetype="text/plain"))

    @server.before_request
    def allowed() -> Any:
        """Accept a request, or answer with 401, 403 or the cookie that carries the token."""
        name = _site(f"//{request.host}", name=True)
        if alone and name not in LOOPBACK:
            refuse("This dashboard answers on 127.0.0.1 only.", 403)
        origin = request.headers.get("Origin")
        if origin and _site(origin) != request.host:
            refuse("This dashboard takes no requests from other sites.", 403)
        if not token:
            return None
        # a host may have several dashboards, each with its own token
        _, _, port = request.host.rpartition(":")
        cookie = f"{_COOKIE}_{port}" if port.isdigit() else _COOKIE
        given = request.args.get("token", "")
        if given and hmac.compare_digest(given.encode(), token.encode()):
            rest = {name: value for name, value in request.args.items() if name != "token"}
            answer = redirect(request.path + ("?" + urlencode(rest) if rest else ""))
            # lax, so that the page written by --open sends the cookie at once
            answer.set_cookie(cookie, token, httponly=True, samesite="Lax")
            return answer
        if not hmac.compare_digest(request.cookies.get(cookie, "").encode(), token.encode()):
            refuse("Open the address that `liex dashboard` printed, with its token.", 401)
        return None

    @server.after_request
    def policies(response: Response) -> Response:
        """Set the security headers of a `response`; its own content policy is kept."""
        response.headers.setdefault("Content-Security-Policy", _POLICY)
        response.headers["X-Content-Type-Options"] = "nosniff"
        # not "no-referrer": a form would then be sent as if from another site
        response.headers["Referrer-Policy"] = "same-origin"
        return response

    @server.errorhandler(413)
    def too_large(_: HTTPException) -> Response:
        """The request is larger than any request of the dashboard's pages."""
        return Response(
            f"The dashboard takes at most {MOST_BYTES >> 20} MB at a time.",
            413,
            mimetype="text/plain",
        )

    @server.errorhandler(Exception)
    def fault(error: Exception) -> Any:
        """A request that no page makes, or an internal error."""
        if isinstance(error, HTTPException):
            return error
        cause = printable(f"{type(error).__name__}: {error}")[:300]
        where = printable(request.path)[:200]
        print(f"dashboard: {where} could not be answered ({cause})", file=sys.stderr)
        return Response(
            "This request cannot be answered; load the page again. The terminal shows the error.",
            500,
            mimetype="text/plain",
        )


def _site(address: str, name: bool = False) -> str | None:
    """Host and port of an address, or only the host name; None if the address is invalid."""
    try:
        found = urlsplit(address)
        return found.hostname if name else found.netloc
    except ValueError:
        return None
