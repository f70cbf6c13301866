"""Damaged files of every format that is read, and damaged files of sessions, by the thousand.

Each file is read in a process that may grow by little memory and has little time; a process that
dies is a fault of its own.
"""

import multiprocessing
import shutil
import tempfile
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.campaign.tally import Tally

_BLOCK = 100  # files that one process reads
_SESSION_SHARE = 0.2


class Block(NamedTuple):
    """Files that one process reads.

    Attributes:
        what: name of a format, or 'session'.
        first: seed of the first of them.
        n: how many.
    """

    what: str
    first: int
    n: int


class Read(NamedTuple):
    """What became of one file: s that it took, and what was wrong with it, if anything."""

    kind: str
    seconds: float
    wrong: str
    traceback: bool


def damaged(n: int, seed: int) -> Tally:
    """Damage n files; each gives what is whole in it, or one sentence, within 5 s.

    Args:
        n: files over all formats and the files of sessions.
        seed: number of the first damage.
    """
    from tests.recordings.every_format import FORMATS

    of_each = -(-round(n * (1.0 - _SESSION_SHARE)) // len(FORMATS))
    blocks = [
        Block(form.name, first, min(_BLOCK, of_each + seed - first))
        for form in FORMATS
        for first in range(seed, seed + of_each, _BLOCK)
    ]
    n_sessions = max(0, n - of_each * len(FORMATS))
    blocks += [
        Block("session", first, min(_BLOCK, n_sessions + seed - first))
        for first in range(seed, seed + n_sessions, _BLOCK)
    ]
    tally = Tally()
    context = multiprocessing.get_context("spawn")
    for block in blocks:
        told, tell = context.Pipe(duplex=False)
        process = context.Process(target=_read_block, args=(block, tell))
        process.start()
        tell.close()
        n_read = 0
        while True:
            try:
                one: Read = told.recv()
            except EOFError:
                break
            n_read += 1
            tally.fault(one.kind, one.seconds, wrong=one.wrong, traceback=one.traceback)
        process.join()
        if n_read < block.n:
            wrong = (
                f"its process died (exit code {process.exitcode}) at seed {block.first + n_read}"
            )
            tally.fault(block.what, wrong=wrong)
    return tally


def _read_block(block: Block, tell: Connection) -> None:
    """Damage the files of a block one by one, and tell what became of each."""
    from liex_lab.errors import LiexError

    with tempfile.TemporaryDirectory() as scratch:
        reading = _session(Path(scratch)) if block.what == "session" else _format(block, scratch)
        for number in range(block.first, block.first + block.n):
            began = time.monotonic()
            wrong, traceback = "", False
            try:
                reading(number)
            except Exception as error:
                wrong = f"seed {number}: {type(error).__name__}: {error}"
                traceback = not isinstance(error, AssertionError | LiexError | TimeoutError)
            tell.send(Read(block.what, time.monotonic() - began, wrong, traceback))


def _format(block: Block, scratch: str) -> Callable[[int], None]:
    """How a recording of a format is damaged, read and put right again."""
    from liex_lab.recordings import open_recording
    from tests.recordings import test_damage as law
    from tests.recordings.every_format import FORMATS

    form = next(form for form in FORMATS if form.name == block.what)
    (sound := Path(scratch) / "whole").mkdir()
    whole = form.write(sound, law.STORED)
    size = sum(file.stat().st_size for file in law.files_of(whole))
    with open_recording(whole) as recording:  # imports and compiled kernels are not the file's
        law.read_all(recording, len(law.STORED))
    shutil.copytree(sound, Path(scratch) / "damaged")
    opened = Path(scratch) / "damaged" / whole.relative_to(sound)

    def reading(number: int) -> None:
        done = law.damage(np.random.default_rng([number, len(form.name)]), opened)
        try:
            with law.little_time(), law.little_memory(4 * size + 300_000_000):
                law.check(form, whole, opened, done)
        finally:
            path = sound / done.file.relative_to(Path(scratch) / "damaged")
            done.file.write_bytes(path.read_bytes())

    return reading


def _session(scratch: Path) -> Callable[[int], None]:
    """How a file of a session is damaged, read and put right again."""
    from tests.recordings import test_damage as law
    from tests.sessions import test_damaged_sessions as sessions

    mouse = sessions.WalkingMouse(sessions.steady(1.0))
    whole = sessions.write(scratch / "whole.liex", mouse).path
    sessions.add_evidence(whole)
    copy = Path(shutil.copytree(whole, scratch / "copy.liex"))
    sessions.read_all(copy)

    def reading(number: int) -> None:
        done = law.damage(np.random.default_rng([number, 7]), copy)
        try:
            with law.little_time(), law.little_memory(500_000_000):
                sessions.read_all(copy)
        finally:
            done.file.write_bytes((whole / done.file.relative_to(copy)).read_bytes())

    return reading
