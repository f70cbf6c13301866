"""Import hook (a meta path finder) for packages beside the library and for paths that are gone.

`liex_lab.pipelines` and `liex_lab.dashboards` are folders of the library where it is installed, and
folders beside it in a clone. A documented path of an earlier version that is gone raises an error
that names its successor. Only numba may still ask for others: its cache of an earlier version names
the record types of that version, and numba resolves these names before it finds the cache outdated.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.abc import Loader
else:  # importlib.abc imports tempfile and random, for a base class that nothing checks
    Loader = object

BESIDE = ("liex_lab.pipelines", "liex_lab.dashboards")
GONE = {"liex_lab.recordings.nyu": "liex_lab.recordings.formats.images.nyu"}
_LIBRARY = Path(__file__).resolve().parent


class _OutdatedModule(ModuleType):
    """A module of an earlier version, as numba's cache names it: any name is an empty class."""

    def __getattr__(self, name: str) -> type:
        """An empty class."""
        if name.startswith("__"):
            raise AttributeError(name)
        return type(name, (), {})


class _OutdatedLoader(Loader):
    """Loads `_OutdatedModule`s."""

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """The empty module."""
        return _OutdatedModule(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Run nothing."""


class _PathFinder:
    """Finds `BESIDE` in a clone, and refuses `GONE`, after every other finder."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Spec of a package beside the library or of an outdated module, else None.

        Raises:
            ModuleNotFoundError: the path is gone; the message names its successor.
        """
        if name in GONE:
            raise ModuleNotFoundError(f"{name} is now {GONE[name]}; import it from there")
        package = _LIBRARY.parent / name.removeprefix("liex_lab.") / "__init__.py"
        if name in BESIDE and package.is_file():
            return spec_from_file_location(name, package)
        if name.startswith("liex_lab.") and _reads_numba_cache():
            return ModuleSpec(name, _OutdatedLoader(), is_package=True)
        return None


def _reads_numba_cache() -> bool:
    """Whether this import is part of reading numba's cache."""
    frame = sys._getframe()
    while frame.f_back is not None:
        frame = frame.f_back
        if frame.f_globals.get("__name__") == "numba.core.caching":
            return True
    return False


def install_path_finder() -> None:
    """Let this process find the packages beside the library."""
    if not any(isinstance(finder, _PathFinder) for finder in sys.meta_path):
        sys.meta_path.append(_PathFinder())
