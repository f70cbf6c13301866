"""Options that several verbs of `liex` share, and how they tell numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

RecordingPath = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="A file, a folder, or synthetic:walk.")
]
SessionPath = Annotated[
    Path, typer.Argument(metavar="SESSION", help="A session folder, NAME.liex.")
]
PlanName = Annotated[
    str, typer.Option("--plan", help="A bundled plan (`liex info` lists them), or a .toml file.")
]
OutFolder = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="The folder in which NAME.liex is made.")
]
TopicName = Annotated[
    str | None,
    typer.Option("--topic", help="The topic of an MCAP file or ROS bag, where several hold depth."),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a value of the plan; repeatable."),
]
AnimalName = Annotated[
    str, typer.Option("--animal", help="fish, mouse, hand, or a skeleton's .toml file.")
]
VariantName = Annotated[
    str, typer.Option("--variant", help="default, or paper: as the paper describes it.")
]
RowName = Annotated[
    str,
    typer.Option("--variant", help="default, paper, paper-one-pose, paper-no-metric, rf or cnn."),
]
JsonFile = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Write the numbers into this file.")
]


def tell_numbers(result: dict[str, Any], json_file: Path | None) -> None:
    """The numbers as a table on the screen, and as JSON where a file was named."""
    if json_file is not None:
        keep_numbers(result, json_file)
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False)
    for name, value in result.items():
        said = to_json(value) if isinstance(value, dict) else str(value)
        table.add_row(name, Text(f"{value:.4g}" if isinstance(value, float) else said))
    Console().print(table)


def keep_numbers(result: dict[str, Any], json_file: Path) -> None:
    """Write the numbers as JSON."""
    json_file.parent.mkdir(parents=True, exist_ok=True)
    json_file.write_text(to_json(result) + "\n", encoding="utf-8")


def to_json(result: Any) -> str:
    """Plain values as indented JSON."""
    from liex_lab.evaluation.pose import plain

    return json.dumps(plain(result), indent=2, allow_nan=False, ensure_ascii=False)
