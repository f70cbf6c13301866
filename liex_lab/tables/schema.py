"""Schema of a session's tables (Apache Parquet): every column, its dtype, unit and meaning.

Every column is listed once, and there is one way for a table to get to disk and back: the writer,
the reader, columns.json and the report's glossary all read `TABLES`. Tables that other packages
make (behaviour) bring their own `Column` entries; a column without an entry is refused by
`write_table`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.actions.ethogram import ACROSS_GAPS
from liex_lab.errors import SessionError
from liex_lab.runtime.memory import blocks

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

ROWS_PER_GROUP = 100_000  # a block of the widest table then takes some 20 MB
Block = Mapping[str, Any]  # column -> one value for all rows, or an array


@dataclass(frozen=True)
class Column:
    """One column of a table, and what a reader has to know about it.

    Attributes:
        table: name of the table.
        name: name of the column.
        dtype: 'string', 'float64', 'int64' or 'bool'.
        unit: its unit; empty for a number without one.
        meaning: what it is, in words.
        formula: how it is worked out, where that is not obvious.
        source: what it comes from.
        unreliable_below_fps: frame rate, 1/s, below which it should not be trusted; None without
            one.
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


def columns(table: str, *rows: tuple[str, ...]) -> tuple[Column, ...]:
    """The columns of one table, in order.

    Args:
        table: name of the table.
        *rows: (name, dtype, unit, meaning[, formula[, source]]) of each column.

    Returns:
        One `Column` for each row.
    """
    made = []
    for row in rows:
        name, dtype, unit, meaning, formula, source = (*row, "", "")[:6]
        made.append(Column(table, name, dtype, unit, meaning, formula, source))
    return tuple(made)


_WHO = (
    ("session_id", "string", "", "name of the session: one recording's results"),
    (
        "individual",
        "string",
        "",
        "name of the animal within the session; the sessions table maps it to subject_id",
    ),
)
_WHEN = (
    (
        "frame_index",
        "int64",
        "",
        "number of the frame in the recording, from 0; frames that the camera did not deliver are "
        "not counted, see frames pulse_index. Of a live stream it is the sender's count",
        "",
        "recording",
    ),
    (
        "time_s",
        "float64",
        "s",
        "time of the frame since the recording's first frame",
        "",
        "the recording's clock",
    ),
    (
        "dt_s",
        "float64",
        "s",
        "time since the previous recorded frame; empty at the first",
        "",
        "the recording's clock",
    ),
)
_SPAN = (
    ("start_s", "float64", "s", "onset, since the first frame", "", ""),
    (
        "stop_s",
        "float64",
        "s",
        "time of the first frame outside; where the last frame inside precedes a gap or ends the "
        "recording, its time + median dt",
        "",
        "",
    ),
    ("start_frame", "int64", "", "frame_index of the first frame inside"),
    (
        "stop_frame",
        "int64",
        "",
        "frame_index of the first frame outside; at the end of the recording, last + 1",
    ),
)
_AXES = "arena frame: z up from the floor, origin below the camera, x along the picture's rows"
_MID = "joints lie on the body's mid-axis, not on the skin"

