"""State events of BORIS are labels, and events that make no bout are told."""

import gzip
import json
from pathlib import Path

import pandas as pd
import pytest

from liex_lab.errors import LiexError
from liex_lab.exchange.boris import boris_export_labels, boris_labels

EVENTS = [
    [0.5, "m01", "rear", "", "", 15],
    [1.2, "m01", "rear", "", "", 36],
    [1.2, "m01", "walk", "", "", 36],
    [2.0, "m01", "walk", "", "", 60],
    [2.5, "m01", "sneeze", "", "", 75],
]
PROJECT = {
    "behaviors_conf": {
        "0": {"type": "State event", "code": "rear"},
        "1": {"type": "Point event", "code": "sneeze"},
    },
    "observations": {"ses-01": {"events": EVENTS, "time offset": 0.0, "my own key": 1}},
}


@pytest.mark.parametrize("pack", [bytes, gzip.compress])
def test_state_events_are_labels_of_a_human_and_points_are_none(pack, tmp_path: Path) -> None:
    path = tmp_path / "a.boris"
    path.write_bytes(pack(json.dumps(PROJECT).encode()))
    labels = boris_labels(path)
    assert labels[
        ["session_id", "individual", "action", "start_s", "stop_s", "source"]
    ].to_numpy().tolist() == [
        ["ses-01", "m01", "rear", 0.5, 1.2, "human"],
        ["ses-01", "m01", "walk", 1.2, 2.0, "human"],
    ]


def test_the_time_offset_of_an_observation_is_taken_off(tmp_path: Path) -> None:
    path = tmp_path / "a.boris"
    events = [[1.5, "", "dig", "", ""], [3.0, "", "dig", "", ""]]
    path.write_text(json.dumps({"observations": {"o": {"time offset": 0.5, "events": events}}}))
    (row,) = boris_labels(path).itertuples()
    assert (row.action, row.start_s, row.stop_s) == ("dig", 1.0, 2.5)


def test_damaged_projects_are_refused_in_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "a.boris"
    for events, complaint in (
        ([[1.0, "m", "dig", "", ""]], "starts at 1 s and never stops"),
        ([["x", "m", "dig", "", ""]], "cannot be read"),
        ([[1.0, "m"]], "cannot be read"),
    ):
        path.write_text(json.dumps({"observations": {"o": {"events": events}}}))
        with pytest.raises(LiexError, match=complaint):
            boris_labels(path)
    for content in (b"", b"[]", b"{}", b"\x1f\x8bnot gzip", b"\xff\xfe"):
        path.write_bytes(content)
        with pytest.raises(LiexError, match="should be a BORIS project"):
            boris_labels(path)


def test_an_export_of_aggregated_events_gives_its_states(tmp_path: Path) -> None:
    path = tmp_path / "events.tsv"
    pd.DataFrame(
        {
            "Observation id": ["o", "o"],
            "Subject": ["m", "m"],
            "Behavior": ["dig", "sneeze"],
            "Behavior type": ["STATE", "POINT"],
            "Start (s)": [1.0, 3.0],
            "Stop (s)": [2.0, 3.0],
        }
    ).to_csv(path, sep="\t", index=False)
    (row,) = boris_export_labels(path).itertuples()
    assert (row.session_id, row.action, row.start_s, row.stop_s) == ("o", "dig", 1.0, 2.0)
