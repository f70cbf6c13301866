"""report.html: one self-contained HTML file, made by a Jinja template from a session folder alone.

It needs no network and no script. Glue: every number comes from the session's tables and
session.json.
"""

from __future__ import annotations

from collections.abc import Hashable
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.sessions import Session
from liex_lab.sessions.failure import write_whole
from liex_lab.sessions.verdict import verdict_in

from . import svg
from .charts import FRAMES, KINEMATICS, around_actions, charts, curves, pictures
from .quality import flip_rows, frame_account, warnings

TEMPLATES = Path(__file__).parent / "templates"
_TABLES = {
    "frames": "frames.parquet",
    "poses": "poses.parquet",
    "rotations": "rotations.parquet",
    "kinematics": "kinematics.parquet",
    "bouts": "bouts.parquet",
    "gaps": "gaps.parquet",
    "flips": "flips.parquet",
    "sessions": "sessions.parquet",
    "summary": "summary.csv",
    "transitions": "transitions.parquet",
    "activity": "activity.parquet",
    "zones": "zones.parquet",
}


def write_report(folder: str | Path) -> Path:
    """Make report.html in a session's folder from what lies in it.

    Args:
        folder: the session's folder.

    Returns:
        Path of the report.
    """
    path = Path(folder) / "report.html"
    write_whole(path, render(Session.open(folder).narrowed(frames=FRAMES, kinematics=KINEMATICS)))
    return path


