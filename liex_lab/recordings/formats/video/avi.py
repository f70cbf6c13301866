"""Index of an AVI (RIFF) file: one walk over its chunks, which reads files without an index or cut.

Times are steps of the stream's constant rate; an empty chunk stands for a dropped picture.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

from liex_lab.errors import RecordingError
from liex_lab.recordings.formats.video.index import DepthTrack, even_times
from liex_lab.recordings.infrared import is_infrared
from liex_lab.runtime.progress import Progress

_CHUNK = struct.Struct("<4sI")  # name, length of what follows
_LISTS = (
    b"AVI ",
    b"AVIX",
    b"hdrl",
    b"strl",
    b"movi",
    b"rec ",
)  # what is stepped into; other lists are passed over
_STREAM = struct.Struct(
    "<4s4sIHHIIIII"
)  # strh: kind, codec, flags, priority, language, initial, scale, rate, start, n
_HEADER_BYTES = 1 << 16


class _Chunk(NamedTuple):
    name: bytes
    start: int
    size: int


def index_avi(path: Path, progress: Progress) -> DepthTrack:
    """Find the pictures of the first video stream of an AVI file.

    Args:
        path: the .avi file.
        progress: told how many MB were walked over.

    Returns:
        Where the pictures lie, with the times of a constant rate: an AVI knows no others.

    Raises:
        RecordingError: the file is no RIFF file.
    """
    size = path.stat().st_size
    track = DepthTrack(even=True)
    slots = []
    n_slots = 0
    kinds: list[bytes] = []  # of the streams, in order
    scale = rate = n_stated = 0
    number = b""
    with path.open("rb", buffering=0) as file:
        if file.read(4) != b"RIFF":
            raise RecordingError(
                f"{path} is named like an AVI video but holds something else; give another file"
            )
        for chunk in _walk(file, size, track):
            if chunk.name == b"strh" and chunk.size >= _STREAM.size:
                kind, *_, a, b, _, n = _STREAM.unpack(_read(file, chunk)[: _STREAM.size])
                kinds.append(kind)
                if kind == b"vids" and not number:
                    track.title = ""
                    number = b"%02d" % (len(kinds) - 1)
                    scale = a
                    rate = b
                    n_stated = n
            elif chunk.name == b"strf" and kinds and number == b"%02d" % (len(kinds) - 1):
                track.take_bitmap_header(_read(file, chunk))
            elif chunk.name == b"strn" and kinds and number == b"%02d" % (len(kinds) - 1):
                track.title = _read(file, chunk).decode("utf-8", "replace").rstrip("\0")
                if is_infrared(track.title):  # the next stream may be depth
                    number = b""
            elif number and chunk.name in (number + b"dc", number + b"db"):
                if chunk.size:  # an empty chunk stands for a picture that was dropped
                    track.offsets.append(chunk.start)
                    track.sizes.append(chunk.size)
                    slots.append(n_slots)
                n_slots += 1
                progress(chunk.start >> 20, (size >> 20) + 1, "looking through the video (MB)")
    if scale and rate:
        track.times_ns = even_times(slots, scale, rate)
    track.whole = track.whole and n_slots >= n_stated
    return track


def _walk(file: IO[bytes], size: int, track: DepthTrack) -> Iterator[_Chunk]:
    """Every chunk that lies whole in the file, lists stepped into; marks the track where the file
    breaks off.
    """
    at = 0
    while at + _CHUNK.size <= size:
        file.seek(at)
        name, length = _CHUNK.unpack(file.read(_CHUNK.size))
        start = at + _CHUNK.size
        if not all(
            32 <= byte < 127 for byte in name
        ):  # no chunk's name: what follows cannot be told from noise
            track.whole = False
            return
        if name in (b"RIFF", b"LIST") and file.read(4) in _LISTS:
            # a program that was stopped leaves the length of its lists at 0
            track.whole = track.whole and 4 <= length <= size - start
            at = start + 4
            continue
        if start + length > size:
            track.whole = False
            return
        yield _Chunk(name, start, length)
        at = start + length + length % 2


def _read(file: IO[bytes], chunk: _Chunk) -> bytes:
    file.seek(chunk.start)
    return file.read(min(chunk.size, _HEADER_BYTES))
