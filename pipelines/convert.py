"""`liex convert`, any recording as MCAP or a folder of PNGs, and `liex pack`, its lossless archive.

MCAP stores every depth unchanged. 16-bit images store whole steps of a size in mm: the largest
candidate of which all depths of a few frames are multiples, or a stated size, to which depths are
rounded.

An archive contains ROS's compressedDepth messages (RVL, Wilson 2017) in chunks compressed by
Zstandard; every verb reads it like any recording, and so does ROS. It keeps times, camera and the
facts that tables depend on. Of a still arena it keeps only the region, if exactly the same is
learned from it as from whole frames; pixels outside become unread. The archive states the SHA-256
of its times and depths.
"""

import hashlib
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from liex_lab.arrays import Mask
from liex_lab.errors import EstimationError, LiexError, ModelError, RecordingError, refuse
from liex_lab.optics.camera import Lens
from liex_lab.plan import Plan
from liex_lab.recordings import Recording, camera_file, open_recording
from liex_lab.recordings.formats.messages.messages import SUFFIX, PackFacts, hash_note
from liex_lab.recordings.frame import Depth, region_mask, whole_steps
from liex_lab.recordings.writer import STAMPS, ImageFolderWriter, McapDepthWriter, RecordingWriter
from liex_lab.runtime import durable
from liex_lab.runtime.progress import Progress, silent
from liex_lab.scene.zones import Corners
from liex_lab.tracking.tracker import FrameTracker

from .build import build_recording, build_tracker, open_planned, stated_corners

_STEPS_MM = (1.0, 0.5, 0.25, 0.2, 0.1, 0.05, 0.025, 0.02, 0.01)
# a folder must not have the suffix of another kind of file
_OTHER_KINDS = re.compile(
    r"\.(bag|db3|oni|dat|tar|gz|tgz|avi|mkv|mp4|png|tiff?|jpe?g|pgm|pclzf|ply|npy|npz|h5|nwb|rrd|zip|toml|csv|json)$",
    re.I,
)


@dataclass(frozen=True)
class Converted:
    """A recording that was written, or an archive that was verified.

    Attributes:
        path: of the recording.
        n_frames: its number of frames.
        notes: sentences about what changed.
        problems: of the recording that was read.
        source_bytes: size of the source recording; 0 if it is not in a file.
        kept: share of an image's pixels that are kept.
        verified: whether it was read again and compared.
        written: whether it is new, rather than an existing one that was verified.
        deleted: files that were removed.
    """

    path: Path
    n_frames: int
    notes: list[str]
    problems: list[str]
    source_bytes: int = 0
    kept: float = 1.0
    verified: bool = False
    written: bool = True
    deleted: Sequence[Path] = ()


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

    The target gets its name only once it is complete.

    Args:
        recording: a path or address, or an open recording.
        to: NAME.mcap, or else a folder for PNG images.
        camera: intrinsics that override the files', as in `open_recording`.
        fps: frame rate of recordings without stamps, as in `open_recording`.
        topic: depth topic of a message log, as in `open_recording`.
        step_mm: mm per step of 16-bit images, to which depths are rounded; None finds a lossless
            one.
        ros: ROS 2 messages in the MCAP file instead of Foxglove's.
        overwrite: replace an existing recording.
        progress: called frame by frame.

    Raises:
        RecordingError: the target exists, the depths do not fit, or the recording cannot be opened.
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
        if step_mm is not None:
            raise RecordingError(
                "an .mcap file keeps depth as it is; leave out --step-mm (in Python step_mm=)"
            )
        metadata = {
            "source": recording.name,
            "source_format": recording.format,
        } | recording.metadata
        return McapDepthWriter(
            part, camera, messages="ros" if ros else "foxglove", metadata=metadata
        )
    step = largest_step(recording) if step_mm is None else step_mm
    if step is None:
        raise RecordingError(
            f"the depths of {recording.name} are no whole steps of {_STEPS_MM[-1]:g} mm, and "
            f"{target.name} would hold 16-bit images, which do not keep them; write an .mcap file, "
            "which does, or let them be rounded with --step-mm 0.1 (in Python step_mm=0.1)"
        )
    return ImageFolderWriter(
        part, camera, step_mm=step, exact=step_mm is None, metadata=recording.metadata
    )


