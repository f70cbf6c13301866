"""A documented path that is gone names its successor, and an outdated kernel cache does no harm."""

from __future__ import annotations

import pickle
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import numba
import pytest
from numba.core.caching import IndexDataCacheFile

from liex_lab.deprecated_paths import GONE


@pytest.mark.parametrize("old", sorted(GONE))
def test_a_path_that_is_gone_names_its_successor(old: str) -> None:
    with pytest.raises(ModuleNotFoundError, match=f"is now {GONE[old]}; import it from there"):
        import_module(old)
    assert find_spec(GONE[old]) is not None


def test_a_kernel_cache_that_names_a_gone_module_is_outdated_and_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = "liex_lab.gone_room.records"
    record = type("Record", (), {"__module__": name})
    for module in (name.rpartition(".")[0], name):
        monkeypatch.setitem(sys.modules, module, ModuleType(module))
    vars(sys.modules[name])["Record"] = record
    index = pickle.dumps(numba.__version__) + pickle.dumps(("old stamp", {record: "kernel.nbc"}))
    monkeypatch.undo()
    (tmp_path / "kernel.nbi").write_bytes(index)
    cache = IndexDataCacheFile(str(tmp_path), "kernel", "new stamp")
    assert cache.load(None) is None
    with monkeypatch.context() as clean:
        clean.delitem(sys.modules, name)
        clean.delitem(sys.modules, name.rpartition(".")[0])
        with pytest.raises(ModuleNotFoundError):
            import_module(name)