def render(session: Session) -> str:
    """The report of a session as one HTML text.

    Args:
        session: the opened session.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    pages = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    words = list(session.metadata.get("actions", {}))
    return pages.get_template("report.html.j2").render(
        name=session.name,
        animal=session.metadata["animal"]["name"],
        headline=headline(session),
        cards=cards(session),
        subject=", ".join(
            f"{name.replace('_', ' ')} {value}"
            for name, value in session.metadata["subject"].items()
        ),
        verdict=verdict_in(session.metadata),
        warnings=warnings(session),
        account=frame_account(session),
        flips=flip_rows(session),
        pictures=pictures(session),
        charts=charts(session, words),
        curves=curves(session),
        around=around_actions(session, words),
        actions=action_rows(session, words),
        summary=summary_rows(session, words),
        budget=budget_rows(session, words),
        zones=zone_rows(session),
        facts=facts(session),
        gaps=gap_rows(session),
        methods=methods(session),
        glossary=glossary(session),
    )


def action_rows(session: Session, words: list[str]) -> list[tuple[str, str, str, str]]:
    """The vocabulary: (word, colour, meaning, what the recording's frame rate cannot tell of it).

    Args:
        session: the opened session.
        words: the actions, in the order in which they are coloured.
    """
    unresolved = session.metadata.get("unresolved_actions") or {}
    return [
        (
            word,
            svg.action_colour(k),
            session.metadata["actions"][word],
            str(unresolved.get(word, "")),
        )
        for k, word in enumerate(words)
    ]


def headline(session: Session) -> str:
    """What was recorded, in one line.

    Args:
        session: the opened session.
    """
    frames = session.metadata["frames"]
    parts = [f"{frames['n_frames']:,} frames", _clock(frames["duration_s"])]
    if frames["fps_median"]:
        parts.append(f"{frames['fps_median']:.1f} frames/s")
    if session.metadata["session_start_time"]:
        parts.append(str(session.metadata["session_start_time"]))
    return " · ".join(parts)


def cards(session: Session) -> list[tuple[str, str, str]]:
    """The few numbers to see first: (value, unit, what).

    Args:
        session: the opened session.
    """
    frames = session.metadata["frames"]
    good = [(f"{frames['n_observed'] / frames['n_frames']:.1%}", "", "of the frames with a pose")]
    error = session.frames["predicted_error_mm"].median()
    if np.isfinite(error):
        good.append((f"{error:.1f}", "mm", "predicted joint error, median"))
    if not session.has("summary.csv"):
        return good
    row = session.summary.iloc[0]
    shown = [
        (f"{row['distance_m']:.2f}", "m", "distance"),
        (_number(row["mean_speed_mm_s"]), "mm/s", "mean speed"),
    ]
    if "rear_count" in row and "tail_beat_hz" not in row:
        shown.append((f"{int(row['rear_count'])}", "", f"rears, {row['rear_s']:.1f} s in all"))
    elif np.isfinite(row.get("tail_beat_hz", np.nan)):
        shown.append((f"{row['tail_beat_hz']:.1f}", "Hz", "tail beat, median"))
    return [*shown, *good]


def summary_rows(session: Session, words: list[str]) -> list[tuple[str, str, str, str]]:
    """The summary as (column, value, unit, meaning), but for the columns of the actions and zones.

    Args:
        session: the opened session.
        words: the actions.
    """
    if not session.has("summary.csv"):
        return []
    described = session.columns[session.columns["table"] == "summary"].set_index("name")
    row = session.summary.iloc[0]
    elsewhere = {
        "session_id",
        "individual",
        *(f"{word}_{what}" for word in words for what, _ in _BUDGET),
    }
    elsewhere |= {f"zone_{zone.name}_{what}" for zone in session.zones for what in ("s", "share")}
    return [
        (
            name,
            f"{row[name]:.1%}" if name.endswith("_share") else _number(row[name]),
            "" if name.endswith("_share") else str(described.loc[name, "unit"]),
            str(described.loc[name, "meaning"]),
        )
        for name in session.summary.columns
        if name not in elsewhere
    ]


_BUDGET = (
    ("count", "bouts"),
    ("s", "time, s"),
    ("share", "share"),
    ("mean_s", "mean, s"),
    ("per_min", "per minute"),
    ("latency_s", "first after, s"),
)


def budget_rows(session: Session, words: list[str]) -> list[tuple[str, str, list[str]]]:
    """Time budget, a row per action: word, colour, and the numbers that `_BUDGET` names.

    Args:
        session: the opened session.
        words: the actions, in the order in which they are coloured.
    """
    if not session.has("summary.csv"):
        return []
    row = session.summary.iloc[0]
    rows = []
    for k, word in enumerate(words):
        if f"{word}_s" in row:  # sessions of an older version lack some of the others
            values = [row.get(f"{word}_{what}", np.nan) for what, _ in _BUDGET]
            texts = [
                f"{value:.1%}" if what == "share" and np.isfinite(value) else _number(value)
                for value, (what, _) in zip(values, _BUDGET, strict=True)
            ]
            rows.append((word, svg.action_colour(k), texts))
    return rows


def zone_rows(session: Session) -> list[tuple[str, list[str]]]:
    """A row per zone: name; time, share, visits, first after, mean visit, distance.

    Args:
        session: the opened session.
    """
    if not session.has("zones.parquet"):
        return []
    table = session.table("zones")
    numbers = table[["time_s", "n_visits", "latency_s", "mean_visit_s", "distance_mm"]].to_numpy(
        float
    )
    return [
        (
            str(name),
            [
                _number(row[0]),
                f"{share:.1%}",
                f"{row[1]:.0f}",
                *(_number(value) for value in row[2:]),
            ],
        )
        for name, share, row in zip(table["zone"], table["share"], numbers, strict=True)
    ]


def facts(session: Session) -> list[tuple[str, str]]:
    """Where the numbers come from: recording, camera, animal, software, cost, as (what, value).

    Args:
        session: the opened session.
    """
    about = session.metadata
    camera = about["camera"]
    frames = about["frames"]
    animal = about["animal"]
    flags = ", ".join(
        f"{count} {flag.replace('_', ' ')}" for flag, count in frames["flags"].items()
    )
    size = f"{animal['spine_mm']:.1f} mm" if animal.get("spine_mm") else "unknown"
    memory = about.get("peak_memory_mb")
    zones = ", ".join(zone.name for zone in session.zones)
    known = [
        ("Recording", f"{about['input']['name']} ({about['input']['format']})"),
        ("Input, sha256", about["input"]["sha256"]),
        (
            "Animal",
            f"{about['individual']}, {animal['name']}, spine {size} "
            f"({animal.get('origin', 'origin unknown')})",
        ),
        (
            "Frames",
            f"{frames['n_frames']:,} recorded ({flags}); {frames['n_missing']} not delivered, in "
            f"{frames['n_gaps']} gaps",
        ),
        (
            "Camera",
            f"{camera['width']} x {camera['height']} px, fx {camera['fx']:.1f}, fy "
            f"{camera['fy']:.1f}, cx {camera['cx']:.1f}, cy {camera['cy']:.1f} px "
            f"({camera['source']}), {camera['floor_distance_mm']:.0f} mm from the floor",
        ),
        ("Arena", f"{session.arena}{f'; zones: {zones}' if zones else ''}"),
        (
            "Model",
            f"{about['model'].get('name', 'none')} {about['model'].get('sha256', '')[:16]}".strip(),
        ),
        (
            "Software",
            ", ".join(f"{name} {v}" for name, v in about["versions"].items() if v != "unknown"),
        ),
        (
            "Run",
            f"{about['timings_s']['total']:.1f} s, {about['frames_per_s']:.0f} frames/s"
            + (f", peak memory {memory:.0f} MB" if memory else ""),
        ),
    ]
    if undone := _optics(session):
        known.insert(5, ("Optics", undone))
    subject = ", ".join(f"{name} {value}" for name, value in about["subject"].items())
    return known + ([("Subject", subject)] if subject else [])


def _optics(session: Session) -> str:
    """What was undone between the real camera and the ideal one; empty where nothing was.

    A sentence without its full stop.
    """
    optics = session.metadata["camera"].get("optics", {})
    undone = []
    if bent := optics.get("distortion"):
        undone.append(
            f"the lens distortion ({bent['model']} "
            f"{', '.join(f'{k:g}' for k in bent['coefficients'])})"
        )
    if water := optics.get("water"):
        undone.append(
            f"the refraction at a water surface {water['height_mm']:g} mm below the lens (index "
            f"{water['refractive_index']:g}, {water['ranging'].replace('_', ' ')} camera)"
        )
    if optics.get("mirrored"):
        undone.append("the mirroring of the pictures")
    what = " and ".join(undone)
    return (
        f"{what} undone; camera and pictures are those of an ideal camera in air" if undone else ""
    )


def gap_rows(session: Session) -> list[tuple[str, str, str, str]]:
    """The longest gaps, at most twelve, in order of time: (from, to, frames, reason); times in s.

    Args:
        session: the opened session.
    """
    shown = session.gaps.nlargest(12, "n_frames_missing").sort_values("start_s")
    return [
        (
            f"{row.start_s:.2f}",
            f"{row.stop_s:.2f}",
            str(row.n_frames_missing),
            str(row.reason).replace("_", " "),
        )
        for row in shown.itertuples()
    ]


def methods(session: Session) -> list[str]:
    """Paragraphs for a methods section, from the run's own record.

    Args:
        session: the opened session.
    """
    about = session.metadata
    camera = about["camera"]
    frames = about["frames"]
    animal = about["animal"]
    model = about["model"]
    error = session.frames["predicted_error_mm"].median()
    rate = f" at {frames['fps_median']:.1f} frames/s" if frames["fps_median"] else ""
    learned = (
        f" with the model {model['name']} (sha256 {model.get('sha256', '')[:16]})"
        if model.get("name")
        else ""
    )
    size = (
        f"; the animal's length along them is {animal['spine_mm']:.1f} mm"
        if animal.get("spine_mm")
        else ""
    )
    origin = f" ({animal['origin']})" if size and animal.get("origin") else ""
    known = (
        f" The median joint error that the model predicts is {error:.1f} mm."
        if np.isfinite(error)
        else ""
    )
    first = (
        f"Depth images of one {animal['name']} ({camera['width']} x {camera['height']} pixels, "
        f"{frames['n_frames']:,} frames{rate}, camera {camera['floor_distance_mm']:.0f} mm from "
        f"the floor) were analysed with liex_lab {about['versions']['liex_lab']}{learned}. A "
        f"skeleton of {len(animal['joints'])} joints ({', '.join(animal['joints'])}) on the body's "
        f"mid-axis was fitted to every frame{size}{origin}. {frames['n_observed']:,} of "
        f"{frames['n_frames']:,} recorded frames have a pose, {frames['flags'].get('doubtful', 0)} "
        f"of them flagged as doubtful; {frames['n_missing']} further frames were not delivered by "
        f"the camera.{known} Positions are millimetres in the arena frame, z up from the floor."
    )
    if undone := _optics(session):
        first += f" {undone[0].upper()}{undone[1:]}."
    return [first, *_by_hand(session), *_behaviour_methods(session)]


def _by_hand(session: Session) -> list[str]:
    """What people corrected, as a methods section has to say it; empty where nothing was."""
    told = session.metadata.get("corrections")
    if not told:
        return []
    kinds = {
        "flip": "head and tail exchanged over a stretch",
        "joint": "joints placed",
        "bout": "edits of bouts",
    }
    parts = ", ".join(f"{text}: {told[kind]}" for kind, text in kinds.items() if told.get(kind))
    return [
        f"After measurement, {told['n']} corrections were made by hand by "
        f"{', '.join(told['authors'])} ({parts})."
    ]


def _behaviour_methods(session: Session) -> list[str]:
    rules = session.metadata.get("rules")
    actions = session.metadata.get("actions", {})
    if not rules or not actions:
        return []
    named = "; ".join(f"{word.replace('_', ' ')}: {meaning}" for word, meaning in actions.items())
    return [
        "Speed is that of the mean of all joints but the nose over the floor, from its positions "
        f"{rules['speed_half_window_s']:g} s before and after at the frames' true times, never "
        "across a gap. Every frame has at most one name, given by rule, the first that applies "
        f"of: {named}. Bouts of one kind with less than {rules['merge_pauses_s']:g} s between them "
        f"were joined, then those shorter than {rules['min_bout_s']:g} s dropped. Shares are of "
        f"the {session.metadata['frames']['observed_s']:.1f} s in which the animal was observed."
    ]


def glossary(session: Session) -> list[tuple[str, list[dict[Hashable, Any]]]]:
    """The columns of every table that the session holds: (file, columns).

    Args:
        session: the opened session.
    """
    columns = session.columns.astype(object).where(session.columns.notna(), "")
    return [
        (file, columns[columns["table"] == table].to_dict("records"))
        for table, file in _TABLES.items()
        if session.has(file)
    ]


def _number(value: Any) -> str:
    """A number as a person would write it: counts whole, the rest of four digits, NaN a dash."""
    if isinstance(value, int | np.integer):
        return f"{value:,}"
    if not np.isfinite(value):
        return "–"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds, 1) if seconds < 60 else round(seconds), 60)
    return f"{rest:.1f} s" if minutes < 1 else f"{minutes:.0f} min {rest:.0f} s"
