"""Schema of all tables (Apache Parquet): every column, its dtype, unit and meaning.

Every column is one line of columns.csv. `when` states which sessions have it: all, those with
behaviour measures, those of some kinds of body, each action or zone, or those that distinguish
kinds of rears. Writers, readers, columns.json, the report and the manual read this list;
`write_table` refuses a column without an entry.
"""

import csv
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from itertools import chain, groupby
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from liex_lab.actions.ethogram import ACROSS_GAPS
from liex_lab.actions.vocabulary import WORDS
from liex_lab.errors import SessionError, refuse
from liex_lab.runtime.memory import blocks
from liex_lab.scene.scene import Arena
from liex_lab.scene.zones import Zone

ROWS_PER_GROUP = 100_000  # about 20 MB per block of the widest table
_TEXTS = ("name", "dtype", "unit", "meaning", "formula", "source")
Block = Mapping[str, Any]  # column -> one value for all rows, or an array


@dataclass(frozen=True)
class Column:
    """One column of a table and its description.

    Attributes:
        table: name of the table.
        name: name of the column.
        dtype: 'string', 'float64', 'int64' or 'bool'.
        unit: its unit; empty for a dimensionless number.
        meaning: its meaning in words.
        formula: its computation, if not obvious.
        source: its origin.
        unreliable_below_fps: frame rate, 1/s, below which it is unreliable; None if absent.
        since: version of liex_lab that introduced it.
    """

    table: str
    name: str
    dtype: str
    unit: str
    meaning: str
    formula: str = ""
    source: str = ""
    unreliable_below_fps: float | None = None
    since: str = "0.1"


@cache
def _listed() -> dict[str, list[dict[str, str]]]:
    """The lines of columns.csv by table."""
    tables: dict[str, list[dict[str, str]]] = {}
    with Path(__file__).with_name("columns.csv").open(encoding="utf-8", newline="") as file:
        for line in csv.DictReader(file):
            tables.setdefault(line["table"], []).append(line)
    # without the keys, and the frames and the length of the whole recording
    tables["periods"] += [{**line, "table": "periods"} for line in tables["summary"][6:]]
    return tables


def table_columns(
    table: str, kind: str = "", words: Sequence[str] = (), zones: Sequence[str] = ()
) -> tuple[Column, ...]:
    """The columns of one table, in order.

    Args:
        table: name of the table.
        kind: of body, one of `behaviour.body.KINDS`; '' leaves out measures of behaviour.
        words: the actions' names.
        zones: the zones' names.
    """
    named: dict[str, list[dict[str, str]]] = {
        "each action": [{"action": word} for word in words],
        "each zone": [{"zone": zone} for zone in zones],
    }
    if rears := rears_of(words):
        sums = {f"rears_{of}": " + ".join(f"{one}_{of}" for one in rears) for of in ("count", "s")}
        named["rears"] = [{"rears": " and ".join(rears), **sums}]
    found: list[Column] = []
    for when, lines in groupby(_listed()[table], lambda line: line["when"]):
        once = not when or (kind and (when == "measured" or kind in when.split()))
        group = list(lines)
        for names in named.get(when, [{}] if once else []):
            found += [_column(line, names) for line in group]
    return tuple(found)


def _column(line: Mapping[str, str], names: Mapping[str, str]) -> Column:
    """The column of a line, with the name of an action or zone filled in."""
    texts = {one: line[one].format(across_gaps=ACROSS_GAPS, **names) for one in _TEXTS}
    fps = line["unreliable_below_fps"]
    return Column(line["table"], **texts, unreliable_below_fps=float(fps) if fps else None)


def rears_of(words: Sequence[str]) -> tuple[str, ...]:
    """The kinds of rears that a vocabulary distinguishes; empty if it contains rear itself."""
    return () if "rear" in words else tuple(word for word in words if word.startswith("rear_"))


