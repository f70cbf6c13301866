"""Access control of the dashboard: host and origin check, token cookie, content security policy.

Only requests with the token are answered, and pages load nothing from other sites. An internal
error gives one line on the terminal and a message for the visitor.
"""

from __future__ import annotations

import hmac
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode, urlsplit

from flask import Flask, Response, abort, redirect, request, stream_with_context
from werkzeug.exceptions import HTTPException

from liex_lab.errors import LiexError, printable

from . import tables
from .data import StudyData

if TYPE_CHECKING:
    import pandas as pd

LOOPBACK = ("127.0.0.1", "localhost", "::1")
MOST_BYTES = 4 << 20  # of a request's body; a correction has a few hundred bytes
_COOKIE = "liex_dashboard"
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: "
    "blob:; connect-src 'self'; font-src 'self' data:; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
# a report needs no script
_REPORT = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"


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
    _answer_faults(server)

    @server.before_request
    def allowed() -> Any:
        """Accept a request, or answer with 401, 403 or the cookie that carries the token."""
        name = _site(f"//{request.host}", name=True)
        if alone and name not in LOOPBACK:
            abort(Response("This dashboard answers on 127.0.0.1 only.", 403, mimetype="text/plain"))
        origin = request.headers.get("Origin")
        if origin and _site(origin) != request.host:
            abort(
                Response(
                    "This dashboard takes no requests from other sites.", 403, mimetype="text/plain"
                )
            )
        if not token:
            return None
        told = request.args.get("token", "")
        if told and hmac.compare_digest(told.encode(), token.encode()):
            rest = {name: value for name, value in request.args.items() if name != "token"}
            answer = redirect(request.path + ("?" + urlencode(rest) if rest else ""))
            # lax, so that the page written by --open sends the cookie at once
            answer.set_cookie(_cookie(), token, httponly=True, samesite="Lax")
            return answer
        if not hmac.compare_digest(request.cookies.get(_cookie(), "").encode(), token.encode()):
            said = "Open the address that `liex dashboard` printed, with its token."
            abort(Response(said, 401, mimetype="text/plain"))
        return None

    @server.after_request
    def policies(response: Response) -> Response:
        """Set the security headers of a `response`; its own content policy is kept."""
        response.headers.setdefault("Content-Security-Policy", _POLICY)
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        return response


def _cookie() -> str:
    """The cookie's name with the port: a host may have several dashboards, each with its own
    token.
    """
    _, _, port = request.host.rpartition(":")
    return f"{_COOKIE}_{port}" if port.isdigit() else _COOKIE


def _answer_faults(server: Flask) -> None:
    """Answer failed requests with a message, and print one line on the terminal."""

    @server.errorhandler(413)
    def too_large(_: HTTPException) -> Response:
        """The request is larger than any request of the dashboard's pages."""
        said = f"The dashboard takes at most {MOST_BYTES >> 20} MB at a time."
        return Response(said, 413, mimetype="text/plain")

    @server.errorhandler(Exception)
    def fault(error: Exception) -> Any:
        """A request that no page makes, or an internal error."""
        if isinstance(error, HTTPException):
            return error
        told = printable(f"{type(error).__name__}: {error}")[:300]
        where = printable(request.path)[:200]
        print(f"dashboard: {where} could not be answered ({told})", file=sys.stderr)
        said = "This request cannot be answered; load the page again. The terminal says why."
        return Response(said, 500, mimetype="text/plain")


def _site(address: str, name: bool = False) -> str | None:
    """Host and port of an address, or only the host name; None if the address is invalid."""
    try:
        found = urlsplit(address)
        return found.hostname if name else found.netloc
    except ValueError:
        return None


def add_downloads(server: Flask, data: StudyData) -> None:
    """Add the routes of tables as CSV, and of sessions' reports."""

    @server.get("/csv/<path:name>.csv")
    def table_csv(name: str) -> Response:
        """A table as shown, by its `name`, see `tables.find`."""
        return _csv(lambda: tables.find(data, name).rows, name.replace("/", "_").strip("_"))

    @server.get("/session-csv/<path:key>/<name>.csv")
    def session_csv(key: str, name: str) -> Response:
        """The whole table `name` of the session `key`."""
        return _csv(lambda: tables.session_table(data, key, name), f"{key}_{name}")

    @server.get("/report/<path:key>")
    def report(key: str) -> Response:
        """The report of the session `key`; its content policy allows no script."""
        try:
            folder = data.session(key).path.resolve()
            file = (folder / "report.html").resolve()
            if file.parent != folder:  # a link to another folder
                raise FileNotFoundError(file)
            page = file.read_text(encoding="utf-8")
        except (LiexError, OSError, ValueError):
            return Response("This session has no report.", 404, mimetype="text/plain")
        answer = Response(page, mimetype="text/html")
        answer.headers["Content-Security-Policy"] = _REPORT
        return answer


def _csv(find: Callable[[], pd.DataFrame], name: str) -> Response:
    try:
        rows = find()
    except LiexError as error:
        return Response(str(error), 404, mimetype="text/plain")
    pieces: Iterator[str] = tables.as_csv(rows)
    safe = (
        "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in name) or "table"
    )
    answer = Response(stream_with_context(pieces), mimetype="text/csv")
    answer.headers["Content-Disposition"] = f'attachment; filename="{safe}.csv"'
    return answer
