"""MCAP files opened by their index: as if they were walked, and what is damaged is told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove.mcap import MCAPCompression
from mcap.writer import CompressionType

from liex_lab.errors import RecordingError
from liex_lab.recordings import Recording, open_recording
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.writer import McapDepthWriter
from tests.recordings.asking import refusal
from tests.recordings.ros_writers import write_ros_mcap
from tests.recordings.writers import SMALL, START_NS, cut, depth_frames, even_times, write_mcap

STORED = depth_frames(20)
ONE = 1  # bytes of a chunk: every message closes its own

Write = Callable[[Path], Any]
KINDS: dict[str, Write] = {
    "zstd": lambda path: write_mcap(path, STORED, chunk_size=ONE),
    "lz4": lambda path: write_mcap(
        path, STORED, chunk_size=ONE, compression=MCAPCompression.Lz4, log_delay_ns=7_000_000
    ),
    "none": lambda path: write_mcap(path, STORED, compression=None, log_delay_ns=7_000_000),
    "png": lambda path: write_mcap(path, STORED, encoding="png", compression=None),
    "two topics": lambda path: write_mcap(
        path, STORED, compression=None, topics=("/camera/depth", "/camera/ir")
    ),
    "out of order": lambda path: write_mcap(
        path,
        STORED,
        compression=None,
        times_ns=np.array(even_times(20))[[0, 2, 1, *range(3, 20)]].tolist(),
    ),
    "from zero": lambda path: write_mcap(
        path, STORED, compression=None, times_ns=even_times(20, start_ns=0), log_delay_ns=START_NS
    ),
    "ros 1": lambda path: write_ros_mcap(
        path, STORED, 1, compression=CompressionType.NONE, log_delay_ns=3_000_000
    ),
    "ros 2": lambda path: write_ros_mcap(path, STORED, 2, chunk_size=ONE, log_delay_ns=3_000_000),
    "ros 2, a cloud": lambda path: write_ros_mcap(
        path, STORED, 2, kind="cloud", compression=CompressionType.LZ4, chunk_size=ONE
    ),
    "ros 2, big endian": lambda path: write_ros_mcap(
        path, STORED, 2, compression=CompressionType.NONE, big_endian=True
    ),
}
WALKED: dict[str, Write] = {
    "many to a packed chunk": lambda path: write_mcap(path, STORED),
    "before 1970": lambda path: written(path, times_ns=even_times(20, start_ns=-(10**9))),
    "no chunks": lambda path: write_mcap(path, STORED, use_chunks=False),
    "no stamps": lambda path: write_mcap(
        path, STORED, stamped=False, compression=None, log_delay_ns=7_000_000
    ),
}


def written(path: Path, times_ns: list[int]) -> None:
    """By this program's own writer."""
    with McapDepthWriter(path, SMALL) as writer:
        for k, (time_ns, depth) in enumerate(zip(times_ns, STORED, strict=True)):
            writer.add(DepthFrame(k, time_ns, depth.astype(np.float32)))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "r.mcap"


def facts(recording: Recording) -> dict[str, Any]:
    """All that a recording says of itself."""
    return {
        "times": recording.times_ns.tolist(),
        "faults": recording.stamp_faults.tolist(),
        "camera": recording.camera,
        "metadata": recording.metadata,
        "depth": [frame.depth.tobytes() for frame in recording],
        "problems": recording.problems,
    }


@pytest.mark.parametrize("kind", [*KINDS, *WALKED])
def test_a_file_says_by_its_index_what_it_says_when_it_is_walked(path: Path, kind: str) -> None:
    (KINDS | WALKED)[kind](path)
    with open_recording(path) as walked, open_recording(path, strict=True) as indexed:
        assert facts(indexed) == facts(walked)


@pytest.mark.parametrize("share", np.linspace(0.05, 0.99, 8).round(3).tolist())
@pytest.mark.parametrize("kind", ["zstd", "none", "ros 2"])
def test_a_cut_file_is_refused_at_once(path: Path, kind: str, share: float) -> None:
    KINDS[kind](path)
    cut(path, share)
    assert "cut" in refusal(path, strict=True)


@pytest.mark.parametrize("kind", ["zstd", "lz4", "none", "ros 2"])
def test_no_damage_anywhere_is_taken_for_depth(path: Path, kind: str) -> None:
    KINDS[kind](path)
    whole = path.read_bytes()
    with open_recording(path) as recording:
        stored = {(frame.time_ns, frame.depth.tobytes()) for frame in recording}
    rng = np.random.default_rng(5)
    told = []
    for at in np.linspace(10, len(whole) - 10, 60).astype(int):
        content = bytearray(whole)
        content[at : at + 8] = rng.integers(0, 256, 8).astype(np.uint8).tobytes()
        path.write_bytes(content)
        try:
            with open_recording(path, strict=True) as recording:
                seen = {(frame.time_ns, frame.depth.tobytes()) for frame in recording}
                assert seen <= stored or recording.problems
                assert len(seen) == len(stored)
        except RecordingError as error:
            told.append(str(error))
    assert len(told) > 30
    assert not any("\n" in sentence for sentence in told)


def test_a_damaged_chunk_is_told_of_when_it_is_read_and_says_what_to_do(path: Path) -> None:
    KINDS["none"](path)
    content = bytearray(path.read_bytes())
    at = content.find(STORED[11].astype("<u2").tobytes()[2000:2100])
    assert at > 0
    content[at] ^= 1
    path.write_bytes(content)
    with open_recording(path, strict=True) as recording:
        np.testing.assert_array_equal(recording.frame(0).depth, STORED[0])
        with pytest.raises(RecordingError, match="accept_truncated"):
            recording.frame(11)
    with open_recording(path) as recording:
        assert recording.truncated
        assert len(recording) < 20
