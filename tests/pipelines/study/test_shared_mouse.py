"""Two short virtual recordings of one mouse of known length, measured as one animal."""

import json
from pathlib import Path

import pytest
from liex_lab.pipelines.study.status import inspection_file

from liex_lab import api
from liex_lab.plan.study import Study
from tests.pipelines.study.test_sharing import here

TABLES = (".parquet", ".csv")
SPINE_MM = 80.0


def make_study(folder: Path, seeds: list[int], n_frames: int) -> Path:
    folder.mkdir()
    text = 'shared = "subject"\nset = { replay.depth = "none" }\n[[animals]]\nid = "m07"\n'
    for seed in seeds:
        text += f'[[sessions]]\nanimal = "m07"\nsession = "{seed}"\n'
        text += f'recording = "synthetic:walk?seed={seed}&frames={n_frames}&spine_mm=80"\n'
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"


@pytest.mark.nightly
def test_two_sessions_of_one_mouse_have_one_length_and_the_report_says_whose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("liex_lab.pipelines.study.run.crew_of", here)
    file = make_study(tmp_path / "study", [3, 4], 40)
    assert {status.state for status in api.run_study(file)} == {"done"}
    found, animals = [], []
    for session in Study.load(file).sessions:
        found.append(json.loads(inspection_file(session).read_text())["animal"]["spine_mm"])
        animals.append(json.loads((session.folder / "session.json").read_text())["animal"])
        page = (session.folder / "report.html").read_text(encoding="utf-8")
        assert "shared by 2 sessions of m07" in page
    (shared,) = {animal["spine_mm"] for animal in animals}
    assert found[0] != found[1]
    assert abs(shared - SPINE_MM) < max(abs(mm - SPINE_MM) for mm in found)
    assert {animal["origin"] for animal in animals} == {"shared by 2 sessions of m07"}
    assert len({animal["girth"] for animal in animals}) == 1


@pytest.mark.nightly
def test_every_table_is_the_same_by_one_worker_and_by_two_in_any_order(tmp_path: Path) -> None:
    one, other = make_study(tmp_path / "one", [3, 4], 40), make_study(tmp_path / "o", [4, 3], 40)
    api.run_study(one, workers=1)
    api.run_study(other, workers=2)
    folders = {session.id: session.folder for session in Study.load(other).sessions}
    for session in Study.load(one).sessions:
        names = [path.name for path in session.folder.iterdir() if path.suffix in TABLES]
        assert len(names) > 8
        for name in names:
            same = (session.folder / name).read_bytes() == (folders[session.id] / name).read_bytes()
            assert same, (session.id, name)
    findings = api.verify_session(session.folder, session.recording)
    assert [finding.sentence for finding in findings if finding.state == "wrong"] == []
    assert any("measured again, all" in finding.sentence for finding in findings)
