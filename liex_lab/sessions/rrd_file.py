"""Messages of a Rerun file (.rrd): a header of 12 bytes, then messages that each begin with their
kind and length, 8 bytes each.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

from liex_lab.errors import SessionError

HEAD = 12  # magic, version and options
_END = 0  # kind of the message that ends a stream
_BLOCK = 1 << 22


def rrd_messages(path: Path, start: int = HEAD) -> Iterator[tuple[int, int]]:
    """Offset and length of each message, up to the end message if there is one.

    Args:
        path: the .rrd file.
        start: offset of the first message to read.

    Raises:
        SessionError: a message is cut, so the file was not written whole.
    """
    size = path.stat().st_size
    at = start
    with path.open("rb") as file:
        while at < size:
            file.seek(at)
            head = file.read(16)
            kind, length = struct.unpack("<QQ", head) if len(head) == 16 else (0, size)
            if at + 16 + length > size:
                raise SessionError(
                    "the replay was not written whole; make room on the disk and run it again"
                )
            if kind == _END:
                return
            yield at, 16 + length
            at += 16 + length


def append_rrd(source: Path, target: Path) -> None:
    """Append the messages of an .rrd file to another one, which is made if it does not exist.

    The index that ends a file is left out, for it counts from the file's own beginning.

    Raises:
        SessionError: the last message of `source` is cut.
    """
    end = max((at + length for at, length in rrd_messages(source)), default=HEAD)
    with source.open("rb") as file, target.open("ab") as whole:
        file.seek(HEAD if whole.tell() else 0)
        while block := file.read(min(_BLOCK, end - file.tell())):
            whole.write(block)
