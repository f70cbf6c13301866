"""Kept rows taken over a change of code that changes nothing of what is learned.

A kept row is of the code whose hash it holds (`fingerprints.learning_code`). After a change that
makes training faster and nothing else all rows would be refused, and measuring them again takes
hours. So the version that made them and this one both train small models of every row, from the
same pictures and on this machine (`small_models`), and find the animal in a recording. Rows whose
models and poses are the same to the last bit are taken over: they get the hash of this version's
code, and the old one stays beside it under `same_as`.

    python -m liex_lab.pipelines.evaluation.paper.same_code PYTHON [ANIMAL ...]

PYTHON is the interpreter of an environment in which the version that made the rows is installed.
The files in `datasets/kept_results` are written anew, and what became of each row is printed.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from liex_lab.catalog import bundled_models, kept_results_folder
from liex_lab.errors import LiexError

from .cached_results import keep_results, kept_results
from .results import SAME_AS

_FILE = Path(__file__).with_name("small_models.py")
# this version's file as a module of the version that the interpreter has
_ASK = """
import importlib.util, json, sys
name, path, animal = sys.argv[1:]
spec = importlib.util.spec_from_file_location(name, path)
module = sys.modules[name] = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
print(json.dumps(module.learned(animal)))
"""
Learned = Mapping[str, Mapping[str, str]]  # see `small_models.learned`


def take_over(python: str, animals: Sequence[str], folder: Path | None = None) -> list[str]:
    """Take the kept rows of some animals over from another version of the code.

    Args:
        python: interpreter of an environment in which the version that made the rows is installed.
        animals: names of bundled animals.
        folder: where rows are kept; None takes datasets/kept_results.

    Returns:
        What became of each row, a sentence each.

    Raises:
        LiexError: the small models of one version could not be trained.
    """
    folder = folder or kept_results_folder()
    told = []
    for animal in animals:
        kept = kept_results(animal, folder)
        then, now = (learned_with(one, animal) for one in (python, sys.executable))
        for part in ("rows", "sensitivity"):
            kept[part], said = taken_over(kept[part], then, now)
            what = "" if part == "rows" else "Fig. 7, "
            told += [f"{animal}, {what}{sentence}" for sentence in said]
        keep_results(folder, animal, kept["rows"], kept["sensitivity"])
    return told


def learned_with(python: str, animal: str) -> Learned:
    """Code and outcome of each row, of the version that an interpreter has.

    Args:
        python: the interpreter.
        animal: a bundled animal's name.

    Raises:
        LiexError: there is no such interpreter, or it ended with an error.
    """
    if shutil.which(python) is None:
        raise LiexError(
            f"{python} should be the interpreter of an environment, and is no program here; name "
            "the path of its python"
        )
    ended = subprocess.run(
        # not what lies in the working folder, which may be a checkout of the other version
        [python, "-P", "-c", _ASK, f"{__package__}.{_FILE.stem}", str(_FILE), animal],
        capture_output=True,
        text=True,
        check=False,
    )
    if ended.returncode:
        why = (ended.stderr.strip().splitlines() or ["no word"])[-1]
        raise LiexError(
            f"{python} should train small models of {animal} with {_FILE.name}, but: {why}; "
            "install liex_lab in its environment"
        )
    return dict(json.loads(ended.stdout.splitlines()[-1]))


def taken_over(
    entries: Mapping[str, Any], then: Learned, now: Learned
) -> tuple[dict[str, Any], list[str]]:
    """Kept rows or curves, with the hash of today's code where they may have it.

    Args:
        entries: by row what is kept, with how it was `made`.
        then: code and outcome by row, of the version that should have made them.
        now: the same of today's.

    Returns:
        The entries, and a sentence about each.
    """
    out = {}
    told = []
    for name, entry in entries.items():
        out[name] = entry
        made = entry["made"]
        if name in now and made.get("learning_code") == now[name]["code"]:
            told.append(f"{name}: of today's code already")
        elif name not in then or name not in now:
            told.append(f"{name}: left, for it could not be trained here")
        elif made.get("learning_code") != then[name]["code"]:
            told.append(f"{name}: left, for it is not of the code it was set against")
        elif then[name]["learned"] != now[name]["learned"]:
            told.append(f"{name}: left, for today's code learns something else")
        else:
            before = [*made.get(SAME_AS, []), made["learning_code"]]
            out[name] = {
                **entry,
                "made": {**made, "learning_code": now[name]["code"], SAME_AS: before},
            }
            told.append(f"{name}: taken over, for today's code learns the same to the last bit")
    return out, told


def main(words: Sequence[str]) -> str:
    """What the command does, and what it prints in the end.

    Args:
        words: of the command line: the interpreter, and animals; none stands for all.

    Raises:
        LiexError: there is no interpreter, or an animal that is not bundled.
    """
    known = list(bundled_models())
    if not words or set(words[1:]) - set(known):
        raise LiexError(
            "expected the interpreter of an environment with the version before the change, and "
            f"then any of {', '.join(known)}; got '{' '.join(words)}'"
        )
    return "\n".join(take_over(words[0], words[1:] or known))


if __name__ == "__main__":
    try:
        print(main(sys.argv[1:]))
    except LiexError as error:
        sys.exit(str(error))
