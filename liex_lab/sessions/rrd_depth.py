"""Depth pictures of a Rerun replay: whole ones, or cut-outs before the still scene.

Depth is stored without loss: RVL (Wilson 2017, run-length and variable-length coding), or PNG where
sensor noise makes that smaller. A cut-out is seen by a pinhole camera of its own, whose principal
point is that of the camera less the cut-out's corner (left, top):

    K' = K - [[0, 0, left], [0, 0, top], [0, 0, 0]].

The still scene is there once. Where cut-outs lie in the picture say the entities below `PLACES`,
see `cutout_frame`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from liex_lab.recordings.rvl import rvl_message
from liex_lab.sessions.cutouts import N_BOXES, Boxes
from liex_lab.sessions.provenance import Provenance

Array = NDArray[np.float64]
Packed = tuple[NDArray[np.uint8], str]  # bytes and media type

IMAGE = "arena/camera/image"
DEPTH = f"{IMAGE}/depth"
BACKGROUND = f"{IMAGE}/background"
PLACES = f"{IMAGE}/places"
CUTOUTS = "arena/camera/cutouts"
MM_PER_UNIT = 1000.0  # our depth is in mm, the scene in metres
# one above the other in the picture; whole pictures may be shown over the cut-outs
_BACKMOST = -40.0
_BEHIND = -30.0
_WHOLE = -20.0
_RVL = "application/rvl"  # media type
_LARGE = 0.54  # bytes per pixel: 166 kB for 640 x 480
_PACKED_FURTHER = 0.93  # by Rerun, which packs what it writes: RVL so much, PNG not at all
_NOISY_PNG = (
    16,
    1,
    17,
    2,
)  # OpenCV's IMWRITE_PNG_COMPRESSION 1 and IMWRITE_PNG_STRATEGY 2, HUFFMAN_ONLY
# pictures, and their bytes, in one message: for each message the index that ends the file takes
# some 5 kB of memory
_TOGETHER = 64
_TOGETHER_BYTES = 1 << 23


class DepthColumns:
    """Depth pictures that wait to be written together.

    Args:
        origin: camera, its distance from the floor, and the still scene.
    """

    def __init__(self, origin: Provenance) -> None:
        self._origin = origin
        self._waiting: list[_Picture] = []
        self._n_messages = 0

    def take(
        self,
        frame_index: int,
        elapsed_ns: int,
        depth: NDArray[np.uint16],
        boxes: Boxes | None,
    ) -> bool:
        """Take the next picture.

        Args:
            frame_index: the camera's count of the frame.
            elapsed_ns: time since the first frame, ns.
            depth: (H, W) uint16 mm, 0 where unread.
            boxes: (K, 4) left, top, right and bottom of its cut-outs, px, all 0 for none; None for
                a whole picture.

        Returns:
            Whether it is time to `send` what waits.
        """
        cuts = [] if boxes is None else boxes.tolist()
        parts = [packed(depth)] if boxes is None else [_cut_out(depth, box) for box in cuts]
        self._waiting.append(_Picture(int(frame_index), elapsed_ns, parts, cuts))
        n_bytes = sum(picture.n_bytes for picture in self._waiting)
        return len(self._waiting) == _TOGETHER or n_bytes > _TOGETHER_BYTES

    def send(self, stream: Any) -> int:
        """Write what waits.

        Args:
            stream: the Rerun stream.

        Returns:
            How many messages of pictures that made.
        """
        waiting = self._waiting
        self._waiting = []
        self._n_messages = 0
        if not waiting:
            return 0
        when = timeline(
            np.array([picture.index for picture in waiting]),
            np.array([picture.elapsed_ns for picture in waiting]),
        )
        if not waiting[0].boxes:
            self._send_pictures(stream, DEPTH, when, [picture.parts[0] for picture in waiting])
        for k in range(len(waiting[0].boxes)):
            boxes = np.array([picture.boxes[k] for picture in waiting], np.float64)
            self._send_cutouts(stream, k, when, boxes, [picture.parts[k] for picture in waiting])
        return self._n_messages

    def _send_pictures(
        self,
        stream: Any,
        entity: str,
        when: list[rr.TimeColumn],
        parts: Sequence[Packed],
    ) -> None:
        """Depth pictures, packed; those of no bytes are none."""
        there = [part for part in parts if len(part[0])]
        blobs, kinds = zip(*there, strict=True) if there else ((), ())
        columns = rr.EncodedDepthImage.columns(blob=blobs, media_type=kinds)
        counts = [int(len(blob) > 0) for blob, _ in parts]
        stream.send_columns(entity, when, [*columns.partition(counts)])
        self._n_messages += 1

    def _send_cutouts(
        self,
        stream: Any,
        k: int,
        when: list[rr.TimeColumn],
        boxes: Array,
        parts: Sequence[Packed],
    ) -> None:
        """The k-th cut-out of frames with its lens, and where in the picture it lies; boxes (n, 4)
        px.
        """
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
        stream.send_columns(f"{CUTOUTS}/{k + 1}", when, [*lenses])
        stream.send_columns(f"{PLACES}/{k + 1}", when, [*places])
        self._send_pictures(stream, f"{CUTOUTS}/{k + 1}/depth", when, parts)

    def log_kind(self, stream: Any, first: NDArray[np.uint16], *, whole: bool) -> None:
        """Log what holds for every depth picture: unit, colours, layout; and the still scene.

        Args:
            stream: the Rerun stream.
            first: (H, W) uint16 mm, the first picture.
            whole: whole pictures are kept, no cut-outs.
        """
        look: dict[str, Any] = {
            "meter": MM_PER_UNIT,
            "colormap": "viridis",
            "point_fill_ratio": 0.25,
            "depth_range": colour_range(first, self._origin.floor_distance_mm),
        }
        if whole:
            kind = rr.EncodedDepthImage.from_fields(**look, draw_order=_WHOLE)
            stream.log(DEPTH, kind, static=True)
            return
        for k in range(N_BOXES):
            kind = rr.EncodedDepthImage.from_fields(**look, draw_order=_BEHIND)
            stream.log(f"{CUTOUTS}/{k + 1}/depth", kind, static=True)
        assert self._origin.background is not None
        blob, media_type = packed(self._origin.background)
        scene = rr.EncodedDepthImage(blob=blob, media_type=media_type, **look, draw_order=_BACKMOST)
        stream.log(BACKGROUND, scene, static=True)


@dataclass(frozen=True)
class _Picture:
    """What is kept of a frame's depth: its packed parts, and their boxes, none for a whole one."""

    index: int
    elapsed_ns: int
    parts: Sequence[Packed]
    boxes: Sequence[Sequence[int]]

    @property
    def n_bytes(self) -> int:
        """Of all parts."""
        return sum(len(blob) for blob, _ in self.parts)


