"""Figures of the floor from above: occupancy, trajectory, and the arena's heights."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from liex_lab.arrays import Array, NDArray
from liex_lab.behaviour.activity import Occupancy, occupancy
from liex_lab.behaviour.body import BRANCHES, axis_of
from liex_lab.scene.scene import Fixture
from liex_lab.sessions import Session

from ..units import counted
from .animals import SessionAnimal
from .style import (
    INK,
    MUTED,
    ONE_COLUMN_MM,
    PAPER,
    TWO_COLUMNS_MM,
    floor_limits,
    halo,
    heading,
    one_panel,
    panel,
    scale_bar,
    sheet,
    time_unit,
)

# one column with a square panel, space for a colour bar, and a title
_FLOOR = ((ONE_COLUMN_MM, 86.0), (2.0, 7.0, 69.0, 69.0))
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
    outlines: list[tuple[str, Array, Any]] = [("arena", session.arena.outline_mm(), "-")]
    outlines += [(zone.name, zone.outline_mm(), (0, (4, 2))) for zone in session.zones]
    for k, (name, corners, dashed) in enumerate(outlines):
        if not len(corners):
            continue
        corners = aligned(session, corners) if centred else corners
        _outline(axes, corners, f"zone {name}" if k else name, dashed)
        if k and named:
            place = corners[:, 0].mean(), corners[:, 1].max()
            halo(axes.text(*place, name, ha="center", va="top", size=6.0))


def _outline(axes: Axes, corners: Array, gid: str, dashed: Any) -> None:
    axes.plot(
        *np.vstack([corners, corners[:1]]).T, color=MUTED, linewidth=0.7, linestyle=dashed, gid=gid
    )


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
    turned = rays @ place.rotation.T
    if (turned[:, 2] < 0).all():  # a corner above the horizon is not on the floor
        on_floor = place.translation + turned * (-place.translation[2] / turned[:, 2])[:, None]
        _outline(axes, on_floor[:, :2], "region", ":")


def in_image(session: Session, xy_mm: Array, height_mm: float = 0.0) -> Array:
    """Positions (n, 2) mm above the floor -> (n, 2) px; empty if any is behind the camera."""
    points = np.column_stack([xy_mm.reshape(-1, 2), np.full(len(xy_mm), height_mm)])
    uv = session.camera.project(session.T_arena_camera.inverse() @ points)
    return uv if np.isfinite(uv).all() else np.empty((0, 2))


def hidden_places(session: Session) -> Array:
    """(n, 4) last positions of hidden animals: x, y mm, and from when to when, s."""
    gaps = session.gaps
    if "x_mm" not in gaps:  # sessions of earlier versions lack the position
        return np.empty((0, 4))
    hidden = gaps[(gaps["reason"] == "hidden") & gaps["x_mm"].notna()]
    return hidden[["x_mm", "y_mm", "start_s", "stop_s"]].to_numpy(float)


def draw_hidden(axes: Axes, session: Session) -> None:
    """Draw the last positions of hidden animals, with the durations.

    Args:
        axes: a panel with axes in millimetres.
        session: the opened session.
    """
    for x, y, start, stop in hidden_places(session):
        axes.plot(x, y, "x", color=INK, markersize=4, gid="hidden")
        halo(
            axes.annotate(
                f"hidden {stop - start:.1f} s", (x, y), (3, 2), textcoords="offset points", size=6.0
            )
        )


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


def occupancy_of(animal: SessionAnimal) -> Occupancy:
    """The occupancy of an animal over the extent of its floor figures."""
    low, high = extent_mm(animal.session, animal.xy_mm)
    return occupancy(animal.xy_mm, animal.hold_s, low, high)


def occupancy_map(animal: SessionAnimal) -> Figure | None:
    """Heatmap of the time per area, with walls and zones; None without positions, and for a
    hand.
    """
    found = occupancy_of(animal)
    if found.n == 0 or axis_of(animal.session.metadata["animal"]).kind == BRANCHES:
        return None
    figure, axes = one_panel(
        *_FLOOR,
        f"Occupancy, {animal.label}\nn = {counted(found.n, 'frame')}, "
        f"{found.observed_s:.1f} s observed",
    )
    image = draw_occupancy(axes, found, _most(found))
    draw_outlines(axes, animal.session)
    draw_hidden(axes, animal.session)
    return _finished(figure, image, "s/cm²", *extent_mm(animal.session, animal.xy_mm))


def trajectory(animal: SessionAnimal) -> Figure | None:
    """Path of the body's centre from above by time; None without a position, and for a hand."""
    known = np.isfinite(animal.xy_mm).all(axis=1)
    if not known.any() or axis_of(animal.session.metadata["animal"]).kind == BRANCHES:
        return None
    figure, axes = one_panel(
        *_FLOOR,
        f"Trajectory, {animal.label}\nn = {counted(int(known.sum()), 'frame')}, "
        f"{animal.hold_s[known].sum():.1f} s observed",
    )
    unit, size = time_unit(animal.duration_s)
    colours = ScalarMappable(
        Normalize(0.0, max(animal.duration_s, 1e-9) / size), colormaps["viridis"].with_extremes()
    )
    path = np.column_stack([animal.column("x_mm"), animal.column("y_mm")])
    time_s = animal.frames["time_s"].to_numpy(float)
    # at most five points per second of an hour
    rows = np.unique(np.linspace(0, len(path) - 1, min(len(path), 20_000)).astype(int))
    # at most 64 colours
    for piece in np.array_split(rows, min(64, max(1, len(rows) // 2))):
        part = np.append(piece, rows[rows > piece[-1]][:1])
        colour = colours.to_rgba(time_s[piece[0]] / size)
        axes.plot(*path[part].T, color=colour, linewidth=1.0, solid_capstyle="round")
    draw_outlines(axes, animal.session)
    first, last = np.flatnonzero(known)[[0, -1]]
    for row, word in ((first, "start"), (last, "end")):
        colour = colours.to_rgba(time_s[row] / size)
        axes.plot(*animal.xy_mm[row], "o", color=colour, markersize=3.5, markeredgecolor=PAPER)
        x, y = animal.xy_mm[row]
        halo(axes.annotate(word, (x, y), (3, 3), textcoords="offset points", size=6.0))
    return _finished(figure, colours, f"time, {unit}", *extent_mm(animal.session, animal.xy_mm))


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
    images = np.where(np.stack(depth) > 0, np.stack(depth), np.nan).astype(np.float32)
    with np.errstate(all="ignore"):
        read = np.isfinite(images).any(axis=0)
        z = np.nanmedian(images[:, read], axis=0).astype(float)
    v, u = np.nonzero(read)
    camera = session.camera
    points = session.T_arena_camera @ camera.unproject(np.column_stack([u, v]), z)
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
    if not any((image > 0).any() for image in depth):
        return None
    heights, x_mm, y_mm = arena_heights(session, depth)
    fixtures = session.metadata.get("scene", {}).get("fixtures", [])
    figure, axes = one_panel(
        *_FLOOR,
        f"Arena, heights above the floor, {session.name}\n"
        f"{session.arena}; {counted(len(fixtures), 'fixture')}; n = "
        f"{counted(len(depth), 'image')}",
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
        halo(axes.annotate(str(fixture), place, (3, 2), textcoords="offset points", size=6.0))
    return _finished(
        figure, image, "height, mm", *np.array([[x_mm[0], y_mm[0]], [x_mm[-1], y_mm[-1]]])
    )


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
        floor_limits(axes, (found.x_mm[0], found.y_mm[0]), (found.x_mm[-1], found.y_mm[-1]))
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


def _finished(figure: Figure, image: Any, label: str, low_mm: Array, high_mm: Array) -> Figure:
    """A figure of the floor with its limits, scale bar and colour bar."""
    floor_limits(figure.axes[0], low_mm, high_mm)
    scale_bar(figure.axes[0])
    _colour_bar(figure, image, label)
    return figure


def _colour_bar(figure: Figure, image: Any, label: str) -> None:
    across, up = figure.get_size_inches() * 25.4
    axes = panel(figure, across - 14.0, 0.25 * up, 2.5, 0.45 * up)
    figure.colorbar(image, cax=axes).outline.set_visible(False)
    axes.set_title(label, size=6.0, color=INK)
