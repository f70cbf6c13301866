"""Runs that the system gives little: memory, open files, places to write."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.campaign.commands import ENDED, measured, run
from tests.campaign.runs import SAMPLE, tables_of
from tests.campaign.small_disks import in_memory, read_only
from tests.campaign.tally import Tally

_LATE_S = 10.0
_GB = (0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.4, 4.6, 5.0, 6.0)
_FILES = (16, 20, 24, 28, 32, 40, 48, 64)
_NO_KERNELS = "a folder for kernels that takes none"  # they are compiled anew, which takes a while
_READ_ONLY = "a disk that may only be read"
_FULL_TMPDIR = "a TMPDIR on a full disk"
_NOWHERE = Path("/proc/1/none")
_BEFORE = {
    **{f"{gb:g} GB of addresses": f"ulimit -v {int(gb * 2**20)};" for gb in _GB},
    **{f"{n} open files": f"ulimit -n {n};" for n in _FILES},
    "no HOME": "unset HOME;",
    "no TMPDIR": "export TMPDIR=/nowhere;",
    _NO_KERNELS: f"export NUMBA_CACHE_DIR={_NOWHERE};",
    _READ_ONLY: "",
    _FULL_TMPDIR: "",
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
        with _disk_for(kind, scratch / f"disk{k}") as disk:
            if kind == _READ_ONLY:
                asked = disk / "out"
            elif kind == _FULL_TMPDIR:
                before = f"export TMPDIR={disk};"
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


@contextmanager
def _disk_for(kind: str, place: Path) -> Iterator[Path]:
    """The small disk that a limit is about; nothing is mounted for the other ones."""
    if kind not in (_READ_ONLY, _FULL_TMPDIR):
        yield place
        return
    with in_memory(place, 1) as disk:
        if disk is None:  # only root mounts one; a disk without any room is not there either
            yield _NOWHERE
            return
        if kind == _READ_ONLY:
            read_only(disk)
        else:
            (disk / "full").write_bytes(bytes(1 << 20))
        yield disk
