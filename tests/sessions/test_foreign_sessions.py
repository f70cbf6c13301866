"""A session of another lab is data: what does not fit is told in a sentence that names the file."""

import copy
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from liex_lab.dashboards.report.report import render

from liex_lab.errors import SessionError
from liex_lab.sessions import Session
from liex_lab.sessions.verdict import verdict_in
from tests.sessions.walking_mouse import WalkingMouse, steady, write

Change = Callable[[dict[str, Any]], Any]
SHARED = {  # a shape that others found, of a session whose frames show too little of the animal
    "kept": True,
    "n_frames": 3,
    "shared_by": "2 sessions of m07",
    "places": [0.1],
    **{name: [1.0] for name in ("width", "width_sd", "height", "height_sd")},
    "joints_moved": [[0.0, 0.0, 0.0]],
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("whole") / "circle.liex", WalkingMouse(steady(1.0))).path


@pytest.fixture(scope="module")
def document(whole: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((whole / "session.json").read_text())
    return found


@pytest.fixture
def foreign(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "foreign.liex"))


def put(*where: Any) -> Change:
    """Put the last of `where` at the place that the others lead to."""

    def change(document: dict[str, Any]) -> None:
        *place, last, value = where
        inner: Any = document
        for key in place:
            inner = inner[key]
        inner[last] = value

    return change


def refused(folder: Path, name: str) -> None:
    """Check that reading a session is refused in one sentence that names a file."""

    def read() -> None:
        session = Session.open(folder)
        for table in ("frames", "poses", "rotations", "bouts"):
            session.table(table)

    with pytest.raises(SessionError, match="is damaged and cannot be read") as caught:
        read()
    assert str(folder / name) in str(caught.value)
    assert str(caught.value).isprintable()


CHANGES = [
    put("session_id", 3),
    put("session_id", "a\0b"),
    put("session_id", "\ud800"),
    put("individual", "\udfff"),
    put("individual", ["a"]),
    put("subject", {"group": 5}),
    put("subject", ["a"]),
    put("subject", {"\ud800": "a"}),
    put("camera", "fx", 1e308),
    put("camera", "fx", 1e-308),
    put("camera", "fx", True),
    put("camera", "width", 10**9),
    put("camera", "width", "107"),
    put("camera", "T_arena_camera", [[1.0]]),
    put("camera", "T_arena_camera", [["a"] * 4] * 4),
    put("camera", "T_arena_camera", np.eye(4)[:, :3].tolist()),
    put("camera", "floor_distance_mm", None),
    put("arena", {"kind": "round", "what": 3}),
    put("zones", [{"name": "a"}, 3]),
    put("zones", [{"circle_mm": [0, 0, 5]}]),
    put("animal", "joints", []),
    put("animal", "joints", ["a", "a", "b", "c", "d"]),
    put("animal", "joints", ["a", "b"]),
    put("animal", "joints", 5),
    put("animal", "bones", [[0, 99]]),
    put("animal", "bones", [[-1, 0]]),
    put("animal", "bones", [[0, 1, 2]]),
    put("animal", "bones", [["a", "b"]]),
    put("animal", "shape", 5),
    put("animal", "shape", {"kept": True, "n_frames": 60}),
    put("animal", "shape", {"kept": False, "n_frames": 60, "places": [0.1], "width": []}),
    put("animal", "shape", SHARED | {"width": [0.0]}),
    put("animal", "shape", SHARED | {"shared_by": ""}),
    put("model", "name", {"a": 1}),
    put("model", None),
    put("problems", "none"),
    put("problems", [{"a": 1}]),
    put("actions", ["walk"]),
    put("actions", {"walk": None}),
    put("rules", {"speed_half_window_s": "fast"}),
    put("frames", "n_frames", -1),
    put("frames", "n_frames", 10**12),
    put("frames", "n_frames", 29),
    put("frames", "flags", "good"),
    put("frames", "duration_s", "long"),
    put("thumbnails", [{"file": "thumbnails/../../x.png"}]),
    put("thumbnails", [{"file": "/etc/passwd"}]),
    put("timings_s", {"total": None}),
    put("versions", "1"),
    put("input", {}),
    put("plan", 5),
    put("schema_version", "x"),
    put("schema_version", 0),
    put("verdict", {"reasons": 5}),
    put("refused_bouts", {"bouts": [5]}),
    put("action_model", {"clock_hz": "fast"}),
    put("corrections", {"n": 1, "authors": 3}),
]


def test_a_session_json_of_other_values_is_refused_before_anything_is_read(
    foreign: Path, document: dict[str, Any]
) -> None:
    for change in CHANGES:
        changed = copy.deepcopy(document)
        change(changed)
        (foreign / "session.json").write_text(json.dumps(changed))
        refused(foreign, "")


