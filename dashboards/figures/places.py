"""Figures of the floor from above: occupancy, trajectory, and the arena's heights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.behaviour.activity import Occupancy, occupancy
from liex_lab.behaviour.body import BRANCHES, axis_of
from liex_lab.scene.scene import Fixture
from liex_lab.sessions import Session

from ..units import counted
from .seen import Array, Seen
from .style import (
    INK,
    MUTED,
    ONE_COLUMN_MM,
    PAPER,
    TWO_COLUMNS_MM,
    floor_limits,
    halo,
    heading,
    panel,
    scale_bar,
    sheet,
    time_unit,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_PLACES = 20_000  # of a trajectory: five per second of an hour
_PIECES = 64  # colours of a trajectory
_ACROSS = 3  # panels per row


def aligned(session: Session, xy_mm: Array) -> Array:
    """Positions relative to the arena's centre and sides, so that arenas can be superimposed.

    They are unchanged if the arena's shape is unknown.

    Args:
        session: the opened session.
        xy_mm: (n, 2) positions, mm, arena frame.
    """
    arena = session.arena
    if arena.centre_mm is None:
        return xy_mm
    yaw = arena.yaw_rad or 0.0
    turned = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return np.asarray((xy_mm - np.array(arena.centre_mm)) @ turned)


def extent_mm(session: Session, xy_mm: Array, centred: bool = False) -> tuple[Array, Array]:
    """Corners (smallest, largest) of a figure of the floor, mm, arena frame.

    Args:
        session: its arena and zones are included.
        xy_mm: (n, 2) positions to include; NaN does not count.
        centred: use the coordinates of `aligned`.
    """
    known = xy_mm[np.isfinite(xy_mm).all(axis=1)]
    shown = [known, session.arena.outline_mm(), *(zone.outline_mm() for zone in session.zones)]
    corners = [aligned(session, p) if centred else p for p in shown if len(p)]
    if not corners:
        return np.zeros(2), np.zeros(2)
    return np.min([p.min(axis=0) for p in corners], 0), np.max([p.max(axis=0) for p in corners], 0)


def draw_outlines(axes: Axes, session: Session, named: bool = True, centred: bool = False) -> None:
    """Draw the arena's walls, if known, and the zones with their names.

    Args:
        axes: a panel with axes in millimetres.
        session: the opened session.
        named: whether to write the zones' names.
        centred: use the coordinates of `aligned`.
    """
    walls = session.arena.outline_mm()
    outlines = [("arena", walls)] if len(walls) else []
    outlines += [(f"zone {zone.name}", zone.outline_mm()) for zone in session.zones]
    for name, corners in outlines:
        corners = aligned(session, corners) if centred else corners
        closed = np.vstack([corners, corners[:1]])
        dashed = "-" if name == "arena" else (0, (4, 2))
        axes.plot(*closed.T, color=MUTED, linewidth=0.7, linestyle=dashed, gid=name)
    for zone in session.zones if named else ():
        corners = aligned(session, zone.outline_mm()) if centred else zone.outline_mm()
        place = corners[:, 0].mean(), corners[:, 1].max()
        text = axes.text(*place, zone.name, ha="center", va="top", size=6.0)
        halo(text)


def draw_region(axes: Axes, session: Session) -> None:
    """Draw the evaluated region on the floor, if it is not the whole image.

    Args:
        axes: a panel with axes in millimetres.
        session: the opened session.
    """
    corners = session.metadata.get("scene", {}).get("region_px", [])
    if len(corners) < 3:
        return
    rays = session.camera.unproject(np.asarray(corners, float), np.ones(len(corners)))
    place = session.T_arena_camera
    ways = rays @ place.rotation.T
    if (ways[:, 2] >= 0).any():  # a corner above the horizon is not on the floor
        return
    on_floor = place.translation + ways * (-place.translation[2] / ways[:, 2])[:, None]
    closed = np.vstack([on_floor, on_floor[:1]])
    axes.plot(*closed[:, :2].T, color=MUTED, linewidth=0.7, linestyle=":", gid="region")


def draw_hidden(axes: Axes, session: Session) -> None:
    """Draw the last positions of hidden animals, with the durations.

    Args:
        axes: a panel with axes in millimetres.
        session: the opened session.
    """
    gaps = session.gaps
    if "x_mm" not in gaps:  # sessions of earlier versions lack the position
        return
    hidden = gaps[(gaps["reason"] == "hidden") & gaps["x_mm"].notna()]
    columns = hidden[["x_mm", "y_mm", "start_s", "stop_s"]].to_numpy(float)
    for x, y, start, stop in columns:
        axes.plot(x, y, "x", color=INK, markersize=4, gid="hidden")
        text = axes.annotate(
            f"hidden {stop - start:.1f} s", (x, y), (3, 2), textcoords="offset points", size=6.0
        )
        halo(text)


def draw_occupancy(axes: Axes, found: Occupancy, most: float) -> Any:
    """Draw the heatmap of an occupancy, unvisited cells empty; returns the image.

    Args:
        axes: a panel with axes in millimetres.
        found: the occupancy.
        most: time per area of the lightest colour, s/cm².
    """
    density = np.where(found.per_cm2 > 1e-3 * most, found.per_cm2, np.nan)
    box = (found.x_mm[0], found.x_mm[-1], found.y_mm[0], found.y_mm[-1])
    return axes.imshow(
        density,
        extent=box,
        origin="lower",
        cmap="viridis",
        vmin=0.0,
        vmax=most,
        interpolation="none",
    )


def occupancy_of(seen: Seen) -> Occupancy:
    """The occupancy of an animal over the extent of its floor figures."""
    low, high = extent_mm(seen.session, seen.xy_mm)
    return occupancy(seen.xy_mm, seen.hold_s, low, high)


def occupancy_map(seen: Seen) -> Figure | None:
    """Heatmap of the time per area, with walls and zones; None without positions, and for a
    hand.
    """
    found = occupancy_of(seen)
    if found.n == 0 or _is_hand(seen):
        return None
    title = (
        f"Occupancy, {seen.who}\nn = {counted(found.n, 'frame')}, {found.observed_s:.1f} s observed"
    )
    figure, axes = _floor_sheet(title)
    image = draw_occupancy(axes, found, _most(found))
    draw_outlines(axes, seen.session)
    draw_hidden(axes, seen.session)
    floor_limits(axes, *extent_mm(seen.session, seen.xy_mm))
    scale_bar(axes)
    _colour_bar(figure, image, "s/cm²")
    return figure


def _is_hand(seen: Seen) -> bool:
    """Whether the animal is a hand, whose position on the floor has no meaning."""
    return axis_of(seen.session.metadata["animal"]).kind == BRANCHES


def trajectory(seen: Seen) -> Figure | None:
    """Path of the body's centre from above by time; None without a position, and for a hand."""
    known = np.isfinite(seen.xy_mm).all(axis=1)
    if not known.any() or _is_hand(seen):
        return None
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    figure, axes = _floor_sheet(
        f"Trajectory, {seen.who}\nn = {counted(int(known.sum()), 'frame')}, "
        f"{seen.hold_s[known].sum():.1f} s observed"
    )
    unit, size = time_unit(seen.duration_s)
    clock = Normalize(0.0, max(seen.duration_s, 1e-9) / size)
    colours = ScalarMappable(clock, colormaps["viridis"].with_extremes())
    way = np.column_stack([seen.column("x_mm"), seen.column("y_mm")])
    time_s = seen.frames["time_s"].to_numpy(float)
    rows = np.unique(np.linspace(0, len(way) - 1, min(len(way), _MOST_PLACES)).astype(int))
    for piece in np.array_split(rows, min(_PIECES, max(1, len(rows) // 2))):
        part = np.append(piece, rows[rows > piece[-1]][:1])
        colour = colours.to_rgba(time_s[piece[0]] / size)
        axes.plot(*way[part].T, color=colour, linewidth=1.0, solid_capstyle="round")
    draw_outlines(axes, seen.session)
    first, last = np.flatnonzero(known)[[0, -1]]
    for row, word in ((first, "start"), (last, "end")):
        colour = colours.to_rgba(time_s[row] / size)
        axes.plot(*seen.xy_mm[row], "o", color=colour, markersize=3.5, markeredgecolor=PAPER)
        at = seen.xy_mm[row]
        text = axes.annotate(word, (at[0], at[1]), (3, 3), textcoords="offset points", size=6.0)
        halo(text)
    floor_limits(axes, *extent_mm(seen.session, seen.xy_mm))
    scale_bar(axes)
    _colour_bar(figure, colours, f"time, {unit}")
    return figure


def arena_heights(
    session: Session, depth: Sequence[NDArray[np.uint16]]
) -> tuple[Array, Array, Array]:
    """Heights of the static scene above the floor, from above.

    Args:
        session: the opened session.
        depth: some depth images (H, W) uint16 mm, 0 where unread, from all over the session; the
            median of each pixel is static.

    Returns:
        Heights (ny, nx) mm, NaN where unread, and the edges of the columns (nx + 1,) and rows (ny +
            1,), mm, arena frame.
    """
    pictures = np.where(np.stack(depth) > 0, np.stack(depth), np.nan).astype(np.float32)
    with np.errstate(all="ignore"):
        seen = np.isfinite(pictures).any(axis=0)
        still = np.full(pictures.shape[1:], np.nan)
        still[seen] = np.nanmedian(pictures[:, seen], axis=0)
    v, u = np.nonzero(seen)
    camera = session.camera
    z = still[seen]
    rays = np.column_stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(z.size)]
    )
    points = session.T_arena_camera @ (rays * z[:, None])
    low, high = extent_mm(session, np.empty((0, 2)))
    if not (high > low).all():
        low, high = np.percentile(points[:, :2], [1.0, 99.0], axis=0)
    # two pixels wide, so that few cells are empty
    step = 2.0 * float(np.median(z)) / min(camera.fx, camera.fy)
    margin = 0.06 * float((high - low).max())
    edges = [np.arange(a - margin, b + margin + step, step) for a, b in zip(low, high, strict=True)]
    box = [edges[1], edges[0]]
    places = points[:, 1], points[:, 0]
    n, _, _ = np.histogram2d(*places, bins=box)
    total, _, _ = np.histogram2d(*places, bins=box, weights=points[:, 2])
    return np.divide(total, n, out=np.full(n.shape, np.nan), where=n > 0), edges[0], edges[1]


def arena_map(session: Session, depth: Sequence[NDArray[np.uint16]]) -> Figure | None:
    """The arena's heights above the floor with fixtures, walls and zones; None without depth.

    Args:
        session: the opened session.
        depth: depth images as for `arena_heights`.
    """
    if not len(depth) or not any((picture > 0).any() for picture in depth):
        return None
    heights, x_mm, y_mm = arena_heights(session, depth)
    fixtures = session.metadata.get("scene", {}).get("fixtures", [])
    figure, axes = _floor_sheet(
        f"Arena, heights above the floor, {session.name}\n"
        f"{session.arena}; {counted(len(fixtures), 'fixture')}; n = "
        f"{counted(len(depth), 'picture')}"
    )
    known = heights[np.isfinite(heights)]
    top = float(np.percentile(known, 99.0)) if len(known) else 10.0
    image = axes.imshow(
        heights,
        extent=(x_mm[0], x_mm[-1], y_mm[0], y_mm[-1]),
        origin="lower",
        cmap="cividis",
        vmin=-5.0,
        vmax=max(top, 20.0),
        interpolation="none",
    )
    draw_outlines(axes, session)
    draw_region(axes, session)
    draw_hidden(axes, session)
    for fixture in map(Fixture.from_dict, fixtures):
        place = fixture.centre_mm
        axes.plot(*place, "+", color=PAPER, markersize=4)
        text = axes.annotate(str(fixture), place, (3, 2), textcoords="offset points", size=6.0)
        halo(text)
    floor_limits(axes, [x_mm[0], y_mm[0]], [x_mm[-1], y_mm[-1]])
    scale_bar(axes)
    _colour_bar(figure, image, "height, mm")
    return figure


def occupancy_panels(title: str, panels: Sequence[tuple[str, Session, Occupancy]]) -> Figure | None:
    """Heatmaps in a grid on one scale; None without a known position.

    Args:
        title: the common title.
        panels: name, session whose walls and zones are drawn, and occupancy of each, as time per
            area of one session (for groups: the mean of the animals).
    """
    known = [one for one in panels if one[2].n]
    if not known:
        return None
    columns = min(_ACROSS, len(known))
    rows = -(-len(known) // columns)
    side = (TWO_COLUMNS_MM - 18.0) / _ACROSS - 4.0
    figure = sheet(columns * (side + 4.0) + 18.0, rows * (side + 13.0) + 8.0)
    most = max(_most(found) for _, _, found in known)
    image = None
    for k, (name, session, found) in enumerate(known):
        row, column = divmod(k, columns)
        axes = panel(
            figure, 2.0 + column * (side + 4.0), 6.0 + (rows - 1 - row) * (side + 13.0), side, side
        )
        image = draw_occupancy(axes, found, most)
        draw_outlines(axes, session, named=k == 0, centred=True)
        corners = [found.x_mm[0], found.y_mm[0]], [found.x_mm[-1], found.y_mm[-1]]
        floor_limits(axes, *corners)
        axes.set_title(name, size=6.5)
        scale_bar(axes)
    heading(figure, title)
    _colour_bar(figure, image, "s/cm²")
    return figure


def _most(found: Occupancy) -> float:
    """Time per area of the lightest colour: the 99 % quantile over the visited floor."""
    density = found.per_cm2
    visited = density[density > 1e-3 * density.max()]
    return float(np.percentile(visited, 99.0)) if len(visited) else 1.0


def _floor_sheet(title: str) -> tuple[Figure, Axes]:
    """A one-column figure with a square panel, space for a colour bar, and a title."""
    figure = sheet(ONE_COLUMN_MM, 86.0)
    axes = panel(figure, 2.0, 7.0, 69.0, 69.0)
    axes.set_title(title)
    return figure, axes


def _colour_bar(figure: Figure, image: Any, label: str) -> None:
    across, up = figure.get_size_inches() * 25.4
    axes = panel(figure, across - 14.0, 0.25 * up, 2.5, 0.45 * up)
    bar = figure.colorbar(image, cax=axes)
    bar.outline.set_visible(False)
    axes.set_title(label, size=6.0, color=INK)
