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


def compile_ahead(*animals: str, progress: Progress = silent) -> bool:
    """Compile the kernels that runs on animals call, unless this machine has done so before.

    Returns:
        Whether all were compiled now; False if that is done already, on a single core, or if
        numba's compilation is off.
    """
    import numba

    if n_cores() < 2 or numba.config.DISABLE_JIT or numba.config.BOUNDSCHECK:
        return False
    found = {animal: _mark(animal) for animal in animals if listed_kernels(animal)}
    marks = {animal: mark for animal, mark in found.items() if mark and not mark.is_file()}
    rows = {
        (row["kernel"], str(row["args"])): (f"{animal}:{number}", row["cpu_s"])
        for animal in marks
        for number, row in enumerate(listed_kernels(animal))
    }
    if not rows:
        return False
    ready = count(1)
    progress(0, len(rows), COMPILING)
    shares = _shares(dict(rows.values()), n_cores())
    whole = _compile(shares, lambda: progress(next(ready), len(rows), COMPILING))
    if whole:
        with suppress(OSError):
            for mark in marks.values():
                mark.touch()
    return whole


def _shares(costs: Mapping[str, float], n: int) -> list[list[str]]:
    """Rows in n shares of about equal duration: the longest first, each to the shortest share."""
    shares: list[list[str]] = [[] for _ in range(n)]
    spent = [0.0] * n
    for row in sorted(costs, key=lambda row: -costs[row]):
        least = spent.index(min(spent))
        shares[least].append(row)
        spent[least] += costs[row]
    return [share for share in shares if share]


def _compile(shares: Sequence[Sequence[str]], report: Callable[[], None]) -> bool:
    """Compile rows ("animal:number"), each share in a process; reports each kernel.

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
            command = own_python("-m", __name__, *share)
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
        args = tuple(type_of(spelled) for spelled in row["args"])
        kernel.overloads.pop(args, None)  # compiled for a kernel that calls it, it was not kept
        kernel.compile(args)
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


def _mark(animal: str) -> Path | None:
    """The file in numba's cache that marks completion; None if nothing is cached.

    Its name changes with the program's sources, numba, and the processor.
    """
    import llvmlite.binding
    import numba

    module, name = listed_kernels(animal)[0]["kernel"].split(":")
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


def _keep_callees_cheap() -> None:
    """Let numba compile only what its cache keeps, in two thirds of the time.

    numba optimises every function that a kernel calls, and the functions that those call, twice,
    and emits machine code for each. Then it links them into the kernel and optimises all of it
    again. Here they get the first, cheaper optimisation only and no machine code. The kernel's own
    code is as fast as usual. In a process with this, kernels can be compiled but not called.
    """
    from numba.core import caching, codegen

    dispatcher: Any = importlib.import_module("numba.core.dispatcher")  # its stubs are incomplete
    library, compiler = codegen.CPUCodeLibrary, dispatcher._FunctionCompiler
    compile_whole, save = compiler.compile, caching.Cache.save_overload
    optimize, finalize = library._optimize_final_module, library._finalize_final_module
    nested = 0

    def compile_nested(self: Any, *types: Any) -> Any:
        nonlocal nested
        nested += 1
        try:
            return compile_whole(self, *types)
        finally:
            nested -= 1

    def optimize_by_depth(self: Any) -> None:
        if nested == 1:
            optimize(self)
            return
        passes, builder = self._codegen._module_pass_manager(
            loop_vectorize=self._codegen._loopvect,
            slp_vectorize=False,
            opt=self._codegen._opt_level,
            cost="cheap",
        )
        passes.run(self._final_module, builder)

    def finalize_by_depth(self: Any) -> None:
        if nested == 1:
            finalize(self)
        else:
            self._finalize_dynamic_globals()
            self._finalized = True

    def save_by_depth(self: Any, *compiled: Any) -> None:
        if nested == 0:  # nothing that calls it is being compiled
            save(self, *compiled)

    compiler.compile = compile_nested
    library._optimize_final_module = optimize_by_depth
    library._finalize_final_module = finalize_by_depth
    caching.Cache.save_overload = save_by_depth
    codegen.JITCPUCodegen.set_env = lambda *_: None  # it belongs to machine code


def main() -> None:
    """Compile rows ("animal:number") of the command line."""
    with suppress(ImportError, AttributeError):  # a numba with other inner parts takes longer
        _keep_callees_cheap()
    for row in sys.argv[1:]:
        animal, number = row.split(":")
        compile_kernel(listed_kernels(animal)[int(number)])
        print(row, flush=True)


if __name__ == "__main__":
    main()
