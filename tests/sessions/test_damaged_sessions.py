"""Whatever is in a session's folder, reading it gives an answer or one sentence, and never leaves the folder."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from liex_lab.errors import LiexError, SessionError
from liex_lab.sessions import Session
from tests.sessions.walking_mouse import WalkingMouse, steady, write

READS: list[Callable[[Session], Any]] = [
    lambda s: s.name, lambda s: s.frames, lambda s: s.poses, lambda s: s.bouts, lambda s: s.summary,
    lambda s: s.columns, lambda s: s.camera, lambda s: s.T_arena_camera, lambda s: s.arena, lambda s: s.zones,
    lambda s: s.plan,
]  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("whole") / "circle.liex", WalkingMouse(steady(1.0)), individual="=1+1").path


@pytest.fixture(scope="module")
def copy(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(whole, tmp_path_factory.mktemp("copy") / "circle.liex"))


def read_all(folder: Path) -> None:
    """Every door of a session: an answer, or a sentence."""
    try:
        session = Session.open(folder)
    except LiexError as error:
        assert "\n" not in str(error)  # noqa: PT017
        return
    for read in READS:
        try:
            read(session)
        except LiexError as error:
            assert "\n" not in str(error)  # noqa: PT017


_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3), max_leaves=8,
)  # fmt: skip


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_value_anywhere_in_session_json(whole: Path, copy: Path, data: st.DataObject) -> None:
    document = json.loads((whole / "session.json").read_text())
    place, keys = document, list(document)
    while keys:
        key = data.draw(st.sampled_from(keys))
        inner = place[key]
        if not isinstance(inner, dict) or not inner or data.draw(st.booleans()):
            place[key] = data.draw(_JSON)
            break
        place, keys = inner, list(inner)
    (copy / "session.json").write_text(json.dumps(document))
    read_all(copy)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(["frames.parquet", "bouts.parquet", "summary.csv", "columns.json", "plan.toml"]),
       data=st.data())  # fmt: skip
def test_any_byte_anywhere_in_its_files(whole: Path, copy: Path, name: str, data: st.DataObject) -> None:
    content = bytearray((whole / name).read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        content[at] = data.draw(st.integers(0, 255))
    else:
        del content[at:]
    (copy / "session.json").write_bytes((whole / "session.json").read_bytes())
    (copy / name).write_bytes(bytes(content))
    read_all(copy)
    (copy / name).write_bytes((whole / name).read_bytes())


@pytest.mark.parametrize("file", ["../../../etc/passwd", "/etc/passwd", "session.rrd", "thumbnails/../../x.png"])
def test_a_picture_outside_of_the_session_is_refused(whole: Path, tmp_path: Path, file: str) -> None:
    folder = Path(shutil.copytree(whole, tmp_path / "x.liex"))
    document = json.loads((folder / "session.json").read_text())
    document["thumbnails"][0]["file"] = file
    (folder / "session.json").write_text(json.dumps(document))
    with pytest.raises(SessionError, match="damaged"):
        Session.open(folder)


def test_a_name_that_is_a_formula_is_none_in_a_spreadsheet(whole: Path) -> None:
    row = (whole / "summary.csv").read_text().splitlines()[1]
    assert row.split(",")[1] == "'=1+1"
    assert Session.open(whole).summary["individual"].tolist() == ["=1+1"]
    assert "=1+1" in (whole / "session.json").read_text()