def _is_mcap(target: Path) -> bool:
    return target.suffix.lower() == ".mcap"


def largest_step(recording: Recording) -> float | None:
    """The largest step, mm, that divides all depths of a few frames; None if absent."""
    rows = np.unique(np.linspace(0, len(recording) - 1, 8).round().astype(int))
    depths = [recording.frame(int(row)).depth for row in rows]
    for step in _STEPS_MM:
        if all(whole_steps(depth, step) is not None for depth in depths):
            return step
    # the writer reports a depth beyond 16 bits, with its frame
    return 1.0 if max(float(depth.max()) for depth in depths) > 65535.0 else None


def _check_target(target: Path, overwrite: bool) -> None:
    """Refuse other kinds of targets, folders with other files, and existing ones unless
    `overwrite`.
    """
    is_file = _is_mcap(target)
    refuse(
        RecordingError,
        (
            _OTHER_KINDS.search(target.name),
            f"{target.name} is no name of what can be written; give NAME.mcap, or a folder's "
            "name for PNG images",
        ),
        (
            not target.parent.is_dir(),
            f"there is no folder {target.parent} to write {target.name} into; make it first",
        ),
        (
            target.exists() and target.is_dir() == is_file,
            f"{target} is a {'folder' if is_file else 'file'}; give another name",
        ),
    )
    if not target.exists():
        return
    own = {camera_file.CAMERA_FILE, STAMPS}
    others = [
        path.name
        for path in ([] if is_file else sorted(target.iterdir()))
        if not path.is_file()
        or not (path.name in own or re.fullmatch(r"frame_\d+\.png", path.name))
    ]
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


@contextmanager
def in_place(target: Path) -> Iterator[Path]:
    """Yield a temporary path; rename it to `target` on success, remove it on failure.

    Raises:
        RecordingError: it cannot be written.
    """
    try:
        with durable.replacing(target, replace_folder=True) as part:
            yield part
    except OSError as error:
        raise RecordingError(
            f"the recording cannot be written as {target} ({error.strerror or error}); make room, "
            "or name another place"
        ) from None


# Lossless archives of recordings, `liex pack`: 16-bit depth of the arena as RVL in an MCAP file.


