"""The region of an arena in a study's plans, or beside a session: stated, changed, taken out."""

from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.region_config import StatedRegions

from liex_lab.errors import LiexError
from liex_lab.plan import Plan
from liex_lab.plan.study import Study
from liex_lab.scene.zones import read_zones
from liex_lab.sessions import Session
from tests.sessions.walking_mouse import WalkingMouse, steady, write

BOX = [[10.0, 8.0], [90.0, 9.5], [88.0, 70.0], [12.0, 66.0]]
STUDY = """\
# spring   (kept)
plan = "mouse"

[[animals]]
id = "m01"
[[animals]]
id = "m02"  # the small one

[[sessions]]
animal = "m01"
session = "01"
recording = "synthetic:walk?frames=30&sensor=primesense-qvga"  # made up

[[sessions]]
animal = "m02"
session = "01"
recording = "synthetic:walk?frames=30&sensor=primesense-qvga"
"""
KEY = "sub-m02_ses-01"


@pytest.fixture(scope="module")
def walker(tmp_path_factory: pytest.TempPathFactory) -> Session:
    mouse = WalkingMouse(steady(1.0))
    plan = "# a note\n" + Plan.load("mouse").to_toml()
    return write(
        tmp_path_factory.mktemp("results") / "walker.liex", mouse, name="walker", plan_toml=plan
    )


@pytest.fixture
def study(tmp_path: Path) -> Path:
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path / "study.toml"


def regions_of(study: Path) -> list[object]:
    found = [one.plan.arena.region for one in Study.load(study).sessions]
    return [None if one is None else one.polygon for one in found]


def test_a_region_of_the_study_is_that_of_every_recording_and_no_comment_is_lost(
    study: Path, walker: Session
) -> None:
    stated = StatedRegions(study)
    about = stated.about(KEY, walker)
    assert [one["name"] for one in about["places"]] == ["all", "recording"]
    assert (about["place"], about["region"]) == ("all", None)
    said = stated.save(KEY, walker, "all", BOX, None)
    assert "liex cohort" in said
    assert regions_of(study) == [BOX, BOX]
    assert stated.about(KEY, walker)["region"] == BOX
    smaller = [*BOX[:2], [60.0, 60.0]]
    stated.save(KEY, walker, "recording", smaller, None)
    assert regions_of(study) == [BOX, smaller]
    text = study.read_text()
    assert set(STUDY.splitlines()) <= set(text.splitlines())
    with pytest.raises(LiexError, match="which would go before this one"):
        stated.save(KEY, walker, "all", smaller, BOX)
    assert study.read_text() == text
    stated.save(KEY, walker, "recording", None, smaller)
    stated.save(KEY, walker, "all", None, BOX)
    assert regions_of(study) == [None, None]
    assert set(STUDY.splitlines()) <= set(study.read_text().splitlines())


def test_a_plan_that_the_study_names_and_an_arena_of_several_are_changed_where_they_stand(
    study: Path, walker: Session
) -> None:
    own = study.with_name("own.toml")
    own.write_text(Plan.load("mouse").to_toml())
    study.write_text(STUDY.replace('"mouse"', '"own.toml"'))
    StatedRegions(study).save(KEY, walker, "all", BOX, None)
    assert Plan.load(own).arena.region is not None
    assert regions_of(study) == [BOX, BOX]
    arena = '[[arenas]]\nname = "left"\nregion = { circle = { centre = [50, 40], radius = 20 } }\n'
    study.write_text(STUDY + 'arena = "left"\n' + arena)
    stated = StatedRegions(study)
    about = stated.about(KEY, walker)
    assert about["place"] == "arena"
    assert np.hypot(*(np.array(about["region"]) - [50, 40]).T) == pytest.approx(20.0, abs=0.1)
    stated.save(KEY, walker, "arena", BOX, about["places"][0]["stated"])
    assert regions_of(study) == [None, BOX]
    with pytest.raises(LiexError, match="arenas"):
        stated.save(KEY, walker, "arena", None, stated.about(KEY, walker)["places"][0]["stated"])


def test_a_session_of_no_study_gets_a_plan_beside_it_that_a_run_takes(
    tmp_path: Path, walker: Session
) -> None:
    stated = StatedRegions(walker.path.parent)
    file = walker.path.with_name("walker.plan.toml")
    said = stated.save("walker", walker, "beside", BOX, None)
    assert f"--plan {file}" in said
    plan = Plan.load(file)
    assert plan == Plan.from_toml(walker.plan).with_settings([f"arena.region={BOX}"])
    assert "# a note" in file.read_text()
    assert stated.about("walker", walker)["region"] == BOX
    file.unlink()


