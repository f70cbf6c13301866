"""Options shared by several commands of `liex`, and the output of numbers."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import liex_lab
from liex_lab.errors import PlanError, RecordingError, printable

RecordingPath = Annotated[
    Path,
    typer.Argument(
        metavar="RECORDING", help="A file, a folder, or a virtual recording such as synthetic:walk."
    ),
]
RecordingPaths = Annotated[
    list[Path],
    typer.Argument(
        metavar="RECORDING",
        help="A file, a folder, or a virtual recording such as synthetic:walk; several files, or a "
        "pattern such as 'cam1_*.mcap', are one recording in parts.",
    ),
]
SessionPath = Annotated[
    Path, typer.Argument(metavar="SESSION", help="A session folder, NAME.liex.")
]
PlanName = Annotated[
    str, typer.Option("--plan", help="A bundled plan (see `liex info`) or a .toml file.")
]
WhichPlan = Annotated[
    str | None,
    typer.Option(
        "--plan", help="A bundled plan or a .toml file; default: the bundled plan that fits."
    ),
]
NamesFile = Annotated[
    Path | None,
    typer.Option(
        "--names", metavar="TOML", help="Which point is which joint, unit, upward axis and floor."
    ),
]
OutFolder = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Output folder, in which NAME.liex is created.")
]
TopicName = Annotated[
    str | None,
    typer.Option("--topic", help="Depth topic of an MCAP file or ROS bag with several."),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a setting of the plan; repeatable."),
]
AnimalName = Annotated[
    str, typer.Option("--animal", help="fish, mouse, hand, or a skeleton's .toml file.")
]
JsonFile = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", help="Also write the numbers to this file.")
]


def as_one(paths: Sequence[Path]) -> Path:
    """One path for several files of a recording, as opened by `liex_lab.open_recording`.

    Raises:
        RecordingError: they are in several folders.
    """
    if len(paths) == 1:
        return paths[0]
    if len({path.parent for path in paths}) > 1:
        raise RecordingError(
            "the files of one recording are expected in one folder, or as a pattern in quotes, "
            f"such as 'day1/*/cam1.mcap'; got {paths[0]} and {paths[-1]}"
        )
    return paths[0].parent / f"{{{','.join(path.name for path in paths)}}}"


def region_setting(region: str | None) -> list[str]:
    """The plan setting of a region; empty if absent.

    Args:
        region: "x,y x,y x,y", the corners of a polygon, or "circle x,y radius"; a final word mm
            means millimetres on the floor, px (the default) pixels.

    Raises:
        PlanError: it is neither.
    """
    if region is None:
        return []
    words = region.split()
    unit = words.pop() if words and words[-1] in ("px", "mm") else "px"
    try:
        if words[:1] == ["circle"]:
            _, centre, radius = words
            x, y = map(float, centre.split(","))
            shape = f"circle = {{centre = [{x}, {y}], radius = {float(radius)}}}"
            return [f'arena.region={{{shape}, unit = "{unit}"}}']
        corners = [[float(value) for value in corner.split(",")] for corner in words]
    except ValueError:
        corners = []
    if len(corners) < 3 or any(len(corner) != 2 for corner in corners):
        raise PlanError(
            "--region takes three or more corners in pixels, as in --region "
            "'60,40 260,40 260,200 60,200', or a circle, as in --region 'circle 160,120 90'; add "
            f"mm at the end to give either in millimetres on the floor; got '{region}'"
        )
    if unit == "px":
        return [f"arena.region={corners}"]
    return [f'arena.region={{polygon = {corners}, unit = "mm"}}']


def load_plan(plan: str | None, settings: Sequence[str]) -> liex_lab.Plan:
    """The named plan, or `mouse`, with settings: an error in them is raised at once."""
    return liex_lab.Plan.load(plan or "mouse").with_settings(settings)


def echo(text: object) -> None:
    """Print a line, with unprintable characters escaped."""
    typer.echo(printable(text))


def print_table(rows: Iterable[Iterable[object]], *headings: str) -> None:
    """Print a table of texts, with unprintable characters escaped."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(*headings, show_header=bool(headings))
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    Console().print(table)


def print_numbers(result: dict[str, Any], json_file: Path | None = None) -> None:
    """Print numbers as a table, and write them as JSON if a file is given."""
    if json_file is not None:
        write_numbers(result, json_file)
    shown = {k: to_json(v) if isinstance(v, dict) else v for k, v in result.items()}
    print_table((k, f"{v:.4g}" if isinstance(v, float) else v) for k, v in shown.items())


