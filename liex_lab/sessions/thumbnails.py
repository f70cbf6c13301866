"""Thumbnails of depth images, cut around the animal, for the report.

They are an evenly spaced sample of a stream of unknown length: when too many frames are kept, every
second one is dropped and the spacing doubles.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera
from liex_lab.recordings.depth_kernels import to_millimetres
from liex_lab.sessions.document import THUMBNAILS
from liex_lab.tables.rows import Rows
from liex_lab.tracking.observations import Observations

_KEPT = 32  # most whole frames kept of a recording of unknown length
_SHOWN = 16
_HALF_SPINES = 1.15  # half the side of a thumbnail, in spine lengths


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

    def save_whole(self, folder: Path, rows: Rows, seen: Observations) -> dict[str, Any] | None:
        """Write the whole depth image that best shows another object of the animal's size.

        Call it after `save`.

        Args:
            folder: the session folder.
            rows: the track in the form of the tables.
            seen: the observations: the animal is one of their two components.

        Returns:
            Its entry as in `save`, and `beside_px`, [u, v] of the centre of the other object; None
            if no kept frame shows one.
        """
        best: tuple[int, int, NDArray[np.float64]] | None = None
        for row in self._usable(rows):
            uv = rows.track.uv_px[row]
            centre = np.nanmean(uv, axis=0)
            found = np.asarray(seen.centroid_px[row, ::2], float)  # of both components
            away = np.linalg.norm(found - centre, axis=1)
            reach = np.nanmax(np.linalg.norm(uv - centre, axis=1))
            n_px = seen.n_px[row, ::2]
            size = int(n_px.min())  # both components should be whole
            both = (np.isfinite(away) & (n_px > 0)).all() and away.max() >= reach
            if both and (best is None or size > best[1]):
                best = row, size, found[int(away.argmax())]
        if best is None:
            return None
        row, _, place = best
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
        half_px = int(np.ceil(max(_HALF_SPINES * spine_px, 1.3 * extent, 16.0)))
        left = int(np.round(centre[0])) - half_px
        top = int(np.round(centre[1])) - half_px
        v, u = (np.arange(first, first + 2 * half_px) for first in (top, left))
        inside = np.ix_((v >= 0) & (v < depth.shape[0]), (u >= 0) & (u < depth.shape[1]))
        square = np.zeros((2 * half_px, 2 * half_px), np.uint16)
        square[inside] = depth[np.ix_(v[inside[0].ravel()], u[inside[1].ravel()])]
        return left, top, square


def _written(
    folder: Path, kind: str, rows: Rows, row: int, left: int, top: int, depth: NDArray[np.uint16]
) -> dict[str, Any]:
    """Write a PNG of a frame; returns its entry."""
    import cv2

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
