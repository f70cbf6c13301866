"""The dashboard's pages: list of sessions, ethograms, group comparison, one session.

The statistics come from `liex_lab.behaviour.cohort`, the figures from `..figures`.
"""

import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np
import pandas as pd
from flask import Flask, Response, jsonify, redirect, render_template, request, stream_with_context
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from werkzeug.exceptions import NotFound

from liex_lab.actions.vocabulary import PALETTE, UNLABELLED_COLOUR, action_colours
from liex_lab.behaviour import body, cohort
from liex_lab.errors import LiexError, SessionError
from liex_lab.plan.study import references_first
from liex_lab.sessions import Session, correcting, corrections
from liex_lab.sessions.individuals import individuals_of

from ..figures import groups, sets, social, times
from ..figures.style import (
    LEFT_MM,
    ONE_COLUMN_MM,
    RIGHT_MM,
    TWO_COLUMNS_MM,
    drawing,
    image_bytes,
    on_page,
    time_unit,
)
from ..report.contact_sheet import MARKS, scene_marks
from ..report.report import warnings
from ..units import shown, titled
from . import tables
from .data import (
    GREY,
    NO_POSE,
    NO_POSE_COLOUR,
    OTHER,
    SessionBouts,
    StudyData,
    raster,
    shown_words,
)
from .desk import Desk
from .tables import number, records, session_address

ShowReplay = Callable[[Path, float], object]
Span = tuple[float, float]
_STEPS = (
    ("frame", -1, "◀ frame"),
    ("frame", 1, "frame ▶"),
    ("bout", -1, "◀ bout"),
    ("bout", 1, "bout ▶"),
    ("flag", -1, "◀ flagged"),
    ("flag", 1, "flagged ▶"),
)
_HALF_S = 4.0  # half the duration of the curves around a moment
_AROUND_MM = 1.2 * ONE_COLUMN_MM
_FACTS = (
    ("frame_index", "frame", ""),
    ("time_s", "time", "s"),
    ("flag", "flag", ""),
    ("predicted_error_mm", "expected error", "mm"),
    ("p_flip", "head and tail exchanged, p", ""),
    ("gap_before", "frames missing before", ""),
    ("zone", "zone", ""),
)