def print_rows(rows: dict[str, dict[str, Any]]) -> None:
    """Print rows of results by name as a Markdown table."""
    columns = [*dict.fromkeys(name for row in rows.values() for name in row)]
    lines = [["", *(name.replace("_", " ") for name in columns)], ["---"] * (len(columns) + 1)]
    lines += [[name, *(_cell(row.get(column)) for column in columns)] for name, row in rows.items()]
    for line in lines:
        echo(f"| {' | '.join(line)} |")


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, list):
        return "; ".join(value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def write_numbers(result: dict[str, Any], json_file: Path) -> None:
    """Write the numbers as JSON."""
    json_file.parent.mkdir(parents=True, exist_ok=True)
    json_file.write_text(to_json(result) + "\n", encoding="utf-8")


def to_json(result: Any) -> str:
    """Plain values as indented JSON."""
    from liex_lab.evaluation.scores import plain

    return json.dumps(plain(result), indent=2, allow_nan=False, ensure_ascii=False)


def print_scores(report: dict[str, Any]) -> None:
    """Print scores of recognised actions (`actions.labels.timeline_scores`).

    Args:
        report: the scores of leave-one-animal-out; empty if there are none.
    """
    if "macro_f1" not in report:
        for name, value in report.items():
            typer.echo(f"{name}: {value}")
        return
    typer.echo(
        "Each animal's actions were recognised by what the others taught: macro F1 of the frames "
        f"{report['macro_f1']:.2f}, F1 of bouts that overlap by half {report['segment_f1_50']:.2f}."
    )
    rows = [
        (word, one["bouts"], f"{one['f1']:.2f}", f"{one['precision']:.0%}", f"{one['recall']:.0%}")
        for word, one in report["per_action"].items()
        if "bouts" in one
    ]
    print_table(rows, "action", "bouts", "F1", "of what was called so, is", "of what is, found")


# `--help` of a group of commands: plain text, in sections, in the order of use.


# the order in `liex --help`; a command selects its section with `rich_help_panel`
START = "Start here"
SESSIONS = "One session"
STUDIES = "Many sessions"
RECORDINGS = "Recordings"
MODELS = "Models and accuracy"
_ORDER = (START, SESSIONS, STUDIES, RECORDINGS, MODELS)
# commands of a section in the order of use; those not listed here are last
_OF_WORK = (
    *("demo", "doctor", "run", "show"),
    *("report", "figures", "correct", "describe", "suggest", "export", "verify"),
    *("cohort", "compare", "dashboard"),
    *("record", "import", "convert", "pack", "live"),
    *("info", "train", "evaluate"),
)


class SectionedGroup(TyperGroup):
    """Commands under their headings; commands without one are last."""

    def list_commands(self, ctx: Any) -> list[str]:
        """The commands' names in the order of work.

        Args:
            ctx: click's context of the command line.
        """
        return sorted(
            super().list_commands(ctx),
            key=lambda name: _OF_WORK.index(name) if name in _OF_WORK else 99,
        )

    # the types are click's, or those of the copy of click in newer Typers
    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each section's commands with the first sentence of their help.

        Args:
            ctx: click's context of the command line.
            formatter: click's formatter, which receives the text.
        """
        sections: dict[str, list[tuple[str, str]]] = {name: [] for name in _ORDER}
        names = self.list_commands(ctx)
        width = formatter.width - 6 - max(map(len, names), default=0)
        for name in names:
            command = self.get_command(ctx, name)
            if command is None or command.hidden:
                continue
            panel = getattr(command, "rich_help_panel", None)
            section = panel if isinstance(panel, str) else "Commands"
            sections.setdefault(section, []).append((name, command.get_short_help_str(2 * width)))
        for section, rows in sections.items():
            if rows:
                with formatter.section(section):
                    formatter.write_dl(rows, col_max=12)


def command_group(help: str, name: str | None = None) -> typer.Typer:
    """A `typer.Typer` whose help is plain text in sections.

    Args:
        help: purpose of the group, one sentence.
        name: of the program; sub-groups are named when they are added.
    """
    return typer.Typer(
        name=name,
        help=help,
        cls=SectionedGroup,
        no_args_is_help=True,
        add_completion=name is not None,  # --install-completion of the program
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
