"""The dashboard's pages of the whole study: list of its sessions, ethograms and time budgets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from dash import Dash, Input, Output, State, dcc, html, no_update

from liex_lab.actions.vocabulary import PALETTE, UNLABELLED

from . import plots
from .data import (
    GREY,
    NO_POSE,
    OTHER,
    StudyData,
    colours_of,
    shown_words,
    vocabulary_of,
)
from .parts import download, graph
from .tables import STATES, block, csv_address, session_address

MOST_COLOURS = len(PALETTE)


def sessions_page(data: StudyData) -> list[Any]:
    """Content of the page that lists every session of the study with its state and quality.

    Args:
        data: the study.
    """
    counts: dict[str, int] = {}
    for entry in data.entries.values():
        counts[entry.state] = counts.get(entry.state, 0) + 1
    chips = [
        html.Li([html.B(f"{counts[state]:,}"), f" {title}"], className=f"state is-{state}")
        for state, title in STATES.items()
        if counts.get(state)
    ]
    return [
        html.Div(
            className="head",
            children=[
                html.Div([html.P("Study", className="kind"), html.H1(data.name)]),
                html.Button(
                    "Refresh",
                    id="look-again",
                    n_clicks=0,
                    type="button",
                    title="read the folders again",
                ),
            ],
        ),
        html.Ul(chips, className="chips", id="state-counts"),
        html.P(
            "Open a session by its name. Error is the expected joint error, the median over its "
            "frames; flips are stretches in which head and tail may have been exchanged.",
            className="muted",
        ),
        block("sessions", "Sessions of the study"),
        html.P(
            [
                download("All summaries as CSV", csv_address("summaries"), ""),
                ": one row per session with every measure.",
            ],
            className="muted",
        ),
    ]


def ethograms_page(data: StudyData) -> list[Any]:
    """Content of the page on what the animals of several sessions did, one below the other.

    Args:
        data: the study.
    """
    keys = [entry.key for entry in data.done]
    names = sorted({entry.who.get("group", "") for entry in data.done} - {""})
    return [
        html.P("Study", className="kind"),
        html.H1("Ethograms side by side"),
        html.Div(
            className="tools",
            children=[
                html.Label(
                    [
                        html.Span("Groups"),
                        dcc.Dropdown(
                            id="ethogram-groups",
                            options=[{"label": name, "value": name} for name in names],
                            multi=True,
                            placeholder="all groups",
                        ),
                    ]
                ),
                html.Label(
                    [
                        html.Span("Sessions"),
                        dcc.Dropdown(
                            id="ethogram-sessions",
                            options=[{"label": key, "value": key} for key in keys],
                            multi=True,
                            placeholder="all sessions of these groups",
                        ),
                    ]
                ),
            ],
        ),
        html.Ul(id="ethogram-key", className="key"),
        dcc.Store(id="ethogram-unit-s", data=1.0),
        html.H2("Over time"),
        html.P(
            "Every row is a session. A click opens the session at that moment.", className="muted"
        ),
        graph(
            "ethograms",
            plots.empty("Reading the sessions ..."),
            "actions of each session over time",
        ),
        html.H2("Time budget"),
        graph(
            "budgets",
            plots.empty("Reading the sessions ..."),
            "share of the time in each action, by session",
        ),
        html.P(
            "Shares are fractions of the observed time; with unlabelled time they sum to 1.",
            className="muted",
        ),
        html.P([download("All shares as CSV", csv_address("summaries"))]),
    ]


def chosen_keys(
    data: StudyData, names: Sequence[str] | None, sessions: Sequence[str] | None
) -> list[str]:
    """The sessions that are named, or those of the groups, or all.

    Args:
        data: the study.
        names: names of groups; empty takes all.
        sessions: names of sessions, which go before groups.

    Returns:
        Keys, by group and then in the study's order (named sessions in the study's order).
    """
    done = data.done
    if sessions:
        return [entry.key for entry in done if entry.key in set(sessions)]
    within = [entry for entry in done if not names or entry.who.get("group", "") in names]
    return [entry.key for entry in sorted(within, key=lambda entry: entry.who.get("group", ""))]


def register(app: Dash, data: StudyData) -> None:
    """Register what happens when something is chosen or clicked on these pages.

    Args:
        app: the dashboard.
        data: the study.
    """

    @app.callback(
        Output("ethograms", "figure"),
        Output("budgets", "figure"),
        Output("ethogram-key", "children"),
        Output("ethogram-unit-s", "data"),
        Input("ethogram-groups", "value"),
        Input("ethogram-sessions", "value"),
    )
    def draw(names: list[str] | None, sessions: list[str] | None) -> tuple[Any, Any, Any, float]:
        """Figures, colour key and time unit (s) of the chosen groups (`names`) and `sessions`."""
        ones = data.ethograms(chosen_keys(data, names, sessions))
        words = shown_words(ones.values())
        coloured = colours_of(words[:MOST_COLOURS], vocabulary_of(ones.values()))
        table = data.collected()
        table = table[table["key"].isin(ones)].set_index("key").reindex(list(ones)).reset_index()
        marks = [
            *coloured.items(),
            *([(OTHER, GREY)] if len(words) > MOST_COLOURS else []),
            ("unlabelled", UNLABELLED),
            (NO_POSE, plots.NO_POSE_COLOUR),
        ]
        key = [
            html.Li([html.I(style={"background": colour}), word.replace("_", " ")])
            for word, colour in marks
        ]
        size = plots.time_unit(max((one.duration_s for one in ones.values()), default=0.0))[1]
        groups = [data.entries[one].who.get("group", "") for one in ones]
        budgets = plots.time_budgets(table, coloured, words, groups)
        return plots.ethograms(ones, coloured, groups), budgets, key, size

    @app.callback(
        Output("url", "href", allow_duplicate=True),
        Input("ethograms", "clickData"),
        State("ethogram-unit-s", "data"),
        prevent_initial_call=True,
    )
    def open_moment(click: dict[str, Any] | None, unit_s: float) -> Any:
        """Address of the moment of a `click` in an ethogram, whose axis has `unit_s` s per unit."""
        if not click:
            return no_update
        point = click["points"][0]
        by_label = {plots.text(key): key for key in data.entries}
        key = by_label.get(str(point["y"]))
        return no_update if key is None else session_address(key, float(point["x"]) * unit_s)

    @app.callback(
        Output("url", "href", allow_duplicate=True),
        Input("budgets", "clickData"),
        prevent_initial_call=True,
    )
    def open_session(click: dict[str, Any] | None) -> Any:
        """Address of the session whose bar was clicked, from plotly's `click`."""
        return session_address(str(click["points"][0]["customdata"])) if click else no_update

    @app.callback(
        Output("url", "href", allow_duplicate=True),
        Input("look-again", "n_clicks"),
        State("url", "href"),
        prevent_initial_call=True,
    )
    def look_again(n_clicks: int, href: str) -> Any:
        """Read the folders again after a click (`n_clicks`); the page's `href` is not used."""
        if not n_clicks:
            return no_update
        data.refresh()
        return "/?again=" + str(n_clicks)
