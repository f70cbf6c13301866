"""Where the system gives no more memory, threads or files, that is said, and not that we are at
fault or a recording damaged.
"""

from __future__ import annotations

import errno
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from liex_lab.catalog import find_sample
from liex_lab.errors import LiexError, RecordingError
from liex_lab.recordings.formats.messages import messages
from liex_lab.runtime.memory import check_limits, why_short
from liex_lab.sessions.folder import describe_failure

SAMPLE = find_sample("mouse_walk.mcap")


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        ImportError("libavcodec.so.62: failed to map segment from shared object"),
        RuntimeError("can't start new thread"),
        np.exceptions.AxisError("not enough memory"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_errors_of_too_little_memory_are_known(error: Exception) -> None:
    assert "memory was not enough" in why_short(error)
    told = describe_failure(error, "measuring", None)
    assert told["reason"] == "the memory was not enough"
    assert "traceback" not in told


def test_an_error_raised_from_one_of_too_little_memory_is_known() -> None:
    error = RuntimeError("a kernel failed")
    error.__cause__ = MemoryError()
    assert "memory" in why_short(error)


def test_too_many_open_files_are_known() -> None:
    assert "ulimit -n" in why_short(OSError(errno.EMFILE, "Too many open files", "x"))


@pytest.mark.parametrize("error", [None, ValueError("x"), LiexError("out of memory cards")])
def test_other_errors_are_not(error: Exception | None) -> None:
    assert not why_short(error)


def test_too_few_addresses_are_refused_before_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    check_limits()
    monkeypatch.setattr(resource, "getrlimit", lambda _: (2 << 30, -1))
    with pytest.raises(LiexError, match=r"2\.0 GB of addresses"):
        check_limits()


def test_a_chunk_that_memory_does_not_suffice_for_is_not_damaged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def short(*_: object) -> bytes:
        raise ValueError("Allocation error : not enough memory")

    monkeypatch.setattr(messages, "_inflate", short)
    from liex_lab.recordings import open_recording

    with pytest.raises((MemoryError, RecordingError)) as caught, open_recording(SAMPLE) as one:
        one.frame(0)
    assert isinstance(caught.value, MemoryError)


@pytest.mark.parametrize("limit", ["-v 2000000", "-n 24"])
def test_a_run_within_a_narrow_limit_ends_in_a_sentence(limit: str, tmp_path: Path) -> None:
    command = f'ulimit {limit} && "{sys.executable}" -m liex_lab run "{SAMPLE}" --out "{tmp_path}"'
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert "ulimit" in done.stderr.splitlines()[-1]
