"""An unfinished session: a folder beside the final place that says how far the work has come, so
that it can go on.

What was seen in the frames lies in it as plain arrays that only grow; the logs (replay, MCAP) grow
beside them. Every few seconds `checkpoint.json` takes down, by a rename, how long all of them were
at one moment. Whatever lies behind that is cut off before the work goes on.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import SessionError
from liex_lab.sessions.failure import write_whole
from liex_lab.sessions.lock import take_lock

EVERY_S = (
    3.0  # between two checkpoints: as much work is lost at most, besides what it takes to begin
)
_STATE = "checkpoint.json"
_LOCK = "lock"
_SEEN = "seen"
_INPUT = "input.json"
STRETCHES = "stretches"
# of work: three hundred years; whole numbers beyond what a float holds are no seconds either
_MOST_S = 1e10
_MOST = 1 << 20  # values of one column that a frame may have
OWN = (_STATE, _LOCK, _SEEN, _INPUT, STRETCHES)  # what is no part of the finished session

if TYPE_CHECKING:
    from liex_lab.recordings.recording import Recording
    from liex_lab.runtime.progress import Progress

LOGS = ("session.rrd", "session.mcap")
Clock = Callable[[], float]


@dataclass
class State:
    """How far a session is. n_frames: written and seen; seconds: spent on them; runs: parts that
    each log is in, one for each time that the work was begun and for each of the stretches that
    others wrote.

    logs: for each part of each log its bytes, in the order of writing: "session.mcap" -> [1200,
    5030].
    """

    key: str
    n_frames: int = 0
    seconds: float = 0.0
    runs: int = 1
    logs: dict[str, list[int]] = field(default_factory=dict)
    stretches: int = 0


class Checkpoint:
    """The folder of an unfinished session, held by this process alone."""

    def __init__(
        self, folder: Path, facts: Mapping[str, Any], clock: Clock = time.monotonic
    ) -> None:
        """Begin, or go on where a session of the same facts (JSON) was left. clock: seconds that
        never jump.
        """
        folder.mkdir(parents=True, exist_ok=True)
        check_free(folder)
        held = take_lock(folder / _LOCK)
        if held is None:  # taken in between
            raise SessionError(
                f"another process has just begun to write {folder}; wait until it is done"
            )
        self.folder = folder
        self._held = held
        self._clock = clock
        text = json.dumps(facts, sort_keys=True, default=str)
        key = hashlib.sha256(text.encode()).hexdigest()
        state = _read_state(folder / _STATE)
        if state is None or state.key != key or not self._cut(state):
            self._empty()
            state = State(key)
        else:
            state.runs += 1
        self.state = state
        self.seconds_before = state.seconds
        (folder / _SEEN).mkdir(exist_ok=True)
        self.seen = Columns(folder / _SEEN)
        self._last = clock()

    @property
    def due(self) -> bool:
        """Whether the last checkpoint was long enough ago."""
        return self._clock() - self._last >= EVERY_S

    def save(self, n_frames: int, seconds: float, logs: Mapping[str, int]) -> None:
        """Take down that everything up to a frame is on disk; logs: the bytes of each log's present
        part.
        """
        self.seen.flush()
        present = {
            name: [*self.state.logs.get(name, [])[: self.n_parts - 1], size]
            for name, size in logs.items()
        }
        self._keep(
            State(
                self.state.key,
                n_frames,
                round(seconds, 3),
                self.state.runs,
                present,
                self.state.stretches,
            )
        )

    def take(self, n_frames: int, seconds: float, logs: Mapping[str, Path]) -> None:
        """Take over the next part of each log, written by another process; what was seen in it is
        in `seen` already.
        """
        self.seen.flush()
        sizes = {}
        k = self.n_parts - 1
        for log, path in logs.items():
            sizes[log] = [*self.state.logs.get(log, [])[:k], path.stat().st_size]
            path.replace(self.part(log, k))
        self._keep(
            State(
                self.state.key, n_frames, round(seconds, 3), k + 1, sizes, self.state.stretches + 1
            )
        )
        self.state.runs += 1  # the next part, not begun yet

    def _keep(self, state: State) -> None:
        write_whole(self.folder / _STATE, json.dumps(vars(state)))
        self.state, self._last = state, self._clock()

    def begin_to_take(self) -> None:
        """Take down that nothing is there yet, so that what others write meanwhile is kept."""
        if not (self.folder / _STATE).is_file():
            self._keep(State(self.state.key, runs=0))
            self.state.runs = 1

    @property
    def n_parts(self) -> int:
        """Parts of each log: one, and one more for each time the work went on or a stretch was
        taken over.
        """
        return self.state.runs

    @property
    def n_interruptions(self) -> int:
        """How often the work was interrupted."""
        return max(0, self.n_parts - 1 - self.state.stretches)

    def part(self, log: str, number: int) -> Path:
        """Where a part of a log lies; the first one under the log's own name."""
        path = self.folder / log
        return path if number == 0 else path.with_name(f"{path.stem}-{number}{path.suffix}")

    def parts(self, log: str) -> list[tuple[Path, int | None]]:
        """The parts of a log in order, with the bytes of each that count; None for all of the
        present one.
        """
        sizes: list[int | None] = [*self.state.logs.get(log, [])[: self.n_parts - 1], None]
        return [(self.part(log, k), size) for k, size in enumerate(sizes)]

    @property
    def logs(self) -> dict[str, Path]:
        """Each log's name in the finished session, and where it lies when it is joined."""
        joined = "" if self.n_parts == 1 else "whole-"
        return {log: self.folder / f"{joined}{log}" for log in LOGS}

    def join_logs(self) -> None:
        """Logs that were written in parts, for the work was interrupted, become one each."""
        from liex_lab.sessions.joining import join_mcap, join_rrd

        if self.n_parts > 1:
            for (log, whole), join in zip(self.logs.items(), (join_rrd, join_mcap), strict=True):
                join(self.parts(log), whole)

    def drop_parts(self) -> None:
        """The joined logs take the place of their parts, from which the work could have gone on
        until now.
        """
        if self.n_parts > 1:
            for log, whole in self.logs.items():
                for path, _ in self.parts(log)[1:]:
                    path.unlink()
                whole.replace(self.folder / log)

    def tidy(self, folder: Path) -> None:
        """Remove what is no part of the finished session from where it is now, and let go of it."""
        self.seen.close()
        for name in OWN:
            path = folder / name
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        self._held.close()

    def leave(self, keep: bool) -> None:
        """Let go of the folder; keep: so that the work can go on later, otherwise nothing stays."""
        self.seen.close()
        if not (keep and (self.folder / _STATE).is_file()):
            shutil.rmtree(self.folder, ignore_errors=True)
        self._held.close()

    def _cut(self, state: State) -> bool:
        """Cut everything back to the checkpoint; False where something is shorter than it says."""
        for log, sizes in state.logs.items():
            for k, size in enumerate(sizes):
                path = self.part(log, k)
                if not path.is_file() or path.stat().st_size < size:
                    return False
                with path.open("r+b") as file:
                    file.truncate(size)
        for (
            path
        ) in self.folder.iterdir():  # half-written tables, and parts begun after the checkpoint
            known = {
                self.part(log, k).name
                for log, sizes in state.logs.items()
                for k in range(len(sizes))
            }
            if path.name not in {*OWN, *known}:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        return Columns.cut(self.folder / _SEEN, state.n_frames)

    def _empty(self) -> None:
        for path in self.folder.iterdir():
            if path.name not in (_LOCK, _INPUT):
                shutil.rmtree(path) if path.is_dir() else path.unlink()


