"""Depth images of a Rerun replay: whole ones, or cut-outs in front of the still scene.

Depth is stored without loss: RVL (Wilson 2017, run-length and variable-length coding), or PNG if
sensor noise makes that smaller. A cut-out belongs to its own pinhole camera, whose principal point
is that of the camera minus the corner (left, top) of its window (see `cutouts.windows`):

    K' = K - [[0, 0, left], [0, 0, top], [0, 0, 0]].

The still scene is stored once. The entities below `PLACES` position every cut-out in the image, see
`cutout_frame`.

Rerun 0.41 treats the images of an entity over time as a video (rerun-io/rerun#12801). It reports no
problem if all images of an entity have one size and one encoding, and the encoding is logged once
for all times. So every window size and every encoding has its own entity, and only one of each
group shows an image at a time. Without a time only PNG is accepted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from liex_lab.recordings.depth_kernels import rvl_message
from liex_lab.sessions.cutouts import N_BOXES, N_WINDOWS, Boxes, window_around, windows
from liex_lab.sessions.provenance import Provenance

Array = NDArray[np.float64]
Packed = tuple[NDArray[np.uint8], str]  # bytes and media type

IMAGE = "arena/camera/image"
DEPTH = f"{IMAGE}/depth"
NOISY = f"{DEPTH}/png"  # whole images whose noise makes PNG smaller
BACKGROUND = f"{IMAGE}/background"
PLACES = f"{IMAGE}/places"
CUTOUTS = "arena/camera/cutouts"
MM_PER_UNIT = 1000.0  # our depth is in mm, the scene in metres
# drawing order in the image; whole images may cover the cut-outs
_BACKMOST = -40.0
_BEHIND = -30.0
_WHOLE = -20.0
# media types
_RVL = "application/rvl"
_PNG = "image/png"
_LARGE = 0.54  # bytes per pixel: 166 kB for 640 x 480
_PACKED_FURTHER = 0.93  # by Rerun's own compression: RVL by this factor, PNG not at all
_NOISY_PNG = (
    16,
    1,
    17,
    2,
)  # OpenCV's IMWRITE_PNG_COMPRESSION 1 and IMWRITE_PNG_STRATEGY 2, HUFFMAN_ONLY
# images, and their bytes, per message: the index at the file's end needs some 5 kB of memory
# per message
_TOGETHER = 128
_TOGETHER_BYTES = 1 << 23


class DepthColumns:
    """Depth images to be written together.

    Args:
        origin: camera, its distance from the floor, and the still scene.
    """

    def __init__(self, origin: Provenance) -> None:
        self._origin = origin
        self._waiting: list[_Picture] = []
        self._n_bytes = 0
        self._n_messages = 0
        self._introduced: set[str] = set()
        self._shown: set[str] = set()  # entities that show an image of earlier frames

    @cached_property
    def _windows(self) -> list[tuple[int, int]]:
        return windows(self._origin)

    def resume(self) -> None:
        """Continue another file, whose last visible entities are unknown."""
        cut_out = self._origin.background is not None
        self._shown = set(cutout_entities() if cut_out else (DEPTH, NOISY))

    def take(
        self,
        frame_index: int,
        elapsed_ns: int,
        depth: NDArray[np.uint16],
        boxes: Boxes | None,
    ) -> bool:
        """Add the next image.

        Args:
            frame_index: the camera's count of the frame.
            elapsed_ns: time since the first frame, ns.
            depth: (H, W) uint16 mm, 0 where unread; the still scene outside of its cut-outs.
            boxes: (K, 4) left, top, right and bottom of its cut-outs, px, all 0 if absent; None for
                a whole image.

        Returns:
            Whether to `send` the waiting images.
        """
        if boxes is None:
            blob, media_type = packed(depth)
            parts = {DEPTH if media_type == _RVL else NOISY: blob}
            cuts: list[tuple[int, int, int, int]] = []
        else:
            parts, cuts = self._cut_out(depth, boxes.tolist())
        self._waiting.append(_Picture(int(frame_index), elapsed_ns, parts, cuts))
        self._n_bytes += sum(len(blob) for blob in parts.values())
        return len(self._waiting) == _TOGETHER or self._n_bytes > _TOGETHER_BYTES

    def _cut_out(
        self, depth: NDArray[np.uint16], boxes: Sequence[Sequence[int]]
    ) -> tuple[dict[str, NDArray[np.uint8]], list[tuple[int, int, int, int]]]:
        """Packed windows around boxes by their entities, and their bounds; all 0 for no box.

        Always RVL: it is several times as fast as PNG, and not larger.
        """
        parts = {}
        places = []
        for k, box in enumerate(boxes):
            if box[2] <= box[0]:
                places.append((0, 0, 0, 0))
                continue
            which, place = window_around(box, self._windows)
            left, top, right, bottom = place
            parts[cutout_entity(k, which)] = rvl_message(depth[top:bottom, left:right])
            places.append(place)
        return parts, places

    def send(self, stream: Any) -> int:
        """Write the waiting images.

        Args:
            stream: the Rerun stream.

        Returns:
            Number of messages with images.
        """
        waiting = self._waiting
        self._waiting = []
        self._n_bytes = 0
        self._n_messages = 0
        if not waiting:
            return 0
        for k in range(len(waiting[0].windows)):
            self._send_lens(stream, k, waiting)
        for entity in sorted(self._shown.union(*(picture.parts for picture in waiting))):
            self._send_pictures(stream, entity, waiting)
        self._shown = set(waiting[-1].parts)
        return self._n_messages

    def _send_pictures(self, stream: Any, entity: str, waiting: Sequence[_Picture]) -> None:
        """Send the images of an entity, and the frame from which it shows none."""
        blobs = []
        rows = []
        counts = []
        shown = entity in self._shown
        for row, picture in enumerate(waiting):
            blob = picture.parts.get(entity)
            if blob is not None:
                blobs.append(blob)
            if blob is not None or shown:
                rows.append(row)
                counts.append(int(blob is not None))
            shown = blob is not None
        if blobs and entity.startswith(CUTOUTS) and entity not in self._introduced:
            self._introduce(stream, entity)
        columns = rr.EncodedDepthImage.columns(blob=blobs)
        when = _when([waiting[row] for row in rows])
        stream.send_columns(entity, when, [*columns.partition(counts)])
        self._n_messages += 1

    def _send_lens(self, stream: Any, k: int, waiting: Sequence[_Picture]) -> None:
        """Send the intrinsics of the k-th cut-out of frames, and its position in the image."""
        boxes = np.array([picture.windows[k] for picture in waiting], np.float64)
        there = boxes[:, 2] > boxes[:, 0]
        if not there.any() and k:
            return
        n = len(boxes)
        lens = np.tile(self._origin.camera.matrix, (n, 1, 1))
        lens[:, :2, 2] -= boxes[:, :2]
        lenses = rr.Pinhole.columns(
            image_from_camera=lens,
            resolution=np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0),
        )
        corners = np.hstack([boxes[:, :2], np.zeros((n, 1))])
        places = rr.Transform3D.columns(
            translation=corners,
            child_frame=[cutout_frame(k)] * n,
            parent_frame=[f"tf#/{IMAGE}"] * n,
        )
        when = _when(waiting)
        stream.send_columns(f"{CUTOUTS}/{k + 1}", when, [*lenses])
        stream.send_columns(f"{PLACES}/{k + 1}", when, [*places])

    def _introduce(self, stream: Any, entity: str) -> None:
        """Log the static properties of a cut-out entity, equal in every part of a replay."""
        assert self._origin.background is not None
        look = self._look(self._origin.background)
        kind = rr.EncodedDepthImage.from_fields(**look, media_type=_RVL, draw_order=_BEHIND)
        stream.log(entity, kind, static=True)
        self._introduced.add(entity)

    def log_kind(self, stream: Any, first: NDArray[np.uint16], *, whole: bool) -> None:
        """Log the static properties of whole images (encoding, unit, colours, layout), or the still
        scene.

        Args:
            stream: the Rerun stream.
            first: (H, W) uint16 mm, the first image.
            whole: whole images are kept, no cut-outs.
        """
        if whole:
            for entity, media_type in ((DEPTH, _RVL), (NOISY, _PNG)):
                kind = rr.EncodedDepthImage.from_fields(
                    **self._look(first), media_type=media_type, draw_order=_WHOLE
                )
                stream.log(entity, kind, static=True)
            return
        import cv2

        assert self._origin.background is not None
        blob = cv2.imencode(".png", self._origin.background)[1].ravel()
        scene = rr.EncodedDepthImage(
            blob=blob,
            media_type=_PNG,
            **self._look(self._origin.background),
            draw_order=_BACKMOST,
        )
        stream.log(BACKGROUND, scene, static=True)

    def _look(self, depth: NDArray[np.uint16]) -> dict[str, Any]:
        """Unit and colours of images similar to this one."""
        return {
            "meter": MM_PER_UNIT,
            "colormap": "viridis",
            "point_fill_ratio": 0.25,
            "depth_range": colour_range(depth, self._origin.floor_distance_mm),
        }


@dataclass(frozen=True)
class _Picture:
    """Kept depth of a frame: its packed parts by entity, and the windows of its cut-outs
    (left, top, right, bottom, px; all 0 if absent), empty for a whole image.
    """

    index: int
    elapsed_ns: int
    parts: dict[str, NDArray[np.uint8]]
    windows: Sequence[tuple[int, int, int, int]]


def _when(pictures: Sequence[_Picture]) -> list[rr.TimeColumn]:
    """The timelines of images."""
    return timeline(
        np.array([picture.index for picture in pictures], np.int64),
        np.array([picture.elapsed_ns for picture in pictures], np.int64),
    )


def cutout_entity(k: int, which: int) -> str:
    """Entity of the k-th cut-out in a window.

    Replays of earlier versions use that of the smallest window for every cut-out.

    Args:
        k: counted from 0.
        which: of the `windows`, counted from 0.
    """
    entity = f"{CUTOUTS}/{k + 1}/depth"
    return f"{entity}/{which + 1}" if which else entity


def cutout_entities() -> list[str]:
    """All entities that may show a cut-out."""
    return [cutout_entity(k, which) for k in range(N_BOXES) for which in range(N_WINDOWS)]


def cutout_frame(k: int) -> str:
    """Rerun's name of the coordinate frame of the k-th cut-out in the image.

    In space a cut-out has its own pinhole camera; in a view of the image its entity is placed into
    this frame instead, because Rerun does not show one camera's image in another's.

    Args:
        k: counted from 0.
    """
    return f"cutout {k + 1} in the picture"


def packed(depth: NDArray[np.uint16]) -> Packed:
    """Encode a depth image without loss.

    RVL is fast and halves the size of raw images. If noise makes it large, beyond 0.54 bytes per
    pixel, PNG is used if smaller (Huffman coding only: noise has no runs).

    Args:
        depth: (H, W) uint16 mm, 0 where unread.

    Returns:
        The bytes, and their media type: 'application/rvl' or 'image/png'.
    """
    import cv2

    rvl = rvl_message(depth)
    if len(rvl) > _LARGE * depth.size:
        png = cv2.imencode(".png", depth, _NOISY_PNG)[1].ravel()
        if len(png) < _PACKED_FURTHER * len(rvl):
            return png, _PNG
    return rvl, _RVL


def colour_range(depth: NDArray[np.uint16], floor_distance_mm: float) -> tuple[float, float]:
    """Depth range of the colour map: the floor of the first frame, and 80 mm above.

    A floor tilted by 10 degrees is covered, but not the walls.

    Args:
        depth: (H, W) uint16 mm of the first frame, 0 where unread.
        floor_distance_mm: distance of the camera from the floor, mm.

    Returns:
        (near, far), mm.
    """
    read = depth[depth > 0]
    near, far = (
        np.percentile(read, [2.0, 98.0]) if len(read) else (floor_distance_mm, floor_distance_mm)
    )
    near = (
        max(float(near), floor_distance_mm - 60.0) - 80.0
    )  # a floor tilted by 10 degrees, but not the walls
    return max(near, 1.0), max(float(far), near + 10.0) + 10.0


def timeline(index: NDArray[np.int64], elapsed_ns: NDArray[np.int64]) -> list[rr.TimeColumn]:
    """The timelines `frame` and `time` of n rows.

    Args:
        index: (n,) the camera's count of the frames.
        elapsed_ns: (n,) time since the first frame, ns.
    """
    return [
        rr.TimeColumn("frame", sequence=index),
        rr.TimeColumn("time", duration=elapsed_ns.astype("timedelta64[ns]")),
    ]