FRAMES = columns(
    "frames",
    *_WHO,
    *_WHEN,
    ("time_ns", "int64", "ns", "time stamp of the frame as recorded", "", "the recording's clock"),
    (
        "gap_before",
        "int64",
        "",
        "frames that the camera did not deliver just before this one; 1 where the clock jumped, "
        "for how many were missing is unknown",
        "time since the frame before / mean frame interval, rounded, - 1",
        "the recording's clock",
    ),
    (
        "pulse_index",
        "int64",
        "",
        "number of the camera's pulse that took the frame, from 0 at the first frame; frames that "
        "the camera did not deliver are counted. After a gap whose reason is clock_jumped it is a "
        "guess",
        "row number + sum of gap_before so far",
        "the recording's clock",
    ),
    (
        "predicted_error_mm",
        "float64",
        "mm",
        "joint error to be expected in this frame, mean over the joints",
        "",
        "learned metric of the model, and the smoother",
    ),
    (
        "residual_mm",
        "float64",
        "mm",
        "distance between the body's surface and the depth seen, within the animal, with "
        "the pose that the frame says by itself",
        "median of |rendered - observed|",
        "fit",
    ),
    ("n_foreground_px", "int64", "px", "pixels taken for the animal", "", "foreground"),
    *(
        (
            f"centroid_{a}_mm",
            "float64",
            "mm",
            f"centre of the animal's outline as seen from above; {_AXES}",
            "mean over its pixels, weighted by the area they cover",
            "foreground",
        )
        for a in "xy"
    ),
    (
        "centroid_z_mm",
        "float64",
        "mm",
        "mean height of the animal's back above the floor",
        "",
        "foreground",
    ),
    (
        "centroid_u_px",
        "float64",
        "px",
        "column of the centroid in the depth picture",
        "",
        "foreground",
    ),
    (
        "centroid_v_px",
        "float64",
        "px",
        "row of the centroid in the depth picture",
        "",
        "foreground",
    ),
    (
        "wall_distance_mm",
        "float64",
        "mm",
        "distance of the centroid from the nearest wall, negative beyond it; empty "
        "where the arena's shape is not known",
        "to the circle or rectangle in session.json, arena",
        "arena",
    ),
    (
        "zone",
        "string",
        "",
        "the zones that the centroid lies in, in the order of the zones' file, with ; between "
        "them; empty outside all of them and where there is no centroid",
        "",
        "arena.zones of the plan",
    ),
    (
        "spine_mm",
        "float64",
        "mm",
        "length of the fitted chain of joints, all bones added up",
        "scale x length of the skeleton at home",
        "fit",
    ),
    ("scale", "float64", "", "size of the animal relative to the skeleton's file", "", "fit"),
    (
        "p_flip",
        "float64",
        "",
        "probability that head and tail are exchanged in this pose",
        "two states over the whole "
        "recording: what each frame says of either, and how fast animals turn",
        "tracker",
    ),
    (
        "bridged",
        "bool",
        "",
        "nothing was measured; the pose is what lies between two measured ones, of which the "
        "nearer is no farther than half of tracking.bridge_s of the plan; measures of behaviour "
        "leave it out",
        "",
        "tracker",
    ),
    (
        "flag",
        "string",
        "",
        "empty when the pose is trusted; doubtful: its predicted error is large, or the picture "
        "contradicts it; corrected: a person placed joints of it; hidden, not_found or no_depth: "
        "nothing was measured, and there is no pose where it is not bridged; hidden: the animal is "
        "behind or under something, whole or so much of it that nobody knows how it lies; "
        "repeated: the depth image is a copy of the one before, with no pose where the stream "
        "froze, and a pose between its neighbours where each image was written more than once",
        "",
        "tracker",
    ),
)

POSES = columns(
    "poses",
    *_WHO,
    *_WHEN,
    ("joint", "string", "", f"name of the joint in the skeleton; {_MID}"),
    ("x_mm", "float64", "mm", f"position of the joint; {_AXES}; {_MID}", "", "fit"),
    ("y_mm", "float64", "mm", f"position of the joint; {_AXES}; {_MID}", "", "fit"),
    ("z_mm", "float64", "mm", f"height of the joint above the floor; {_AXES}; {_MID}", "", "fit"),
    (
        "u_px",
        "float64",
        "px",
        "column of the joint in the depth image; (0, 0) is the centre of the top-left pixel",
        "pinhole projection",
        "fit",
    ),
    (
        "v_px",
        "float64",
        "px",
        "row of the joint in the depth image; (0, 0) is the centre of the top-left pixel",
        "pinhole projection",
        "fit",
    ),
    (
        "score",
        "float64",
        "",
        "probability that the joint lies within 10 % of the spine's length of the truth; exports "
        "give a likelihood made of it and of the frame's flag",
        "chi distribution with 3 degrees of freedom at 0.1 spine_mm / s, where s^2 = "
        "(2 sd_xy_mm^2 + sd_z_mm^2) / 3",
        "sd_xy_mm, sd_z_mm",
    ),
    (
        "sd_mm",
        "float64",
        "mm",
        "standard deviation of the joint along one axis from one frame to another; speeds are made "
        "of it",
        "sqrt(trace of covariance / 3)",
        "posterior of the smoother",
    ),
    (
        "sd_xy_mm",
        "float64",
        "mm",
        "standard deviation of x_mm and of y_mm: where along an animal's outline its joints lie is "
        "a matter of its build, and may be wrong by the same amount throughout a recording",
        "sqrt(sd_mm^2 + s^2 / 2), s of animals of builds that no forest was trained on",
        "posterior of the smoother, calibration",
    ),
    (
        "sd_z_mm",
        "float64",
        "mm",
        "standard deviation of z_mm: a camera sees the back only, so how deep below it the joints "
        "lie may be wrong by the same amount throughout a recording",
        "sqrt(sd_mm^2 + h^2), h of animals of builds that no forest was trained on",
        "posterior of the smoother, calibration",
    ),
)

