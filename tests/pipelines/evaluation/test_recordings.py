"""Benchmarks of recording formats: every number is there and means what it says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.evaluation import recordings

from liex_lab.optics.camera import PRIMESENSE


def test_a_format_is_written_read_and_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(recordings.FORMATS) == {"mcap_zstd_raw", "mcap_zstd_png", "png_folder", "moseq_dat"}
    some = {name: recordings.FORMATS[name] for name in ("moseq_dat",)}
    monkeypatch.setattr(recordings, "FORMATS", some)
    images = np.full((2, 480, 640), 700, np.float32)
    monkeypatch.setattr(recordings, "_rendered", lambda progress: (PRIMESENSE, images))
    result = recordings.evaluate_recordings(n_frames=3, n_hour=24, n_repeats=1)
    for name in ("frames_per_s_1core", "open_ms_per_frame", "peak_mb", "peak_mb_of_an_hour"):
        assert set(result[name]) == set(some)
        assert all(value > 0 for value in result[name].values())
    assert all(result["peak_mb_of_an_hour"][name] >= result["peak_mb"][name] for name in some)
    assert "640 x 480, 3 frames" in result["protocol"]
    assert json.loads(json.dumps(result, allow_nan=False)) == result


@pytest.mark.slow
def test_a_kind_of_recording_is_run_and_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kinds = recordings.KINDS
    assert list(kinds) == ["mcap_raw_640x480", "moseq_gz_512x424"]
    monkeypatch.setattr(recordings, "KINDS", {"moseq": ("kinect-v2", kinds["moseq_gz_512x424"][1])})
    (numbers,) = recordings.evaluate_kinds(40, tmp_path).values()
    assert set(recordings.DEFINITIONS) <= set(numbers)
    ratio = numbers["frames_per_s"] / numbers["decoding_frames_per_s_1core"]
    assert numbers["times_decoding"] == pytest.approx(ratio)
    share = numbers["session_mb"] / numbers["recording_mb"]
    assert numbers["session_share"] == pytest.approx(share)
    # a process cannot do in less time what is a part of what it does
    assert numbers["frames_per_s_with_start"] < numbers["frames_per_s"]
    assert not any(tmp_path.iterdir())
