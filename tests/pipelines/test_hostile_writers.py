"""Every writer of the program, with names that want it to write elsewhere: what lies outside of the
folder that the user named stays as it is.
"""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from liex_lab.dashboards.replay.layouts import write_blueprint, write_layout
from liex_lab.dashboards.report.report import write_report
from liex_lab.pipelines.compare import compare_groups
from liex_lab.pipelines.correct import correct_session

from liex_lab.errors import PlaceError, SessionError
from liex_lab.exchange import TARGETS, export
from liex_lab.plan import Plan
from liex_lab.runtime.durable import inside, locked, safe_name, take_lock
from liex_lab.sessions import Session
from liex_lab.sessions.corrections import BoutEdit, Description
from liex_lab.sessions.folder import describe_failure, write_failure
from liex_lab.sessions.session import video_path
from tests.hostile_names import NAMES
from tests.sessions.walking_mouse import WalkingMouse, steady, write

MOUSE = WalkingMouse(steady(0.5))
# `python -m tests.campaign names` has every writer meet all of them
_THOROUGH = "LIEX_ALL_NAMES" in os.environ
_SOME = NAMES if _THOROUGH else NAMES[::44]
_OPENED = [name for name in NAMES if name != "nul\0byte" and "\ud800" not in name]


def contents(root: Path) -> dict[str, bytes | str]:
    """Everything below a folder: bytes of files, targets of links."""
    return {
        str(path.relative_to(root)): str(path.readlink())
        if path.is_symlink()
        else path.read_bytes()
        if path.is_file()
        else ""
        for path in root.rglob("*")
    }


