"""What README.md says is there, is there."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest
from liex_lab.pipelines.convert import convert
from typer.testing import CliRunner

import liex_lab
from liex_lab import cli
from liex_lab.arena.zones import read_zones
from liex_lab.behaviour.cohort import STATS
from liex_lab.behaviour.listing import FIRST, all_columns, first_columns
from liex_lab.body import Skeleton
from liex_lab.plan import Plan
from liex_lab.sessions.session import FILES
from tests.conftest import REPOSITORY

TEXT = (REPOSITORY / "README.md").read_text(encoding="utf-8")


def section(title: str) -> str:
    return TEXT.split(f"\n## {title}\n")[1].split("\n## ")[0]


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


def test_every_file_and_every_link_is_there() -> None:
    out = section("What comes out")
    assert set(FILES) | {"report.html"} == set(
        re.findall(r"`([a-z_]+\.[a-z]+)`", out.split("The columns that")[0])
    )
    for link in re.findall(r"\]\(([^)h][^)]*)\)", TEXT):
        assert (REPOSITORY / link).exists(), link
    assert (REPOSITORY / "dashboards" / "assets" / "demo.png").stat().st_size <= 150_000


def test_the_list_of_columns_is_the_columns_own() -> None:
    listed = TEXT.split("<!-- columns: python -m liex_lab.behaviour.listing -->\n")[1].split(
        "<!-- end of columns"
    )[0]
    assert listed == first_columns()
    assert set(FIRST) <= set(all_columns())


def test_every_verb_and_every_setting_exists() -> None:
    verbs = re.findall(r"^\| `(\w+)", section("The verbs"), re.MULTILINE)[
        1:
    ]  # the first is `liex ...`
    told = CliRunner().invoke(cli.app, ["--help"]).output
    known = (
        "cohort compare convert correct dashboard demo describe doctor evaluate export "
        "figures info live "
        "report "
        "run show suggest "
    )
    known += "train verify"
    assert sorted(verbs) == sorted(known.split())
    assert all(verb in told for verb in verbs)
    plan = tomllib.loads(
        re.sub(r"^# (\w+) =$", r"\1 = 0", Plan.load("mouse").to_toml(), flags=re.MULTILINE)
    )
    for table, key in re.findall(
        r"`(\w+)\.(\w+)(?:=[^`]*)?`", section("The plan").split("**Size.**")[0]
    ):
        assert key in plan[table], f"{table}.{key}"


def test_every_python_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each is run as it stands, on a short virtual recording that has the name it asks for."""
    monkeypatch.chdir(tmp_path)
    convert("synthetic:walk?seed=3&frames=60", "recording.mcap")
    examples = blocks("python")
    assert examples
    for example in examples:
        for asked in set(re.findall(r'"(recording\.[a-z.]+)"', example)):
            example = example.replace(asked, "recording.mcap")
        for _ in range(2):  # again it replaces what is there
            exec(compile(example, "README.md", "exec"), {})
        names = {
            node.attr
            for node in ast.walk(ast.parse(example))
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "liex_lab"
        }
        assert names <= set(liex_lab.__all__)
    assert (tmp_path / "results" / "recording.liex" / "session.json").is_file()
    assert capsys.readouterr().out.count("\n") >= 2 * len(examples)


def test_every_column_that_is_named_is_one() -> None:
    named = set(re.findall(r"`(?:frames|poses|kinematics|bouts|summary) `?(\w+)`", TEXT))
    named |= set(re.findall(r"`((?:rear|distance|speed|mean|n)_\w+)`", TEXT))
    known = {name.split(".")[1] for name in all_columns()} | {column.name for column in STATS}
    assert named
    assert named <= known


def test_the_zones_can_be_read(tmp_path: Path) -> None:
    (example,) = [block for block in blocks("toml") if "[[zones]]" in block]
    (tmp_path / "zones.toml").write_text(example, encoding="utf-8")
    assert [zone.name for zone in read_zones(tmp_path / "zones.toml")] == ["centre", "nest"]


def test_the_animal_of_ones_own_can_be_read(tmp_path: Path) -> None:
    (example,) = [block for block in blocks("toml") if "[[joints]]" in block]
    (tmp_path / "gerbil.toml").write_text(example, encoding="utf-8")
    gerbil = Skeleton.load(tmp_path / "gerbil.toml")
    assert (gerbil.name, gerbil.n_joints, gerbil.dof) == ("gerbil", 3, 8)
    assert gerbil.length == pytest.approx(75.0)
