"""Live sources of depth frames: growing files, and a TCP stream of raw frames.

A growing file is polled every 20 ms and read from where reading ended. The stream opens with a JSON
greeting (length as u32, then name and camera); each frame follows as index and time (i64, ns),
height and width (u32), little endian, then H * W float32 mm, row by row.
"""

import json
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from queue import Queue
from typing import NamedTuple, TypeVar

import numpy as np

from liex_lab.errors import LiexError, RecordingError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.recording import Recording, closing_on_error

_FRAME = struct.Struct("<qqII")  # index, time ns, height, width; then float32 mm, row by row
_HEAD = struct.Struct("<I")  # length of the greeting, JSON
_POLL_S = 0.02
_GREETING_S = 10.0  # for the whole greeting
_FRAME_S = 30.0  # for the rest of a frame that has begun


_Frame = TypeVar("_Frame")


class Arrival(NamedTuple):
    """A frame and its time of arrival.

    Attributes:
        frame: the depth frame.
        at_s: its time of arrival, s, on the clock of `time.perf_counter`.
        more: whether the next frame has arrived too.
    """

    frame: DepthFrame
    at_s: float
    more: bool = False


@dataclass(frozen=True)
class Arriving:
    """A recording in progress: its name and camera, and its frames as they arrive.

    Attributes:
        name: name of the recording.
        camera: the camera of the frames.
        frames: the frames in order; iterate once.
    """

    name: str
    camera: Camera
    frames: Iterator[Arrival]


def growing(reopen: Callable[[], Recording], patience_s: float) -> Arriving:
    """Frames of a file or folder that is being written, as they arrive.

    Args:
        reopen: opens the whole frames written so far; called again once these have been read, if
            the format cannot continue reading by itself.
        patience_s: the recording is over after this time without a new frame, s.

    Returns:
        The recording in progress; its first frame has arrived.

    Raises:
        RecordingError: no first frame arrived within patience_s.
    """
    first = _when_there(reopen, patience_s)
    return Arriving(first.name, first.camera, _grown(first, reopen, patience_s))


def _when_there(reopen: Callable[[], Recording], patience_s: float) -> Recording:
    """The recording, opened as soon as it has a first frame."""
    by = time.perf_counter() + patience_s
    while True:
        try:
            if len(opened := reopen()):
                return opened
        except RecordingError:
            if time.perf_counter() > by:
                raise
        if time.perf_counter() > by:
            raise RecordingError(
                f"nothing has come for {patience_s:g} s; begin the recording first, or wait longer"
            )
        time.sleep(_POLL_S)


def _grown(
    opened: Recording, reopen: Callable[[], Recording], patience_s: float
) -> Iterator[Arrival]:
    done = 0
    last = time.perf_counter()
    while time.perf_counter() - last < patience_s:
        for index in range(done, len(opened)):
            last = time.perf_counter()
            yield Arrival(opened.frame(index), last, index + 1 < len(opened))
        done = max(done, len(opened))
        time.sleep(_POLL_S)
        try:
            # reading goes on if the format supports it
            if (more := opened.grown()) is None:
                opened.close()
                more = reopen()
            opened = more
        except RecordingError:  # in the middle of a write
            continue
    opened.close()


def replayed(recording: Recording, speed: float = 1.0) -> Arriving:
    """Send a recording through a local socket at its own pace, or faster.

    Args:
        recording: sent from its first frame to its last by a separate thread.
        speed: factor on the recorded pace.

    Returns:
        The frames as they arrive at the receiving end.
    """
    server = socket.create_server(("127.0.0.1", 0))
    threading.Thread(target=_send, args=(server, recording, speed), daemon=True).start()
    return received(*server.getsockname()[:2])


def received(host: str, port: int) -> Arriving:
    """Frames from a sender like `replayed`, at a TCP address.

    A separate thread reads them, so that the time of a frame is its arrival, not its request. At
    most 128 frames are buffered; then the sender has to wait.

    Args:
        host: name or address of the sender.
        port: its TCP port.

    Returns:
        The frames as they arrive, until the sender closes the connection.

    Raises:
        RecordingError: no sender answers, or no greeting with name and camera arrives within 10 s.
    """
    try:
        link = socket.create_connection((host, port), timeout=_GREETING_S)
    except OSError as error:
        raise RecordingError(
            f"no sender answers at {host}:{port} ({error}); start the sender first"
        ) from None
    where = f"{host}:{port}"
    with closing_on_error(link):
        name, camera = _greeting(link, where)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    arrivals = read_ahead(_frames(link, camera, where))
    return Arriving(name, camera, (one._replace(more=more) for one, more in arrivals))


