"""A documented path that is gone names its successor."""

from importlib import import_module
from importlib.util import find_spec

import pytest

from liex_lab.deprecated_paths import GONE


@pytest.mark.parametrize("old", sorted(GONE))
def test_a_path_that_is_gone_names_its_successor(old: str) -> None:
    with pytest.raises(ModuleNotFoundError, match=f"is now {GONE[old]}; import it from there"):
        import_module(old)
    assert find_spec(GONE[old]) is not None