def test_a_shape_that_is_shared_needs_no_frames_of_its_own(
    foreign: Path, document: dict[str, Any]
) -> None:
    changed = copy.deepcopy(document)
    put("animal", "shape", SHARED)(changed)
    (foreign / "session.json").write_text(json.dumps(changed))
    assert Session.open(foreign).metadata["animal"]["shape"]["shared_by"] == "2 sessions of m07"


def without(folder: Path, document: dict[str, Any], *names: str) -> Session:
    """The session without some sections of its session.json."""
    kept = {key: value for key, value in document.items() if key not in names}
    (folder / "session.json").write_text(json.dumps(kept))
    return Session.open(folder)


def test_every_missing_section_is_named_or_not_needed(
    foreign: Path, document: dict[str, Any]
) -> None:
    optional = []
    for name in document:
        try:
            without(foreign, document, name)
            optional.append(name)
        except SessionError as error:
            assert name in str(error)  # noqa: PT017
    assert len(document) - len(optional) > 8
    assert render(without(foreign, document, *optional))


@pytest.mark.nightly
def test_a_report_is_made_without_any_section_that_is_not_needed(
    foreign: Path, document: dict[str, Any]
) -> None:
    for name in document:
        try:
            session = without(foreign, document, name)
        except SessionError:
            continue
        assert render(session), name


def test_numbers_that_are_not_finite_are_refused(foreign: Path) -> None:
    path = foreign / "session.json"
    content = path.read_text()
    for text in ("NaN", "Infinity", "-Infinity", "1e999"):
        floor = f'"floor_distance_mm": {text}'
        path.write_text(content.replace('"floor_distance_mm": 700.0', floor))
        refused(foreign, "session.json")


def cast(name: str, kind: pa.DataType) -> Callable[[pa.Table], pa.Table]:
    """A change of one column's type."""
    return lambda t: t.set_column(
        t.schema.get_field_index(name), name, pa.array(t[name].to_pylist()).cast(kind)
    )


def valued(name: str, row: int, value: Any) -> Callable[[pa.Table], pa.Table]:
    """A change of one value."""

    def change(table: pa.Table) -> pa.Table:
        values = table[name].to_pylist()
        values[row] = value
        kind = table.schema.field(name).type
        return table.set_column(table.schema.get_field_index(name), name, pa.array(values, kind))

    return change


TABLES = [
    ("frames", lambda t: t.slice(1)),
    ("frames", lambda t: t.drop(["time_s"])),
    ("frames", cast("time_s", pa.string())),
    ("frames", cast("time_ns", pa.duration("ns"))),
    ("frames", lambda t: t.append_column("time_s", t["time_s"])),
    ("frames", valued("time_s", 3, float("nan"))),
    ("frames", valued("time_s", 3, -5.0)),
    ("frames", valued("frame_index", 3, 0)),
    ("frames", valued("flag", 3, None)),
    ("poses", lambda t: t.slice(5)),
    ("poses", lambda t: t.drop(["joint"])),
    ("poses", valued("joint", 7, "nose")),
    ("poses", lambda t: t.take(list(reversed(range(t.num_rows))))),
    ("rotations", lambda t: t.slice(0, t.num_rows - 1)),
    ("rotations", valued("joint", 0, "rump")),
    ("bouts", valued("stop_frame", 0, -1)),
    ("bouts", valued("action", 0, None)),
    ("bouts", valued("start_s", 0, float("nan"))),
    ("sessions", lambda t: pa.concat_tables([t, t])),
    ("sessions", lambda t: t.slice(1)),
]


def test_tables_of_other_widths_kinds_and_rows_are_refused(foreign: Path) -> None:
    for name, change in TABLES:
        path = foreign / f"{name}.parquet"
        whole = path.read_bytes()
        pq.write_table(change(pq.read_table(path)), path)
        refused(foreign, path.name)
        path.write_bytes(whole)


def test_a_table_that_claims_more_rows_than_its_file_can_hold_is_not_read(foreign: Path) -> None:
    n = 1_000_000
    path = foreign / "gaps.parquet"
    schema = pq.read_schema(path)
    columns = [pa.nulls(n, field.type) for field in schema]
    pq.write_table(pa.Table.from_arrays(columns, schema=schema.remove_metadata()), path)
    assert path.stat().st_size < 100_000
    refused(foreign, "gaps.parquet")


def test_a_verdict_of_other_kinds_is_no_verdict() -> None:
    assert verdict_in(
        {"verdict": {"reasons": 5, "look_at_it": "yes", "sentence": None}}
    ) == verdict_in({})
