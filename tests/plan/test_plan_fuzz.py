"""Whatever a plan says, it is read or refused in one sentence; and what was found so is
kept here.
"""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from liex_lab.body.skeleton import Skeleton
from liex_lab.errors import LiexError
from liex_lab.plan import Plan
from liex_lab.plan.study import Study
from liex_lab.scene.zones import read_zones

_WHOLE = Plan().model_dump()
_WORDS = st.sampled_from(
    [*_WHOLE, *(key for section in _WHOLE.values() if isinstance(section, dict) for key in section)]
)
_LEAVES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=12),
    st.datetimes(),
    st.dates(),
    st.sampled_from(["../x", "/etc/passwd", "mouse", "\0", "2026-08-21T10:00:00+02:00", "=1+1"]),
)
_TABLES = st.recursive(
    _LEAVES,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(_WORDS | st.text(max_size=6), inner, max_size=4)
    ),
    max_leaves=15,
)


def check(read: Any) -> None:
    try:
        plan = read()
        assert Plan.from_toml(plan.to_toml()) == plan
        assert not plan.session.name or not set(plan.session.name) & {"/", "\\", "\0"}
    except LiexError as error:
        assert "\n" not in str(error), str(error)  # noqa: PT017


@settings(max_examples=20, deadline=None)
@given(table=st.dictionaries(_WORDS | st.text(max_size=6), _TABLES, max_size=5))
def test_whatever_a_plan_says_it_is_read_or_refused_in_one_sentence(table: dict[str, Any]) -> None:
    check(lambda: Plan.from_table(table))


@settings(max_examples=20, deadline=None)
@given(text=st.text(max_size=60))
def test_whatever_a_plans_text_is_it_is_read_or_refused_in_one_sentence(text: str) -> None:
    check(lambda: Plan.from_toml(text))


@settings(max_examples=20, deadline=None)
@given(
    key=_WORDS | st.text(max_size=10),
    section=_WORDS | st.text(max_size=10),
    value=st.text(max_size=20),
)
def test_whatever_is_set_on_the_command_line_it_is_read_or_refused(
    key: str, section: str, value: str
) -> None:
    check(lambda: Plan().with_settings([f"{section}.{key}={value}"]))


@pytest.mark.parametrize("name", ["../x", "a/b", "", ".hidden", "a\\b", "=cmd", "x" * 300, "a\nb"])
def test_a_session_name_stays_in_its_folder(name: str) -> None:
    with pytest.raises(LiexError, match="name"):
        Plan.from_table({"session": {"name": name}})


def test_a_deeply_nested_file_is_refused(tmp_path: Path) -> None:
    deep = "a = " + "[" * 5000 + "]" * 5000
    (tmp_path / "deep.toml").write_text(deep)
    for read in (Plan.load, Study.load, read_zones, Skeleton.load):
        with pytest.raises(LiexError, match="TOML"):
            read(tmp_path / "deep.toml")
    with pytest.raises(LiexError):
        Plan().with_settings([f"camera.{deep}"])
