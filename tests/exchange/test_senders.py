"""Messages reach a receiver of every kind, and what cannot be sent to is said beforehand."""

import builtins
import json
import os
import socket
import subprocess
import sys
import tty
from contextlib import suppress
from typing import Any

import pylsl
import pytest
import zmq

from liex_lab.errors import LiexError, MissingPackageError
from liex_lab.exchange.senders import message, open_sender

LINE = message({"rule": "rear", "value": 1.0, "count": 3})


def _free_port() -> int:
    with socket.socket() as link:
        link.bind(("127.0.0.1", 0))
        return int(link.getsockname()[1])


def test_udp_brings_a_line_of_json_and_needs_no_receiver() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        sender = open_sender(f"udp://127.0.0.1:{receiver.getsockname()[1]}")
        sender.send(LINE)
        line = receiver.recv(4096).decode()
    assert json.loads(line)["count"] == 3
    assert line.count("\n") == 1
    for _ in range(5):  # the receiver is gone
        sender.send(LINE)
    sender.close()


def test_zmq_publishes_and_refuses_a_port_that_is_taken() -> None:
    port = _free_port()
    sender = open_sender(f"zmq://127.0.0.1:{port}")
    subscriber: Any = zmq.Context.instance().socket(zmq.SUB)
    subscriber.subscribe("")
    subscriber.connect(f"tcp://127.0.0.1:{port}")
    for _ in range(50):
        sender.send(LINE)
        if subscriber.poll(100):
            break
    assert subscriber.recv_string(zmq.NOBLOCK) == LINE
    subscriber.close(0)
    with pytest.raises(LiexError, match="not in use by another program"):
        open_sender(f"zmq://127.0.0.1:{port}")
    sender.close()


def test_a_serial_line_gets_the_message() -> None:
    here, there = os.openpty()
    tty.setraw(there)
    sender = open_sender(f"serial://{os.ttyname(there)}")
    sender.send(LINE)
    assert os.read(here, 4096).decode() == LINE
    sender.close()
    os.close(here)
    os.close(there)
    with pytest.raises(LiexError, match=r"nothing can be sent to serial:///dev/none"):
        open_sender("serial:///dev/none")


def test_a_serial_line_that_nobody_reads_holds_up_nothing() -> None:
    here, there = os.openpty()
    tty.setraw(there)
    sender = open_sender(f"serial://{os.ttyname(there)}")
    with suppress(BlockingIOError):
        for _ in range(2000):
            sender.send(LINE)
        pytest.fail("the line takes whatever is sent")
    sender.close()
    os.close(here)
    os.close(there)


INLET = """
import pylsl
found = pylsl.resolve_byprop("name", "rears of a test", 1, 5.0)
inlet = pylsl.StreamInlet(found[0]) if found else None
print(inlet and (inlet.open_stream(5.0) or found[0].type()), flush=True)
print(inlet and inlet.pull_sample(timeout=5.0)[0][0], flush=True)
"""


def test_another_process_gets_a_message_by_lsl() -> None:
    sender = open_sender("lsl://rears of a test")
    command = [sys.executable, "-c", INLET]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        kind = other.stdout.readline().strip()
        sender.send(LINE)
        received = other.stdout.readline()
    sender.close()
    if kind == "None":
        pytest.skip("LSL finds no stream on this machine: its network carries no multicast")
    assert (kind, received) == ("Markers", LINE)


def test_lsl_announces_a_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    pushed: list[list[str]] = []

    class Outlet:
        """Needs no network."""

        def __init__(self, about: pylsl.StreamInfo) -> None:
            assert (about.name(), about.type()) == ("rears", "Markers")

        def push_sample(self, sample: list[str]) -> None:
            pushed.append(sample)

    monkeypatch.setattr(pylsl, "StreamOutlet", Outlet)
    open_sender("lsl://rears").send(LINE)
    assert pushed == [[LINE.rstrip()]]


@pytest.mark.parametrize(
    ("address", "why"),
    [
        ("127.0.0.1:5005", "a trigger is sent to udp://HOST:PORT"),
        ("upd://127.0.0.1:5005", "did you mean udp://"),
        ("udp://127.0.0.1", "host or port is missing"),
        ("udp://127.0.0.1:99999", "should be udp://HOST:PORT"),
        ("udp://no such host:1", "should be udp://HOST:PORT"),
        ("lsl://", "has no name"),
    ],
)
def test_an_address_that_cannot_be_meant_is_refused(address: str, why: str) -> None:
    with pytest.raises(LiexError) as refused:
        open_sender(address)
    assert why in str(refused.value)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name in ("zmq", "pylsl", "serial"):
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    for address in ("zmq://127.0.0.1:5", "lsl://a", "serial:///dev/ttyACM0"):
        with pytest.raises(MissingPackageError, match=r"pip install '\.\[trigger\]'"):
            open_sender(address)
