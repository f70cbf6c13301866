"""Messages to other programs and instruments while a recording goes on: UDP, ZMQ, LSL, serial.

A message is one line of JSON. None of these ways waits for a receiver, so that one that is late or
dead does not hold up the measurement.
"""

import json
import socket
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import urlsplit

from liex_lab.errors import (
    LiexError,
    MissingPackageError,
    did_you_mean,
    how_to_install,
    one_line,
)

Send = Callable[[str], object]
_BAUD = 115_200


def open_sender(address: str) -> Send:
    """A function that sends a line of text to an address, and raises OSError if that fails.

    Args:
        address: udp://HOST:PORT; zmq://HOST:PORT, at which subscribers connect (PUB); lsl://NAME, a
            stream of that name; or serial:///dev/..., at 115,200 baud.

    Raises:
        LiexError: the address is of another form, taken or unknown.
        MissingPackageError: the package for it is not installed.
    """
    kind, separator, _ = address.partition("://")
    if not separator or kind not in _KINDS:
        raise LiexError(
            f"a trigger is sent to {', '.join(_KINDS.values())}; got '{address}'"
            + did_you_mean(kind, _KINDS, "; did you mean {}://?")
        )
    try:
        return _OPENERS[kind](address)
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"to send to {address}, {error.name} is missing; {how_to_install('trigger')}"
        ) from None
    except LiexError:
        raise
    except Exception as error:  # other packages raise no common type
        raise LiexError(
            f"nothing can be sent to {address} ({one_line(error)}); it should be "
            f"{_KINDS[kind]}, not in use by another program"
        ) from None


def message(facts: Mapping[str, Any]) -> str:
    """One line of JSON with a line end."""
    return json.dumps(facts, allow_nan=False) + "\n"


def _udp(address: str) -> Send:
    host, port = _host_port(address)
    family, kind, protocol, _, target = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    link = socket.socket(family, kind, protocol)
    link.setblocking(False)
    return lambda line: link.sendto(line.encode(), target)


def _zmq(address: str) -> Send:
    import zmq

    host, port = _host_port(address)
    publisher: Any = zmq.Context.instance().socket(zmq.PUB)
    publisher.setsockopt(zmq.LINGER, 200)  # ms, for the last messages at the end
    publisher.bind(f"tcp://{host}:{port}")
    return publisher.send_string


def _lsl(address: str) -> Send:
    import pylsl

    name = address.partition("://")[2]
    if not name:
        raise ValueError("the stream has no name")
    about = pylsl.StreamInfo(name, "Markers", 1, pylsl.IRREGULAR_RATE, pylsl.cf_string, name)
    outlet = pylsl.StreamOutlet(about)
    return lambda line: outlet.push_sample([line.rstrip()])


def _serial(address: str) -> Send:
    import serial

    port = serial.Serial(urlsplit(address).path, _BAUD, write_timeout=0)
    return lambda line: port.write(line.encode())


def _host_port(address: str) -> tuple[str, int]:
    parts = urlsplit(address)
    if not parts.hostname or not parts.port:
        raise ValueError("host or port is missing")
    return parts.hostname, parts.port


_OPENERS = {"udp": _udp, "zmq": _zmq, "lsl": _lsl, "serial": _serial}
_KINDS = {
    "udp": "udp://HOST:PORT",
    "zmq": "zmq://HOST:PORT",
    "lsl": "lsl://NAME",
    "serial": "serial:///dev/NAME",
}