def cutout_frame(k: int) -> str:
    """Rerun's name of the coordinate frame of the k-th cut-out in the picture.

    In space a cut-out is seen by a pinhole camera of its own; in a view of the picture its entity
    is put into this frame instead, for Rerun shows what one camera sees in no other's picture.

    Args:
        k: counted from 0.
    """
    return f"cutout {k + 1} in the picture"


def packed(depth: NDArray[np.uint16]) -> Packed:
    """Encode a depth picture without loss.

    RVL takes half of what raw pictures do and is quick. Where noise makes it large, beyond 0.54
    bytes per pixel, PNG is taken if it is smaller (Huffman coding alone: noise has no runs to look
    for).

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
            return png, "image/png"
    return rvl, _RVL


def _cut_out(depth: NDArray[np.uint16], box: Sequence[int]) -> Packed:
    """A box of a picture, encoded without loss; no bytes where there is no box.

    Always RVL: Rerun takes PNGs for a video, whose pictures may not change their size.
    """
    left, top, right, bottom = box
    if right <= left:
        return np.empty(0, np.uint8), _RVL
    return rvl_message(depth[top:bottom, left:right]), _RVL


def colour_range(depth: NDArray[np.uint16], floor_distance_mm: float) -> tuple[float, float]:
    """Range of depth over which the colours spread: the floor of the first frame, and 80 mm above.

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
