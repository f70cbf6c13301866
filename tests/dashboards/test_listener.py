"""The dashboard's server at its end."""

from __future__ import annotations

import threading
import time
import urllib.request
from collections.abc import Callable, Iterable
from typing import Any

from liex_lab.dashboards.app.listener import Listener


def test_what_is_being_answered_is_waited_for_when_the_server_ends() -> None:
    began, done = threading.Event(), threading.Event()

    def slow(_: Any, start: Callable[..., Any]) -> Iterable[bytes]:
        began.set()
        time.sleep(0.5)
        done.set()
        start("200 OK", [("Content-Type", "text/plain")])
        return [b"done"]

    server = Listener("127.0.0.1", 0, slow)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}/"
    asking = threading.Thread(target=lambda: urllib.request.urlopen(address).read(), daemon=True)
    asking.start()
    assert began.wait(10)
    server.shutdown()
    server.server_close()
    assert done.is_set()
