"""What every recording promises, whatever file it comes from: the same laws over every format of
formats.py.
"""

import gc
import io
import os
import shutil
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from liex_lab.errors import RecordingError
from liex_lab.recordings import Recording, open_recording
from tests.recordings.every_format import FORMATS, Format
from tests.recordings.writers import SMALL, depth_frames

N = 7
STORED = depth_frames(N)
BYTES = STORED[0].nbytes
LARGE = 64 * 1024  # a file above this is read in parts


@pytest.fixture(scope="module", params=FORMATS, ids=lambda form: form.name)
def form(request: pytest.FixtureRequest) -> Format:
    return request.param


@pytest.fixture(scope="module")
def path(form: Format, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return form.write(tmp_path_factory.mktemp("laws"), STORED)


def assert_is(depth: np.ndarray, index: int, form: Format, stored: np.ndarray = STORED) -> None:
    """The frame is that which was written."""
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, stored[index], rtol=0, atol=form.atol_mm)
    np.testing.assert_array_equal(depth == 0, stored[index] == 0)  # unread stays unread


def it_holds_what_was_written(recording: Recording, form: Format) -> None:
    assert (len(recording), recording.n_whole, recording.truncated) == (N, N, False)
    assert (recording.width, recording.height) == (64, 48)
    lens = recording.camera
    np.testing.assert_allclose(
        [lens.fx, lens.fy, lens.cx, lens.cy], [SMALL.fx, SMALL.fy, SMALL.cx, SMALL.cy]
    )
    assert lens.source
    for index, frame in enumerate(recording):
        assert (frame.index, frame.time_ns) == (index, int(recording.times_ns[index]))
        assert_is(frame.depth, index, form)


def times_increase_by_what_was_written(recording: Recording, form: Format) -> None:
    assert recording.times_ns.dtype == np.int64
    assert np.all(np.diff(recording.times_ns) > 0)
    np.testing.assert_allclose(
        np.diff(recording.times_ns), 1e9 / 30, atol=0.6e6
    )  # some count whole milliseconds
    assert recording.duration_s == pytest.approx((N - 1) / 30, abs=0.001)
    assert (recording.gaps, recording.faults) == ([], [])


def it_reads_in_any_order_and_again(recording: Recording, form: Format) -> None:
    for index in (5, 0, 3, 3, -1, 6, 1):
        assert_is(recording.frame(index).depth, index % N, form)
    first, second = list(recording), list(recording)
    np.testing.assert_array_equal([f.depth for f in first], [f.depth for f in second])
    for here, later in zip(recording, recording[2:], strict=False):  # two readers of one file
        assert_is(here.depth, here.index, form)
        assert_is(later.depth, here.index + 2, form)


def a_slice_is_a_recording_of_its_frames(recording: Recording, form: Format) -> None:
    for part in (slice(2, 5), slice(None, None, 2), slice(-3, None), slice(1, 2)):
        cut, rows = recording[part], range(N)[part]
        assert len(cut) == len(rows)
        np.testing.assert_array_equal(cut.times_ns, recording.times_ns[part])
        assert [frame.index for frame in cut] == list(range(len(rows)))
        for frame, row in zip(cut, rows, strict=True):
            assert_is(frame.depth, row, form)


def images_may_be_written_on(recording: Recording, form: Format) -> None:
    recording.frame(1).depth[:] = -1
    assert_is(recording.frame(1).depth, 1, form)


READING = (
    it_holds_what_was_written,
    times_increase_by_what_was_written,
    it_reads_in_any_order_and_again,
    a_slice_is_a_recording_of_its_frames,
    images_may_be_written_on,
)


def test_an_open_recording_keeps_the_laws_of_reading(
    form: Format, path: Path, subtests: pytest.Subtests
) -> None:
    with open_recording(path, strict=True) as recording:
        for law in READING:
            with subtests.test(law.__name__):
                law(recording, form)


