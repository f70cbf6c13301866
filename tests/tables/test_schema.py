"""Every column is listed once, written as listed, and equal input gives equal bytes."""

import json

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from liex_lab.errors import SessionError
from liex_lab.sessions import Session
from liex_lab.tables.schema import (
    Column,
    all_columns,
    dictionary,
    to_pandas,
    write_table,
)
from tests.sessions.walking_mouse import WalkingMouse, steady, write


@pytest.fixture(scope="module")
def session(tmp_path_factory) -> Session:
    return write(
        tmp_path_factory.mktemp("tables") / "circle.liex", WalkingMouse(steady(2.0), lost=(10, 11))
    )


def test_every_written_column_has_an_entry_in_columns_json(session):
    described = {(row.table, row.name): row for row in session.columns.itertuples(index=False)}
    written = {
        (path.stem, field.name): str(field.type)
        for path in session.path.glob("*.parquet")
        for field in pq.read_schema(path)
    }
    written |= {("summary", name): "" for name in pd.read_csv(session.path / "summary.csv").columns}
    assert set(written) == set(described)
    for key, kind in written.items():
        assert described[key].meaning, key
        assert kind in (
            "",
            {"float64": "double"}.get(described[key].dtype, described[key].dtype),
        ), key


def test_a_unit_in_a_name_is_the_unit_of_the_entry():
    suffixes = {
        "_rad_mm": "rad mm",
        "_mm_s": "mm/s",
        "_rad_s": "rad/s",
        "_mm": "mm",
        "_px": "px",
        "_hz": "Hz",
        "_rad": "rad",
        "_ns": "ns",
        "_s": "s",
    }
    for entry in dictionary(list(all_columns().values())):
        for suffix, unit in suffixes.items():
            if entry["name"].endswith(suffix):
                assert entry["unit"] == unit, entry["name"]
                break


def test_a_column_without_an_entry_is_refused(tmp_path):
    schema = [Column("notes", "text", "string", "", "what was noted")]
    with pytest.raises(SessionError, match=r"without a description \['extra'\]"):
        write_table(tmp_path / "notes.parquet", schema, [{"text": ["a"], "extra": [1]}], {})
    with pytest.raises(SessionError, match=r"lacks \['text'\]"):
        write_table(tmp_path / "notes.parquet", schema, [{}], {})


def test_a_column_cannot_be_described_twice_and_differently():
    with pytest.raises(SessionError, match="twice and differently"):
        dictionary([Column("poses", "x_mm", "float64", "mm", "something else")])


def test_equal_input_gives_equal_tables_whatever_the_chunks(tmp_path):
    mouse = WalkingMouse(steady(2.0), rear_s=(0.5, 1.2), lost=(3,))
    first, second = (
        write(tmp_path / "a.liex", mouse, chunk=7),
        write(tmp_path / "b.liex", mouse, chunk=60),
    )
    names = sorted(
        path.name for path in first.path.iterdir() if path.suffix in (".parquet", ".csv", ".toml")
    )
    assert len(names) == 13
    for name in [*names, "columns.json", "session.mcap"]:
        assert (first.path / name).read_bytes() == (second.path / name).read_bytes(), name


def test_parquet_files_are_zstd_and_describe_themselves(session):
    for path in session.path.glob("*.parquet"):
        file = pq.ParquetFile(path)
        about = json.loads(file.schema_arrow.metadata[b"liex_lab"])
        assert {"version", "calibration_hash", "model_hash", "axes", "columns"} <= set(about), (
            path.name
        )
        assert set(about["columns"]) == set(file.schema_arrow.names)
        if file.metadata.num_row_groups:
            assert file.metadata.row_group(0).column(0).compression == "ZSTD"


def test_a_block_becomes_the_frame_that_reading_it_back_gives(session, tmp_path):
    kinds = {"who": "string", "n": "int64", "yes": "bool"}
    schema = [Column("t", name, dtype, "", "what it is") for name, dtype in kinds.items()]
    block = {"who": "m", "n": np.array([1, 2]), "yes": [True, False]}
    write_table(tmp_path / "t.parquet", schema, [block], {})
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "t.parquet"), to_pandas(schema, block))