@contextmanager
def nothing_beside(root: Path, *but: Path) -> Iterator[None]:
    """Fail if anything below a folder changes, but for these folders."""

    def others() -> dict[str, bytes | str]:
        own = [str(path.relative_to(root)) for path in but]
        return {
            name: content
            for name, content in contents(root).items()
            if not any(name == one or name.startswith(f"{one}/") for one in own)
        }

    before = others()
    yield
    assert others() == before


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Session:
    folder = tmp_path_factory.mktemp("measured") / "circle.liex"
    subject = {"subject_id": "m01", "group": "control"}
    return write(folder, MOUSE, plan_toml=Plan.load("mouse").to_toml(), subject=subject)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A folder a/b/out for what is written, and what must not be touched around it."""
    (tmp_path / "a" / "b" / "out").mkdir(parents=True)
    for folder in ("prec", "a/prec", "a/b/prec"):
        for ending in ("", ".nwb", ".boris", "_dlc", ".nc", ".analysis.h5", "_csv", ".liex"):
            (tmp_path / folder).mkdir(exist_ok=True)
            (tmp_path / folder / f"precious{ending}").write_text("kept")
    return tmp_path


def renamed(measured: Session, to: Path, **facts: Any) -> Session:
    """A copy of a session whose session.json says something else, as one of another lab may."""
    shutil.copytree(measured.path, to)
    document = json.loads((to / "session.json").read_text())
    (to / "session.json").write_text(json.dumps(document | facts))
    return Session.open(to)


@pytest.mark.parametrize("name", NAMES if _THOROUGH else NAMES[::12])
def test_exports_stay_in_their_folder(name: str, measured: Session, root: Path) -> None:
    out = root / "a" / "b" / "out"
    facts = {"session_id": name, "individual": name}
    if name == "nul\0byte" or "\ud800" in name:  # such a session is not even opened
        with pytest.raises(SessionError, match="damaged"):
            renamed(measured, root / "a" / "b" / "s.liex", **facts)
        return
    session = renamed(measured, root / "a" / "b" / "s.liex", **facts)
    with nothing_beside(root, out):
        for to in ("boris", "csv"):
            assert export(session, to, out, overwrite=True).parent == out
    assert len(list(out.iterdir())) == 2


@pytest.mark.parametrize("to", [to for to in TARGETS if to != "mabe"])
@pytest.mark.parametrize("name", _OPENED if _THOROUGH else ["../../prec/precious"])
def test_every_format_stays_in_its_folder(
    name: str, to: str, measured: Session, root: Path
) -> None:
    out = root / "a" / "b" / "out"
    facts = {"session_start_time": "2026-08-21T10:00:00+02:00"}
    session = renamed(measured, root / "a" / "b" / "s.liex", session_id=name, **facts)
    with nothing_beside(root, out):
        assert export(session, to, out, overwrite=True).parent == out


@pytest.mark.nightly
@pytest.mark.parametrize("name", _SOME)
def test_sessions_reports_corrections_and_comparisons_stay_in_theirs(name: str, root: Path) -> None:
    out = root / "a" / "b" / "out"
    # what no file can say is refused elsewhere
    text = name.encode(errors="ignore").decode().replace("\0", "")
    subject = {"subject_id": text, "group": text, "cage": text}
    with nothing_beside(root, out):
        skeleton = MOUSE.skeleton
        mouse = replace(MOUSE, skeleton=replace(skeleton, names=(text, *skeleton.names[1:])))
        session = write(
            inside(out, name, ".liex"),
            mouse,
            name=text,
            individual=text,
            subject=subject,
            plan_toml=Plan.load("mouse").to_toml(),
        )
        assert session.path.parent == out
        write_report(session.path)
        write_blueprint(session)
        write_layout(session)
        word = BoutEdit("add", text or "x", int(MOUSE.times_ns[2]), int(MOUSE.times_ns[9]))
        correct_session(session.path, [word, Description("group", text)], author=text, report=False)
        other = replace(MOUSE, speed_mm_s=150.0)
        write(out / "other.liex", other, name="other", subject={"subject_id": "b", "group": "b"})
        try:
            compare_groups([out], out / "compared", ["mean_speed_mm_s"], figures=False)
        except SessionError:
            assert not text.strip() or text == "b"  # one group only
        write_failure(out / "failed", describe_failure(ValueError(text), text, 3))
    assert {path.name for path in out.iterdir()} <= {
        session.path.name,
        "other.liex",
        "compared",
        "failed",
    }


@pytest.mark.parametrize("name", NAMES)
def test_figures_and_videos_stay_in_their_folder(name: str, tmp_path: Path) -> None:
    from liex_lab.dashboards.figures.sets import put_figure

    out = tmp_path / "out"
    assert put_figure(out, f"{name}.svg", b"<svg/>").parent == out
    assert len(list(out.iterdir())) == 1
    for what in ("", name):
        place = video_path(out, name, what)
        assert place.parent == out
        assert place.name == safe_name(place.name)


@pytest.mark.nightly
def test_no_writer_follows_a_link_in_its_folder(measured: Session, root: Path) -> None:
    out = root / "a" / "b" / "out"
    precious = root / "prec" / "precious"
    session = renamed(measured, out / "s.liex", individual="m")
    slower = replace(MOUSE, speed_mm_s=150.0)
    other = write(out / "t.liex", slower, name="t", subject={"subject_id": "m02", "group": "b"})
    word = BoutEdit("add", "x", int(MOUSE.times_ns[2]), int(MOUSE.times_ns[9]))
    compared = out / "compared"
    compared.mkdir()
    writers: dict[Path, Callable[[], object]] = {
        session.path / "report.html": lambda: write_report(session.path),
        session.path / "replay.rbl": lambda: write_blueprint(session),
        session.path / "foxglove.json": lambda: write_layout(session),
        session.path / ".correcting": lambda: correct_session(session.path, [word], report=False),
        session.path / "corrected": lambda: correct_session(session.path, [word], report=False),
        session.path / "corrected.part": lambda: correct_session(
            session.path, [word], report=False
        ),
        session.path / "corrected.old": lambda: correct_session(session.path, [word], report=False),
        out / ".lock": lambda: take_lock(out / ".lock"),
        out / "new.liex": lambda: write(out / "new.liex", MOUSE),
        out / "new.liex.part": lambda: write(out / "new.liex", MOUSE),
        out / "new.liex.old": lambda: write(out / "new.liex", MOUSE),
        out / "fail": lambda: write_failure(out / "fail", {}),
        compared / "columns.json": lambda: compare_groups(
            [session.path, other.path], compared, ["mean_speed_mm_s"], figures=False
        ),
        **{
            out / f"circle{ending}": partial(export, session, to, out, overwrite=True)
            for to, (_, ending, _) in TARGETS.items()
            if to not in ("nwb", "mabe")
        },
    }
    for place, writer in writers.items():
        for target in (precious, root / "nothing"):
            before = contents(root / "prec")
            if place.is_file():
                place.unlink()
            place.symlink_to(target)
            with pytest.raises(PlaceError, match="symbolic link"):
                writer()
            assert contents(root / "prec") == before
            assert not (root / "nothing").exists()
            place.unlink()


def test_a_link_inside_an_unfinished_session_or_its_corrections_is_refused(
    measured: Session, root: Path
) -> None:
    out = root / "a" / "b" / "out"
    part = out / "new.liex.part"
    part.mkdir()
    (part / "session.json").symlink_to(root / "prec" / "precious")
    with pytest.raises(PlaceError, match=r"session\.json"):
        write(out / "new.liex", MOUSE)
    session = renamed(measured, out / "s.liex", individual="m")
    word = BoutEdit("add", "x", int(MOUSE.times_ns[2]), int(MOUSE.times_ns[9]))
    correct_session(session.path, [word], report=False)
    (session.path / "corrected" / "bouts.parquet").unlink()
    (session.path / "corrected" / "bouts.parquet").symlink_to(root / "prec" / "precious")
    with pytest.raises(PlaceError, match=r"bouts\.parquet"):
        correct_session(session.path, [word], report=False)
    assert (root / "prec" / "precious").read_text() == "kept"


def test_a_lock_is_taken_and_given_back_as_before(tmp_path: Path) -> None:
    with locked(tmp_path / ".lock", "it is busy"):
        assert take_lock(tmp_path / ".lock") is None
    assert not list(tmp_path.iterdir())