class Columns:
    """Arrays on disk that grow by rows, one file each, and a small text that says what they hold,
    in order.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._kinds = _read_kinds(folder) or {}
        self._files: dict[str, IO[bytes]] = {}

    def append(self, columns: Mapping[str, NDArray[Any]]) -> None:
        """The next rows (n, ...) of every column."""
        kinds = {
            name: (values.dtype.str, list(values.shape[1:])) for name, values in columns.items()
        }
        if not self._kinds:
            write_whole(self._folder / "columns.json", json.dumps(kinds))
            self._kinds = kinds
        if kinds != self._kinds:
            raise ValueError(f"columns {kinds} were to be appended to {self._kinds}")
        for name, values in columns.items():
            if name not in self._files:
                self._files[name] = (self._folder / f"{name}.bin").open("ab")
            self._files[name].write(np.ascontiguousarray(values).tobytes())

    def __len__(self) -> int:
        """Rows so far."""
        self.flush()
        for name, (kind, shape) in self._kinds.items():
            row = np.dtype(kind).itemsize * int(np.prod(shape))
            return (self._folder / f"{name}.bin").stat().st_size // row
        return 0

    def flush(self) -> None:
        """Hand everything to the system."""
        for file in self._files.values():
            file.flush()

    def close(self) -> None:
        """Let go of the files."""
        for file in self._files.values():
            file.close()
        self._files.clear()

    def read(self) -> dict[str, NDArray[Any]]:
        """All rows of every column, in memory that the system may take back; empty where none was
        written.
        """
        self.flush()
        return {
            name: np.memmap(self._folder / f"{name}.bin", np.dtype(kind), "c").reshape(-1, *shape)
            for name, (kind, shape) in self._kinds.items()
            if (self._folder / f"{name}.bin").stat().st_size
        }

    @staticmethod
    def cut(folder: Path, n: int) -> bool:
        """Cut every column back to n rows; False where one has fewer."""
        kinds = _read_kinds(folder)
        if kinds is None:
            return n == 0
        for name, (kind, shape) in kinds.items():
            path = folder / f"{name}.bin"
            size = n * np.dtype(kind).itemsize * int(np.prod(shape))
            if not path.is_file() or path.stat().st_size < size:
                return False
            with path.open("r+b") as file:
                file.truncate(size)
        return True


def hash_once(recording: Recording, folder: Path, progress: Progress) -> None:
    """Have the recording's hash, which takes long for hours of it, from an interrupted run where
    its files are as then.

    folder: of the unfinished session.
    """
    stamp = recording.stamp
    try:
        found = json.loads((folder / _INPUT).read_text(encoding="utf-8"))
        if stamp and found["stamp"] == stamp:
            recording.take_digest(str(found["sha256"]))
    except (OSError, ValueError, KeyError, TypeError):
        pass
    began = time.monotonic()
    digest = recording.digest(progress)
    if stamp and time.monotonic() - began > EVERY_S:
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / _INPUT, json.dumps({"stamp": stamp, "sha256": digest}))


def check_free(folder: Path) -> None:
    """Refuse an unfinished session's folder that another process writes."""
    if (folder / _LOCK).is_file():
        held = take_lock(folder / _LOCK)
        if held is None:
            raise SessionError(
                f"another process is writing the session {folder.with_suffix('').name} into "
                f"{folder.parent}; wait until it is done, or choose another place with --out"
            )
        held.close()


