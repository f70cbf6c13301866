"""Conversion of recordings, `liex convert`: any depth recording to MCAP or a folder of PNGs.

MCAP keeps every depth as it is. 16-bit images keep whole steps of a size, mm: the largest of some
of which all depths of a few frames are multiples, or the nearest steps of a stated size.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from liex_lab.errors import RecordingError
from liex_lab.optics.camera import Lens
from liex_lab.recordings import Recording, open_recording
from liex_lab.recordings.camera_file import CAMERA_FILE
from liex_lab.recordings.depth_units import whole_steps
from liex_lab.recordings.writer import STAMPS, PictureFolderWriter, RecordingWriter
from liex_lab.runtime.durable import replacing
from liex_lab.runtime.progress import Progress, silent

_STEPS_MM = (1.0, 0.5, 0.25, 0.2, 0.1, 0.05, 0.025, 0.02, 0.01)
_N_PROBED = 8
# a name that ends like another kind of file is no folder's
_OTHER_KINDS = re.compile(
    r"\.(bag|db3|oni|dat|tar|gz|tgz|avi|mkv|mp4|png|tiff?|jpe?g|pgm|pclzf|ply|npy|npz|h5|nwb|rrd|zip|toml|csv|json)$",
    re.I,
)
_PICTURE = re.compile(r"frame_\d+\.png")


@dataclass(frozen=True)
class Converted:
    """What was written.

    Attributes:
        path: the recording that was written.
        n_frames: its number of frames.
        notes: sentences about what is not as it was.
        problems: of the recording that was read.
    """

    path: Path
    n_frames: int
    notes: list[str]
    problems: list[str]


def convert(
    recording: str | Path | Recording,
    to: str | Path,
    *,
    camera: Lens | None = None,
    fps: float | None = None,
    topic: str | None = None,
    step_mm: float | None = None,
    ros: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Converted:
    """Write a recording as MCAP or a folder of PNG images.

    The target has its name only when it is whole.

    Args:
        recording: a path or address, or a recording that is open already.
        to: NAME.mcap, or else a folder for PNG images.
        camera: intrinsics that come before what the files state, as in `open_recording`.
        fps: frame rate of recordings without stamps, as in `open_recording`.
        topic: depth topic of a message log, as in `open_recording`.
        step_mm: mm for each step of 16-bit pictures; depths are rounded to it. None finds one that
            keeps them.
        ros: ROS 2 messages in the MCAP file instead of Foxglove's.
        overwrite: replace a recording that is in its place.
        progress: told frame by frame.

    Raises:
        RecordingError: something is in its place, the depths do not fit, or the recording cannot be
            opened.
    """
    target = Path(to)
    _check_target(target, overwrite)
    if isinstance(recording, Recording):
        return _convert(recording, target, step_mm, ros, progress)
    if target.exists() and Path(recording).exists() and target.samefile(recording):
        raise RecordingError(f"{target} is the recording itself; write under another name")
    with open_recording(
        recording, camera=camera, fps=fps, topic=topic, progress=progress
    ) as opened:
        return _convert(opened, target, step_mm, ros, progress)


def _convert(
    recording: Recording, target: Path, step_mm: float | None, ros: bool, progress: Progress
) -> Converted:
    with in_place(target) as part:
        writer = _writer(recording, target, part, step_mm, ros)
        with writer:
            for frame in recording:
                writer.add(frame)
                progress(frame.index + 1, len(recording), f"writing {target.name}")
    return Converted(target, len(recording), writer.notes, list(recording.problems))


def _writer(
    recording: Recording, target: Path, part: Path, step_mm: float | None, ros: bool
) -> RecordingWriter:
    camera = recording.camera
    if ros and not _is_mcap(target):
        raise RecordingError(
            f"ROS's messages are written into an .mcap file, not into {target.name}; leave out "
            "--ros"
        )
    if _is_mcap(target):
        from liex_lab.recordings.formats.messages.mcap_writer import McapDepthWriter

        if step_mm is not None:
            raise RecordingError(
                "an .mcap file keeps depth as it is, so that --step-mm (in Python step_mm=) says "
                "nothing; leave it out"
            )
        metadata = {
            "source": recording.name,
            "source_format": recording.format,
        } | recording.metadata
        return McapDepthWriter(
            part, camera, messages="ros" if ros else "foxglove", metadata=metadata
        )
    step = _step(recording, target) if step_mm is None else step_mm
    return PictureFolderWriter(
        part, camera, step_mm=step, exact=step_mm is None, metadata=recording.metadata
    )


def _is_mcap(target: Path) -> bool:
    return target.suffix.lower() == ".mcap"


def largest_step(recording: Recording, steps_mm: Sequence[float] = _STEPS_MM) -> float | None:
    """The largest of some steps (mm, descending) of which the depths of a few frames are multiples;
    None if there is none.
    """
    rows = np.unique(np.linspace(0, len(recording) - 1, _N_PROBED).round().astype(int))
    depths = [recording.frame(int(row)).depth for row in rows]
    for step in steps_mm:
        if all(whole_steps(depth, step) is not None for depth in depths):
            return step
    # a depth that 16 bits cannot reach is told by the writer, with its frame
    return 1.0 if max(float(depth.max()) for depth in depths) > 65535.0 else None


def _step(recording: Recording, target: Path) -> float:
    """The step of a target's 16-bit pictures."""
    step = largest_step(recording)
    if step is not None:
        return step
    raise RecordingError(
        f"the depths of {recording.name} are no whole steps of {_STEPS_MM[-1]:g} mm, and "
        f"{target.name} would hold 16-bit pictures, which do not keep them; write an .mcap file, "
        "which does, or let them be rounded with --step-mm 0.1 (in Python step_mm=0.1)"
    )


def _check_target(target: Path, overwrite: bool) -> None:
    """Refuse to write over what is there, and over anything but a recording at all."""
    if _OTHER_KINDS.search(target.name):
        raise RecordingError(
            f"{target.name} is no name of what can be written; give NAME.mcap, or a folder's "
            "name for PNG images"
        )
    if not target.parent.is_dir():
        raise RecordingError(
            f"there is no folder {target.parent} to write {target.name} into; make it first"
        )
    if not target.exists():
        return
    is_file = _is_mcap(target)
    if target.is_dir() if is_file else not target.is_dir():
        raise RecordingError(f"{target} is a {'folder' if is_file else 'file'}; give another name")
    others = (
        []
        if is_file
        else [path.name for path in sorted(target.iterdir()) if not _written_here(path)]
    )
    if others:
        raise RecordingError(
            f"{target} holds more than a recording written by liex convert, such as {others[0]}; "
            "give another name"
        )
    if not overwrite and (is_file or any(target.iterdir())):
        raise RecordingError(
            f"{target} is there already; give another name, or add "
            "--overwrite (in Python overwrite=True)"
        )


def _written_here(path: Path) -> bool:
    return path.is_file() and (
        path.name in (CAMERA_FILE, STAMPS) or _PICTURE.fullmatch(path.name) is not None
    )


@contextmanager
def in_place(target: Path) -> Iterator[Path]:
    """A name beside `target` to write under; what was written gets its own when the block ends, and
    else is gone.

    Args:
        target: the file or folder that is to be.

    Raises:
        RecordingError: it cannot be written.
    """
    try:
        with replacing(target, replace_folder=True) as part:
            yield part
    except OSError as error:
        raise RecordingError(
            f"the recording cannot be written as {target} ({error.strerror or error}); make room, "
            "or name another place"
        ) from None
