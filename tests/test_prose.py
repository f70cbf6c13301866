"""Prose and layout that readers can rely on: parameters are named, statements stand alone."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import pytest

from tests.conftest import REPOSITORY

pytestmark = pytest.mark.checks

FILES = [
    path
    for top in ("liex_lab", "pipelines", "dashboards")
    for path in sorted((REPOSITORY / top).rglob("*.py"))
]
Definition = ast.FunctionDef | ast.ClassDef


def public(path: Path) -> Iterator[Definition]:
    """Functions, classes and methods that no name on the way calls private."""

    def within(node: ast.AST) -> Iterator[Definition]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, Definition) and not child.name.startswith("_"):
                yield child
                if isinstance(child, ast.ClassDef):
                    yield from within(child)

    parts = path.relative_to(REPOSITORY).parts
    if not any(part.startswith("_") and not part.startswith("__") for part in parts):
        yield from within(ast.parse(path.read_text(encoding="utf-8")))


def test_public_docstrings_name_their_parameters_and_say_more_than_a_line() -> None:
    named, lines = [], []
    for path in FILES:
        for node in public(path):
            text = ast.get_docstring(node) or ""
            lines.append(len(text.splitlines()))
            if isinstance(node, ast.FunctionDef):
                arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                names = [each.arg for each in arguments if each.arg not in ("self", "cls")]
                named += [re.search(rf"\b{name}\b", text) is not None for name in names]
    assert sum(named) >= 0.9 * len(named)
    assert median(lines) >= 4


def test_a_statement_stands_alone_and_the_formatter_is_in_charge() -> None:
    assignments, packed, kept_from_formatter = 0, 0, 0
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        kept_from_formatter += len(re.findall(r"# fmt: (?:skip|off)", text))
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Assign):
                assignments += 1
                packed += isinstance(node.targets[0], ast.Tuple) and isinstance(
                    node.value, ast.Tuple
                )
    assert packed < 0.02 * assignments
    assert kept_from_formatter <= 60