_TURN = (
    "rotation vector relative to the parent joint; row 'root': the body's base relative to the "
    "arena"
)
_SHIFT = (
    "row 'root' only: position of the body's base in the arena; empty in the rows of the joints"
)
_SPREAD = "posterior of the smoother"
_OF_ROOT = ("wx_rad", "wy_rad", "wz_rad", "tx_mm", "ty_mm", "tz_mm")
# of each pair of them, row by row of the upper triangle: name and unit
ROOT_COVARIANCES = {
    f"cov_{a[:2]}_{b[:2]}_{unit}": unit.replace("2", "²").replace("_", " ")
    for k, a in enumerate(_OF_ROOT)
    for b in _OF_ROOT[k + 1 :]
    for unit in [a[3:] + "2" if a[3:] == b[3:] else f"{a[3:]}_{b[3:]}"]
}
ROTATIONS = columns(
    "rotations",
    *_WHO,
    *_WHEN,
    (
        "joint",
        "string",
        "",
        "name of the joint; 'root' is the rigid transform of the body's base, T_arena_root",
    ),
    *(
        (
            f"w{axis}_rad",
            "float64",
            "rad",
            f"{axis} of the {_TURN}",
            "logarithm of the rotation",
            "fit",
        )
        for axis in "xyz"
    ),
    *(
        (
            f"sd_w{axis}_rad",
            "float64",
            "rad",
            f"standard deviation of w{axis}_rad, in the joint's own frame",
            "",
            _SPREAD,
        )
        for axis in "xyz"
    ),
    *((f"t{axis}_mm", "float64", "mm", f"{axis}; {_SHIFT}", "", "fit") for axis in "xyz"),
    *(
        (
            f"sd_t{axis}_mm",
            "float64",
            "mm",
            f"standard deviation of t{axis}_mm, in the root's own frame",
            "",
            _SPREAD,
        )
        for axis in "xyz"
    ),
    *(
        (
            name,
            "float64",
            unit,
            f"row 'root' only: covariance of the root's {name[4:6]} and {name[7:9]}, in its own "
            "frame; the variances are the squares of their sd_",
            "",
            _SPREAD,
        )
        for name, unit in ROOT_COVARIANCES.items()
    ),
)

BOUTS = columns(
    "bouts",
    *_WHO,
    ("action", "string", "", "a word of the ethogram's vocabulary"),
    *_SPAN[:2],
    ("duration_s", "float64", "s", f"duration of the bout. {ACROSS_GAPS}", "stop_s - start_s"),
    *_SPAN[2:],
    (
        "score",
        "float64",
        "",
        "how well the bout fits its action, 0 to 1; for rules, the share of its frames that "
        "satisfy the rule",
    ),
    ("source", "string", "", "who named it: rule, model or human"),
    ("model_hash", "string", "", "hash of the model that named it; empty for a rule"),
)

