"""report.html: one self-contained HTML file, made by a Jinja template from a session folder.

It needs no network and no script. Every number comes from the session's tables and session.json.
"""

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.actions.ethogram import ACROSS_GAPS
from liex_lab.actions.vocabulary import NO_POSE, UNLABELLED_COLOUR, action_colours
from liex_lab.optics.camera import SensorCard
from liex_lab.runtime.durable import write_whole
from liex_lab.sessions import Session
from liex_lab.sessions.session import found_video
from liex_lab.sessions.verdict import verdict_in

from ..figures.animals import FRAMES, KINEMATICS
from ..figures.sets import FOLDER, for_the_page
from ..units import counted, day, page, reading, shown, titled
from ..video.relief import scale_mm
from .contact_sheet import thumbnails, whole_image
from .facts import (
    beside_average,
    frame_account,
    methods,
    optics,
    refusal_rows,
    spine_mm,
    warnings,
)

TEMPLATES = Path(__file__).parent / "templates"


_TABLES = (
    *("frames", "poses", "rotations", "kinematics", "bouts", "gaps", "flips", "sessions"),
    *("summary", "transitions", "activity", "zones"),
)


def write_views(folder: str | Path) -> Path:
    """Write the report and the layout files of both replays; returns the report's path."""
    from ..replay.layouts import write_blueprint, write_layout

    session = Session.open(folder)
    write_blueprint(session)
    write_layout(session)
    return write_report(folder)


def write_report(folder: str | Path) -> Path:
    """Write report.html and the figure files of a session folder; returns the report's path."""
    path = Path(folder) / "report.html"
    session = Session.open(folder).narrowed(frames=FRAMES, kinematics=KINEMATICS)
    write_whole(path, render(session, path.parent / FOLDER))
    return path


def render(session: Session, figures: Path | None = None) -> str:
    """The report of a session as one HTML text.

    Args:
        session: the opened session.
        figures: the folder for figure files; None writes none.
    """
    about = session.metadata
    words = list(about.get("actions", {}))
    gaps, flips, video = session.gaps, session.flips, found_video(session)
    sensor = about.get("scene", {}).get("sensor")
    likely = flips.nlargest(12, "p_flip").sort_values("start_s") if len(flips) else flips
    return page(
        TEMPLATES / "report.html.j2",
        about=about,
        counted=counted,
        reading=reading,
        name=session.name,
        animal=about["animal"]["name"],
        headline=headline(session),
        cards=cards(session),
        subject=", ".join(f"{k.replace('_', ' ')} {v}" for k, v in about["subject"].items()),
        verdict=verdict_in(about),
        warnings=warnings(session),
        account=frame_account(session),
        flips=likely.to_dict("records"),
        thumbnails=thumbnails(session),
        whole_image=whole_image(session),
        n_animals=(about.get("verdict") or {}).get("n_animals", 1),
        no_pose=NO_POSE,
        top_mm=scale_mm([session]),
        last_joint=about["animal"]["joints"][-1].replace("_", " "),
        figures=for_the_page(session, figures),
        clips=clip_links(session),
        video=None if video is None else video.name,
        unresolved=about.get("unresolved_actions") or {},
        summary=summary_rows(session, words),
        budget=budget_rows(session, words),
        across_gaps=ACROSS_GAPS,
        arena=session.arena,
        zones=session.zones,
        zone_rows=session.table("zones").to_dict("records") if session.has("zones.parquet") else [],
        spine=spine_mm(session),
        optics=optics(session),
        sensor="" if sensor is None else str(SensorCard.from_dict(sensor)),
        beside_average=beside_average,
        gaps=gaps.nlargest(12, "n_frames_missing").sort_values("start_s").to_dict("records"),
        refused=refusal_rows(session),
        no_actions=about.get("no_actions", ""),
        methods=methods(session),
        glossary=glossary(session),
    )


def clip_links(session: Session) -> dict[str, str]:
    """The videos of actions in the report's folder: action -> file name.

    A video of `rear` also covers rear_supported.
    """
    links = {}
    for word in session.bouts["action"].astype(str).unique():
        parts = word.split("_")
        names = ("_".join(parts[:k]) for k in range(len(parts), 0, -1))
        found = (found_video(session, name) for name in names)
        if video := next(filter(None, found), None):
            links[word] = video.name
    return links


