"""A session that the disk has by far no room for is refused before its first frame."""

import shutil
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest

from liex_lab.errors import SessionError
from liex_lab.sessions.cutouts import needed_bytes
from liex_lab.sessions.folder import check_room, megabytes, part_folder

Usage = namedtuple("Usage", "total used free")
RNG = np.random.default_rng(3)
NOISY = [RNG.normal(700.0, 3.0, (120, 160)).astype(np.uint16) for _ in range(2)]
FLAT = [np.full((120, 160), 700, np.uint16)] * 2


def free(monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**12, 10**12 - size, size))


def test_more_of_the_depth_takes_more_room_and_noise_packs_badly() -> None:
    kinds = ("none", "animal", "arena", "all")
    sizes = [needed_bytes(NOISY, 1000, 5, 30.0, kept) for kept in kinds]
    assert sizes[0] < sizes[1] < sizes[3] < sizes[2]
    assert needed_bytes(FLAT, 1000, 5, 30.0, "all") < 0.2 * sizes[3]


def test_every_frame_takes_as_much_as_every_other_one() -> None:
    ten, thousand, both = (
        needed_bytes(NOISY, n, 5, 30.0) for n in (10, 1000, 1010)
    )  # and what is there once
    once = needed_bytes(NOISY, 0, 5, 30.0)
    assert both - once == (ten - once) + (thousand - once)


def test_a_full_disk_is_told_before_the_work_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free(monkeypatch, 40_000_000)
    with pytest.raises(SessionError) as told:
        check_room(tmp_path / "new" / "walk.liex", 100_000_000)
    assert "takes about 100.0 MB" in str(told.value)
    assert f"the disk that holds {tmp_path} has 40.0 MB free" in str(told.value)
    assert "--set replay.depth=" in str(told.value)
    assert not (tmp_path / "new").exists()


def test_an_estimate_and_the_bytes_of_an_interrupted_run_count_as_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = tmp_path / "walk.liex"
    free(monkeypatch, 60_000_000)
    check_room(place, 100_000_000)
    free(monkeypatch, 100_000)
    part_folder(place).mkdir()
    (part_folder(place) / "session.mcap").write_bytes(bytes(900_000))
    check_room(place, 1_000_000)
    (part_folder(place) / "session.mcap").write_bytes(bytes(100_000))
    with pytest.raises(SessionError, match=r"takes about 0\.9 MB"):
        check_room(place, 1_000_000)


def test_sizes_are_written_as_people_read_them() -> None:
    assert [megabytes(size) for size in (2_100_000, 3.25e9)] == ["2.1 MB", "3.2 GB"]
