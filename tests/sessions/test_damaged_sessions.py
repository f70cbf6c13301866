"""Whatever is in a session's folder, reading it gives an answer or one sentence, and never leaves
the folder.
"""

import json
import shutil
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from liex_lab.errors import LiexError, SessionError
from liex_lab.sessions import Session
from liex_lab.sessions.checkpoint import LOGS, Checkpoint
from liex_lab.sessions.evidence import read_evidence, read_flips, write_evidence
from liex_lab.sessions.folder import read_failure
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.track import Subject
from tests.damage import ANYTHING, check, damage
from tests.sessions.walking_mouse import WalkingMouse, steady, write

READS: list[Callable[[Session], Any]] = [
    lambda s: s.name,
    lambda s: s.frames,
    lambda s: s.poses,
    lambda s: s.bouts,
    lambda s: s.summary,
    lambda s: s.columns,
    lambda s: s.camera,
    lambda s: s.T_arena_camera,
    lambda s: s.arena,
    lambda s: s.zones,
    lambda s: s.plan,
    read_evidence,
    read_flips,
]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = write(
        tmp_path_factory.mktemp("whole") / "circle.liex",
        WalkingMouse(steady(1.0)),
        individual="=1+1",
    ).path
    add_evidence(path)
    return path


@pytest.fixture(scope="module")
def copy(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(whole, tmp_path_factory.mktemp("copy") / "circle.liex"))


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return begun(tmp_path_factory.mktemp("begun"))


def add_evidence(folder: Path) -> None:
    """Put observations.npz into a session."""
    mouse = WalkingMouse(steady(1.0))
    subject = Subject(
        mouse.skeleton, mouse.camera, mouse.T_arena_camera, 90.0, 5.0, 0.5, (1.0,) * 5
    )
    write_evidence(folder, Observations.empty(mouse.skeleton, mouse.times_ns), subject)


def begun(folder: Path) -> Path:
    """An unfinished session of two checkpoints."""
    held = Checkpoint(folder / "x.part", FACTS)
    for log in LOGS:
        (held.folder / log).write_bytes(b"0123456789")
    held.columns.append({"a": np.arange(6.0).reshape(3, 2), "b": np.arange(3)})
    held.save(3, 1.0, 8, 8)
    held.leave(keep=True)
    return folder / "x.part"


FACTS = {"n_frames": 3}


def read_all(folder: Path) -> None:
    """Every door of a session: an answer, or a sentence."""
    try:
        session = Session.open(folder)
    except LiexError as error:
        assert "\n" not in str(error)  # noqa: PT017
        return
    for read in READS:
        check(partial(read, session))


@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_any_value_anywhere_in_session_json(whole: Path, copy: Path, data: st.DataObject) -> None:
    document = json.loads((whole / "session.json").read_text())
    damage(document, data)
    (copy / "session.json").write_text(json.dumps(document))
    read_all(copy)


@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    name=st.sampled_from(
        [
            "frames.parquet",
            "bouts.parquet",
            "summary.csv",
            "columns.json",
            "plan.toml",
            "observations.npz",
        ]
    ),
    data=st.data(),
)
def test_any_byte_anywhere_in_its_files(
    whole: Path, copy: Path, name: str, data: st.DataObject
) -> None:
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


@settings(
    max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(name=st.sampled_from(["checkpoint.json", "seen/columns.json"]), data=st.data())
def test_any_value_anywhere_in_an_unfinished_session(
    part: Path, name: str, data: st.DataObject
) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(shutil.copytree(part, Path(scratch) / "x.part"))
        document = json.loads((copy / name).read_text())
        damage(document, data)
        (copy / name).write_text(json.dumps(document))
        held = Checkpoint(copy, FACTS)  # it goes on, or begins anew
        n = held.state.n_frames
        assert n in (0, 3) or name == "checkpoint.json"
        assert all(len(values) >= n for values in held.columns.read().values())
        for log in (held.replay, held.folder / "session.mcap"):
            log.touch()
        held.save(n + 1, held.seconds_before + 1.0, 0, 0)
        held.leave(keep=False)


@settings(max_examples=25, deadline=None)
@given(document=ANYTHING)
def test_any_json_instead_of_a_failure(document: Any) -> None:
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "failed.json").write_text(json.dumps(document))
        found = read_failure(Path(folder))
        assert found is not None
        assert isinstance(found["reason"], str)


@pytest.mark.parametrize(
    "file", ["../../../etc/passwd", "/etc/passwd", "session.rrd", "thumbnails/../../x.png"]
)
def test_a_picture_outside_of_the_session_is_refused(
    whole: Path, tmp_path: Path, file: str
) -> None:
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
