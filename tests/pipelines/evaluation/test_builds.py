"""`liex evaluate pose --split other-build`: animals of another build, tracked as a run does."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from liex_lab.pipelines.evaluation import builds
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.errors import LiexError


@pytest.mark.slow
def test_a_mouse_of_another_build_stands_beside_a_usual_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(builds, "N_FRAMES", 40)
    file = tmp_path / "builds.json"
    words = ["evaluate", "pose", "--split", "other-build", "--frames", "1", "--json", str(file)]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 0, result.output
    told = json.loads(file.read_text())
    for name in ("other", "usual"):
        assert told[name]["n_frames"] == 40
        assert told[name]["found"] > 0.9
        assert told[name]["error_percent"] < 15.0
    assert told["ratio_to_usual"] == pytest.approx(
        told["other"]["error_percent"] / told["usual"]["error_percent"]
    )


def test_the_sealed_animals_are_others_than_those_of_development() -> None:
    assert not {*builds.SEEDS, *range(201, 230)} & {*builds.SEALED_SEEDS}


def test_cameras_and_noise_go_in_turn() -> None:
    made = [builds.film("mouse", 500, k, "other") for k in range(12)]
    assert len({(one.camera.width, round(one.camera.fx)) for one in made}) >= 4


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--animal", "hand"], "is of mouse and fish"),
        (["--variant", "paper"], "bundled model"),
        (["--frames", "99999"], "at most so many"),
    ],
)
def test_what_cannot_be_measured_is_told(words: list[str], told: str) -> None:
    result = CliRunner().invoke(cli.app, ["evaluate", "pose", "--split", "other-build", *words])
    assert isinstance(result.exception, LiexError)
    assert told in str(result.exception)
    result = CliRunner().invoke(cli.app, ["evaluate", "pose", "--sealed"])
    assert "leave it out" in str(result.exception)
