"""HDF5 files that are made in memory and written in one go.

HDF5 does not survive a disk that gets full under it: what it could not write it tries again at the
interpreter's exit, with tracebacks from its own code and sometimes a crash. In memory it meets no
disk, and the one write that does is Python's, whose error is a sentence.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import h5py


@contextmanager
def hdf5_file(path: Path) -> Iterator[h5py.File]:
    """An empty HDF5 file to fill, which is written when it has been filled without an error.

    Args:
        path: where it is written.

    Raises:
        OSError: it cannot be written there.
    """
    import h5py

    memory = io.BytesIO()
    with h5py.File(memory, "w") as file:
        yield file
    path.write_bytes(memory.getbuffer())
