"""Dash components that the dashboard's pages share: figures, download links, ARIA attributes."""

from __future__ import annotations

from typing import Any

from dash import dcc, html

# Plotly's toolbar has a button that sends the figure to its makers: it is taken out, and has no
# address to send it to
_GRAPH = {
    "displaylogo": False,
    "responsive": True,
    "showSendToCloud": False,
    "plotlyServerURL": "",
    "modeBarButtonsToRemove": ["select2d", "lasso2d", "autoScale2d", "sendDataToCloud"],
}


def aria(**names: str) -> dict[str, Any]:
    """ARIA attributes for screen readers: `label` becomes aria-label.

    Args:
        **names: attribute without its prefix -> text.
    """
    return {f"aria-{name}": value for name, value in names.items()}


def graph(name: str, figure: dict[str, Any], told: str) -> html.Div:
    """A figure with what it shows in words, for a screen reader.

    Args:
        name: id of the figure on the page.
        figure: plotly's figure, see `plots`.
        told: what the figure shows, in words.
    """
    drawn = dcc.Graph(id=name, figure=figure, config=_GRAPH)  # type: ignore[arg-type]
    return html.Div(drawn, role="figure", className="graph", **aria(label=told))


def download(title: str, address: str, className: str = "button") -> html.A:
    """A link whose target is saved, not shown.

    Args:
        title: text of the link.
        address: what it leads to.
        className: CSS classes of the link.
    """
    return html.A(title, href=address, className=className, download="")
