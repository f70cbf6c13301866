"""The fault campaigns: python -m tests.campaign all --json FILE (figures in docs/evidence.md).

What a campaign does at random moments it does from a seed, but for the moments themselves, which
the machine's load decides. `all` runs those that count alike (tried, survived, lost, wrong,
tracebacks, slowest_s) one after the other and writes the file after each; with --share only a part
of each, for a night.
"""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.campaign.tally import Tally

# faults of a whole campaign
SIZES = {
    "names": 0,  # all names against all writers
    "limits": 0,  # each once
    "odd": 0,
    "damaged": 10_000,
    "signals": 50,
    "disks": 100,
    "power": 20,
    "kills": 200,
    "workers": 20,
    "slurm": 20,
}
OTHERS = ("faults", "broken", "fuzz", "day", "day-end")


def main() -> None:
    """The campaigns that were asked for; prints their figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=["all", *SIZES, *OTHERS])
    parser.add_argument("--n", type=int, help="faults, instead of the campaign's usual number")
    parser.add_argument("--share", type=float, default=1.0, help="all: of the usual numbers")
    parser.add_argument("--frames", type=int, help="of a recording")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="where the figures are kept")
    parser.add_argument("--minutes", type=float, default=60.0, help="of one core (fuzz), or a day")
    parser.add_argument(
        "--folder",
        type=Path,
        help="of the hundred sessions, or the day: given again, it goes on there",
    )
    asked = parser.parse_args()
    parts = list(SIZES) if asked.part == "all" else [asked.part]
    figures: dict[str, Any] = {}
    for part in parts:
        figures[part] = _other(asked) if part in OTHERS else _counted(part, asked).to_dict()
        told = json.dumps(figures, indent=2)
        if asked.json:
            asked.json.write_text(told + "\n", encoding="utf-8")
        print(json.dumps({part: figures[part]}, indent=2), flush=True)
    failed = [name for name, one in figures.items() if one.get("broken") and name in SIZES]
    sys.exit(1 if failed else 0)


def _counted(part: str, asked: argparse.Namespace) -> Tally:
    """A campaign that counts as all do."""
    from tests.campaign import (
        damaged,
        disks,
        kills,
        limits,
        names,
        odd,
        power,
        signals,
        slurm,
        studies,
    )

    n = asked.n or max(1, round(SIZES[part] * asked.share))
    campaigns: dict[str, Callable[[], Tally]] = {
        "names": names.names,
        "limits": limits.limits,
        "odd": odd.odd,
        "damaged": lambda: damaged.damaged(n, asked.seed),
        "signals": lambda: signals.signals(n, asked.seed),
        "disks": lambda: disks.disks(n, asked.seed),
        "power": lambda: power.power_cuts(n, asked.seed),
        "kills": lambda: kills.kills(n, asked.frames or 300, asked.seed),
        "workers": lambda: studies.workers(n, asked.seed),
        "slurm": lambda: slurm.slurm(n, asked.seed),
    }
    return campaigns[part]()


def _other(asked: argparse.Namespace) -> dict[str, Any]:
    """A campaign with figures of its own."""
    from tests.campaign import day, faults, fuzz, studies

    others: dict[str, Callable[[], dict[str, Any]]] = {
        "faults": lambda: faults.faults(asked.n or 3, asked.frames or 300, asked.seed),
        "broken": lambda: studies.broken(asked.n or 100, asked.frames or 30, 2, asked.folder),
        "fuzz": lambda: fuzz.fuzz(asked.minutes, asked.seed),
        "day": lambda: day.day(asked.folder or Path("day"), asked.minutes, asked.seed),
        "day-end": lambda: day.day(asked.folder or Path("day"), asked.minutes, asked.seed, True),
    }
    return others[asked.part]()


if __name__ == "__main__":
    main()
