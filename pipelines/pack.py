"""Lossless archives of recordings, `liex pack`: 16-bit depth of the arena as RVL in an MCAP file.

Pictures are ROS's compressedDepth messages (RVL, Wilson 2017) in chunks packed by Zstandard, which
every verb reads like any recording, and ROS, too. Times, camera and the facts that tables depend on
are kept. Of a still arena only its region is kept, where what is learned from it is exactly what is
learned from the whole pictures; pixels outside of it become unread. The archive states the SHA-256
of its times and pictures.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.errors import EstimationError, LiexError, ModelError, RecordingError
from liex_lab.plan import Plan
from liex_lab.runtime.places import inside
from liex_lab.runtime.progress import Progress, silent

from .build import build_recording, build_tracker, open_planned
from .convert import in_place, largest_step

if TYPE_CHECKING:
    from liex_lab.arena.region import Corners
    from liex_lab.recordings.frame import Depth
    from liex_lab.recordings.recording import Recording
    from liex_lab.tracking.tracker import FrameTracker

Mask = NDArray[np.bool_]

_WIDER = (0.0, 0.03, 0.1)  # of the picture's width: how much wider than found the region may be


@dataclass(frozen=True)
class Packed:
    """What became of a recording.

    Attributes:
        path: the archive.
        n_frames: its frames.
        n_bytes: its size.
        source_bytes: size of the recording that it was made of; 0 for one that is in no file.
        kept: share of the pixels of a picture that are kept.
        verified: whether it was read again and compared.
        written: whether it is new, not one that was only verified.
        deleted: files that were removed.
        notes: sentences about what was found.
    """

    path: Path
    n_frames: int
    n_bytes: int
    source_bytes: int
    kept: float
    verified: bool
    written: bool
    deleted: list[Path]
    notes: list[str]


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
) -> Packed:
    """Write the archive of a recording; it has its name only when it is whole.

    With `verify`, an archive is held against the hash that it states instead.

    Args:
        recording: a path or address.
        to: the archive, NAME.mcap; None: NAME.pack.mcap beside the recording.
        plan: how the recording is opened, and what animal its arena is found by; its
            `arena.region` is the region where it states one.
        whole: keep whole pictures.
        verify: read the archive again and compare every picture and time with the recording.
        delete_original: remove the recording's file once that was done and nothing differs.
        overwrite: replace a file that is in the archive's place.
        progress: told frame by frame.

    Raises:
        RecordingError: something is in its place, the depths do not fit, the recording cannot be
            opened or is an archive already, or what was read again differs.
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
        corners = () if whole else _stated(opened, plan)
        mask, notes = (None, []) if whole else _region(recording, opened, plan, corners, progress)
        with in_place(target) as part:
            digest = _write(opened, part, step_mm, mask, corners, progress)
            if verify or delete_original:
                _compare(opened, part, mask, digest, progress)
        done = Packed(
            target,
            len(opened),
            target.stat().st_size,
            sum(source.stat().st_size for source in opened.sources),
            1.0 if mask is None else float(mask.mean()),
            verify or delete_original,
            True,
            list(opened.sources) if delete_original else [],
            [*opened.problems, *notes],
        )
    for source in done.deleted:
        source.unlink()
    return done


def _checked(path: str | Path, opened: Recording, progress: Progress) -> Packed:
    """An archive, its times and pictures held against the hash that it states."""
    stated = opened.metadata["packed"]
    digest = _hash_of(opened, progress)
    if digest != stated["depth_sha256"]:
        raise RecordingError(
            f"{path} was cut or changed since it was packed: its times and pictures have another "
            "hash than it states; take another copy of it"
        )
    size = Path(path).stat().st_size
    return Packed(Path(path), len(opened), size, 0, 1.0, True, False, [], list(opened.problems))


def _target(
    recording: str | Path, to: str | Path | None, opened: Recording, overwrite: bool
) -> Path:
    """Where the archive goes."""
    from liex_lab.recordings.formats.messages.pack_facts import SUFFIX

    beside = Path(recording).parent if opened.sources else Path()
    target = Path(to) if to is not None else inside(beside, opened.name, f"{SUFFIX}.mcap")
    if target.suffix.lower() != ".mcap":
        raise RecordingError(
            f"an archive is an MCAP file; give --to NAME.mcap (in Python to=), not {target.name}"
        )
    if not target.parent.is_dir():
        raise RecordingError(
            f"there is no folder {target.parent} to write {target.name} into; make it first"
        )
    if any(target.resolve() == source.resolve() for source in opened.sources):
        raise RecordingError(f"{target} is the recording itself; write under another name")
    if target.exists() and (target.is_dir() or not overwrite):
        raise RecordingError(f"{target} is there already; give another name, or add --overwrite")
    return target


