"""Compiled code on disk: each compiled function finds its own again."""

import importlib
import pkgutil
from collections import defaultdict

import numba
from numba.core.dispatcher import Dispatcher

import liex_lab


def dispatchers() -> dict[int, tuple[str, Dispatcher]]:
    """Every compiled function of the package that is kept on disk, with a name it goes by."""
    found = {}
    for module in pkgutil.walk_packages(liex_lab.__path__, "liex_lab."):
        if module.name == "liex_lab.__main__":
            continue
        for name, value in vars(importlib.import_module(module.name)).items():
            if (
                isinstance(value, Dispatcher)
                and value.targetoptions.get("nopython")
                and value.stats.cache_path
            ):
                found[id(value)] = (f"{value.__module__}.{name}", value)
    return found


def test_no_two_compiled_functions_share_a_file_on_disk() -> None:
    """Numba names a file after the Python function, not after its options, so a serial and a
    parallel driver made from one function read one another's code: whichever was compiled first
    serves both.
    """
    owners = defaultdict(list)
    for name, dispatcher in dispatchers().values():
        code = dispatcher.py_func.__code__
        owners[code.co_filename, code.co_firstlineno, dispatcher.py_func.__qualname__].append(name)
    assert owners or numba.config.DISABLE_JIT
    shared = [sorted(names) for names in owners.values() if len(names) > 1]
    assert not shared
