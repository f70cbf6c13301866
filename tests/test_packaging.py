"""What pyproject.toml, README.md and .ci/run say about each other and about the folders."""

import os
import re
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

from tests.conftest import REPOSITORY

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
SETUP = PROJECT["tool"]["setuptools"]
TEST_LINE = (
    "python3 -m venv .venv && .venv/bin/pip install -q -e '.[test]' && .venv/bin/python -m pytest"
)
DEMO_LINE = "python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/liex demo"


def test_the_package_list_is_what_the_folders_hold() -> None:
    found = {"liex_lab.datasets"}
    for top, name in [
        ("liex_lab", "liex_lab"),
        ("pipelines", "liex_lab.pipelines"),
        ("dashboards", "liex_lab.dashboards"),
    ]:
        for folder in (REPOSITORY / top).rglob("*"):
            if folder.suffix == ".py":
                inner = folder.parent.relative_to(REPOSITORY / top).parts
                found.add(".".join([name, *inner]))
    assert sorted(SETUP["packages"]) == sorted(found)


def test_every_package_has_its_init_and_datasets_has_none() -> None:
    for package in SETUP["packages"]:
        top = max((name for name in SETUP["package-dir"] if package.startswith(name)), key=len)
        folder = (
            REPOSITORY
            / SETUP["package-dir"][top]
            / package.removeprefix(top).strip(".").replace(".", "/")
        )
        assert (folder / "__init__.py").is_file() == (package != "liex_lab.datasets"), folder


def test_every_data_file_of_a_package_is_shipped() -> None:
    for package, patterns in SETUP["package-data"].items():
        top = max((name for name in SETUP["package-dir"] if package.startswith(name)), key=len)
        folder = (
            REPOSITORY
            / SETUP["package-dir"][top]
            / package.removeprefix(top).strip(".").replace(".", "/")
        )
        inner = [other for other in SETUP["packages"] if other.startswith(f"{package}.")]
        shipped = {path for pattern in patterns for path in folder.glob(pattern)}
        for path in folder.rglob("*"):
            in_other = any(
                path.is_relative_to(folder / other.removeprefix(package)[1:]) for other in inner
            )
            is_data = path.is_file() and path.suffix not in {".py", ".pyc", ".nbi", ".nbc"}
            assert not is_data or in_other or path in shipped, (
                f"{path} would be missing from the wheel"
            )


def test_the_readme_holds_the_two_lines_that_do_the_set_up() -> None:
    blocks = re.findall(r"```sh\n(.*?)```", (REPOSITORY / "README.md").read_text(), re.DOTALL)
    assert f"{DEMO_LINE}\n" in blocks
    assert f"{TEST_LINE}\n" in blocks


def test_ci_runs_exactly_the_line_of_the_readme() -> None:
    script = (REPOSITORY / ".ci" / "run").read_text()
    extract = re.search(r"^test_line=.*$", script, re.MULTILINE)
    assert extract is not None
    read = subprocess.run(
        ["bash", "-c", f'{extract[0]}\nprintf %s "$test_line"'],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    )
    assert read.stdout == TEST_LINE
    assert 'bash -euo pipefail -c "$test_line"' in script
    assert "export CI=true" in script


IMPORTS = "import liex_lab.pipelines.session, liex_lab.dashboards.report.report, liex_lab.api"


def python_in_the_clone(*arguments: str, clone: Path = REPOSITORY) -> str:
    """What Python prints where README leaves a reader: in the clone, installed without `-e`.

    `-S` leaves out the finder of an editable installation, which would find the clone anywhere.
    """
    packages = os.pathsep.join({sysconfig.get_path("purelib"), sysconfig.get_path("platlib")})
    ran = subprocess.run(
        [sys.executable, "-S", *arguments],
        cwd=clone,
        env={**os.environ, "PYTHONPATH": packages},
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr[-2000:]
    return ran.stdout


def test_everything_is_importable_in_the_folder_of_the_clone(tmp_path: Path) -> None:
    for room in ("liex_lab", "pipelines", "dashboards", "datasets", "docs"):
        (tmp_path / room).symlink_to(REPOSITORY / room)
    sample = "from liex_lab.catalog import find_sample; find_sample('mouse_walk.mcap')"
    code = f"{sample}; import runpy; runpy.run_path('docs/conf.py'); {IMPORTS}"
    python_in_the_clone("-c", code, clone=tmp_path)
