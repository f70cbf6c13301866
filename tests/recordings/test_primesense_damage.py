"""Damaged .oni files: cut, with bits flipped, zeroed, with wrong sizes. Frames or a sentence, and never more memory
than four times the file and 300 MB.
"""

from __future__ import annotations

import re
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
WRONG = (0, 1, 27, 28, 39, 2**16, 2**24, 2**31 - 1, 2**31, 2**32 - 1)


def whole_file(codec: str, old: bool) -> tuple[OniBuilder, list[int]]:
    """A file, and where each of its frames ends."""
    payloads = [plain_payload(frame, codec) for frame in STORED]
    made = depth_builder(payloads, codec, 32, 24, old=old, table=True)
    head = 24 + 12 if old else 28 + 12
    ends = [at + head + len(payload) for (_, at), payload in zip(made.frames[1], payloads, strict=True)]
    made.record(0x0B)
    return made, ends


def damaged(whole: bytes, rng: np.random.Generator) -> tuple[bytes, int]:
    """A variant of a file, and the first byte in which it differs."""
    content, at = bytearray(whole), int(rng.integers(len(whole)))
    kind = rng.integers(6)
    if kind == 0:
        return bytes(content[:at]), at
    if kind == 1:
        places = np.sort(rng.integers(0, 8 * len(whole), rng.integers(1, 20)))
        for bit in places.tolist():
            content[bit // 8] ^= 1 << bit % 8
        return bytes(content), int(places[0]) // 8
    if kind == 2:
        n = int(rng.integers(1, 5000))
        content[at : at + n] = bytes(len(content[at : at + n]))
    elif kind == 3:
        n = int(rng.integers(1, 2000))
        content[at : at + n] = rng.integers(0, 256, rng.integers(0, 2000)).astype(np.uint8).tobytes()
    elif kind == 4:  # any number where a size may be: they stand at the sizes' own distances from a record's beginning
        at = int(rng.choice([found.start() for found in re.finditer(b"NIR\0", whole)])) + int(
            rng.choice([4, 8, 12, 16, 20])
        )
        content[at : at + 4] = struct.pack("<I", int(rng.choice(WRONG)))
    else:  # in the records before the first frame, where names, sizes and counts are
        at = int(rng.integers(24, whole.index(b"\x08\0\0\0", 24)))
        content[at : at + 4] = struct.pack("<I", int(rng.choice(WRONG)))
    return bytes(content), at


@pytest.mark.parametrize(
    ("codec", "old", "n_variants"), [("16zT", False, 200), ("16zT", True, 60), ("16zP", False, 60), ("NONE", True, 60)]
)
def test_damage_costs_what_lies_behind_it_and_nothing_else(
    tmp_path: Path, codec: str, old: bool, n_variants: int
) -> None:
    made, ends = whole_file(codec, old)
    rng, path = np.random.default_rng([CODECS.index(codec), old]), tmp_path / "r.oni"
    n_opened = 0
    tracemalloc.start()
    try:
        for _ in range(n_variants):
            content, at = damaged(made.content, rng)
            path.write_bytes(content)
            tracemalloc.reset_peak()
            n_before = sum(end <= at for end in ends)
            recording, sentence = opened_or_refused(path)
            if recording is None:
                assert n_before == 0
                assert path.name in sentence
                assert "\n" not in sentence
                continue
            n_opened += 1
            with recording:
                depths = [frame.depth for frame in recording]
                assert len(depths) >= n_before
                assert all(
                    np.array_equal(depth, stored) for depth, stored in zip(depths, STORED[:n_before], strict=False)
                )
                assert all(depth.shape == depths[0].shape and np.isfinite(depth).all() for depth in depths)
                assert recording.truncated or len(content) >= len(made.content)
            assert tracemalloc.get_traced_memory()[1] < 4 * len(content) + 300e6
    finally:
        tracemalloc.stop()
    assert n_opened > n_variants // 2


@pytest.mark.parametrize("codec", CODECS)
def test_a_damaged_frame_costs_only_itself(tmp_path: Path, codec: str) -> None:
    made, _ = whole_file(codec, False)
    path = tmp_path / "r.oni"
    head = made.frames[1][5][1]
    for field, value in [(0, 7), (4, 0x1A), (12, 2**20), (16, 2**31), (16, 3), (16, 2**16)]:
        content = made.content[: head + field] + struct.pack("<I", value) + made.content[head + field + 4 :]
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
