"""report.html: one self-contained HTML file, made by a Jinja template from a session folder.

It needs no network and no script. Every number comes from the session's tables and session.json.
"""

from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.actions import ethogram, vocabulary
from liex_lab.behaviour.body import axis_of
from liex_lab.optics.camera import SensorCard
from liex_lab.runtime.durable import write_whole
from liex_lab.sessions import Session, correcting, verdict
from liex_lab.sessions.session import found_video
from liex_lab.tracking import identity
from liex_lab.tracking.track import DOUBTFUL

from ..figures.animals import FRAMES, KINEMATICS
from ..figures.sets import FOLDER, for_the_page
from ..units import counted, day, page, paragraphs, reading, shown, titled
from ..video.film import scale_mm
from .contact_sheet import thumbnails, whole_image

TEMPLATES = Path(__file__).parent / "templates"


def methods(session: Session) -> list[str]:
    """Paragraphs for a methods section, from the run's record; the text is in methods.j2."""
    about = session.metadata
    axis = axis_of(about["animal"])
    actions = about.get("actions") or {}
    named = {word.replace("_", " "): meaning for word, meaning in actions.items()}
    sources = {str(source) for source in session.bouts["source"]}
    if about.get("action_model"):
        sources.add("model")
    elif actions and not sources & {"model", "rule"}:
        sources.add("rule")
    return paragraphs(
        TEMPLATES / "methods.j2",
        about=about,
        counted=counted,
        kind=axis.kind,
        trunk=[axis.joints[k] for k in axis.trunk],
        spine=spine_mm(session),
        error=session.frames["predicted_error_mm"].median(),
        optics=optics(session),
        doubtful=_n_doubtful(about["frames"]),
        corrections=about.get("corrections"),
        rules=about.get("rules"),
        sources=sources,
        recogniser=_recogniser(session),
        n_refused=len((about.get("refused_bouts") or {}).get("bouts", [])),
        n_human=int((session.bouts["source"] == "human").sum()),
        actions=actions,
        defined=[f"{word}: {meaning}" for word, meaning in named.items() if meaning],
        bare=[word for word, meaning in named.items() if not meaning],
        checked=any("(checked: " in meaning for meaning in actions.values()),
        across_gaps=ethogram.ACROSS_GAPS,
    )


def warnings(session: Session) -> list[str]:
    """Warnings as sentences, those of the recording first; the text is in warnings.j2."""
    about = session.metadata
    frames = about["frames"]
    hidden = int(frames["flags"].get("hidden", 0))
    # only two columns: the dashboard reads them for every session of a study
    error, spine = session.table("frames", ["predicted_error_mm", "spine_mm"]).median()
    behaviour = session.has("summary.csv")
    fps = frames["fps_median"] or 0.0
    slow: list[str] = []
    if behaviour:
        columns = session.columns
        slow = list(
            dict.fromkeys(
                columns["name"][
                    (columns["unreliable_below_fps"] > fps)
                    & columns["table"].isin(["kinematics", "bouts"])
                ]
            )
        )
    noise = session.summary.iloc[0].get("speed_noise_mm_s", np.nan) if behaviour else np.nan
    return about["problems"] + paragraphs(
        TEMPLATES / "warnings.j2",
        counted=counted,
        shown=shown,
        frames=frames,
        n_beside=_unmeasured(about),
        hidden=hidden,
        lost=frames["n_frames"] - frames["n_observed"] - hidden,
        doubtful=_n_doubtful(frames),
        error=error,
        spine=spine,
        flips=session.flips,
        crossings=_crossings(session),
        unclear=identity.UNCLEAR,
        disagreements=correcting.disagreements(session),
        behaviour=behaviour,
        noise=noise,
        pause=(about.get("rules") or {}).get("pause_below_mm_s", np.nan),
        schema=about["schema_version"],
        n_gaps=len(session.gaps),
        slow=slow,
        fps=fps,
        n_contradicting=len(contradicting(session)),
        lost_share=0.02,  # of the frames
        doubtful_share=0.05,  # of the frames
        error_share=0.1,  # of the length
        noise_share=1.0,  # of the pause threshold
    )


def _n_doubtful(frames: dict[str, Any]) -> int:
    """Measured poses that are not trusted."""
    return sum(frames["flags"].get(flag, 0) for flag in DOUBTFUL)