@dataclass(frozen=True)
class Pages:
    """The pages of a study, and what their scripts ask for.

    Attributes:
        data: the study.
        desk: finds a session's data by its key.
        show_replay: opens the replay of a .rrd at a time (s); None only shows the command.
        of_recordings: whether regions can be drawn for recordings without results.
        measuring: lists, examines and measures recordings, see `make_app`; None measures none.
    """

    data: StudyData
    desk: Callable[[str], Desk]
    show_replay: ShowReplay | None
    of_recordings: bool
    measuring: Any

    def table(self, name: str, **how: Any) -> Markup:
        """A table as HTML, by its name; see `tables.find` and `tables.fill`."""
        try:
            filled = tables.fill(tables.find(self.data, name), **how)
        except LiexError as error:
            filled = {"sentence": str(error)}
        return Markup(render_template("table.html", **filled))  # nosec B704: a rendered template

    def requested_table(self) -> Markup:
        """The table ?name=, filtered and sorted."""
        name, words, column = (request.args.get(key, "") for key in ("name", "words", "column"))
        return self.table(name, words=words, sorted_by=column, down=request.args.get("down") == "1")

    def sessions(self) -> str:
        """The list of sessions."""
        states = [entry.state for entry in self.data.entries.values()]
        counts = [
            (state, title, f"{states.count(state):,}")
            for state, title in tables.STATES.items()
            if state in states
        ]
        return render_template("sessions.html", counts=counts)

    def refresh(self) -> Any:
        """Read the states of the sessions again, and list them."""
        self.data.refresh()
        return redirect("/", 303)

    def ethograms(self) -> str:
        """The ethograms of the requested sessions."""
        return render_template("ethograms.html", **ethogram_rows(self.data))

    def groups(self) -> str:
        """The comparison of groups."""
        return render_template("groups.html", **compared_groups(self.data))

    def group_figure(self, measure: str) -> Response:
        """SVG of the comparison of a measure."""
        with drawing():
            return _download(_comparison(self.data, measure, request.args.get("reference", "")))

    def review(self) -> str:
        """The page of blinded reviews."""
        return render_template("review.html")

    def bench(self) -> str:
        """The page on which a recording is chosen, examined and measured."""
        listed = self._bench().listed(request.args.get("at", ""))
        parts = [part for part in listed["at"].split("/") if part]
        trail = [(part, "/".join(parts[: k + 1])) for k, part in enumerate(parts)]
        entries = [(name, "folder") for name in listed["folders"]]
        entries += [(name, "file") for name in listed["files"]]
        prefix = f"{listed['at']}/" if listed["at"] else ""
        job = self.measuring.state()
        return render_template(
            "bench.html", trail=trail, entries=entries, prefix=prefix, job=job, **listed
        )

    def bench_start(self) -> Any:
        """Start the requested job, and show the folder of its recording."""
        at = request.form.get("at", "")
        self._bench().start(request.form.get("verb", ""), at, request.form.get("plan", ""))
        return redirect(f"/bench?at={quote(at.rpartition('/')[0])}", 303)

    def bench_stop(self) -> Any:
        """Stop the job."""
        self._bench().stop()
        return redirect("/bench", 303)

    def bench_state(self) -> Any:
        """What the job has done."""
        return jsonify(self._bench().state())

    def _bench(self) -> Any:
        if self.measuring is None:
            raise SessionError("nothing is measured here; start the dashboard on this machine")
        return self.measuring

    def arena(self, key: str) -> str:
        """The page on which a region is drawn."""
        return render_template("arena.html", key=key, known=key in self.data.entries)

    def session(self, key: str) -> Any:
        """A session, or why it has no results."""
        entry = self.data.entries.get(key)
        if entry is None:
            reason = "The study has no session of this name."
            return render_template("sentence.html", title="No such session", message=reason), 404
        if entry not in self.data.done:
            reason = "; ".join(filter(None, (entry.reason, entry.remedy)))
            more = {"arena": f"/arena/{quote(key, safe='')}"} if self.of_recordings else {}
            what = {"kind": "session", "title": key, "state": entry.state}
            reason = reason or "it has not been measured yet"
            return render_template("sentence.html", message=reason, **what, **more)
        return render_template(
            "session.html",
            **session_facts(self.data, key),
            at_s=_moment(),
            steps=_STEPS,
            may_show=self.show_replay is not None,
            sentences=correcting.SENTENCES,
            modules=sorted(
                path.name for path in (Path(__file__).parent / "assets").glob("desk*.mjs")
            ),
        )

    def whole(self, key: str) -> Response:
        """The ethogram and the curves of a session, or of its stretch from ?from= to ?to= (s)."""
        span = _span(self.desk(key).animals[0].duration_s)
        part = span if "from" in request.args else None

        def figures(_: Session) -> list[Figure | None]:
            animals = self.desk(key).animals
            return [draw(one, part) for one in animals for draw in (times.ethogram, times.curves)]

        with drawing():
            return _timed("whole", self.data.read(key, figures), span, TWO_COLUMNS_MM)

    def moment(self, key: str) -> Response:
        """The curves around ?t= (s), the values of its frame, and the command of its replay."""
        at_s = _moment()
        span = (at_s - _HALF_S, at_s + _HALF_S)
        with drawing():
            figure = self.data.read(
                key, lambda _: times.curves(self.desk(key).animals[0], span, _AROUND_MM)
            )
            values = self.data.read(key, lambda session: facts(session, at_s))
            path = self.data.session(key).path
            return _timed(
                "around",
                [figure],
                span,
                _AROUND_MM,
                facts=values,
                command=f"liex show {shlex.quote(str(path))} --at {at_s:.3f}",
            )

    def step(self, key: str) -> Response:
        """The time of the next or previous (?to=) frame, bout or flag (?by=) from ?t= (s)."""
        to = 1 if request.args.get("to") == "1" else -1
        return jsonify(
            round(moved_to(self.data.session(key), _moment(), request.args.get("by", ""), to), 4)
        )

    def replay(self, key: str) -> Any:
        """Open the replay of a session at a moment."""
        asked = request.get_json(silent=True)  # a form of another site cannot send JSON
        at_s = asked.get("at_s") if isinstance(asked, dict) else None
        if self.show_replay is None or not isinstance(at_s, int | float):
            return {"message": "no replay is opened here"}, 403
        self.show_replay(self.data.session(key).path / "session.rrd", float(at_s))
        return {"message": f"Rerun shows the replay at {at_s:.3f} s."}

    def figure(self, key: str, name: str) -> Response:
        """SVG of a figure of a session."""
        if name not in sets.OF_SESSION:
            raise NotFound
        with drawing():
            _, _, drawn = self.data.read(
                key, lambda session: next(sets.session_figures(session, [name]))
            )
            return _download(drawn)

    def csv(self, name: str) -> Response:
        """A table as shown, by its `name`, see `tables.find`."""
        return _csv(lambda: tables.find(self.data, name).rows, name.replace("/", "_").strip("_"))

    def session_csv(self, key: str, name: str) -> Response:
        """The whole table `name` of the session `key`."""
        return _csv(lambda: tables.session_table(self.data, key, name), f"{key}_{name}")

    def report(self, key: str) -> Response:
        """The report of the session `key`; its content policy allows no script."""
        try:
            folder = self.data.session(key).path.resolve()
            file = (folder / "report.html").resolve()
            if file.parent != folder:  # a link to another folder
                raise FileNotFoundError(file)
            page = file.read_text(encoding="utf-8")
        except (LiexError, OSError, ValueError):
            return Response("This session has no report.", 404, mimetype="text/plain")
        answer = Response(page, mimetype="text/html")
        # a report needs no script
        answer.headers["Content-Security-Policy"] = (
            "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
        )
        return answer


