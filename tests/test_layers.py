"""An import only ever goes down, and importing the package brings nothing heavy along."""

import ast
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

pytestmark = pytest.mark.checks

CONTRACT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["importlinter"][
    "contracts"
][0]
WITHOUT_LAYER = {"__init__", "__main__"}
DATA_FOLDERS = {"models"}


def imported_modules(path: Path) -> set[str]:
    """The dotted names that a file imports anywhere, inside functions too."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{name.name}" for name in node.names)}
    return found


def files_of(folder: str) -> list[Path]:
    return sorted((REPOSITORY / folder).rglob("*.py"))


def test_an_import_only_goes_down() -> None:
    lint = "from importlinter.cli import lint_imports; raise SystemExit(lint_imports())"
    ran = subprocess.run(
        [sys.executable, "-c", lint], cwd=REPOSITORY, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_every_module_of_the_library_has_a_layer() -> None:
    layers = " ".join(CONTRACT["layers"]).replace("(", " ").replace(")", " ").split()
    for entry in (REPOSITORY / "liex_lab").iterdir():
        is_module = entry.suffix == ".py" or (entry.is_dir() and any(entry.glob("*.py")))
        if is_module and entry.stem not in WITHOUT_LAYER | DATA_FOLDERS:
            assert f"liex_lab.{entry.stem}" in layers, (
                f"give {entry.name} a layer in pyproject.toml"
            )


@pytest.mark.parametrize(
    ("folder", "forbidden"),
    [
        ("pipelines", ("dashboards", "pipelines", "liex_lab.api", "liex_lab.cli")),
        (
            "dashboards",
            ("liex_lab.pipelines", "pipelines", "dashboards", "liex_lab.api", "liex_lab.cli"),
        ),
        ("liex_lab", ("pipelines", "dashboards")),
    ],
)
def test_views_do_not_know_the_jobs(folder: str, forbidden: tuple[str, ...]) -> None:
    """import-linter takes liex_lab.pipelines for a missing module, so this looks at the imports
    itself.
    """
    for path in files_of(folder):
        for name in imported_modules(path):
            assert not any(name == top or name.startswith(f"{top}.") for top in forbidden), (
                f"{path} imports {name}"
            )


def test_only_the_command_line_and_the_front_door_know_the_jobs() -> None:
    for path in files_of("liex_lab"):
        if path.relative_to(REPOSITORY / "liex_lab").parts[0] not in {"cli", "api.py"}:
            upwards = [
                name
                for name in imported_modules(path)
                if name.startswith(("liex_lab.pipe", "liex_lab.dash"))
            ]
            assert not upwards, f"{path} imports {upwards}"


HEAVY = {
    "numba",
    "pandas",
    "rerun",
    "sklearn",
    "scipy",
    "cv2",
    "pyarrow",
    "mcap",
    "foxglove",
    "tifffile",
    "open3d",
    "matplotlib",
    "torch",
    "statsmodels",
    "dask",
    "distributed",
}


@pytest.mark.parametrize(
    "code",
    [
        "import liex_lab; liex_lab.Camera, liex_lab.SE3, liex_lab.Plan, liex_lab.LiexError",
        "import liex_lab.cli, typer.testing; typer.testing.CliRunner().invoke(liex_lab.cli.app, "
        "['run', '--help'])",
    ],
)
def test_nothing_heavy_comes_along(code: str) -> None:
    code += "; import sys; print(*{name.partition('.')[0] for name in sys.modules})"
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert not HEAVY & set(ran.stdout.split())


def test_every_public_name_can_be_had() -> None:
    code = "import liex_lab; [getattr(liex_lab, name) for name in liex_lab.__all__]"
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, env=os.environ
    )
    assert ran.returncode == 0, ran.stderr


def imports_of_files() -> dict[str, set[str]]:
    """Every module of the repository with the modules of it that it imports anywhere, for types
    too.
    """
    tops = {
        "liex_lab": "liex_lab",
        "pipelines": "liex_lab.pipelines",
        "dashboards": "liex_lab.dashboards",
    }
    files: dict[str, Path] = {}
    for folder, package in tops.items():
        for path in files_of(folder):
            parts = path.relative_to(REPOSITORY / folder).with_suffix("").parts
            files[".".join([package, *(parts[:-1] if parts[-1] == "__init__" else parts)])] = path
    arrows: dict[str, set[str]] = {}
    for name, path in files.items():
        inside = name if path.name == "__init__.py" else name.rpartition(".")[0]
        found: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom):
                above = (
                    inside.split(".")[: len(inside.split(".")) - node.level + 1]
                    if node.level
                    else []
                )
                base = ".".join([*above, *([node.module] if node.module else [])])
                found |= {
                    f"{base}.{item.name}" if f"{base}.{item.name}" in files else base
                    for item in node.names
                }
            elif isinstance(node, ast.Import):
                found |= {item.name for item in node.names}
        arrows[name] = (found & set(files)) - {name}
    return arrows


def test_no_circle_of_imports_between_files() -> None:
    left = imports_of_files()
    while free := [name for name, found in left.items() if not found & set(left)]:
        for name in free:
            del left[name]
    assert not left, f"imports go in a circle among these, or from these into one: {sorted(left)}"


@pytest.mark.parametrize("folder", ["pipelines", "dashboards"])
def test_a_folder_imports_its_own_modules_relatively(folder: str) -> None:
    for path in files_of(folder):
        absolute = [
            name for name in imported_modules(path) if name.startswith(f"liex_lab.{folder}")
        ]
        assert not absolute, (
            f"{path} imports {absolute}; in the tree there is no such package, so nobody checks it"
        )
