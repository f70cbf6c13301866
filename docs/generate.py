"""The parts of the manual that the program itself writes: `python docs/generate.py`.

What stands between `<!-- generated: NAME -->` and `<!-- end of generated -->` in a page comes from
the program: the command line from its parser, columns from their descriptions, settings from the
plan's classes, scores from the models' cards, functions from their docstrings. A test fails where a
page is out of date.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import sys
import textwrap
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import typer

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))  # the program in the clone whose pages these are
_PART = re.compile(r"(<!-- generated: ([\w-]+) -->\n).*?(<!-- end of generated -->)", re.DOTALL)

# The Python interface in the order of the page: modules with their public functions and classes
# ("classes" for these alone), and functions and classes with some of their members ("*": all).
PYTHON: dict[str, dict[str, str]] = {
    "Jobs": {"liex_lab.api": "*"},
    "Recordings": {
        "liex_lab.recordings.open_recording": "",
        "liex_lab.recordings.Recording": "frame chunks rate_hz duration_s gaps faults close",
        "liex_lab.recordings.DepthFrame": "",
    },
    "Sessions": {
        "liex_lab.Session": "*",
        "liex_lab.sessions.correcting": "*",
        "liex_lab.exchange.export": "",
    },
    "Plans and studies": {
        "liex_lab.Plan": "load from_toml with_settings to_toml",
        "liex_lab.plan.study.Study": "load sessions results",
    },
    "Bodies, cameras, transforms": {
        "liex_lab.Skeleton": "load n_joints dof edges length",
        "liex_lab.Camera": "project",
        "liex_lab.SE3": "*",
    },
    "The method by itself": {"liex_lab.PoseEstimator": "load skeleton estimate"},
    "Groups": {
        "liex_lab.behaviour.cohort.collect": "",
        "liex_lab.behaviour.cohort.compare": "",
    },
    "Errors": {"liex_lab.errors": "classes"},
}
# the columns that are used most
FIRST_COLUMNS = (
    "frames.frame_index",
    "frames.time_s",
    "frames.gap_before",
    "frames.pulse_index",
    "frames.predicted_error_mm",
    "frames.residual_mm",
    "frames.flag",
    "frames.bridged",
    "frames.p_flip",
    "frames.centroid_x_mm",
    "frames.wall_distance_mm",
    "frames.zone",
    "poses.joint",
    "poses.x_mm",
    "poses.z_mm",
    "poses.u_px",
    "poses.sd_mm",
    "poses.sd_xy_mm",
    "poses.sd_z_mm",
    "kinematics.speed_mm_s",
    "kinematics.speed_sd_mm_s",
    "kinematics.acceleration_mm_s2",
    "kinematics.heading_rad",
    "kinematics.yaw_rate_rad_s",
    "kinematics.body_pitch_rad",
    "kinematics.length_mm",
    "kinematics.bend_rad",
    "kinematics.nose_height_mm",
    "kinematics.tail_beat_hz",
    "kinematics.tail_beat_mm",
    "bouts.action",
    "bouts.start_s",
    "bouts.stop_s",
    "bouts.duration_s",
    "bouts.path_mm",
    "bouts.peak_speed_mm_s",
    "bouts.net_turn_rad",
    "bouts.since_last_s",
    "summary.observed_s",
    "summary.distance_m",
    "summary.mean_speed_mm_s",
    "summary.speed_noise_mm_s",
    "summary.outer_half_share",
    "summary.rear_count",
    "summary.rear_share",
    "summary.rear_latency_s",
    "transitions.n",
    "transitions.by_chance",
    "transitions.p_fdr",
    "zones.n_visits",
    "activity.distance_mm",
)
MODULES = ("liex_lab.api", "liex_lab.sessions.correcting", "liex_lab.errors")


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _prose(text: str | None) -> str:
    parts = re.split(r"(`[^`]*`)", text or "")  # in code nothing is escaped
    parts[::2] = [part.replace("<", "\\<").replace("[", "\\[") for part in parts[::2]]
    return "".join(parts)


def _leaves(name: str, command: Any, depth: int = 0) -> Iterator[tuple[str, Any, int]]:
    """Every verb with the words that call it; those of a group after the group."""
    yield name, command, depth
    if hasattr(command, "list_commands"):
        context = command.context_class(command, info_name=name)
        for inner in command.list_commands(context):
            found = command.get_command(context, inner)
            if not found.hidden:
                yield from _leaves(f"{name} {inner}", found, depth + 1)


def cameras() -> str:
    """Every depth mode of the cameras by name, with the source of its figures."""
    from liex_lab.optics.camera import DEPTH_MODES

    lines = [
        "| name | mode | image, px | focal length, px | range, m | frames/s | unit, mm | source |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, mode, camera, reach, rates, unit in DEPTH_MODES:
        far = "" if reach is None else f"{reach[0] / 1e3:g} to {reach[1] / 1e3:g}"
        hertz = ", ".join(map(str, rates))
        lines.append(
            f"| `{name}` | {mode} | {camera.width} x {camera.height} | {camera.fx:g} | {far} | "
            f"{hertz} | {unit:g} | {camera.source} |"
        )
    return "\n".join(lines)


def command_line() -> str:
    """Every verb of `liex` with its usage and options."""
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
            lines += ["| option | meaning |", "|---|---|", *rows, ""]
    return "\n".join(lines)


def _option(one: Any, context: Any) -> str:
    name, meaning = one.get_help_record(context) or (one.name, "")
    return f"| `{_cell(name)}` | {_cell(_prose(meaning))} |"


def every_column() -> str:
    """Every column of every table, a section a table."""
    from liex_lab.tables.schema import all_columns

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


def first_columns() -> str:
    """The columns that are used most."""
    from liex_lab.tables.schema import all_columns

    known = all_columns()
    lines = ["| column | unit | meaning |", "|---|---|---|"]
    for name in FIRST_COLUMNS:
        column = known[name]
        formula = f" ({column.formula})" if column.formula and len(column.formula) < 60 else ""
        text = f"{column.meaning}{formula}".replace("|", "\\|")
        lines.append(f"| {column.table} `{column.name}` | {column.unit} | {text} |")
    return "\n".join(lines) + "\n"


def settings() -> str:
    """Every setting of a plan with its default, a section a table."""
    from pydantic import BaseModel

    from liex_lab.plan import Plan

    lines: list[str] = []
    for table, field in Plan.model_fields.items():
        inner = field.annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            continue
        lines += [f"### [{table}]", "", "| setting | default | meaning |", "|---|---|---|"]
        for key, one in inner.model_fields.items():
            default = "" if one.default is None else f"`{json.dumps(one.default)}`"
            lines.append(f"| `{table}.{key}` | {default} | {_cell(one.description or '')} |")
        lines.append("")
    return "\n".join(lines)


def exports() -> str:
    """Every format that `liex export` writes."""
    from liex_lab.exchange import TARGETS

    rows = [f"| `{word}` | {_cell(written)} |" for word, (_, _, written) in TARGETS.items()]
    return "\n".join(["| `--to` | what is written |", "|---|---|", *rows, ""])


def scores() -> str:
    """The scores on the models' cards, measured when the bundled models were made."""
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
    """The words that actions are named by, with their definitions."""
    from liex_lab.actions.vocabulary import WORDS

    lines = []
    for animal, words in sorted(WORDS.items()):
        lines += [f"## {animal.capitalize()}", "", "| action | definition |", "|---|---|"]
        lines += [f"| `{word}` | {_cell(one.printed)} |" for word, one in words.items()]
        lines.append("")
    return "\n".join(lines)


