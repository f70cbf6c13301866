"""Runs that the system gives little: memory, open files, places to write."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from tests.campaign.commands import ENDED, measured, run
from tests.campaign.runs import SAMPLE, tables_of
from tests.campaign.tally import Tally

_LATE_S = 10.0
_GB = (0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.4, 4.6, 5.0, 6.0)
_FILES = (16, 20, 24, 28, 32, 40, 48, 64)
_NO_KERNELS = "a folder for kernels that takes none"  # they are compiled anew, which takes a while
_NOWHERE = Path("/proc/1/none")
_BEFORE = {
    **{f"{gb:g} GB of addresses": f"ulimit -v {int(gb * 2**20)};" for gb in _GB},
    **{f"{n} open files": f"ulimit -n {n};" for n in _FILES},
    "no HOME": "unset HOME;",
    "no TMPDIR": "export TMPDIR=/nowhere;",
    _NO_KERNELS: f"export NUMBA_CACHE_DIR={_NOWHERE};",
    "a file in place of the folder": "",
    "a folder that is not there and may not be made": "",
}


def limits() -> Tally:
    """Runs under each limit: they end as usual, or soon and in a sentence, and without the limit
    the same command goes on to the same tables.
    """
    tally = Tally()
    scratch = Path(tempfile.mkdtemp(prefix="liex-limits-"))
    alone, usual_s = measured(scratch / "alone")
    expected = tables_of(alone)
    for k, (kind, before) in enumerate(_BEFORE.items()):
        out = asked = scratch / f"out{k}"
        out.mkdir()
        if kind.startswith("a file"):
            asked = out / "file"
            asked.touch()
        elif kind.startswith("a folder that"):
            asked = _NOWHERE
        ended = run("run", SAMPLE, "--out", asked, before=before)
        late_s = 0.0 if kind == _NO_KERNELS else max(ended.seconds - usual_s, 0.0)
        wrong = lost = ""
        if ended.hung or late_s > _LATE_S:
            wrong = f"it took {ended.seconds:.0f} s, usually {usual_s:.0f}"
        elif ended.code not in ENDED and "liex:" not in ended.said:
            wrong = f"exit code {ended.code} without a sentence"
        again = run("run", SAMPLE, "--out", out, "--overwrite")
        if again.code not in ENDED or tables_of(out / alone.name) != expected:
            lost = f"without the limit it ends with {again.code}: {again.said[-600:]}"
        tally.fault(
            kind, late_s, lost=lost, wrong=wrong, traceback=ended.traceback, said=ended.said
        )
    shutil.rmtree(scratch)
    return tally
