"""The dashboard's tables: found by name, sorted, filtered, shown as HTML and exported as CSV.

CSV cells that a spreadsheet would read as a formula are escaped.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd

from liex_lab.errors import SessionError
from liex_lab.runtime.text_files import harmless_table
from liex_lab.sessions.verdict import state_in_words

from ..units import counted, read_as
from ..units import shown as as_read
from .data import DONE, StudyData

MOST_ROWS = 400  # on a page; the file has them all
_BATCH = 20_000  # rows of a long table in memory at once


@dataclass(frozen=True)
class Table:
    """A requested table.

    Attributes:
        rows: the whole table.
        shown: the columns to show -> their headings.
        link: the column whose cells are links: to a session, or with start_s to a moment; may be
            empty.
        units: column, or measure of a row -> its unit in the table; cells are shown in the
            displayed unit.
    """

    rows: pd.DataFrame
    shown: dict[str, str]
    link: str = ""
    units: Mapping[str, str] = field(default_factory=dict)


SESSIONS = {
    "session": "session",
    "group": "group",
    "state": "state",
    "duration_min": "duration, min",
    "posed_share": "with a pose",
    "doubtful_share": "doubtful",
    "n_gaps": "gaps",
    "n_missing": "missing",
    "predicted_error_mm": "error, mm",
    "n_flips": "flips",
    "flips_s": "flips, s",
    "warnings": "warnings",
    "reason": "notes",
}
STATS = {
    "measure": "measure",
    "contrast": "contrast",
    "group": "group",
    "n_group": "n of group",
    "reference": "reference",
    "n_reference": "n of reference",
    "refused": "not tested, because",
    "estimate": "difference",
    "ci_low": "from",
    "ci_high": "to",
    "effect_size": "Hedges' g",
    "effect_low": "from",
    "effect_high": "to",
    "p": "p",
    "p_fdr": "p, corrected",
    "test": "test",
    "unit": "unit",
    "n_animals": "animals",
    "n_cages": "cages",
    "n_sessions": "sessions",
    "n_bouts": "bouts",
    "observed_min": "observed, min",
    "n_without_value": "without value",
}
BOUTS = {
    "action": "action",
    "start_s": "from, s",
    "stop_s": "to, s",
    "duration_s": "lasts, s",
    "score": "score",
    "source": "by",
    "peak_speed_mm_s": "peak, cm/s",
    "contradicts": "contradicts its definition",
    "path_mm": "path, mm",
}
GAPS = {"start_s": "from, s", "stop_s": "to, s", "n_frames_missing": "frames", "reason": "reason"}
FLIPS = {
    "start_s": "from, s",
    "stop_s": "to, s",
    "p_flip": "probability",
    "applied": "corrected",
    "source": "by",
}
STATES = {
    "done": "done",
    "changed": "changed since",
    "failed": "failed",
    "new": "waiting",
    "begun": "interrupted",
    "excluded": "left out",
}
INTERACTIONS = {
    "agent": "animal",
    "action": "interaction",
    "target": "with",
    "start_s": "from, s",
    "stop_s": "to, s",
    "duration_s": "lasts, s",
    "score": "score",
}
CROSSINGS = {
    "start_s": "from, s",
    "stop_s": "to, s",
    "animals": "animals",
    "p_swap": "probability",
    "decided_by": "decided by",
}
_OF_SESSION = {
    "bouts": BOUTS,
    "gaps": GAPS,
    "flips": FLIPS,
    "interactions": INTERACTIONS,
    "crossings": CROSSINGS,
}


def find(data: StudyData, name: str) -> Table:
    """A table by its name.

    Args:
        data: the study.
        name: sessions, summaries, stats/MEASURE/REFERENCE (the reference may be empty), or
            bouts/KEY, gaps/KEY, flips/KEY, interactions/KEY, crossings/KEY of a session.

    Raises:
        SessionError: there is no such table or session.
    """
    what, _, rest = name.partition("/")
    if name == "sessions":
        return Table(data.overview(), SESSIONS, "session")
    if name == "summaries":
        rows = data.collected()
        return Table(rows, {str(column): str(column) for column in rows}, "key")
    if what == "stats":
        measure, _, reference = rest.partition("/")
        return Table(data.stats(measure, reference or None), STATS, units=data.units())
    if what in _OF_SESSION and rest:
        rows = data.read(rest, lambda session: session.table(what))
        return Table(
            rows,
            {column: title for column, title in _OF_SESSION[what].items() if column in rows},
            "start_s",
            {"peak_speed_mm_s": "mm/s"},
        )
    raise SessionError(f"there is no table '{name}'")


def arranged(table: Table, words: str, column: str, down: bool) -> pd.DataFrame:
    """The rows that contain all of the words, sorted by a column.

    Args:
        table: the table.
        words: separated by spaces; each must occur in a shown cell, ignoring case.
        column: the column to sort by, rows without a value last; an unknown column does not sort.
        down: sort in descending order.
    """
    rows = table.rows
    if wanted := words.lower().split():
        shown = rows[[name for name in table.shown if name in rows]]
        # a state is found by its displayed word as well
        cells = shown.map(lambda value: f"{value} {STATES.get(str(value), '')}".lower())
        lines = ["\n".join(line) for line in cells.to_numpy()]
        rows = rows[np.array([all(word in line for word in wanted) for line in lines], bool)]
    if column in rows:
        rows = rows.sort_values(column, ascending=not down, kind="stable", na_position="last")
    return rows


def csv_address(name: str) -> str:
    """Address of a table's CSV file; `name` as in `find`."""
    return f"/csv/{quote(name, safe='')}.csv"