GAPS = columns(
    "gaps",
    *_WHO,
    *_SPAN,
    (
        "n_frames_missing",
        "int64",
        "",
        "frames in which no pose was measured (bridged ones, which have a pose all the same, are "
        "among them), or that the camera never delivered; 0 where only a time stamp was moved, 1 "
        "where the clock jumped, for how many it were nobody knows",
    ),
    (
        "reason",
        "string",
        "",
        "camera_dropped: never recorded, start_frame = stop_frame = the next frame; "
        "clock_jumped: the camera was stopped, or its clock set, before the frame; "
        "stamp_repeated, stamp_out_of_order: this frame's own time stamp could not be true and "
        "was moved; no_depth: recorded without any depth; repeated: the stream froze, and the "
        "depth image before it was written again; hidden: the animal went behind or under "
        "something; tracker_lost: nothing in the frame looks like the animal",
    ),
    (
        "x_mm",
        "float64",
        "mm",
        f"where the animal was last seen before it was hidden, else empty; {_AXES}",
        "",
        "tracker",
    ),
    (
        "y_mm",
        "float64",
        "mm",
        f"where the animal was last seen before it was hidden, else empty; {_AXES}",
        "",
        "tracker",
    ),
)

FLIPS = columns(
    "flips",
    *_WHO,
    *_SPAN,
    (
        "p_flip",
        "float64",
        "",
        "probability that head and tail were exchanged: where applied, in what the single frames "
        "said, else in the tables",
        "mean over the span",
        "tracker",
    ),
    ("applied", "bool", "", "whether the exchange was undone in the tables"),
    ("source", "string", "", "who found it: model or human"),
    ("undone_at", "string", "", "when a human took the correction back, ISO 8601; empty otherwise"),
)

SESSIONS = columns(
    "sessions",
    *_WHO,
    (
        "subject_id",
        "string",
        "",
        "the animal across the study; empty when the recording does not say",
    ),
    ("group", "string", "", "experimental group; empty until stated"),
    ("cage", "string", "", "home cage or tank; empty until stated"),
    ("sex", "string", "", "sex; empty until stated"),
    ("batch", "string", "", "batch of the experiment; empty until stated"),
    (
        "session_start_time",
        "string",
        "",
        "when the recording began, ISO 8601 with zone; empty when unknown",
    ),
    ("n_frames", "int64", "", "recorded frames"),
    (
        "n_frames_observed",
        "int64",
        "",
        "recorded frames with a measured pose; bridged ones do not count",
    ),
    (
        "observed_s",
        "float64",
        "s",
        "time with a measured pose",
        "sum over frames with a measured pose of the time to the next frame; before a gap or the "
        "end, the median dt",
    ),
    ("fps_median", "float64", "1/s", "frames per second", "1 / median dt"),
    ("calibration_hash", "string", "", "hash of the camera's numbers and its place in the arena"),
    ("software_version", "string", "", "version of liex_lab"),
)

TABLES: dict[str, tuple[Column, ...]] = {
    rows[0].table: rows for rows in (FRAMES, POSES, ROTATIONS, BOUTS, GAPS, FLIPS, SESSIONS)
}


def dictionary(*extra: Sequence[Column]) -> list[dict[str, Any]]:
    """The content of columns.json: every column of `TABLES`, then those of other packages.

    Args:
        *extra: columns of further tables.

    Returns:
        Each column once, as a plain dict.

    Raises:
        SessionError: a column is described twice and differently.
    """
    entries = [column for rows in TABLES.values() for column in rows] + [
        column for rows in extra for column in rows
    ]
    seen: dict[tuple[str, str], Column] = {}
    for column in entries:
        if seen.setdefault((column.table, column.name), column) != column:
            raise SessionError(
                f"column {column.table}.{column.name} is described twice and differently; keep one"
            )
    return [asdict(column) for column in seen.values()]


