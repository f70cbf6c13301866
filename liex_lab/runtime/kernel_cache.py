"""Fallback cache folder for compiled kernels if neither the package nor the home is writable.

numba caches machine code next to the package or in the home's cache and does not start without
either, as in a container or for a service account. Cached code is executed, so a folder in a shared
TMPDIR is used only if this account owns it and nobody else can write to it.
"""

import os
import stat
import sys
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"
_ROOM = Path(__file__).resolve().parents[1] / "scene"  # one of the packages with kernels


def keep_kernels() -> str:
    """Ensure that numba has a writable cache folder.

    Returns:
        A message if the folder is temporary or missing; "" if nothing had to be done.
    """
    stated = os.environ.get(VARIABLE)
    places = [Path(stated)] if stated else [_ROOM / "__pycache__", _home_cache()]
    if any(_writable(place) for place in places):
        return ""
    place = _temporary()
    if place is None:
        return (
            "there is no folder that compiled kernels can be kept in; name one that this account "
            f"may write with {VARIABLE}"
        )
    os.environ[VARIABLE] = str(place)
    if "numba" in sys.modules:
        import numba

        numba.config.CACHE_DIR = str(place)
    return (
        f"compiled kernels are kept in {place}, as this account has no other place for them; name "
        f"a lasting one with {VARIABLE}"
    )


def _home_cache() -> Path:
    """Folder of numba's cache in the home; a path that cannot exist if there is no home."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "numba"
    except RuntimeError:  # there is no home
        return Path(os.devnull) / "none"


def _writable(place: Path) -> bool:
    """Whether a folder is writable or can be created."""
    try:
        there = next(folder for folder in (place, *place.parents) if folder.exists())
        return there.is_dir() and os.access(there, os.W_OK | os.X_OK)
    except (OSError, StopIteration):
        return False


def _temporary() -> Path | None:
    """This account's own folder in TMPDIR; None if it cannot be created."""
    import tempfile

    try:
        account = os.getuid() if hasattr(os, "getuid") else "kernels"
        place = Path(tempfile.gettempdir()) / f"liex-kernels-{account}"
        place.mkdir(mode=0o700, exist_ok=True)
        found = place.lstat()
        own = stat.S_ISDIR(found.st_mode) and (
            not hasattr(os, "getuid") or (found.st_uid == os.getuid() and not found.st_mode & 0o077)
        )
        return place if own else Path(tempfile.mkdtemp(prefix="liex-kernels-"))
    except OSError:
        return None
