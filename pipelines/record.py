"""`liex record`: the frames of a depth camera as an MCAP file, with calibration and its own times.

A thread reads the camera, another writes, so that a slow disk delays no frame before 128 of them
wait. The file is complete when it ends by itself, by Ctrl-C or with the camera's cable; one that
was cut off, by a full disk or the power, keeps all but its last frame, or 128 kB of small frames.
"""

import threading
from dataclasses import dataclass, field
from pathlib import Path

from liex_lab.errors import RecordingError, one_line
from liex_lab.optics.camera import DEPTH_MODES, DepthMode
from liex_lab.recordings.devices import MAKERS, Device
from liex_lab.recordings.streaming import read_ahead
from liex_lab.recordings.writer import McapDepthWriter
from liex_lab.runtime import durable
from liex_lab.runtime.processes import Ended
from liex_lab.runtime.progress import Progress, silent


@dataclass
class Recorded:
    """What was recorded.

    Attributes:
        path: of the file.
        n_frames: frames in it.
        n_dropped: frames that the camera made, by their numbers, and that are not in it.
        duration_s: from the first to the last frame, by the camera's clock.
        notes: sentences on it.
        error: why it ended early; "" if it was stopped or is as long as asked.
    """

    path: Path
    n_frames: int = 0
    n_dropped: int = 0
    duration_s: float = 0.0
    notes: list[str] = field(default_factory=list)
    error: str = ""


def record(
    camera: str,
    out: str | Path,
    *,
    seconds: float | None = None,
    preset: str | None = None,
    progress: Progress = silent,
) -> Recorded:
    """Record a depth camera until it is stopped.

    Args:
        camera: `orbbec` or `realsense`.
        out: the .mcap file, which must not exist.
        seconds: its length by the camera's clock; None records until Ctrl-C.
        preset: a camera by name, or NAME:WIDTHxHEIGHT, whose image size is asked for.
        progress: called frame by frame.

    Raises:
        RecordingError: there is no such camera, mode or place, or not one frame comes.
        MissingPackageError: the maker's package is not installed.
    """
    path = Path(out)
    if camera not in MAKERS:
        raise RecordingError(
            f"--camera is one of {', '.join(MAKERS)}, got '{camera}'; choose one of them"
        )
    if path.suffix.lower() != ".mcap" or path.exists():
        raise RecordingError(
            f"{path} exists; record under another name"
            if path.exists()
            else f"recordings are .mcap files, got {path}; give --out NAME.mcap"
        )
    device = MAKERS[camera](None if preset is None else _mode(preset))
    done = Recorded(path, notes=list(device.notes))
    stop = threading.Event()
    writing = threading.Thread(target=_write, args=(device, done, seconds, stop, progress))
    try:
        writing.start()
        while writing.is_alive():
            writing.join(0.1)
    except Ended:
        stop.set()
        writing.join()
        done.notes.append("the recording was stopped and is complete until then")
    finally:
        device.close()
    if not done.n_frames:
        path.unlink(missing_ok=True)
        raise RecordingError(done.error)
    return done


def _mode(preset: str) -> DepthMode:
    """The depth mode of NAME or NAME:WIDTHxHEIGHT."""
    name, _, size = preset.partition(":")
    modes = [mode for mode in DEPTH_MODES if mode.name == name]
    sizes = [f"{mode.camera.width}x{mode.camera.height}" for mode in modes]
    if not modes or (size and size not in sizes):
        known = sizes or list(dict.fromkeys(mode.name for mode in DEPTH_MODES))
        raise RecordingError(
            f"--preset is NAME or NAME:WIDTHxHEIGHT, got '{preset}'; known are {', '.join(known)}"
        )
    return modes[sizes.index(size) if size else 0]


def _write(
    device: Device,
    done: Recorded,
    seconds: float | None,
    stop: threading.Event,
    progress: Progress,
) -> None:
    """Write frames until one of the reasons to end, which `done` then states."""
    facts = {"camera_model": device.name, "camera_serial": device.serial}
    first_ns, last = 0, None
    try:
        with McapDepthWriter(done.path, device.camera, messages="ros", metadata=facts) as writer:
            try:
                for frame, _ in read_ahead(device.frames):
                    first_ns = first_ns or frame.time_ns
                    long_s = (frame.time_ns - first_ns) * 1e-9
                    if stop.is_set() or (seconds is not None and long_s >= seconds):
                        break
                    if last is not None and frame.index == last:  # delivered twice
                        continue
                    writer.add(frame)
                    done.n_dropped += max(0, frame.index - last - 1) if last is not None else 0
                    last = frame.index
                    done.n_frames += 1
                    done.duration_s = long_s
                    progress(done.n_frames, None, f"recording; {done.n_dropped} frames dropped")
            except RecordingError as error:
                done.error = str(error)
            writer.note({"frames_dropped": str(done.n_dropped)})
        done.notes += writer.notes
    except OSError as error:
        done.error = (
            f"{durable.why_full(error) if durable.is_full(error) else one_line(error)}; the frames "
            "until then are read with --set recording.accept_truncated=true"
        )
