"""What README.md and the manual in docs/ say is there, is there."""

import re
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.behaviour.cohort import STATS
from liex_lab.body import Skeleton
from liex_lab.catalog import bundled_models
from liex_lab.exchange import TARGETS
from liex_lab.exchange.export import ALIASES
from liex_lab.optics.camera import SensorCard
from liex_lab.plan import Plan
from liex_lab.scene.scene import Fixture, Scene
from liex_lab.scene.zones import read_zones
from liex_lab.sessions.session import FILES
from liex_lab.tables.schema import all_columns
from tests.conftest import REPOSITORY

README = (REPOSITORY / "README.md").read_text(encoding="utf-8")
DOCS = REPOSITORY / "docs"
GENERATED = re.compile(r"<!-- generated: .*?<!-- end of generated -->", re.DOTALL)
PAGES = {  # as people wrote them
    path.relative_to(DOCS).as_posix(): GENERATED.sub("", path.read_text(encoding="utf-8"))
    for path in DOCS.rglob("*.md")
    if not {"auto_examples", "_build"} & set(path.parts)
}
EVERYTHING = "\n".join([README, *PAGES.values()])

OTHERS = {"height_ave_mm", "velocity_2d_mm", "area_mm", "dist_to_center_px"}  # MoSeq's columns
SCENE = {field.name for kind in (Scene, Fixture, SensorCard) for field in fields(kind)}


def blocks(language: str, text: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def test_the_readme_is_short_and_its_pictures_are_small() -> None:
    assert len(README.splitlines()) <= 150
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README)
    assert len(pictures) == 3
    assert sum((REPOSITORY / path).stat().st_size for path in pictures) <= 350_000
    assert (REPOSITORY / "dashboards" / "assets" / "demo.png").stat().st_size <= 150_000


def test_every_file_of_a_session_and_every_link_is_there() -> None:
    told = re.findall(r"^\| .*", PAGES["reference/session-folder.md"], re.MULTILINE)
    named = set(re.findall(r"`([a-z_]+\.[a-z]+)`", "\n".join(told)))
    assert set(FILES) | {"report.html"} == named
    for link in re.findall(r"\]\(([^)h][^)]*)\)", README):
        assert (REPOSITORY / link).exists(), link


def test_errors_in_the_readme_are_those_of_the_models_card() -> None:
    scores = bundled_models()["mouse"]["scores"]
    (ours,) = re.findall(r"Our own virtual mice: (.*?) \|", README)
    splits = ("clean", "hard", "other-body")
    stated = [float(mm) for mm in re.findall(r"(\d\.\d) mm", ours)]
    assert stated == [round(scores[split]["median_joint_error_mm"], 1) for split in splits]


def test_every_verb_option_setting_and_format_that_is_named_exists() -> None:
    help_of: dict[str, str] = {}

    def helped(*words: str) -> str:
        if " ".join(words) not in help_of:
            help_of[" ".join(words)] = CliRunner().invoke(cli.app, [*words, "--help"]).output
        return help_of[" ".join(words)]

    top = helped()
    shell = [block for text in (README, *PAGES.values()) for block in blocks("sh", text)]
    lines = "".join(shell).splitlines()
    lines += re.findall(r"`(liex [a-z][^`]*)`", EVERYTHING)
    calls = [line.strip().removeprefix(".venv/bin/") for line in lines]
    calls = [call for call in calls if call.startswith("liex ")]
    assert len(calls) > 60
    for call in calls:
        words = call.split("#")[0].split()[1:]
        verb = words[0]
        if verb.startswith("--") or verb == "VERB":
            continue
        assert f"  {verb} " in top, call
        inner = [words[1]] if verb in ("correct", "evaluate", "import") and len(words) > 1 else []
        if inner and not re.fullmatch(r"[a-z]+", inner[0]):
            inner = []
        options = helped(verb, *inner)
        assert "Usage:" in options, call
        for option in re.findall(r" (--[a-z][a-z-]*)", call.split("#")[0]):
            assert option in options, call
    plan = tomllib.loads(
        re.sub(r"^# (\w+) =$", r"\1 = 0", Plan.load("mouse").to_toml(), flags=re.MULTILINE)
    )
    tables = "|".join(plan)
    for table, key in re.findall(rf"`(?:--set )?({tables})\.([a-z]\w+)(?:=[^`]*)?`", EVERYTHING):
        if key not in ("parquet", "csv", "json", "toml", "rrd", "mcap", "rbl", "html"):
            assert key in plan[table], f"{table}.{key}"
    formats = set(re.findall(r"--to ([a-z]+)\b", EVERYTHING)) - {"study", "live", "none"}
    assert {"csv", "xlsx", "nwb"} <= formats <= {*TARGETS, *ALIASES, "video"}


def test_every_column_that_is_named_is_one() -> None:
    units = "mm|mm_s|mm_s2|rad|rad_s|px|s|m|hz|share|count"
    named = set(re.findall(rf"`([a-z]\w*_(?:{units}))`", EVERYTHING))
    known = {name.split(".")[1] for name in all_columns()} | {column.name for column in STATS}
    known |= {
        key
        for table in Plan.load("mouse").model_dump().values()
        if isinstance(table, dict)
        for key in table
    }
    known |= {"arc_mm", "surface_mm", "thickness_mm", "along_constant_mm"}  # of foreign bodies
    known |= {"expected_error_mm", "unit_mm", "mesh_unit_mm", "points_mm", "time_s"}
    known |= {"offset_s", "nose_z_mm", "pair_WORD_share"}  # of a table in the plan, and examples
    known |= {one for one in named if "_minus_" in one and one.endswith(tuple(known))}
    assert len(named) > 20
    assert named <= known | OTHERS | SCENE, named - known


def test_the_zones_can_be_read(tmp_path: Path) -> None:
    names = []
    for example in blocks("toml", PAGES["howto/zones.md"]):
        (tmp_path / "zones.toml").write_text(example, encoding="utf-8")
        names.append([name for zone in read_zones(tmp_path / "zones.toml") for name in zone.names])
    corners = [f"corner_{k}" for k in range(1, 5)]
    assert names == [["centre", "nest"], ["centre", "periphery", *corners, "left_object"]]


def test_the_animal_of_ones_own_can_be_read(tmp_path: Path) -> None:
    example, _ = blocks("toml", PAGES["tutorials/own-animal.md"])  # a skeleton, and a plan
    (tmp_path / "gerbil.toml").write_text(example, encoding="utf-8")
    gerbil = Skeleton.load(tmp_path / "gerbil.toml")
    assert (gerbil.name, gerbil.n_joints, gerbil.dof) == ("gerbil", 3, 8)
    assert gerbil.length == pytest.approx(75.0)


def test_the_arenas_can_be_read() -> None:
    example, _ = blocks("toml", PAGES["howto/arenas.md"])  # of a plan, and of a study
    arenas = Plan.from_toml(example).arenas
    assert arenas is not None
    assert not isinstance(arenas, str)
    assert [one.name for one in arenas] == ["left", "right"]
