"""What a person who waits is told."""

from numba.core import event

from liex_lab.runtime.progress import COMPILING, reporting_compilation


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
