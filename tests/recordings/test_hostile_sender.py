"""Whoever sends frames may lie about them: that is a sentence, in bounded time and memory."""

import json
import socket
import struct
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import numpy as np
import pytest

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera
from liex_lab.recordings import streaming
from liex_lab.recordings.streaming import received

CAMERA = Camera(width=32, height=24, fx=30.0, fy=30.0, cx=15.5, cy=11.5)
GOOD = CAMERA.to_dict()
ENDLESS = struct.pack("<I", 0xFFFFFFFF)  # a greeting that is not waited for
FRAME = np.full((24, 32), 700.0, np.float32).tobytes()


def greeting(said: object) -> bytes:
    text = said if isinstance(said, bytes) else json.dumps(said).encode()
    return struct.pack("<I", len(text)) + text


def frame(index: int, width: int, height: int, pixels: bytes = FRAME) -> bytes:
    return struct.pack("<qqII", index, index * 33_000_000, height, width) + pixels


@contextmanager
def sender(say: Callable[[socket.socket], None]) -> Iterator[int]:
    """The port of a server that says so to the first who comes."""
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        with server, suppress(OSError), server.accept()[0] as link:
            say(link)

    thread = threading.Thread(target=serve)
    thread.start()
    yield server.getsockname()[1]
    thread.join(20.0)
    assert not thread.is_alive()


@pytest.mark.parametrize(
    ("width", "height"),
    [(40_000, 40_000), (0xFFFFFFFF, 0xFFFFFFFF), (0, 0), (24, 32), (32, 25), (1, 768)],
)
def test_a_frame_of_another_size_than_the_camera_takes_no_memory(width: int, height: int) -> None:
    def say(link: socket.socket) -> None:
        link.sendall(greeting({"name": "a", "camera": GOOD}) + frame(0, 32, 24))
        link.sendall(frame(1, width, height, b""))

    with sender(say) as port:
        frames = received("127.0.0.1", port).frames
        assert next(frames).frame.depth.shape == (24, 32)
        tracemalloc.start()
        with pytest.raises(RecordingError, match=f"{width} x {height} pixels.*has 32 x 24"):
            next(frames)
        assert tracemalloc.get_traced_memory()[1] < 1 << 22
        tracemalloc.stop()


@pytest.mark.parametrize(
    "said",
    [
        {"name": "a", "camera": {}},
        {"name": "a", "camera": "a camera"},
        {"name": "a", "camera": None},
        {"name": "a"},
        {"name": 3, "camera": GOOD},
        {"name": "a", "camera": GOOD | {"width": 10**9, "height": 10**9}},
        {"name": "a", "camera": GOOD | {"width": 32.5}},
        {"name": "a", "camera": GOOD | {"height": -24}},
        {"name": "a", "camera": GOOD | {"fx": float("nan")}},
        {"name": "a", "camera": GOOD | {"cx": float("inf")}},
        {"name": "a", "camera": GOOD | {"fy": "far"}},
        [],
        b"\xff\xfe",
        b"",
        b"[" * 100_000,
        ENDLESS,
    ],
    ids=lambda said: str(said)[:50],
)
def test_a_greeting_without_a_sound_camera_is_a_sentence(said: object) -> None:
    sent = ENDLESS if said is ENDLESS else greeting(said)
    with (
        sender(lambda link: link.sendall(sent)) as port,
        pytest.raises(RecordingError, match="does not send depth frames"),
    ):
        received("127.0.0.1", port)


def drip(link: socket.socket, data: bytes) -> None:
    for one in data:
        link.sendall(bytes([one]))
        time.sleep(0.1)


def test_a_greeting_that_drips_ends_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streaming, "_GREETING_S", 1.0)
    whole = greeting({"name": "a", "camera": GOOD})
    assert len(whole) > 50  # it would take more than five seconds
    began = time.monotonic()
    with sender(lambda link: drip(link, whole)) as port:
        with pytest.raises(RecordingError, match="does not send depth frames"):
            received("127.0.0.1", port)
        assert time.monotonic() - began < 4.0


def test_a_frame_that_drips_is_left_out_and_ends_the_recording(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(streaming, "_FRAME_S", 1.0)

    def say(link: socket.socket) -> None:
        link.sendall(greeting({"name": "a", "camera": GOOD}) + frame(0, 32, 24))
        link.sendall(frame(1, 32, 24, b""))
        drip(link, FRAME)

    with sender(say) as port:
        came = list(received("127.0.0.1", port).frames)
    assert [one.frame.index for one in came] == [0]
    assert came[0].frame.depth.tobytes() == FRAME
