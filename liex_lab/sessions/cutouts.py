"""Cut-outs: the depth that a session keeps of every frame, and the still scene behind it.

The background is the farthest depth that keeps recurring in each pixel (see `scene.background`). An
animal that hardly moves would become part of it, but the segmentation knows the depth behind such
an animal. In every frame, the boxes around the two likeliest objects, or around as many as animals
are measured, are kept as the camera read them, unread pixels as 0; outside of them a kept image
shows the background. A frame without any
such object is kept whole, so that people can find out why. A box contains the projected joints of
the object's pose, and a square of 1.4 square roots of its pixels about its centroid, with a margin
of 15 % of the spine all around:

    box = hull(joints, centroid -+ 0.7 sqrt(n_px)) -+ (0.15 spine f / z + 4 px).

A body with a tail has a further point, 0.35 of the spine straight behind its rump.
It depends on the single frame only, so it is the same in every process.

Rerun's viewer reports images of changing size as a broken video. In its replay, cut-outs therefore
have few sizes, `windows`: from the length of the animal's box on the floor,

    a = 1.3 spine f / z + 8 px,

sides of 1, 1.15 and 1.4 times that (animals rear and swim above the floor), and whole images. A
cut-out is centred in the smallest window that contains it, in front of the still scene.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import zstandard
from numpy.typing import ArrayLike, NDArray

from liex_lab.errors import RecordingError, SessionError
from liex_lab.optics.camera import Camera
from liex_lab.recordings.depth_kernels import to_millimetres
from liex_lab.recordings.formats.messages.mcap import open_replay
from liex_lab.recordings.frame import region_mask
from liex_lab.recordings.recording import Recording
from liex_lab.scene.background import learn_background, sample_frames
from liex_lab.scene.background_segmenter import BackgroundSubtraction, at_every_pixel
from liex_lab.sessions.provenance import THUMBNAILS, Provenance, reading_from
from liex_lab.sessions.session import Session
from liex_lab.tables.rows import Rows
from liex_lab.tracking.observations import Observations

Depth = NDArray[np.uint16]
Boxes = NDArray[np.int16]

FILE = "cutouts.npz"
ANIMAL = "animal"
ARENA = "arena"
ALL = "all"
NONE = "none"
N_BOXES = 2  # objects per frame, if no more animals are measured
_FRAMES = 16  # from which the background is learned
_REACH = 0.7  # of the square root of an object's pixels, to each side of its centroid
_MARGIN = 0.15  # of the spine
_MARGIN_PX = 4.0
_TAIL = 0.35  # of the spine, straight behind a body with a tail
_SIDES = (1.0, 1.15, 1.4)  # of windows, in lengths of the animal's box on the floor
N_WINDOWS = len(_SIDES) ** 2 + 1  # at most; the last is the whole image


def still_scene(recording: Recording, known: BackgroundSubtraction | None = None) -> Depth:
    """The background of the whole image, including pixels outside of any region, from 16 frames.

    Args:
        recording: an open recording.
        known: the segmentation's own scene, learned from more frames, which can identify a resting
            animal; None for a hand.

    Returns:
        (H, W) uint16 mm, smoothed by a median of 3 x 3 pixels, 0 where no depth recurs.
    """
    learned = to_millimetres(learn_background(sample_frames(recording, _FRAMES))[0])
    # remove specks of the small sample
    smooth: Depth = np.asarray(cv2.medianBlur(learned, 3), np.uint16)
    return smooth if known is None else _without_animals(smooth, known)


def _without_animals(image: Depth, known: BackgroundSubtraction) -> Depth:
    """Replace what the segmentation would take for the animal by the background.

    Objects of more than four times the animal's usual area stay: if only the bare plane is known of
    the floor, so do permanent objects on it.

    Args:
        image: (H, W) uint16 mm.
        known: the segmentation's scene, on a subsampled pixel grid.
    """
    step = known.stride
    limit, background = (
        at_every_pixel(values, step, image.shape) for values in (known.limit, known.background)
    )
    _, labels = cv2.connectedComponents(((image > 0) & (image < limit)).astype(np.uint8))
    areas = np.bincount(labels.ravel(), image.ravel().astype(np.float64) ** 2)
    # usual areas of the animal; larger objects are not resting animals
    rests = areas / (known.camera.fx * known.camera.fy) < 4.0 * known.area_mm2
    rests[0] = False  # the background itself
    # the animal's edge is below the segmentation's limit
    around = np.ones((2 * step + 3, 2 * step + 3), np.uint8)
    own = cv2.dilate(rests[labels].astype(np.uint8), around).astype(bool)
    behind = to_millimetres(background)
    return np.where(own & (behind > image), behind, image)


class DepthKeeper:
    """Selects the depth that a session keeps, according to its plan.

    Args:
        origin: camera, animal, background, and extent of the depth to keep.
    """

    def __init__(self, origin: Provenance) -> None:
        self._origin = origin
        self._kept = origin.replay_depth
        self._region = _region(origin) if self._kept == ARENA else None
        self._arena = _arena(origin) if self._kept == ARENA else (0, 0, 0, 0)

    def boxes(self, observations: Observations | None) -> Boxes | None:
        """Boxes in which images are kept as read; the background replaces the rest.

        Args:
            observations: the hypotheses of these n frames; None without a search for an animal.

        Returns:
            (n, K, 4) int16 of left, top, right and bottom (px, the latter two exclusive, all 0 for
            no box); None if whole images are kept, or none.
        """
        if self._kept in (NONE, ALL) or self._origin.background is None or observations is None:
            return None
        if self._kept == ARENA:
            boxes = np.zeros((len(observations), N_BOXES, 4), np.int16)
            boxes[:, 0] = self._arena
            return boxes
        boxes = boxes_around(observations, self._origin)
        camera = self._origin.camera
        nothing = ~boxes.any(axis=(1, 2))
        boxes[nothing, 0] = (0, 0, camera.width, camera.height)  # for people to find out why
        return boxes

    def keep(self, depth: Sequence[NDArray[np.float32]], boxes: Boxes | None) -> list[Depth]:
        """The images to keep; empty if no depth is kept.

        Args:
            depth: n images (H, W) float32 mm, 0 where unread.
            boxes: of these frames, see `boxes`.
        """
        if self._kept == NONE:
            return []
        background = self._origin.background
        if boxes is None or background is None:
            return [to_millimetres(image) for image in depth]
        if self._kept == ARENA:
            whole = [to_millimetres(image) for image in depth]
            if self._region is None:
                return whole
            return [np.where(self._region, image, background) for image in whole]
        return [composed(image, cuts, background) for image, cuts in zip(depth, boxes, strict=True)]


def _region(origin: Provenance) -> NDArray[np.bool_] | None:
    """(H, W) mask of the arena's region; None for the whole image."""
    if origin.scene is None or not origin.scene.region_px:
        return None
    return region_mask(origin.scene.region_px, origin.camera.width, origin.camera.height)