def add_handlers(app: Flask, pages: Pages) -> None:
    """Add what all pages share: the variables of their templates, and answers to errors."""

    @app.context_processor
    def shared() -> dict[str, Any]:
        path = request.path
        here = "/" if path.startswith(("/session", "/arena")) else path
        functions = {"csv_address": tables.csv_address, "session_address": session_address}
        names = {"study": pages.data.name, "here": here, "grey": GREY, "table": pages.table}
        names["measuring"] = pages.measuring is not None
        return {**names, **functions}

    @app.errorhandler(LiexError)
    def refused(error: LiexError) -> Any:
        if request.accept_mimetypes.best == "text/html":  # a page, not one of its scripts
            return render_template(
                "sentence.html", title="This cannot be shown", message=str(error)
            )
        return {"message": str(error)}, 400

    @app.errorhandler(404)
    def absent(_: NotFound) -> Any:
        return render_template("sentence.html", title="No such page", message=""), 404


def ethogram_rows(data: StudyData) -> dict[str, Any]:
    """The variables of the ethogram page, for the requested groups and sessions."""
    names = request.args.getlist("group")
    chosen = request.args.getlist("session")
    group_of = {entry.key: entry.subject.get("group", "") for entry in data.done}
    keys = [key for key in group_of if key in chosen]  # sessions take precedence over groups
    if not chosen:
        keys = sorted(
            [key for key, group in group_of.items() if not names or group in names],
            key=lambda key: group_of[key],
        )
    ones = data.ethograms(keys)
    words = shown_words(ones.values())
    vocabulary = dict.fromkeys(word for one in ones.values() for word in one.vocabulary)
    # those of report and replay, which belong to the whole vocabulary, if they are free
    coloured = action_colours(words[: len(PALETTE)], action_colours(list(vocabulary)))
    colours = {**coloured, "unlabelled": UNLABELLED_COLOUR, NO_POSE: NO_POSE_COLOUR}
    if len(words) > len(PALETTE):
        colours[OTHER] = GREY
    start_s, stop_s = _span(max((one.duration_s for one in ones.values()), default=0.0))
    unit, size = time_unit(stop_s - start_s)
    summaries = data.collected().set_index("key")
    entries: list[dict[str, Any]] = []
    for (key, one), before in zip(ones.items(), [None, *ones], strict=False):
        repeated = before is not None and group_of[before] == group_of[key]
        shares = _shares(summaries.loc[[key]].iloc[0], [*words, "unlabelled"], coloured)
        bars = _bars(one, words, (start_s, stop_s), len(ones), (unit, size))
        group = "" if repeated else group_of[key]
        entries.append({"key": key, "group": group, "bars": bars, "shares": shares})
    choices = [
        ("group", "Groups", sorted({*group_of.values()} - {""}), names),
        ("session", "Sessions", list(group_of), chosen),
    ]
    return {
        "choices": choices,
        "legend": colours,
        "colours": colours,
        "entries": entries,
        "start_s": start_s,
        "stop_s": stop_s,
        "unit": unit,
        "time_ticks": _ticks(start_s / size, stop_s / size),
        "share_ticks": _ticks(0.0, 100.0),
    }


