"""The double-plotted actogram of an animal, with light and dark and sleep by immobility."""

from datetime import datetime, timedelta

import numpy as np
from matplotlib.figure import Figure

from .animals import Array, SessionAnimal
from .style import BLUE, INK, LEFT_MM, LINE, RIGHT_MM, TWO_COLUMNS_MM, name_rows, one_panel

_PER_HOUR = 6  # bars
_LIGHT = "#e8c840"
_ROW_MM = 11.0


def actogram(animal: SessionAnimal) -> Figure | None:
    """Activity by the time of day, each day beside the next one; None without light in the plan."""
    hours, activity = animal.table("hours"), animal.table("activity")
    if hours is None or activity is None or not len(hours):
        return None
    began = datetime.fromisoformat(hours["clock"].iloc[0])
    since_midnight_h = (began - began.replace(hour=0, minute=0, second=0)) / timedelta(hours=1)
    bar = ((since_midnight_h + activity["start_s"] / 3600.0) * _PER_HOUR).to_numpy(int)
    distance, observed = (
        np.bincount(bar, activity[name]) for name in ("distance_mm", "observed_s")
    )
    rate = np.divide(distance, observed, out=np.zeros(len(distance)), where=observed > 0)
    top = float(np.percentile(rate[rate > 0], 99)) if rate.any() else 1.0
    n_days = int(bar[-1] // (24 * _PER_HOUR)) + 1
    height = _ROW_MM * n_days + 3.0
    figure, axes = one_panel(
        (TWO_COLUMNS_MM, height + 17.0),
        (LEFT_MM, 8.0, TWO_COLUMNS_MM - LEFT_MM - RIGHT_MM, height),
        f"Actogram, {animal.label}; bars: speed in 10 min, up to {0.1 * top:.2g} cm/s; line: share "
        "of the hour in sleep by immobility",
    )
    start, stop = (
        since_midnight_h + hours[name].to_numpy(float) / 3600.0 for name in ("start_s", "stop_s")
    )
    dark = ~hours["light"].to_numpy(bool)
    known = hours["observed_s"].to_numpy(float) > 0
    slept = hours["sleep_by_immobility_s"] / hours["observed_s"].where(hours["observed_s"] > 0)
    times = np.flatnonzero(rate) / _PER_HOUR
    for shift in (0, 1):

        def place(at: Array, shift: int = shift) -> tuple[Array, Array]:
            """Columns, h, and rows from the top, of times of day in one half of the figure."""
            row = at // 24.0 - shift
            return at % 24.0 + 24.0 * shift, np.where(row < 0, np.nan, row)

        x, row = place(start)
        axes.bar(
            x[dark],
            0.96,
            (stop - start)[dark],
            row[dark] - 0.48,
            align="edge",
            color=LINE,
            gid="dark",
        )
        colours = np.where(dark, INK, _LIGHT)
        axes.bar(x, 0.12, stop - start, -0.72, align="edge", color=colours, gid="light")
        y = row + 0.46 - 0.9 * slept
        axes.hlines(y[known], x[known], (x + stop - start)[known], BLUE, lw=0.9, gid="sleep")
        x, row = place(times)
        high = 0.9 * np.minimum(rate[rate > 0] / top, 1.0)
        axes.bar(x, -high, 1.0 / _PER_HOUR, row + 0.46, align="edge", color=INK, gid="activity")
    name_rows(axes, [f"{began + timedelta(days=k):%d %b}" for k in range(n_days)])
    axes.set(xlim=(0.0, 48.0), ylim=(n_days - 0.5, -0.75), xlabel="time of day, h")
    axes.set_xticks(range(0, 49, 6), [str(h % 24) for h in range(0, 49, 6)])
    return figure