def _recogniser(session: Session) -> dict[str, Any]:
    """The recogniser, its training data and its decision rate."""
    model = session.metadata.get("action_model") or {}
    planned = session.metadata.get("plan", {}).get("actions") or {}
    hashes = [str(one) for one in session.bouts["model_hash"] if str(one)]
    return {
        "name": planned.get("model") or f"{session.metadata['animal']['name']}, bundled",
        "digest": str(model.get("sha256") or (hashes[0] if hashes else ""))[:16],
        "labels": str(model.get("labels", "")),
        "n": int(model.get("n_recordings", 0)),
        "clock_hz": model.get("clock_hz"),
    }


def spine_mm(session: Session) -> float:
    """The displayed length of the animal: the fitted chain's, median over the frames, mm."""
    return float(session.frames["spine_mm"].median())


def optics(session: Session) -> str:
    """The corrected optical effects (lens, water, mirror) as text; empty if there are none.

    It has no full stop.
    """
    found = session.metadata["camera"].get("optics", {})
    undone = []
    if bent := found.get("distortion"):
        undone.append(
            f"the lens distortion ({bent['model']} "
            f"{', '.join(f'{k:g}' for k in bent['coefficients'])})"
        )
    if water := found.get("water"):
        undone.append(
            f"the refraction at a water surface {water['height_mm']:g} mm below the lens (index "
            f"{water['refractive_index']:g}, {water['ranging'].replace('_', ' ')} camera)"
        )
    if found.get("mirrored"):
        undone.append("the mirroring of the images")
    if not undone:
        return ""
    return f"{' and '.join(undone)} undone; camera and images are those of an ideal camera in air"


def beside_average(shape: Mapping[str, Any]) -> str:
    """The difference between this animal and the average one of its length, in words.

    Args:
        shape: section `animal.shape` of session.json.
    """
    moved = [float(np.linalg.norm(joint)) for joint in shape.get("joints_moved", ())]
    return " ".join(paragraphs(TEMPLATES / "shape.j2", shape=shape, moved=moved))


def contradicting(session: Session) -> pd.DataFrame:
    """Bouts that a person named or a correction changed, and that contradict their definition."""
    bouts = session.bouts
    if "contradicts" not in bouts:
        return bouts.iloc[:0]
    return bouts[bouts["contradicts"].fillna("") != ""]


def refusal_rows(session: Session) -> list[tuple[str, str, str, str, str]]:
    """Bouts that contradict their definition: the renamed ones first, then the unchanged ones.

    Returns:
        (from, to, name, what was done, contradiction), times in s.
    """
    refused = (session.metadata.get("refused_bouts") or {}).get("bouts", [])
    rows = [(one, one["named"] or "unlabelled", one["why"]) for one in refused]
    kept = contradicting(session).to_dict("records")
    rows += [(one, f"left, by {one['source']}", one["contradicts"]) for one in kept]
    return [
        (f"{one['start_s']:.2f}", f"{one['stop_s']:.2f}", str(one["action"]), str(what), str(why))
        for one, what, why in rows
    ]


def frame_account(session: Session) -> list[tuple[str, float, int, str]]:
    """The classification of all frames that the camera should have taken.

    Returns:
        (class, share, number, CSS class for its colour) of trusted, doubtful, unclear, hidden, lost
            and undelivered frames; unclear and hidden ones only if present.
    """
    frames = session.metadata["frames"]
    doubtful, unclear = (int(frames["flags"].get(flag, 0)) for flag in DOUBTFUL)
    hidden = int(frames["flags"].get("hidden", 0))
    lost = frames["n_frames"] - frames["n_observed"] - hidden
    parts = [
        ("trusted pose", frames["n_observed"] - doubtful - unclear, "good"),
        ("doubtful pose", doubtful, "doubt"),
        *([("unclear which animal", unclear, "doubt")] if unclear else []),
        *([("hidden", hidden, "gone")] if hidden else []),
        ("no pose", lost, "lost"),
        ("not delivered", frames["n_missing"], "gone"),
    ]
    total = max(sum(count for _, count, _ in parts), 1)
    return [(what, count / total, int(count), kind) for what, count, kind in parts]


