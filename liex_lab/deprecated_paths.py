"""Import hook (a meta path finder) for packages beside the library and for paths that are gone.

`liex_lab.pipelines` and `liex_lab.dashboards` are folders of the library where it is installed, and
folders beside it in a clone. A documented path of an earlier version that is gone raises an error
that names its successor.
"""

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType

BESIDE = ("liex_lab.pipelines", "liex_lab.dashboards")
GONE = {"liex_lab.recordings.nyu": "liex_lab.recordings.formats.images.nyu"}
_LIBRARY = Path(__file__).resolve().parent


class _PathFinder:
    """Finds `BESIDE` in a clone, and refuses `GONE`, after every other finder."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Spec of a package beside the library, else None.

        Raises:
            ModuleNotFoundError: the path is gone; the message names its successor.
        """
        if name in GONE:
            raise ModuleNotFoundError(f"{name} is now {GONE[name]}; import it from there")
        package = _LIBRARY.parent / name.removeprefix("liex_lab.") / "__init__.py"
        if name in BESIDE and package.is_file():
            return spec_from_file_location(name, package)
        return None


def install_path_finder() -> None:
    """Let this process find the packages beside the library."""
    if not any(isinstance(finder, _PathFinder) for finder in sys.meta_path):
        sys.meta_path.append(_PathFinder())
