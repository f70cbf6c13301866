"""Damaged files of every format: frames or one sentence, in little time and memory, and what lay
before the damage.
"""

import resource
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from liex_lab.errors import RecordingError
from liex_lab.recordings import Recording, open_recording
from tests.recordings.every_format import FORMATS, Format
from tests.recordings.writers import depth_frames

STORED = depth_frames(6)
FEW = 10  # damaged variants of a format outside the nightly run
SECONDS = 5  # far more than any takes; a hang otherwise


class Damage(NamedTuple):
    """What was done to which file, and the first byte that it changed."""

    kind: str
    file: Path
    at: int


@contextmanager
def little_memory(n_bytes: int) -> Iterator[None]:
    """As in a process that may grow by `n_bytes` only."""
    with open("/proc/self/status") as status:
        used = next(int(line.split()[1]) << 10 for line in status if line.startswith("VmData:"))
    before = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (used + n_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


@contextmanager
def little_time() -> Iterator[None]:
    def late(*_: object) -> None:
        raise TimeoutError(f"not done after {SECONDS} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def files_of(path: Path) -> list[Path]:
    return [path] if path.is_file() else sorted(file for file in path.iterdir() if file.is_file())


def damage(rng: np.random.Generator, path: Path) -> Damage:
    """Change one file of a recording: cut it, turn bits, blank a stretch, make a number absurd, add
    or drop bytes.
    """
    files = files_of(path)
    sizes = np.array([file.stat().st_size for file in files], float)
    # mostly what holds the depth, sometimes what lies beside it
    file = files[int(rng.choice(len(files), p=sizes / sizes.sum() if rng.random() < 0.7 else None))]
    content = bytearray(file.read_bytes())
    kind = str(rng.choice(["cut", "bits", "zeros", "number", "insert", "remove", "twice"]))
    near = (
        len(content) if rng.random() < 0.6 else min(len(content), 256)
    )  # headers are worth more than their share
    at = int(rng.integers(0, near))
    length = int(rng.integers(1, 600))
    if kind == "cut":
        del content[at:]
    elif kind == "bits":
        for _ in range(int(rng.integers(1, 9))):
            bit = int(rng.integers(at, min(at + 64, len(content))))
            content[bit] ^= 1 << int(rng.integers(8))
    elif kind == "zeros":
        content[at : at + length] = bytes(len(content[at : at + length]))
    elif kind == "number":  # as a length, a count or a size: 2^32 - 1, 2^31 - 1, 2^31, 2^24, 0, 1
        number = bytes.fromhex(
            str(
                rng.choice(["ffffffff", "ffffff7f", "00000080", "00000001", "00000000", "01000000"])
            )
        )
        content[at : at + 4] = number[: len(content[at : at + 4])]
    elif kind == "insert":
        content[at:at] = rng.integers(0, 256, length).astype(np.uint8).tobytes()
    elif kind == "twice":
        content[at:at] = content[max(0, at - length) : at]
    else:
        del content[at : at + length]
    file.write_bytes(content)
    return Damage(kind, file, at)


def read_all(recording: Recording, most: int) -> dict[int, np.ndarray]:
    """Its frames, each a depth image; a recording never holds many more than were written."""
    assert len(recording) <= most
    assert recording.times_ns.dtype == np.int64
    assert np.all(np.diff(recording.times_ns) > 0)
    frames = {}
    for frame in recording:
        assert frame.depth.shape == (recording.height, recording.width)
        assert frame.depth.dtype == np.float32
        assert np.isfinite(frame.depth).all()
        assert frame.depth.min() >= 0
        frames[frame.index] = frame.depth
    return frames


def check(form: Format, whole: Path, opened: Path, done: Damage) -> bool:
    """Open what is damaged and hold it to the laws; whether it opened."""
    expected = form.survivors(whole if whole.is_file() else whole / done.file.name, done.at)
    try:
        recording = open_recording(opened)
    except RecordingError as error:
        sentence = str(error)
        assert sentence
        assert "\n" not in sentence
        assert expected is None, f"refused although {list(expected)} are whole: {sentence}"
        return False
    with recording:
        frames = read_all(recording, 3 * len(STORED))
        for index in expected or ():
            np.testing.assert_allclose(frames[index], STORED[index], rtol=0, atol=form.atol_mm)
        if done.kind == "cut" and expected is not None:
            assert recording.truncated or recording.problems
        return True


@pytest.mark.parametrize("n_damaged", [FEW, pytest.param(200, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.name)
def test_damaged_variants_give_frames_or_a_sentence(
    form: Format, n_damaged: int, tmp_path: Path
) -> None:
    (tmp_path / "whole").mkdir()
    whole = form.write(tmp_path / "whole", STORED)
    size = sum(file.stat().st_size for file in files_of(whole))
    with open_recording(whole) as recording:  # imports and compiled kernels are not the file's
        read_all(recording, len(STORED))
    n_opened, failed = 0, []
    shutil.copytree(tmp_path / "whole", tmp_path / "damaged")
    opened = tmp_path / "damaged" / whole.relative_to(tmp_path / "whole")
    for seed in range(n_damaged):
        done = damage(np.random.default_rng([seed, len(form.name)]), opened)
        try:
            with little_time(), little_memory(4 * size + 300_000_000):
                n_opened += check(form, whole, opened, done)
        except BaseException as error:
            failed.append(
                f"seed {seed}, {done.kind} at {done.at} of {done.file.name}: "
                f"{type(error).__name__}: {error}"
            )
            if isinstance(error, KeyboardInterrupt):
                raise
        sound = tmp_path / "whole" / done.file.relative_to(tmp_path / "damaged")
        done.file.write_bytes(sound.read_bytes())
    assert not failed, "\n".join(failed)
    # the damage was neither too harsh nor none
    assert 0.1 * n_damaged < n_opened <= n_damaged - (n_damaged > FEW)


@pytest.mark.parametrize(
    "form", [form for form in FORMATS if form.promise], ids=lambda form: form.name
)
def test_a_header_that_promises_two_thousand_million_frames_is_refused(
    form: Format, tmp_path: Path
) -> None:
    path = form.write(tmp_path, STORED)
    assert form.promise is not None
    form.promise(path)
    with little_time(), little_memory(300_000_000), pytest.raises(RecordingError) as error:
        open_recording(path, strict=True)
    assert "\n" not in str(error.value)


def test_the_limits_of_this_test_hold(tmp_path: Path) -> None:
    with little_memory(50_000_000), pytest.raises(MemoryError):
        np.ones(
            4_000_000_000, np.uint8
        )  # more than a process that has run many tests may hold unused
    with little_time():
        signal.setitimer(signal.ITIMER_REAL, 0.01)
        with pytest.raises(TimeoutError):
            signal.pause()
