"""SpikeInterface opens a recording to which the manual adds our measures; where it is installed."""

import shutil
from typing import Any

import numpy as np
import pandas as pd
import pynwb
from liex_lab.pipelines.sync import sync_session

from liex_lab.sessions import Session
from tests.test_pages import BLOCK, EPHYS, PAGES


def test_ephys_and_ours_are_on_one_clock(session, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(EPHYS, {})
    shutil.copytree(session.path, "mouse_walk.liex")
    ours = np.cumsum(np.random.default_rng(3).uniform(0.1, 0.4, 15))
    pd.DataFrame({"time_s": ours}).to_csv("camera.csv", index=False)
    pd.DataFrame({"time_s": 1.00002 * ours + 9}).to_csv("ephys.csv", index=False)
    sync_session("mouse_walk.liex", "ephys.csv", pulses="camera.csv", report=False)
    names: dict[str, Any] = {}
    for language, block in BLOCK.findall(PAGES["docs/howto/sync.md"]):
        if language == "python":
            exec(block, names)
    samples, recording = names["samples"], names["recording"]
    frames = Session.open("mouse_walk.liex").frames
    np.testing.assert_allclose(frames["sync_s"], 1.00002 * frames["time_s"] + 9, atol=1e-6)
    np.testing.assert_allclose(recording.get_times()[samples], frames["sync_s"], atol=0.6e-3)
    assert recording.get_num_channels() == 4
    with pynwb.NWBHDF5IO("ephys.nwb", "r") as io:
        made = io.read()
        np.testing.assert_array_equal(
            made.processing["behavior"]["speed"].timestamps[:], frames["sync_s"]
        )
        assert len(made.intervals["actions"].to_dataframe()) == len(session.bouts)
