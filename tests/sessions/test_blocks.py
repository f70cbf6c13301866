"""Long tables are made, written and read in blocks: whatever their size, the same rows come out."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from liex_lab.scene.scene import Arena
from liex_lab.scene.zones import Zone
from liex_lab.sessions import session as session_module
from liex_lab.tables import rows as rows_module
from liex_lab.tables import schema
from liex_lab.tables.rows import Rows, seconds
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = WalkingMouse(np.delete(steady(3.0), slice(30, 36)), lost=(40, 41, 70))


def spelled_out(table: pd.DataFrame) -> pd.DataFrame:
    """A table whose categories are texts, as in the files."""
    names = table.select_dtypes("category").columns
    return table.astype(dict.fromkeys(names, "str"))


def test_a_table_made_in_blocks_is_the_one_made_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    zones = [Zone("side", (150.0, 0.0, 60.0)), Zone("all", (0.0, 0.0, 1e4))]
    arena = Arena("round", (0.0, 0.0), radius_mm=200.0)

    def made() -> dict[str, pd.DataFrame]:
        rows = Rows(MOUSE.track(), 5 + np.arange(len(MOUSE.times_ns)), "s", "m", (), arena, zones)
        return {
            name: pd.concat(
                [schema.to_pandas(schema.TABLES[name], block) for block in blocks],
                ignore_index=True,
            )
            for name, blocks in (
                ("frames", rows.frames()),
                ("poses", rows.poses()),
                ("rotations", rows.rotations()),
            )
        } | {"at once": spelled_out(rows.frames_table)}

    at_once = made()
    monkeypatch.setattr(rows_module, "ROWS_PER_GROUP", 50)
    in_blocks = made()
    for name, table in at_once.items():
        pd.testing.assert_frame_equal(in_blocks[name], table, check_exact=True)
    pd.testing.assert_frame_equal(in_blocks["frames"], in_blocks["at once"], check_exact=True)
    time_s = seconds(np.array(MOUSE.times_ns))
    np.testing.assert_array_equal(at_once["frames"]["time_s"], time_s)
    np.testing.assert_allclose(at_once["frames"]["dt_s"][1:], np.diff(time_s), atol=1e-12)
    assert np.isnan(at_once["frames"]["dt_s"][0])


def test_a_data_frame_is_written_in_blocks_as_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    table = Rows(MOUSE.track(), np.arange(len(MOUSE.times_ns)), "s", "m").frames_table
    monkeypatch.setattr(schema, "ROWS_PER_GROUP", 16)
    schema.write_table(tmp_path / "a.parquet", schema.FRAMES, schema.from_pandas(table), {})
    written = pd.read_parquet(tmp_path / "a.parquet")
    pd.testing.assert_frame_equal(written, spelled_out(table), check_exact=True)


@pytest.mark.parametrize("long", [10, 1000])
def test_some_columns_or_rows_of_a_table_are_those_of_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, long: int
) -> None:
    session = write(tmp_path / "a.liex", MOUSE)
    monkeypatch.setattr(session_module, "_LONG", long)
    some = session.narrowed(frames=("time_s", "frame_index", "no such"), kinematics=("x_mm",))
    pd.testing.assert_frame_equal(some.frames, session.frames[["time_s", "frame_index"]])
    pd.testing.assert_frame_equal(some.kinematics, session.kinematics[["x_mm"]])
    poses = session.poses
    wanted = poses[poses["frame_index"].isin([3, 80])].reset_index(drop=True)
    pd.testing.assert_frame_equal(session.table("poses", frame_index=[3, 80]), wanted)
    pd.testing.assert_frame_equal(
        session.table("poses", ["joint", "x_mm"], [3, 80]), wanted[["joint", "x_mm"]]
    )