@dataclass(frozen=True)
class Vocabulary:
    """Determines the columns of a session's behaviour tables.

    Attributes:
        words: the actions' names.
        zones: the zones' names.
        kind: of body, one of `behaviour.body.KINDS`.
    """

    words: tuple[str, ...]
    zones: tuple[str, ...] = ()
    kind: str = "stands"

    def table(self, name: str) -> tuple[Column, ...]:
        """The columns of one of the tables."""
        return table_columns(name, self.kind, self.words, self.zones)

    @property
    def columns(self) -> tuple[Column, ...]:
        """Every column of the behaviour tables; for bouts only those beyond `BOUTS`."""
        every = [column for name in BEHAVIOUR for column in self.table(name)]
        return tuple(column for column in every if column not in BOUTS)


BEHAVIOUR = ("kinematics", "bouts", "summary", "transitions", "zones", "activity")
TABLES: dict[str, tuple[Column, ...]] = {
    name: table_columns(name)
    for name in ("frames", "poses", "rotations", "bouts", "gaps", "flips", "sessions")
}
FRAMES, POSES, ROTATIONS, BOUTS, GAPS, FLIPS, SESSIONS = TABLES.values()
SYNCED = {  # on the clock of another instrument, see `sessions.clock`; by table
    name: tuple(_column(line, {}) for line in _listed()[name] if line["when"] == "synced")
    for name in ("frames", "bouts")
}
# of sessions with several animals in one arena only
CROSSINGS = table_columns("crossings")
INTERACTIONS = table_columns("interactions") + table_columns("interaction_totals")
EVENTS = table_columns("events")  # of another instrument
DAYS = table_columns("hours") + table_columns("rhythm")  # of sessions with [light] in the plan
TRIGGERS = table_columns("triggers")  # of a live recording
MOSEQ = table_columns("moseq")  # of an extraction by MoSeq
POINTS = table_columns("points")  # of an export; no session contains it
# of each pair of the root's coordinates, row by row of the upper triangle
ROOT_COVARIANCES = tuple(column.name for column in ROTATIONS if column.name.startswith("cov_"))


def all_columns() -> dict[str, Column]:
    """Every possible column of a session, for every kind of body, by `table.name`."""
    walking, swimming, branching = (
        Vocabulary(tuple(WORDS.get(animal, ())), (), kind).columns
        for animal, kind in (("mouse", "stands"), ("fish", "swims"), ("hand", "branches"))
    )
    tables = chain(
        *TABLES.values(), *SYNCED.values(), CROSSINGS, INTERACTIONS, EVENTS, DAYS, TRIGGERS, MOSEQ
    )
    every = chain(tables, table_columns("periods"), POINTS, branching, swimming, walking)
    return {f"{c.table}.{c.name}": c for c in every}


def dictionary(*extra: Sequence[Column]) -> list[dict[str, Any]]:
    """The content of columns.json: the columns of `TABLES`, then those of other packages, as dicts.

    Args:
        *extra: columns of further tables.

    Raises:
        SessionError: two different descriptions of one column.
    """
    listed: dict[tuple[str, str], Column] = {}
    for column in chain(*TABLES.values(), *extra):
        if listed.setdefault((column.table, column.name), column) != column:
            raise SessionError(
                f"column {column.table}.{column.name} is described twice and differently; keep one"
            )
    return [asdict(column) for column in listed.values()]


def arrow_schema(schema: Sequence[Column], metadata: Mapping[str, Any]) -> pa.Schema:
    """The Arrow schema of a table, with its description as JSON under the metadata key `liex_lab`.

    Args:
        schema: the columns.
        metadata: further metadata of the table, JSON values.

    Returns:
        The schema, fields in the order of the columns.
    """
    kinds = {
        "string": pa.string(),
        "float64": pa.float64(),
        "int64": pa.int64(),
        "bool": pa.bool_(),
    }
    fields = [pa.field(column.name, kinds[column.dtype]) for column in schema]
    described = {**metadata, "columns": {column.name: asdict(column) for column in schema}}
    return pa.schema(fields, metadata={"liex_lab": json.dumps(described, sort_keys=True)})


