"""What is made ahead by a thread is what would have been made in turn."""

import threading
from collections.abc import Iterator

import numba
import pytest

from liex_lab.runtime.processes import imported_ahead, in_background, prefetch, side_by_side


def test_one_item_is_made_while_the_one_before_it_is_used() -> None:
    made: list[int] = []
    third = threading.Event()

    def items() -> Iterator[int]:
        for k in range(5):
            made.append(k)
            if k == 2:
                third.set()
            yield k

    coming = prefetch(items())
    assert next(coming) == 0
    assert next(coming) == 1
    assert third.wait(10)
    assert 4 not in made
    coming.close()


def test_what_goes_wrong_is_raised_after_the_items_before_it() -> None:
    def items() -> Iterator[int]:
        yield 1
        raise OSError("the drive is gone")

    coming = prefetch(items())
    assert next(coming) == 1
    with pytest.raises(OSError, match="drive"):
        next(coming)


def test_something_is_made_while_a_block_runs_and_its_error_is_raised_where_it_is_wanted() -> None:
    asked, begun = threading.Event(), threading.Event()

    def make() -> int:
        begun.set()
        assert asked.wait(10)
        return 7

    def fail() -> int:
        raise OSError("the drive is gone")

    with in_background(make) as made:
        assert begun.wait(10)  # before anybody asks for it
        asked.set()
        assert made() == made() == 7
    with in_background(fail) as failed, pytest.raises(OSError, match="gone"):
        failed()
    with in_background(fail):  # nobody wants it
        pass


@pytest.mark.parametrize("n_threads", [1, 2])
def test_results_side_by_side_are_in_order_and_what_goes_wrong_is_raised(n_threads: int) -> None:
    before = numba.get_num_threads()
    numba.set_num_threads(min(n_threads, before))
    try:
        assert side_by_side(lambda number: number**2, range(50)) == [n**2 for n in range(50)]
        assert side_by_side(lambda number: number, []) == []
        with pytest.raises(ZeroDivisionError):
            side_by_side(lambda number: 1 // number, [1, 0, 2])
    finally:
        numba.set_num_threads(before)


def test_modules_are_imported_while_a_block_runs_and_no_more_after_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun, ended, asked = threading.Event(), threading.Event(), []

    def slowly(name: str) -> None:
        asked.append(name)
        begun.set()
        assert ended.wait(10.0)
        raise ImportError(name)

    monkeypatch.setattr("liex_lab.runtime.processes.import_module", slowly)
    others = set(threading.enumerate())
    with imported_ahead("colorsys", "there_is_no_such_module"):
        assert begun.wait(10.0)
        (fetching,) = set(threading.enumerate()) - others
    ended.set()
    fetching.join(10.0)
    assert asked == ["colorsys"]