def headline(session: Session) -> str:
    """A summary of the recording in one line."""
    frames = session.metadata["frames"]
    parts = [counted(frames["n_frames"], "frame"), _clock(frames["duration_s"])]
    if frames["fps_median"]:
        parts.append(f"{frames['fps_median']:.1f} frames/s")
    if session.metadata["session_start_time"]:
        parts.append(day(str(session.metadata["session_start_time"])))
    return " · ".join(parts)


def cards(session: Session) -> list[tuple[str, str, str]]:
    """The key numbers: (value, unit, name)."""
    frames = session.metadata["frames"]
    n = frames["n_frames"]
    good = [(f"{frames['n_observed'] / n:.1%}", "", f"of {counted(n, 'frame')} with a pose")]
    error = session.frames["predicted_error_mm"].median()
    if np.isfinite(error):
        good.append((f"{error:.1f}", "mm", "predicted joint error, median"))
    if not session.has("summary.csv"):
        return good
    row = session.summary.iloc[0]
    speed, unit = shown(row["mean_speed_mm_s"], "mm/s")
    first = [
        (f"{row['distance_m']:.2f}", "m", "distance"),
        (reading(speed, unit), unit, "mean speed"),
    ]
    if "rear_count" in row and "tail_beat_hz" not in row:
        rears, what = counted(int(row["rear_count"]), "rear").split()
        first.append((rears, "", f"{what}, {row['rear_s']:.1f} s in all"))
    elif np.isfinite(row.get("tail_beat_hz", np.nan)):
        first.append((f"{row['tail_beat_hz']:.1f}", "Hz", "tail beat, median"))
    return [*first, *good]


def summary_rows(session: Session, words: list[str]) -> list[tuple[str, str, str, str]]:
    """The summary as (title, value, unit, meaning), without columns of `words` (actions) or
    zones.
    """
    if not session.has("summary.csv"):
        return []
    described = session.columns[session.columns["table"] == "summary"].set_index("name")
    row = session.summary.iloc[0]
    budgeted = [*words, "unlabelled"] if words else []
    elsewhere = {
        "session_id",
        "individual",
        *(f"{word}_{what}" for word in budgeted for what, _ in _BUDGET),
    }
    elsewhere |= {f"zone_{zone.name}_{what}" for zone in session.zones for what in ("s", "share")}
    found = []
    for name in session.summary.columns:
        if name in elsewhere:
            continue
        kept = str(described.loc[name, "unit"] or "")
        value, unit = shown(row[name], kept)
        share = name.endswith("_share")
        found.append(
            (
                titled(name, kept),
                f"{value:.1%}" if share else reading(value, unit),
                "" if share else unit,
                str(described.loc[name, "meaning"]),
            )
        )
    return found


_BUDGET = (  # quantity of an action, and its unit
    ("count", ""),
    ("s", "s"),
    ("share", ""),
    ("mean_s", "s"),
    ("per_min", "1/min"),
    ("latency_s", "s"),
)


def budget_rows(session: Session, words: list[str]) -> list[tuple[str, str, list[str]]]:
    """Time budget, a row per action and for unlabelled time: word, colour, values of `_BUDGET`.

    `words` are the actions, in the order of their colours.
    """
    if not words or not session.has("summary.csv"):
        return []
    row = session.summary.iloc[0]
    rows = []
    for word, colour in (*action_colours(words).items(), ("unlabelled", UNLABELLED_COLOUR)):
        if f"{word}_s" in row:  # sessions of an older version lack some of the others
            values = [row.get(f"{word}_{what}", np.nan) for what, _ in _BUDGET]
            texts = [
                f"{value:.1%}" if what == "share" and np.isfinite(value) else reading(value, unit)
                for value, (what, unit) in zip(values, _BUDGET, strict=True)
            ]
            rows.append((word, colour, texts))
    return rows


def glossary(session: Session) -> list[tuple[str, list[dict[Hashable, Any]]]]:
    """The columns of every table of the session: (file, columns)."""
    columns = session.columns.astype(object).where(session.columns.notna(), "")
    files = {
        table: "summary.csv" if table == "summary" else f"{table}.parquet" for table in _TABLES
    }
    return [
        (file, columns[columns["table"] == table].to_dict("records"))
        for table, file in files.items()
        if session.has(file)
    ]


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds, 1) if seconds < 60 else round(seconds), 60)
    return f"{rest:.1f} s" if minutes < 1 else f"{minutes:.0f} min {rest:.0f} s"