def arrow_schema(schema: Sequence[Column], metadata: Mapping[str, Any]) -> pa.Schema:
    """The Arrow schema of a table, with its description as JSON under the metadata key `liex_lab`.

    Args:
        schema: the columns.
        metadata: what else the table's metadata shall hold, JSON values.

    Returns:
        The schema, fields in the order of the columns.
    """
    import pyarrow as pa

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
    dictionaries, no time stamps.

    Args:
        path: the file.
        schema: the columns, in the order in which they are written.
        blocks: consecutive rows, each block with every column.
        metadata: goes into the file, see `arrow_schema`.

    Returns:
        How many rows were written.

    Raises:
        SessionError: a block's columns are not exactly those of the schema.
    """
    import pyarrow.parquet as pq

    arrow = arrow_schema(schema, metadata)
    texts = [column.name for column in schema if column.dtype == "string"]
    n_rows = 0
    with pq.ParquetWriter(
        path, arrow, compression="zstd", use_dictionary=texts, write_statistics=True
    ) as writer:
        for block in blocks:
            batch = _arrow_block(block, schema, arrow)
            n_rows += batch.num_rows
            writer.write_table(batch, row_group_size=ROWS_PER_GROUP)
            del block, batch  # before the next one is made
    return n_rows


def _arrow_block(block: Block, schema: Sequence[Column], arrow: pa.Schema) -> pa.Table:
    """One block as Arrow columns in the schema's order."""
    import pyarrow as pa

    check_described(block, schema)
    n = max((len(v) for v in block.values() if _is_array(v)), default=1)
    return pa.Table.from_arrays(
        [_arrow_column(block[f.name], f.type, n) for f in arrow], schema=arrow
    )


def check_described(names: Iterable[str], schema: Sequence[Column], table: str = "") -> None:
    """Refuse a table whose columns are not exactly those of its schema.

    Args:
        names: the table's columns.
        schema: the described columns.
        table: the table's name in the error; '' takes the schema's.

    Raises:
        SessionError: a column lacks a description, or a described column lacks.
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
    """One column: a scalar stands for all rows, a `Words` for repeated names."""
    import pyarrow as pa

    if isinstance(value, Words):
        return pa.DictionaryArray.from_arrays(value.codes.astype(np.int32), list(value.words)).cast(
            kind
        )
    if not _is_array(value):
        return pa.repeat(pa.scalar(value, kind), n)
    if kind == pa.string():
        return pa.array([str(word) for word in value], kind)
    return pa.array(np.asarray(value), kind)


@dataclass(frozen=True)
class Words:
    """A column of few different names, as in a dictionary encoding: `words[codes]`.

    There is no Python string per row.

    Attributes:
        codes: (n,) index of each row's word.
        words: the different words.
    """

    codes: NDArray[np.int64]
    words: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.codes)

    def __getitem__(self, rows: slice) -> Words:
        """Some consecutive rows."""
        return Words(self.codes[rows], self.words)


def to_pandas(schema: Sequence[Column], block: Block, copy: bool = True) -> pd.DataFrame:
    """A block as a data frame of the schema's dtypes, as reading the table back would give it.

    Args:
        schema: the columns; those that the block lacks are left out.
        block: column -> one value for all rows, an array, or `Words`.
        copy: False where the block's arrays may go on as the table's columns, wherever they lie.

    Returns:
        The data frame.
    """
    import pandas as pd

    n = max((len(v) for v in block.values() if _is_array(v)), default=1)
    data: dict[str, Any] = {}
    for column in schema:
        if column.name not in block:
            continue
        value = block[column.name]
        if isinstance(value, Words):
            value = np.array(value.words, dtype=object)[value.codes]
        elif not _is_array(value):
            value = [value] * n
        data[column.name] = pd.Series(value, dtype=_pandas_dtype(column), copy=copy)
    return pd.DataFrame(data, copy=False)


def empty_table(schema: Sequence[Column]) -> pd.DataFrame:
    """A data frame without rows, of the right dtypes.

    Args:
        schema: the columns.

    Returns:
        A data frame of 0 rows.
    """
    return to_pandas(schema, {column.name: [] for column in schema})


def from_pandas(table: pd.DataFrame) -> Iterator[Block]:
    """A data frame's columns as blocks for `write_table`; an empty one gives one empty block.

    Args:
        table: any data frame.

    Yields:
        Column -> values of at most `ROWS_PER_GROUP` rows.
    """
    for part in blocks(max(len(table), 1), ROWS_PER_GROUP):
        yield {str(name): table[name].iloc[part].to_numpy() for name in table.columns}


def _pandas_dtype(column: Column) -> str:
    return "str" if column.dtype == "string" else column.dtype
