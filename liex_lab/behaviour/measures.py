"""Table `bouts` with its measures, and what of each bout contradicts the word it is named by.

Bouts may be named by a rule, a model or a person; `bout_reader` has the measures, `checking` the
limits.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from liex_lab.behaviour.body import kind_of
from liex_lab.behaviour.bout_reader import BoutReader
from liex_lab.behaviour.checking import BoutCheck
from liex_lab.tables.schema import BOUTS, table_columns, to_pandas


def measure_bouts(
    bouts: pd.DataFrame, kinematics: pd.DataFrame, meanings: Mapping[str, str] | None = None
) -> pd.DataFrame:
    """The table `bouts` with its measures.

    What a camera of this frame rate cannot measure is left empty (see unreliable_below_fps in
    columns.json).

    Args:
        bouts: needs the columns of `tables.BOUTS`; all others of it are replaced.
        kinematics: the table `kinematics` of the same animal.
        meanings: word -> definition as it is printed, which the bouts are checked against; None
            checks nothing.

    Returns:
        The table with all its columns, one row per bout.
    """
    columns = table_columns("bouts", kind_of(kinematics))
    reader = BoutReader(kinematics)
    check = BoutCheck(reader, meanings or {})
    spans = reader.rows_of(bouts)
    measured = [reader.measure(a, b) for a, b in spans]
    block: dict[str, Any] = {c.name: bouts[c.name].to_numpy() for c in BOUTS}
    for column in columns[len(BOUTS) :]:
        if column.name == "since_last_s":
            block[column.name] = reader.since_last(bouts, spans)
        elif column.name == "contradicts":
            block[column.name] = [
                check.broken(a, b, str(word))
                for (a, b), word in zip(spans, bouts["action"], strict=True)
            ]
        else:
            known = reader.fps >= (column.unreliable_below_fps or 0.0)
            empty = 0 if column.dtype == "int64" else np.nan
            block[column.name] = [m[column.name] if known else empty for m in measured]
    return to_pandas(columns, block)
