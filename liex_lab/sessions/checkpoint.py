"""Checkpoint and restart of an unfinished session: append-only files and a record of their lengths.

An unfinished session is a folder next to the final one. It contains the observations of its frames
as plain, growing arrays, and the two logs, session.rrd and session.mcap. Every few seconds
`checkpoint.json` records, by an atomic rename, how many bytes of each file were valid at one
moment. Any later bytes are truncated before the work resumes. Rerun cannot append to a file, so a
resumed run writes resumed.rrd, whose messages are appended to session.rrd later.
"""

import hashlib
import json
import os
import shutil
import struct
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, TypeAdapter

from liex_lab.errors import SessionError
from liex_lab.recordings.formats.messages.mcap import MAGIC, RECORD
from liex_lab.runtime import durable, memory

# between two checkpoints: the most work that can be lost, besides startup
EVERY_S = 3.0
_STATE = "checkpoint.json"
_LOCK = "lock"
_OBSERVED = "seen"
STRETCHES = "stretches"
# of work: 300 years; also excludes integers too large for a float
_MOST_S = 1e10
# of each column, its dtype and the shape of a row
_KINDS = TypeAdapter(
    dict[
        Annotated[str, Field(pattern=r"^[A-Za-z_]\w*$")],
        tuple[str, list[Annotated[int, Field(ge=0, lt=1 << 20)]]],
    ]
)
OWN = (_STATE, _LOCK, _OBSERVED, STRETCHES, "resumed.rrd")  # not in the finished session


LOGS = ("session.rrd", "session.mcap")
# an .rrd file: a header, then messages that begin with kind and length, 8 bytes each
RRD_HEAD = 12  # magic, version and options
_BLOCK = 1 << 22
_RESUMED = "resumed.rrd"


class State(BaseModel):
    """Progress of a session: the content of checkpoint.json.

    Attributes:
        key: SHA-256 of the session's provenance; only the same one is resumed.
        n_frames: frames written, with their observations.
        seconds: time spent on them, s.
        interruptions: number of interruptions if the work resumes from here.
        logs: valid bytes of each log.
    """

    model_config = ConfigDict(strict=True, frozen=True)
    key: str
    n_frames: NonNegativeInt = 0
    seconds: Annotated[float, Field(ge=0.0, lt=_MOST_S)] = 0.0
    interruptions: NonNegativeInt = 0
    logs: dict[
        Annotated[str, Field(pattern=r"^(session\.rrd|resumed\.rrd|session\.mcap)$")],
        NonNegativeInt,
    ] = {}


