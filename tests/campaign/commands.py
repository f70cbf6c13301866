"""The program as its users start it, and how it ended."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from tests.runtime.test_signals import heeding

_LONGEST_S = 240.0
ENDED = (0, 4)  # exit codes of a command that did what it was asked to


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Attributes:
        code: its exit code.
        said: everything that it printed.
        seconds: how long it took.
        hung: it had to be killed.
    """

    code: int
    said: str
    seconds: float
    hung: bool = False

    @property
    def traceback(self) -> bool:
        """Whether it said anything but sentences to its user."""
        return self.code == 70 or "Traceback (most recent" in self.said or "panicked" in self.said


def started(
    *arguments: str | Path,
    environment: dict[str, str] | None = None,
    out: IO[str] | int = subprocess.PIPE,
) -> subprocess.Popen[str]:
    """`liex` with these arguments, heeding signals, its output and its errors in one.

    Args:
        *arguments: of the command line.
        environment: variables besides those of this process.
        out: where its output goes.
    """
    return subprocess.Popen(
        [sys.executable, "-m", "liex_lab", *map(str, arguments)],
        stdout=out,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env={**os.environ, **(environment or {})},
        preexec_fn=heeding,
    )


def run(*arguments: str | Path, longest_s: float = _LONGEST_S) -> Ended:
    """A command to its end.

    Args:
        *arguments: of the command line.
        longest_s: it is killed after so long.
    """
    began = time.monotonic()
    with started(*arguments) as process:
        try:
            said, _ = process.communicate(timeout=longest_s)
        except subprocess.TimeoutExpired:
            process.kill()
            said, _ = process.communicate()
            return Ended(process.returncode, said, time.monotonic() - began, True)
    return Ended(process.returncode, said, time.monotonic() - began)
