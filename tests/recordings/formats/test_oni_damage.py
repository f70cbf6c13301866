"""What damage to one frame of an .oni file costs, and files made to take memory; 200 variants are
in test_damage.py.
"""

from __future__ import annotations

import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from tests.recordings.asking import opened_or_refused
from tests.recordings.oni_files import OniBuilder, depth_builder, mode, plain_payload
from tests.recordings.writers import depth_frames

STORED = depth_frames(12, 32, 24)
CODECS = ("16zT", "16zP", "NONE")


@pytest.mark.parametrize("codec", CODECS)
def test_a_damaged_frame_costs_only_itself(tmp_path: Path, codec: str) -> None:
    made = depth_builder(
        [plain_payload(frame, codec) for frame in STORED], codec, 32, 24, table=True
    )
    made.record(0x0B)
    path = tmp_path / "r.oni"
    head = made.frames[1][5][1]
    for field, value in [(0, 7), (4, 0x1A), (12, 2**20), (16, 2**31), (16, 3), (16, 2**16)]:
        content = (
            made.content[: head + field]
            + struct.pack("<I", value)
            + made.content[head + field + 4 :]
        )
        path.write_bytes(content)
        recording, sentence = opened_or_refused(path)
        assert recording is not None, sentence
        with recording:
            depths = [frame.depth for frame in recording]
            expected = STORED.astype(np.float32)
            if len(depths) == len(STORED) - 1:
                assert recording.truncated
                expected = np.delete(expected, 5, axis=0)
            elif field == 16 and value == 3:
                expected[5] = 0  # too short to be a frame
            np.testing.assert_array_equal(depths, expected)
            assert recording.problems


def test_records_without_end_take_no_memory(tmp_path: Path) -> None:
    made = depth_builder([], "16zP", 32, 24)
    frame = struct.pack("<IIIIIQQI", 0x0052494E, 0x0A, 1, 40, 2, 0, 0, 1) + b"\0\0"
    changes = b""
    for width in range(1, 2000):
        one = OniBuilder()
        one.properties(1, xnMapOutputMode=mode(width, 24))
        changes += one.content[24:] + frame
    path = tmp_path / "r.oni"
    path.write_bytes(made.content + changes + 20_000 * frame)
    tracemalloc.start()
    try:
        recording, sentence = opened_or_refused(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert recording is None
    assert "r.oni" in sentence
    assert peak < 4 * path.stat().st_size + 30e6
