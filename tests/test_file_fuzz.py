"""Whatever is in the small files that a plan or a study names, it is read or refused in one
sentence.
"""

import copy
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from liex_lab.pipelines.study.cluster import SlurmTable

from liex_lab.body.shape import Surface
from liex_lab.body.skeleton import PRESETS, Skeleton
from liex_lab.scene.zones import read_zones
from tests.damage import ANYTHING, check, damage

_MOUSE = tomllib.loads((PRESETS / "mouse.toml").read_text(encoding="utf-8"))
_PARTS = st.sampled_from(
    [
        "[[zones]]",
        "[zones]",
        "name",
        "=",
        '"a"',
        "circle",
        "{ centre = [0, 0], radius = 80 }",
        "polygon",
        "\n",
        "[[0,0],[9,0],[9,9]]",
        "[[0,0],[1,1],[2,2]]",
        "unit",
        '"px"',
        "1e400",
        "nan",
        "relative_to",
        '"centre"',
        "[",
        "]",
        "{",
        "}",
        "-1",
        "jobs",
        "cores_per_job",
        "memory",
        "prologue",
        '["x"]',
        "99999999999999999999",
    ]
)
_TEXTS = st.lists(_PARTS, max_size=14).map(" ".join) | st.text(max_size=40)


def reading(read: Any, text: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.toml"
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        check(lambda: read(path))


@settings(max_examples=30, deadline=None)
@given(text=_TEXTS)
def test_any_text_instead_of_zones(text: str) -> None:
    reading(read_zones, text)


@settings(max_examples=30, deadline=None)
@given(text=_TEXTS)
def test_any_text_instead_of_a_slurm_file(text: str) -> None:
    reading(SlurmTable.load, text)


def skeleton_of(table: dict[str, Any]) -> None:
    """A skeleton and the body about it, as a run makes them of a user's file."""
    skeleton = Skeleton.from_table(table, "a.toml")
    Surface.of(skeleton)
    assert skeleton.length > 0


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_any_value_anywhere_in_a_skeleton(data: st.DataObject) -> None:
    table = copy.deepcopy(_MOUSE)
    for _ in range(data.draw(st.integers(1, 2))):
        damage(table, data)
        if not table:
            break
    check(lambda: skeleton_of(table))


@settings(max_examples=20, deadline=None)
@given(joints=ANYTHING, surface=ANYTHING, view=ANYTHING)
def test_any_table_instead_of_a_skeleton(joints: Any, surface: Any, view: Any) -> None:
    check(lambda: skeleton_of({"name": "x", "joints": joints, "surface": surface, "view": view}))
    check(lambda: skeleton_of({**_MOUSE, "surface": surface}))
    check(lambda: skeleton_of({**_MOUSE, "view": view}))


@pytest.mark.parametrize("text", ["[[zones]]\nname = 3", "zones = 3", ""])
def test_zones_that_are_none_are_told(text: str) -> None:
    reading(read_zones, text)
