"""Kernels compiled ahead: the list is true, and a machine does it once."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from liex_lab.pipelines import compiling
from liex_lab.pipelines.compiling import KERNELS, compile_ahead, listed_kernels, spelling, type_of

from liex_lab.catalog import find_sample
from liex_lab.errors import SessionError

# what a process called from Python; with a warm cache no kernel that others call is among them
_CALLED = """
import json, sys
from numba.core.dispatcher import Dispatcher
from liex_lab.cli import main
from liex_lab.pipelines.compiling import spelling
sys.argv = ["liex", "run", *sys.argv[1:]]
try:
    main()
except SystemExit as ended:
    assert not ended.code, ended.code
kernels = {
    value for name, module in list(sys.modules.items()) if name.startswith("liex_lab.")
    for value in vars(module).values() if isinstance(value, Dispatcher)
}
called = {
    (f"{kernel.py_func.__module__}:{kernel.py_func.__qualname__}", json.dumps(spelled))
    for kernel in kernels
    for spelled in ([spelling(kind) for kind in args] for args in kernel.overloads)
}
print("CALLED", json.dumps(sorted(called)))
"""
_LEFT_OUT = ("liex_lab.recordings.", "liex_lab.simulation.")
ANIMALS = sorted(json.loads(KERNELS.read_text(encoding="utf-8"))["animals"])


def test_the_bundled_animals_are_listed() -> None:
    assert ANIMALS == ["fish", "hand", "mouse"]
    assert listed_kernels("snake") == ()


@pytest.mark.parametrize("animal", ANIMALS)
def test_every_listed_kernel_is_there_and_its_types_can_be_read(animal: str) -> None:
    for row in listed_kernels(animal):
        module, name = row["kernel"].split(":")
        assert callable(getattr(importlib.import_module(module), name).compile), row["kernel"]
        assert [spelling(type_of(one)) for one in row["args"]] == row["args"]


def test_a_run_calls_only_kernels_that_are_listed(tmp_path: Path) -> None:
    """Else they are compiled one after another; `python -m tests.kernels` makes the list anew."""
    run = [str(find_sample("mouse_walk.mcap")), "--plan", "mouse", "--out", str(tmp_path)]
    ran = subprocess.run(
        [sys.executable, "-c", _CALLED, *run], capture_output=True, text=True, check=True
    )
    line = next(line for line in ran.stdout.splitlines() if line.startswith("CALLED "))
    called = {(kernel, args) for kernel, args in json.loads(line.removeprefix("CALLED "))}
    listed = {(row["kernel"], json.dumps(row["args"])) for row in listed_kernels("mouse")}
    missing = {kernel for kernel, args in called - listed if not kernel.startswith(_LEFT_OUT)}
    assert called & listed
    assert not missing, "run `python -m tests.kernels`"


class _Pool:
    """Stands for processes; notes what they are asked to compile."""

    asked: list[list[str]] = []  # noqa: RUF012
    broken = False

    def __init__(self, n: int, threads: int | None = 0) -> None:
        assert threads is None  # the environment is not touched while others compile
        self.n = n

    def each(self, do: Callable[[Any], Any], works: Sequence[Any]) -> Iterator[Any]:
        assert do is compiling.compile_kernel
        if self.broken:
            raise SessionError("a worker process ended without a word")
        self.asked.append([work["kernel"] for work in works])
        yield from works


@pytest.fixture
def pool(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> type[_Pool]:
    class Pool(_Pool):
        asked: list[list[str]] = []  # noqa: RUF012

    monkeypatch.setattr(compiling, "Processes", Pool)
    monkeypatch.setattr(compiling, "n_cores", lambda: 2)
    monkeypatch.setattr(compiling, "_mark", lambda animal, rows: tmp_path / "mark")
    return Pool


def test_a_machine_compiles_once_the_longest_kernel_first(pool: type[_Pool]) -> None:
    told: list[int] = []
    assert compile_ahead("mouse", lambda done, total, what: told.append(done))
    assert not compile_ahead("mouse")
    assert len(pool.asked) == 1
    cost = {row["kernel"]: row["cpu_s"] for row in listed_kernels("mouse")}
    assert [cost[kernel] for kernel in pool.asked[0]] == sorted(cost.values(), reverse=True)
    assert told == list(range(len(cost) + 1))


def test_without_room_for_processes_the_run_compiles_what_it_calls(
    pool: type[_Pool], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool, "broken", True)
    assert not compile_ahead("mouse")
    monkeypatch.setattr(pool, "broken", False)
    monkeypatch.setattr(compiling, "n_cores", lambda: 1)
    assert not compile_ahead("mouse")
    assert not pool.asked


def test_a_kernel_that_is_called_otherwise_now_is_left_to_the_run() -> None:
    compiling.compile_kernel({"kernel": "liex_lab.body._kernels:gone", "args": []})
    compiling.compile_kernel({"kernel": "liex_lab.no_such_module:gone", "args": []})
    compiling.compile_kernel({"kernel": "liex_lab.body._kernels:place_joints", "args": ["int64"]})