def pack(
    recording: str | Path,
    to: str | Path | None = None,
    *,
    plan: Plan,
    whole: bool = False,
    verify: bool = False,
    delete_original: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Converted:
    """Write the archive of a recording; it gets its name only once it is complete.

    With `verify`, an existing archive is checked against its stated hash instead.

    Args:
        recording: a path or address.
        to: the archive, NAME.mcap; None: NAME.pack.mcap next to the recording.
        plan: how to open the recording, and the animal for finding the arena; its `arena.region`,
            if stated, is the region.
        whole: keep whole images.
        verify: read the archive again and compare every image and time with the recording.
        delete_original: remove the recording's file after a comparison without differences.
        overwrite: replace an existing file.
        progress: called frame by frame.

    Raises:
        RecordingError: the target exists, the depths do not fit, the recording cannot be opened or
            is an archive already, or the archive differs when read again.
    """
    with open_planned(recording, plan, progress) as opened:
        if "packed" in opened.metadata:
            if verify and to is None and not delete_original:
                return _checked(recording, opened, progress)
            raise RecordingError(
                f"{recording} is an archive of `liex pack` already; `liex pack {recording} "
                "--verify` checks it against the hash that it states"
            )
        target = _target(recording, to, opened, overwrite)
        if delete_original:
            _check_deletable(opened)
        step_mm = largest_step(opened)
        if step_mm is None:
            raise RecordingError(
                f"the depths of {opened.name} are no whole steps of 16 bits, so that an archive "
                "would change them; keep the recording, or write it with `liex convert --to "
                f"{opened.name}.mcap`"
            )
        region = None if whole else plan.arena.region
        corners = () if region is None else stated_corners(opened, plan, region)
        mask, notes = (None, []) if whole else _region(recording, opened, plan, corners, progress)
        with in_place(target) as part:
            digest = _write(opened, part, step_mm, mask, corners, progress)
            if verify or delete_original:
                _compare(opened, part, mask, digest, progress)
        done = Converted(
            target,
            len(opened),
            notes,
            list(opened.problems),
            source_bytes=sum(source.stat().st_size for source in opened.sources),
            kept=1.0 if mask is None else float(mask.mean()),
            verified=verify or delete_original,
            deleted=list(opened.sources) if delete_original else [],
        )
    for source in done.deleted:
        source.unlink()
    return done


def _checked(path: str | Path, opened: Recording, progress: Progress) -> Converted:
    """Check times and images of an archive against its stated hash."""
    stated = opened.metadata["packed"]
    whole = hashlib.sha256()
    for frame in opened:
        _hash_frame(whole, stated["step_mm"], frame.time_ns, frame.depth)
        progress(frame.index + 1, len(opened), f"verifying {opened.name}")
    if whole.hexdigest() != stated["depth_sha256"]:
        raise RecordingError(
            f"{path} was cut or changed since it was packed: its times and images have another "
            "hash than it states; take another copy of it"
        )
    return Converted(
        Path(path), len(opened), [], list(opened.problems), verified=True, written=False
    )


def _target(
    recording: str | Path, to: str | Path | None, opened: Recording, overwrite: bool
) -> Path:
    """Path of the archive."""
    beside = Path(recording).parent if opened.sources else Path()
    target = Path(to) if to is not None else durable.inside(beside, opened.name, f"{SUFFIX}.mcap")
    refuse(
        RecordingError,
        (
            not _is_mcap(target),
            f"an archive is an MCAP file; give --to NAME.mcap (in Python to=), not {target.name}",
        ),
        (
            any(target.resolve() == source.resolve() for source in opened.sources),
            f"{target} is the recording itself; write under another name",
        ),
    )
    _check_target(target, overwrite)
    return target


def _check_deletable(opened: Recording) -> None:
    """Refuse to remove anything but the only file of a complete recording."""
    if len(opened.sources) != 1 or opened.truncated:
        why = (
            "is cut or damaged"
            if opened.truncated
            else f"is {len(opened.sources)} files"
            if opened.sources
            else "is in no file"
        )
        raise RecordingError(
            f"--delete-original removes a recording that is one whole file, and {opened.name} "
            f"{why}; leave it out, and remove the recording yourself"
        )


def _region(
    recording: str | Path,
    opened: Recording,
    plan: Plan,
    corners: Corners,
    progress: Progress,
) -> tuple[Mask | None, list[str]]:
    """The pixels to keep (H, W), None for all, and a note on why; those within `corners` if given.

    A found region is kept if the tracker learned from it equals the one learned from whole images.
    """
    if corners:
        return region_mask(corners, opened.width, opened.height), []
    if plan.arenas is not None:
        return None, ["whole images are kept, for the plan has several arenas in them"]
    try:
        ideal = build_recording(recording, plan, progress)
    except LiexError as error:
        return None, [f"whole images are kept: {error}"]
    with ideal:
        if ideal.optics:
            return None, ["whole images are kept, for lens, water or a mirror bend them"]
        progress(0, None, "finding the arena")
        try:
            learned = build_tracker(ideal, plan)
        except (EstimationError, ModelError) as error:
            return None, [f"whole images are kept, for no arena was found: {error}"]
        region = _found_region(learned, ideal.width, ideal.height)
        if region is None:
            return None, [
                "whole images are kept, for the measurement uses all of them, not only the arena; "
                "name the region to be kept with --region"
            ]
        if learned.scene.n_animals > 1:
            return None, [
                "whole images are kept, for more than one animal moves in them; name what is to "
                "be kept with --region"
            ]
        # margins that are tried around the found region, of the image's width
        for share in (0.0, 0.03, 0.1):
            mask = _wider(region, round(share * ideal.width))
            cut = ideal.viewed_by(ideal.camera, _within(mask), {}, lent=True)
            try:
                if _alike(learned, build_tracker(cut, plan)):
                    return mask, []
            except EstimationError:
                continue
        return None, [
            "whole images are kept, for the arena alone would be measured otherwise; name the "
            "region to be kept with --region"
        ]


def _found_region(tracker: FrameTracker, width: int, height: int) -> Mask | None:
    """The pixels (H, W) in which the animal is searched for; None for all."""
    support_plane = getattr(tracker.scene, "support_plane", None)
    if support_plane is None or support_plane.region is None:
        return None
    stride = int(getattr(tracker.scene, "stride", 1))
    mask = np.repeat(np.repeat(support_plane.region, stride, axis=0), stride, axis=1)
    found = np.asarray(mask[:height, :width], np.bool_)
    return None if found.all() else found


def _wider(mask: Mask, px: int) -> Mask:
    """A mask dilated by a disc of so many pixels."""
    import cv2

    if not px:
        return mask
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * px + 1, 2 * px + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc) > 0, np.bool_)


