"""Open a depth recording of any format: dispatch from a path to the reader.

The format follows from the name of a file, or from the names in a folder; an MCAP file, such as an
archive by `liex pack`, is also recognised by its first bytes. Several files of one camera are one
recording. A reader's module and its libraries are imported on demand.
"""

from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from liex_lab.errors import LiexError, RecordingError
from liex_lab.optics.camera import Lens
from liex_lab.recordings.camera_file import CAMERA_FILE
from liex_lab.recordings.recording import Recording
from liex_lab.runtime.durable import named_files
from liex_lab.runtime.progress import Progress, silent

_READS = (
    "a folder of 16-bit PNG, TIFF, PGM or PCLZF images with a camera.toml, exports of a Raytrix "
    "camera with a raytrix.toml, a MoSeq session (its folder, depth.dat, depth.avi, depth.mkv or "
    ".tar.gz) or its extraction (results_00.h5), a PrimeSense recording (.oni), an MCAP file or a "
    "ROS bag (.bag, .db3)"
)
_IMAGES = (".png", ".tif", ".tiff", ".pgm", ".pclzf")
_MOSEQ = ("moseq", "open_moseq")
_ALONE = {  # suffix of a file that is a whole recording: module and function of its reader
    **dict.fromkeys((".tar.gz", ".tgz", ".tar", ".avi", ".mkv"), _MOSEQ),
    ".mcap": ("messages.mcap", "open_mcap"),
    ".oni": ("oni", "open_oni"),
    ".h5": ("moseq_results", "open_results"),
    **dict.fromkeys((".bag", ".db3"), ("messages.rosbag", "open_bag")),
}
_ROLLED = (".mcap", ".oni", ".bag", ".db3")  # of recorders that begin a new file now and then
_FILES = _ALONE | {".dat": _MOSEQ} | dict.fromkeys(_IMAGES, ("images.folder", "open_images"))
_MCAP = b"\x89MCAP0\r\n"
_PACKED = "is packed, and only .tar.gz is read as it is; unpack it{} and give the result"
_NOT_READ = {
    **dict.fromkeys((".zstd", ".zst"), _PACKED.format(" with `zstd -d`")),
    **dict.fromkeys((".zip", ".gz", ".xz", ".bz2", ".7z", ".rar"), _PACKED.format("")),
    **dict.fromkeys(
        (".ray", ".rays"),
        "is in Raytrix's own format, which only the maker's licensed software reads; compute "
        "metric depth in RxLive, save the depth map of every frame as 32-bit TIFF (or its points "
        "as XYZ or PLY) into one folder, write a raytrix.toml with the line profile = "
        '"raytrix-f32-negative-mm" into it, and give that folder',
    ),
    **dict.fromkeys(
        (".ply", ".xyz"),
        "is a point cloud, which is read as one of a folder; write a raytrix.toml beside it that "
        'defines its numbers, with a line such as profile = "raytrix-points-mm", and give '
        "the folder",
    ),
    **dict.fromkeys(
        (".jpg", ".jpeg", ".bmp", ".gif", ".webp", ".mp4", ".mov", ".webm"),
        "is an 8-bit image or a video for display, and 16-bit depth was expected; give "
        "the depth itself",
    ),
    **dict.fromkeys(
        (".npy", ".npz", ".rrd", ".xef", ".svo", ".svo2"),
        "is in a format that is not read yet; export it as 16-bit PNG images, one to a frame",
    ),
    **dict.fromkeys(
        (".sqlite", ".sqlite3", ".db"),
        "is a database, such as Live Mouse Tracker's, with tracks but without depth images; give "
        "the depth recording itself",
    ),
}


