"""What the pages for people say is there, is there; one version everywhere."""

import re
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

import liex_lab
from tests.conftest import REPOSITORY

PAGES = sorted(
    path
    for path in [*(REPOSITORY / "docs").rglob("*.md"), REPOSITORY / "CONTRIBUTING.md"]
    if not {"auto_examples", "_build"} & set(path.parts)
)
ROOMS = [
    "",
    "liex_lab",
    "liex_lab/recordings",
    "liex_lab/recordings/formats",
    "liex_lab/scene",
    "liex_lab/estimation",
    "liex_lab/tracking",
    "liex_lab/sessions",
    "dashboards/report",
    "tests/recordings",
]


def is_there(path: str) -> bool:
    return any((REPOSITORY / room / path).exists() for room in ROOMS)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_that_a_page_names_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"`((?:[\w.-]+/)*[\w-]+\.(?:py|toml|md)|(?:[\w.-]+/)+)`", text)
    linked = re.findall(r"\]\(([^)h][^)]*)\)", text)
    made = {
        "study.toml",
        "plan.toml",
        "gerbil.toml",
        "camera.toml",
        "raytrix.toml",
        "zones.toml",
        "study/study.toml",
    }  # by the program, or by a user
    made |= {"figures/", "study/study.toml", "study/derivatives/liex-lab/sub-m01/ses-day1/behav/"}
    missing = [path for path in named if path not in made and not is_there(path)]
    files = {link: link.partition("#")[0] or page.name for link in linked}
    missing += [link for link, file in files.items() if not (page.parent / file).exists()]
    missing += [link for link in linked if {"auto_examples", "_build"} & set(Path(link).parts)]
    assert not missing


@pytest.mark.parametrize("page", [*PAGES, REPOSITORY / "README.md"], ids=lambda page: page.name)
def test_a_page_reads_well_where_the_repository_is_read(page: Path) -> None:
    """It is plain Markdown: no directive or role of Sphinx is left in it as dead text."""
    text = re.sub(r"```\w+\n.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    dead = re.findall(
        r"`{3,}\{[\w-]+\}|^:{3,}.*|\{[a-z]+\}`|sphx_glr\w*|:[a-z]+:`", text, re.MULTILINE
    )
    assert not dead
    parts = re.findall(r"<!-- generated: ([\w-]+) -->\n(.*?)<!-- end of generated", text, re.DOTALL)
    assert len(re.findall(r"^<!-- generated: ", text, re.MULTILINE)) == len(parts)
    assert [name for name, part in parts if part.count("\n") < 5] == []


def test_generated_parts_are_those_that_the_program_writes_now() -> None:
    spec = spec_from_file_location("generate", REPOSITORY / "docs" / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    generate = module_from_spec(spec)
    spec.loader.exec_module(generate)
    found = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        found += re.findall(r"^<!-- generated: ([\w-]+) -->", text, re.MULTILINE)
        where = page.relative_to(REPOSITORY)
        assert generate.renewed(text) == text, f"{where} is stale: run python docs/generate.py"
    assert sorted(found) == sorted(generate.PARTS)


def test_every_dotted_path_that_is_called_public_can_be_imported() -> None:
    text = (REPOSITORY / "docs" / "public-paths.md").read_text(encoding="utf-8")
    for path in re.findall(r"`(liex_lab(?:\.[a-z_]+)+)(?:\.[A-Za-z_]+)?`", text):
        if path.split(".")[-1] in ("read_nyu_joints", "write_sample"):
            path = path.rpartition(".")[0]
        if path not in ("liex_lab.__all__",):
            assert find_spec(path) is not None, path


def test_one_version_is_stated_everywhere() -> None:
    version = liex_lab.__version__
    changes = (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\d[\w.]*)", changes, re.MULTILINE)[0] == version
    assert f"\nversion: {version}\n" in (REPOSITORY / "CITATION.cff").read_text(encoding="utf-8")