@pytest.mark.parametrize(
    ("corners", "why"),
    [
        ([[10, 10], [90, 60], [90, 10], [10, 60]], "sides 1 and 3 of its polygon cross"),
        ([[500, 10], [600, 10], [600, 90]], "lies outside the image"),
        ([[10, 10], [11, 10], [11, 11]], "too few to hold an arena"),
        ([[10, 10], [90, 10]], "three or more corners"),
        ([[10, 10], [90, 10], [90]], "region"),
        ([[10, 10], [90, 10], [90, float("nan")]], "finite"),
        ([["a", 10], [90, 10], [90, 60]], "region"),
        ({"circle": 3}, "list of at most 200 corners"),
        ([[1, 2]] * 201, "list of at most 200 corners"),
    ],
)
def test_what_is_no_region_is_a_sentence_and_the_file_stays(
    study: Path, walker: Session, corners: object, why: str
) -> None:
    with pytest.raises(LiexError, match=why):
        StatedRegions(study).save(KEY, walker, "all", corners, None)
    assert study.read_text() == STUDY
    assert [path.name for path in study.parent.iterdir()] == ["study.toml"]


def test_what_changed_meanwhile_or_is_a_link_is_not_overwritten(
    study: Path, walker: Session
) -> None:
    stated = StatedRegions(study)
    with pytest.raises(LiexError, match="was changed since this page was opened"):
        stated.save(KEY, walker, "all", BOX, [[1.0, 2.0]])
    with pytest.raises(LiexError, match="there is no place"):
        stated.save(KEY, walker, "elsewhere", BOX, None)
    kept = study.rename(study.with_name("kept.toml"))
    study.symlink_to(kept)
    with pytest.raises(LiexError, match="link"):
        stated.save(KEY, walker, "all", BOX, None)
    assert kept.read_text() == STUDY


def test_a_recording_that_was_not_measured_is_seen_whole_and_gets_a_region(study: Path) -> None:
    stated = StatedRegions(study)
    depth, camera = stated.depth_image(KEY)
    assert depth.shape == (camera.height, camera.width)
    assert (depth > 0).mean() > 0.8
    stated.save(KEY, None, "recording", BOX, None)
    assert regions_of(study) == [None, BOX]
    study.write_text(
        STUDY
        + '[sessions.set.arena.region]\ncircle = { centre = [0, 0], radius = 90 }\nunit = "mm"\n'
    )
    about = stated.about(KEY, None)
    assert about["region"] is None
    assert "millimetres on the floor" in about["message"]


def test_zones_are_drawn_for_a_whole_study_and_taken_out_again(
    study: Path, walker: Session
) -> None:
    stated = StatedRegions(study)
    said = stated.save_zone(KEY, walker, "nest", "centre", BOX)
    assert "zones.toml holds the zone nest" in said
    file = study.with_name("zones.toml")
    file.write_text("# mine\n" + file.read_text())
    stated.save_zone(KEY, walker, "ball", "nose", BOX)
    stated.save_zone(KEY, walker, "nest", "tail_base", BOX)
    assert [(one.name, one.part, one.unit) for one in read_zones(file)] == [
        ("ball", "nose", "px"),
        ("nest", "tail_base", "px"),
    ]
    assert file.read_text().startswith("# mine")
    plans = [one.plan.arena.zones for one in Study.load(study).sessions]
    assert [Path(str(one)).resolve() for one in plans] == [file.resolve()] * 2
    assert [one["name"] for one in stated.about(KEY, walker)["zones"]] == ["ball", "nest"]
    for wrong, why in (("9 b", "letters, digits"), ("x", "arena.region|corners")):
        with pytest.raises(LiexError, match=why):
            stated.save_zone(KEY, walker, wrong, "nose", BOX if wrong != "x" else BOX[:2])
    for name in ("ball", "nest"):
        stated.save_zone(KEY, walker, name, "nose", None)
    assert [one.plan.arena.zones for one in Study.load(study).sessions] == [None, None]
    assert set(STUDY.splitlines()) <= set(study.read_text().splitlines())
    assert not stated.about(KEY, walker)["zones"]


def test_a_session_of_no_study_gets_its_zones_beside_it(walker: Session) -> None:
    stated = StatedRegions(walker.path.parent)
    stated.save_zone("walker", walker, "nest", "centre", BOX)
    file, plan = (walker.path.with_name(f"walker.{one}.toml") for one in ("zones", "plan"))
    assert [one.name for one in read_zones(str(Plan.load(plan).arena.zones))] == ["nest"]
    file.unlink()
    plan.unlink()
