"""Writers of recordings, frame by frame: their interface, and folders of 16-bit PNG images.

Use a writer in a `with` block: the end of the file is written when the block ends without an error.
Its `notes` then report what a reader of the file should know. Depth is stored in whole steps of
`step_mm`, either exactly or rounded to the nearest step.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.camera_file import CAMERA_FILE
from liex_lab.recordings.frame import LARGEST_STEP, Depth, DepthFrame, nearest_steps, whole_steps

STAMPS = "timestamps.csv"
_FACTS = ("subject_id", "session_start_time")  # the metadata that a camera.toml can state


class RecordingWriter(ABC):
    """Interface of a writer for the frames of a recording, in order of time.

    Attributes:
        path: the file or folder to write; it must not exist.
        camera: the camera of the frames.
        notes: sentences about what the format could not store, complete after `finish`.
    """

    def __init__(self, path: Path, camera: Camera) -> None:
        """Keep the path and the camera; nothing is written."""
        self.path = path
        self.camera = camera
        self.notes: list[str] = []

    @abstractmethod
    def add(self, frame: DepthFrame) -> None:
        """Append the next frame; its time must not precede that of the last one."""

    @abstractmethod
    def finish(self) -> None:
        """Write the end of the file."""

    @abstractmethod
    def release(self) -> None:
        """Close open files, whether the recording is whole or not."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self.finish()
        finally:
            self.release()


class PictureFolderWriter(RecordingWriter):
    """Writer of a folder of 16-bit PNG images, with a camera.toml and a timestamps.csv.

    One image per frame; the stamps are in nanoseconds.
    """

    def __init__(
        self,
        path: Path,
        camera: Camera,
        *,
        step_mm: float = 1.0,
        exact: bool = True,
        metadata: dict[str, Any] | None = None,
    ) -> None:
        """Create the folder.

        Args:
            path: the folder, which must not exist.
            camera: the camera of the frames, for camera.toml.
            step_mm: mm of a stored step.
            exact: refuse depths between steps instead of rounding them.
            metadata: facts of the recording; only subject_id and session_start_time are stored.
        """
        super().__init__(path, camera)
        self._step_mm = step_mm
        self._exact = exact
        self._facts = {key: str(value) for key, value in (metadata or {}).items() if key in _FACTS}
        self._times: list[int] = []
        path.mkdir()

    def add(self, frame: DepthFrame) -> None:
        """Write one image; its stamp is written by `finish`.

        Args:
            frame: the frame, depth (H, W) float32 mm.

        Raises:
            RecordingError: its depth does not fit into 16 bits, or (exact) lies between steps.
        """
        steps = steps_of(frame, self._step_mm, self._exact)
        (self.path / f"frame_{len(self._times):06d}.png").write_bytes(png_of(steps))
        self._times.append(frame.time_ns)

    def finish(self) -> None:
        """Write camera.toml and timestamps.csv."""
        camera = self.camera
        numbers = {
            name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")
        }
        facts: dict[str, Any] = numbers | {"unit_mm": self._step_mm} | self._facts
        if camera.distortion is not None:
            facts |= {
                "distortion": camera.distortion.coefficients,
                "distortion_model": camera.distortion.model,
            }
        lines = [f"# intrinsics: {' '.join(camera.source.split())}", "[camera]"]
        lines += [f"{key} = {json.dumps(value)}" for key, value in facts.items()]
        (self.path / CAMERA_FILE).write_text("\n".join([*lines, ""]), encoding="utf-8")
        (self.path / STAMPS).write_text(
            "\n".join(["time_ns", *map(str, self._times), ""]), encoding="utf-8"
        )
        if not self._exact:
            self.notes.append(f"depth was rounded to whole steps of {self._step_mm:g} mm")

    def release(self) -> None:
        """Do nothing: no file stays open."""


def steps_of(frame: DepthFrame, step_mm: float, exact: bool) -> NDArray[np.uint16]:
    """Convert depth of a frame to 16-bit steps.

    Args:
        frame: the frame, depth (H, W) float32 mm.
        step_mm: mm of a step.
        exact: refuse depths between steps instead of rounding them.

    Returns:
        (H, W) uint16 steps, 0 where unread.

    Raises:
        RecordingError: a depth is beyond 65535 steps, or (exact) between two of them.
    """
    depth: Depth = frame.depth
    steps = whole_steps(depth, step_mm) if exact else nearest_steps(depth, step_mm)
    if steps is not None:
        return steps
    if float(depth.max()) > LARGEST_STEP * step_mm:
        raise RecordingError(
            f"frame {frame.index} holds depths up to {depth.max():.0f} mm, and 16 bits in steps of "
            f"{step_mm:g} mm hold up to {LARGEST_STEP * step_mm:.0f} mm; write an .mcap file, or "
            "choose a larger step with --step-mm"
        )
    raise RecordingError(
        f"frame {frame.index} holds depths between whole steps of {step_mm:g} mm, which 16 bits do "
        "not keep; write an unpacked .mcap file, which does, or let the depths be rounded with "
        "--step-mm 0.1"
    )


def png_of(steps: NDArray[np.uint16]) -> bytes:
    """Encode a depth image (H, W) uint16 as the bytes of a 16-bit grey PNG file."""
    import cv2

    good, packed = cv2.imencode(".png", steps)
    assert good
    return bytes(packed.tobytes())
