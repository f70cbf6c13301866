"""What is written through to the disk is what was given, whatever is told to let go meanwhile."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import IO

import numpy as np
import pytest

from liex_lab.runtime import places


@pytest.mark.parametrize("stretch", [1, 1000, 1 << 20])
def test_parts_are_written_in_their_order_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stretch: int
) -> None:
    monkeypatch.setattr(places, "STRETCH", stretch)
    rng = np.random.default_rng(3)
    parts = [rng.bytes(int(n)) for n in rng.integers(0, 5000, 100)]
    path = tmp_path / "written"
    with path.open("wb") as file:
        n = places.write_through((memoryview(part) for part in parts), file)
    assert path.read_bytes() == b"".join(parts)
    assert n == path.stat().st_size


def test_every_byte_but_the_last_stretches_is_given_up_once_it_is_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(places, "STRETCH", 1000)
    told: list[tuple[int, int]] = []
    monkeypatch.setattr(places, "let_go", lambda file, first, last: told.append((first, last)))
    with (tmp_path / "written").open("wb") as file:
        places.write_through([memoryview(bytes(250))] * 20, file)
    assert told == [(0, 1000), (0, 2000), (1000, 3000), (2000, 4000), (3000, 5000)]


def test_what_is_let_go_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "file"
    content = np.random.default_rng(4).bytes(1 << 20)
    path.write_bytes(content)
    with path.open("rb") as file:
        assert file.read(1000) == content[:1000]
        places.let_go(file, 0, len(content))
        assert file.read() == content[1000:]


def test_a_system_that_cannot_be_told_writes_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "STRETCH", 10)
    monkeypatch.delattr(os, "posix_fadvise", raising=False)
    out: IO[bytes] = io.BytesIO()  # has no number of its own either
    assert places.write_through([memoryview(b"abcdefgh")] * 4, out) == 32
    out.seek(0)
    assert out.read() == b"abcdefgh" * 4