def _arena(origin: Provenance) -> tuple[int, int, int, int]:
    """The box of the arena's region."""
    region = _region(origin)
    if region is None:
        return 0, 0, origin.camera.width, origin.camera.height
    rows = np.flatnonzero(region.any(axis=1))
    columns = np.flatnonzero(region.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def windows(origin: Provenance) -> list[tuple[int, int]]:
    """Sizes of cut-outs in the Rerun replay, determined by the provenance.

    Args:
        origin: camera, its distance from the floor, the animal's length, and extent of the depth.

    Returns:
        At most `N_WINDOWS` of (width, height) px, smallest area first; the last is the whole image.
    """
    camera = origin.camera
    sizes = {(camera.width, camera.height)}
    if origin.replay_depth == ARENA:
        left, top, right, bottom = _arena(origin)
        sizes.add((right - left, bottom - top))
    else:
        length_px = _spine_mm(origin) * camera.fx / max(origin.floor_distance_mm, 1.0)
        side = (1.0 + 2.0 * _MARGIN) * length_px + 2.0 * _MARGIN_PX
        sides = [math.ceil(times * side) for times in _SIDES]
        sizes |= {(min(w, camera.width), min(h, camera.height)) for w in sides for h in sides}
    return sorted(sizes, key=lambda size: (size[0] * size[1], size))


def window_around(
    box: Sequence[int], sizes: Sequence[tuple[int, int]]
) -> tuple[int, tuple[int, int, int, int]]:
    """The smallest window that contains a box, centred on it where the image allows.

    Args:
        box: left, top, right, bottom, px, in the image.
        sizes: of windows, see `windows`.

    Returns:
        Index of the size, and left, top, right, bottom, px.
    """
    left, top, right, bottom = box
    width = right - left
    height = bottom - top
    which = next(k for k, (w, h) in enumerate(sizes) if w >= width and h >= height)
    wide, high = sizes[which]
    x = min(max(left + width // 2 - wide // 2, 0), sizes[-1][0] - wide)
    y = min(max(top + height // 2 - high // 2, 0), sizes[-1][1] - high)
    return which, (x, y, x + wide, y + high)


def _spine_mm(origin: Provenance) -> float:
    return float(origin.animal_size.get("spine_mm") or origin.skeleton.length)


def boxes_around(observations: Observations, origin: Provenance) -> Boxes:
    """The boxes around the likely animals of single frames.

    Args:
        observations: the hypotheses of n frames.
        origin: camera, its pose, and the animal's length.

    Returns:
        (n, K, 4) int16 left, top, right, bottom, px, of K = 2 or as many objects as animals are
            measured; all 0 for no object.
    """
    camera = origin.camera
    into = origin.T_arena_camera.inverse()
    spine_mm = _spine_mm(origin)
    n_boxes = max(N_BOXES, observations.known.shape[1] // 2)
    found = np.zeros((len(observations), n_boxes, 4), np.int16)
    for k in range(n_boxes):
        h = 2 * k  # the other hypothesis of each object is the same one reversed
        rows = np.flatnonzero(observations.known[:, h] & (observations.n_px[:, h] > 0))
        if not len(rows):
            continue
        joints = observations.joints_as(h, range(observations.skeleton.n_joints))[rows].astype(
            np.float64
        )
        if "tail_mm" in origin.skeleton.surface:
            tail = joints[:, :1] - joints[:, 1:2]
            tail *= _TAIL * spine_mm / np.maximum(np.linalg.norm(tail, axis=2, keepdims=True), 1e-9)
            joints = np.append(joints, joints[:, :1] + tail, axis=1)
        centre = observations.centroid_px[rows, h].astype(np.float64)
        reach = _REACH * np.sqrt(observations.n_px[rows, h].astype(np.float64))[:, None]
        far = (into @ observations.centroid_mm[rows, h].astype(np.float64))[:, 2:]
        margin = _MARGIN * spine_mm * camera.fx / np.maximum(far, 1.0) + _MARGIN_PX
        with np.errstate(invalid="ignore"):
            uv = camera.project(into @ joints.reshape(-1, 3)).reshape(len(rows), -1, 2)
            low = np.fmin(np.fmin.reduce(uv, axis=1), centre - reach) - margin
            high = np.fmax(np.fmax.reduce(uv, axis=1), centre + reach) + margin
        size = np.array([camera.width, camera.height])
        low, high = (
            np.clip(np.nan_to_num(corner), 0, size).astype(np.int64)
            for corner in (np.floor(low), np.ceil(high) + 1.0)
        )
        whole = (high > low).all(axis=1)
        found[rows[whole], k] = np.hstack([low, high])[whole]
    return found


def composed(depth: NDArray[np.float32], boxes: Boxes, background: Depth) -> Depth:
    """An image inside its boxes, and the background outside of them.

    Args:
        depth: (H, W) float32 mm, 0 where unread.
        boxes: (K, 4) left, top, right, bottom, px.
        background: (H, W) uint16 mm.

    Returns:
        (H, W) uint16 mm, a new array.
    """
    image = background.copy()
    for left, top, right, bottom in boxes.tolist():
        image[top:bottom, left:right] = to_millimetres(depth[top:bottom, left:right])
    return image


def meant_to_keep_depth(session: Session) -> bool:
    """Whether a session's plan keeps depth in its replay.

    Args:
        session: the session; plans of earlier versions have a boolean, or no value.
    """
    return session.metadata.get("plan", {}).get("replay", {}).get("depth", ALL) not in (NONE, False)


def open_depth(session: Session) -> Recording:
    """The depth images that a session keeps, as a recording.

    Outside of its boxes an image shows the still scene, see `Kept`.

    Args:
        session: the session.

    Returns:
        The recording of session.mcap; its rows are those of the table `frames`.

    Raises:
        SessionError: the session keeps no depth.
        RecordingError: session.mcap cannot be read.
    """
    try:
        return open_replay(session.path / "session.mcap")
    except RecordingError:
        if meant_to_keep_depth(session):
            raise
    raise SessionError(
        f'{session.path} keeps no depth images, for its plan states replay.depth = "none"; run '
        "`liex run` on the recording again with --set replay.depth=animal (in Python "
        "plan.with_settings(['replay.depth=animal']))"
    )


class Kept:
    """Where a session's images are as the camera read them, instead of the still scene.

    Args:
        session: the session.

    Attributes:
        boxes: (n, K, 4) left, top, right and bottom of every frame's cut-outs, px; None for a
            session with whole images, or none.

    Raises:
        SessionError: its file is damaged.
    """

    def __init__(self, session: Session) -> None:
        self.boxes: Boxes | None = None
        path = session.path / FILE
        if path.is_file():
            with reading_from(path), np.load(path, allow_pickle=False) as kept:
                boxes: NDArray[Any] = kept["boxes"]
                if boxes.ndim != 3 or boxes.shape[2] != 4 or len(boxes) != len(session.frames):
                    raise ValueError(f"boxes are {boxes.shape}, not those of every frame")
                self.boxes = boxes

    def holds(self, row: int, u_px: ArrayLike, v_px: ArrayLike) -> NDArray[np.bool_]:
        """Whether pixels of a frame were kept as read.

        Args:
            row: the frame's row in the table `frames`.
            u_px: columns, px; rounded.
            v_px: rows of the image, px; rounded.

        Returns:
            Booleans in the shape of `u_px`.
        """
        u, v = (np.rint(np.asarray(px, float))[..., None] for px in (u_px, v_px))
        if self.boxes is None:  # whole images, as in sessions of earlier versions
            return np.ones(u.shape[:-1], np.bool_)
        left, top, right, bottom = self.boxes[row].T
        return np.asarray(((left <= u) & (u < right) & (top <= v) & (v < bottom)).any(axis=-1))


def needed_bytes(
    images: Sequence[NDArray[np.uint16]],
    n_frames: int,
    n_joints: int,
    length_px: float,
    kept: str = ANIMAL,
) -> int:
    """Estimated size of a session, bytes, within a factor of two.

    bytes = once + n_frames (1,000 + 260 J + 2 (c A + 1,500))

    Every frame has rows of tables and messages, some 260 bytes per joint, and two copies of the
    kept depth (session.rrd, session.mcap): A pixels that compress to c bytes each, as the
    recording's own depth images do. A report, figures, descriptions and sixteen thumbnails are
    added. The numbers were measured on sessions of mice, fish and hands of 100 to 1,500 frames.

    Args:
        images: some depth images (H, W) of the recording, mm.
        n_frames: frames of the recording.
        n_joints: joints of the animal.
        length_px: length of the animal in the image.
        kept: extent of the kept depth, as in `[replay] depth`.
    """
    packer = zstandard.ZstdCompressor(level=3)  # as in the logs
    packed = sum(len(packer.compress(np.ascontiguousarray(image).tobytes())) for image in images)
    whole = sum(image.size for image in images)
    a_pixel = packed / max(whole, 1)
    a_frame = 1_000 + 260 * n_joints
    if kept != NONE:
        an_image = whole / max(len(images), 1)
        kept_px = min((1.1 * length_px + 8.0) ** 2, an_image) if kept == ANIMAL else an_image
        a_frame += int(2 * (a_pixel * kept_px + (0 if kept == ALL else 1_500)))
    return 1_200_000 + int(16 * (2.3 * length_px) ** 2 * a_pixel) + n_frames * a_frame


# Thumbnails of depth images, cut around the animal, for the report.


_KEPT = 32  # most whole frames kept of a recording of unknown length
_SHOWN = 16


class Thumbnails:
    """Evenly spaced frames of a stream, at most 32 at a time."""

    def __init__(self) -> None:
        self._every = 1
        self._n_frames = 0
        self._kept: dict[int, NDArray[np.uint16]] = {}  # row -> depth

    def add(self, depth: NDArray[np.float32]) -> None:
        """Add the next frame, depth (H, W) float32 mm, 0 where unread."""
        if self._n_frames % self._every == 0:
            self._kept[self._n_frames] = to_millimetres(depth)
        self._n_frames += 1
        if len(self._kept) > _KEPT:
            self._every *= 2
            self._kept = {row: image for row, image in self._kept.items() if row % self._every == 0}

    def resume(self, n_frames: int, read: Callable[[int], NDArray[np.float32]]) -> None:
        """Sample as if n_frames frames had been added.

        Args:
            n_frames: number of frames.
            read: depth (H, W) float32 mm of one of them by its row.
        """
        while n_frames > _KEPT * self._every:
            self._every *= 2
        self._kept = {row: to_millimetres(read(row)) for row in range(0, n_frames, self._every)}
        self._n_frames = n_frames

    def save(self, folder: Path, rows: Rows, camera: Camera) -> list[dict[str, Any]]:
        """Write up to sixteen 16-bit PNG images, mm, 0 where unread, of frames with a pose.

        Args:
            folder: the session folder, in which the folder `thumbnails` is created.
            rows: the track in the form of the tables.
            camera: the depth camera, for the size of the animal in px.

        Returns:
            For each file, frame_index, left_px, top_px, width_px and height_px.
        """
        usable = self._usable(rows)
        if not usable:
            return []
        (folder / THUMBNAILS).mkdir()
        chosen = {usable[k] for k in np.linspace(0, len(usable) - 1, _SHOWN).round().astype(int)}
        return [
            _written(folder, "frame", rows, row, *self._cut(row, rows, camera))
            for row in sorted(chosen)
        ]

    def save_whole(
        self, folder: Path, rows: Rows, observations: Observations
    ) -> dict[str, Any] | None:
        """Write the whole depth image that best shows another object of the animal's size.

        Call it after `save`.

        Args:
            folder: the session folder.
            rows: the track in the form of the tables.
            observations: the observations: the animal is one of their two components.

        Returns:
            Its entry as in `save`, and `beside_px`, [u, v] of the centre of the other object; None
            if no kept frame shows one.
        """
        usable = np.array(self._usable(rows), np.int64)
        uv = rows.track.uv_px[usable]
        centre = np.nanmean(uv, axis=1, keepdims=True)
        found = np.asarray(observations.centroid_px[usable, ::2], float)  # of both components
        away = np.linalg.norm(found - centre, axis=2)
        reach = np.nanmax(np.linalg.norm(uv - centre, axis=2), axis=1)
        size = observations.n_px[usable, ::2].min(axis=1)  # both components should be whole
        both = np.isfinite(away).all(axis=1) & (size > 0) & (away.max(axis=1) >= reach)
        if not both.any():
            return None
        best = int(np.where(both, size, 0).argmax())
        row = int(usable[best])
        place = found[best, away[best].argmax()]
        return {
            **_written(folder, "whole", rows, row, 0, 0, self._kept[row]),
            "beside_px": [round(float(at), 1) for at in place],
        }

    def _usable(self, rows: Rows) -> list[int]:
        """Kept rows with a measured pose."""
        observed = rows.track.observed
        return [row for row in sorted(self._kept) if row < len(observed) and observed[row]]

    def _cut(self, row: int, rows: Rows, camera: Camera) -> tuple[int, int, NDArray[np.uint16]]:
        """Left, top (px) and depth of a square around the animal; 0 beyond the image's edge."""
        depth = self._kept[row]
        uv = rows.track.uv_px[row]
        centre = np.nanmean(uv, axis=0)
        extent = np.nanmax(np.linalg.norm(uv - centre, axis=1))
        near = depth[depth > 0]
        distance = float(np.median(near)) if len(near) else 1000.0
        spine_px = float(rows.track.spine_mm[row]) * camera.fx / distance
        # half the side of a thumbnail, in spine lengths
        half_px = int(np.ceil(max(1.15 * spine_px, 1.3 * extent, 16.0)))
        left = int(np.round(centre[0])) - half_px
        top = int(np.round(centre[1])) - half_px
        side = 2 * half_px
        around = 2 * side  # an animal may reach out of the image
        row_px, column_px = top + around, left + around
        square = np.pad(depth, around)[row_px : row_px + side, column_px : column_px + side]
        return left, top, square


def _written(
    folder: Path, kind: str, rows: Rows, row: int, left: int, top: int, depth: NDArray[np.uint16]
) -> dict[str, Any]:
    """Write a PNG of a frame; returns its entry."""
    index = int(rows.frame_index[row])
    name = f"{THUMBNAILS}/{kind}_{index:07d}.png"
    cv2.imwrite(str(folder / name), depth)
    height, width = depth.shape
    return {
        "file": name,
        "frame_index": index,
        "left_px": left,
        "top_px": top,
        "width_px": width,
        "height_px": height,
    }