def interactions() -> str:
    """The words for what one animal does to another, with the default limits."""
    from liex_lab.actions.vocabulary import INTERACTIONS
    from liex_lab.behaviour.interactions import definitions
    from liex_lab.plan.sections import InteractionThresholds

    meanings = definitions(InteractionThresholds())
    rows = [
        f"| `{word}` | {'mutual' if one.mutual else ''} | {meanings[word]} | {one.mabe} |"
        for word, one in INTERACTIONS.items()
    ]
    return "\n".join(["| word | | meaning | in MABe |", "|---|---|---|---|", *rows, ""])


def python_interface() -> str:
    """Functions and classes with their signatures and docstrings."""
    lines: list[str] = []
    for title, names in PYTHON.items():
        lines += [f"## {title}", ""]
        for path, members in names.items():
            home, _, name = path.rpartition(".")
            if path in MODULES:
                module = import_module(path)
                lines += [*_docstring(module), ""]
                for inner in getattr(module, "__all__", vars(module)):
                    one = getattr(module, inner)
                    own = hasattr(module, "__all__") or getattr(one, "__module__", "") == path
                    if own and inner[0] != "_" and (inspect.isclass(one) or members == "*"):
                        lines += _described(f"{path}.{inner}", one)
            else:
                one = getattr(import_module(home), name)
                lines += _described(path, one)
                own = [key for key in vars(one) if key[0] != "_"] if members == "*" else []
                for inner in own or members.split():
                    lines += _described(f"{name}.{inner}", inspect.getattr_static(one, inner))
    return "\n".join(lines)


