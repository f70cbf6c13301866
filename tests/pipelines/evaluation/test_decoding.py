"""`liex evaluate speed --recordings`: what is measured is measured, and called as ever."""

from __future__ import annotations

import json

import numpy as np
import pytest
from liex_lab.pipelines.evaluation import decoding as job

from liex_lab.errors import LiexError
from liex_lab.optics.camera import PRIMESENSE
from liex_lab.runtime.progress import silent


def test_what_is_promised_is_measured() -> None:
    assert set(job._FORMATS) == {
        "mcap_zstd_raw",
        "mcap_zstd_png",
        "png_folder",
        "moseq_dat",
    }
    camera, pictures = job._rendered(silent)
    assert (camera.width, camera.height) == pictures.shape[:0:-1] == (640, 480)
    assert 300 < np.median(pictures) < 1000


def test_a_format_is_written_read_and_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    some = {name: job._FORMATS[name] for name in ("mcap_zstd_raw", "moseq_dat")}
    monkeypatch.setattr(job, "_FORMATS", some)
    monkeypatch.setattr(
        job, "_rendered", lambda progress: (PRIMESENSE, np.full((2, 480, 640), 700, np.float32))
    )
    told: list[str] = []
    result = job.evaluate_recordings(
        n_frames=3, n_hour=24, n_repeats=1, progress=lambda *facts: told.append(facts[2])
    )
    for name in ("frames_per_s_1core", "open_ms_per_frame", "peak_mb", "peak_mb_of_an_hour"):
        assert set(result[name]) == set(some)
        assert all(value > 0 for value in result[name].values())
    assert all(result["peak_mb_of_an_hour"][name] >= result["peak_mb"][name] for name in some)
    assert "640 x 480, 3 frames" in result["protocol"]
    assert told == ["timing mcap_zstd_raw", "timing moseq_dat"]
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_a_process_that_fails_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job, "_READ", "raise SystemExit('it broke')")
    monkeypatch.setattr(
        job, "_rendered", lambda progress: (PRIMESENSE, np.full((2, 480, 640), 700, np.float32))
    )
    with pytest.raises(LiexError, match="it broke"):
        job.evaluate_recordings(n_frames=1, n_hour=6, n_repeats=1)
