"""Long tables are made, written and read in blocks: whatever their size, the same rows come out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from liex_lab.scene.outline import Arena
from liex_lab.scene.zones import Zone
from liex_lab.sessions import evidence
from liex_lab.sessions.evidence import FILE, write_evidence
from liex_lab.tables import rows as rows_module
from liex_lab.tables import schema
from liex_lab.tables.rows import Rows, seconds
from liex_lab.tracking.observations import COLUMNS, Observations
from liex_lab.tracking.track import Subject
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = WalkingMouse(np.delete(steady(3.0), slice(30, 36)), lost=(40, 41, 70))


@pytest.mark.parametrize("size", [1, 7, 50])
def test_a_table_made_in_blocks_is_the_one_made_at_once(
    size: int, monkeypatch: pytest.MonkeyPatch
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
        } | {"at once": rows.frames_table}

    at_once = made()
    monkeypatch.setattr(rows_module, "ROWS_PER_GROUP", size)
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
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "a.parquet"), table, check_exact=True)


def test_some_columns_or_rows_of_a_table_are_those_of_the_whole(tmp_path: Path) -> None:
    session = write(tmp_path / "a.liex", MOUSE)
    some = session.narrowed(frames=("time_s", "frame_index", "no such"), kinematics=("x_mm",))
    pd.testing.assert_frame_equal(some.frames, session.frames[["time_s", "frame_index"]])
    pd.testing.assert_frame_equal(some.kinematics, session.kinematics[["x_mm"]])
    poses = session.poses
    wanted = poses[poses["frame_index"].isin([3, 80])].reset_index(drop=True)
    pd.testing.assert_frame_equal(session.table("poses", frame_index=[3, 80]), wanted)
    pd.testing.assert_frame_equal(
        session.table("poses", ["joint", "x_mm"], [3, 80]), wanted[["joint", "x_mm"]]
    )


def test_evidence_is_written_in_blocks_as_numpy_writes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = Observations.empty(MOUSE.skeleton, MOUSE.times_ns)
    rng = np.random.default_rng(3)
    seen.place[:], seen.n_px[:] = (
        rng.normal(size=seen.place.shape),
        rng.integers(0, 99, seen.n_px.shape),
    )
    subject = Subject(
        MOUSE.skeleton, MOUSE.camera, MOUSE.T_arena_camera, 90.0, 5.0, 0.5, (1.0,) * 5
    )
    monkeypatch.setattr(evidence, "_BLOCK", 16)
    write_evidence(tmp_path, seen, subject)
    with np.load(tmp_path / FILE) as kept:
        told = kept["subject"]
    np.savez_compressed(
        tmp_path / "by_numpy.npz", subject=told, **{name: getattr(seen, name) for name in COLUMNS}
    )
    assert (tmp_path / FILE).read_bytes() == (tmp_path / "by_numpy.npz").read_bytes()
