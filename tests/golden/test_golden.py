"""Sessions that older versions wrote stay readable: every table, every column, every value."""

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest
from liex_lab.dashboards.report.report import render

from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.scene.scene import UNKNOWN
from liex_lab.sessions import Session
from liex_lab.sessions.provenance import SCHEMA_VERSION
from tests.golden.write import ARENA, CAMERA, HERE, TABLES, ZONES, contents

NUMBERS = sorted(
    int(path.name.removeprefix("session_").removesuffix(".tar.gz"))
    for path in HERE.glob("*.tar.gz")
)


def opened(number: int, folder: Path) -> Session:
    """The golden session of a schema, extracted into a folder."""
    with tarfile.open(HERE / f"session_{number}.tar.gz") as tar:
        tar.extractall(folder, filter="data")
    return Session.open(folder / f"session_{number}")


@pytest.fixture(scope="module", params=NUMBERS)
def golden(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Session:
    session = opened(request.param, tmp_path_factory.mktemp("golden"))
    assert session.metadata["schema_version"] == request.param
    return session


def test_every_schema_has_its_golden_session() -> None:
    assert list(range(1, SCHEMA_VERSION + 1)) == NUMBERS
    for number in NUMBERS:
        assert sum(path.stat().st_size for path in HERE.glob(f"session_{number}.*")) < 220_000


def test_every_table_is_read_with_its_columns_and_values(golden: Session) -> None:
    expected = json.loads(
        (HERE / f"session_{golden.metadata['schema_version']}.json").read_text(encoding="utf-8")
    )
    found = contents(golden)
    assert list(expected) == list(TABLES)
    for name, table in expected.items():
        assert found[name]["n_rows"] == table["n_rows"], name
        for column, (kind, n_known, value) in table["columns"].items():
            now = found[name]["columns"][column]
            assert now[:2] == [kind, n_known], f"{name}.{column}"
            assert now[2] == (
                value if kind == "text" else pytest.approx(value, rel=1e-12, abs=1e-12)
            ), column


def test_every_column_is_still_explained(golden: Session) -> None:
    described = set(zip(golden.columns["table"], golden.columns["name"], strict=True))
    for name in TABLES:
        table = golden.summary if name == "summary" else golden.table(name)
        assert {(name, column) for column in table.columns} <= described


def test_camera_place_plan_and_depth_are_read(golden: Session) -> None:
    assert golden.camera == CAMERA
    np.testing.assert_allclose(golden.T_arena_camera @ [0.0, 0.0, 700.0], 0.0, atol=1e-9)
    assert isinstance(Plan.from_toml(golden.plan), Plan), "a plan may gain settings, but lose none"
    with open_recording(golden.path / "session.mcap") as recording:
        assert recording.times_ns.tolist() == golden.frames["time_ns"].tolist()
        assert len(recording.gaps) == 1


def test_arena_and_zones_are_read_where_the_session_knows_them(golden: Session) -> None:
    known = golden.metadata["schema_version"] >= 2
    assert golden.arena == (ARENA if known else UNKNOWN)
    assert tuple(golden.zones) == (ZONES if known else ())
    assert ("zone_centre_s" in golden.summary.columns) == known


def test_the_report_of_the_oldest_and_the_newest_session_can_be_made_again(
    tmp_path: Path,
) -> None:
    for number in (NUMBERS[0], NUMBERS[-1]):
        session = opened(number, tmp_path)
        assert session.name in render(session)


@pytest.mark.nightly
def test_the_report_of_every_old_session_can_be_made_again(golden: Session) -> None:
    assert golden.name in render(golden)