def fill(table: Table, words: str = "", sorted_by: str = "", down: bool = False) -> dict[str, Any]:
    """Variables of the template `table.html`: heads, rows (at most `MOST_ROWS`), and row count.

    Args:
        table: the table.
        words: required in every shown row, see `arranged`.
        sorted_by: the column to sort by.
        down: sort in descending order.
    """
    rows = arranged(table, words, sorted_by, down)
    sort = "descending" if down else "ascending"
    heads = [
        {
            "column": column,
            "title": title,
            "sort": sort if column == sorted_by else "none",
            "numeric": column in table.rows and table.rows[column].dtype.kind in "iuf",
        }
        for column, title in table.shown.items()
    ]
    places = {name: _places(table.rows[name]) for name in table.shown if name in table.rows}
    n, total = len(rows), len(table.rows)
    extent = counted(n, "row") if n == total else f"{n:,} of {total:,} rows"
    extent += f"; the first {MOST_ROWS} are shown, the CSV has all" if n > MOST_ROWS else ""
    return {
        "heads": heads,
        "message": extent,
        "rows": [
            [_cell(table, row, column, places.get(column)) for column in table.shown]
            for row in records(rows.head(MOST_ROWS))
        ],
    }


def as_csv(table: pd.DataFrame) -> Iterator[str]:
    """Yield a table as CSV text in blocks of rows, the header first; formulas are escaped."""
    for start in range(0, max(len(table), 1), _BATCH):
        part = table.iloc[start : start + _BATCH]
        yield harmless_table(part).to_csv(index=False, header=start == 0, lineterminator="\n")


def session_table(data: StudyData, key: str, name: str) -> pd.DataFrame:
    """A whole table of a session, with all columns; `name` is one of `session_tables`.

    Raises:
        SessionError: there is no such session or table.
    """
    if name not in session_tables(data, key):
        raise SessionError(f"the session '{key}' has no table '{name}'")
    session = data.session(key)
    return session.summary if name == "summary" else session.table(name)


def session_tables(data: StudyData, key: str) -> list[str]:
    """Names of a session's tables."""
    session = data.session(key)
    return [
        *(["summary"] if session.has("summary.csv") else []),
        *sorted(path.stem for path in session.path.glob("*.parquet")),
    ]


def session_address(key: str, at_s: float | None = None) -> str:
    """Address of a session's page.

    Args:
        key: the session's name in the study.
        at_s: the moment to show, s since the first frame; None shows the page as it opens.
    """
    return f"/session/{quote(key, safe='')}" + ("" if at_s is None else f"?t={at_s:.3f}")


def number(value: Any, places: int | None = None) -> str:
    """A value as text.

    Args:
        value: a bool is yes or no, an integer has its thousands separated, another number has three
            significant digits (no decimals from 1000 on), and NaN is a dash; anything else is
            converted to text.
        places: decimals of a float, as in its whole column; None as above.
    """
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{value:,}"
    if not isinstance(value, float | np.floating):
        return str(value)
    if not np.isfinite(value):
        return "–"
    exact = float(value)
    shown = 0.0 if abs(exact) < 1e-12 else exact  # rounding error of a sum that is zero
    whole = abs(shown) >= 1000 or shown == int(shown)
    style = f",.{places}f" if places is not None else ",.0f" if whole else ".3g"
    return f"{shown:{style}}"


def records(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a table as dicts."""
    return [{str(name): value for name, value in row.items()} for row in rows.to_dict("records")]


def _places(values: "pd.Series[Any]") -> int | None:
    """Decimals for a column: three significant digits of its median, at most four decimals.

    None if the column is not numeric, or contains p values or estimates of many measures.
    """
    if values.dtype.kind != "f" or values.name in STATS:
        return None
    size = values.abs()[values.abs() > 0]
    whole = bool((size == size.round()).all())
    return 0 if whole else int(np.clip(2 - np.floor(np.log10(size.median())), 0, 4))


def _cell(
    table: Table, row: dict[str, Any], column: str, places: int | None = None
) -> dict[str, Any]:
    """A cell: its text and, if applicable, its kind and link target.

    Numbers have the decimals (`places`) of their column.
    """
    value = row.get(column, "")
    about = str(row.get("measure", ""))
    if column == "measure":
        return {"kind": "", "text": read_as(about, table.units.get(about, ""))}
    # estimates have the unit of the measure
    if unit := table.units.get(
        about if column in ("estimate", "ci_low", "ci_high") else column, ""
    ):
        value = as_read(value, unit)[0]
    if column == "state":
        state = state_in_words(str(value), str(row.get("reason", "")))
        return {"kind": "state", "text": STATES.get(state, state), "to": str(value)}
    if column == "reason" and "remedy" in row:
        texts = (str(row[name]) for name in ("reason", "remedy", "damage"))
        value = "; ".join(one for one in texts if one not in ("", "nan", "new"))
        return {"kind": "text", "text": value}
    if column in ("test", "refused"):
        return {"kind": "text", "text": str(value)}
    text = number(value, places)
    if column.endswith("_share") and isinstance(value, int | float) and np.isfinite(value):
        text = f"{100 * value:.1f} %"
    if column == table.link and column == "start_s":
        return {"kind": "moment", "text": text, "to": round(float(value), 4)}
    if column == table.link and row.get("state", "done") in DONE:
        return {"kind": "link", "text": text, "to": session_address(str(value))}
    return {"kind": "", "text": text}


def columns_of(data: StudyData) -> Sequence[str]:
    """Measures for group comparison: numeric columns of the summaries with at least one value."""
    left_out = {"n_frames", "n_frames_observed", "fps_median", "n_bouts"}
    known = data.collected().select_dtypes("number").dropna(axis="columns", how="all")
    return [
        name for name in map(str, known) if name not in left_out and not name.endswith("_summary")
    ]
