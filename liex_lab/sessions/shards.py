"""Shards of a recording, measured by several processes in parallel, each in its own folder.

They are inside the unfinished session until it appends them, in order. If a worker dies, another
one may write its shard a second time: a shard is published by an atomic rename, and both versions
are equal.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from liex_lab.runtime.durable import sync_folder, sync_tree, write_whole
from liex_lab.sessions.checkpoint import LOGS, STRETCHES, Checkpoint, Columns
from liex_lab.sessions.cutouts import DepthKeeper
from liex_lab.sessions.provenance import Provenance
from liex_lab.sessions.writer import seen_rows

if TYPE_CHECKING:
    from liex_lab.recordings.frame import DepthFrame
    from liex_lab.tracking.observations import Observations

_SIZES = "stretch.json"
_SEEN = "seen"


def shard_folder(unfinished: Path, start: int, stop: int) -> Path:
    """Path of a complete shard of an unfinished session.

    Args:
        unfinished: the folder of the unfinished session.
        start: first row of the shard.
        stop: the first row after it.
    """
    return unfinished / STRETCHES / f"{start:09d}-{stop:09d}"


def is_whole(folder: Path) -> bool:
    """Whether a shard exists with files of the recorded sizes.

    Args:
        folder: the shard's folder.
    """
    try:
        sizes = json.loads((folder / _SIZES).read_text(encoding="utf-8"))
        return all((folder / log).stat().st_size == sizes[log] for log in LOGS)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def append_shard(held: Checkpoint, folder: Path, n_frames: int, seconds: float) -> None:
    """Append a complete shard to an unfinished session, and remove its folder.

    Args:
        held: the unfinished session, locked by this process.
        folder: the shard's folder.
        n_frames: frames of the session including the shard.
        seconds: time spent on them, s.
    """
    held.seen.append(Columns(folder / _SEEN).read())
    held.append(folder, n_frames, seconds)
    shutil.rmtree(folder, ignore_errors=True)


class ShardWriter:
    """Writer of a shard: depth of consecutive frames and their observations.

    After a `with` block the shard is complete, or absent on an error.
    """

    def __init__(self, folder: Path, origin: Provenance, first_ns: int | None) -> None:
        """Begin the shard in a temporary folder next to its own.

        Args:
            folder: the shard's folder.
            origin: provenance of the recording.
            first_ns: time of the recording's first frame, ns; None if it is in this shard.
        """
        from liex_lab.sessions.mcap import McapWriter
        from liex_lab.sessions.rrd import ReplayWriter

        self._whole = folder
        self._folder = folder.with_name(f".{folder.name}.{os.getpid()}")
        shutil.rmtree(self._folder, ignore_errors=True)
        (self._folder / _SEEN).mkdir(parents=True)
        self._seen = Columns(self._folder / _SEEN)
        replay, messages = (self._folder / log for log in LOGS)
        self._replay = ReplayWriter(replay, origin)
        self._mcap = McapWriter(messages, origin)
        self._keeper = DepthKeeper(origin)
        if first_ns is not None:
            self._replay.resume(first_ns)

    def __enter__(self) -> ShardWriter:
        return self

    def add(self, frames: Sequence[DepthFrame], seen: Observations) -> None:
        """Write the next frames.

        Args:
            frames: consecutive frames.
            seen: their observations, one row per frame.
        """
        boxes = self._keeper.boxes(seen)
        depth = self._keeper.keep([frame.depth for frame in frames], boxes)
        times = [int(frame.time_ns) for frame in frames]
        self._replay.add([int(frame.index) for frame in frames], times, depth, boxes)
        self._mcap.add(times, depth)
        self._seen.append(seen_rows(frames, seen, boxes))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if error is None:
                sizes = dict(zip(LOGS, (self._replay.flushed(), self._mcap.flushed()), strict=True))
            self._seen.close()
            for log in (self._replay, self._mcap):
                log.abandon()
            if error is None:
                self._become_whole(sizes)
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _become_whole(self, sizes: dict[str, int]) -> None:
        """Publish the shard, with the logs truncated to `sizes`: what closing added is dropped."""
        for log, size in sizes.items():
            os.truncate(self._folder / log, size)
        write_whole(self._folder / _SIZES, json.dumps(sizes))
        if is_whole(self._whole):  # another worker was faster
            return
        shutil.rmtree(self._whole, ignore_errors=True)
        sync_tree(self._folder)
        self._folder.rename(self._whole)
        sync_folder(self._whole.parent)
