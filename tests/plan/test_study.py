"""A study file names what is in its own folder, and says in one sentence what is wrong with it."""

import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liex_lab.errors import LiexError, StudyError
from liex_lab.plan import Plan
from liex_lab.plan.study import Study

TWO = """
name = "two groups"
[set]
behaviour.rear_height_mm = 45.0
[[animals]]
id = "m01"
group = "control"
cage = "c1"
set = { animal.spine_mm = 65 }
[[animals]]
id = "m02"
group = "treated"
[[sessions]]
animal = "m01"
session = "01_date-20260821"
recording = "rawdata/sub-m01/ses-01_date-20260821/behav/depth.mcap"
[[sessions]]
animal = "m02"
session = "01"
recording = "synthetic:walk?seed=3"
set = { behaviour.rear_height_mm = 50.0 }
exclude = "fell asleep"
"""


def study_of(text: str, folder: Path) -> Study:
    file = folder / "study.toml"
    file.write_text(text, encoding="utf-8")
    return Study.load(file)


def read_whole(text: str, folder: Path) -> None:
    """Everything that reading a study may refuse."""
    study = study_of(text, folder)
    assert study.results
    assert study.sessions


def test_sessions_get_their_animals_facts_and_settings(tmp_path: Path) -> None:
    first, second = study_of(TWO, tmp_path).sessions
    assert first.id == "sub-m01_ses-01_date-20260821"
    assert first.folder == tmp_path / "derivatives/liex-lab/sub-m01/ses-01_date-20260821/behav"
    assert first.recording == str(
        tmp_path / "rawdata/sub-m01/ses-01_date-20260821/behav/depth.mcap"
    )
    facts = first.plan.session
    assert (facts.name, facts.subject_id, facts.group, facts.cage) == (
        first.id,
        "m01",
        "control",
        "c1",
    )
    assert (first.plan.animal.spine_mm, first.plan.behaviour.rear_height_mm) == (65, 45.0)
    assert (second.plan.animal.spine_mm, second.plan.behaviour.rear_height_mm) == (None, 50.0)
    assert (first.exclude, second.exclude) == ("", "fell asleep")
    assert not first.recording_exists
    assert second.recording_exists


def test_a_plan_and_files_in_the_studys_folder_are_found_from_everywhere(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(Plan.load("mouse").with_settings(["seed=7"]).to_toml())
    (tmp_path / "zones.toml").write_text("")
    study = study_of(
        TWO.replace(
            'name = "two groups"', 'plan = "own.toml"\nset.arena.zones = "zones.toml"'
        ).replace("[set]\nbehaviour.rear_height_mm = 45.0\n", ""),
        tmp_path,
    )
    plan = study.sessions[0].plan
    assert plan.seed == 7
    assert plan.arena.zones == str(tmp_path / "zones.toml")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("rawdata/sub-m01", "../elsewhere", "its own folder"),
        ("rawdata/sub-m01", "/etc", "its own folder"),
        ("rawdata/sub-m01", "C:/data", "its own folder"),
        ("rawdata/sub-m01", "rawdata/../../x", "its own folder"),
        ('name = "two groups"', 'results = "../out"', "its own folder"),
        ('name = "two groups"', 'results = "rawdata/out"', "nothing is written"),
        ('name = "two groups"', 'plan = "../mouse.toml"', "its own folder"),
        ('name = "two groups"', 'plan = "mose"', "there is no plan"),
        ('id = "m02"', 'id = "../m02"', "letters and digits"),
        ('id = "m02"', 'id = "=cmd"', "letters and digits"),
        ('id = "m02"', 'id = "M01"', "listed twice"),
        ('session = "01"', 'session = "a/b"', "letters and digits"),
        (
            'animal = "m02"\nsession = "01"',
            'animal = "m01"\nsession = "01_date-20260821"',
            "two sessions",
        ),
        ('animal = "m02"', 'animal = "m03"', "not in"),
        ("exclude", "exlcude", "did you mean exclude"),
        ("group", "gruop", "did you mean group"),
        ("animal.spine_mm = 65", "animal.spin_mm = 65", "nearest one is animal.spine_mm"),
        ("animal.spine_mm = 65", "animal.spine_mm = 'x'", "number"),
        ("[set]", "[set", "TOML"),
    ],
)
def test_a_mistake_is_one_sentence(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in TWO
    with pytest.raises(LiexError, match=said) as error:
        read_whole(TWO.replace(old, new), tmp_path)
    assert "\n" not in str(error.value)


def test_a_study_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match="cohort init"):
        Study.load(tmp_path)
    (tmp_path / "study.toml").write_bytes(b"\xff\xfe\0\0")
    with pytest.raises(StudyError, match="TOML"):
        Study.load(tmp_path)


_WORDS = st.sampled_from(
    [*tomllib.loads(TWO), "plan", "results", "set", "id", "animal", "session", "recording", "x"]
)
_LEAVES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=12),
    st.sampled_from(
        [
            "../x",
            "/etc/passwd",
            "mouse",
            "m01",
            "synthetic:walk",
            "\0",
            "a\\..\\b",
            "rawdata",
            "~/x",
        ]
    ),
)
_TABLES = st.recursive(
    _LEAVES,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_WORDS, inner, max_size=4),
    max_leaves=20,
)


