"""Two short virtual recordings of one mouse of known length, measured as one animal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from liex_lab.pipelines.study.sharing import look_file
from liex_lab.pipelines.study.status import standings

from liex_lab import api
from liex_lab.plan.study import Study

TABLES = (".parquet", ".csv")
SPINE_MM = 80.0
RECORDINGS = {str(seed): f"synthetic:walk?seed={seed}&frames=40&spine_mm=80" for seed in (3, 4)}


def make_study(folder: Path, names: list[str]) -> Path:
    folder.mkdir()
    text = 'shared = "subject"\nset = { replay.depth = "none" }\n[[animals]]\nid = "m07"\n'
    for name in names:
        text += f'[[sessions]]\nanimal = "m07"\nsession = "{name}"\n'
        text += f'recording = "{RECORDINGS[name]}"\n'
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"


@pytest.fixture(scope="module")
def studies(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same study twice: by one worker, and by two with the sessions in the other order."""
    folder = tmp_path_factory.mktemp("shared")
    one = make_study(folder / "one", list(RECORDINGS))
    other = make_study(folder / "other", list(reversed(RECORDINGS)))
    api.run_study(one, workers=1)
    api.run_study(other, workers=2)
    return one, other


def told(file: Path) -> dict[str, dict[str, Any]]:
    """What session.json of each session says of the animal."""
    return {
        session.id[-1]: json.loads((session.folder / "session.json").read_text())["animal"]
        for session in Study.load(file).sessions
    }


def test_both_say_the_same_length_and_it_is_nearer_than_the_worse_of_the_two(
    studies: tuple[Path, Path],
) -> None:
    animals = told(studies[0])
    found = [
        json.loads(look_file(session).read_text())["animal"]["spine_mm"]
        for session in Study.load(studies[0]).sessions
    ]
    (shared,) = {animal["spine_mm"] for animal in animals.values()}
    assert found[0] != found[1]
    assert abs(shared - SPINE_MM) < max(abs(mm - SPINE_MM) for mm in found)
    assert {animal["origin"] for animal in animals.values()} == {"shared by 2 sessions of m07"}
    assert len({animal["girth"] for animal in animals.values()}) == 1


def test_every_table_is_the_same_by_one_worker_and_by_two_in_any_order(
    studies: tuple[Path, Path],
) -> None:
    one, other = (
        {session.id: session.folder for session in Study.load(file).sessions} for file in studies
    )
    assert {status.state for file in studies for status in standings(Study.load(file))} == {"done"}
    for id, folder in one.items():
        names = sorted(path.name for path in folder.iterdir() if path.suffix in TABLES)
        assert len(names) > 8
        for name in names:
            assert (folder / name).read_bytes() == (other[id] / name).read_bytes(), (id, name)


def test_the_report_says_whose_size_it_is(studies: tuple[Path, Path]) -> None:
    for session in Study.load(studies[0]).sessions:
        page = (session.folder / "report.html").read_text(encoding="utf-8")
        assert "shared by 2 sessions of m07" in page


def test_plan_and_recording_alone_give_the_session_again(studies: tuple[Path, Path]) -> None:
    session = Study.load(studies[0]).sessions[0]
    findings = api.verify_session(session.folder, session.recording)
    assert [finding.sentence for finding in findings if finding.state == "wrong"] == []
    assert any("measured again, all" in finding.sentence for finding in findings)
