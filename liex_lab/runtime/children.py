"""Processes of a pool that end with the process that started them, however that one ended."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading


def end_with_parent() -> None:
    """In a new process of `multiprocessing`: end when the parent does, and leave Ctrl-C to it.

    The parent holds the other end of a pipe, which the system closes when it is no more: this works
    on every system, and for SIGKILL.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to both
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def end_children(but: set[int]) -> None:
    """End processes of this one's pools at once.

    Args:
        but: ids of those that stay.
    """
    for child in multiprocessing.active_children():
        if child.pid not in but:
            child.terminate()
