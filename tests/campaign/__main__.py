"""The fault campaign, run by hand: python -m tests.campaign kills|workers|faults|broken|fuzz
(figures in docs/evidence.md).

What it does at random moments it does from a seed, but for the moments themselves, which the
machine's load decides.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path


def main() -> None:
    """The campaign's part that was asked for; prints its figures as JSON."""
    from tests.campaign import faults, fuzz, kills, studies

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", choices=["kills", "workers", "faults", "broken", "fuzz"])
    parser.add_argument(
        "--n", type=int, help="kills: 50, workers: 20, faults of each kind: 3, sessions: 100"
    )
    parser.add_argument(
        "--frames", type=int, help="of a recording: 900, of a session of a hundred: 30"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60.0, help="fuzz: of one core's work")
    parser.add_argument(
        "--folder", type=Path, help="of the hundred sessions: given again, it goes on there"
    )
    asked = parser.parse_args()
    figures = {
        "kills": lambda: kills.kills(asked.n or 50, asked.frames or 900, asked.seed),
        "workers": lambda: studies.workers(asked.n or 20, asked.seed),
        "faults": lambda: faults.faults(asked.n or 3, asked.frames or 300, asked.seed),
        "broken": lambda: studies.broken(asked.n or 100, asked.frames or 30, 2, asked.folder),
        "fuzz": lambda: fuzz.fuzz(asked.minutes, asked.seed),
    }[asked.part]()
    print(json.dumps(figures, indent=2))


if __name__ == "__main__":
    main()
