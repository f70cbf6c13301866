"""`liex dashboard`: a study in the browser, a Dash app served from this machine.

Nothing is loaded from anywhere else: the content security policy allows this server alone.
"""

from __future__ import annotations

import logging
import signal
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote

from dash import ALL, MATCH, ClientsideFunction, Dash, Input, Output, State, dcc, html

from liex_lab.errors import LiexError
from liex_lab.runtime.processes import Ended

from . import (
    page_corrections,
    page_groups,
    page_region,
    page_review,
    page_session,
    page_study,
    tables,
)
from .data import StudyData
from .desk import Desks, Suggest
from .desk_routes import Clerk, add_routes
from .frames import Frames
from .guard import LOOPBACK, add_downloads, guard
from .page_session import ShowReplay
from .parts import aria
from .saver import Correct, Report, Saver

_ASSETS = Path(__file__).parent / "assets"
_PAGES = (
    ("/", "Sessions"),
    ("/ethograms", "Ethograms"),
    ("/groups", "Groups"),
    ("/review", "Review"),
)
_INDEX = """<!doctype html>
<html lang="en">
<head>{%metas%}<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{%title%}</title>
<script type="module" async src="/assets/desk_ahead.mjs"></script>{%css%}</head>
<body>{%app_entry%}<footer hidden>{%config%}{%scripts%}{%renderer%}</footer></body>
</html>"""
_SAVER = "liex_saver"
# addresses to listen on that nobody can open
_EVERYWHERE = ("", "0.0.0.0", "::")  # nosec B104: told apart, not listened on
_POLICY = (
    "default-src 'none'; script-src 'self' {hashes}; style-src 'self' 'unsafe-inline'; img-src "
    "'self' data: blob:; connect-src 'self'; font-src 'self' data:; base-uri 'none'; form-action "
    "'self'; frame-ancestors 'none'"
)


def make_app(
    data: StudyData,
    *,
    token: str = "",
    alone: bool = True,
    show_replay: ShowReplay | None = None,
    correct: Correct | None = None,
    report: Report | None = None,
    suggest: Suggest | None = None,
    reviews: Path | None = None,
    regions: page_region.Regions | None = None,
) -> Dash:
    """The dashboard of a study, not yet served.

    Args:
        data: the study.
        token: what every visitor has to know; empty asks for none.
        alone: only this machine is answered.
        show_replay: opens the replay of a .rrd at a time (s), or raises LiexError; None: only the
            command is shown.
        correct: adds corrections to the session in a folder, or takes some back; None: the pages
            only show.
        report: makes the report of the session in a folder again, after it was corrected; None
            where `correct` does.
        suggest: finds the stretches of a session whose actions are least certain; None finds none.
        reviews: folder of blinded reviews, made with the first one; None takes none.
        regions: states the regions of arenas in plans; None states none.
    """
    app = Dash(
        "liex_lab_dashboard",
        assets_folder=str(_ASSETS),
        assets_ignore=r".*\.mjs$",  # modules are fetched by whoever imports them
        serve_locally=True,
        suppress_callback_exceptions=True,
        title=f"{data.name} · liex_lab",
        update_title="",
        index_string=_INDEX,
        add_log_handler=False,
        compress=False,
    )
    app.layout = _shell(data)
    beyond = regions is not None and regions.of_recordings
    _register(app, data, may_correct=correct is not None, beyond=beyond)
    page_study.register(app, data)
    page_groups.register(app, data)
    page_session.register(app, data, show_replay)
    saver = Saver(correct, report) if correct is not None else None
    page_region.register(app)
    frames = Frames()
    desks = Desks(data.session, frames, suggest)
    if saver is not None:
        page_corrections.register(app, data, saver)
    app.server.extensions[_SAVER] = saver
    hashes: list[str] = []

    def policy() -> str:
        if not hashes:
            hashes.extend(f"'{one.strip(chr(39))}'" for one in app.csp_hashes())
        return _POLICY.format(hashes=" ".join(hashes))

    guard(app.server, token, policy, alone=alone)
    add_downloads(app.server, data)
    add_routes(app.server, desks, None if saver is None else Clerk(desks, saver))
    page_region.add_scenes(app.server, data, frames, regions)
    if reviews is not None:
        page_review.register(app)
        page_review.add_reviews(app.server, page_review.Reviews(data, desks, reviews))
    return app


