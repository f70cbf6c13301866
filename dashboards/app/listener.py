"""The dashboard's HTTP server: so many connections at a time, and none that stays silent."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from werkzeug.serving import ThreadedWSGIServer, WSGIRequestHandler

IDLE_S = 30.0  # a browser opens connections before it needs them, and may open them again
MOST = 64  # connections at a time: a browser has six
_LAST_S = 5.0  # for so long what is being answered is waited for at the end


class Handler(WSGIRequestHandler):
    """A connection that is closed where nothing comes, or nothing is taken, for so long."""

    timeout = IDLE_S
    server: Listener

    def run_wsgi(self) -> None:
        """Answer one request."""
        with self.server.answering():
            super().run_wsgi()


class Listener(ThreadedWSGIServer):
    """A server that answers at most `MOST` connections at a time; what comes beside is closed.

    Args:
        host: the address to listen on.
        port: the port; 0 takes any that is free.
        app: what answers.
    """

    def __init__(self, host: str, port: int, app: Any) -> None:
        self._places = threading.BoundedSemaphore(MOST)
        self._free = threading.Condition()
        self._n_answered = 0  # requests that are being answered now
        super().__init__(host, port, app, Handler)

    @contextmanager
    def answering(self) -> Iterator[None]:
        """The while in which a request is answered."""
        with self._free:
            self._n_answered += 1
        try:
            yield
        finally:
            with self._free:
                self._n_answered -= 1
                self._free.notify_all()

    def server_close(self) -> None:
        """Listen no more; what is being answered is waited for, for five seconds at most.

        A table that is read while the interpreter ends would keep the program from ending: its
        reader's threads wait for an interpreter that has gone.
        """
        super().server_close()
        with self._free:
            self._free.wait_for(lambda: not self._n_answered, _LAST_S)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Give a connection a thread of its own, where there is a place for it.

        Args:
            request: the connection.
            client_address: where it comes from.
        """
        if not self._places.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer a connection until it ends, and free its place.

        Args:
            request: the connection.
            client_address: where it comes from.
        """
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()