def open_recording(
    path: str | Path,
    *,
    camera: Lens | None = None,
    fps: float | None = None,
    topic: str | None = None,
    pattern: str | None = None,
    strict: bool = False,
    progress: Progress = silent,
) -> Recording:
    """Open a depth recording of any format; frames are decoded on request.

    Args:
        path: a file or a folder, or 'synthetic:walk?seed=3&frames=300' for a virtual animal (see
            `open_synthetic`). A pattern such as cam1_*.mcap, or a folder of files that continue
            each other, is one recording in several files (see `join_parts`).
        camera: overrides the camera in the files; a `Lens` fits images of any size.
        fps: frame rate, Hz; used only if the files contain no time stamps.
        topic: the depth topic to read from an MCAP file or a ROS bag with several of them.
        pattern: which images of a folder to read, as in `*.tif`; overrides a camera.toml.
        strict: refuse a recording that is cut short, instead of only reporting it in `problems` and
            `truncated`. A damaged part of an MCAP file is refused when it is read.
        progress: reports while an archive is unpacked or an index made.

    Returns:
        The recording; close it, or use it in a `with` block.

    Raises:
        RecordingError: the path does not exist, contains no readable depth, or (strict) is cut.
    """
    path = Path(path)
    try:
        recording: Recording
        # address of a virtual recording; rendering is a higher layer than reading, so only named
        if str(path).startswith("synthetic:"):
            simulator = import_module("liex_lab.simulation.simulator")
            recording = simulator.open_synthetic(str(path), camera)
        else:
            files = _files_of(path)
            if len(files) > 1:
                from liex_lab.recordings.parts import join_parts

                settings: dict[str, Any] = {"camera": camera, "fps": fps, "topic": topic}
                settings |= {"pattern": pattern, "strict": strict}
                opener = partial(open_recording, **settings)
                return join_parts(
                    files, opener, unbroken=files[0].parent == path, progress=progress
                )
            (module, name), file = _reader_of(files[0])
            reader = import_module(f"liex_lab.recordings.formats.{module}")
            more: dict[str, dict[str, Any]] = {
                "open_images": {"pattern": pattern},
                "open_bag": {"topic": topic},
                "open_mcap": {"topic": topic, "strict": strict},
            }
            recording = getattr(reader, name)(file, camera, fps, progress, **more.get(name, {}))
    except OSError as error:
        raise RecordingError(
            f"{error.filename or path} cannot be read ({error.strerror or error}); check it"
        ) from None
    except RecordingError:
        raise
    except LiexError as error:  # an impossible camera, stated by this recording
        raise RecordingError(f"{path}: {error}") from None
    if strict and recording.truncated:
        recording.close()
        n_whole = f"{recording.n_whole} whole frame{'' if recording.n_whole == 1 else 's'}"
        raise RecordingError(
            f"{path} is cut short or damaged, {n_whole} can be read from it; copy it again, or go "
            "on with what is whole by adding --set recording.accept_truncated=true (in Python "
            "plan.with_settings(['recording.accept_truncated=true']))"
        )
    return recording


def stated_subject(path: Path, progress: Progress = silent) -> str:
    """The animal's name in a recording's metadata; no frame is read.

    Args:
        path: a file or a folder.
        progress: reports while an archive is searched.

    Returns:
        The stated name; '' if none is stated, or the metadata cannot be read.
    """
    from liex_lab.recordings.camera_file import CameraFile
    from liex_lab.recordings.formats.moseq import METADATA, read_metadata, unpack

    folder = path if path.is_dir() else path.parent
    name = path.name.lower()
    notes = {file: folder / file for file in (METADATA, CAMERA_FILE)}
    try:
        if name.endswith((".mcap", ".h5")):
            with open_recording(path, strict=True) as recording:
                return str(recording.metadata.get("subject_id", ""))
        with TemporaryDirectory() as scratch:
            if name.endswith((".tar.gz", ".tgz", ".tar")):
                notes |= {METADATA: Path(scratch, METADATA)}  # unless it is in the archive
                notes |= unpack(path, tuple(notes), Path(scratch), progress)[0]
            is_moseq = notes[METADATA].is_file() and not name.endswith((".oni", ".bag", ".db3"))
            facts = read_metadata(notes[METADATA] if is_moseq else None, cut=True).facts
            facts |= CameraFile.read(notes[CAMERA_FILE]).metadata
    except (LiexError, OSError):
        return ""
    return str(facts.get("subject_id", ""))