def _within(mask: Mask | None) -> Callable[[Depth], Depth]:
    """A function that makes pixels outside a mask unread."""
    if mask is None:
        return lambda depth: depth
    return lambda depth: np.where(mask, depth, np.float32(0))


def _alike(one: FrameTracker, other: FrameTracker) -> bool:
    """Whether two trackers learned bit-identical values."""
    own = [field.name for field in fields(one) if field.name not in ("estimator", "scene", "body")]
    scene = [field.name for field in fields(one.scene) if field.name != "support_plane"]  # type: ignore[arg-type]
    pairs = [(getattr(one, name), getattr(other, name)) for name in own]
    pairs += [(getattr(one.scene, name), getattr(other.scene, name)) for name in scene]
    pairs.append((one.body.girth, other.body.girth))
    return all(_same(a, b) for a, b in pairs)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return bool(np.array_equal(a, b))
    if hasattr(a, "__dataclass_fields__") and type(a) is type(b):
        return all(_same(getattr(a, one.name), getattr(b, one.name)) for one in fields(a))
    return bool(a == b)


def _write(
    opened: Recording,
    part: Path,
    step_mm: float,
    mask: Mask | None,
    corners: Corners,
    progress: Progress,
) -> str:
    """Write the archive; returns the hash of its times and depths."""
    within = _within(mask)
    moved = opened.stamp_faults
    facts = PackFacts(
        step_mm=step_mm,
        problems=list(opened.problems),
        moved={int(row): int(moved[row]) for row in np.flatnonzero(moved)},
        source={"name": opened.name, "format": opened.format, "sha256": opened.digest(progress)},
        region_px=[list(corner) for corner in corners],
        n_px=0 if mask is None else int(mask.sum()),
        doubts=list(opened.doubts),
    )
    whole = hashlib.sha256()
    metadata = {**opened.metadata, **facts.to_notes()}
    with McapDepthWriter(
        part, opened.camera, messages="ros", packing="rvl", step_mm=step_mm, metadata=metadata
    ) as writer:
        for frame in opened:
            kept = type(frame)(frame.index, frame.time_ns, within(frame.depth))
            writer.add(kept)
            _hash_frame(whole, step_mm, frame.time_ns, kept.depth)
            progress(frame.index + 1, len(opened), f"packing {opened.name}")
        writer.note(hash_note(whole.hexdigest()))
    return whole.hexdigest()


def _compare(
    opened: Recording, part: Path, mask: Mask | None, digest: str, progress: Progress
) -> None:
    """Raise RecordingError if the archive differs from the recording."""
    within = _within(mask)
    with open_recording(part, strict=True) as packed:
        same = packed.metadata.get("packed", {}).get("depth_sha256") == digest
        same = same and np.array_equal(packed.times_ns, opened.times_ns)
        same = same and _camera_of(packed) == _camera_of(opened)
        for row in range(len(opened) if same else 0):
            if not np.array_equal(packed.frame(row).depth, within(opened.frame(row).depth)):
                same = False
                break
            progress(row + 1, len(opened), "comparing the archive with the recording")
    if not same:
        raise RecordingError(
            f"the archive of {opened.name} does not hold what the recording does, so it was "
            "removed and the recording stays; please report this as an error of liex_lab"
        )


def _camera_of(recording: Recording) -> Sequence[Any]:
    camera = recording.camera
    return [camera.matrix.tolist(), camera.width, camera.height, camera.distortion]


def _hash_frame(whole: "hashlib._Hash", step_mm: float, time_ns: int, depth: Depth) -> None:
    """Add a frame to the SHA-256 of times and depth in steps; see `PackFacts.depth_sha256`."""
    steps = np.rint(depth / np.float32(step_mm)).astype("<u2")
    whole.update(np.int64(time_ns).astype("<i8").tobytes())
    whole.update(steps.tobytes())
