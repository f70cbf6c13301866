"""The program as its users start it, and how it ended."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from tests.campaign.runs import SAMPLE
from tests.runtime.test_signals import heeding

_LONGEST_S = 120.0
_DYING_S = 10.0
ENDED = (0, 4)  # exit codes of a command that did what it was asked to


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Attributes:
        code: its exit code.
        said: everything that it printed.
        seconds: how long it took.
        hung: it had to be killed; `said` then ends with where its threads were.
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
    before: str = "",
) -> subprocess.Popen[str]:
    """`liex` with these arguments, heeding signals, its output and its errors in one.

    Args:
        *arguments: of the command line.
        environment: variables besides those of this process.
        out: where its output goes.
        before: words of the shell that it is started after, such as a limit.
    """
    shell = ["sh", "-c", f'{before} exec "$@"', "sh"] if before else []
    return subprocess.Popen(
        [*shell, sys.executable, "-m", "liex_lab", *map(str, arguments)],
        stdout=out,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        env={**os.environ, "PYTHONFAULTHANDLER": "1", **(environment or {})},
        preexec_fn=heeding,
    )


def run(*arguments: str | Path, longest_s: float = _LONGEST_S, before: str = "") -> Ended:
    """A command to its end.

    Args:
        *arguments: of the command line.
        longest_s: it is killed after so long.
        before: see `started`.
    """
    began = time.monotonic()
    with started(*arguments, before=before) as process:
        try:
            said, _ = process.communicate(timeout=longest_s)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGABRT)  # where its threads are, by Python's fault handler
            try:
                said, _ = process.communicate(timeout=_DYING_S)
            except subprocess.TimeoutExpired:
                process.kill()
                said, _ = process.communicate()
            return Ended(process.returncode, said, time.monotonic() - began, True)
    return Ended(process.returncode, said, time.monotonic() - began)


def measured(out: Path) -> tuple[Path, float]:
    """The bundled sample's session, measured without any disturbance, and how long that took, s.

    Args:
        out: the folder that the session is made in.
    """
    ended = run("run", SAMPLE, "--out", out)
    assert ended.code in ENDED, ended.said
    return next(out.glob("*.liex")), ended.seconds