def write_table(
    path: Path, schema: Sequence[Column], blocks: Iterable[Block], metadata: Mapping[str, Any]
) -> int:
    """Write a Parquet table block by block and return its number of rows.

    Row groups have at most `ROWS_PER_GROUP` rows. Equal blocks give equal bytes: zstd, strings as
    dictionaries, no timestamps.

    Args:
        path: the file.
        schema: the columns, in the order in which they are written.
        blocks: consecutive rows, each block with every column.
        metadata: of the file, see `arrow_schema`.

    Raises:
        SessionError: a block's columns differ from those of the schema.
    """
    arrow = arrow_schema(schema, metadata)
    texts = [column.name for column in schema if column.dtype == "string"]
    n_rows = 0
    with pq.ParquetWriter(
        path, arrow, compression="zstd", use_dictionary=texts, write_statistics=True
    ) as writer:
        for block in blocks:
            check_described(block, schema)
            n = max((len(v) for v in block.values() if _is_array(v)), default=1)
            columns = [_arrow_column(block[one.name], one.type, n) for one in arrow]
            batch = pa.Table.from_arrays(columns, schema=arrow)
            n_rows += batch.num_rows
            writer.write_table(batch, row_group_size=ROWS_PER_GROUP)
            del block, columns, batch  # to free memory for the next block
    return n_rows


def append_columns(
    path: Path, to: Path, columns: Sequence[Column], compute: Callable[[Block], Block]
) -> None:
    """Write a table with further columns, with one row group in memory at a time.

    Args:
        path: the table's file.
        to: the file to write.
        columns: descriptions of the new columns.
        compute: called with the columns of some rows; returns the new ones.
    """
    with pq.ParquetFile(path) as file:
        described = json.loads((file.schema_arrow.metadata or {}).get(b"liex_lab", b"{}"))
        described.setdefault("columns", {}).update({one.name: asdict(one) for one in columns})
        fields = [*file.schema_arrow, *arrow_schema(columns, {})]
        arrow = pa.schema(fields, {"liex_lab": json.dumps(described, sort_keys=True)})
        texts = [field.name for field in fields if field.type == pa.string()]
        with pq.ParquetWriter(to, arrow, compression="zstd", use_dictionary=texts) as writer:
            for k in range(file.num_row_groups):
                group = file.read_row_group(k)
                more = compute({name: group[name].to_numpy() for name in group.column_names})
                added = [pa.array(more[column.name]) for column in columns]
                writer.write_table(pa.Table.from_arrays([*group.columns, *added], schema=arrow))


def check_described(names: Iterable[str], schema: Sequence[Column], table: str = "") -> None:
    """Refuse a table whose columns differ from those of its schema.

    Args:
        names: the table's columns.
        schema: the described columns.
        table: the table's name in the error; '' takes the schema's.

    Raises:
        SessionError: a column lacks a description, or a described column is missing.
    """
    written = list(names)
    described = [column.name for column in schema]
    undescribed = [name for name in written if name not in described]
    absent = [name for name in described if name not in written]
    if undescribed or absent:
        raise SessionError(
            f"table {table or schema[0].table} has columns without a description {undescribed} and "
            f"lacks {absent}; every column is listed once, with its meaning, in the table's schema"
        )


def _is_array(value: Any) -> bool:
    return hasattr(value, "__len__") and not isinstance(value, str)


def _arrow_column(value: Any, kind: pa.DataType, n: int) -> pa.Array:
    """One column: a scalar is repeated for all rows."""
    if isinstance(value, pa.DictionaryArray):
        return value.cast(kind)
    if not _is_array(value):
        return pa.repeat(pa.scalar(value, kind), n)
    if kind == pa.string():
        return pa.array([str(word) for word in value], kind)
    return pa.array(np.asarray(value), kind)


