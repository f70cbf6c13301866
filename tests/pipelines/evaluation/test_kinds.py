"""Whole runs by kind of recording: every number is there and means what it says."""

from __future__ import annotations

from pathlib import Path

import pytest
from liex_lab.pipelines.evaluation.kinds import DEFINITIONS, evaluate_kinds


@pytest.mark.slow
def test_every_kind_of_recording_is_run_and_read_beside_it(tmp_path: Path) -> None:
    found = evaluate_kinds(40, tmp_path)
    assert list(found) == ["mcap_raw_640x480", "moseq_gz_512x424"]
    for numbers in found.values():
        assert set(DEFINITIONS) <= set(numbers)
        ratio = numbers["frames_per_s"] / numbers["decoding_frames_per_s_1core"]
        assert numbers["times_decoding"] == pytest.approx(ratio)
        share = numbers["session_mb"] / numbers["recording_mb"]
        assert numbers["session_share"] == pytest.approx(share)
        # a process cannot do in less time what is a part of what it does
        assert numbers["frames_per_s_with_start"] < numbers["frames_per_s"]
    assert not any(tmp_path.iterdir())
