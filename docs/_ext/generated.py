"""Pages that the program itself writes: a line `<!-- generated: NAME -->` stands for them.

The command line is read from its parser, the columns from their descriptions, settings from the
plan's classes, scores from the models' cards: none of it is typed into a page.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from typing import Any

import typer
from sphinx.application import Sphinx

_MARK = re.compile(r"^<!-- generated: ([\w-]+) -->$", re.MULTILINE)
_SCRIPT = re.compile(r"\]\((?:\.\./)*examples/(plot_\w+)\.py\)")  # a page of the gallery, in the site


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _leaves(name: str, command: Any, depth: int = 0) -> Iterator[tuple[str, Any, int]]:
    """Every verb with the words that call it; those of a group after the group."""
    yield name, command, depth
    if hasattr(command, "list_commands"):
        context = command.context_class(command, info_name=name)
        for inner in command.list_commands(context):
            found = command.get_command(context, inner)
            if not found.hidden:
                yield from _leaves(f"{name} {inner}", found, depth + 1)


def command_line() -> str:
    """Every verb of `liex` with its usage and options, as Markdown."""
    from liex_lab.cli.main import app

    lines: list[str] = []
    for name, command, depth in _leaves("liex", typer.main.get_command(app)):
        if depth == 0:
            continue
        context = command.context_class(command, info_name=name)
        usage = " ".join(command.collect_usage_pieces(context)).replace("[OPTIONS]", "[options]")
        lines += [f"{'#' * min(depth + 1, 3)} {name}", ""]
        lines += ["```text", f"{name} {usage}", "```", "", _prose(command.help), ""]
        if command.epilog:
            lines += [_prose(command.epilog), ""]
        rows = [_option(one, context) for one in command.params if not getattr(one, "hidden", 0)]
        if rows and not hasattr(command, "list_commands"):
            lines += ["| option | what it says |", "|---|---|", *rows, ""]
    return "\n".join(lines)


def _prose(text: str | None) -> str:
    return (text or "").replace("<", "\\<").replace("[", "\\[")


def _option(one: Any, context: Any) -> str:
    name, told = one.get_help_record(context) or (one.name, "")
    return f"| `{_cell(name)}` | {_cell(_prose(told))} |"


def every_column() -> str:
    """Every column of every table, a section a table, as Markdown."""
    from liex_lab.behaviour.listing import all_columns

    tables: dict[str, list[str]] = {}
    for column in all_columns().values():
        formula = f" ({column.formula})" if column.formula else ""
        row = f"| `{column.name}` | {column.unit} | {_cell(column.meaning + formula)} |"
        tables.setdefault(column.table, []).append(row)
    lines = []
    for table in sorted(tables):
        lines += [f"### {table}", "", "| column | unit | meaning |", "|---|---|---|"]
        lines += [*tables[table], ""]
    return "\n".join(lines)


def settings() -> str:
    """Every setting of a plan with its default, a section a table, as Markdown."""
    from pydantic import BaseModel

    from liex_lab.plan import Plan

    lines: list[str] = []
    for table, field in Plan.model_fields.items():
        inner = field.annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            continue
        lines += [f"### [{table}]", "", "| setting | default | what it is |", "|---|---|---|"]
        for key, one in inner.model_fields.items():
            default = "" if one.default is None else f"`{json.dumps(one.default)}`"
            lines.append(f"| `{table}.{key}` | {default} | {_cell(one.description or '')} |")
        lines.append("")
    return "\n".join(lines)


def exports() -> str:
    """Every format that `liex export` writes, as Markdown."""
    from liex_lab.exchange import TARGETS

    rows = [f"| `{word}` | {_cell(told)} |" for word, (_, _, told) in TARGETS.items()]
    return "\n".join(["| `--to` | what is written |", "|---|---|", *rows, ""])


def scores() -> str:
    """The scores on the models' cards, measured when the bundled models were made, as Markdown."""
    from liex_lab.catalog import bundled_models

    head = ("model", "frames", "mean joint error", "median", "95 % within", "flips", "lost")
    lines = [
        f"| {' | '.join((*head, 'within the 90 % interval', 'predicted and true error'))} |",
        "|---" * 9 + "|",
    ]
    for name, card in bundled_models().items():
        for split, one in card.get("scores", {}).items():
            if not isinstance(one, dict) or "mean_joint_error_mm" not in one:
                continue
            mm = [f"{one[f'{key}_joint_error_mm']:.2f} mm" for key in ("mean", "median", "p95")]
            share = [f"{one[key]:.1%}" for key in ("flip_rate", "lost_rate")]
            lines.append(
                f"| {name}, {split} | {one['n_frames']:,} | {' | '.join(mm + share)} | "
                f"{one['interval90_coverage']:.0%} | {one['spearman_predicted_error']:.2f} |"
            )
    return "\n".join(lines) + "\n"


def vocabularies() -> str:
    """The words that actions are named by, with their definitions, as Markdown."""
    from liex_lab.actions.vocabulary import WORDS

    lines = []
    for animal, words in sorted(WORDS.items()):
        lines += [f"## {animal.capitalize()}", "", "| action | definition |", "|---|---|"]
        lines += [f"| `{word}` | {_cell(told.printed)} |" for word, told in words.items()]
        lines.append("")
    return "\n".join(lines)


PAGES: dict[str, Callable[[], str]] = {
    "command-line": command_line,
    "every-column": every_column,
    "settings": settings,
    "exports": exports,
    "scores": scores,
    "vocabularies": vocabularies,
}


def replace(app: Sphinx, docname: str, source: list[str]) -> None:
    """Put the generated text in the place of each mark.

    Args:
        app: Sphinx.
        docname: the page.
        source: its text, the only element, changed in place.
    """
    text = _MARK.sub(lambda mark: PAGES[mark[1]](), source[0])
    source[0] = _SCRIPT.sub(r"](/auto_examples/\1.rst)", text)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx.

    Args:
        app: Sphinx.
    """
    app.connect("source-read", replace)
    return {"parallel_read_safe": True}
