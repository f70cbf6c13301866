"""Depth recordings of every format through one door: `open_recording`."""

from __future__ import annotations

from pathlib import Path

from liex_lab.camera import Lens
from liex_lab.errors import LiexError, RecordingError
from liex_lab.progress import Progress, silent
from liex_lab.recordings.frame import DepthFrame
from liex_lab.recordings.recording import Recording
from liex_lab.recordings.times import Gap

__all__ = ["DepthFrame", "Gap", "Recording", "open_recording"]

_READS = (
    "a folder of 16-bit PNG or TIFF pictures with a camera.toml, a MoSeq session (its folder, depth.dat or .tar.gz), "
    "a PrimeSense recording (.oni) or an MCAP file with Foxglove depth pictures"
)
_ARCHIVES = (".tar.gz", ".tgz", ".tar")
_PICTURES = (".png", ".tif", ".tiff")
_VIDEOS = ("depth.avi", "depth.mkv")
_RAYTRIX = (
    "is in Raytrix's own format, which only the maker's licensed software reads; export its depth maps as TIFF from "
    "RxLive and give their folder"
)
_EIGHT_BIT = (
    "is an 8-bit picture or a video for people to look at, and 16-bit depth was expected; give the depth itself"
)
_NOT_YET = "is in a format that is not read yet; export it as 16-bit PNG pictures, one to a frame"
_NOT_READ = {
    **dict.fromkeys((".ray", ".rays"), _RAYTRIX),
    **dict.fromkeys((".jpg", ".jpeg", ".bmp", ".gif", ".webp", ".mp4", ".avi", ".mov", ".webm"), _EIGHT_BIT),
    **dict.fromkeys((".bag", ".db3", ".mkv", ".pclzf", ".pgm", ".ply", ".h5", ".npy", ".npz", ".rrd"), _NOT_YET),
}


def open_recording(
    path: str | Path,
    *,
    camera: Lens | None = None,
    fps: float | None = None,
    topic: str | None = None,
    strict: bool = False,
    progress: Progress = silent,
) -> Recording:
    """Open a depth recording of any format; frames are read when asked for.

    path: a file or a folder, or 'synthetic:walk?seed=3&frames=300' for a virtual mouse (see `open_synthetic`); camera:
    comes before whatever the files state, a `Lens` for pictures of any size; fps: used only where the files hold no
    time stamps; topic: of an MCAP file with several depth topics; strict: refuse a recording that is cut short, instead
    of only saying so in `problems` and `truncated`; progress: told while an archive is unpacked or an index made.
    """
    path = Path(path)
    try:
        recording = _open(path, camera, fps, topic, progress)
    except OSError as error:
        raise RecordingError(f"{error.filename or path} cannot be read ({error.strerror or error}); check it") from None
    except RecordingError:
        raise
    except LiexError as error:  # a camera that cannot be: it came out of this recording
        raise RecordingError(f"{path}: {error}") from None
    if strict and recording.truncated:
        recording.close()
        n_whole = f"{recording.n_whole} whole frame{'' if recording.n_whole == 1 else 's'}"
        raise RecordingError(
            f"{path} is cut short or damaged, {n_whole} can be read from it; copy it again, or go on with what is "
            "whole by adding --set recording.accept_truncated=true"
        )
    return recording


def _open(path: Path, camera: Lens | None, fps: float | None, topic: str | None, progress: Progress) -> Recording:
    name = path.name.lower()
    if str(path).startswith("synthetic:"):
        from liex_lab.recordings.walking import open_synthetic

        return open_synthetic(str(path), camera)
    if not path.exists():
        raise RecordingError(f"there is no file or folder {path}; check the spelling")
    if path.is_dir():
        return _open_folder(path, camera, fps, topic, progress)
    if name.endswith(_PICTURES):
        from liex_lab.recordings.images import open_images

        return open_images(path, camera, fps, progress)
    if name.endswith((*_ARCHIVES, ".dat")):
        from liex_lab.recordings.moseq import open_moseq

        return open_moseq(path, camera, fps, progress)
    if name.endswith(".mcap"):
        from liex_lab.recordings.mcap import open_mcap

        return open_mcap(path, camera, fps, progress, topic)
    if name.endswith(".oni"):
        from liex_lab.recordings.primesense import open_oni

        return open_oni(path, camera, fps, progress)
    why = _NOT_READ.get(path.suffix.lower())
    raise RecordingError(f"{path} {why}" if why else f"{path} is no recording that can be read; give {_READS}")


def _open_folder(
    folder: Path, camera: Lens | None, fps: float | None, topic: str | None, progress: Progress
) -> Recording:
    inside = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
    if not inside:
        raise RecordingError(f"{folder} is an empty folder; give {_READS}")
    if "depth.dat" in inside:
        from liex_lab.recordings.moseq import open_moseq

        return open_moseq(folder, camera, fps, progress)
    if video := next((name for name in _VIDEOS if name in inside), None):
        from liex_lab.recordings.moseq import video_error

        raise video_error(folder, video)
    if "session.json" in inside:
        raise RecordingError(
            f"{folder} is a session, the result of a run; look at it with `liex show`, or give a recording"
        )
    if any(Path(name).suffix.lower() in (*_PICTURES, ".jpg", ".jpeg", ".bmp") for name in inside):
        from liex_lab.recordings.images import open_images

        return open_images(folder, camera, fps, progress)
    files = [name for name in inside if name.lower().endswith((*_ARCHIVES, ".mcap", ".oni"))]
    if len(files) == 1:
        return _open(folder / files[0], camera, fps, topic, progress)
    offer = files or [f"{name}/" for name in inside if (folder / name).is_dir()]
    raise RecordingError(
        f"{folder} holds no depth pictures and no depth.dat; "
        + (f"give one of these in it: {', '.join(offer[:6])}" if offer else f"give {_READS}")
    )
