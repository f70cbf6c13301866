"""Processes that this one starts: in what they find its modules, and that they end with it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading


def own_python(*arguments: str) -> list[str]:
    """The command of another Python with the packages of this one.

    It takes nothing from the folder that it is started in, which may hold another liex_lab, such as
    the sources that this one was installed from, or anything that is called like a package.

    Args:
        *arguments: what it runs, as "-m" and a module, or "-c" and a program, and that one's own.
    """
    return [sys.executable, "-P", *arguments]


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
