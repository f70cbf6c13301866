"""Writers that are killed while a session takes the place of another one: corrections stay."""

import os
import shutil
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.correct import correct_session
from liex_lab.pipelines.verify import verify_session

from liex_lab import behaviour
from liex_lab.plan import Plan
from liex_lab.sessions import Session, SessionWriter
from liex_lab.sessions import correcting as ask
from liex_lab.sessions.corrections import read_log
from liex_lab.sessions.folder import put_back_session, set_outdated, taken_from, write_failure
from tests.sessions.kills import check_order, killed_at, recorded
from tests.sessions.walking_mouse import WalkingMouse, write

MOUSE = WalkingMouse(np.arange(12) / 30.0)
TOML = Plan.load("mouse").to_toml()


@pytest.fixture(scope="module")
def corrected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = write(tmp_path_factory.mktemp("older") / "circle.liex", MOUSE, plan_toml=TOML).path
    return groom(place, 0.1)


@pytest.fixture
def place(corrected: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A corrected session, on a disk that takes no time to synchronise."""
    monkeypatch.setattr(os, "fsync", lambda file: None)
    return Path(shutil.copytree(corrected, tmp_path / "circle.liex"))


def groom(place: Path, start_s: float) -> Path:
    edit = ask.add_bout(Session.open(place), "groom", start_s, start_s + 0.05, new_word=True)
    return correct_session(place, [edit], report=False)


def again(place: Path) -> Session:
    return write(place, MOUSE, plan_toml=TOML, overwrite=True)


def check_whole(place: Path, n: int = 1) -> None:
    """The session is there, reads whole, and has so many corrections."""
    session = Session.open(place)
    assert len(session.log.standing) == n
    assert "groom" in set(session.bouts["action"])
    assert len(session.poses) == 5 * len(MOUSE.times_s)
    assert not [found for found in verify_session(place) if found.state == "wrong"]


@pytest.mark.parametrize("by", ["reading", "measuring", "correcting"])
def test_a_session_that_was_put_aside_is_put_back(place: Path, by: str) -> None:
    place.rename(place.with_name("circle.liex.old"))  # killed between the two renames
    if by == "measuring":
        again(place)
    elif by == "correcting":
        groom(place, 0.2)
    check_whole(place, 2 if by == "correcting" else 1)
    assert [path.name for path in place.parent.iterdir()] == ["circle.liex"]


def test_a_session_that_was_put_aside_is_not_overwritten_unasked(place: Path) -> None:
    place.rename(place.with_name("circle.liex.old"))
    with pytest.raises(Exception, match="exists already"):
        write(place, MOUSE, plan_toml=TOML)
    check_whole(place)


def test_nothing_is_put_back_while_a_writer_is_at_work(place: Path) -> None:
    with SessionWriter(place, MOUSE.provenance(), overwrite=True) as writer:
        old = place.with_name("circle.liex.old")
        place.rename(old)
        assert not put_back_session(place)
        assert old.is_dir()
        writer.add([MOUSE.frame(row) for row in range(12)])
        writer.track = MOUSE.track()
        writer.close()
    assert len(read_log(place).entries) == 1


def test_a_failure_noted_meanwhile_does_not_hide_what_was_put_aside(place: Path) -> None:
    place.rename(place.with_name("circle.liex.old"))
    write_failure(place, {"reason": "the disk was full"})
    again(place)
    check_whole(place)
    assert taken_from(place) == "circle.liex.outdated-2"


def each_way_it_can_lie(place: Path, work: Callable[[], object]) -> Iterator[bool]:
    """Kill some work at each of its system calls in turn, each time from the same beginning.

    Whatever happens, corrections are there. Yields where things lie otherwise than before: whether
    it was killed.
    """
    home = place.parent
    kept = Path(shutil.copytree(home, home.with_name(f"{home.name}-kept")))
    ways: set[frozenset[str]] = set()
    for n in count():
        shutil.rmtree(home)
        shutil.copytree(kept, home)
        stopped = killed_at(n, work)
        lies = frozenset(
            str(path.relative_to(home))
            for path in home.rglob("*")
            if not [part for part in path.parts[:-1] if part.endswith((".gone", "seen"))]
        )
        assert [path for path in home.rglob("corrections.json") if path.stat().st_size], n
        if lies not in ways:
            ways.add(lies)
            yield stopped
        if not stopped:
            break
    assert n > 15
    assert len(ways) > 3


@pytest.mark.nightly
def test_killed_at_any_call_of_publishing_the_corrections_stay(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with SessionWriter(place, MOUSE.provenance(plan_toml=TOML), overwrite=True) as writer:
        for frames, _ in MOUSE.chunks(20):
            writer.add(frames)
        writer.track = MOUSE.track()
        measured = behaviour.measure_rows(writer.rows).for_session()
        with monkeypatch.context() as patch:
            patch.setattr(writer, "_publish", lambda: None)
            writer.close(**measured)

        def publish() -> None:
            writer._done = False
            writer._publish()

        for _ in each_way_it_can_lie(place, publish):
            check_whole(place)
            again(place)
            check_whole(place)
            assert [path.name for path in place.parent.iterdir()] == ["circle.liex"]


@pytest.mark.nightly
def test_killed_at_any_call_of_correcting_the_corrections_stay(place: Path) -> None:
    for _ in each_way_it_can_lie(place, lambda: groom(place, 0.2)):
        before = len(read_log(place).entries)
        check_whole(place, before)
        groom(place, 0.3)
        check_whole(place, before + 1)
        assert [p.name for p in place.iterdir() if p.name.startswith("correct")] == ["corrected"]


@pytest.mark.nightly
def test_killed_at_any_call_of_setting_a_session_aside_the_corrections_stay(place: Path) -> None:
    set_outdated(place)
    again(place)
    for _ in each_way_it_can_lie(place, lambda: set_outdated(place)):
        again(place)
        check_whole(place)


def test_all_is_on_disk_before_an_older_session_or_older_corrections_go(place: Path) -> None:
    with recorded() as calls:
        again(place)
    check_order(calls, place)
    with recorded() as calls:
        groom(place, 0.2)
    check_order(calls, place / "corrected")


def test_corrections_that_cannot_be_read_are_kept_and_not_taken_over(place: Path) -> None:
    (place / "corrected" / "corrections.json").write_text("")
    set_outdated(place)
    assert not again(place).log.entries
    set_outdated(place)
    names = {path.name for path in place.parent.iterdir()}
    assert names == {"circle.liex.outdated", "circle.liex.outdated-2"}
    assert (place.with_name("circle.liex.outdated-2") / "corrected" / "corrections.json").is_file()


def test_corrections_that_were_taken_over_and_removed_by_hand_do_not_come_back(
    place: Path,
) -> None:
    set_outdated(place)
    again(place)
    check_whole(place)
    shutil.rmtree(place / "corrected")
    assert not again(place).log.entries


def test_a_session_is_opened_from_within_its_own_folder(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / "deeper").mkdir()
    for within, path in ((place, "."), (place / "deeper", "..")):
        monkeypatch.chdir(within)
        assert not put_back_session(Path(path))
        assert len(Session.open(path).frames) == 12