_TABLES = (
    *("frames", "poses", "rotations", "kinematics", "bouts", "gaps", "flips", "sessions"),
    *("summary", "transitions", "activity", "hours", "rhythm", "zones", "events"),
    *("periods", "crossings", "interactions", "interaction_totals", "triggers"),
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
    write_whole(
        path,
        render(
            Session.open(folder).narrowed(frames=FRAMES, kinematics=KINEMATICS),
            path.parent / FOLDER,
        ),
    )
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
        verdict=verdict.verdict_in(about),
        warnings=warnings(session),
        account=frame_account(session),
        flips=likely.to_dict("records"),
        crossings=_crossings(session),
        thumbnails=thumbnails(session),
        whole_image=whole_image(session),
        n_animals=_unmeasured(about) + 1,
        no_pose=vocabulary.NO_POSE,
        top_mm=scale_mm([session]),
        last_joint=about["animal"]["joints"][-1].replace("_", " "),
        figures=for_the_page(session, figures),
        clips=clip_links(session),
        video=None if video is None else video.name,
        unresolved=about.get("unresolved_actions") or {},
        summary=summary_rows(session, words),
        rhythm=rhythm_rows(session),
        periods=session.table("periods").to_dict("records")
        if session.has("periods.parquet")
        else [],
        budget=budget_rows(session, words),
        across_gaps=ethogram.ACROSS_GAPS,
        arena=session.arena,
        zones=session.zones,
        zone_rows=session.table("zones").to_dict("records") if session.has("zones.parquet") else [],
        spine=spine_mm(session),
        optics=optics(session),
        sensor="" if sensor is None else str(SensorCard.from_dict(sensor)),
        beside_average=beside_average,
        gaps=gaps.nlargest(12, "n_frames_missing").sort_values("start_s").to_dict("records"),
        refused=refusal_rows(session),
        interactions=interaction_rows(session),
        no_actions=about.get("no_actions", ""),
        methods=methods(session),
        glossary=glossary(session),
    )


def _unmeasured(about: Mapping[str, Any]) -> int:
    """How many animals are in view and not measured, by the content of session.json."""
    found = about.get("verdict") or {}
    return max(0, int(found.get("n_animals", 1)) - int(found.get("n_measured", 1)))


def _crossings(session: Session) -> list[dict[Hashable, Any]]:
    """The crossings of several animals."""
    known = session.has("crossings.parquet")
    return session.crossings.to_dict("records") if known else []


def interaction_rows(session: Session) -> dict[str, list[str]]:
    """Share and number of each interaction by pair: the pairs under '', then a row per action.

    `isolated` stands under every pair of its animal. Empty for a session of one animal.
    """
    if not session.has("interaction_totals.parquet"):
        return {}
    table = session.interaction_totals
    totals = {
        (agent, target, action): f"{share:.1%} ({count})" if count else "–"
        for agent, target, action, share, count in table[
            ["agent", "target", "action", "share", "count"]
        ].itertuples(index=False, name=None)
    }
    pairs = list(dict.fromkeys(key[:2] for key in totals if key[1]))
    rows = {"": [f"{agent} → {target}" for agent, target in pairs]}
    for action in table["action"].unique():
        rows[action] = [
            totals.get((*pair, action)) or totals[pair[0], "", action] for pair in pairs
        ]
    return rows


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
    return _rows_of(row, [name for name in row.index if name not in elsewhere], described)


def rhythm_rows(session: Session) -> list[tuple[str, str, str, str]]:
    """The known measures of light and dark, as `summary_rows`; [] without light in the plan."""
    if not session.has("rhythm.parquet"):
        return []
    described = session.columns[session.columns["table"] == "rhythm"].set_index("name")
    row = session.rhythm.iloc[0]
    known = [name for name in row.index[2:-1] if np.isfinite(row[name])]
    lacking = [("not measured", "", "", row["not_measured"])] if row["not_measured"] else []
    return _rows_of(row, known, described) + lacking


def _rows_of(
    row: "pd.Series[Any]", names: list[str], described: pd.DataFrame
) -> list[tuple[str, str, str, str]]:
    """Columns of a table of one row as (title, value, unit, meaning)."""
    found = []
    for name in names:
        kept = str(described.loc[name, "unit"] or "")
        value, unit = shown(row[name], kept)
        share = name.endswith("_share")
        found.append(
            (
                titled(name, kept),
                f"{value:.1%}" if share and np.isfinite(row[name]) else reading(value, unit),
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
    for word, colour in (
        *vocabulary.action_colours(words).items(),
        ("unlabelled", vocabulary.UNLABELLED_COLOUR),
    ):
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
    if minutes >= 120:
        return f"{minutes // 60:.0f} h {minutes % 60:.0f} min"
    return f"{rest:.1f} s" if minutes < 1 else f"{minutes:.0f} min {rest:.0f} s"