def serve(app: Dash, host: str, port: int, told: Callable[[int], None]) -> None:
    """Serve until interrupted.

    Args:
        app: the dashboard.
        host: the address to listen on.
        port: the port; 0 takes any that is free.
        told: hears the port once the server listens.

    Raises:
        LiexError: the server cannot listen there.
    """
    from .listener import Listener

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    try:
        server = Listener(host, port, app.server)
    except (OSError, SystemExit) as error:
        why = getattr(error, "strerror", None) or "in use"
        raise LiexError(
            f"the dashboard cannot listen on {host}, port {port} ({why}); name another with "
            "--port, or 0 for any that is free"
        ) from None
    told(int(server.server_port))
    try:
        server.serve_forever()
    except KeyboardInterrupt:
        pass
    except Ended as ended:
        if ended.signal != signal.SIGINT:  # Ctrl-C is the way to end it
            raise
    finally:
        server.server_close()
        saver: Saver | None = app.server.extensions.get(_SAVER)
        if saver is not None:
            saver.finish()  # what was taken is saved


def address(host: str, port: int, token: str) -> str:
    """What to type into a browser.

    Args:
        host: the address the server listens on; for all of this machine's, its name is shown.
        port: its port.
        token: what every visitor has to know; may be empty.
    """
    shown = "127.0.0.1" if host in LOOPBACK else host
    if host in _EVERYWHERE:
        shown = socket.gethostname()
    return f"http://{f'[{shown}]' if ':' in shown else shown}:{port}/" + (
        f"?token={token}" if token else ""
    )


def _shell(data: StudyData) -> html.Div:
    links = [dcc.Link(title, href=href, id={"part": "tab", "href": href}) for href, title in _PAGES]
    return html.Div(
        [
            dcc.Location(id="url", refresh="callback-nav"),
            html.A("Skip to the content", href="#page", className="skip"),
            html.Header(
                html.Div(
                    [
                        html.Span("liex_lab", className="brand"),
                        html.Nav(links, **aria(label="pages")),
                    ],
                    className="bar",
                )
            ),
            html.Main(id="page", tabIndex=-1),
        ]
    )


def _page(
    data: StudyData, path: str, search: str, *, beyond: bool = False, **may: bool
) -> list[Any]:
    try:
        if path in ("", "/"):
            return page_study.sessions_page(data)
        if path == "/ethograms":
            return page_study.ethograms_page(data)
        if path == "/review":
            return page_review.review_page(data)
        if path == "/groups":
            return page_groups.groups_page(data)
        if path.startswith("/session/"):
            key = unquote(path.removeprefix("/session/"))
            if key not in {entry.key for entry in data.done}:
                more = page_region.not_measured(data, key) if beyond else []
                return [*page_session.failed_page(data, key), *more]
            return page_session.session_page(data, key, _moment(search), **may)
        if path.startswith("/arena/"):
            return page_region.arena_page(data, unquote(path.removeprefix("/arena/")))
    except LiexError as error:
        return [html.H1("This cannot be shown"), html.P(str(error))]
    return [html.H1("No such page"), html.P(dcc.Link("Sessions", href="/"))]


def _moment(search: str) -> float:
    try:
        at_s = float(parse_qs(search.removeprefix("?")).get("t", ["0"])[0])
    except ValueError:
        return 0.0
    return at_s if 0.0 <= at_s < 1e9 else 0.0


def _register(app: Dash, data: StudyData, **may: bool) -> None:
    """The pages themselves, and the sorting and filtering of every table."""

    @app.callback(
        Output("page", "children"),
        Output({"part": "tab", "href": ALL}, "className"),
        Input("url", "pathname"),
        Input("url", "search"),
        State({"part": "tab", "href": ALL}, "id"),
    )
    def route(
        path: str | None, search: str | None, tabs: list[dict[str, str]]
    ) -> tuple[Any, list[str]]:
        here = "/" if (path or "/").startswith(("/session", "/arena")) else path or "/"
        marks = ["here" if tab["href"] == here else "" for tab in tabs]
        return _page(data, path or "/", search or "", **may), marks

    @app.callback(
        Output({"part": "cells", "table": MATCH}, "data"),
        Input({"part": "filter", "table": MATCH}, "value"),
        Input({"part": "order", "table": MATCH}, "data"),
        State({"part": "filter", "table": MATCH}, "id"),
    )
    def fill(words: str | None, order: dict[str, Any], asked: dict[str, str]) -> Any:
        name = asked["table"]
        try:
            return tables.fill(name, tables.find(data, name), words or "", order)
        except LiexError as error:
            return tables.sentence(name, str(error))

    app.clientside_callback(
        ClientsideFunction("liex", "draw"),
        Output({"part": "rows", "table": MATCH}, "className"),
        Input({"part": "cells", "table": MATCH}, "data"),
    )
