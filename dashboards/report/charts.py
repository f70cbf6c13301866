"""The report's contact sheet, and the whole depth image of a session with its scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.vocabulary import action_colours
from liex_lab.sessions import Session

from ..video.relief import Relief, put_back, scale_mm
from . import contact_sheet
from .contact_sheet import BESIDE, Mark, scene_marks

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]


def pictures(session: Session) -> list[tuple[str, str, str, str]]:
    """The contact sheet: the session's thumbnails with scene and skeleton, in order of time.

    Returns:
        (SVG, time, the ethogram's action at that time or an empty text, its colour) of each.
    """
    import cv2

    made = []
    kept = session.metadata.get("thumbnails", [])
    frames = session.frames.set_index("frame_index")
    poses = session.table(
        "poses", ["frame_index", "u_px", "v_px"], [entry["frame_index"] for entry in kept]
    )
    bones = [(int(a), int(b)) for a, b in session.metadata["animal"]["bones"]]
    words = list(session.metadata.get("actions", {}))
    marks = scene_marks(session) if kept else []
    relief = _relief(session)
    for entry in kept:
        depth = cv2.imread(str(session.path / entry["file"]), cv2.IMREAD_UNCHANGED)
        if depth is None:
            continue
        index = entry["frame_index"]
        uv = poses.loc[poses["frame_index"] == index, ["u_px", "v_px"]].to_numpy(float)
        rgb = _in_colours(relief, depth, entry)
        drawn = contact_sheet.picture(rgb, uv, bones, entry["left_px"], entry["top_px"], marks)
        time_s = float(frames.loc[index, "time_s"])
        word = _word_at(session.bouts, time_s)
        colour = action_colours(words).get(word, "")
        made.append((drawn, f"{time_s:.2f} s", word, colour))
    return made


def whole_picture(session: Session) -> tuple[str, str] | None:
    """The whole depth image with another animal in view that is not tracked.

    Returns:
        SVG, and its time; None if the session has none.
    """
    import cv2

    entry = session.metadata.get("whole_picture")
    depth = cv2.imread(str(session.path / entry["file"]), cv2.IMREAD_UNCHANGED) if entry else None
    if not entry or depth is None:
        return None
    index = entry["frame_index"]
    uv = session.table("poses", ["u_px", "v_px"], [index])[["u_px", "v_px"]].to_numpy(float)
    frames = session.frames.set_index("frame_index")
    marks = [
        *scene_marks(session),
        Mark(BESIDE, np.array([entry["beside_px"]], float), "not measured"),
    ]
    drawn = contact_sheet.picture(
        _in_colours(_relief(session), depth, entry),
        uv,
        [(int(a), int(b)) for a, b in session.metadata["animal"]["bones"]],
        0,
        0,
        marks,
        unit=depth.shape[1] / 250.0,
        lettered=True,
    )
    return drawn, f"{float(frames.loc[index, 'time_s']):.2f} s"


def _relief(session: Session) -> Relief:
    """Heights above the floor in colours, on the scale of the session's video."""
    return Relief(session, scale_mm([session]))


def _in_colours(relief: Relief, depth: Any, entry: dict[str, Any]) -> NDArray[np.uint8]:
    """The cropped depth image as relief: (h, w, 3) uint8 RGB."""
    cut = np.asarray(depth, np.uint16)
    left, top = int(entry["left_px"]), int(entry["top_px"])
    side = (cut.shape[1], cut.shape[0])
    return relief.picture(put_back(cut, left, top, relief.shape), left, top, side, side)


def _word_at(bouts: pd.DataFrame, time_s: float) -> str:
    """The action at a moment; empty if there is none."""
    here = bouts.loc[
        (bouts["start_s"] <= time_s + 1e-6) & (bouts["stop_s"] > time_s + 1e-6), "action"
    ]
    return str(here.iloc[0]) if len(here) else ""