class Checkpoint:
    """The folder of an unfinished session, locked by this process.

    Attributes:
        folder: the folder.
        state: progress of the session.
        seconds_before: time spent in earlier runs, s.
        n_interruptions: number of earlier interruptions.
        replay: file of Rerun's messages in this run.
        columns: the observations on disk.
    """

    def __init__(self, folder: Path, facts: Mapping[str, Any]) -> None:
        """Begin, or resume a session with the same provenance.

        Args:
            folder: the folder NAME.part; created if needed.
            facts: the session's provenance, serialisable as JSON.

        Raises:
            SessionError: another process is writing the session.
        """
        try:
            durable.unlinked_tree(folder).mkdir(parents=True, exist_ok=True)
        except FileNotFoundError as error:  # a virtual parent folder, such as /proc
            raise SessionError(
                f"no folder can be made at {error.filename} ({error.strerror}); name another place"
            ) from None
        self._held = _locked(folder)
        self.folder = folder
        key = hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()
        state = None
        with suppress(OSError, ValueError):  # nothing to resume from
            state = State.model_validate_json((folder / _STATE).read_bytes())
        if state is None or state.key != key or not self._cut(state):
            self._empty()
            state = State(key=key)
        self.state = state
        self.seconds_before = state.seconds
        self.n_interruptions = state.interruptions
        (folder / _OBSERVED).mkdir(exist_ok=True)
        self.columns = Columns(folder / _OBSERVED)
        self._last = time.monotonic()
        replay, resumed = folder / LOGS[0], folder / _RESUMED
        if resumed.is_file():
            append_rrd(resumed, replay)
            self._keep(logs={log: _size(folder / log) for log in LOGS})
            resumed.unlink()
        self.replay = resumed if replay.is_file() else replay

    @property
    def is_saved(self) -> bool:
        """Whether there is a checkpoint to resume from."""
        return (self.folder / _STATE).is_file()

    @property
    def due(self) -> bool:
        """Whether the last checkpoint was `EVERY_S` ago or longer."""
        return time.monotonic() - self._last >= EVERY_S

    def save(self, n_frames: int, seconds: float, replay: int, messages: int) -> None:
        """Record that everything up to a frame is on disk.

        Args:
            n_frames: frames written, with their observations.
            seconds: time spent on them, s, earlier runs included.
            replay: bytes of the file `replay`.
            messages: bytes of session.mcap.
        """
        logs = {**self.state.logs, self.replay.name: replay, LOGS[1]: messages}
        interruptions = self.n_interruptions + 1
        self._keep(n_frames=n_frames, seconds=seconds, logs=logs, interruptions=interruptions)

    def append(self, shard: Path, n_frames: int, seconds: float) -> None:
        """Append the logs of a shard, whose observations are in `columns` already.

        Args:
            shard: its folder.
            n_frames: frames of the session including the shard.
            seconds: time spent on them, s.
        """
        for log, append in zip(LOGS, (append_rrd, append_chunks), strict=True):
            append(shard / log, self.folder / log)
        logs = {log: _size(self.folder / log) for log in LOGS}
        self._keep(n_frames=n_frames, seconds=seconds, logs=logs)

    def begin_shards(self) -> None:
        """Save an empty checkpoint, so that shards written by other processes are kept."""
        if not self.is_saved:
            self._keep()

    def _keep(self, **changes: Any) -> None:
        """Save a state once its files are on disk, so that it survives a power cut."""
        self.columns.flush()
        state = self.state.model_copy(update=changes)
        durable.sync_tree(self.folder / _OBSERVED)
        for log in state.logs:
            durable.sync_file(self.folder / log)
        durable.write_whole(self.folder / _STATE, state.model_dump_json())
        self.state, self._last = state, time.monotonic()

    def join_replay(self) -> None:
        """Complete session.rrd, all of whose parts are closed."""
        if self.replay.name == _RESUMED:
            append_rrd(self.replay, self.folder / LOGS[0])

    def tidy(self, folder: Path) -> None:
        """Remove working files from the finished session, and release the lock.

        Args:
            folder: the current folder of the session.
        """
        self.columns.close()
        for name in OWN:
            _remove(folder / name)
        self._held.close()

    def leave(self, keep: bool) -> None:
        """Release the folder without finishing the session.

        Args:
            keep: leave the folder if it has a checkpoint, so that the work can resume later;
                otherwise remove it.
        """
        with suppress(OSError):  # unwritten bytes are after the checkpoint
            self.columns.close()
        if not (keep and self.is_saved):
            shutil.rmtree(self.folder, ignore_errors=True)
        self._held.close()

    def _cut(self, state: State) -> bool:
        """Truncate everything to the checkpoint; False if a file is shorter than recorded."""
        for path in self.folder.iterdir():  # incomplete tables, and logs without a checkpoint
            if not (path.name in OWN and path.name != _RESUMED) and path.name not in state.logs:
                _remove(path)
        for log, size in state.logs.items():
            if _size(self.folder / log) < size:
                return False
            os.truncate(self.folder / log, size)
        return Columns.cut(self.folder / _OBSERVED, state.n_frames)

    def _empty(self) -> None:
        for path in self.folder.iterdir():
            if path.name != _LOCK:
                _remove(path)