def _read_state(path: Path) -> State | None:
    """The state in a file; None where there is none that could be gone on with."""
    try:
        state = State(**json.loads(path.read_text(encoding="utf-8")))
        sizes = [size for log in state.logs.values() for size in log]
        counts = [state.n_frames, state.runs, state.stretches, *sizes]
        sound = isinstance(state.key, str) and 0.0 <= state.seconds < _MOST_S
        sound = sound and all(isinstance(n, int) and n >= 0 for n in counts)
        sound = sound and all(
            log in LOGS and len(parts) == state.runs for log, parts in state.logs.items()
        )
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return None
    return state if sound else None


def _read_kinds(folder: Path) -> dict[str, tuple[str, list[int]]] | None:
    """What columns.json says of the columns: dtype and shape of a row by name; None where it makes
    no sense.
    """
    try:
        found: dict[str, Any] = json.loads((folder / "columns.json").read_text(encoding="utf-8"))
        kinds = {
            name: (np.dtype(str(kind)), [int(n) for n in shape])
            for name, (kind, shape) in found.items()
        }
    except (OSError, ValueError, AttributeError, TypeError, RecursionError, OverflowError):
        return None
    sound = all(name.isidentifier() and dtype.kind in "biufU" for name, (dtype, _) in kinds.items())
    sound = sound and all(0 <= n < _MOST for _, shape in kinds.values() for n in shape)
    return {name: (dtype.str, shape) for name, (dtype, shape) in kinds.items()} if sound else None