def to_pandas(schema: Sequence[Column], block: Block, copy: bool = True) -> pd.DataFrame:
    """A block as a data frame of the schema's dtypes, equal to the table read back.

    Args:
        schema: the columns; those missing in the block are left out.
        block: column -> one value for all rows, an array, or a `pyarrow.DictionaryArray`.
        copy: False if the table may share the block's arrays; its texts, which are one value or a
            `pyarrow.DictionaryArray`, are then categories.
    """
    n = max((len(v) for v in block.values() if _is_array(v)), default=1)
    data: dict[str, Any] = {}
    for column in schema:
        if column.name not in block:
            continue
        value = block[column.name]
        if column.dtype == "string" and not copy:
            if not _is_array(value):
                value = pa.DictionaryArray.from_arrays(np.zeros(n, np.int8), [str(value)])
            data[column.name] = value.to_pandas()
            continue
        if isinstance(value, pa.DictionaryArray):
            value = value.to_numpy(zero_copy_only=False)
        elif not _is_array(value):
            value = [value] * n
        dtype = "str" if column.dtype == "string" else column.dtype
        data[column.name] = pd.Series(value, dtype=dtype, copy=copy)
    return pd.DataFrame(data, copy=False)


def empty_table(schema: Sequence[Column]) -> pd.DataFrame:
    """A data frame of 0 rows with the schema's dtypes."""
    return to_pandas(schema, {column.name: [] for column in schema})


def from_pandas(table: pd.DataFrame) -> Iterator[Block]:
    """Yield a data frame's columns as blocks for `write_table`; an empty one gives one empty block.

    Yields:
        Column -> values of at most `ROWS_PER_GROUP` rows.
    """
    for part in blocks(max(len(table), 1), ROWS_PER_GROUP):
        yield {str(name): table[name].iloc[part].to_numpy() for name in table.columns}


# Displayed units: cm/s and degrees on pages and in replays; tables use mm/s and rad.


_SHOWN = {
    "mm/s": ("cm/s", 0.1),
    "mm/s²": ("cm/s²", 0.1),
    "rad": ("°", 180.0 / np.pi),
    "rad/s": ("°/s", 180.0 / np.pi),
}


def shown(value: Any, unit: str) -> tuple[Any, str]:
    """A number, or an array, in the displayed unit, and that unit.

    Args:
        value: in the unit of the files.
        unit: as in columns.json; only speeds and angles are converted.
    """
    name, factor = _SHOWN.get(unit, (unit, 1.0))
    return (value * factor if factor != 1.0 else value), name


def titled(column: str, unit: str) -> str:
    """The displayed name of a column, without its unit.

    Args:
        column: name of the column, such as `mean_speed_mm_s`.
        unit: as in columns.json.
    """
    tail = "_" + unit.replace("/", "_").replace("²", "2")
    return (column.removesuffix(tail) if unit else column).replace("_", " ")


# Protocol of a session's tables: the part of `sessions.Session` that lower layers may read.


class SessionTables(Protocol):
    """The tables of one session folder, and its session.json."""

    @property
    def metadata(self) -> dict[str, Any]:
        """The content of session.json."""

    @property
    def arena(self) -> Arena:
        """The outline of the floor, arena frame, mm."""

    @property
    def zones(self) -> Sequence[Zone]:
        """The zones of the session, arena frame, mm."""

    @property
    def frames(self) -> pd.DataFrame:
        """The table `frames`: one row per frame of the recording."""

    @property
    def gaps(self) -> pd.DataFrame:
        """The table `gaps`: one row per stretch without frames or a measured pose."""

    @property
    def bouts(self) -> pd.DataFrame:
        """The table `bouts`: the ethogram, one row per bout."""

    @property
    def summary(self) -> pd.DataFrame:
        """One row per animal."""

    def table(self, name: str, columns: list[str] | None = None) -> pd.DataFrame:
        """A table by its name, in memory.

        Args:
            name: of the table, such as 'poses'.
            columns: the columns to read; None for all.
        """


# Checks of a session's tables, which another program may have written, before computing.