def _files_of(path: Path) -> list[Path]:
    """The files or folders that are one recording: of a pattern, or of a folder of files alike.

    Raises:
        RecordingError: nothing matches the pattern.
    """
    found = named_files(path)
    if not found:
        raise RecordingError(f"no file or folder matches {path}; check the spelling")
    if len(found) == 1 and found[0].is_dir():
        inside = sorted(one for one in found[0].iterdir() if not one.name.startswith("."))
        kinds = {one.suffix.lower() for one in inside} & set(_FILES)
        alike = [one for one in inside if one.suffix.lower() in _ROLLED]
        return alike if len(alike) > 1 and len(kinds) == 1 else found
    return found


def _reader_of(path: Path) -> tuple[tuple[str, str], Path]:
    """Module and function of `formats` that reads a path, and the file or folder to read.

    Raises:
        RecordingError: it is no recording that can be read.
    """
    from liex_lab.recordings.formats.images.nyu import is_nyu

    if not path.exists():
        raise RecordingError(f"there is no file or folder {path}; check the spelling")
    if path.is_dir():
        return _reader_of_folder(path)
    if is_nyu(path.parent, [path.name]):
        return ("images.nyu", "open_nyu"), path
    where = _named(path.name)
    if where is None:  # a file of any name may start with MCAP's magic bytes
        with path.open("rb") as file:
            where = _FILES[".mcap"] if file.read(len(_MCAP)) == _MCAP else None
    if where is None:
        why = _NOT_READ.get(path.suffix.lower())
        raise RecordingError(
            f"{path} {why}" if why else f"{path} is no recording that can be read; give {_READS}"
        )
    if not path.stat().st_size:
        raise RecordingError(f"{path} is empty; copy the recording again")
    return where, path


def _named(name: str, files: dict[str, tuple[str, str]] = _FILES) -> tuple[str, str] | None:
    return next((where for end, where in files.items() if name.lower().endswith(end)), None)


def _reader_of_folder(folder: Path) -> tuple[tuple[str, str], Path]:
    from liex_lab.recordings.formats.images.nyu import is_nyu
    from liex_lab.recordings.formats.images.raytrix import (
        PROFILE_FILE,
        is_raytrix,
        no_profile_error,
    )

    inside = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
    if not inside:
        raise RecordingError(f"{folder} is an empty folder; give {_READS}")
    if any(name in inside for name in ("depth.dat", "depth.avi", "depth.mkv")):
        return _MOSEQ, folder
    if PROFILE_FILE in inside:
        return ("images.raytrix", "open_raytrix"), folder
    if CAMERA_FILE not in inside and is_raytrix(folder, inside):
        raise no_profile_error(folder)
    if is_nyu(folder, inside):
        return ("images.nyu", "open_nyu"), folder
    if "session.json" in inside:
        raise RecordingError(
            f"{folder} is a session, the result of a run; open it with `liex show`, or give a "
            "recording"
        )
    if any(Path(name).suffix.lower() in (*_IMAGES, ".jpg", ".jpeg", ".bmp") for name in inside):
        return _FILES[".png"], folder
    files = [name for name in inside if _named(name, _ALONE)]
    files = files or [name for name in inside if Path(name).suffix in (".zstd", ".zst")]
    if len(files) == 1:
        return _reader_of(folder / files[0])
    offer = files or [f"{name}/" for name in inside if (folder / name).is_dir()]
    raise RecordingError(
        f"{folder} holds no depth images and no depth.dat; "
        + (f"give one of these in it: {', '.join(offer[:6])}" if offer else f"give {_READS}")
    )
