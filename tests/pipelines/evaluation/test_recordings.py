"""Benchmarks of recording formats: every number is there and means what it says."""

import json
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from liex_lab.pipelines.evaluation import speed

from liex_lab.optics.camera import PRIMESENSE


def in_this_process(job: str, *arguments: object, one_thread: bool = False) -> dict[str, Any]:
    """Stands in for `speed.isolated`, whose processes take seconds to start."""
    module, name = job.split(":")
    began = time.perf_counter()
    found = getattr(import_module(module), name)(
        *(one if isinstance(one, int) else str(one) for one in arguments)
    )
    seconds = time.perf_counter() - began
    measured = {"seconds": seconds, "seconds_with_start": seconds + 1.0, "peak_memory_mb": 100.0}
    return measured | (found or {})


def check_kind(folder: Path, n_frames: int, monkeypatch: pytest.MonkeyPatch) -> None:
    assert list(speed.KINDS) == ["mcap_raw_640x480", "moseq_gz_512x424"]
    kind = {"moseq": ("kinect-v2", speed.KINDS["moseq_gz_512x424"][1])}
    monkeypatch.setattr(speed, "KINDS", kind)
    (numbers,) = speed.evaluate_kinds(n_frames, folder).values()
    assert set(speed.DEFINITIONS) <= set(numbers)
    ratio = numbers["frames_per_s"] / numbers["decoding_frames_per_s_1core"]
    assert numbers["times_decoding"] == pytest.approx(ratio)
    share = numbers["session_mb"] / numbers["recording_mb"]
    assert numbers["session_share"] == pytest.approx(share)
    # a process cannot do in less time what is a part of what it does
    assert numbers["frames_per_s_with_start"] < numbers["frames_per_s"]
    assert not any(folder.iterdir())


def test_a_kind_of_recording_is_run_and_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(speed, "isolated", in_this_process)
    check_kind(tmp_path, 30, monkeypatch)


@pytest.mark.nightly
def test_a_kind_of_recording_is_run_in_processes_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_kind(tmp_path, 40, monkeypatch)


def test_a_format_is_written_read_and_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(speed.FORMATS) == {"mcap_zstd_raw", "mcap_zstd_png", "png_folder", "moseq_dat"}
    monkeypatch.setattr(speed, "isolated", in_this_process)
    images = np.full((2, 480, 640), 700, np.float32)
    monkeypatch.setattr(speed, "_rendered", lambda progress: (PRIMESENSE, images))
    result = speed.evaluate_recordings(n_frames=3, n_hour=24, n_repeats=1)
    for name in ("frames_per_s_1core", "open_ms_per_frame", "peak_mb", "peak_mb_of_an_hour"):
        assert set(result[name]) == set(speed.FORMATS)
        assert all(value > 0 for value in result[name].values())
    assert all(result["peak_mb_of_an_hour"][name] >= 100.0 for name in speed.FORMATS)
    assert "640 x 480, 3 frames" in result["protocol"]
    assert json.loads(json.dumps(result, allow_nan=False)) == result
