"""Kernels compiled ahead: the list is true, and a machine does it once."""

import importlib
import json
import subprocess
import sys
from collections.abc import Callable
from itertools import chain
from pathlib import Path

import pytest
from liex_lab.pipelines import compiling
from liex_lab.pipelines.compiling import KERNELS, compile_ahead, listed_kernels, type_of

from liex_lab.catalog import find_sample
from tests.kernels import LEFT_OUT, spelling

# what a process called from Python; with a warm cache no kernel that others call is among them
_CALLED = """
import json, sys
from numba.core.dispatcher import Dispatcher
from liex_lab.cli import main
from tests.kernels import spelling
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


@pytest.mark.nightly
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


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[list[list[str]]]:
    """What processes were asked to compile; the first time they fail."""
    asked: list[list[list[str]]] = []

    def compile_shares(shares: list[list[str]], report: Callable[[], None]) -> bool:
        asked.append(shares)
        for _ in chain.from_iterable(shares):
            report()
        return len(asked) > 1

    monkeypatch.setattr(compiling, "_compile", compile_shares)
    monkeypatch.setattr(compiling, "n_cores", lambda: 2)
    monkeypatch.setattr(compiling, "_mark", lambda animal: tmp_path / f"mark-{animal}")
    return asked


def test_a_machine_compiles_until_it_succeeds_once_and_each_core_about_as_long(
    asked: list[list[list[str]]],
) -> None:
    done: list[int] = []
    assert not compile_ahead("mouse")
    assert compile_ahead("mouse", progress=lambda n, total, what: done.append(n))
    assert not compile_ahead("mouse")
    cost = {f"mouse:{k}": row["cpu_s"] for k, row in enumerate(listed_kernels("mouse"))}
    assert len(asked) == 2
    assert sorted(chain.from_iterable(asked[1])) == sorted(cost)
    spent = [sum(cost[row] for row in share) for share in asked[1]]
    assert len(spent) == 2
    assert max(spent) < 1.2 * min(spent)
    assert done == list(range(len(cost) + 1))
    assert compile_ahead("mouse", "fish")
    fish = [row for row in chain.from_iterable(asked[2]) if row.startswith("fish:")]
    assert fish
    assert sorted(fish) == sorted(chain.from_iterable(asked[2]))  # the mouse's are there


def test_on_one_core_the_run_compiles_what_it_calls(
    asked: list[list[list[str]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiling, "n_cores", lambda: 1)
    assert not compile_ahead("mouse")
    assert not asked


@pytest.mark.nightly
def test_processes_compile_what_is_installed_wherever_they_are_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "liex_lab"
    other.mkdir()
    (other / "__init__.py").write_text("raise SystemExit(3)  # the sources of another version")
    monkeypatch.chdir(tmp_path)
    kernels = [row["kernel"].split(":")[1] for row in listed_kernels("mouse")]
    shares = [[f"mouse:{kernels.index(name)}"] for name in ("place_joints", "number_nodes")]
    reported: list[None] = []
    assert compiling._compile(shares, lambda: reported.append(None))
    assert len(reported) == 2
    assert not compiling._compile([["mouse:10000"]], lambda: None)


def test_a_kernel_that_is_called_otherwise_now_is_left_to_the_run() -> None:
    compiling.compile_kernel({"kernel": "liex_lab.body._skinning_kernels:gone", "args": []})
    compiling.compile_kernel({"kernel": "liex_lab.no_such_module:gone", "args": []})
    compiling.compile_kernel(
        {"kernel": "liex_lab.body._skinning_kernels:place_joints", "args": ["int64"]}
    )