def _bars(
    one: SessionBouts,
    words: Sequence[str],
    span_s: Span,
    n_rows: int,
    unit: tuple[str, float],
) -> list[dict[str, Any]]:
    """The runs of one ethogram row, in % of the span; nothing after the session's end."""
    # time bins of an ethogram's row
    # time bins of all rows together, at most
    n = min(800, max(120, 40_000 // n_rows))
    start_s, stop_s = span_s
    codes = raster(one, words, start_s, stop_s, n)
    end = int(np.ceil(n * np.clip((one.duration_s - start_s) / (stop_s - start_s), 0.0, 1.0)))
    edges = [0, *(np.flatnonzero(np.diff(codes[:end])) + 1).tolist(), end]
    named = [*words, NO_POSE, "unlabelled"]  # codes -2 and -1 count from the end
    bars = []
    for a, b in pairwise(edges):
        word = named[codes[a]] if b > a else ""
        at = (start_s + a * (stop_s - start_s) / n) / unit[1]
        bars.append(
            {
                "at": 100.0 * a / n,
                "width": 100.0 * (b - a) / n,
                "word": word,
                "label": f"{at:.2f} {unit[0]}: {word.replace('_', ' ')}",
            }
        )
    return bars


def _shares(
    row: "pd.Series[float]", words: Sequence[str], coloured: Mapping[str, str]
) -> list[dict[str, Any]]:
    """One row of the time budget, in %; actions without their own colour are merged."""
    parts: dict[str, float] = {}
    for word in words:
        share = float(row.get(f"{word}_share", np.nan))
        if share > 0.0:  # NaN if unknown
            name = word if word in coloured or word == "unlabelled" else OTHER
            parts[name] = parts.get(name, 0.0) + 100.0 * share
    ends = np.cumsum([0.0, *parts.values()])
    return [
        {
            "at": at,
            "width": share,
            "word": word,
            "label": f"{word.replace('_', ' ')}: {share:.1f} %",
        }
        for (word, share), at in zip(parts.items(), ends, strict=False)
    ]


def _ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Round numbers of an axis, each with its position in %."""
    ticks = MaxNLocator(8, steps=[1, 2, 5, 10]).tick_values(low, high)
    inside = [tick for tick in ticks if low <= tick <= high]
    return [(100.0 * (tick - low) / max(high - low, 1e-9), f"{tick:g}") for tick in inside]


def compared_groups(data: StudyData) -> dict[str, Any]:
    """The variables of the group page, for the requested measure and reference."""
    table = data.collected()
    measures = list(tables.columns_of(data))
    usual = [name for name in cohort.usual_measures(table) if name in measures]
    ordered = [*usual, *(name for name in measures if name not in usual)]
    names = references_first({str(name) for name in table["group"].fillna("")} - {""})
    if not ordered or len(names) < 2:
        return {"refused": f"{len(table)} measured sessions have {', '.join(names) or 'no group'}"}
    asked = {key: request.args.get(key, "") for key in ("measure", "reference")}
    measure = asked["measure"] if asked["measure"] in ordered else ordered[0]
    reference = asked["reference"] if asked["reference"] in names else ""
    units, notes = data.units(), list(table.attrs.get("check", ()))
    unit, meaning = data.described(measure)
    page: dict[str, Any] = {
        "notes": notes,
        "measures": [(name, titled(name, units.get(name, ""))) for name in ordered],
        "names": names,
        "measure": measure,
        "reference": reference,
        "meaning": meaning,
        "problem": "",
    }
    try:
        stats = data.stats(measure, reference or None)
    except LiexError as error:
        return page | {"problem": str(error)}
    with drawing():
        drawn = _comparison(data, measure, reference)
        svg = "" if drawn is None else on_page(image_bytes(drawn, "svg"), "groups", measure)
    # of the figure's links, the part after the # becomes the tooltip
    linked = re.sub(
        r'<a href="(/session/[^"#]*)#([^"]*)"([^>]*)>',
        lambda found: f'<a href="{found[1]}"><title>{Markup.escape(unquote(found[2]))}</title>',
        svg,
    )
    own = records(stats[stats["measure"] == measure])
    return page | {
        "figure": Markup(linked),  # nosec B704: matplotlib escapes every text
        "verdicts": [_verdict(row, unit) for row in own],
        "methods": cohort.methods(stats, table, [f"{note}." for note in notes]),
    }


def _comparison(data: StudyData, measure: str, reference: str) -> Figure | None:
    """The figure of a measure by group; its marks link to their sessions."""
    stats = data.stats(measure, reference or None)
    unit, _ = data.described(measure)
    return groups.comparison(data.collected(), stats, measure, unit, link=session_address)


def _verdict(row: dict[str, Any], unit: str) -> dict[str, Any]:
    """One contrast in words: the result, its uncertainty and the sample sizes."""
    cages = f"{row['n_cages']} cages, " if row["n_cages"] else ""
    counts = (
        f"{cohort.counted_units(row)}; {row['n_animals']} animals, {cages}{row['n_sessions']} "
        f"sessions, {row['n_bouts']:,} bouts, {number(row['observed_min'])} min; "
        f"{row['n_without_value']} sessions without a value."
    )
    return {
        "contrast": row["contrast"],
        "result": cohort.result(row, unit),
        "counts": counts,
        "tested": bool(row["test"]),
    }


def session_facts(data: StudyData, key: str) -> dict[str, Any]:
    """The variables of a session's page that are shown before its script loads more.

    Raises:
        SessionError: the session cannot be opened.
    """
    session = data.session(key)
    subject = data.entries[key].subject
    frames = session.metadata["frames"]
    stated = [f"{name.replace('_', ' ')} {value}" for name, value in subject.items() if value]
    extent = f"{frames['n_frames']:,} frames, {frames['duration_s']:.1f} s"
    path = quote(key, safe="")
    kinds = dict.fromkeys(mark.kind for mark in scene_marks(session))
    own = str(session.metadata["individual"])
    named = (
        f"{key.removesuffix(f'-{own}')}-{one}" for one in individuals_of(session) if one != own
    )
    files = [
        (f"{name}.csv", f"/session-csv/{path}/{name}.csv")
        for name in tables.session_tables(data, key)
    ]
    files += [(f"{name}.svg", f"/figure/{path}/{name}.svg") for name in sets.OF_SESSION]
    return {
        "key": key,
        "group": subject.get("group", ""),
        "headline": f"{', '.join(stated)} · {extent}" if stated else extent,
        "warnings": warnings(session),
        "author": corrections.author_name(),
        "scene": [(kind, MARKS[kind][0]) for kind in kinds],
        "arena": f"/arena/{path}",
        "others": [one for one in named if one in data.entries],
        "together": session.has("interactions.parquet"),
        "network": social.met(session),
        "crossings": session.has("crossings.parquet"),
        "report": f"/report/{path}" if session.has("report.html") else "",
        "files": files,
    }


def moved_to(session: Session, at_s: float, by: str, to: int) -> float:
    """Time of the next or previous frame, bout or flagged frame, s; `at_s` if absent.

    Args:
        session: the opened session.
        at_s: the moment, s since the first frame.
        by: frame, bout or flag.
        to: 1 for the next, -1 for the previous.
    """
    time_s = session.frames["time_s"].to_numpy(float)
    if by == "frame":
        return float(time_s[np.clip(np.abs(time_s - at_s).argmin() + to, 0, len(time_s) - 1)])
    places = (
        session.bouts["start_s"].to_numpy(float)
        if by == "bout"
        else time_s[(session.frames["flag"].fillna("") != "").to_numpy()]
    )
    beyond = places[places > at_s + 1e-4] if to > 0 else places[places < at_s - 1e-4]
    return at_s if not len(beyond) else float(beyond.min() if to > 0 else beyond.max())


def facts(session: Session, at_s: float) -> list[tuple[str, str]]:
    """The values of the frame nearest in time to `at_s` (s), as (name, value with unit)."""
    row = int(np.abs(session.frames["time_s"].to_numpy(float) - at_s).argmin())
    frame = session.frames.iloc[row]
    found = [(title, frame[name], unit) for name, title, unit in _FACTS if name in frame]
    if session.has("kinematics.parquet"):
        moved = session.kinematics.iloc[row]
        curves = body.logged_of(session.metadata["animal"])
        measured = [(one.column, one.title.lower(), one.unit) for one in curves]
        found += [
            (title, *shown(moved[name], unit))
            for name, title, unit in (
                *measured,
                *(("heading_rad", "heading", "rad"), ("length_mm", "length", "mm")),
            )
            if name in moved
        ]
    bouts = session.bouts
    now = bouts[(bouts["start_s"] <= frame["time_s"]) & (frame["time_s"] < bouts["stop_s"])]
    words = ", ".join(str(word).replace("_", " ") for word in now["action"])
    texts = [("action", words or "unlabelled")]
    for title, value, unit in found:
        text = f"{value:.3f}" if title == "time" else number(value)
        if text not in ("", "nan"):
            texts.append((title, f"{text} {unit if text != '–' else ''}".strip()))
    return texts


def _timed(
    name: str, drawn: Sequence[Figure | None], span_s: Span, width_mm: float, **more: Any
) -> Response:
    """Figures over time as JSON: SVG, and the start and end of the time axis in the figure."""
    figures = [figure for figure in drawn if figure is not None]
    svgs = [
        on_page(image_bytes(one, "svg"), f"{name}{k}", "over time") for k, one in enumerate(figures)
    ]
    axis = {
        "left": LEFT_MM / width_mm,
        "right": 1.0 - RIGHT_MM / width_mm,
        "from_s": span_s[0],
        "to_s": span_s[1],
    }
    return jsonify({"svg": "".join(svgs), **axis, **more})


def _download(figure: Figure | None) -> Response:
    if figure is None:
        raise SessionError("there is nothing to draw: no value is known")
    return Response(image_bytes(figure, "svg"), mimetype="image/svg+xml")


def _moment() -> float:
    """The requested moment ?t=, s; 0 if absent or invalid."""
    try:
        at_s = float(request.args.get("t", "0"))
    except ValueError:
        return 0.0
    return at_s if 0.0 <= at_s < 1e9 else 0.0


def _span(duration_s: float) -> Span:
    """The requested stretch from ?from= to ?to= (s); the whole duration if absent or invalid."""
    stop_s = max(duration_s, 1e-3)
    try:
        low, high = (float(request.args[name]) for name in ("from", "to"))
    except (KeyError, ValueError):
        return 0.0, stop_s
    low, high = max(low, 0.0), min(high, stop_s)
    return (low, high) if high - low > 1e-3 else (0.0, stop_s)


def _csv(find: Callable[[], pd.DataFrame], name: str) -> Response:
    try:
        rows = find()
    except LiexError as error:
        return Response(str(error), 404, mimetype="text/plain")
    safe = re.sub(r"[^A-Za-z0-9_-]", "_", name) or "table"
    answer = Response(stream_with_context(tables.as_csv(rows)), mimetype="text/csv")
    answer.headers["Content-Disposition"] = f'attachment; filename="{safe}.csv"'
    return answer
