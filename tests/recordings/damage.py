"""Files as disks and networks leave them: seeded damage, and what a reader may do about it.

No crash, no hang, no error but a sentence; memory bounded by the file's size; what lies before the damage comes out.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import numpy as np

from liex_lab.errors import RecordingError
from liex_lab.recordings import open_recording

LONGEST_S = 20
MEGABYTE = 1 << 20


def damaged(content: bytes, seed: int) -> tuple[bytes, int]:
    """A variant of a file, and the first byte that is not as it was."""
    rng = np.random.default_rng(seed)
    at = int(rng.integers(0, len(content)))
    length = int(rng.integers(1, 400))
    kind = seed % 6
    if kind == 0:  # cut
        return content[:at], at
    if kind == 1:  # bits flipped
        changed, places = bytearray(content), np.sort(rng.integers(0, len(content), int(rng.integers(1, 9))))
        for place in places:
            changed[place] ^= 1 << int(rng.integers(0, 8))
        return bytes(changed), int(places[0])
    if kind == 2:  # zeroed
        return content[:at] + bytes(min(length, len(content) - at)) + content[at + length :], at
    if kind == 3:  # a size that is far too large, or none
        word = [b"\xff\xff\xff\x7f", b"\xff" * 8, bytes(4), b"\x00\x00\x00\x80"][int(rng.integers(0, 4))]
        return content[:at] + word + content[at + len(word) :], at
    if kind == 4:  # a piece is missing
        return content[:at] + content[at + length :], at
    return content[:at] + content[max(0, at - length) : at] + content[at:], at  # a piece is there twice


def read_all(path: Path) -> tuple[set[bytes], str]:
    """Every frame of a file as the bytes of its depth, or none and the sentence."""
    try:
        with open_recording(path) as recording:
            for frame in recording:
                assert np.isfinite(frame.depth).all()
                assert frame.depth.shape == (recording.height, recording.width)
            return {frame.depth.tobytes() for frame in recording}, ""
    except RecordingError as error:
        return set(), str(error)


def survive(
    path: Path, n_variants: int, n_before: Callable[[int], int], frames: list[bytes], first_seed: int = 0
) -> int:
    """Read damaged variants of a file; returns of how many frames came out.

    n_before: how many frames lie wholly before a byte; frames: the depth of each, float32 as bytes.
    """
    content, n_read = path.read_bytes(), 0
    variant = path.with_stem(f"{path.stem}_damaged")
    for seed in range(first_seed, first_seed + n_variants):
        changed, first = damaged(content, seed)
        variant.write_bytes(changed)
        with at_most(seconds=LONGEST_S, memory_bytes=4 * len(changed) + 300 * MEGABYTE, what=f"seed {seed}"):
            found, sentence = read_all(variant)
        assert found or sentence, f"seed {seed}"
        assert "\n" not in sentence, f"seed {seed}"
        lost = [k for k in range(n_before(first)) if frames[k] not in found]
        assert not lost, f"seed {seed}: frames {lost} lie before the damage and were lost; {sentence}"
        n_read += bool(found)
    return n_read


@contextmanager
def at_most(seconds: int, memory_bytes: int, what: str) -> Iterator[None]:
    """Interrupts what hangs, and measures how much memory was taken beyond what was there."""

    def hung(number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"{what}: still reading after {seconds} s")

    before = signal.signal(signal.SIGALRM, hung)
    signal.alarm(seconds)
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    held = _status("VmRSS")
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    taken = _status("VmHWM") - held
    assert taken <= memory_bytes, f"{what}: {taken >> 20} MB were taken and {memory_bytes >> 20} MB allowed"


def _status(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(name))