def _check_deletable(opened: Recording) -> None:
    """Refuse to remove anything but the one file of a whole recording."""
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
    """The pixels to keep (H, W), None for all, and a note on why; those within corners, if stated.

    A region that was found is kept where the tracker learned from it is that of whole pictures.
    """
    from liex_lab.arena.scene import region_mask

    if corners:
        return region_mask(corners, opened.width, opened.height), []
    if plan.arenas is not None:
        return None, ["whole pictures are kept, for the plan has several arenas in them"]
    try:
        seen = build_recording(recording, plan, progress)
    except LiexError as error:
        return None, [f"whole pictures are kept: {error}"]
    with seen:
        if seen.optics:
            return None, ["whole pictures are kept, for lens, water or a mirror bend them"]
        progress(0, None, "finding the arena")
        try:
            learned = build_tracker(seen, plan)
        except (EstimationError, ModelError) as error:
            return None, [f"whole pictures are kept, for no arena was found: {error}"]
        region = _found_region(learned, seen.width, seen.height)
        if region is None:
            return None, [
                "whole images are kept, for the measurement uses all of them, not only the arena; "
                "name the region to be kept with --region"
            ]
        if learned.scene.standing.n_together > 1:  # type: ignore[attr-defined]
            return None, [
                "whole pictures are kept, for more than one thing moves in them; name what is to "
                "be kept with --region"
            ]
        for share in _WIDER:
            mask = _wider(region, round(share * seen.width))
            cut = seen.seen_by(seen.camera, _within(mask), {}, lent=True)
            try:
                if _alike(learned, build_tracker(cut, plan)):
                    return mask, []
            except EstimationError:
                continue
        return None, [
            "whole pictures are kept, for the arena alone would be measured otherwise; name the "
            "region to be kept with --region"
        ]


def _stated(opened: Recording, plan: Plan) -> Corners:
    """The corners (u, v) px of the plan's region in the recording's pictures; none without one."""
    from .regions import stated_corners

    return () if plan.arena.region is None else stated_corners(opened, plan, plan.arena.region)


def _found_region(tracker: FrameTracker, width: int, height: int) -> Mask | None:
    """The pixels (H, W) that are looked at; None for all."""
    standing = getattr(tracker.scene, "standing", None)
    if standing is None or standing.region is None:
        return None
    stride = int(getattr(tracker.scene, "stride", 1))
    mask = np.repeat(np.repeat(standing.region, stride, axis=0), stride, axis=1)
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
    """What makes pixels outside of a mask unread."""
    if mask is None:
        return lambda depth: depth
    return lambda depth: np.where(mask, depth, np.float32(0))


def _alike(one: FrameTracker, other: FrameTracker) -> bool:
    """Whether two trackers were learned alike, bit for bit."""
    own = [field.name for field in fields(one) if field.name not in ("estimator", "scene", "body")]
    scene = [field.name for field in fields(one.scene) if field.name != "standing"]  # type: ignore[arg-type]
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
    """Write the archive; returns the hash that it states."""
    from liex_lab.recordings.formats.messages.mcap_writer import McapDepthWriter
    from liex_lab.recordings.formats.messages.pack_facts import PackFacts, hash_note

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
    whole = _Hash(step_mm)
    metadata = {**opened.metadata, **facts.to_notes()}
    with McapDepthWriter(
        part, opened.camera, messages="ros", packing="rvl", step_mm=step_mm, metadata=metadata
    ) as writer:
        for frame in opened:
            kept = type(frame)(frame.index, frame.time_ns, within(frame.depth))
            writer.add(kept)
            whole.add(frame.time_ns, kept.depth)
            progress(frame.index + 1, len(opened), f"packing {opened.name}")
        writer.note(hash_note(whole.hexdigest))
    return whole.hexdigest


def _compare(
    opened: Recording, part: Path, mask: Mask | None, digest: str, progress: Progress
) -> None:
    """Raise RecordingError where the archive differs from the recording."""
    from liex_lab.recordings import open_recording

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


class _Hash:
    """SHA-256 of times and pictures in steps; see `PackFacts.depth_sha256`."""

    def __init__(self, step_mm: float) -> None:
        self._step_mm = step_mm
        self._sha256 = hashlib.sha256()

    def add(self, time_ns: int, depth: Depth) -> None:
        """Take the next picture (H, W) float32 mm."""
        steps = np.rint(depth / np.float32(self._step_mm)).astype("<u2")
        self._sha256.update(np.int64(time_ns).astype("<i8").tobytes())
        self._sha256.update(steps.tobytes())

    @property
    def hexdigest(self) -> str:
        """64 hexadecimal digits."""
        return self._sha256.hexdigest()


def _hash_of(opened: Recording, progress: Progress) -> str:
    whole = _Hash(float(opened.metadata["packed"]["step_mm"]))
    for frame in opened:
        whole.add(frame.time_ns, frame.depth)
        progress(frame.index + 1, len(opened), f"verifying {opened.name}")
    return whole.hexdigest
