"""libOpenNI2 as a witness, in a process of its own: its Dummy device and its player crash when they
are taken down.

`play` gives what its player reads from an .oni file; `record` lets its recorder write one, of its
Dummy device or of what its player plays. Run as a script, this module does either and leaves
without taking anything down.
"""

import ctypes
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

REPOSITORY = Path(__file__).resolve().parents[2]
LIBRARY = "libOpenNI2.so.0"
VERSION = 2002  # of the interface, 2.2
DEPTH, HORIZONTAL_FOV, VERTICAL_FOV, N_FRAMES, SPEED, REPEAT = 3, 1, 2, 8, 100, 101
ONE_FRAME_A_READ = -1.0


class Witnessed(NamedTuple):
    """Frames (n, H, W) as libOpenNI2 handed them out, their times (n,) in µs, and its angles of
    view, rad.
    """

    frames: NDArray[np.uint16]
    times_us: NDArray[np.uint64]
    fov: tuple[float, float]


def play(path: Path) -> Witnessed:
    """What libOpenNI2 reads from a file."""
    return _run(path.parent, "play", str(path))


def record(source: str | Path, target: Path, n_frames: int) -> Witnessed:
    """Let libOpenNI2 write `target` from a device or a file; what it handed out meanwhile."""
    return _run(target.parent, "record", str(source), str(target), str(n_frames))


def _run(folder: Path, *arguments: str) -> Witnessed:
    try:
        ctypes.CDLL(LIBRARY)
    except OSError:
        pytest.skip(f"{LIBRARY} is not installed (apt install libopenni2-0)")
    out = folder / "witnessed.npz"
    command = [sys.executable, "-m", "tests.recordings.openni2", str(out), *arguments]
    ran = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=30)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    with np.load(out) as found:
        return Witnessed(found["frames"], found["times_us"], tuple(found["fov"].tolist()))


class _Frame(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("sensor", ctypes.c_int),
        ("time_us", ctypes.c_uint64),
        ("index", ctypes.c_int),
        ("width", ctypes.c_int),
        ("height", ctypes.c_int),
        ("mode", ctypes.c_int * 4),
        ("cropped", ctypes.c_int),
        ("x", ctypes.c_int),
        ("y", ctypes.c_int),
        ("stride", ctypes.c_int),
    )


class _Stream:
    """The depth stream of a device or file."""

    def __init__(self, source: str) -> None:
        self.library = ctypes.CDLL(LIBRARY)
        self.library.oniGetExtendedError.restype = ctypes.c_char_p
        self._device, self.handle = ctypes.c_void_p(), ctypes.c_void_p()
        self.do("oniInitialize", VERSION)
        self.do("oniDeviceOpen", source.encode(), ctypes.byref(self._device))
        if source.endswith(".oni"):
            self.do("oniDeviceSetProperty", self._device, REPEAT, ctypes.byref(ctypes.c_int(0)), 4)
            self.do(
                "oniDeviceSetProperty",
                self._device,
                SPEED,
                ctypes.byref(ctypes.c_float(ONE_FRAME_A_READ)),
                4,
            )
        self.do("oniDeviceCreateStream", self._device, DEPTH, ctypes.byref(self.handle))

    def do(self, name: str, *arguments: object) -> None:
        status = getattr(self.library, name)(*arguments)
        if status:
            raise SystemExit(f"{name} says {status}: {self.library.oniGetExtendedError().decode()}")

    def number(self, name: int, kind: type[ctypes.c_int] | type[ctypes.c_float]) -> float:
        value, size = kind(), ctypes.c_int(4)
        failed = self.library.oniStreamGetProperty(
            self.handle, name, ctypes.byref(value), ctypes.byref(size)
        )
        return float("nan") if failed else value.value

    def read(self) -> tuple[NDArray[np.uint16], int]:
        pointer = ctypes.POINTER(_Frame)()
        self.do("oniStreamReadFrame", self.handle, ctypes.byref(pointer))
        frame = pointer.contents
        data = ctypes.string_at(frame.data, frame.size)
        self.library.oniFrameRelease(pointer)
        return np.frombuffer(data, np.uint16).reshape(frame.height, frame.width), frame.time_us


def _main(out: str, what: str, source: str, target: str = "", n: str = "") -> None:
    stream, recorder = _Stream(source), ctypes.c_void_p()
    if what == "record":
        stream.do("oniCreateRecorder", target.encode(), ctypes.byref(recorder))
        stream.do("oniRecorderAttachStream", recorder, stream.handle, 0)
        stream.do("oniRecorderStart", recorder)
        time.sleep(1.0)  # it starts in a thread, and frames before that are lost
    stream.do("oniStreamStart", stream.handle)
    frames, times = zip(
        *(stream.read() for _ in range(int(n or stream.number(N_FRAMES, ctypes.c_int)))),
        strict=True,
    )
    if what == "record":
        stream.library.oniRecorderStop(recorder)
        stream.do("oniRecorderDestroy", ctypes.byref(recorder))
    fov = [stream.number(name, ctypes.c_float) for name in (HORIZONTAL_FOV, VERTICAL_FOV)]
    np.savez(out, frames=np.stack(frames), times_us=np.array(times, np.uint64), fov=np.array(fov))
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    _main(*sys.argv[1:])
