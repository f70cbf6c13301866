"""ruff, mypy and bandit hold for the whole repository, and every function but a numba kernel
states its types.
"""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import REPOSITORY

pytestmark = pytest.mark.checks


def run_module(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", *arguments], cwd=REPOSITORY, capture_output=True, text=True
    )


def test_ruff_finds_nothing() -> None:
    ran = run_module("ruff", "check", ".")
    assert ran.returncode == 0, ran.stdout


def test_mypy_finds_nothing() -> None:
    ran = run_module("mypy")
    assert ran.returncode == 0, ran.stdout


def test_bandit_finds_nothing_that_has_no_reason_beside_it() -> None:
    rooms = ("liex_lab", "pipelines", "dashboards")
    ran = run_module("bandit", "-q", "-c", "pyproject.toml", "-r", *rooms)
    assert ran.returncode == 0, ran.stdout


def functions_without_types(path: Path) -> list[str]:
    """Those that do not state what they return, but for kernels: numba finds their types itself."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    compiled = [
        ast.unparse(node)
        for node in nodes
        if isinstance(node, ast.Call) and ast.unparse(node.func) in {"kernel", "inner_kernel"}
    ]
    untyped = []
    for node in nodes:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.returns is None:
            decorators = " ".join(ast.unparse(decorator) for decorator in node.decorator_list)
            is_kernel = "kernel(" in decorators or any(
                call.endswith(f"({node.name})") for call in compiled
            )
            untyped += [] if is_kernel else [f"{path}:{node.lineno} {node.name}"]
    return untyped


@pytest.mark.parametrize("folder", ["liex_lab", "pipelines", "dashboards"])
def test_every_function_states_its_types(folder: str) -> None:
    untyped = [
        line
        for path in sorted((REPOSITORY / folder).rglob("*.py"))
        for line in functions_without_types(path)
    ]
    assert not untyped, "\n".join(untyped)


def kernels_of(path: Path) -> list[ast.FunctionDef]:
    """The functions of a file that numba compiles."""
    return [
        node
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef)
        and any("kernel(" in ast.unparse(decorator) for decorator in node.decorator_list)
    ]


def test_no_kernel_takes_more_than_twelve_arguments() -> None:
    """Past that a record is missing whose fields they are."""
    kernels = [
        (path, kernel)
        for path in sorted((REPOSITORY / "liex_lab").rglob("*.py"))
        for kernel in kernels_of(path)
    ]
    assert len(kernels) > 200
    crowded = [
        f"{path}:{kernel.lineno} {kernel.name}"
        for path, kernel in kernels
        if len(kernel.args.args) > 12
    ]
    assert not crowded, "\n".join(crowded)


def test_the_formatter_would_change_nothing() -> None:
    ran = run_module("ruff", "format", "--check", ".")
    assert ran.returncode == 0, ran.stdout
