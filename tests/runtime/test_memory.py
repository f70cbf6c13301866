"""Arrays on disk: they hold what arrays hold, take no memory once let go of, and a full disk is
told beforehand.
"""

from __future__ import annotations

import errno
import gc
import os
import shutil
import sys

import numpy as np
import pytest

from liex_lab.body.skeleton import Skeleton
from liex_lab.runtime.memory import blocks, mapped, on_disk, rest, uncollected
from liex_lab.tracking.track import Track

_MB = 1 << 20


def resident_mb() -> float:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / _MB


def test_what_is_written_stays_when_its_memory_is_let_go_of_and_no_file_is_left(tmp_path):
    array = on_disk(tmp_path)((1000, 3), np.float64)
    part = array[10:20]
    part[:] = np.arange(30.0).reshape(10, 3)
    rest()
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


@pytest.mark.skipif(sys.platform != "linux", reason="only there the system tells and takes back")
def test_a_track_on_disk_takes_no_memory_when_it_rests(tmp_path):
    mouse, n = Skeleton.load("mouse"), 400_000  # many times what else comes and goes meanwhile
    before = resident_mb()
    track = Track.empty(mouse, np.arange(n, dtype=np.int64), allocate=on_disk(tmp_path))
    track.joints_mm[:] = 1.0
    assert resident_mb() - before > 10
    rest()
    assert resident_mb() - before < 5
    assert track.posed.all()
    assert np.isnan(track.uv_px).all()


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


def test_garbage_is_collected_again_after_a_block_without() -> None:
    assert gc.isenabled()
    with uncollected():
        assert not gc.isenabled()
        with uncollected():
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()
