"""A BORIS project comes back as it went, keeps what it does not know, and unpaired events are told."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import pandas as pd
import pytest

from liex_lab.errors import LiexError
from liex_lab.exchange.boris_project import boris_export_labels, boris_labels, read_boris_project, write_boris_project

BOUTS = pd.DataFrame({
    "individual": ["m01", "m01", "m01"], "action": ["rear", "walk", "rear"], "start_s": [0.5, 1.2, 3.0],
    "stop_s": [1.2, 2.0, 3.5],
})  # fmt: skip


def written(path: Path, **more) -> Path:
    return write_boris_project(path, BOUTS, {"rear": "up", "walk": "goes"}, observation="ses-01", duration_s=5.0,
                               fps=30.0, date="2026-08-21T10:00:00", **more)  # fmt: skip


@pytest.mark.parametrize("name", ["a.boris", "a.boris.gz"])
def test_bouts_come_back_as_labels_of_a_human(name: str, tmp_path: Path) -> None:
    labels = boris_labels(written(tmp_path / name))
    pd.testing.assert_frame_equal(labels[list(BOUTS)], BOUTS)
    assert set(labels["source"]) == {"human"}
    assert set(labels["session_id"]) == {"ses-01"}


def test_a_project_has_what_boris_asks_for(tmp_path: Path) -> None:
    project = json.loads(written(tmp_path / "a.boris", media="preview.mp4").read_text())
    assert project["project_format_version"] == "7.0"
    assert [b["code"] for b in project["behaviors_conf"].values()] == ["rear", "walk"]
    assert [s["name"] for s in project["subjects_conf"].values()] == ["m01"]
    observation = project["observations"]["ses-01"]
    assert observation["media_info"]["fps"] == {"preview.mp4": 30.0}
    assert observation["events"][0] == [0.5, "m01", "rear", "", "", 15]
    assert len(observation["events"]) == 2 * len(BOUTS)


def test_what_a_person_added_stays_and_corrections_are_read(tmp_path: Path) -> None:
    path = written(tmp_path / "a.boris")
    project = read_boris_project(path)
    project["my_own_key"] = {"kept": True}
    project["observations"]["another"] = {"events": [], "type": "LIVE"}
    project["observations"]["ses-01"]["events"] = [[1.0, "m01", "dig", "", ""], [2.5, "m01", "dig", "", ""]]
    again = read_boris_project(written(tmp_path / "b.boris", project=project))
    assert again["my_own_key"] == {"kept": True}
    assert "another" in again["observations"]
    path.write_bytes(gzip.compress(json.dumps(project | {"observations": {"ses-01": {
        "time offset": 0.5, "events": [[1.5, "", "dig", "", ""], [3.0, "", "dig", "", ""]]}}}).encode()))  # fmt: skip
    (row,) = boris_labels(path).itertuples()
    assert (row.action, row.start_s, row.stop_s) == ("dig", 1.0, 2.5)


@pytest.mark.parametrize(
    ("events", "complaint"),
    [([[1.0, "m", "dig", "", ""]], "starts at 1 s and never stops"), ([["x", "m", "dig", "", ""]], "cannot be read"),
     ([[1.0, "m"]], "cannot be read")],
)  # fmt: skip
def test_events_that_make_no_bouts_are_one_sentence(events: list, complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "a.boris"
    path.write_text(json.dumps({"observations": {"o": {"events": events}}}))
    with pytest.raises(LiexError, match=complaint):
        boris_labels(path)


@pytest.mark.parametrize("content", [b"", b"[]", b"{}", b"\x1f\x8bnot gzip", b"\xff\xfe"])
def test_what_is_no_project_is_one_sentence(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.boris"
    path.write_bytes(content)
    with pytest.raises(LiexError, match="should be a BORIS project"):
        boris_labels(path)


def test_an_export_of_aggregated_events_gives_its_states(tmp_path: Path) -> None:
    path = tmp_path / "events.tsv"
    pd.DataFrame({
        "Observation id": ["o", "o"], "Subject": ["m", "m"], "Behavior": ["dig", "sneeze"],
        "Behavior type": ["STATE", "POINT"], "Start (s)": [1.0, 3.0], "Stop (s)": [2.0, 3.0],
    }).to_csv(path, sep="\t", index=False)  # fmt: skip
    (row,) = boris_export_labels(path).itertuples()
    assert (row.session_id, row.action, row.start_s, row.stop_s) == ("o", "dig", 1.0, 2.0)
