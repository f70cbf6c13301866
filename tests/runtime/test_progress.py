"""What a person who waits is told."""

from pathlib import Path

import pytest
from numba.core import event

from liex_lab.runtime.progress import COMPILING, logged, reporting_compilation


def test_compiling_is_told_while_it_lasts_and_then_what_was_being_done() -> None:
    told: list[str] = []
    with reporting_compilation(lambda done, total, what: told.append(what)) as progress:
        progress(0, None, "opening")
        with event.trigger_event("numba:compile"), event.trigger_event("numba:compile"):
            pass  # a kernel, and one that it calls
        progress(1, 2, "looking")
    with event.trigger_event("numba:compile"):
        pass
    assert told == ["opening", COMPILING, COMPILING, "opening", "looking"]


def test_a_log_states_each_stage_once_and_what_ended_it(tmp_path: Path) -> None:
    seen: list[tuple[int, int | None, str]] = []
    log = tmp_path / "new" / "a.log"

    def job() -> None:
        with logged(lambda *one: seen.append(one), log, "liex run a") as progress:
            assert not log.exists(), "nothing was done yet"
            progress(0, None, "learning")
            assert not log.parent.exists(), "what is refused leaves nothing"
            log.parent.mkdir()
            for k in range(101):
                progress(k, 100, "measuring")
            raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        job()
    lines = [line.partition(" ")[2] for line in log.read_text(encoding="utf-8").splitlines()]
    assert lines[:3] == ["liex run a", "learning", "measuring: 0 of 100"]
    assert lines[-2:] == ["measuring: 100 of 100", "ended: broken"]
    assert len(lines) == 2 + 11 + 1
    assert len(seen) == 102
