"""Bounds of a NumPy archive (.npz) from somewhere else, checked before any of it is unpacked.

A few kilobytes can claim, or unpack to, any amount of memory. The directory of the archive and the
header of each array say how much it would be; unpacking stops at what the directory says.
"""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import IO

import numpy as np

_HEADS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def check_npz(source: Path | IO[bytes], most_bytes: int) -> None:
    """Check that an .npz holds arrays of plain numbers, and no more of them than it may.

    Args:
        source: the file.
        most_bytes: bytes of all arrays together.

    Raises:
        ValueError: it holds more, an array is larger than its part of the file, or it is no
            archive of arrays.
    """
    try:
        with zipfile.ZipFile(source) as archive:
            entries = archive.infolist()
            total = sum(entry.file_size for entry in entries)
            if total > most_bytes:
                raise ValueError(
                    f"it unpacks to {total / 1e9:.1f} GB, and at most {most_bytes / 1e9:.1f} GB "
                    "are expected"
                )
            for entry in entries:
                with archive.open(entry) as file:
                    _check_array(file, entry)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, OverflowError) as error:
        raise ValueError(f"it is no archive of arrays ({error})") from None
    if not isinstance(source, Path):
        source.seek(0)


def _check_array(file: IO[bytes], entry: zipfile.ZipInfo) -> None:
    """Raises ValueError where an array's header claims another size than its file has."""
    version = np.lib.format.read_magic(file)
    if version not in _HEADS:
        raise ValueError(f"{entry.filename} has a header of an unknown kind")
    shape, _, dtype = _HEADS[version](file)
    if dtype.hasobject:
        raise ValueError(f"{entry.filename} does not hold plain numbers")
    if math.prod(shape) * dtype.itemsize > entry.file_size:
        raise ValueError(f"{entry.filename} claims {shape} numbers, more than there are")
