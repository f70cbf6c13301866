"""Messages to other programs and instruments while a recording goes on: UDP, ZMQ, LSL, serial.

A message is one line of JSON. None of these ways waits for a receiver, so that one that is late or
dead does not hold up the measurement.
"""

import json
import os
import socket
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from liex_lab.errors import (
    LiexError,
    MissingPackageError,
    did_you_mean,
    how_to_install,
    one_line,
)
from liex_lab.recordings.recording import closing_on_error

_BAUD = 115_200


class Sender(NamedTuple):
    """A way to a receiver.

    Attributes:
        send: sends a line of text; raises what its package raises if that fails.
        close: ends it.
    """

    send: Callable[[str], object]
    close: Callable[[], object]


def open_sender(address: str) -> Sender:
    """A way to the receivers at an address.

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


def _udp(address: str) -> Sender:
    host, port = _host_port(address)
    family, kind, protocol, _, target = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    link = socket.socket(family, kind, protocol)
    link.setblocking(False)
    return Sender(lambda line: link.sendto(line.encode(), target), link.close)


def _zmq(address: str) -> Sender:
    import zmq

    host, port = _host_port(address)
    publisher: Any = zmq.Context.instance().socket(zmq.PUB)
    publisher.setsockopt(zmq.LINGER, 200)  # ms, for the last messages at the end
    with closing_on_error(publisher):
        publisher.bind(f"tcp://{host}:{port}")
    return Sender(publisher.send_string, publisher.close)


def _lsl(address: str) -> Sender:
    import pylsl

    name = address.partition("://")[2]
    if not name:
        raise ValueError("the stream has no name")
    about = pylsl.StreamInfo(name, "Markers", 1, pylsl.IRREGULAR_RATE, pylsl.cf_string, name)
    outlet = pylsl.StreamOutlet(about)
    return Sender(lambda line: outlet.push_sample([line.rstrip()]), lambda: None)


def _serial(address: str) -> Sender:
    import serial

    port = serial.Serial(urlsplit(address).path, _BAUD)

    def send(line: str) -> None:  # pyserial waits, for ever, once the buffer of the line is full
        if os.write(port.fileno(), line.encode()) < len(line.encode()):
            raise BlockingIOError("nobody reads the line")

    return Sender(send, port.close)


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
