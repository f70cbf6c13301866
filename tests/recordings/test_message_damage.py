"""200 damaged variants each of MCAP files and ROS bags."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType

from liex_lab.progress import silent
from liex_lab.recordings import open_recording
from liex_lab.recordings._message_file import MessageFile
from liex_lab.recordings.mcap import McapFile
from liex_lab.recordings.rosbag import BagFile, Db3File
from tests.recordings.damage import read_all, survive
from tests.recordings.ros_writers import write_bag, write_db3, write_ros_mcap
from tests.recordings.writers import depth_frames, write_camera, write_mcap

STORED = depth_frames(12)
FRAMES = [frame.astype(np.float32).tobytes() for frame in STORED]


def ends(file: MessageFile) -> list[int]:
    """Behind which byte of the file each depth picture lies: the end of its chunk, or its own."""
    found = []
    for envelope in file.walk(lambda channel: "Image" in channel.schema, silent):
        place = envelope.place
        chunk = file.chunks[place.chunk] if place.chunk >= 0 else None
        found.append(place.offset + place.length if chunk is None else chunk.offset + chunk.length)
    file.close()
    return found


MCAPS: dict[str, Callable[[Path], Path]] = {
    "zstd": lambda path: write_mcap(path, STORED),
    "unchunked": lambda path: write_mcap(path, STORED, use_chunks=False),
    "png": lambda path: write_mcap(path, STORED, encoding="png"),
    "ros 2, lz4": lambda path: write_ros_mcap(path, STORED, 2, kind="rvl", compression=CompressionType.LZ4),
    "ros 1, plain": lambda path: write_ros_mcap(path, STORED, 1, compression=CompressionType.NONE),
}


@pytest.mark.parametrize("kind", MCAPS)
def test_200_damaged_mcap_files(tmp_path: Path, kind: str) -> None:
    path = MCAPS[kind](tmp_path / "r.mcap")
    write_camera(tmp_path)
    before = ends(McapFile(path, path.open("rb")))
    n = survive(path, 40, lambda byte: sum(end <= byte for end in before), FRAMES, 40 * list(MCAPS).index(kind))
    assert n >= 20


BAGS: dict[str, Callable[[Path], Path]] = {
    "lz4": lambda path: write_bag(path, STORED),
    "bz2": lambda path: write_bag(path, STORED, compression="bz2", kind="png"),
    "plain": lambda path: write_bag(path, STORED, compression=None),
    "one chunk": lambda path: write_bag(path, STORED, compression=None, chunk_bytes=1 << 20, kind="rvl"),
}


@pytest.mark.parametrize("kind", BAGS)
def test_200_damaged_bags(tmp_path: Path, kind: str) -> None:
    path = BAGS[kind](tmp_path / "r.bag")
    write_camera(tmp_path)
    before = ends(BagFile(path, path.open("rb")))
    n = survive(path, 50, lambda byte: sum(end <= byte for end in before), FRAMES, 50 * list(BAGS).index(kind))
    assert n >= 25


def test_damaged_ros_2_bags(tmp_path: Path) -> None:
    """SQLite keeps its tables in pages of a tree, so that nothing is promised of what comes before."""
    path = next(write_db3(tmp_path / "r", STORED).glob("*.db3"))
    write_camera(path.parent)
    assert len(ends(Db3File(path, path.open("rb")))) == len(STORED)
    assert survive(path, 50, lambda byte: 0, FRAMES) >= 20


def chunk_starts(path: Path) -> list[int]:
    """Where the records of a file's chunks begin, in order."""
    file = (McapFile if path.suffix == ".mcap" else BagFile)(path, path.open("rb"))
    ends(file)
    return file.starts


@pytest.mark.parametrize("write", [write_mcap, write_bag])
@pytest.mark.parametrize("number", [0, 2, -1])
@pytest.mark.parametrize("where", ["length", "content"])
def test_a_damaged_chunk_costs_its_own_frames_only(
    tmp_path: Path, write: Callable[..., Path], number: int, where: str
) -> None:
    """Also the first one, which tells what the messages are, and one whose length is lost: the file's end tells."""
    path = write(tmp_path / ("r.mcap" if write is write_mcap else "r.bag"), STORED)
    write_camera(tmp_path)
    content = bytearray(path.read_bytes())
    starts = chunk_starts(path)
    assert len(starts) >= 4
    at = starts[number] + (0 if where == "length" else 400)
    content[at : at + 60] = b"\xff" * 60
    path.write_bytes(content)
    found, _ = read_all(path)
    assert len(STORED) - 4 <= len(found) < len(STORED)
    assert found < set(FRAMES)
    with open_recording(path) as recording:
        assert recording.truncated
