"""H.264 in an MP4 file by PyAV, the same bytes for the same pictures."""

from __future__ import annotations

from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import SessionError
from liex_lab.runtime.durable import replacing
from liex_lab.runtime.places import unlinked

_CODECS = ("libx264", "libopenh264")
_CLOCK = Fraction(1, 90_000)  # s, the usual unit of time in MP4
_THREADS = 2  # always: their number is in what comes out


def h264() -> str:
    """The name of an H.264 encoder that this PyAV has.

    Raises:
        SessionError: it has none.
    """
    import av

    for name in _CODECS:
        try:
            av.codec.Codec(name, "w")
        except ValueError:  # av's UnknownCodecError is one
            continue
        return name
    raise SessionError(
        f"a video is written as H.264, and the PyAV that is installed here ({av.__version__}) has "
        f"neither {' nor '.join(_CODECS)}; `pip install --force-reinstall --no-binary :none: av` "
        "brings one that has"
    )


class Video:
    """A video file that is written picture by picture (a context manager).

    It grows under another name and has its own at the end; where the block is left by an error
    nothing is left.

    Args:
        path: the file to write.
        fps: pictures per second, as usual in it; each is shown at its own time.

    Raises:
        SessionError: there is no encoder.
        PlaceError: a symbolic link lies there.
    """

    def __init__(self, path: Path, fps: float) -> None:
        self._codec = h264()
        self._path = unlinked(path)
        self._files = ExitStack()
        self._fps = Fraction(fps).limit_denominator(1001)
        self._box: Any = None
        self._stream: Any = None

    def __enter__(self) -> Video:
        return self

    def add(self, picture: NDArray[np.uint8], time_s: float) -> None:
        """Append a picture; all are as large as the first.

        Args:
            picture: (H, W, 3) uint8 RGB; an odd row or column is left out.
            time_s: when it is shown, s, later than the one before; 0 at the first.
        """
        import av

        height, width = (n - n % 2 for n in picture.shape[:2])
        if self._box is None:
            part = self._files.enter_context(replacing(self._path))
            self._box = av.open(str(part), "w", format="mp4", options=_box_options())
            self._files.push(self._end)
            self._stream = self._box.add_stream(self._codec, rate=self._fps)
            self._stream.width = width
            self._stream.height = height
            self._stream.pix_fmt = "yuv420p"
            self._stream.codec_context.time_base = _CLOCK
            self._stream.codec_context.thread_count = _THREADS
            if self._codec == "libx264":
                self._stream.options = {"crf": "20", "preset": "veryfast"}
        frame = av.VideoFrame.from_ndarray(
            np.ascontiguousarray(picture[:height, :width]), format="rgb24"
        )
        frame.time_base = _CLOCK
        frame.pts = round(time_s / _CLOCK)
        self._box.mux(self._stream.encode(frame))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._files.__exit__(kind, error, trace)

    def _end(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the box, after the last pictures where all went well."""
        if kind is None:
            self._box.mux(self._stream.encode())
        self._box.close()


def _box_options() -> dict[str, str]:
    """The index stands first, for players that begin before they have all; no writer's name."""
    return {"movflags": "+faststart", "fflags": "+bitexact"}
