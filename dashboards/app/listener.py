"""The dashboard's HTTP server: so many connections at a time, and none that stays silent."""

from __future__ import annotations

import threading
from typing import Any

from werkzeug.serving import ThreadedWSGIServer, WSGIRequestHandler

IDLE_S = 30.0  # a browser opens connections before it needs them, and may open them again
MOST = 64  # connections at a time: a browser has six


class Handler(WSGIRequestHandler):
    """A connection that is closed where nothing comes, or nothing is taken, for so long."""

    timeout = IDLE_S


class Listener(ThreadedWSGIServer):
    """A server that answers at most `MOST` connections at a time; what comes beside is closed.

    Args:
        host: the address to listen on.
        port: the port; 0 takes any that is free.
        app: what answers.
    """

    def __init__(self, host: str, port: int, app: Any) -> None:
        self._places = threading.BoundedSemaphore(MOST)
        super().__init__(host, port, app, Handler)

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
