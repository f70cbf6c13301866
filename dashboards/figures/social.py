"""The interactions of an arena as a matrix and as a network."""

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from liex_lab.actions.vocabulary import INTERACTIONS, individual_colours
from liex_lab.sessions import Session
from liex_lab.sessions.individuals import arena_name, individuals_of

from .animals import Array, SessionAnimal
from .style import INK, LINE, MUTED, TWO_COLUMNS_MM, halo, heading, name_rows, one_panel

_ROW_MM = 8.0
_DIRECTED = [word for word, one in INTERACTIONS.items() if not one.mutual]


def met(session: Session) -> bool:
    """Whether any animal of the session's arena did anything to another one."""
    return session.has("interactions.parquet") and bool(
        (session.interactions["target"] != "").any()
    )


def _pairs(animal: SessionAnimal) -> pd.DataFrame | None:
    """The totals of ordered pairs; None without an interaction."""
    if not met(animal.session):
        return None
    return animal.session.interaction_totals.query("target != ''")


def interaction_matrix(animal: SessionAnimal) -> Figure | None:
    """Number and time of each interaction by ordered pair; None without any."""
    table = _pairs(animal)
    if table is None:
        return None
    found = table.assign(pair=table["agent"] + " → " + table["target"])
    pairs = list(found["pair"].unique())
    words = [word for word in INTERACTIONS if found.loc[found["action"] == word, "count"].sum()]
    count, total_s, share = (
        found.pivot(index="pair", columns="action", values=name).loc[pairs, words].to_numpy(float)
        for name in ("count", "total_s", "share")
    )
    height, left = _ROW_MM * len(pairs), 40.0
    width = min(14.0 * len(words), TWO_COLUMNS_MM - left - 5.0)
    figure, axes = one_panel((TWO_COLUMNS_MM, height + 30.0), (left, 3.0, width, height))
    axes.imshow(np.nan_to_num(share), cmap="Blues", vmin=0.0, vmax=1.5 * share.max(), aspect="auto")
    for row, column in zip(*np.nonzero(count), strict=True):
        text = f"{count[row, column]:.0f}\n{total_s[row, column]:.1f} s"
        axes.text(column, row, text, ha="center", va="center", size=5.5)
    name_rows(axes, pairs)
    axes.set_xticks(range(len(words)), [word.replace("_", " ") for word in words])
    axes.tick_params(axis="x", top=True, labeltop=True, bottom=False, labelbottom=False, length=0)
    axes.tick_params(axis="x", labelrotation=35.0)
    for label in axes.get_xticklabels():
        label.set(ha="left", rotation_mode="anchor")
    axes.spines[:].set_visible(False)
    heading(
        figure,
        f"Interactions, {arena_name(animal.session)}: number and time of what the first did to the "
        f"second; mutual ones stand in both rows.\nShade: share of the time in which both have a "
        f"trusted pose, {table['observed_s'].min():.0f} s or more",
    )
    return figure


def interaction_network(animal: SessionAnimal) -> Figure | None:
    """The group as a network: what is directed as arrows, contact as lines; None without any."""
    table = _pairs(animal)
    if table is None:
        return None
    names = individuals_of(animal.session)
    colours = individual_colours(names)
    angle = 2.0 * np.pi * np.arange(len(names)) / len(names)
    angle += np.pi if len(names) == 2 else np.pi / 2.0
    at = dict(zip(names, np.column_stack([np.cos(angle), np.sin(angle)]), strict=True))
    figure, axes = one_panel((TWO_COLUMNS_MM / 2.0, 76.0), (2.0, 1.0, 87.0, 64.0))
    contact = table[table["action"] == "contact"].set_index(["agent", "target"])["share"].to_dict()
    directed = table[table["action"].isin(_DIRECTED)]
    done = directed.groupby(["agent", "target"], sort=False)[["count", "total_s"]].sum()
    most = max(int(done["count"].max()), 1)
    for agent, target, count, total_s in done.reset_index().itertuples(index=False, name=None):
        a, b, share = at[agent], at[target], contact[agent, target]
        if names.index(agent) < names.index(target) and share > 0.0:
            line = np.stack([a, b], axis=1)
            axes.plot(*line, color=LINE, linewidth=1.0 + 12.0 * share, zorder=0)
            _label(axes, 0.5 * (a + b), f"contact {share:.1%}", MUTED)
        if count:
            style = {
                "arrowstyle": "-|>",
                "mutation_scale": 10.0,
                "connectionstyle": "arc3,rad=-0.35",
                "color": colours[agent],
                "linewidth": 0.6 + 1.8 * count / most,
                "shrinkA": 9.0,
                "shrinkB": 9.0,
            }
            axes.annotate("", b, a, arrowprops=style)
            # beside the middle of the arrow, which bends to its left
            aside = 0.3 * np.array([a[1] - b[1], b[0] - a[0]])
            _label(axes, 0.5 * (a + b) + aside, f"{count} ({total_s:.1f} s)", INK)
    for name, place in at.items():
        axes.plot(place[0], place[1], "o", color=colours[name], markersize=9.0)
        x, y = place * (1.0 if len(names) == 2 else 1.22) - [0.0, 0.22 * (len(names) == 2)]
        axes.text(x, y, name, ha="center", va="center")
    axes.set(xlim=(-1.45, 1.45), ylim=(-1.35, 1.35))
    axes.set_axis_off()
    heading(
        figure,
        f"Interactions of {arena_name(animal.session)}: arrows are\n"
        "interactions that are not mutual (number and time), grey is contact\n"
        "(share of the time in which both have a trusted pose)",
    )
    return figure


def _label(axes: Axes, at: Array, label: str, colour: str) -> None:
    halo(axes.text(at[0], at[1], label, ha="center", va="center", color=colour))
