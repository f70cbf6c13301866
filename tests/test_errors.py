"""What is said on a terminal is text: no name of a file or person does anything there."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from liex_lab.pipelines.correct import correct_session
from liex_lab.pipelines.doctor import examine
from liex_lab.pipelines.session import run_session
from typer.testing import CliRunner

from liex_lab import cli
from liex_lab.errors import LiexError, printable
from liex_lab.plan import Plan
from liex_lab.recordings import open_recording
from liex_lab.recordings.timestamps import unwritable_times
from liex_lab.recordings.writer import ImageFolderWriter
from liex_lab.sessions.corrections import BoutEdit
from tests.hostile_names import NAMES
from tests.sessions.walking_mouse import WalkingMouse, steady, write


@pytest.mark.parametrize("name", NAMES)
def test_a_sentence_that_quotes_a_name_is_one_printable_line(name: str) -> None:
    said = str(LiexError(f"there is no {name}"))
    assert len(said.splitlines()) == 1
    assert "\x1b" not in said
    said.encode()
    assert not set(said) & set("\x07\u202e\u200b\0")


@pytest.mark.parametrize("text", ["Mäuse 🐁 / m01", "a b\tc\nd", "\u00a0no break", "日本"])
def test_what_people_write_is_shown_as_it_is(text: str) -> None:
    assert printable(text) == text


def test_a_correction_s_words_are_shown_whatever_they_are(tmp_path: Path) -> None:
    mouse = WalkingMouse(steady(1.0))
    session = write(tmp_path / "a.liex", mouse, plan_toml=Plan.load("mouse").to_toml())
    word = BoutEdit("add", "[/b]x", int(mouse.times_ns[2]), int(mouse.times_ns[20]))
    correct_session(session.path, [word], author="[/red]\x1b[2J", report=False)
    ran = CliRunner().invoke(
        cli.app, ["correct", "list", str(session.path)], env={"COLUMNS": "200"}
    )
    assert ran.exit_code == 0, ran.output
    assert "[/b]x" in ran.output
    assert "[/red]" in ran.output
    assert "\x1b[2J" not in ran.output


def shifted(by_ns: int, folder: Path) -> Path:
    """A folder of pictures whose clock starts elsewhere."""
    address = "synthetic:walk?seed=3&frames=8&sensor=primesense-qvga&spine_mm=70"
    with (
        open_recording(address) as whole,
        ImageFolderWriter(folder, whole.camera, step_mm=1.0, exact=False) as written,
    ):
        for frame in whole:
            elapsed = frame.time_ns - int(whole.times_ns[0])
            written.add(replace(frame, time_ns=by_ns + elapsed))
    return folder


@pytest.mark.parametrize(
    "by_ns", [-(10**9), pytest.param(2**62 - 10**11, marks=pytest.mark.nightly)]
)
def test_times_that_no_session_can_hold_are_told_by_doctor_and_run(
    by_ns: int, tmp_path: Path
) -> None:
    recording = shifted(by_ns, tmp_path / "shifted")
    with pytest.raises(LiexError, match="shift them"):
        run_session(recording, Plan.load("mouse"), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["shifted"]
    assert any("shift them" in problem for problem in examine(recording)["problems"])


def test_times_of_a_usual_clock_and_from_zero_are_taken() -> None:
    for first in (0, 1_700_000_000 * 10**9):
        assert unwritable_times(first + np.arange(5, dtype=np.int64) * 33_000_000) == ""
    assert unwritable_times(np.zeros(0, np.int64)) == ""


def test_the_printed_command_is_one_that_a_shell_takes_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import shlex

    place = tmp_path / "$(id) a.liex"
    session = write(place, WalkingMouse(steady(1.0)), plan_toml=Plan.load("mouse").to_toml())
    monkeypatch.setattr("liex_lab.api.run_session", lambda *_, **__: session.path)
    ran = CliRunner().invoke(cli.app, ["run", "x.mcap", "--out", str(tmp_path)])
    line = next(line for line in ran.output.splitlines() if line.startswith("replay:"))
    assert shlex.split(line.partition(":")[2]) == ["liex", "show", str(place)]
    shutil.rmtree(place)
