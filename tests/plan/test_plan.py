"""A plan survives its own file, and a mistake in one is told in a sentence that names the nearest
right thing.
"""

import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liex_lab.errors import PlanError
from liex_lab.plan import Plan, known_plans, plans_folder

words = st.text(st.characters(exclude_categories=["Cs"]), max_size=30)
lengths = st.floats(1e-3, 1e6)


@st.composite
def plans(draw: st.DrawFn) -> Plan:
    low, high = sorted(draw(st.lists(lengths, min_size=2, max_size=2, unique=True)))
    table: dict[str, Any] = {
        "seed": draw(st.integers(0, 2**40)),
        "animal": {"name": draw(words), "spine_min_mm": low, "spine_max_mm": high},
        "camera": {"cx": draw(st.floats(-1e4, 1e4)), "source": draw(words)},
        "recording": {"accept_truncated": draw(st.booleans())},
        "session": {
            "subject_id": draw(words),
            "session_start_time": draw(st.datetimes(timezones=st.timezones())),
        },
    }
    if draw(st.booleans()):
        table["animal"]["spine_mm"] = draw(lengths)
    return Plan.from_table(table)


@settings(max_examples=20)
@given(plan=plans())
def test_a_plan_survives_its_own_file(plan: Plan) -> None:
    text = plan.to_toml()
    again = Plan.from_toml(text)
    assert again == plan
    assert again.to_toml() == text


@pytest.mark.parametrize("name", known_plans())
def test_a_bundled_plan_is_the_file_that_the_program_would_write(name: str) -> None:
    """So every setting stands in it, with its comment. After adding one: liex info --plan NAME >
    the file.
    """
    assert (plans_folder() / f"{name}.toml").read_text(encoding="utf-8") == Plan.load(
        name
    ).to_toml()


def test_every_setting_says_what_it_means() -> None:
    for name, field in Plan.model_fields.items():
        inner = getattr(field.annotation, "model_fields", {"": field})
        for key, setting in inner.items():
            assert setting.description, f"{name}.{key}"


def test_settings_are_put_in_as_their_own_type() -> None:
    chosen = ["animal.spine_mm=65", "recording.accept_truncated=true", "session.subject_id=0123"]
    chosen += ["session.group = control A", "recording.topic=/depth", "seed=7"]
    plan = Plan.load("mouse").with_settings(chosen)
    assert plan.animal.spine_mm == 65.0
    assert plan.recording.accept_truncated is True
    assert plan.session.subject_id == "0123"
    assert plan.session.group == "control A"
    assert plan.recording.topic == "/depth"
    assert plan.seed == 7
    assert plan.with_settings(["animal.spine_mm="]).animal.spine_mm is None
    both = ["animal.spine_min_mm=200", "animal.spine_max_mm=300"]
    assert plan.with_settings(both).animal.spine_min_mm == 200.0, "checked together"
    assert Plan.load("mouse").animal.spine_mm is None, "a plan never changes"


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("camera.fxx=3", "nearest one is camera.fx"),
        ("camra.fx=3", "nearest one is [camera]"),
        ("camera.spine_mm=3", "nearest one is animal.spine_mm"),
        ("spine_mm=65", "nearest one is animal.spine_mm"),
        ("foreground.min_hieght_mm=9", "nearest one is foreground.min_height_mm"),
        ("seed.x=1", "nearest one is seed"),
        ("animal=3", "[animal] is a section"),
        ("animal.spine_mm=-4", "animal.spine_mm should be greater than 0, got -4"),
        ("animal.spine_mm=long", "animal.spine_mm should be a valid number, got 'long'"),
        ("animal.spine_mm=inf", "animal.spine_mm should be a finite number"),
        ("seed=1.5", "seed should be a valid integer, got 1.5"),
        ("recording.accept_truncated=1", "should be a valid boolean"),
        ("session.session_start_time=2026-08-21T10:00:00", "with a time zone"),
        ("animal.spine_min_mm=300", "should be below spine_max_mm"),
        ("animal.spine_mm", "key=value"),
        ("=4", "key=value"),
    ],
)
def test_a_wrong_setting_is_told_in_one_sentence(setting: str, says: str) -> None:
    with pytest.raises(PlanError) as caught:
        Plan().with_settings([setting])
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_mistake_in_a_file_names_the_file_and_a_wrong_name_the_known_plans(
    tmp_path: Path,
) -> None:
    path = tmp_path / "my.toml"
    path.write_text("[estimation]\nmodle = 'mouse'\n")
    for plan, says in (
        (path, r"my\.toml: estimation\.modle is not .* nearest one is estimation\.model"),
        ("moose", "did you mean 'mouse'"),
        (tmp_path / "nothing.toml", r"bundled are: .*mouse"),
    ):
        with pytest.raises(PlanError, match=says):
            Plan.load(plan)


@pytest.mark.parametrize("content", [b"[animal\n", b"\xff\xfe\x00", b"\x89PNG\r\n"])
def test_a_file_that_is_no_toml_is_told_in_a_sentence(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "plan.toml"
    path.write_bytes(content)
    with pytest.raises(PlanError, match="should be a TOML"):
        Plan.load(path)


def test_a_missing_line_has_its_default() -> None:
    assert Plan.from_toml("[animal]\nspine_mm = 65") == Plan().with_settings(["animal.spine_mm=65"])
    assert "spine_mm" not in tomllib.loads(Plan().to_toml())["animal"]


def test_the_behaviour_section_holds_the_rules_of_the_mouse() -> None:
    from liex_lab.behaviour.bouts import MouseRules

    assert MouseRules(**Plan().behaviour.model_dump()) == MouseRules()


SEVERAL = """
[[arenas]]
name = "left"
region = [[10, 20], [200, 20], [200, 300]]
subject_id = "m01"
[[arenas]]
name = "right"
region = { circle = { centre = [100.0, 0.0], radius = 80.0 }, unit = "mm" }
"""


def test_several_arenas_survive_their_own_file() -> None:
    plan = Plan.from_toml(SEVERAL)
    assert plan.arenas is not None
    assert plan.arenas != "auto"
    assert [one.name for one in plan.arenas] == ["left", "right"]
    assert Plan.from_toml(plan.to_toml()) == plan
    auto = Plan().with_settings(["arenas=auto"])
    assert auto.arenas == "auto"
    assert Plan.from_toml(auto.to_toml()) == auto


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"right"', '"Left"', "two [[arenas]] are called left"),
        ('"right"', '"../right"', "arenas.1.name"),
        ("radius = 80.0", "radius = -1", "greater than 0"),
        ('unit = "mm"', "rectangle = [[0, 0], [9, 9]]", "a region is one of polygon"),
        ("[[arenas]]", "[arena]\nregion = [[1, 2], [9, 2], [9, 9]]\n[[arenas]]", "leave one"),
    ],
)
def test_a_slip_in_several_arenas_is_told_in_one_sentence(old: str, new: str, says: str) -> None:
    with pytest.raises(PlanError) as caught:
        Plan.from_toml(SEVERAL.replace(old, new, 1))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
