"""The queue of corrections: many at a time, in order, each with its number, none lost."""

import threading
from collections.abc import Sequence
from pathlib import Path

import pytest
from liex_lab.dashboards.app.corrections import FAILED, SAVED, Saver

from liex_lab.errors import LiexError, SessionError
from liex_lab.sessions.corrections import Correction, JointMove, Log, corrected_folder, read_log


class Disk:
    """Writes logs alone, and waits until it is let go on."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, int]] = []
        self.reports: list[Path] = []
        self.go = threading.Event()
        self.go.set()

    def correct(
        self, folder: Path, what: Sequence[Correction], undo: Sequence[int], author: str
    ) -> None:
        self.go.wait(10)
        self.calls.append((len(what), len(undo)))
        if any(isinstance(one, JointMove) and one.joint == "bad" for one in what):
            raise SessionError("a bad joint")
        log = read_log(folder).added(what, undo, author)
        corrected_folder(folder).mkdir(exist_ok=True)
        (corrected_folder(folder) / "corrections.json").write_text(Log("x", log.entries).to_json())

    def report(self, folder: Path) -> None:
        self.reports.append(folder)


def joint(frame: int, name: str = "nose") -> JointMove:
    return JointMove(frame, name, 0.0, 0.0, 0.0)


def test_what_waits_is_saved_together_and_reported_once(tmp_path: Path) -> None:
    disk = Disk()
    saver = Saver(disk.correct, disk.report, calm_s=0.05)
    disk.go.clear()
    tickets = [saver.add(tmp_path, joint(k), "me") for k in range(6)]
    assert saver.busy(tmp_path)[0] == 6
    disk.go.set()
    saver.finish()
    assert [one.state for one in tickets] == [SAVED] * 6
    assert [one.number for one in tickets] == [1, 2, 3, 4, 5, 6]
    assert len(disk.calls) <= 2
    assert disk.reports == [tmp_path]
    assert saver.busy(tmp_path) == (0, False)
    saver.wait(saver.take_back(tmp_path, 3, "me"))
    assert [entry.number for entry in read_log(tmp_path).standing] == [1, 2, 4, 5, 6]


def test_one_that_cannot_be_saved_takes_no_other_with_it(tmp_path: Path) -> None:
    disk = Disk()
    saver = Saver(disk.correct, disk.report)
    disk.go.clear()
    tickets = [
        saver.add(tmp_path, joint(k, name), "me") for k, name in enumerate(["a", "bad", "b"])
    ]
    disk.go.set()
    saver.finish()
    assert [one.state for one in tickets] == [SAVED, FAILED, SAVED]
    assert [entry.what for entry in read_log(tmp_path).standing] == [joint(0, "a"), joint(2, "b")]
    with pytest.raises(LiexError, match="a bad joint"):
        saver.wait(tickets[1])


def test_authors_and_takings_back_keep_their_order(tmp_path: Path) -> None:
    disk = Disk()
    saver = Saver(disk.correct, disk.report)
    saver.wait(saver.add(tmp_path, joint(1), "me"))
    disk.go.clear()
    saver.add(tmp_path, joint(2), "me")
    saver.take_back(tmp_path, 1, "me")
    saver.add(tmp_path, joint(3), "you")
    disk.go.set()
    saver.finish()
    entries = read_log(tmp_path).entries
    assert [entry.author for entry in entries] == ["me", "me", "me", "you"]
    assert [entry.undoes for entry in entries] == [0, 0, 1, 0]
