"""The files that a recording is read from: their SHA-256, and what happened to them meanwhile."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from liex_lab.runtime.progress import Progress, silent

Stamp = list[list[str | int]]

_BLOCK = 1 << 24  # bytes read at once: after each, other threads may hold Python's lock for a while
_GONE = -1  # size of a file that is not there


class SourceFiles:
    """The input files of a recording, none of one that is in no file; its slices share them.

    Attributes:
        paths: the files.
        stamp_at_opening: their `stamp` when the recording was opened.
    """

    def __init__(self, paths: Iterable[Path] = ()) -> None:
        """Note how the files are now.

        Args:
            paths: the files.
        """
        self.paths = tuple(paths)
        self.stamp_at_opening = self.stamp
        self._digest: str | None = None

    @property
    def stamp(self) -> Stamp:
        """Name, size (bytes) and modification time (ns) of each file, in order.

        It shows cheaply whether a file changed. Of a file that is gone the size is -1.
        """
        found: Stamp = []
        for path in self.paths:
            try:
                now = path.stat()
            except OSError:
                found.append([path.name, _GONE, 0])
            else:
                found.append([path.name, now.st_size, now.st_mtime_ns])
        return sorted(found)

    @property
    def has_digest(self) -> bool:
        """Whether the digest is known already."""
        return self._digest is not None

    def digest(self, progress: Progress = silent) -> str:
        """SHA-256 of the files, see `file_digest`; computed once and kept.

        Args:
            progress: told how many MB were read.
        """
        if self._digest is None:
            self._digest = file_digest(self.paths, progress)
        return self._digest

    def take_digest(self, digest: str) -> None:
        """Accept a digest that was computed before, for the files have not changed since.

        Args:
            digest: the SHA-256, in hexadecimal.
        """
        self._digest = digest

    def rewritten(self) -> tuple[str, ...]:
        """That files were written to since the recording was opened, in a sentence; () if not.

        A file that only grew is another matter, see `grown`; one that was removed goes on being
        read.
        """
        names = [
            name
            for (name, size, time), (_, before, then) in self._beside()
            if size != _GONE and (size < before or (size == before and time != then))
        ]
        return _said(
            names,
            "changed while the recording was measured, so that frames of two recordings may be "
            "mixed; run it again",
        )

    def grown(self) -> tuple[str, ...]:
        """That files grew since the recording was opened, in a sentence; () if not."""
        names = [name for (name, size, _), (_, before, _) in self._beside() if size > before]
        return _said(
            names,
            "grew while the recording was measured; what was appended is not in the session",
        )

    def _beside(self) -> list[tuple[tuple[str, int, int], tuple[str, int, int]]]:
        """Each file's stamp now and at opening."""
        return [
            ((str(a[0]), int(a[1]), int(a[2])), (str(b[0]), int(b[1]), int(b[2])))
            for a, b in zip(self.stamp, self.stamp_at_opening, strict=True)
        ]


def file_digest(files: Iterable[Path], progress: Progress = silent) -> str:
    """SHA-256 of one file, or of several files together.

    Of one file its bytes; of several, for each in order of name its name, its size and its bytes.

    Args:
        files: the paths of the files, in any order.
        progress: told how many MB were read.

    Returns:
        64 hexadecimal digits.
    """
    ordered = sorted(files, key=lambda path: path.name)
    sizes = [path.stat().st_size for path in ordered]
    whole = hashlib.sha256()
    done = 0
    room = memoryview(bytearray(_BLOCK))  # new memory for each block takes as long as reading it
    total = (sum(sizes) >> 20) + 1
    for path, size in zip(ordered, sizes, strict=True):
        if len(ordered) > 1:
            whole.update(f"{path.name}\0{size}\0".encode())
        with path.open("rb", buffering=0) as file:
            while n := file.readinto(room):
                whole.update(room[:n])
                done += n
                progress(done >> 20, total, "reading the recording's hash (MB)")
    return whole.hexdigest()


def _said(names: list[str], what: str) -> tuple[str, ...]:
    """What happened to one file by its name, or to how many; () to none."""
    if not names:
        return ()
    return (f"{names[0] if len(names) == 1 else f'{len(names)} files'} {what}",)
