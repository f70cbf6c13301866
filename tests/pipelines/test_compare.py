"""Sessions on disk are compared by group, and what cannot be is told."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from liex_lab.pipelines.compare import compare_sessions, find_sessions
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.errors import SessionError
from tests.sessions.walking_mouse import WalkingMouse, steady, write


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five slow mice and five that are twice as fast, one session each."""
    folder = tmp_path_factory.mktemp("study")
    for k in range(10):
        mouse = WalkingMouse(steady(1.0), speed_mm_s=100.0 + 3 * k + 100.0 * (k >= 5))
        subject = {"subject_id": f"m{k}", "group": "fast" if k >= 5 else "control"}
        write(folder / f"sub-m{k}" / f"s{k}.liex", mouse, name=f"s{k}", subject=subject)
    return folder


def test_the_groups_of_a_folder_of_sessions_are_compared(study, tmp_path):
    ran = CliRunner().invoke(
        cli.app, ["compare", str(study), "--out", str(tmp_path), "--measure", "mean_speed_mm_s"]
    )
    assert ran.exit_code == 0, ran.output
    stats = pd.read_parquet(tmp_path / "stats.parquet")
    assert list(stats["contrast"]) == ["fast - control"]
    assert stats["estimate"].iloc[0] == pytest.approx(115.0, rel=1e-2)
    assert stats["p"].iloc[0] == pytest.approx(2 / 252)
    assert "mean_speed_mm_s" in ran.output
    assert "0.0079" in ran.output
    assert len(pd.read_csv(tmp_path / "sessions.csv")) == 10
    assert "unit of comparison is the animal" in (tmp_path / "methods.txt").read_text()
    assert (tmp_path / "columns.json").is_file()


def test_why_nothing_is_tested_is_said_once_for_all_measures(study, tmp_path):
    asked = [f"--measure={name}" for name in ("rear_share", "pause_share", "distance_m")]
    ran = CliRunner().invoke(cli.app, ["compare", str(study), "--out", str(tmp_path), *asked])
    assert ran.exit_code == 0, ran.output
    assert ran.output.count("every unit has the same value") == 1
    assert "not tested: rear_share, pause_share\n" in ran.output
    assert "nan" not in ran.output


def test_the_usual_measures_are_those_with_values(study, tmp_path):
    stats = compare_sessions([study], tmp_path)["stats"]
    assert {"distance_m", "mean_speed_mm_s", "walk_share"} <= set(stats["measure"])
    assert "outer_half_share" not in set(stats["measure"])  # nobody knows where the walls are
    assert "unlabelled_share" not in set(stats["measure"])


def test_a_list_of_the_animals_overrules_the_sessions(study, tmp_path):
    table = tmp_path / "animals.csv"
    table.write_text(
        "subject_id,group,cage\n" + "".join(f"m{k},{'ab'[k % 2]},c{k // 2}\n" for k in range(10))
    )
    row = compare_sessions([study], tmp_path / "out", ["distance_m"], animals=table)["stats"].iloc[
        0
    ]
    assert row["contrast"] == "b - a"
    # every cage holds one of each, so only those two change places
    assert "5 against 5 animals within their blocks can be arranged in 32 ways" in row["refused"]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("subject_id,group\nm0,a\n", "does not list the animal 'm1'"),
        ("name,group\nm0,a\n", "should have a column subject_id"),
        ("", "should be a CSV"),
    ],
)
def test_a_list_that_does_not_fit_is_told(study, tmp_path, text, sentence):
    (tmp_path / "animals.csv").write_text(text)
    with pytest.raises(SessionError, match=sentence):
        compare_sessions([study], tmp_path / "out", animals=tmp_path / "animals.csv")
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_compared_is_told(study, tmp_path):
    with pytest.raises(SessionError, match="there is no session in"):
        compare_sessions([tmp_path], tmp_path / "out")
    with pytest.raises(SessionError, match="is not a folder"):
        find_sessions([tmp_path / "nowhere"])
    with pytest.raises(SessionError, match="no session's summary has the column 'sped'"):
        compare_sessions([study], tmp_path / "out", ["sped"])
    with pytest.raises(SessionError, match="one of them 'wild'"):
        compare_sessions([study], tmp_path / "out", reference="wild")
    with pytest.raises(SessionError, match="needs two groups"):
        compare_sessions([study / "sub-m0"], tmp_path / "out")
    with pytest.raises(SessionError, match="the engine is one of"):
        compare_sessions([study], tmp_path / "out", engine="anova")
