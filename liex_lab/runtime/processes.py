"""Ctrl-C, SIGTERM and SIGHUP: what is under way is put down within seconds, and said so.

The signal becomes an exception, so that checkpoints are kept and temporary folders go. What does
not end by itself, such as a kernel or a library's thread, is ended with the process after 4 s; a
second signal ends it at once. What is on disk then is as after a kill, which every writer expects.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_PATIENCE_S = 4.0
_AGAIN_S = 0.05
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
_SAID = {"SIGINT": "interrupted (Ctrl-C)", "SIGTERM": "ended (SIGTERM)", "SIGHUP": "ended (SIGHUP)"}


class Ended(BaseException):
    """Raised in the main thread when the process is asked to end.

    Attributes:
        signal: the signal's number.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.signal = number

    def __str__(self) -> str:
        """One sentence for people."""
        return (
            f"{_SAID[signal.Signals(self.signal).name]}; the same command goes on where a "
            "measurement was, or begins anew"
        )

    @property
    def exit_code(self) -> int:
        """128 and the signal's number, as shells have it: 130 for Ctrl-C, 143 for SIGTERM."""
        return 128 + self.signal


@contextmanager
def ending() -> Iterator[None]:
    """Within the block, signals that ask the process to end raise `Ended` in the main thread.

    Signals that the process was started to ignore, as by nohup, are ignored.
    """
    asked: list[int] = []
    unheard = threading.Event()
    usual = sys.unraisablehook

    def end(number: int, frame: FrameType | None) -> None:
        error = Ended(number)
        if unheard.is_set():
            unheard.clear()
            raise error
        if asked:
            _end_now(error, asked)
        asked.append(number)
        late = threading.Timer(_PATIENCE_S, _end_now, [error, asked])
        late.daemon = True
        late.start()
        raise error

    def again(what: sys.UnraisableHookArgs) -> None:
        """It was raised where Python lets no error out, such as in a weak reference's callback."""
        if not isinstance(what.exc_value, Ended):
            return usual(what)
        unheard.set()
        later = threading.Timer(_AGAIN_S, _send, [what.exc_value.signal])
        later.daemon = True
        later.start()
        return None

    before = {}
    sys.unraisablehook = again
    for name in _NAMES:
        number = getattr(signal, name, None)
        if number is None or threading.current_thread() is not threading.main_thread():
            continue
        found = signal.getsignal(number)
        if found in (signal.SIG_DFL, signal.default_int_handler):
            before[number] = signal.signal(number, end)
    try:
        yield
    finally:
        sys.unraisablehook = usual
        if asked:
            asked.append(0)  # the sentence is said by who catches the error
        else:  # a second signal would still end it at once
            for number, handler in before.items():
                signal.signal(number, handler)


def _send(number: int) -> None:
    """A signal to the main thread, whatever it waits for."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        signal.raise_signal(number)


def _end_now(error: Ended, asked: list[int]) -> None:
    """End the process, whatever its threads are doing."""
    if len(asked) == 1:
        os.write(2, f"liex: {error}\n".encode())  # a handler may stand within a write of ours
    os._exit(error.exit_code)


# Processes that this one starts: in what they find its modules, and that they end with it.


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