class Columns:
    """Arrays on disk that grow by rows.

    One binary file per array, and columns.json with names, dtypes and row shapes in order.

    Args:
        folder: the existing folder of the files.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._kinds = _read_kinds(folder)
        self._files: dict[str, IO[bytes]] = {}

    def append(self, columns: Mapping[str, NDArray[Any]]) -> None:
        """Append the next rows of every column.

        Args:
            columns: arrays (n, ...) by name; always with the same names, dtypes and row shapes, in
                the same order.

        Raises:
            ValueError: the columns differ from earlier ones.
        """
        kinds = {
            name: (values.dtype.str, list(values.shape[1:])) for name, values in columns.items()
        }
        if not self._kinds:
            durable.write_whole(self._folder / "columns.json", json.dumps(kinds))
            self._kinds = kinds
        if kinds != self._kinds:
            raise ValueError(f"columns {kinds} were to be appended to {self._kinds}")
        for name, values in columns.items():
            if name not in self._files:
                self._files[name] = (self._folder / f"{name}.bin").open("ab")
            self._files[name].write(np.ascontiguousarray(values).tobytes())

    def flush(self) -> None:
        """Pass everything written so far to the operating system."""
        for file in self._files.values():
            file.flush()

    def close(self) -> None:
        """Close the files.

        Raises:
            OSError: a write failed; all files are closed nevertheless.
        """
        with ExitStack() as closing:
            for file in self._files.values():
                closing.callback(file.close)
            self._files.clear()

    def read(self) -> dict[str, NDArray[Any]]:
        """All rows of every column, mapped from the files; empty columns are left out.

        Do not write to the arrays, see `mapped`.
        """
        self.flush()
        return {
            name: memory.mapped(self._folder / f"{name}.bin", np.dtype(kind)).reshape(-1, *shape)
            for name, (kind, shape) in self._kinds.items()
            if (self._folder / f"{name}.bin").stat().st_size
        }

    @staticmethod
    def cut(folder: Path, n: int) -> bool:
        """Truncate every column to its first rows; False if one has fewer.

        Args:
            folder: the folder of the files.
            n: rows to keep.
        """
        kinds = _read_kinds(folder)
        if not kinds:
            return n == 0
        for name, (kind, shape) in kinds.items():
            path = folder / f"{name}.bin"
            size = n * np.dtype(kind).itemsize * int(np.prod(shape))
            if not path.is_file() or path.stat().st_size < size:
                return False
            with path.open("r+b") as file:
                file.truncate(size)
        return True


def rrd_messages(path: Path, start: int = RRD_HEAD) -> Iterator[tuple[int, int]]:
    """Offset and length of each message, up to the end message if there is one.

    Args:
        path: the .rrd file.
        start: offset of the first message to read.

    Raises:
        SessionError: a message is cut, so the file was not written completely.
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
            # kind of the message that ends a stream
            if kind == 0:
                return
            yield at, 16 + length
            at += 16 + length


def append_rrd(source: Path, target: Path) -> None:
    """Append the messages of an .rrd file to another one, which is created if needed.

    The index at the end of the file is left out, as its offsets are only valid in that file.

    Raises:
        SessionError: the last message of `source` is cut.
    """
    end = max((at + length for at, length in rrd_messages(source)), default=RRD_HEAD)
    with source.open("rb") as file, target.open("ab") as whole:
        file.seek(RRD_HEAD if whole.tell() else 0)
        while block := file.read(min(_BLOCK, end - file.tell())):
            whole.write(block)


def append_chunks(source: Path, log: Path) -> None:
    """Append the chunks of an MCAP file without an end to another one of the same topics."""
    with source.open("rb") as file, log.open("ab") as whole:
        if whole.tell():  # magic bytes and header exist already
            file.seek(len(MAGIC))
            _, length = RECORD.unpack(file.read(RECORD.size))
            file.seek(length, os.SEEK_CUR)
        shutil.copyfileobj(file, whole)


def _size(path: Path) -> int:
    """Bytes of a file; -1 if it does not exist."""
    return path.stat().st_size if path.is_file() else -1


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def check_free(folder: Path) -> None:
    """Raise SessionError if another process is writing the unfinished session of a folder.

    Args:
        folder: the folder NAME.part.
    """
    if (folder / _LOCK).is_file():
        _locked(folder).close()


def _locked(folder: Path) -> IO[bytes]:
    """The lock of an unfinished session; raises SessionError if another process is writing it."""
    held = durable.take_lock(folder / _LOCK)
    if held is None:
        raise SessionError(
            f"another process is writing the session {folder.with_suffix('').name} into "
            f"{folder.parent}; wait until it is done, or choose another place with --out"
        )
    return held


def hold(folder: Path) -> IO[bytes] | None:
    """Lock an unfinished session against other writers.

    Args:
        folder: the folder NAME.part.

    Returns:
        The lock, released by `close`; None if another process is writing the session, or it was
        finished in the meantime.
    """
    try:
        return durable.take_lock(folder / _LOCK)
    except FileNotFoundError:
        return None


def _read_kinds(folder: Path) -> dict[str, tuple[str, list[int]]]:
    """Dtype and row shape of the columns by name, from columns.json; empty if it is invalid."""
    with suppress(OSError, ValueError, TypeError):
        kinds = _KINDS.validate_json((folder / "columns.json").read_bytes())
        if all(np.dtype(dtype).kind in "biufU" for dtype, _ in kinds.values()):
            return kinds
    return {}
