"""A folder takes the place of another: on disk first, and one of the two always whole."""

import errno
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from liex_lab.runtime import durable
from liex_lab.runtime.durable import Scratch, remove_stale
from tests.sessions.kills import check_order, killed_at, recorded

WHOLE = {"a.txt", "inner/b.txt"}


def fill(folder: Path, text: str) -> Path:
    for name in WHOLE:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def read(folder: Path) -> str:
    """The text of a whole folder."""
    (text,) = {(folder / name).read_text() for name in WHOLE}
    return text


def test_everything_is_on_disk_before_the_old_one_goes(tmp_path: Path) -> None:
    place = fill(tmp_path / "place", "old")
    with recorded() as calls:
        durable.move_into_place(fill(tmp_path / "new", "new"), place, tmp_path / "aside")
    check_order(calls, place)
    assert read(place) == "new"
    assert list(tmp_path.iterdir()) == [place]


@pytest.mark.parametrize("step", [5, pytest.param(1, marks=pytest.mark.nightly)])
def test_killed_at_any_call_one_of_them_is_whole_and_the_next_one_resumes(
    step: int, tmp_path: Path
) -> None:
    n = 0
    while True:
        here = tmp_path / str(n)
        place, aside = fill(here / "place", "old"), here / "aside"
        new = fill(here / "new", "new")
        stopped = killed_at(n, lambda: durable.move_into_place(new, place, aside))  # noqa: B023
        durable.put_back(place, aside)
        assert read(place) in ("old", "new"), n
        shutil.rmtree(new, ignore_errors=True)
        durable.move_into_place(fill(new, "third"), place, aside)
        assert read(place) == "third"
        assert list(here.iterdir()) == [place], n
        if not stopped:
            break
        n += step
    assert n > 10


def test_what_cannot_be_renamed_leaves_the_old_one_in_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, new = fill(tmp_path / "place", "old"), fill(tmp_path / "new", "new")
    rename = os.rename

    def refuse(source: Path, target: Path) -> None:
        if Path(source) == new:
            raise OSError(errno.EACCES, "refused")
        rename(source, target)

    monkeypatch.setattr(os, "rename", refuse)
    with pytest.raises(OSError, match="refused"):
        durable.move_into_place(new, place, tmp_path / "aside")
    assert read(place) == "old"
    assert not (tmp_path / "aside").exists()


def test_a_share_that_cannot_synchronise_is_no_error_and_a_broken_disk_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number, told in ((errno.EINVAL, False), (errno.ENOTSUP, False), (errno.EIO, True)):
        monkeypatch.setattr(os, "fsync", _Refusing(number))
        place, new = fill(tmp_path / "place", "old"), fill(tmp_path / "new", "new")
        if told:
            with pytest.raises(OSError, match="refused"):
                durable.move_into_place(new, place, tmp_path / "aside")
        else:
            durable.move_into_place(new, place, tmp_path / "aside")
        assert read(place) == ("old" if told else "new")


class _Refusing:
    """A disk that answers every fsync with one error."""

    def __init__(self, number: int) -> None:
        self._number = number

    def __call__(self, file: int) -> None:
        raise OSError(self._number, "refused")


# A temporary folder goes with its process, however that one ends.


KEEPS = """
from liex_lab.runtime.durable import Scratch
import time
scratch = Scratch()
(scratch.folder / "big").write_bytes(bytes(1000))
print(scratch.folder, flush=True)
time.sleep(60)
"""


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    return tmp_path


def test_it_goes_when_it_is_closed(temporary: Path) -> None:
    scratch = Scratch()
    (scratch.folder / "a").write_text("x")
    assert [scratch.folder] == list(temporary.iterdir())
    scratch.close()
    assert not list(temporary.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="signals differ")
def test_what_a_killed_process_left_goes_with_the_next_and_what_is_in_use_stays(
    temporary: Path,
) -> None:
    (temporary / "liex-scratch-unlocked").mkdir()  # of somebody who was killed before
    (temporary / "other").write_text("kept")
    with subprocess.Popen([sys.executable, "-c", KEEPS], stdout=subprocess.PIPE, text=True) as one:
        assert one.stdout is not None
        left = Path(one.stdout.readline().strip())
        remove_stale()
        assert (left / "big").is_file()
        os.kill(one.pid, signal.SIGKILL)
        one.wait()
    assert (left / "big").is_file()
    Scratch().close()
    assert {path.name for path in temporary.iterdir()} == {"other"}


def test_who_has_not_locked_its_folder_when_others_tidy_up_makes_another_one(
    temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = tempfile.mkdtemp
    made: list[str] = []

    def overtaken(prefix: str) -> str:
        made.append(make(prefix=prefix))
        if len(made) == 1:
            remove_stale()
        return made[-1]

    monkeypatch.setattr(tempfile, "mkdtemp", overtaken)
    scratch = Scratch()
    assert len(made) == 2
    assert [scratch.folder] == list(temporary.iterdir())
    scratch.close()


def test_a_link_with_such_a_name_is_left_alone(temporary: Path) -> None:
    precious = temporary / "precious"
    precious.mkdir()
    (precious / ".lock").write_text("")
    (temporary / "liex-scratch-link").symlink_to(precious)
    remove_stale()
    assert (precious / ".lock").is_file()
