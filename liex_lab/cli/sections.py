"""`--help` of a group of verbs: plain text, in sections, in the order in which people need them.

Typer draws its boxes with Rich, whose import takes longer than everything else that `liex --help`
does; the plain text of click is there at once and reads as well.
"""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

# the order in which `liex --help` shows them; a verb names its own with `rich_help_panel`
START = "Start here"
SESSIONS = "One session"
STUDIES = "Many sessions"
RECORDINGS = "Recordings"
MODELS = "Models and accuracy"
_ORDER = (START, SESSIONS, STUDIES, RECORDINGS, MODELS)
# within its section a verb stands where people need it; one that is not named here stands last
_OF_WORK = (
    *("demo", "doctor", "run", "show"),
    *("report", "figures", "correct", "describe", "suggest", "export", "verify"),
    *("cohort", "compare", "dashboard"),
    *("convert", "pack", "live"),
    *("info", "train", "evaluate"),
)


class SectionedGroup(TyperGroup):
    """Verbs under the headings that they name; verbs without one stand last."""

    def list_commands(self, ctx: Any) -> list[str]:
        """The verbs' names in the order of work.

        Args:
            ctx: click's context of the command line.
        """
        names = super().list_commands(ctx)
        return sorted(names, key=lambda name: _OF_WORK.index(name) if name in _OF_WORK else 99)

    # the types are click's, or those of the copy of click that newer Typers carry
    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each section's verbs with the first sentence of their help.

        Args:
            ctx: click's context of the command line.
            formatter: click's formatter, which takes the text.
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
            row = (name, command.get_short_help_str(2 * width))
            sections.setdefault(section, []).append(row)
        for section, rows in sections.items():
            if rows:
                with formatter.section(section):
                    formatter.write_dl(rows, col_max=12)


def group_of_verbs(help: str, name: str | None = None) -> typer.Typer:
    """A `typer.Typer` whose help is plain text in sections.

    Args:
        help: what the group is for, one sentence.
        name: of the program; sub-groups are named where they are added.
    """
    return typer.Typer(
        name=name,
        help=help,
        cls=SectionedGroup,
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
