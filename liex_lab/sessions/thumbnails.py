"""Thumbnails of depth pictures, cut around the animal, so that the report can show what was fitted.

They are an evenly spaced sample of a stream of unknown length: when too many frames are held, every
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
from liex_lab.tables.rows import Rows
from liex_lab.tracking.observations import Observations

FOLDER = "thumbnails"
_KEPT = 32  # at most this many whole frames are held while a recording of unknown length goes by
_SHOWN = 16
_HALF_SPINES = 1.15  # half the side of the picture, in spine lengths


class Keepsakes:
    """Evenly spaced frames of a stream, at most 32 at a time."""

    def __init__(self) -> None:
        self._every = 1
        self._seen = 0
        self._kept: dict[int, NDArray[np.uint16]] = {}  # row -> depth

    def add(self, depth: NDArray[np.float32]) -> None:
        """Take the next frame.

        Args:
            depth: (H, W) float32 mm, 0 where unread.
        """
        if self._seen % self._every == 0:
            self._kept[self._seen] = to_millimetres(depth)
            self._thin_out()
        self._seen += 1

    def _thin_out(self) -> None:
        if len(self._kept) > _KEPT:
            self._every *= 2
            self._kept = {row: image for row, image in self._kept.items() if row % self._every == 0}

    def again(self, n_frames: int, read: Callable[[int], NDArray[np.float32]]) -> None:
        """Put the sample into the state as if the first frames had been added.

        Args:
            n_frames: how many frames.
            read: depth (H, W) float32 mm of one of them by its row.
        """
        for row in range(n_frames):
            if row % self._every == 0:
                self._kept[row] = np.empty(0, np.uint16)
                self._thin_out()
        self._kept = {row: to_millimetres(read(row)) for row in self._kept}
        self._seen = n_frames

    def save(self, folder: Path, rows: Rows, camera: Camera) -> list[dict[str, Any]]:
        """Write up to sixteen 16-bit PNG pictures, mm, 0 where unread; returns where each was cut.

        Args:
            folder: the session folder, which gets the folder `thumbnails`.
            rows: the track as the tables see it; only frames with a measured pose are taken.
            camera: the depth camera, for the size of the animal in px.

        Returns:
            For each picture file, frame_index, left_px, top_px, width_px and height_px.
        """
        import cv2

        observed = rows.track.observed
        usable = [row for row in sorted(self._kept) if row < len(observed) and observed[row]]
        if not usable:
            return []
        (folder / FOLDER).mkdir()
        chosen = sorted(
            {usable[k] for k in np.linspace(0, len(usable) - 1, _SHOWN).round().astype(int)}
        )
        entries = []
        for row in chosen:
            left, top, picture = self._cut(row, rows, camera)
            name = f"{FOLDER}/frame_{int(rows.frame_index[row]):07d}.png"
            cv2.imwrite(str(folder / name), picture)
            entries.append(
                {
                    "file": name,
                    "frame_index": int(rows.frame_index[row]),
                    "left_px": left,
                    "top_px": top,
                    "width_px": picture.shape[1],
                    "height_px": picture.shape[0],
                }
            )
        return entries

    def save_whole(self, folder: Path, rows: Rows, seen: Observations) -> dict[str, Any] | None:
        """Write the whole picture in which another thing of the animal's size is seen best.

        Call it after `save`.

        Args:
            folder: the session folder.
            rows: the track as the tables see it.
            seen: what the single frames said: the animal is one of their two components.

        Returns:
            Its entry as `save` gives it, and `beside_px`, [u, v] of the middle of the other thing;
            None where no kept picture shows one.
        """
        import cv2

        best: tuple[int, int, NDArray[np.float64]] | None = None
        for row in sorted(self._kept):
            if row >= rows.track.n_frames or not rows.track.observed[row]:
                continue
            uv = rows.track.uv_px[row]
            centre = np.nanmean(uv, axis=0)
            found = np.asarray(seen.centroid_px[row, ::2], float)  # of both components
            away = np.linalg.norm(found - centre, axis=1)
            reach = np.nanmax(np.linalg.norm(uv - centre, axis=1))
            n_px = seen.n_px[row, ::2]
            if not (np.isfinite(away) & (n_px > 0)).all() or away.max() < reach:
                continue
            size = int(n_px.min())  # that both are seen whole
            if best is None or size > best[1]:
                best = row, size, found[int(away.argmax())]
        if best is None:
            return None
        row, _, place = best
        depth = self._kept[row]
        name = f"{FOLDER}/whole_{int(rows.frame_index[row]):07d}.png"
        cv2.imwrite(str(folder / name), depth)
        return {
            "file": name,
            "frame_index": int(rows.frame_index[row]),
            "left_px": 0,
            "top_px": 0,
            "width_px": depth.shape[1],
            "height_px": depth.shape[0],
            "beside_px": [round(float(at), 1) for at in place],
        }

    def _cut(self, row: int, rows: Rows, camera: Camera) -> tuple[int, int, NDArray[np.uint16]]:
        depth = self._kept[row]
        uv = rows.track.uv_px[row]
        centre = np.nanmean(uv, axis=0)
        extent = np.nanmax(np.linalg.norm(uv - centre, axis=1))
        near = depth[depth > 0]
        distance = float(np.median(near)) if len(near) else 1000.0
        half = max(
            _HALF_SPINES * float(rows.track.spine_mm[row]) * camera.fx / distance,
            1.3 * extent,
            16.0,
        )
        half_px = int(np.ceil(half))
        left = int(np.round(centre[0])) - half_px
        top = int(np.round(centre[1])) - half_px
        padded = np.zeros(
            (2 * half_px, 2 * half_px), np.uint16
        )  # beyond the picture's edge nothing was read
        height, width = depth.shape
        x0 = max(left, 0)
        x1 = min(left + 2 * half_px, width)
        y0 = max(top, 0)
        y1 = min(top + 2 * half_px, height)
        if x1 > x0 and y1 > y0:
            padded[y0 - top : y1 - top, x0 - left : x1 - left] = depth[y0:y1, x0:x1]
        return left, top, padded
