"""Whatever is in a file of labels, it is read or refused in one sentence."""

import copy
import gzip
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from liex_lab.pipelines.training.action_model import read_any_labels

from liex_lab.actions.labels import words_of
from liex_lab.errors import LiexError
from tests.damage import ANYTHING, check, damage
from tests.exchange.test_boris_labels import PROJECT

_OURS = ["session_id", "individual", "action", "start_s", "stop_s", "x"]
_BORIS = ["Observation id", "Subject", "Behavior", "Behavior type", "Start (s)", "Stop (s)"]
_CELLS = st.one_of(
    st.floats().map(str),
    st.integers().map(str),
    st.text(max_size=6),
    st.sampled_from(
        ["", "rear", "STATE", "1.5", "nan", "1e999", "true", '"', "2020-01-01", "0x1", "1_0", "\0"]
    ),
)


def read(content: bytes, name: str) -> None:
    """Everything that is done with a file of labels: it is read, and its words are put on
    frames.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        words_of(read_any_labels(path), np.arange(10) / 30.0, "o")


@settings(max_examples=25, deadline=None)
@given(data=st.data(), packed=st.booleans())
def test_any_value_anywhere_in_a_boris_project(data: st.DataObject, packed: bool) -> None:
    project: dict[str, Any] = copy.deepcopy(PROJECT)
    damage(project, data)
    text = json.dumps(project).encode()
    check(lambda: read(gzip.compress(text, 1) if packed else text, "a.boris"))


@settings(max_examples=20, deadline=None)
@given(document=ANYTHING)
def test_any_json_instead_of_a_boris_project(document: Any) -> None:
    check(lambda: read(json.dumps({"observations": document}).encode(), "a.boris"))


@settings(max_examples=25, deadline=None)
@given(
    head=st.lists(st.sampled_from([*_OURS, *_BORIS]), min_size=1, max_size=8),
    rows=st.lists(st.lists(_CELLS, max_size=8), max_size=5),
    whole=st.sampled_from([_OURS, _BORIS, []]),
    tabs=st.booleans(),
)
def test_any_table_of_labels(
    head: list[str], rows: list[list[str]], whole: list[str], tabs: bool
) -> None:
    between = "\t" if tabs else ","
    text = "\n".join(between.join(row) for row in [whole or head, *rows])
    check(lambda: read(text.encode("utf-8", "surrogatepass"), "a.tsv" if tabs else "a.csv"))


@settings(max_examples=25, deadline=None)
@given(
    content=st.binary(max_size=60),
    name=st.sampled_from(["a.boris", "a.csv", "a.tsv", "a.parquet", "a.boris.gz"]),
    head=st.sampled_from(
        [
            b"",
            b"\x1f\x8b",
            b"\x1f\x8b\x08\0\0\0\0\0",
            b"action,start_s,stop_s\n",
            b"PAR1",
            b"Observation id\tSubject\tBehavior\tStart (s)\tStop (s)\n",
        ]
    ),
)
@example(content=b"\xff" * 20, name="a.boris", head=b"\x1f\x8b\x08\0\0\0\0\0")
@example(content=b"[" * 60, name="a.boris", head=b"")
def test_any_bytes_instead_of_labels(content: bytes, name: str, head: bytes) -> None:
    check(lambda: read(head + content, name))


def test_a_deeply_nested_project_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.boris").write_text('{"observations": ' + "[" * 200_000 + "]" * 200_000 + "}")
    with pytest.raises(LiexError, match="BORIS"):
        read_any_labels(tmp_path / "a.boris")
