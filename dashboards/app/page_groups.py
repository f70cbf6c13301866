"""The dashboard's page that compares groups of animals: one measure drawn, all comparisons listed.

The statistics (Hedges' g, permutation test or mixed model, Benjamini-Hochberg) are those of
`liex_lab.behaviour.cohort`.
"""

from __future__ import annotations

from typing import Any

from dash import Dash, Input, Output, dcc, html, no_update

from liex_lab.behaviour import cohort
from liex_lab.errors import LiexError
from liex_lab.plan.subject import references_first

from ..units import titled
from . import plots
from .data import StudyData
from .parts import graph
from .tables import block, columns_of, number, records, session_address

ALL = "every pair"


def groups_page(data: StudyData) -> list[Any]:
    """Content of the page: choose a measure; see the animals, the differences, and the test.

    Where there are no two groups, a sentence says what to state.

    Args:
        data: the study.
    """
    table = data.collected()
    measures = list(columns_of(data))
    usual = [name for name in cohort.usual_measures(table) if name in measures]
    ordered = [*usual, *(name for name in measures if name not in usual)]
    units = data.units()
    names = references_first({str(name) for name in table["group"].fillna("")} - {""})
    if not ordered or len(names) < 2:
        said = f"{len(table)} measured sessions have {', '.join(names) or 'no group'}"
        return [
            html.P("Study", className="kind"),
            html.H1("Groups"),
            html.P(
                f"A comparison needs two groups of animals, and these {said}. State `group` for "
                "the animals in the study file, or session.group in the plan."
            ),
        ]
    return [
        html.P("Study", className="kind"),
        html.H1("Groups"),
        *(html.P(f"Check this result: {note}", className="note") for note in data.to_check()),
        html.Div(
            className="tools",
            children=[
                html.Label(
                    [
                        html.Span("Measure"),
                        dcc.Dropdown(
                            id="measure",
                            options=[
                                {"label": titled(name, units.get(name, "")), "value": name}
                                for name in ordered
                            ],
                            value=ordered[0],
                            clearable=False,
                        ),
                    ]
                ),
                html.Label(
                    [
                        html.Span("Compare"),
                        dcc.Dropdown(
                            id="reference",
                            clearable=False,
                            value=ALL,
                            options=[
                                {"label": ALL, "value": ALL},
                                *({"label": f"with {one}", "value": one} for one in names),
                            ],
                        ),
                    ]
                ),
            ],
        ),
        html.P(id="measure-meaning", className="muted"),
        html.Div(
            className="pair",
            children=[
                html.Div(
                    [
                        html.H2("Animals"),
                        graph(
                            "group-points",
                            plots.empty("Comparing ..."),
                            "each animal's mean and its sessions, by group",
                        ),
                        html.P(
                            "Large marks are animals, small ones their sessions, the line is the "
                            "mean of the animals. A click opens the session.",
                            className="muted",
                        ),
                    ]
                ),
                html.Div(
                    [
                        html.H2("Differences"),
                        graph(
                            "group-differences",
                            plots.empty("Comparing ..."),
                            "differences of the groups with their intervals",
                        ),
                        html.Div(id="verdicts"),
                    ]
                ),
            ],
        ),
        html.H2("Every comparison"),
        html.P(
            "All that was compared stands here, tested or not; p is corrected for the whole table.",
            className="muted",
        ),
        html.Div(id="stats-table"),
        html.H2("For the methods section"),
        html.P(id="stats-methods", className="paste"),
    ]


def verdict(row: dict[str, Any], unit: str) -> html.Div:
    """One contrast in words: what was found, how sure, of how many.

    Args:
        row: a row of the table `stats`, see `cohort.compare`.
        unit: the measure's unit in the table; empty where it has none.
    """
    cages = f"{row['n_cages']} cages, " if row["n_cages"] else ""
    counts = (
        f"{cohort.counted_units(row)}; {row['n_animals']} animals, {cages}{row['n_sessions']} "
        f"sessions, {row['n_bouts']:,} bouts, {number(row['observed_min'])} min; "
        f"{row['n_without_value']} sessions without a value."
    )
    kind = "verdict" if row["test"] else "verdict is-refused"
    return html.Div(
        [
            html.H3(row["contrast"]),
            html.P(cohort.result(row, unit), className="tested"),
            html.P(counts, className="muted"),
        ],
        className=kind,
    )


def register(app: Dash, data: StudyData) -> None:
    """Register what happens when a measure is chosen or an animal clicked.

    Args:
        app: the dashboard.
        data: the study.
    """

    @app.callback(
        Output("group-points", "figure"),
        Output("group-differences", "figure"),
        Output("verdicts", "children"),
        Output("stats-table", "children"),
        Output("stats-methods", "children"),
        Output("measure-meaning", "children"),
        Input("measure", "value"),
        Input("reference", "value"),
    )
    def compare(measure: str, reference: str) -> tuple[Any, ...]:
        """Figures, verdicts, table and text of `measure`, against the group `reference`."""
        against = None if reference == ALL else reference
        unit, meaning = data.described(measure)
        try:
            stats = data.stats(measure, against)
        except LiexError as error:
            return plots.empty(str(error)), plots.empty(""), [], [], "", meaning
        own = stats[stats["measure"] == measure]
        return (
            plots.groups(data.collected(), measure, unit, against),
            plots.differences(own, unit),
            [verdict(row, unit) for row in records(own)],
            block(f"stats/{measure}/{against or ''}", "Every comparison"),
            cohort.methods(stats, data.collected(), [f"{note}." for note in data.to_check()]),
            meaning,
        )

    @app.callback(
        Output("url", "href", allow_duplicate=True),
        Input("group-points", "clickData"),
        prevent_initial_call=True,
    )
    def open_session(click: dict[str, Any] | None) -> Any:
        """Address of the session whose mark was clicked, from plotly's `click`."""
        return session_address(str(click["points"][0]["customdata"])) if click else no_update
