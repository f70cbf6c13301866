"""A dotted path that moved still imports, is the module at its new place, and says once where that
is.
"""

from __future__ import annotations

import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec

import pytest

from liex_lab.moved import MOVED
from tests.conftest import REPOSITORY


@pytest.mark.parametrize("old", sorted(MOVED))
def test_an_old_path_leads_to_a_module_that_is_there(old: str) -> None:
    assert find_spec(MOVED[old]) is not None
    assert not (REPOSITORY / f"{old.replace('.', '/')}.py").exists()


def test_an_old_path_is_the_module_at_the_new_one_and_says_so_once() -> None:
    sys.modules.pop("liex_lab.camera", None)
    with pytest.warns(
        FutureWarning, match=r"liex_lab\.camera has moved to liex_lab\.optics\.camera"
    ) as told:
        old = import_module("liex_lab.camera")
    import_module("liex_lab.camera")
    assert len(told) == 1
    assert old is import_module("liex_lab.optics.camera")
    assert old.__spec__ is not None
    assert old.__name__ == "liex_lab.optics.camera" == old.__spec__.name


def test_a_script_that_used_the_documented_path_still_runs_and_is_told() -> None:
    code = "from liex_lab.recordings.nyu import read_nyu_joints; print(read_nyu_joints.__module__)"
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    assert ran.stdout.strip() == "liex_lab.recordings.formats.images.nyu"
    assert ran.stderr.count("has moved to liex_lab.recordings.formats.images.nyu") == 1
