"""A drive that cannot be read, a clock that jumps, two runs on one folder at once."""

import random
import shutil
import tempfile
from pathlib import Path
from typing import Any

from tests.campaign.runs import begin, refusal, tables_of, undisturbed


def faults(n: int, n_frames: int, seed: int) -> dict[str, Any]:
    """Each fault n times; what was refused, and with which sentences, and whether the tables were
    equal in the end.
    """
    rng, scratch = random.Random(seed), Path(tempfile.mkdtemp(prefix="liex-faults-"))
    _, expected = undisturbed(scratch, n_frames)
    found: dict[str, Any] = {}

    def ended(out: Path) -> bool:
        """Run until it is whole; whether its tables are those of an undisturbed run."""
        process = begin(out, n_frames)
        process.join()
        places = list(out.glob("*.liex"))
        return process.exitcode == 0 and len(places) == 1 and tables_of(places[0]) == expected

    def broken(name: str, out: Path, **how: Any) -> None:
        process = begin(out, n_frames, **how)
        process.join()
        count(
            name, refused=int(process.exitcode == 1), taken_for_whole=len(list(out.glob("*.liex")))
        )
        sentences.add(_plain(refusal(out), scratch))

    def count(name: str, **more: int) -> None:
        figures = found.setdefault(name, {})
        for key, value in more.items():
            figures[key] = figures.get(key, 0) + value

    for k in range(n):
        sentences: set[str] = set()
        broken("read error", scratch / f"read{k}", broken_at=rng.randrange(n_frames))
        count("read error", equal_afterwards=int(ended(scratch / f"read{k}")))
        found["read error"].setdefault("said", sorted(sentences))
        process = begin(scratch / f"clock{k}", n_frames, jumping=True)
        process.join()
        places = list((scratch / f"clock{k}").glob("*.liex"))
        count(
            "clock jumps",
            finished=len(places),
            equal_tables=sum(tables_of(one) == expected for one in places),
        )
        figures, said = _two_at_once(scratch / f"two{k}", n_frames, expected)
        count("two at once", **figures)
        found["two at once"].setdefault("said", _plain(said, scratch))
    shutil.rmtree(scratch)
    return {"times_each": n, **found}


def _two_at_once(
    out: Path, n_frames: int, expected: dict[str, bytes]
) -> tuple[dict[str, int], str]:
    """Two runs into one folder: one is refused, the other one's tables are equal."""
    both = [begin(out, n_frames) for _ in range(2)]
    for process in both:
        process.join()
    places = list(out.glob("*.liex"))
    return {
        "one_refused": int(sorted(process.exitcode or 0 for process in both) == [0, 1]),
        "equal_tables": int(len(places) == 1 and tables_of(places[0]) == expected),
    }, refusal(out)


def _plain(said: str, scratch: Path) -> str:
    return said.replace(str(scratch), "...")
