"""The laws of all readers of small files on ever new examples; what breaks one is told, and the
hunt goes on.
"""

import functools
import inspect
import random
import re
import shutil
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from hypothesis import seed
from hypothesis.errors import FailedHealthCheck

import tests.exchange.test_label_fuzz as labels
import tests.sessions.test_damaged_sessions as sessions
from tests import test_file_fuzz
from tests.plan import test_plan_fuzz, test_study

Law = Callable[[int], int]  # a seed -> examples tried; raises what breaks it


def fuzz(minutes: float, rng_seed: int) -> dict[str, Any]:
    """Examples tried of each law in so many minutes of one core's work, and every way in which one
    was broken, with its example.
    """
    rng, tried, broken = random.Random(rng_seed), dict[str, int](), dict[str, str]()
    began, until = (
        time.monotonic(),
        time.process_time() + 60 * minutes,
    )  # on a busy machine it takes as much longer
    with (
        tempfile.TemporaryDirectory() as scratch,
        suppress(KeyboardInterrupt),
    ):  # stopped, it tells what it has
        laws = _laws(Path(scratch))
        while time.process_time() < until:
            for name, law in laws.items():
                try:
                    tried[name] = tried.get(name, 0) + law(rng.getrandbits(32))
                except FailedHealthCheck:  # a busy machine
                    continue
                except Exception as error:
                    said = "".join(traceback.format_exception(error))
                    where = re.findall(r'liex_lab/[^"]*", line \d+', said)[-1:]
                    key = f"{name}: {type(error).__name__} {where}"
                    if key not in broken:
                        print(key, said[-3000:], file=sys.stderr, flush=True)
                    broken.setdefault(key, said[-3000:])
    return {
        "core_minutes": time.process_time() / 60,
        "minutes": (time.monotonic() - began) / 60,
        "examples": sum(tried.values()),
        "examples_of_each": tried,
        "broken": broken,
    }


def _laws(scratch: Path) -> dict[str, Law]:
    """Each law by its name."""
    whole = sessions.write(scratch / "a.liex", sessions.WalkingMouse(sessions.steady(1.0))).path
    sessions.add_evidence(whole)
    known = {
        "whole": whole,
        "copy": Path(shutil.copytree(whole, scratch / "b.liex")),
        "part": sessions.begun(scratch / "begun"),
    }
    found: dict[str, Law] = {}
    for module in (test_study, test_plan_fuzz, test_file_fuzz, labels, sessions):
        for name, law in vars(module).items():
            if name.startswith("test_") and hasattr(law, "is_hypothesis_test"):
                wanted = inspect.signature(law).parameters
                found[name] = _law(law, {key: path for key, path in known.items() if key in wanted})
    return found


def _law(test: Any, given: dict[str, Path]) -> Law:
    """A hypothesis test as a law that counts."""
    inner, n = test.hypothesis.inner_test, 0

    @functools.wraps(inner)
    def counted(*args: Any, **kwargs: Any) -> None:
        nonlocal n
        n += 1
        inner(*args, **kwargs)

    test.hypothesis.inner_test = counted

    def law(rng_seed: int) -> int:
        before = n
        seed(rng_seed)(test)(**given)
        return n - before

    return law
