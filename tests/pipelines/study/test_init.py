"""`liex cohort init`: a study file that loads, whatever the folders and files are called."""

import json
import tarfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from liex_lab.pipelines.study.init import begin_study, find_recordings, name_sessions
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.errors import StudyError
from liex_lab.optics.camera import Camera
from liex_lab.plan.study import Study, find_subject
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.writer import McapDepthWriter


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
    with pytest.raises(StudyError, match="is not a folder"):
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
    named, _ = name_sessions(dict.fromkeys(paths, ""), root)
    table = {
        "animals": [{"id": animal} for animal in dict.fromkeys(animal for animal, *_ in named)],
        "sessions": [{"animal": a, "session": s, "recording": "x.mcap"} for a, s, *_ in named],
    }
    assert len(Study.from_table(table, Path("/x/study.toml")).sessions) == len(set(paths))


def moseq(root: Path, name: str, subject: object, content: str = "") -> None:
    """A MoSeq session as far as init reads it."""
    touch(root, f"{name}/depth.dat")
    (root / name / "depth.dat").write_text(content)
    (root / name / "metadata.json").write_text(json.dumps({"SubjectName": subject}))


def animals_of(folder: Path) -> dict[str, list[str]]:
    """The animals of the study in a folder, begun anew, with their sessions."""
    found: dict[str, list[str]] = {}
    for one in Study.load(begin_study(folder, overwrite=True)).table.sessions:
        found.setdefault(one.animal, []).append(one.session)
    return found


LAYOUTS = {
    "endings": "m0{a}_day{d}.mcap",
    "short endings": "m0{a}-d{d}.oni",
    "capitals and spaces": "M0{a} Day {d}.mcap",
    "dates": "m0{a}_2026082{d}.mcap",
    "dates with hyphens": "m0{a}_2026-08-2{d}.bag",
    "stamps": "m0{a}-2026082{d}T101500.mcap",
    "dates first": "2026082{d}_m0{a}.mcap",
    "bids": "sub-m0{a}/ses-day{d}/behav/depth.mcap",
    "animal, then day": "m0{a}/day{d}.mcap",
    "day, then animal": "day{d}/m0{a}.mcap",
    "date, then animal": "2026-08-2{d}/m0{a}_depth.mcap",
    "in a group": "groupA/m{a}_s{d}.oni",
    "in a folder of a person": "smith/mouse_{a}/session_{d}/depth.avi",
    "tests": "m0{a}/2026082{d}.mcap",
    "tag": "A1{a}_trial{d}.db3",
    "habituation": "m0{a}_habituation{d}_depth.mcap",
}


@pytest.mark.parametrize("pattern", LAYOUTS.values(), ids=LAYOUTS.keys())
def test_two_mice_on_three_days_are_two_animals_for_init_and_for_run(
    tmp_path: Path, pattern: str
) -> None:
    names = [pattern.format(a=a, d=d) for a in (1, 2) for d in (1, 2, 3)]
    touch(tmp_path, *(f"rawdata/{name}" for name in names))
    found = animals_of(tmp_path)
    assert [len(set(sessions)) for sessions in found.values()] == [3, 3]
    for one in Study.load(tmp_path).table.sessions:
        assert find_subject(tmp_path / one.recording).id == one.animal
        elsewhere = find_subject(Path("/home/anna") / Path(one.recording).relative_to("rawdata"))
        assert elsewhere.id == one.animal, "a run outside of any study"


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("subjects", [("m07", "m08"), (7, 8), ("m07_day2", "m08 day 3")])
def test_sessions_of_moseq_are_of_the_animal_in_their_metadata(
    tmp_path: Path, subjects: tuple[object, object], packed: bool
) -> None:
    for k in range(6):
        name = f"session_2024030510010{k}"
        moseq(tmp_path / "rawdata", name, subjects[k % 2], content=str(k))
        if packed:
            with tarfile.open(tmp_path / "rawdata" / f"{name}.tar.gz", "w:gz") as archive:
                archive.add(tmp_path / "rawdata" / name, name)
            for file in (tmp_path / "rawdata" / name).iterdir():
                file.unlink()
    found = animals_of(tmp_path)
    assert [len(sessions) for sessions in found.values()] == [3, 3]
    assert list(found) == [f"{subjects[0]}"[:3], f"{subjects[1]}"[:3]]
    assert "named by: metadata" in (tmp_path / "study.toml").read_text()


def test_extractions_of_moseq_are_listed_only_without_their_recordings(tmp_path: Path) -> None:
    touch(tmp_path, "rawdata/session_1/proc/results_00.h5", "rawdata/poses.h5")
    assert [one.parent.parent.name for one in find_recordings(tmp_path)] == ["session_1"]
    touch(tmp_path, "rawdata/session_1.tar.gz")
    assert [one.name for one in find_recordings(tmp_path)] == ["session_1.tar.gz"]


