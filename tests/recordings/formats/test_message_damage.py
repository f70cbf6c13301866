"""What damage to one chunk of an MCAP file or a ROS bag costs; 200 variants of each are in
test_damage.py.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from liex_lab.recordings import open_recording
from liex_lab.recordings.formats.messages.mcap import McapFile
from liex_lab.recordings.formats.messages.rosbag import BagFile
from liex_lab.runtime.progress import silent
from tests.recordings.ros_writers import write_bag
from tests.recordings.writers import depth_frames, write_camera, write_mcap

STORED = depth_frames(12)
FRAMES = [frame.astype(np.float32).tobytes() for frame in STORED]


def chunk_starts(path: Path) -> list[int]:
    """Where the records of a file's chunks begin, in order."""
    file = (McapFile if path.suffix == ".mcap" else BagFile)(path, path.open("rb"))
    list(file.walk(lambda channel: True, silent))
    file.close()
    return file.starts


@pytest.mark.parametrize("write", [write_mcap, write_bag])
@pytest.mark.parametrize("number", [0, 2, -1])
@pytest.mark.parametrize("where", ["length", "content"])
def test_a_damaged_chunk_costs_its_own_frames_only(
    tmp_path: Path, write: Callable[..., Path], number: int, where: str
) -> None:
    """Also the first one, which tells what the messages are, and one whose length is lost: the
    file's end tells.
    """
    path = write(tmp_path / ("r.mcap" if write is write_mcap else "r.bag"), STORED)
    write_camera(tmp_path)
    content = bytearray(path.read_bytes())
    starts = chunk_starts(path)
    assert len(starts) >= 4
    at = starts[number] + (0 if where == "length" else 400)
    content[at : at + 60] = b"\xff" * 60
    path.write_bytes(content)
    with open_recording(path) as recording:
        found = {frame.depth.tobytes() for frame in recording}
        assert recording.truncated
    assert len(STORED) - 4 <= len(found) < len(STORED)
    assert found < set(FRAMES)
