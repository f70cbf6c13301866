"""Rising edges are read from files of other instruments as these write them."""

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import harp.data
import numpy as np
import pynwb
import pytest
from harp.protocol import RegisterU8

from liex_lab.errors import LiexError, MissingPackageError
from liex_lab.exchange import pulses
from liex_lab.exchange.pulses import read_pulses

EDGES = np.array([1.0, 1.5, 2.0, 2.5, 4.0, 4.5])  # up, down, up, ...
LEVELS = "time;level\n0,5;0\n1,0;1\n1,5;0\n2,0;1\n"


@pytest.mark.parametrize(
    ("name", "content", "channel", "times"),
    [
        ("edges.csv", LEVELS, "", [1.0, 2.0]),
        ("bare.txt", "1.0\n2.0\n", "", [1.0, 2.0]),
        ("two.csv", "a,b\n1,5\n2,6\n", "b", [5.0, 6.0]),
        ("two.csv", "a,b\n1,5\n2,6\n", "", "state --channel: it has a, b"),
        ("two.csv", "a,b\n1,5\n2,6\n", "c", "there is no column 'c'"),
        ("x.xyz", "1", "", "is of another kind"),
        ("x.nwb", "1", "", "should hold times of events, but"),
    ],
)
def test_tables_of_times_are_read(
    name: str, content: str, channel: str, times: list[float] | str, tmp_path: Path
) -> None:
    path = tmp_path / name
    path.write_text(content)
    if isinstance(times, str):
        with pytest.raises(LiexError, match=times):
            read_pulses(path, channel)
    else:
        np.testing.assert_array_equal(read_pulses(path, channel), times)


def test_edges_of_nwb_are_read(tmp_path: Path) -> None:
    file = pynwb.NWBFile(
        session_description="pulses",
        identifier="pulses",
        session_start_time=datetime(2026, 11, 28, tzinfo=UTC),
    )
    levels = np.repeat([0, 1, 0, 1], 50)
    file.add_acquisition(pynwb.TimeSeries(name="ttl", data=levels, unit="V", rate=100.0))
    file.add_acquisition(
        pynwb.TimeSeries(name="led", data=np.ones(6), unit="n/a", timestamps=EDGES)
    )
    trials = pynwb.epoch.TimeIntervals(name="stimuli", description="when")
    trials.add_row(start_time=3.0, stop_time=4.0)
    file.add_time_intervals(trials)
    with pynwb.NWBHDF5IO(tmp_path / "x.nwb", "w") as written:
        written.write(file)
    for name, times in (("ttl", [0.5, 1.5]), ("led", EDGES), ("stimuli", [3.0])):
        np.testing.assert_allclose(read_pulses(tmp_path / "x.nwb", name), times)
    with pytest.raises(LiexError, match="which series or table of intervals"):
        read_pulses(tmp_path / "x.nwb")


def test_edges_of_open_ephys_are_read(tmp_path: Path) -> None:
    folder = tmp_path / "Record Node 101" / "experiment1" / "recording1"
    stream = {"folder_name": "Acq-100.Data/", "sample_rate": 1000.0}
    channel = {"channel_name": "CH1", "bit_volts": 0.195, "units": "uV"}
    event = {"folder_name": "Acq-100.Data/TTL/", "channel_name": "TTL", "sample_rate": 1000.0}
    content = {
        "GUI version": "0.6.7",
        "continuous": [{**stream, "num_channels": 1, "channels": [channel]}],
        "events": [event],
        "spikes": [],
    }
    samples, ttl = folder / "continuous/Acq-100.Data", folder / "events/Acq-100.Data/TTL"
    samples.mkdir(parents=True)
    ttl.mkdir(parents=True)
    (folder / "structure.oebin").write_text(json.dumps(content))
    np.zeros(6000, np.int16).tofile(samples / "continuous.dat")
    np.save(samples / "sample_numbers.npy", np.arange(6000))
    np.save(samples / "timestamps.npy", np.arange(6000) / 1000.0)
    np.save(ttl / "timestamps.npy", np.append(EDGES, [5.0, 5.1]))
    np.save(ttl / "sample_numbers.npy", np.append(1000 * EDGES, [5000, 5100]).astype(int))
    np.save(ttl / "states.npy", np.array([1, -1] * 3 + [4, -4], np.int16))
    np.testing.assert_allclose(read_pulses(tmp_path, "TTL 1"), EDGES[::2])
    np.testing.assert_allclose(read_pulses(folder, "TTL 4"), [5.0])
    with pytest.raises(LiexError, match="it has TTL 1, TTL 4"):
        read_pulses(tmp_path)


def test_edges_of_spikeglx_are_read(tmp_path: Path) -> None:
    meta = {
        "fileName": "D:/run_g0/run_g0_t0.nidq.bin",
        "typeThis": "nidq",
        "nSavedChans": 2,
        "snsMnMaXaDw": "0,0,1,1",
        "niMNGain": 1,
        "niMAGain": 1,
        "niAiRangeMax": 5,
        "niSampRate": 1000,
        "niXDChans1": "0:1",
        "firstSample": 0,
        "~snsChanMap": "(0,0,32,1,1)(XA0;0:0)(XD0;1:1)",
    }
    (tmp_path / "run_g0_t0.nidq.meta").write_text("".join(f"{k}={v}\n" for k, v in meta.items()))
    samples = np.zeros((6000, 2), np.int16)
    for up, down in (1000 * EDGES).astype(int).reshape(-1, 2):
        samples[up:down, 1] |= 1
    samples[3000:3100, 1] |= 2
    samples.tofile(tmp_path / "run_g0_t0.nidq.bin")
    found = read_pulses(tmp_path / "run_g0_t0.nidq.bin", "XD0 ON")
    np.testing.assert_allclose(found, EDGES[::2])


def test_edges_of_a_harp_register_are_read(tmp_path: Path) -> None:
    native: Any = RegisterU8
    register = native(32)
    values = np.array([1, 0, 3, 0, 1, 0], np.uint8)
    harp.data.to_file(register, values, tmp_path / "Inputs_32.bin", timestamps=EDGES)
    np.testing.assert_allclose(read_pulses(tmp_path / "Inputs_32.bin", "0"), EDGES[::2])
    with pytest.raises(LiexError, match="which bit holds the pulses; state --channel: it has 0, 1"):
        read_pulses(tmp_path / "Inputs_32.bin")


def test_a_missing_reader_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(pulses._READERS, "folder", (lambda *_: __import__("no_such"), "sync"))
    with pytest.raises(MissingPackageError, match=r"no_such is missing; .*\[sync\]"):
        read_pulses(tmp_path)
