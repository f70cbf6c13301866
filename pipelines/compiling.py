"""Ahead-of-time compilation of the kernels that a plan needs, side by side, once on a machine.

numba compiles a kernel when it is called for the first time, one kernel after another. Which
kernels a run calls, and with arguments of which types, is known beforehand: `kernels.json` lists
them (`python -m tests.kernels` makes it anew). Before the first run processes compile them side by
side into numba's cache on disk, where the run finds them. What the list does not hold is compiled
when it is called, as ever; so a list that is out of date costs time and nothing else.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import multiprocessing
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from liex_lab.catalog import MODELS
from liex_lab.errors import LiexError
from liex_lab.runtime.progress import COMPILING, Progress, silent

from .workers import Processes, n_cores

KERNELS = Path(__file__).with_name("kernels.json")
_FEWEST_CORES = 2
_DIGITS = 16


def compile_ahead(animal: str, progress: Progress = silent) -> bool:
    """Compile the kernels that a run on an animal calls, unless this machine has done so before.

    Args:
        animal: name of the skeleton; for one that is not listed nothing is done.
        progress: told how many kernels are ready.

    Returns:
        Whether anything was compiled. Not on a single core, in a process that may not start others,
        and where numba is told not to compile.
    """
    import numba

    rows = listed_kernels(animal)
    if (
        not rows
        or n_cores() < _FEWEST_CORES
        or multiprocessing.current_process().daemon
        or numba.config.DISABLE_JIT
        or numba.config.BOUNDSCHECK
    ):
        return False
    done = _mark(animal, rows)
    if done is None or done.is_file():
        return False
    progress(0, len(rows), COMPILING)
    rows = sorted(rows, key=lambda row: -row["cpu_s"])  # the longest first, so that all end at once
    try:
        for k, _ in enumerate(Processes(n_cores(), None).each(compile_kernel, rows)):
            progress(k + 1, len(rows), COMPILING)
        done.touch()
    except (LiexError, OSError):  # too little memory or disk: the run compiles what it calls
        return False
    return True


@cache
def listed_kernels(animal: str) -> Sequence[Mapping[str, Any]]:
    """The kernels that a run on an animal calls from Python.

    Args:
        animal: name of the skeleton.

    Returns:
        For each `kernel` ("module:name"), `args` (types, see `type_of`) and `cpu_s`, what it took
        to compile where the list was made; () for an animal that is not listed.
    """
    if not KERNELS.is_file():
        return ()  # while it is being made
    return tuple(json.loads(KERNELS.read_text(encoding="utf-8"))["animals"].get(animal, ()))


def compile_kernel(row: Mapping[str, Any]) -> None:
    """Compile one kernel into numba's cache; nothing where it is there, or is called otherwise now.

    Args:
        row: of `listed_kernels`.
    """
    from numba.core.errors import NumbaError

    module, name = row["kernel"].split(":")
    try:
        kernel = getattr(importlib.import_module(module), name)
        kernel.compile(tuple(type_of(spelled) for spelled in row["args"]))
    except (ImportError, AttributeError, TypeError, ValueError, NumbaError):
        return  # the list is out of date; the run compiles the kernel as it calls it


def type_of(spelled: Any) -> Any:
    """The type in numba of an argument as `spelling` writes it.

    Args:
        spelled: text of a number's type, or a table.
    """
    types = _numba_types()
    if isinstance(spelled, str):
        return types.none if spelled == "none" else getattr(types, _NUMBERS.get(spelled, spelled))
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


_NUMBERS = {"bool": "boolean"}


def _numba_types() -> Any:
    """The module of numba's types; its stubs know half of them."""
    return importlib.import_module("numba.core.types")


def spelling(kind: Any) -> Any:
    """How an argument's type is written in `kernels.json`.

    Args:
        kind: numba's type: a number's, an array's, a tuple's, a NamedTuple's, None's or that of a
            default.

    Raises:
        TypeError: it is of another kind, such as a function's.
    """
    types = _numba_types()
    if isinstance(kind, types.Array):
        return {"array": [spelling(kind.dtype), kind.ndim, kind.layout, kind.mutable]}
    if isinstance(kind, types.Omitted):
        return {"omitted": kind.value}
    if isinstance(kind, types.NamedTuple | types.NamedUniTuple):
        owner = kind.instance_class
        fields = [spelling(field) for field in kind.types]
        return {"record": f"{owner.__module__}:{owner.__qualname__}", "fields": fields}
    if isinstance(kind, types.BaseTuple):
        return {"tuple": [spelling(field) for field in kind.types]}
    if isinstance(kind, types.Number | types.Boolean | types.NoneType) and not isinstance(
        kind, types.Literal
    ):
        return str(kind)
    raise TypeError(f"an argument of a kernel should be numbers, arrays or records, not {kind}")


def _mark(animal: str, rows: Sequence[Mapping[str, Any]]) -> Path | None:
    """The file in numba's cache that says that it has been done; None where nothing is cached.

    Its name changes with the program's sources, numba, and the processor.
    """
    import llvmlite.binding
    import numba

    module, name = rows[0]["kernel"].split(":")
    folder = getattr(importlib.import_module(module), name).stats.cache_path
    if folder is None:
        return None
    told = hashlib.sha256(
        f"{numba.__version__} {llvmlite.binding.get_host_cpu_name()} {animal}".encode()
    )
    for path in (KERNELS, *sorted(MODELS.parent.rglob("*.py"))):
        stat = path.stat()
        told.update(f"{path} {stat.st_mtime_ns} {stat.st_size}\n".encode())
    return Path(folder) / f"compiled-{told.hexdigest()[:_DIGITS]}"