@pytest.mark.parametrize(
    "names",
    [
        ("m1.mcap", "m01.mcap", "mouse3.mcap", "A12.mcap", "cage2_m3.mcap", "cage3_m3.mcap"),
        ("cage2/m3.mcap", "cage3/m3.mcap"),
        ("20260821.mcap", "20260822.mcap"),
        ("session_20240305100122.tar.gz", "session_20240305100123.tar.gz"),
        ("rec_1.mcap", "rec_2.mcap", "depth.mcap", "video 3.avi"),
        ("day1/rec.mcap", "day2/rec.mcap"),
        ("wt_1.mcap", "ko_1.mcap", "drug_d1.mcap", "drug_d2.mcap"),
        ("101-2_d1.mcap", "10-12_d1.mcap"),
        ("小白_d1.mcap", "小黑_d1.mcap"),
        ("s1.mcap", "s2.mcap", "mouse_day1.mcap", "mouse_day2.mcap"),
    ],
)
def test_no_two_animals_are_merged_by_cutting_too_much(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    touch(tmp_path, *names)
    assert len(animals_of(tmp_path)) == len(names)


def test_init_asks_whether_the_animals_are_right_and_says_what_names_none(tmp_path: Path) -> None:
    touch(tmp_path, *(f"m0{k % 3}_day{k // 3}.mcap" for k in range(6)), "20260821.mcap")
    ran = CliRunner().invoke(cli.app, ["cohort", "init", str(tmp_path)])
    assert ran.exit_code == 0, ran.output
    assert "7 recordings, 4 animals: is that so?" in ran.output
    assert "    m01: day0, day1" in ran.output
    assert "nothing names the animal of 20260821: " in ran.output
    text = (tmp_path / "study.toml").read_text()
    assert 'id = "m01"  # named by: file name' in text
    assert "# note: nothing names the animal of 20260821" in text


@pytest.mark.parametrize(
    "names", [("m1_9", "m1_10"), ("m1_2026-03-02T07-59", "m1_2026-03-02T08-00")]
)
def test_files_of_one_camera_that_follow_each_other_are_one_session(
    tmp_path: Path, names: tuple[str, str]
) -> None:
    camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    depth = np.full((48, 64), 700.0, np.float32)
    for first_s, name in ((0, names[0]), (1, names[1]), (90, "mouse7"), (9000, "mouse8")):
        with McapDepthWriter(tmp_path / f"{name}.mcap", camera) as file:
            for k in range(30):
                file.add(DepthFrame(k, (first_s * 30 + k) * 33_333_333, depth))
    begin_study(tmp_path)
    recordings = [Path(one.recording) for one in Study.load(tmp_path / "study.toml").sessions]
    assert [one.name for one in recordings] == ["m1_*.mcap", "mouse7.mcap", "mouse8.mcap"]


def test_a_placeholder_in_metadata_is_no_animal(tmp_path: Path) -> None:
    for name in ("m01_day1", "m02_day1", "m02_day2"):
        moseq(tmp_path, name, "default", content=name)
    assert {name: len(own) for name, own in animals_of(tmp_path).items()} == {"m01": 1, "m02": 2}


def test_metadata_and_name_that_disagree_are_told(tmp_path: Path) -> None:
    moseq(tmp_path, "m01_day1", "m07")
    said: list[str] = []
    begin_study(tmp_path, echo=said.append)
    assert "m01_day1: its metadata name the animal m07 and its file name m01" in said


def test_the_same_recording_is_listed_once(tmp_path: Path) -> None:
    raw = tmp_path / "rawdata"
    moseq(raw, "session_1", "m01", content="one")
    moseq(raw, "session_2", "m01", content="two")
    touch(raw, "session_1.tar.gz", "proc/depth.tiff")
    (raw / "m02_day1.mcap").write_text("three")
    (raw / "copy of m02.mcap").write_text("three")
    (raw / "m03_day1.oni").write_text("four")
    (raw / "m03_day1.mcap").write_text("the same in another container")
    said: list[str] = []
    study = Study.load(begin_study(tmp_path, echo=said.append))
    assert len(study.sessions) == 4
    for left_out in ("session_1.tar.gz", "copy of m02.mcap", "m03_day1.mcap"):
        assert any(
            line.startswith(f"rawdata/{left_out} is the same recording as ") for line in said
        ), left_out


def test_a_folder_of_containers_with_one_camera_file_holds_several_recordings(
    tmp_path: Path,
) -> None:
    touch(tmp_path, "rig/camera.toml", "rig/m01_day1.oni", "rig/m01_day2.oni")
    assert animals_of(tmp_path) == {"m01": ["rigday1", "rigday2"]}