def test_what_goes_while_it_is_read_gives_its_frames_or_a_sentence(
    form: Format, tmp_path: Path
) -> None:
    path = form.write(tmp_path, STORED)
    with open_recording(path) as recording:
        shutil.rmtree(tmp_path)
        said = set()
        for index in range(N):
            try:
                assert_is(recording.frame(index).depth, index, form)
            except RecordingError as error:
                said.add("can be read no more" in str(error))
        assert said <= {True}


def test_equal_files_have_equal_digests_and_others_not(
    path: Path, form: Format, tmp_path: Path
) -> None:
    with (
        open_recording(path) as recording,
        open_recording(form.write(tmp_path, STORED[:-1])) as shorter,
    ):
        assert recording.digest() == recording[1:3].digest() != shorter.digest()


def test_closing_lets_go_and_nothing_is_read_after_it(
    path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    before = set(os.listdir("/proc/self/fd"))
    recording = open_recording(path)
    part = recording[1:4]
    part.close()  # a slice leaves the file to the recording it was cut from
    part.frame(0)
    recording.close()
    recording.close()
    assert set(os.listdir("/proc/self/fd")) <= before
    assert not list(tmp_path.iterdir())
    for closed in (recording, part):
        with pytest.raises(RecordingError, match="was closed"):
            closed.frame(0)


def test_a_recording_that_nobody_holds_lets_go_of_its_files(
    path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    gc.freeze()  # all but the recording
    recording = open_recording(path)
    recording.frame(0)
    del recording
    gc.collect()  # an unclosed file is a ResourceWarning, and a warning is an error here
    gc.unfreeze()
    assert not list(tmp_path.iterdir())


class Bounded(io.BufferedReader):
    """A file that refuses to be read at once: a large one never in one piece, nor in pieces of many
    frames.
    """

    def read(self, size: int | None = -1, /) -> bytes:
        self._check(size)
        return super().read(size)

    def read1(self, size: int = -1, /) -> bytes:
        return super().read1(size)  # never more than the buffer

    def readinto(self, buffer: Any, /) -> int:
        self._check(memoryview(buffer).nbytes)
        return super().readinto(buffer)

    def readall(self) -> bytes:
        return self.read(-1)

    def _check(self, size: int | None) -> None:
        total = os.fstat(self.fileno()).st_size
        unbounded = size is None or size < 0
        if total > LARGE and (unbounded or size > max(1 << 20, 4 * BYTES)):
            raise AssertionError(
                f"{self.name}, {total} bytes long, was asked for {'all' if unbounded else size}"
            )


# one of every kind; the others nightly
QUICK = ["png", "tiff-stack", "moseq-dat", "moseq-archive", "azure-mkv", "oni-16zT", "ros2-db3"]
QUICK += ["mcap-foxglove", "bag-lz4"]


@pytest.mark.parametrize(
    "form",
    [
        pytest.param(form, id=form.name, marks=[pytest.mark.nightly] * (form.name not in QUICK))
        for form in FORMATS
    ],
)
def test_large_files_are_read_in_parts_and_memory_does_not_grow_with_length(
    form: Format, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # enough for a file that must not be read at once; fewer where every image has one of its own
    many = depth_frames(300 if form.streams else 48)
    genuine, quarter, peaks = io.open, len(many) // 4, []

    def open_bounded(file: Any, mode: str = "r", *rest: Any, **more: Any) -> Any:
        return Bounded(io.FileIO(file)) if mode == "rb" else genuine(file, mode, *rest, **more)

    for name, n in (("warm", quarter), ("short", quarter), ("long", len(many))):
        (tmp_path / name).mkdir()
        path = form.write(tmp_path / name, many[:n])
        tracemalloc.start()
        with monkeypatch.context() as patched:
            patched.setattr(io, "open", open_bounded)
            patched.setattr("builtins.open", open_bounded)
            with open_recording(path) as recording:
                for frame in recording:
                    assert_is(frame.depth, frame.index, form, many)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    largest = max(file.stat().st_size for file in ([path] if path.is_file() else path.iterdir()))
    assert form.streams == (largest > 4 * LARGE)
    # each further frame may cost some numbers, and never its image
    assert peaks[2] < peaks[1] + (len(many) - quarter) * BYTES / 2
