"""What the pages for people say is there, is there; one version everywhere."""

from __future__ import annotations

import re
from importlib.util import find_spec
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
    "liex_lab/foreground",
    "liex_lab/estimation",
    "liex_lab/tracking",
    "liex_lab/sessions",
    "dashboards/report",
    "tests/recordings",
]


def is_there(path: str) -> bool:
    return any((REPOSITORY / room / path).exists() for room in ROOMS)


def is_drawn(path: Path) -> bool:
    """Whether an example of the gallery draws this picture when the site is built."""
    drawn = re.fullmatch(r"sphx_glr_(plot_\w+)_\d{3}\.png", path.name)
    return drawn is not None and (REPOSITORY / f"docs/examples/{drawn[1]}.py").is_file()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_that_a_page_names_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"`((?:[\w.-]+/)*[\w-]+\.(?:py|toml|md)|(?:[\w.-]+/)+)`", text)
    linked = re.findall(r"\]\(([^)h][^)]*)\)", text)
    made = {
        "study.toml",
        "plan.toml",
        "camera.toml",
        "raytrix.toml",
        "study/study.toml",
    }  # by the program, or by a user
    made |= {"figures/", "study/study.toml", "derivatives/liex-lab/sub-m01/ses-01/behav/"}
    missing = [path for path in named if path not in made and not is_there(path)]
    files = {link: page.parent / link for link in linked}
    missing += [link for link, file in files.items() if not (file.exists() or is_drawn(file))]
    assert not missing


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
