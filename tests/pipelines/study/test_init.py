"""`liex cohort init`: a study file that loads, whatever the folders and files are called."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from liex_lab.pipelines.study.init import begin_study, find_recordings, name_sessions

from liex_lab.errors import StudyError
from liex_lab.plan.study import Study


def touch(root: Path, *names: str) -> None:
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()


def test_recordings_in_folders_of_the_convention_become_animals_and_sessions(
    tmp_path: Path,
) -> None:
    touch(
        tmp_path,
        "rawdata/sub-m01/ses-01_date-20260821/behav/depth.mcap",
        "rawdata/sub-m01/ses-02/behav/depth.avi",
        "rawdata/sub-m01/ses-02/behav/depth_ts.txt",
        "rawdata/sub-m02/ses-01/behav/camera.toml",
        "rawdata/sub-m02/ses-01/behav/000.png",
        "rawdata/notes.txt",
        "other/left-out.mcap",
    )
    study = Study.load(begin_study(tmp_path))
    assert [session.id for session in study.sessions] == [
        "sub-m01_ses-01_date-20260821",
        "sub-m01_ses-02",
        "sub-m02_ses-01",
    ]
    assert [Path(session.recording).name for session in study.sessions] == [
        "depth.mcap",
        "behav",
        "behav",
    ]
    assert all(session.recording_exists for session in study.sessions)
    with pytest.raises(StudyError, match="overwrite"):
        begin_study(tmp_path)
    assert begin_study(tmp_path, overwrite=True)


def test_recordings_under_any_names_become_sessions_of_their_own(tmp_path: Path) -> None:
    touch(
        tmp_path,
        "mouse 1.mcap",
        "mouse+1.mcap",
        "=cmd|'x'.oni",
        "day 2/mouse_1.bag",
        "day 2/done.liex/session.mcap",
    )
    touch(tmp_path, "out/m.liex/session.json", "out/m.liex/session.mcap", ".hidden/x.mcap")
    study = Study.load(begin_study(tmp_path))
    assert len({session.id for session in study.sessions}) == len(study.sessions) == 4


def test_a_folder_without_recordings_is_told(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match="no recording"):
        begin_study(tmp_path)
    with pytest.raises(StudyError, match="is none"):
        begin_study(tmp_path / "none")
    assert not list(tmp_path.iterdir())
    assert find_recordings(tmp_path) == []


@settings(max_examples=60, deadline=None)
@given(
    names=st.lists(
        st.text(st.characters(exclude_characters="/\0", codec="utf-8"), min_size=1, max_size=20),
        min_size=1,
        max_size=6,
    )
)
def test_names_are_made_safe_and_stay_different(names: list[str]) -> None:
    root = Path("/raw")
    paths = [
        root / f"sub-{name}" / f"ses-{name}_x" / "depth.mcap"
        for name in names
        if name not in (".", "..")
    ]
    named = name_sessions(paths, root)
    table = {
        "animals": [{"id": animal} for animal in dict.fromkeys(animal for animal, _, _ in named)],
        "sessions": [{"animal": a, "session": s, "recording": "x.mcap"} for a, s, _ in named],
    }
    assert len(Study.from_table(table, Path("/x/study.toml")).sessions) == len(paths)
