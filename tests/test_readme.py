"""What README.md says is there, is there."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

import liex_lab
from liex_lab import cli
from liex_lab.arena.zones import read_zones
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
        "cohort compare convert correct dashboard demo doctor evaluate export info live report "
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


def test_the_python_example_uses_what_there_is() -> None:
    (example,) = blocks("python")
    attributes = [node for node in ast.walk(ast.parse(example)) if isinstance(node, ast.Attribute)]
    used = {node.attr for node in attributes if ast.unparse(node.value) == "liex_lab"}
    assert used == {"open_recording", "Plan", "run_session", "Session"}
    assert used <= set(liex_lab.__all__)


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