def inside(path: Path, folder: Path) -> bool:
    """Whether a path lies in the folder when its dots are taken away."""
    return Path(*path.resolve().parts[: len(folder.resolve().parts)]) == folder.resolve()


@settings(max_examples=25, deadline=None)
@given(table=st.dictionaries(_WORDS, _TABLES, max_size=5))
def test_whatever_a_study_file_says_it_is_read_or_refused_in_one_sentence(
    table: dict[str, Any],
) -> None:
    check_study(table)


def check_study(table: dict[str, Any]) -> None:
    """The law of the test above, which the fuzzing script runs for longer."""
    folder = Path("/nowhere/study")
    try:
        study = Study.from_table(table, folder / "study.toml")
        assert inside(study.results, folder)
        for session in study.sessions:
            assert inside(session.folder, folder)
            assert session.recording.startswith("synthetic:") or inside(
                Path(session.recording), folder
            )
    except LiexError as error:
        assert "\n" not in str(error)  # noqa: PT017


ARENAS = """
[[arenas]]
name = "left"
region = [[10.0, 20.0], [200.0, 20.0], [200.0, 300.0], [10.0, 300.0]]
[[arenas]]
name = "right"
region = { rectangle = [[210.0, 20.0], [400.0, 300.0]] }
set = { foreground.min_height_mm = 8.0 }
[[animals]]
id = "m01"
[[animals]]
id = "m02"
[[sessions]]
animal = "m01"
session = "01"
recording = "rawdata/both.mcap"
arena = "left"
[[sessions]]
animal = "m02"
session = "01"
recording = "rawdata/both.mcap"
arena = "right"
"""


def test_animals_in_several_arenas_of_one_recording_are_sessions_of_their_own(
    tmp_path: Path,
) -> None:
    left, right = study_of(ARENAS, tmp_path).sessions
    assert left.recording == right.recording
    assert left.folder != right.folder
    assert left.plan.arena.region is not None
    assert left.plan.arena.region.polygon is not None
    assert right.plan.arena.region is not None
    assert right.plan.arena.region.rectangle == [[210.0, 20.0], [400.0, 300.0]]
    assert (left.plan.foreground.min_height_mm, right.plan.foreground.min_height_mm) == (7.0, 8.0)
    assert (left.plan.session.subject_id, right.plan.session.subject_id) == ("m01", "m02")


PAIRS = """
set = { animal.spine_max_mm = 90 }
[[animals]]
id = "m01"
group = "wt"
[[animals]]
id = "m02"
group = "ko"
[[sessions]]
animals = ["m01", "m02"]
session = "01"
recording = "rawdata/box1.mcap"
"""


def test_the_animals_of_one_arena_are_sessions_that_are_measured_together(tmp_path: Path) -> None:
    wt, ko = study_of(PAIRS, tmp_path).sessions
    assert (wt.id, ko.id) == ("sub-m01_ses-01", "sub-m02_ses-01")
    assert [one.id for one in wt.together] == [one.id for one in ko.together] == [wt.id, ko.id]
    assert wt.plan.animal.count == ko.plan.animal.count == 2
    facts = [(one.plan.session.subject_id, one.plan.session.group) for one in (wt, ko)]
    assert facts == [("m01", "wt"), ("m02", "ko")]
    assert wt.folder != ko.folder


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('animals = ["m01", "m02"]', "", "should name its animal"),
        ('animals = ["m01", "m02"]', 'animal = "m01"\nanimals = ["m01", "m02"]', "should name"),
        ('["m01", "m02"]', '["m01"]', "at least 2"),
        ('["m01", "m02"]', '["m01", "m01"]', "two sessions"),
        ('["m01", "m02"]', '["m01", "m03"]', "not in"),
        ("animal.spine_max_mm = 90", "animal.count = 3", ""),
        (
            'animals = ["m01", "m02"]',
            'animal = "m01"\nset = { animal.count = 2 }',
            "animal.count is 2, and the session names 1; list the animals of the arena",
        ),
        ('group = "ko"', "set = { animal.spine_mm = 60 }", "their settings differ"),
        (
            "animal.spine_max_mm = 90",
            'animal.rfid = { readings = "r.csv", tags = ["a"], '
            "antennas = { A = { centre = [0, 0], radius = 40 } } }",
            "names the animals itself",
        ),
    ],
)
def test_a_slip_in_the_animals_of_one_arena_is_refused(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    assert old in PAIRS
    if not message:  # the number of names counts
        assert study_of(PAIRS.replace(old, new), tmp_path).sessions[1].plan.animal.count == 2
        return
    with pytest.raises(StudyError, match=message):
        read_whole(PAIRS.replace(old, new, 1), tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('arena = "right"', 'arena = "middle"', "in the arena middle, which is not in"),
        ('arena = "right"', 'arena = "left"', "two sessions are of the arena left"),
        ('name = "right"', 'name = "Left"', "the same name"),
        ("rectangle = [[210.0, 20.0], [400.0, 300.0]]", "unit = 'px'", "a region is one of"),
        ("[[arenas]]", 'set = { arenas = "auto" }\n[[arenas]]', "one arena"),
    ],
)
def test_a_slip_in_the_arenas_of_a_study_is_told(
    tmp_path: Path, old: str, new: str, says: str
) -> None:
    with pytest.raises(StudyError, match=says):
        read_whole(ARENAS.replace(old, new, 1), tmp_path)
