"""Two animals in one arena: run, report and study say so, and the report shows the second one."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.convert import convert
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.sessions import Session
from liex_lab.simulation.scenes.catalogue import film

N_FRAMES = 90
SEED = 3
ADDRESS = f"synthetic:scene?name=two-animals&seed={SEED}&frames={N_FRAMES}"


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A study of the one recording, measured: its folder, and what was printed."""
    folder = tmp_path_factory.mktemp("two")
    (folder / "raw").mkdir()
    convert(ADDRESS, folder / "raw" / "two.mcap")
    (folder / "study.toml").write_text(
        'name = "two"\n[[animals]]\nid = "m1"\ngroup = "a"\n'
        '[[sessions]]\nanimal = "m1"\nsession = "01"\nrecording = "raw/two.mcap"\n'
    )
    result = CliRunner().invoke(cli.app, ["cohort", str(folder / "study.toml"), "--workers", "1"])
    assert result.exit_code == 0, result.output
    return folder, result.output


@pytest.fixture(scope="module")
def session(studied: tuple[Path, str]) -> Session:
    (found,) = studied[0].rglob("session.json")
    return Session.open(found.parent)


def test_the_studys_last_lines_and_its_table_say_what_the_session_says(
    studied: tuple[Path, str],
) -> None:
    *_, told, counted = studied[1].strip().splitlines()
    assert told.startswith("done")
    assert "note: 2 animals are in view and one of them is followed" in told
    assert counted == "1 session: 1 done with cautions"
    (table,) = studied[0].rglob("study.csv")
    assert "2 animals are in view" in table.read_text()


def test_a_run_ends_well_and_says_that_there_are_two(
    studied: tuple[Path, str], tmp_path: Path
) -> None:
    words = ["run", str(studied[0] / "raw" / "two.mcap"), "--out", str(tmp_path), "--no-depth"]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 0, result.output
    last = result.output.strip().splitlines()[-1]
    assert "2 animals are in view and one of them is followed" in last


def test_the_report_shows_the_one_that_is_not_measured_where_it_is(session: Session) -> None:
    page = (session.path / "report.html").read_text()
    assert "2 animals are in view, and only one of them is followed" in page
    found = re.search(r'<circle cx="([\d.]+)" cy="([\d.]+)"[^>]*class="beside"', page)
    assert found is not None
    assert "not measured</text>" in page
    entry = session.metadata["whole_picture"]
    assert (session.path / entry["file"]).is_file()
    # as it was rendered: each of the two is where a true animal is, and they are not the same
    animals = film("two-animals", SEED, N_FRAMES).animals
    row = int(np.flatnonzero(session.frames["frame_index"] == entry["frame_index"])[0])
    truth = [session.camera.project(animal.joints_camera[row].mean(axis=0)) for animal in animals]
    shown = np.array([float(found[1]), float(found[2])]) - 0.5
    poses = session.table("poses", ["u_px", "v_px"], [entry["frame_index"]])
    followed = poses[["u_px", "v_px"]].to_numpy(float).mean(axis=0)
    other = [np.linalg.norm(place - shown) for place in truth]
    own = [np.linalg.norm(place - followed) for place in truth]
    assert min(other) < 12
    assert min(own) < 12
    assert int(np.argmin(other)) != int(np.argmin(own))
