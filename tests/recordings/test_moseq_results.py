"""An extraction of MoSeq is read as full frames: where the animal was, as it lay, at its time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.recordings.open import open_recording
from tests.recordings.moseq_results import write_results

_FLOOR = 673.5
_ROI = np.zeros((424, 512), np.bool_)
_ROI[60:380, 70:430] = True
_TIMES = np.cumsum([0.0, 33.0, 33.5, 100.0, 33.0, 33.0, 33.0, 33.0]) + 6.6e8  # ms


def _mouse(k: int) -> NDArray[np.float32]:
    """A half ellipsoid on a floor that slopes, as uint16 would hold it; at the edge for k = 0."""
    v, u = np.mgrid[:424, :512]
    x, y, turn = 88.0 + 41 * k, 90.3 + 33 * k, 0.4 + 0.8 * k
    along = (u - x) * np.cos(turn) + (v - y) * np.sin(turn)
    across = (v - y) * np.cos(turn) - (u - x) * np.sin(turn)
    inside = np.clip(1 - (along / 20) ** 2 - (across / 9) ** 2, 0, None)
    return np.floor(_background() - 10 * (inside > 0) - 30 * np.sqrt(inside)).astype(np.float32)


def _background() -> NDArray[np.float64]:
    return np.broadcast_to(_FLOOR + 0.02 * np.arange(512), (424, 512)).copy()


_FRAMES = [_mouse(k) for k in range(8)]
_FLIPS = np.arange(8) % 3 == 1


@pytest.fixture
def file(tmp_path: Path) -> Path:
    about = {"SubjectName": "m07", "StartTime": "2017-01-25T10:42:07-05:00"}
    write_results(
        tmp_path / "results_00.h5", _FRAMES, _background(), _ROI, _TIMES, _FLIPS, None, about
    )
    return tmp_path / "results_00.h5"


def test_frames_come_out_where_the_animal_was(file: Path) -> None:
    with open_recording(file) as recording:
        assert recording.metadata["subject_id"] == "m07"
        assert recording.camera.source == "typical Kinect v2"
        np.testing.assert_allclose(np.diff(recording.times_ns) / 1e6, np.diff(_TIMES), atol=1e-3)
        assert any("typical Kinect v2 were taken" in one for one in recording.problems)
        assert any("10 to 100 mm in a square of 80 px" in one for one in recording.problems)
        assert not recording.doubts
        for frame, truth in zip(recording, _FRAMES, strict=True):
            true, found = (_background() - one >= 10 for one in (truth, frame.depth))
            assert (true & found).sum() > 0.93 * (true | found).sum(), frame.index
            assert np.abs(frame.depth - truth)[true & found].mean() < 1.0
            np.testing.assert_allclose(frame.depth[~found], _background()[~found], rtol=1e-6)


def test_a_flip_changes_no_frame(file: Path) -> None:
    other = file.with_name("unflipped.h5")
    write_results(other, _FRAMES, _background(), _ROI, _TIMES, np.zeros(8, np.bool_))
    with open_recording(file) as one, open_recording(other) as two:
        for a, b in zip(one, two, strict=True):
            np.testing.assert_array_equal(a.depth, b.depth)


def test_a_hole_is_unread(file: Path) -> None:
    frames = [one.copy() for one in _FRAMES]
    frames[4][220:226, 250:256] = _FLOOR - 140  # higher than MoSeq keeps
    write_results(file, frames, _background(), _ROI, _TIMES)
    with open_recording(file) as recording:
        assert (recording.frame(4).depth[221:225, 251:255] == 0).all()


def _set(name: str, value: Any) -> Callable[[h5py.File], None]:
    def edit(file: h5py.File) -> None:
        del file[name]
        if value is not None:
            file[name] = value

    return edit


_E = "metadata/extraction"


@pytest.mark.parametrize(
    ("edit", "sentence"),
    [
        (_set("timestamps", None), "a constant 30 frames/s was assumed"),
        (_set("timestamps", _TIMES[:5] / 1e3), "taken as"),
        (_set("timestamps", _TIMES[:5]), "frames holds 8 frames but timestamps holds 5"),
        (_set(f"{_E}/flips", None), "does not state which cut-outs were flipped"),
        (_set(f"{_E}/first_frame", None), "no raw first frame"),
        (_set(f"{_E}/first_frame", _FRAMES[0] - 30), "differs from the raw one in the file"),
        (_set(f"{_E}/background", None), "a flat floor at"),
        (_set("scalars/centroid_x_px", np.array([90.0] * 7 + [np.nan])), "1 of 8 frames hold no"),
    ],
)
def test_what_is_missing_is_said(
    file: Path, edit: Callable[[h5py.File], None], sentence: str
) -> None:
    with h5py.File(file, "a") as opened:
        edit(opened)
    with open_recording(file) as recording:
        assert any(sentence in one for one in recording.problems), recording.problems
        recording.frame(-1)


@pytest.mark.parametrize(
    ("edit", "sentence"),
    [
        (_set("frames", None), "holds no cut-outs"),
        (_set("frames", np.zeros((8, 80, 60), np.uint8)), "cut-outs of 60 x 80 pixels"),
        (_set("scalars/angle", None), "does not hold centroid and angle"),
        (_set(f"{_E}/roi", None), "holds no region of interest"),
        (_set("scalars/centroid_x_px", np.full(8, np.nan)), "no frame in which MoSeq found"),
        (_set(f"{_E}/roi", np.ones((480, 640), np.bool_)), "write a camera.toml beside it"),
    ],
)
def test_what_cannot_be_put_together_is_refused(
    file: Path, edit: Callable[[h5py.File], None], sentence: str
) -> None:
    with h5py.File(file, "a") as opened:
        edit(opened)
    with pytest.raises(RecordingError, match=sentence):
        open_recording(file)


def test_heights_over_nothing_are_refused(file: Path) -> None:
    with h5py.File(file, "a") as opened:
        del opened[f"{_E}/background"], opened[f"{_E}/true_depth"]
    with pytest.raises(RecordingError, match="neither a background"):
        open_recording(file)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_cut_file_and_one_that_is_no_hdf5_are_refused(file: Path, share: float) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))] or b"no HDF5")
    with pytest.raises(RecordingError, match="should be the results of moseq2-extract"):
        open_recording(file)


def test_a_damaged_block_is_unread_and_reported_once(file: Path) -> None:
    with h5py.File(file) as opened:
        at = opened["frames"].id.get_chunk_info(0).byte_offset
    content = bytearray(file.read_bytes())
    content[at + 8 : at + 24] = bytes(16)
    file.write_bytes(content)
    with open_recording(file) as recording:
        assert all((frame.depth == 0).all() for frame in recording)
        assert sum("taken as wholly unread" in one for one in recording.problems) == 1
