"""Runs that the system gives little: memory, open files, places to write."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.campaign.commands import ENDED, Ended, run
from tests.campaign.runs import SAMPLE, tables_of
from tests.campaign.tally import Tally

_LATE_S = 10.0
_GB = (0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.4, 4.6, 5.0, 6.0)
_FILES = (16, 20, 24, 28, 32, 40, 48, 64)
_PLACES = {
    "no HOME": "unset HOME;",
    "no TMPDIR": "export TMPDIR=/nowhere;",
    "a folder for kernels that takes none": "export NUMBA_CACHE_DIR=/proc/1/none;",
    "a file in place of the folder": "OUT=$OUT/file; : > $OUT;",
    "a folder that is not there and may not be made": "OUT=/proc/1/none;",
}


def limits() -> Tally:
    """Runs under each limit: they end as usual, or soon and in a sentence, and without the limit
    the same command goes on to the same tables.
    """
    tally = Tally()
    scratch = Path(tempfile.mkdtemp(prefix="liex-limits-"))
    usual = run("run", SAMPLE, "--out", scratch / "alone")
    assert usual.code in ENDED, usual.said
    expected = tables_of(next((scratch / "alone").glob("*.liex")))
    prefixes = {
        **{f"{gb:g} GB of addresses": f"ulimit -v {int(gb * 2**20)};" for gb in _GB},
        **{f"{n} open files": f"ulimit -n {n};" for n in _FILES},
        **_PLACES,
    }
    for k, (kind, prefix) in enumerate(prefixes.items()):
        out = scratch / f"out{k}"
        out.mkdir()
        ended = _limited(prefix, out)
        wrong = lost = ""
        compiles = "NUMBA_CACHE_DIR" in prefix
        if ended.hung or (ended.seconds > usual.seconds + _LATE_S and not compiles):
            wrong = f"it took {ended.seconds:.0f} s, usually {usual.seconds:.0f}"
        elif ended.code not in ENDED and "liex:" not in ended.said:
            wrong = f"exit code {ended.code} without a sentence"
        again = run("run", SAMPLE, "--out", out, "--overwrite")
        if again.code not in ENDED or tables_of(out / f"{SAMPLE.stem}.liex") != expected:
            lost = f"without the limit it ends with {again.code}: {again.said[-600:]}"
        seconds = 0.0 if compiles else max(ended.seconds - usual.seconds, 0.0)
        tally.fault(
            kind, seconds, lost=lost, wrong=wrong, traceback=ended.traceback, said=ended.said
        )
    shutil.rmtree(scratch)
    return tally


def _limited(prefix: str, out: Path) -> Ended:
    """A run after these words of the shell."""
    begin = f"OUT={shlex.quote(str(out))}; {prefix} exec {shlex.quote(sys.executable)}"
    command = f'{begin} -m liex_lab run {shlex.quote(str(SAMPLE))} --out "$OUT"'
    began = time.monotonic()
    try:
        done = subprocess.run(
            ["sh", "-c", command],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            timeout=240,
            check=False,
            env=dict(os.environ),
        )
    except subprocess.TimeoutExpired as late:
        said = late.stdout.decode(errors="replace") if isinstance(late.stdout, bytes) else ""
        return Ended(-9, said, time.monotonic() - began, True)
    return Ended(done.returncode, done.stdout, time.monotonic() - began)