def _greeting(link: socket.socket, where: str) -> tuple[str, Camera]:
    """Receive the sender's greeting: the recording's name and its camera."""
    by = time.monotonic() + _GREETING_S
    head = _exactly(link, _HEAD.size, by)
    length = _HEAD.unpack(head)[0] if head else 0
    with suppress(ValueError, TypeError, KeyError, AttributeError, RecursionError, LiexError):
        stated = json.loads(_exactly(link, length if length < (1 << 20) else 0, by))
        name = stated["name"]
        camera = Camera.from_dict(stated["camera"])
        size = (camera.width, camera.height)
        if (
            isinstance(name, str)
            and all(type(n) is int for n in size)
            # of a camera
            and size[0] * size[1] <= (1 << 24)
        ):
            return name, camera
    raise RecordingError(
        f"what is at {where} does not send depth frames as `replayed` does: no greeting with "
        f"name and camera came within {_GREETING_S:g} s; check the port"
    )


def read_ahead(frames: Iterator[_Frame]) -> Iterator[tuple[_Frame, bool]]:
    """The same frames, read on a separate thread, at most 128 ahead; and whether more are waiting.

    The time of a frame is then its arrival, not its request.

    Args:
        frames: in order; a RecordingError ends them.
    """
    # frames buffered; then the sender waits
    waiting: Queue[_Frame | RecordingError | None] = Queue(128)

    def fetch() -> None:
        try:
            for arrival in frames:
                waiting.put(arrival)
            waiting.put(None)
        except RecordingError as error:
            waiting.put(error)

    threading.Thread(target=fetch, daemon=True).start()
    while (arrival := waiting.get()) is not None:
        if isinstance(arrival, RecordingError):
            raise arrival
        yield arrival, not waiting.empty()


def _send(server: socket.socket, recording: Recording, speed: float) -> None:
    """Greet the first client, then send every frame at its due time."""
    with server, closing(server.accept()[0]) as link:
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        greeting = json.dumps(
            {"name": recording.name, "camera": recording.camera.to_dict()}
        ).encode()
        link.sendall(_HEAD.pack(len(greeting)) + greeting)
        first = int(recording.times_ns[0])
        # starts once the first frame is read: decoding it is not part of the recording's pace
        began: float | None = None
        for frame in recording:
            began = time.perf_counter() if began is None else began
            late = (frame.time_ns - first) * 1e-9 / speed - (time.perf_counter() - began)
            if late > 0:
                time.sleep(late)
            height, width = frame.depth.shape
            try:
                link.sendall(_FRAME.pack(frame.index, frame.time_ns, height, width))
                link.sendall(np.ascontiguousarray(frame.depth, np.float32).data.cast("B"))
            except OSError:  # the client disconnected
                return


def _frames(link: socket.socket, camera: Camera, where: str) -> Iterator[Arrival]:
    """Frames of the camera's size that arrive whole and in time."""
    with link:
        while True:
            # for the next frame
            head = _exactly(link, _FRAME.size, time.monotonic() + 300.0)
            if not head:
                return
            index, time_ns, height, width = _FRAME.unpack(head)
            if (width, height) != (camera.width, camera.height):
                raise RecordingError(
                    f"{where} sends a frame of {width} x {height} pixels, and its camera has "
                    f"{camera.width} x {camera.height}; correct the sender"
                )
            depth = np.empty((height, width), np.float32)
            if not _fill(link, depth.data.cast("B"), time.monotonic() + _FRAME_S):
                return
            yield Arrival(DepthFrame(index, time_ns, depth), time.perf_counter())


def _exactly(link: socket.socket, n: int, by: float) -> bytes:
    """The next n bytes; empty if the sender disconnects or they do not arrive in time."""
    data = bytearray(n)
    return bytes(data) if _fill(link, memoryview(data), by) else b""


def _fill(link: socket.socket, place: memoryview, by: float) -> bool:
    """Receive bytes until the buffer is full; False if the sender disconnects, or on timeout.

    They are received in place, because a frame has millions of them. `by` is a time of
    `time.monotonic`, s: a sender that trickles bytes cannot block forever.
    """
    while place:
        left = by - time.monotonic()
        if left <= 0:
            return False
        link.settimeout(left)
        try:
            n = link.recv_into(place)
        except OSError:
            return False
        if not n:
            return False
        place = place[n:]
    return True
