"""Kernels compiled ahead: the list is true, and a machine does it once."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import ClassVar

import pytest
from liex_lab.pipelines import compiling
from liex_lab.pipelines.compiling import KERNELS, compile_ahead, listed_kernels, spelling, type_of

from liex_lab.catalog import find_sample
from tests.kernels import LEFT_OUT

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
    missing = {kernel for kernel, args in called - listed if not kernel.startswith(LEFT_OUT)}
    assert called & listed
    assert not missing, "run `python -m tests.kernels`"


class _Compilers:
    """Stands for processes; notes what they are asked to compile."""

    asked: ClassVar[list[list[list[int]]]] = []
    ends_well = True

    def __init__(self, animal: str, shares: list[list[int]]) -> None:
        self._shares = shares
        self.asked.append(shares)

    def run(self, tell: Callable[[], None]) -> bool:
        for _ in chain.from_iterable(self._shares):
            tell()
        return self.ends_well


@pytest.fixture
def compilers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> type[_Compilers]:
    class Compilers(_Compilers):
        asked: ClassVar[list[list[list[int]]]] = []

    monkeypatch.setattr(compiling, "_Compilers", Compilers)
    monkeypatch.setattr(compiling, "n_cores", lambda: 2)
    monkeypatch.setattr(compiling, "_mark", lambda animal, rows: tmp_path / "mark")
    return Compilers


def test_a_machine_compiles_once_and_each_core_about_as_long(compilers: type[_Compilers]) -> None:
    told: list[int] = []
    assert compile_ahead("mouse", lambda done, total, what: told.append(done))
    assert not compile_ahead("mouse")
    cost = [row["cpu_s"] for row in listed_kernels("mouse")]
    (shares,) = compilers.asked
    assert sorted(chain.from_iterable(shares)) == list(range(len(cost)))
    spent = [sum(cost[row] for row in share) for share in shares]
    assert len(spent) == 2
    assert max(spent) < 1.2 * min(spent)
    assert told == list(range(len(cost) + 1))


def test_what_did_not_end_well_is_tried_again(
    compilers: type[_Compilers], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compilers, "ends_well", False)
    assert not compile_ahead("mouse")
    monkeypatch.setattr(compilers, "ends_well", True)
    assert compile_ahead("mouse")
    assert len(compilers.asked) == 2


def test_on_one_core_the_run_compiles_what_it_calls(
    compilers: type[_Compilers], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiling, "n_cores", lambda: 1)
    assert not compile_ahead("mouse")
    assert not compilers.asked


def test_processes_compile_and_tell_of_every_kernel() -> None:
    kernels = [row["kernel"].split(":")[1] for row in listed_kernels("mouse")]
    shares = [[kernels.index("place_joints")], [kernels.index("number_nodes")]]
    told: list[None] = []
    assert compiling._Compilers("mouse", shares).run(lambda: told.append(None))
    assert len(told) == 2
    assert not compiling._Compilers("mouse", [[10_000]]).run(lambda: None)


def test_they_compile_what_is_installed_wherever_they_are_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "liex_lab"
    other.mkdir()
    (other / "__init__.py").write_text("raise SystemExit(3)  # the sources of another version")
    monkeypatch.chdir(tmp_path)
    told: list[None] = []
    assert compiling._Compilers("mouse", [[0]]).run(lambda: told.append(None))
    assert len(told) == 1


def test_a_kernel_that_is_called_otherwise_now_is_left_to_the_run() -> None:
    compiling.compile_kernel({"kernel": "liex_lab.body._skinning_kernels:gone", "args": []})
    compiling.compile_kernel({"kernel": "liex_lab.no_such_module:gone", "args": []})
    compiling.compile_kernel(
        {"kernel": "liex_lab.body._skinning_kernels:place_joints", "args": ["int64"]}
    )
