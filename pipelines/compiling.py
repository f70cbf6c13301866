"""Ahead-of-time compilation of the kernels that a plan needs, in parallel, once per machine.

numba compiles a kernel at its first call, one kernel after another. The kernels that a run calls,
and their argument types, are known beforehand: `kernels.json` lists them (regenerate it with
`python -m tests.kernels`). Before the first run, parallel processes compile them into numba's cache
on disk, where the run finds them. Kernels that are not listed are compiled when called, as usual,
so an outdated list only costs time.
"""

import hashlib
import importlib
import json
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache, partial
from itertools import count
from pathlib import Path
from typing import Any

from liex_lab.catalog import MODELS
from liex_lab.runtime.processes import n_cores, own_python
from liex_lab.runtime.progress import COMPILING, Progress, silent

KERNELS = Path(__file__).with_name("kernels.json")


def compile_ahead(animal: str, progress: Progress = silent) -> bool:
    """Compile the kernels that a run on an animal calls, unless this machine has done so before.

    Returns:
        Whether all were compiled now; False if that is done already, on a single core, or if
        numba's compilation is off.
    """
    import numba

    rows = listed_kernels(animal)
    if not rows or n_cores() < 2 or numba.config.DISABLE_JIT or numba.config.BOUNDSCHECK:
        return False
    done = _mark(animal, rows)
    if done is None or done.is_file():
        return False
    shares = _shares([row["cpu_s"] for row in rows], n_cores())
    ready = count(1)
    progress(0, len(rows), COMPILING)
    whole = _compile(animal, shares, lambda: progress(next(ready), len(rows), COMPILING))
    if whole:
        with suppress(OSError):
            done.touch()
    return whole


def _shares(costs: Sequence[float], n: int) -> list[list[int]]:
    """Rows in n shares of about equal duration: the longest first, each to the shortest share."""
    shares: list[list[int]] = [[] for _ in range(n)]
    spent = [0.0] * n
    for row in sorted(range(len(costs)), key=lambda row: -costs[row]):
        least = spent.index(min(spent))
        shares[least].append(row)
        spent[least] += costs[row]
    return [share for share in shares if share]


def _compile(animal: str, shares: Sequence[Sequence[int]], report: Callable[[], None]) -> bool:
    """Compile the rows of a list, each share in a process; reports each kernel.

    The processes are started with their own command instead of `multiprocessing`, which would run
    the main script of a caller of `run_session` again in each of them.

    Returns:
        Whether all succeeded; False if there is too little memory or too many processes.
    """
    running: list[subprocess.Popen[str]] = []

    def end() -> None:
        for one in running:
            one.kill()
            one.wait()

    try:
        for share in shares:
            command = own_python("-m", __name__, animal, *map(str, share))
            quiet = subprocess.DEVNULL
            running.append(
                subprocess.Popen(command, stdout=subprocess.PIPE, stderr=quiet, text=True)
            )
        with ThreadPoolExecutor(len(running)) as listeners:
            try:
                return all(list(listeners.map(partial(_listen, report=report), running)))
            finally:
                end()  # before waiting for the listeners
    except OSError:
        return False
    finally:
        end()


def _listen(process: subprocess.Popen[str], report: Callable[[], None]) -> bool:
    """Call `report` for each line of a process; returns whether it succeeded."""
    assert process.stdout is not None
    with process.stdout as lines:
        for _ in lines:
            report()
    return process.wait() == 0


@cache
def listed_kernels(animal: str) -> Sequence[Mapping[str, Any]]:
    """The kernels that a run on an animal calls from Python.

    Returns:
        For each `kernel` ("module:name"), `args` (types, see `type_of`) and `cpu_s`, its compile
        time when the list was made; () for an animal that is not listed.
    """
    if not KERNELS.is_file():
        return ()  # while it is being generated
    return tuple(json.loads(KERNELS.read_text(encoding="utf-8"))["animals"].get(animal, ()))


def compile_kernel(row: Mapping[str, Any]) -> None:
    """Compile a kernel of `listed_kernels` into numba's cache, unless it is cached or has
    changed.
    """
    from numba.core.errors import NumbaError

    module, name = row["kernel"].split(":")
    try:
        kernel = getattr(importlib.import_module(module), name)
        kernel.compile(tuple(type_of(spelled) for spelled in row["args"]))
    except (ImportError, AttributeError, TypeError, ValueError, NumbaError):
        return  # the list is outdated; the run compiles the kernel on call


def type_of(spelled: Any) -> Any:
    """The numba type of an argument as `kernels.json` spells it: a type's name or a table."""
    types: Any = importlib.import_module("numba.core.types")  # its stubs are incomplete
    if isinstance(spelled, str):
        return getattr(types, {"bool": "boolean"}.get(spelled, spelled))
    if "array" in spelled:
        dtype, n_dims, layout, writable = spelled["array"]
        return types.Array(type_of(dtype), n_dims, layout, readonly=not writable)
    if "omitted" in spelled:
        return types.Omitted(spelled["omitted"])
    if "record" in spelled:
        module, name = spelled["record"].split(":")
        fields = [type_of(field) for field in spelled["fields"]]
        return types.BaseTuple.from_types(fields, getattr(importlib.import_module(module), name))
    return types.BaseTuple.from_types([type_of(field) for field in spelled["tuple"]])


def _mark(animal: str, rows: Sequence[Mapping[str, Any]]) -> Path | None:
    """The file in numba's cache that marks completion; None if nothing is cached.

    Its name changes with the program's sources, numba, and the processor.
    """
    import llvmlite.binding
    import numba

    module, name = rows[0]["kernel"].split(":")
    folder = getattr(importlib.import_module(module), name).stats.cache_path
    if folder is None:
        return None
    mark = hashlib.sha256(
        f"{numba.__version__} {llvmlite.binding.get_host_cpu_name()} {animal}".encode()
    )
    for path in (KERNELS, *sorted(MODELS.parent.rglob("*.py"))):
        stat = path.stat()
        mark.update(f"{path} {stat.st_mtime_ns} {stat.st_size}\n".encode())
    return Path(folder) / f"compiled-{mark.hexdigest()[:16]}"


def main() -> None:
    """Compile kernels of an animal by their numbers in the list, both from the command line."""
    animal, *numbers = sys.argv[1:]
    for number in numbers:
        compile_kernel(listed_kernels(animal)[int(number)])
        print(number, flush=True)


if __name__ == "__main__":
    main()
