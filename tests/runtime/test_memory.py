"""Arrays on disk: they hold what arrays hold, take no memory once let go of, and a full disk is
told beforehand.
"""

import errno
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from liex_lab.behaviour.kinematics import neighbours
from liex_lab.catalog import find_sample
from liex_lab.errors import LiexError, RecordingError
from liex_lab.recordings.formats.messages import messages
from liex_lab.recordings.timestamps import frames_apart, median_step
from liex_lab.runtime import memory
from liex_lab.runtime.memory import (
    blocks,
    check_limits,
    in_windows,
    mapped,
    on_disk,
    release_memory,
    why_short,
)
from liex_lab.sessions.folder import describe_failure

_MB = 1 << 20


def resident_mb() -> float:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / _MB


def test_what_is_written_stays_when_its_memory_is_let_go_of_and_no_file_is_left(tmp_path):
    array = on_disk(tmp_path)((1000, 3), np.float64)
    part = array[10:20]
    part[:] = np.arange(30.0).reshape(10, 3)
    release_memory()
    for _ in blocks(3, 1):
        part[0] += 100.0
    part[0] -= 300.0
    np.testing.assert_array_equal(array[10:20].ravel(), np.arange(30.0))
    assert not array[:10].any()
    assert list(tmp_path.iterdir()) == []
    assert on_disk(tmp_path)((0, 3), np.int64).shape == (0, 3)


@pytest.mark.skipif(sys.platform != "linux", reason="only there the system tells and takes back")
def test_going_through_rows_in_blocks_holds_no_more_than_a_block_of_what_lies_on_disk(tmp_path):
    n, size = 4 * _MB, _MB
    (tmp_path / "numbers").write_bytes(np.arange(n, dtype=np.int64).tobytes())
    numbers = mapped(tmp_path / "numbers", np.dtype(np.int64))
    before = resident_mb()
    doubled = on_disk(tmp_path)((n,), np.int64)
    for rows in blocks(n, size):
        doubled[rows] = 2 * numbers[rows]
        assert resident_mb() - before < 40  # three blocks of 8 MB, of 64 MB in all
    assert resident_mb() - before < 8
    assert (doubled[::1000] == 2 * np.arange(0, n, 1000)).all()


@pytest.mark.parametrize("n", [0, 1, 63, 64, 65, 200])
def test_rows_made_in_windows_are_those_of_the_whole(n, tmp_path, monkeypatch):
    values = np.random.default_rng(n).normal(size=(n, 2))

    def around(at: slice) -> np.ndarray:
        return (
            np.lib.stride_tricks.sliding_window_view(
                np.pad(values[at], ((3, 3), (0, 0)), mode="edge"), 7, axis=0
            ).max(axis=-1)
            if at.stop > at.start
            else values[at]
        )

    whole = around(slice(0, n))
    monkeypatch.setattr(memory, "_WINDOW", 64)
    np.testing.assert_array_equal(in_windows(n, 3, around, on_disk(tmp_path)), whole)


def test_a_clock_and_its_neighbours_do_not_depend_on_the_size_of_windows(monkeypatch):
    rng = np.random.default_rng(1)
    steps = rng.choice([1, 1, 1, 1, 2, 40], 3000)
    exact = 33_366_700 * np.cumsum(steps)
    clocks = [
        exact,
        exact + rng.normal(0.0, 1e6, 3000).astype(np.int64),
        (np.round(exact / 1e6) * 1e6).astype(np.int64),
    ]
    observed = rng.random(3000) > 0.05

    def found() -> list[np.ndarray]:
        return [
            result
            for times in clocks
            for result in (
                frames_apart(times, median_step(times)),
                *neighbours(times * 1e-9, observed, 0.1),
            )
        ]

    whole = found()
    monkeypatch.setattr(memory, "_WINDOW", 64)
    for one, other in zip(whole, found(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_disk_without_room_is_told_before_any_of_it_is_taken(tmp_path, monkeypatch):
    free = shutil.disk_usage(tmp_path).free
    monkeypatch.setattr(
        "tempfile.TemporaryFile", lambda **how: pytest.fail("it was tried all the same")
    )
    with pytest.raises(OSError, match="No space left"):
        on_disk(tmp_path)((2 * free,), np.uint8)


def test_where_files_cannot_be_mapped_arrays_are_in_memory_and_a_full_disk_is_told(
    tmp_path, monkeypatch
):
    def refuse(number):
        def memmap(*what, **how):
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr("numpy.memmap", memmap)

    refuse(errno.ENODEV)
    assert on_disk(tmp_path)((5, 2), np.float64).shape == (5, 2)
    refuse(errno.ENOSPC)
    with pytest.raises(OSError, match="No space left"):
        on_disk(tmp_path)((5, 2), np.float64)


# Where the system gives no more memory, threads or files, that is said, and not that we are at
# fault or a recording damaged.


SAMPLE = find_sample("mouse_walk.mcap")


_CAUSED = RuntimeError("a kernel failed")
_CAUSED.__cause__ = MemoryError()


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (MemoryError(), "memory"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "memory"),
        (ImportError("libavcodec.so.62: failed to map segment from shared object"), "memory"),
        (RuntimeError("can't start new thread"), "memory"),
        (np.exceptions.AxisError("not enough memory"), "memory"),
        (_CAUSED, "memory"),
        (OSError(errno.EMFILE, "Too many open files", "x"), "ulimit -n"),
        (None, ""),
        (ValueError("x"), ""),
        (LiexError("out of memory cards"), ""),
    ],
    ids=lambda error: type(error).__name__,
)
def test_what_the_system_has_run_out_of_is_known(error: Exception | None, says: str) -> None:
    why = why_short(error)
    assert says in why
    assert bool(says) == bool(why)
    if "memory" in why:
        assert error is not None
        told = describe_failure(error, "measuring", None)
        assert told["reason"] == "the memory was not enough"
        assert "traceback" not in told


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


@pytest.mark.nightly
@pytest.mark.parametrize("limit", ["-n 24", "-v 2000000"])
def test_a_run_within_a_narrow_limit_ends_in_a_sentence(limit: str, tmp_path: Path) -> None:
    command = f'ulimit {limit} && "{sys.executable}" -m liex_lab run "{SAMPLE}" --out "{tmp_path}"'
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    assert "ulimit" in done.stderr.splitlines()[-1]
