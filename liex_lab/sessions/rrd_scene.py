"""What stands still, in the Rerun replay: region of interest, fixtures, and where an animal hid.

All of it is static and takes some hundred bytes a thing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
import rerun as rr

from liex_lab.sessions.rrd_depth import IMAGE, MM_PER_UNIT

if TYPE_CHECKING:
    from liex_lab.scene.scene import Scene
    from liex_lab.tables.rows import Rows

OVERLAY: Final = f"{IMAGE}/overlay"
FLOOR: Final = "arena/floor"
_GREY: Final = [154, 160, 166, 255]
_PURPLE: Final = [170, 51, 119, 255]


def log_surroundings(stream: Any, scene: Scene) -> None:
    """The region outside of which nothing is looked at, and what stands on the floor.

    Args:
        stream: the replay.
        scene: as session.json describes it.
    """
    if scene.region_px:
        ring = np.array([*scene.region_px, scene.region_px[0]]) + 0.5
        outline = rr.LineStrips2D(
            [ring], radii=rr.Radius.ui_points(1.0), colors=[_GREY], labels=["region"]
        )
        stream.log(f"{OVERLAY}/region", outline, static=True)
    if scene.fixtures:
        tops = np.array([[*one.centre_mm, one.height_mm] for one in scene.fixtures])
        labels = [f"fixture, {one}" for one in scene.fixtures]
        things = rr.Points3D(tops / MM_PER_UNIT, radii=0.003, colors=[_GREY], labels=labels)
        stream.log(f"{FLOOR}/fixtures", things, static=True)


def log_hidden_places(stream: Any, rows: Rows) -> None:
    """Where the animal was last seen before it was hidden, each place with since when.

    Args:
        stream: the replay.
        rows: the track as the tables see it.
    """
    gaps = rows.gaps()
    hidden = (gaps["reason"] == "hidden") & np.isfinite(gaps["x_mm"])
    if not hidden.any():
        return
    x, y, start, stop = (gaps[name][hidden] for name in ("x_mm", "y_mm", "start_s", "stop_s"))
    labels = [f"hidden {a:.1f} to {b:.1f} s" for a, b in zip(start, stop, strict=True)]
    places = np.column_stack([x, y, np.zeros(len(x))]) / MM_PER_UNIT
    points = rr.Points3D(places, radii=0.004, colors=[_PURPLE], labels=labels)
    stream.log(f"{FLOOR}/hidden", points, static=True)