def _described(path: str, one: Any) -> list[str]:
    """A heading, the signature, and the docstring; nothing of what has no docstring."""
    if not path.startswith("liex_lab."):
        heading = f"#### {path}"  # a member of the class above
    else:
        heading = f"### {path.rpartition('.')[2]}"
    if inspect.isfunction(function := getattr(one, "__func__", one)):
        call = ["```text", _signature(path, function), "```", ""]
    else:
        call = [] if heading.startswith("####") else [f"`{path}`", ""]
    text = _docstring(one)
    return [heading, "", *call, *text, ""] if text else []


def _signature(path: str, function: Any) -> str:
    node = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    assert isinstance(node, ast.FunctionDef)
    takes = re.sub(r"^(self|cls)(, |$)", "", ast.unparse(node.args))
    gives = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return textwrap.fill(
        f"{path}({takes}){gives}", 88, subsequent_indent="    ", break_on_hyphens=False
    )


def _docstring(one: Any) -> list[str]:
    """A docstring as Markdown: prose as it is, parameters and errors as lists."""
    lines: list[str] = []
    for line in (inspect.getdoc(one) or "").splitlines():
        if found := re.fullmatch(r"(Args|Attributes|Returns|Yields|Raises):", line):
            title = {"Args": "Parameters"}.get(found[1], found[1])
            lines += [f"**{title}**", ""]
        elif named := re.fullmatch(r" {4}(\*{0,2}\w+): (.*)", line):
            lines.append(f"- `{named[1]}`: {_prose(named[2])}")
        else:
            lines.append(_prose(re.sub(r"^ {4}", "", line)))
    return lines


PARTS: dict[str, Callable[[], str]] = {
    "command-line": command_line,
    "cameras": cameras,
    "every-column": every_column,
    "first-columns": first_columns,
    "settings": settings,
    "exports": exports,
    "scores": scores,
    "vocabularies": vocabularies,
    "interactions": interactions,
    "python-interface": python_interface,
}


def renewed(text: str) -> str:
    """A page's text with its generated parts as the program writes them now.

    Args:
        text: the page, Markdown.
    """
    return _PART.sub(
        lambda part: f"{part[1]}{PARTS[part[2]]().strip()}\n{part[3]}",
        text,
    )


def main() -> None:
    """Write the generated parts of every page."""
    for page in sorted(DOCS.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        if (now := renewed(text)) != text:
            page.write_text(now, encoding="utf-8")
            print(page)


if __name__ == "__main__":
    main()