# columns that schema 1 lacks; columns added by later schemas are listed here as well
_LATER = {
    "frames": {"wall_distance_mm", "zone", "p_flip", "bridged", "pulse_index", "n_animals"},
    "poses": {"sd_xy_mm", "sd_z_mm"},
    "rotations": set(ROOT_COVARIANCES),
    "gaps": {"x_mm", "y_mm"},
}
_FEW = 10_000
_SPANS = {"bouts", "gaps", "flips", "crossings", "interactions"}
# our types in Parquet, and their kinds in pandas
_STORED = {"string": "BYTE_ARRAY", "float64": "DOUBLE", "int64": "INT64", "bool": "BOOLEAN"}
_KINDS = {"string": "O", "float64": "f", "int64": "i", "bool": "b"}


def check_footer(path: Path, name: str, n_frames: int, n_joints: int) -> None:
    """Check columns, types and number of rows of a table's file.

    Args:
        path: the Parquet file.
        name: the table's name.
        n_frames: frames of the session.
        n_joints: joints of the animal.

    Raises:
        ValueError: they do not match a session with these numbers of frames and joints.
    """
    footer = pq.read_metadata(path)
    n_rows = footer.num_rows
    found = {
        leaf.name: leaf for leaf in (footer.schema.column(k) for k in range(footer.num_columns))
    }
    exact = {
        "frames": n_frames,
        "kinematics": n_frames,
        "poses": n_frames * n_joints,
        "rotations": n_frames * (n_joints + 1),
        "sessions": 1,
    }
    refuse(
        ValueError,
        (
            n_rows != exact.get(name, n_rows),
            f"it has {n_rows} rows where the session has {exact.get(name)}",
        ),
        (  # more is impossible: each frame has a timestamp
            n_rows > max(_FEW, 8 * (n_joints + 1) * path.stat().st_size),
            f"it claims {n_rows} rows, which a file of its size does not hold",
        ),
        (
            name not in exact and n_rows > max(_FEW, 4 * n_frames),
            f"it claims {n_rows} rows for {n_frames} frames",
        ),
        (len(found) != footer.num_columns, "it has two columns of one name"),
    )
    for column in TABLES.get(name, ()):
        leaf = found.get(column.name)
        if leaf is None:
            if column.name not in _LATER.get(name, ()):
                raise ValueError(f"it lacks the column {column.name}")
        elif leaf.physical_type != _STORED[column.dtype] or leaf.max_repetition_level:
            raise ValueError(f"its column {column.name} is not {column.dtype}")


def check_rows(name: str, table: pd.DataFrame, joints: Sequence[str]) -> None:
    """Check the rows of a table, in the columns that were read.

    Args:
        name: the table's name.
        table: all its rows, or all rows of some frames.
        joints: names of the animal's joints.

    Raises:
        ValueError: a name is missing, frames are out of order, times are not finite, or rows do not
            match the joints.
    """
    for column in TABLES.get(name, ()):
        if column.name not in table:
            continue
        values = table[column.name]
        refuse(
            ValueError,
            (
                values.dtype.kind != _KINDS[column.dtype],
                f"its column {column.name} is not {column.dtype}",
            ),
            (
                column.dtype == "string" and values.hasnans,
                f"its column {column.name} lacks a value",
            ),
        )
    if "joint" in table and name in ("poses", "rotations"):
        own = [*joints] if name == "poses" else ["root", *joints]
        words = table["joint"]
        if len(words) % len(own) or not all(
            (words.iloc[k :: len(own)] == joint).all() for k, joint in enumerate(own)
        ):
            raise ValueError("its rows are not those of the session's joints in their order")
    if name == "frames":
        _check_frames(table)
    if name in _SPANS:
        for start, stop in (("start_frame", "stop_frame"), ("start_s", "stop_s")):
            if {start, stop} <= set(table) and not (table[start] <= table[stop]).all():
                raise ValueError(f"it has a {stop} before its {start}")


def _check_frames(table: pd.DataFrame) -> None:
    """Raises ValueError if frames or times do not increase."""
    for column in ("frame_index", "time_ns", "time_s"):
        if column in table:
            values = table[column].to_numpy()
            if not np.isfinite(values).all() or (values[1:] <= values[:-1]).any():
                raise ValueError(f"its {column} does not go on from row to row")
