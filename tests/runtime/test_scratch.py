"""A temporary folder goes with its process, however that one ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from liex_lab.runtime.durable import Scratch, remove_stale

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
