"""Kernels have a place wherever liex starts, and none that somebody else could have filled."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from liex_lab.runtime import kernel_cache
from liex_lab.runtime.kernel_cache import VARIABLE, keep_kernels
from liex_lab.runtime.kernels import ignore_outdated_kernels
from tests.conftest import REPOSITORY


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An account without home, of a package that it cannot write; returns its TMPDIR."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", os.devnull + "/none")
    monkeypatch.setattr(kernel_cache, "_ROOM", Path(os.devnull))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    return tmp_path


def test_nothing_is_changed_where_there_is_a_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert keep_kernels() == ""
    assert VARIABLE not in os.environ


def test_an_account_without_a_place_gets_its_own_below_tmpdir(nowhere: Path) -> None:
    said = keep_kernels()
    place = Path(os.environ.pop(VARIABLE))
    assert place.parent == nowhere
    assert place.stat().st_mode & 0o077 == 0
    assert str(place) in said
    assert VARIABLE in said


@pytest.mark.skipif(sys.platform == "win32", reason="accounts differ")
@pytest.mark.parametrize("kind", ["link", "open"])
def test_a_folder_that_somebody_else_may_have_filled_is_not_used(kind: str, nowhere: Path) -> None:
    trap = nowhere / f"liex-kernels-{os.getuid()}"
    if kind == "link":
        (nowhere / "theirs").mkdir()
        trap.symlink_to(nowhere / "theirs")
    else:
        trap.mkdir()
        trap.chmod(0o777)
    keep_kernels()
    place = Path(os.environ.pop(VARIABLE))
    assert place != trap
    assert place.stat().st_mode & 0o077 == 0


def test_no_place_at_all_is_told(nowhere: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", os.devnull)
    assert VARIABLE in keep_kernels()
    assert VARIABLE not in os.environ


def test_liex_starts_where_a_stated_place_cannot_be_written() -> None:
    code = "import liex_lab.geometry._kernels, os; print(os.environ['NUMBA_CACHE_DIR'])"
    environment = {**os.environ, VARIABLE: os.devnull + "/none"}
    ran = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    assert "liex-kernels-" in ran.stdout


def test_an_index_that_names_an_earlier_type_is_empty(monkeypatch: pytest.MonkeyPatch) -> None:
    from numba.core.caching import IndexDataCacheFile

    monkeypatch.setattr(IndexDataCacheFile, "_load_index", lambda self: self.renamed)
    ignore_outdated_kernels()
    assert IndexDataCacheFile._load_index(object()) == {}


@pytest.mark.nightly
def test_kernels_of_an_earlier_version_are_compiled_again(tmp_path: Path) -> None:
    """Their index names a record type that has another name now."""
    source = """
from typing import NamedTuple
from liex_lab.runtime.kernels import kernel

class {name}(NamedTuple):
    value: float

@kernel()
def doubled(record):
    return 2.0 * record.value

print(doubled({name}(21.0)))
"""
    for name in ("Earlier", "Present"):
        (tmp_path / "kernels.py").write_text(source.format(name=name), encoding="utf-8")
        ran = subprocess.run(
            [sys.executable, "-c", "import liex_lab, kernels"],
            cwd=tmp_path,
            env=os.environ | {VARIABLE: str(tmp_path / "cache"), "PYTHONPATH": str(REPOSITORY)},
            capture_output=True,
            text=True,
        )
        assert ran.stdout.strip() == "42.0", ran.stderr
