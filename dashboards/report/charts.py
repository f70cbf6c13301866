"""The report's figures from a session's tables: what is drawn, and from which columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.colours import action_colours
from liex_lab.behaviour.around import around_onsets
from liex_lab.sessions import Session

from ..units import shown
from . import svg, svg_matrices

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[np.float64]

_BLUE = "#4477AA"
_GREEN = "#228833"
_RED = "#EE6677"
_PURPLE = "#AA3377"
# column of the kinematics, title, what it is, unit, colour, whether the axis begins at zero
_CURVES = (
    ("speed_mm_s", "Speed", "of the body centre", "mm/s", _BLUE, True),
    ("nose_height_mm", "Nose height", "above the floor", "mm", _GREEN, True),
    ("z_mm", "Height", "of the body centre above the floor", "mm", _GREEN, True),
    ("tail_beat_hz", "Tail beat", "frequency", "Hz", _PURPLE, True),
    ("bend_rad", "Bend", "of the whole body, positive to the left", "rad", _PURPLE, False),
)
_WALKING = ("speed_mm_s", "nose_height_mm")
_SWIMMING = ("speed_mm_s", "z_mm", "bend_rad", "tail_beat_hz")
_AROUND = ("speed_mm_s", "nose_height_mm", "tail_beat_hz")
# columns that are drawn
FRAMES = ("frame_index", "time_s", "gap_before", "predicted_error_mm", "spine_mm")
KINEMATICS = ("time_s", "x_mm", "y_mm", *(curve[0] for curve in _CURVES))
_CERTAIN = 0.05  # of p, corrected


def charts(session: Session, words: list[str]) -> dict[str, str]:
    """All single figures as SVG, by name; empty where the session has no numbers for one.

    Names: lanes, way (path over the floor), error, errors, budget, matrix, activity.

    Args:
        session: the opened session.
        words: the actions, in the order in which they are coloured.
    """
    frames = session.frames
    bouts = session.bouts
    time_s = frames["time_s"].to_numpy(float)
    time = svg.time_scale(session.metadata["frames"]["duration_s"])
    spans = list(zip(bouts["start_s"], bouts["stop_s"], bouts["action"], strict=True))
    empty = session.gaps[
        session.gaps["n_frames_missing"] > 0
    ]  # the others are stamps that were moved
    lost = list(zip(empty["start_s"], empty["stop_s"], strict=True))
    error = frames["predicted_error_mm"]
    drawn = dict.fromkeys(("lanes", "way", "error", "errors", "budget", "matrix", "activity"), "")
    if words or lost:
        drawn["lanes"] = svg.lanes(spans, words, lost, time)
    drawn["error"] = svg.curve(time_s, _across_gaps(error, frames), time, "mm", _RED, last=True)
    drawn["errors"] = svg.histogram(error.to_numpy(float), "mm", _RED)
    if session.has("kinematics.parquet"):
        x_mm = _across_gaps(session.kinematics["x_mm"], frames)
        y_mm = _across_gaps(session.kinematics["y_mm"], frames)
        drawn["way"] = svg.trajectory(x_mm, y_mm, time_s, outlines(session))
    if session.has("summary.csv"):
        row = session.summary.iloc[0]
        shares = [
            (word, float(row[f"{word}_share"]), colour)
            for word, colour in action_colours(words).items()
            if f"{word}_share" in row
        ]
        drawn["budget"] = svg.budget(shares)
    if session.has("transitions.parquet"):
        drawn["matrix"] = _matrix(session.table("transitions"), words)
    if session.has("activity.parquet"):
        drawn["activity"] = _activity(session.table("activity"), words)
    return drawn


def curves(session: Session) -> list[tuple[str, str, str]]:
    """What the body did over time: (title, what it is, SVG).

    Args:
        session: the opened session.
    """
    if not session.has("kinematics.parquet"):
        return []
    frames = session.frames
    moved = session.kinematics
    bouts = session.bouts
    time_s = frames["time_s"].to_numpy(float)
    time = svg.time_scale(session.metadata["frames"]["duration_s"])
    rearing = bouts["action"].astype(str).str.startswith("rear")
    rears = bouts.loc[rearing, ["start_s", "stop_s"]].to_numpy(float)
    wanted = _SWIMMING if "tail_beat_hz" in moved else _WALKING
    made = []
    for name, title, what, unit, colour, from_zero in _CURVES:
        if name in wanted and name in moved:
            shaded = [(float(a), float(b)) for a, b in rears] if name == "nose_height_mm" else []
            values, unit = shown(_across_gaps(moved[name], frames), unit)
            what = f"{what}, {unit}{'; rearing shaded' if shaded else ''}"
            made.append(
                (title, what, svg.curve(time_s, values, time, unit, colour, shaded, from_zero))
            )
    return made


def traces(session: Session) -> list[tuple[str, Array, Array, str]]:
    """Curves to look at over time, broken at gaps of the camera; the last is the predicted error.

    Args:
        session: the opened session.

    Returns:
        (name with its unit, time s (n,), values (n,), colour) of each.
    """
    frames = session.frames
    time_s = frames["time_s"].to_numpy(float)
    made: list[tuple[str, Array, Array, str]] = []
    if session.has("kinematics.parquet"):
        moved = session.kinematics
        wanted = _SWIMMING if "tail_beat_hz" in moved else _WALKING
        for name, title, _, unit, colour, _ in _CURVES:
            if name in wanted and name in moved:
                values, unit = shown(_across_gaps(moved[name], frames), unit)
                made.append((f"{title}, {unit}", time_s, values, colour))
    return [
        *made,
        ("Predicted error, mm", time_s, _across_gaps(frames["predicted_error_mm"], frames), _RED),
    ]


def around_actions(session: Session, words: list[str]) -> list[tuple[str, str]]:
    """Peri-event curves of the actions: (title, SVG), all of a measure on the same scale.

    Args:
        session: the opened session.
        words: the actions.
    """
    if not session.has("kinematics.parquet"):
        return []
    moved = session.kinematics
    made = []
    for name, title, _, unit, colour, _ in _CURVES:
        if name not in _AROUND or name not in moved:
            continue
        found = {word: around_onsets(moved, session.bouts, word, name) for word in words}
        if name == "nose_height_mm":  # on four feet there is nothing to see
            found = {word: one for word, one in found.items() if word.startswith("rear")}
        known = {word: one for word, one in found.items() if one is not None}
        if not known:
            continue
        scale, unit = shown(1.0, unit)
        top = scale * max(float(np.nanmax(one.high)) for one in known.values())
        for word, one in known.items():
            low, median, high = (scale * some for some in (one.low, one.median, one.high))
            limits = (0.0, 1.05 * top or 1.0)
            drawn = svg_matrices.around(one.time_s, low, median, high, unit, colour, limits)
            made.append((f"{title} around {word.replace('_', ' ')}, {one.n} bouts", drawn))
    return made


def pictures(session: Session) -> list[tuple[str, str, str, str]]:
    """The contact sheet: the kept depth pictures with the skeleton over them, in order of time.

    Args:
        session: the opened session.

    Returns:
        (SVG, when, the action that the ethogram names there or an empty text, its colour) of each.
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
    for entry in kept:
        depth = cv2.imread(str(session.path / entry["file"]), cv2.IMREAD_UNCHANGED)
        if depth is None:
            continue
        index = entry["frame_index"]
        uv = poses.loc[poses["frame_index"] == index, ["u_px", "v_px"]].to_numpy(float)
        reach_mm = 0.9 * float(
            frames["spine_mm"].median()
        )  # an animal on its feet is about half its length high
        drawn = svg.picture(
            np.asarray(depth, np.uint16), uv, bones, entry["left_px"], entry["top_px"], reach_mm
        )
        time_s = float(frames.loc[index, "time_s"])
        word = _word_at(session.bouts, time_s)
        colour = action_colours(words).get(word, "")
        made.append((drawn, f"{time_s:.2f} s", word, colour))
    return made


