"""The dashboard's page of one session at one moment: picture, numbers, curves and replay."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from dash import (
    ALL,
    ClientsideFunction,
    Dash,
    Input,
    Output,
    State,
    ctx,
    dcc,
    html,
    no_update,
)

from liex_lab.behaviour.body import logged_of
from liex_lab.errors import LiexError, SessionError

from ..report.charts import traces
from ..report.quality import warnings
from ..units import counted, shown
from . import page_corrections, page_region, plots
from .data import StudyData, colours_of, shown_words
from .parts import aria, download, graph
from .tables import block, number, session_address, session_tables

if TYPE_CHECKING:
    from liex_lab.sessions import Session

ShowReplay = Callable[[Path, float], object]
_STEPS = (
    ("frame", -1, "◀ frame"),
    ("frame", 1, "frame ▶"),
    ("bout", -1, "◀ bout"),
    ("bout", 1, "bout ▶"),
    ("flag", -1, "◀ flagged"),
    ("flag", 1, "flagged ▶"),
)
_HALF_S = 4.0
_FACTS = (
    ("frame_index", "frame", ""),
    ("time_s", "time", "s"),
    ("flag", "flag", ""),
    ("predicted_error_mm", "error to be expected", "mm"),
    ("p_flip", "head and tail exchanged, p", ""),
    ("gap_before", "frames missing before", ""),
    ("zone", "zone", ""),
)
_MOVED = (("heading_rad", "heading", "rad"), ("length_mm", "length", "mm"))


def session_page(
    data: StudyData,
    key: str,
    at_s: float,
    *,
    may_correct: bool,
) -> list[Any]:
    """Content of a session's page at a moment.

    Args:
        data: the study.
        key: the session's name in the study.
        at_s: the moment, s since its first frame.
        may_correct: whether there is a form for corrections.

    Raises:
        SessionError: the session cannot be opened.
    """
    session = data.session(key)
    entry = data.entries[key]
    who = ", ".join(
        f"{name.replace('_', ' ')} {value}" for name, value in entry.who.items() if value
    )
    frames = session.metadata["frames"]
    size = plots.time_unit(float(frames["duration_s"]))[1]
    said = [html.Li(sentence) for sentence in warnings(session)]
    return [
        html.P(
            [dcc.Link("Sessions", href="/"), " / ", entry.who.get("group") or "session"],
            className="kind",
        ),
        html.Div(
            className="title",
            children=[
                html.H1(key),
                html.P(
                    f"{who + ' · ' if who else ''}{frames['n_frames']:,} frames, "
                    f"{frames['duration_s']:.1f} s",
                    className="muted",
                ),
            ],
        ),
        *(
            [
                html.Details(
                    [html.Summary(f"{counted(len(said), 'thing')} to know first"), html.Ul(said)],
                    className="problems",
                )
            ]
            if said
            else []
        ),
        dcc.Store(id="session-key", data=key),
        dcc.Store(id="session-unit-s", data=size),
        dcc.Store(id="corrections-made", data=""),
        _steps(at_s),
        html.Div(id="desk", className="desk", role="region", **aria(label="look and correct")),
        html.Div(html.P("The curves follow ...", className="muted"), id="session-figures"),
        *([page_corrections.panel(session)] if may_correct else []),
        *page_region.scene_panel(key, session),
        html.H2("Bouts"),
        block(f"bouts/{key}", "Bouts of the session"),
        *_more(data, key, session),
    ]


def _figures(data: StudyData, key: str, at_s: float, may_show: bool) -> list[Any]:
    """What comes after the first picture, for it keeps a browser busy: curves, numbers, replay."""
    whole = _whole(data, key, data.session(key), at_s)
    return [
        html.H2("The whole session"),
        html.P("A click goes to that moment.", className="muted"),
        graph("whole", whole, "actions, speed and predicted error over the whole session"),
        html.Div(
            className="pair moment",
            children=[
                html.Div([html.H3("This frame"), html.Dl(id="frame-facts", className="facts")]),
                html.Div(
                    [
                        graph(
                            "around",
                            plots.empty("Reading the frames ...", 380),
                            "curves around the moment",
                        ),
                        _replay(may_show),
                    ]
                ),
            ],
        ),
    ]


def _whole(data: StudyData, key: str, session: Session, at_s: float) -> dict[str, Any]:
    """The figure of the whole session, marked at a moment."""
    one = data.ethograms([key]).get(key)
    if one is None:
        raise SessionError(f"the bouts of '{key}' cannot be read; {data.damage(key)}")
    coloured = colours_of(shown_words([one]), one.vocabulary)
    return plots.whole_session(one, coloured, traces(session), at_s)


def failed_page(data: StudyData, key: str) -> list[Any]:
    """What there is to say of a session that was not measured.

    Args:
        data: the study.
        key: the session's name in the study; one that the study does not have is named so.
    """
    entry = data.entries.get(key)
    if entry is None:
        return [
            html.H1("No such session"),
            html.P(["The study has no session of this name. ", dcc.Link("All sessions", href="/")]),
        ]
    said = "; ".join(filter(None, (entry.reason, entry.remedy))) or "it has not been measured yet"
    return [
        html.P(dcc.Link("Sessions", href="/"), className="kind"),
        html.H1(key),
        html.P([html.Span(entry.state, className=f"state is-{entry.state}"), f" {said}"]),
    ]


def _steps(at_s: float) -> html.Div:
    buttons = [
        html.Button(
            label,
            id={"part": "step", "by": by, "to": to},
            n_clicks=0,
            type="button",
            title=(
                f"{'next' if to > 0 else 'previous'} {'frame with a flag' if by == 'flag' else by}"
            ),
        )
        for by, to, label in _STEPS
    ]
    time = html.Label(
        [
            html.Span("Moment, s "),
            dcc.Input(id="moment", type="number", value=at_s, step="any", debounce=True),
        ]
    )
    return html.Div(
        [time, *buttons, html.Span(id="moment-link")],
        className="tools stick",
        role="toolbar",
        **aria(label="go through the frames"),
    )


def _replay(may_show: bool) -> html.Div:
    button = html.Button(
        "Open the replay here",
        id="open-replay",
        n_clicks=0,
        type="button",
        className="main",
        disabled=not may_show,
    )
    return html.Div(
        className="replay",
        children=[
            html.H3("Replay"),
            button if may_show else html.Div(button, hidden=True),
            html.P(
                [
                    "Or in a terminal: ",
                    html.Code(id="replay-command"),
                    " ",
                    dcc.Clipboard(
                        target_id="replay-command", title="copy the command", className="copy"
                    ),
                ]
            ),
            html.P(id="replay-said", className="muted", role="status"),
        ],
    )


def _more(data: StudyData, key: str, session: Session) -> list[Any]:
    links = [
        html.Li(download(f"{name}.csv", f"/session-csv/{quote(key, safe='')}/{name}.csv", ""))
        for name in session_tables(data, key)
    ]
    report = (
        [
            html.A(
                "The session's report",
                href=f"/report/{quote(key, safe='')}",
                target="_blank",
                className="button",
            )
        ]
        if (session.path / "report.html").is_file()
        else []
    )
    return [
        html.Div(
            className="pair",
            children=[
                html.Div(
                    [html.H2("Gaps"), block(f"gaps/{key}", "Gaps of the session", searched=False)]
                ),
                html.Div(
                    [
                        html.H2("Head and tail perhaps exchanged"),
                        block(f"flips/{key}", "Flips", searched=False),
                    ]
                ),
            ],
        ),
        html.H2("Every table"),
        html.P(report),
        html.Ul(links, className="files"),
    ]


def nearest_row(session: Session, at_s: float) -> int:
    """Row of the frame whose time is nearest.

    Args:
        session: the opened session.
        at_s: the moment, s since its first frame.
    """
    return int(np.abs(session.frames["time_s"].to_numpy(float) - at_s).argmin())


def moved_to(session: Session, at_s: float, by: str, to: int) -> float:
    """Time of the next or previous frame, bout or flagged frame, s; `at_s` where there is none.

    Args:
        session: the opened session.
        at_s: the moment, s since its first frame.
        by: frame, bout or flag.
        to: 1 for the next, -1 for the previous.
    """
    time_s = session.frames["time_s"].to_numpy(float)
    row = nearest_row(session, at_s)
    if by == "frame":
        return float(time_s[min(max(row + to, 0), len(time_s) - 1)])
    places = (
        session.bouts["start_s"].to_numpy(float)
        if by == "bout"
        else time_s[(session.frames["flag"].fillna("") != "").to_numpy()]
    )
    beyond = places[places > at_s + 1e-4] if to > 0 else places[places < at_s - 1e-4]
    return at_s if not len(beyond) else float(beyond.min() if to > 0 else beyond.max())


def facts(session: Session, row: int) -> list[Any]:
    """The numbers of one frame, as a list of what and how much.

    Args:
        session: the opened session.
        row: the frame's row in the table `frames`.
    """
    frame = session.frames.iloc[row]
    known = [(title, frame[name], unit) for name, title, unit in _FACTS if name in frame]
    if session.has("kinematics.parquet"):
        moved = session.kinematics.iloc[row]
        measured = [
            (one.column, one.title.lower(), one.unit)
            for one in logged_of(session.metadata["animal"])
        ]
        known += [
            (title, *shown(moved[name], unit))
            for name, title, unit in (*measured, *_MOVED)
            if name in moved
        ]
    bouts = session.bouts
    now = bouts[(bouts["start_s"] <= frame["time_s"]) & (frame["time_s"] < bouts["stop_s"])]
    action = ", ".join(str(word).replace("_", " ") for word in now["action"]) or "unlabelled"
    items: list[Any] = [html.Dt("action"), html.Dd(action)]
    for title, value, unit in known:
        told = f"{value:.3f}" if title == "time" else number(value)
        if told not in ("", "nan"):
            items += [html.Dt(title), html.Dd(f"{told} {unit if told != '–' else ''}".strip())]
    return items


def register(app: Dash, data: StudyData, show_replay: ShowReplay | None) -> None:
    """Register what happens on a session's page.

    Args:
        app: the dashboard.
        data: the study.
        show_replay: opens the replay of a .rrd at a time (s); None where it cannot be opened from
            here.
    """

    @app.callback(
        Output("moment", "value"),
        Input("whole", "clickData"),
        Input("around", "clickData"),
        Input({"part": "step", "by": ALL, "to": ALL}, "n_clicks"),
        State("moment", "value"),
        State("session-key", "data"),
        State("session-unit-s", "data"),
        prevent_initial_call=True,
    )
    def move(
        whole: Any, around: Any, _steps: Any, at_s: float | None, key: str, unit_s: float
    ) -> Any:
        """The new moment, s, after a click on a figure or a button.

        Args:
            whole: plotly's click on the curves of the whole session.
            around: plotly's click on the curves around the moment.
            _steps: numbers of clicks on the buttons.
            at_s: the present moment, s.
            key: the session's name in the study.
            unit_s: seconds per unit of the whole session's axis.
        """
        asked = ctx.triggered_id
        if not ctx.triggered[0]["value"]:
            return no_update
        if asked == "whole":
            return round(float(whole["points"][0]["x"]) * unit_s, 4)
        if asked == "around":
            return round(float(around["points"][0]["x"]), 4)
        return round(moved_to(data.session(key), at_s or 0.0, asked["by"], int(asked["to"])), 4)

    @app.callback(
        Output("around", "figure"),
        Output("frame-facts", "children"),
        Output("replay-command", "children"),
        Input("moment", "value"),
        Input("corrections-made", "data"),
        State("session-key", "data"),
    )
    def follow(at_s: float | None, _made: str, key: str) -> tuple[Any, ...]:
        """What is read of a session to show the moment.

        Args:
            at_s: the moment, s.
            _made: changes with every correction.
            key: the session's name in the study.
        """
        moment = float(at_s or 0.0)

        def shown_of(session: Session) -> tuple[Any, ...]:
            """Curves, facts and command of the opened `session`."""
            return (
                plots.around(traces(session), moment, _HALF_S),
                facts(session, nearest_row(session, moment)),
                f"liex show {shlex.quote(str(session.path))} --at {moment:.3f}",
            )

        return data.read(key, shown_of)

    @app.callback(
        Output("moment-link", "children"),
        Input("moment", "value"),
        State("session-key", "data"),
    )
    def link(at_s: float | None, key: str) -> html.A:
        """A link to the moment `at_s` (s) of the session `key`."""
        return html.A("link to this moment", href=session_address(key, float(at_s or 0.0)))

    @app.callback(
        Output("session-figures", "children"),
        Input("desk", "className"),
        State("session-key", "data"),
        State("moment", "value"),
        prevent_initial_call=True,
    )
    def figures(_opened: str, key: str, at_s: float | None) -> list[Any]:
        """The figures of the session `key` at `at_s`, once there is a first picture (`_opened`)."""
        try:
            return _figures(data, key, float(at_s or 0.0), show_replay is not None)
        except LiexError as error:
            return [html.P(str(error), className="problems", role="alert")]

    @app.callback(
        Output("whole", "figure", allow_duplicate=True),
        Output("correct-made", "children"),
        Input("corrections-made", "data"),
        State("session-key", "data"),
        State("moment", "value"),
        prevent_initial_call=True,
    )
    def again(_made: str, key: str, at_s: float | None) -> Any:
        """The curves and the list of corrections of the session `key` once more were made.

        Args:
            _made: changes with every correction.
            key: the session's name in the study.
            at_s: the present moment, s.
        """
        moment = float(at_s or 0.0)
        return data.read(
            key,
            lambda session: (_whole(data, key, session, moment), page_corrections.made(session)),
        )

    @app.callback(
        Output({"part": "order", "table": ALL}, "data", allow_duplicate=True),
        Input("corrections-made", "data"),
        State({"part": "order", "table": ALL}, "data"),
        prevent_initial_call=True,
    )
    def tables_again(made: str, orders: list[dict[str, Any]]) -> list[dict[str, Any]]:
        """Let every table of the page be filled again, in the `orders` that it had."""
        return [{**order, "made": made} for order in orders]

    app.clientside_callback(
        ClientsideFunction("liex", "open"),
        Output("desk", "className"),
        Input("session-key", "data"),
        State("moment", "value"),
    )
    app.clientside_callback(
        ClientsideFunction("liex", "again"),
        Output("desk", "lang"),
        Input("corrections-made", "data"),
    )
    # in the browser: an answer that changes a part of a figure fails where the page was just left
    app.clientside_callback(
        ClientsideFunction("liex", "cursor"),
        Output("whole", "figure"),
        Input("moment", "value"),
        Input("session-figures", "children"),  # the moment may have changed before they came
        State("session-unit-s", "data"),
        State("whole", "figure"),
    )
    app.clientside_callback(
        ClientsideFunction("liex", "moment"),
        Output("desk", "tabIndex"),
        Input("moment", "value"),
    )

    @app.callback(
        Output("replay-said", "children"),
        Input("open-replay", "n_clicks"),
        State("moment", "value"),
        State("session-key", "data"),
        prevent_initial_call=True,
    )
    def replay(n_clicks: int, at_s: float | None, key: str) -> Any:
        """Open the replay of the session `key` at `at_s` after a click (`n_clicks`)."""
        if not n_clicks or show_replay is None:
            return no_update
        try:
            show_replay(data.session(key).path / "session.rrd", float(at_s or 0.0))
        except LiexError as error:
            return str(error)
        return f"Rerun shows the replay at {float(at_s or 0.0):.3f} s."