def _word_at(bouts: pd.DataFrame, time_s: float) -> str:
    """The action at a moment, empty where none is named."""
    here = bouts.loc[
        (bouts["start_s"] <= time_s + 1e-6) & (bouts["stop_s"] > time_s + 1e-6), "action"
    ]
    return str(here.iloc[0]) if len(here) else ""


def outlines(session: Session) -> list[tuple[str, Array]]:
    """The arena's walls, where known, and the zones, by name: corners (n, 2) mm in the arena frame.

    Args:
        session: the opened session.
    """
    walls = session.arena.outline_mm()
    known = [(svg.ARENA, walls)] if len(walls) else []
    return known + [(zone.name, zone.outline_mm()) for zone in session.zones]


def _matrix(table: pd.DataFrame, words: list[str]) -> str:
    """The transitions as a matrix of the words that occur; empty with fewer than two."""
    seen = [
        word
        for word in words
        if (table.loc[table["from_action"] == word, "n_from"] > 0).any()
        or (table.loc[table["to_action"] == word, "n"] > 0).any()
    ]
    if len(seen) < 2:
        return ""
    place = {word: k for k, word in enumerate(seen)}
    table = table[table["from_action"].isin(seen) & table["to_action"].isin(seen)]
    at = table["from_action"].map(place).to_numpy(int), table["to_action"].map(place).to_numpy(int)

    def spread(values: Any) -> Array:
        out = np.full((len(seen), len(seen)), np.nan)
        out[at] = np.asarray(values, float)
        return out

    certain = spread(table["p_fdr"] <= _CERTAIN) == 1.0
    probability = spread(table["probability"])
    by_chance = spread(table["by_chance"])
    return svg_matrices.matrix(seen, probability, by_chance, certain, spread(table["n"]))


def _activity(table: pd.DataFrame, words: list[str]) -> str:
    parts = [
        (word, table[f"{word}_s"].to_numpy(float), colour)
        for word, colour in action_colours(words).items()
        if f"{word}_s" in table
    ]
    numbers = (table[name].to_numpy(float) for name in ("start_s", "stop_s", "observed_s"))
    start_s, stop_s, observed_s = numbers
    return svg_matrices.activity(start_s, stop_s, parts, observed_s)


def _across_gaps(values: pd.Series[Any], frames: pd.DataFrame) -> Array:
    """Values (n,) with the first one after a gap of the camera taken out.

    No line is then drawn across the gap.
    """
    return np.asarray(values.where(frames["gap_before"] == 0), float)
