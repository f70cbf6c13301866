"""Ground that changes during a recording: a nest that is built, bedding that is moved.

A lasting rise is ground only if it stays while the animal is elsewhere, so that an animal asleep is
none. The ground is therefore read in sampled frames that show the whole animal, away from every
place that changes and on its way (`learning.learn_scene`). A reading is the median of five such
frames. Consecutive ones that agree within 0.7 of the foreground's margin (7 mm), but for half an
animal's area, are one stretch, whose ground is their median; between two stretches the ground is
the farther one of both, as it is not known when it changed. A frame is brought to the farthest
ground of all: a reading z of the ground g, no nearer than the foreground's margin,

    z >= g - margin    becomes    z + max(g) - g,

and every nearer reading, as the animal's, is unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from liex_lab.arrays import Mask, NDArray
from liex_lab.optics.camera import Camera
from liex_lab.scene.background import FloorLevel, learn_background, usual_depth
from liex_lab.scene.floor import Depths, parts


@dataclass(frozen=True)
class RaisedGround:
    """Ground that rose or sank slowly: a nest that was built, or bedding that was moved.

    Attributes:
        rise_mm: median rise of its largest part from the first to the last third, mm; negative if
            it sank.
        area_mm2: of all its parts, mm^2.
        part_mm2: of its largest part, mm^2.
    """

    rise_mm: float
    area_mm2: float
    part_mm2: float

    @staticmethod
    def find(
        sample: NDArray[np.float32], on_floor: Mask, camera: Camera, least: tuple[float, float]
    ) -> RaisedGround | None:
        """Find it in frames spread over a recording.

        The ground of a third is its farthest mode, so that an animal that often rests in one place
        is no ground.

        Args:
            sample: (n, H, W) float32 mm, the frames, 0 where unread.
            on_floor: (H, W) bool, the visible floor.
            camera: of those pixels.
            least: smallest height, mm, and smallest area of a part, mm^2.

        Returns:
            The ground; None if it does not change, or fewer than 24 frames are given.
        """
        thirds = np.array_split(sample, 3)
        if len(thirds[-1]) < 8:
            return None
        before, after = (learn_background(thirds[k])[0] for k in (0, 2))
        rise = np.where(on_floor & (before > 0) & (after > 0), before - after, np.float32(0))
        px_mm2 = before.astype(float) ** 2 / (camera.fx * camera.fy)
        found = [
            (float(px_mm2[part].sum()), float(np.median(rise[part])))
            for part in (*parts(rise > least[0]), *parts(rise < -least[0]))
        ]
        found = [one for one in found if one[0] > least[1]]
        return (
            RaisedGround(max(found)[1], sum(one[0] for one in found), max(found)[0])
            if found
            else None
        )

    @property
    def sentence(self) -> str:
        """The change in words."""
        return (
            f"{0.01 * self.area_mm2:.0f} cm² of the floor, such as a nest or bedding, "
            f"{'rose' if self.rise_mm > 0 else 'sank'} by {abs(self.rise_mm):.0f} mm during the "
            "recording, and what rises is measured as a part of the animal there: measure the "
            "recording in shorter parts, such as its files"
        )


@dataclass(frozen=True)
class ChangingGround:
    """The ground of each stretch of a recording, where it changes.

    Attributes:
        where: (H, W) bool, the P pixels that change, in the grid of the scene.
        margin_mm: (P,) float32, height of the foreground's limit above the ground.
        depth_mm: (S, P) float32, the ground of each stretch; every second one is known, the others
            lie before, between and after these.
        since_ns: (S,) int64, time of its first frame; the first is the recording's.
        unknown_share: share of the time in which the ground is not known.
        level: reference level of the floor; None if it does not drift.
    """

    where: Mask
    margin_mm: Depths
    depth_mm: Depths
    since_ns: NDArray[np.int64]
    unknown_share: float
    level: FloorLevel | None

    @staticmethod
    def places(sample: Depths, on_floor: Mask, min_height_mm: float) -> Mask:
        """Where the ground of any sixth of a recording differs from that of another.

        Args:
            sample: (n, H, W) float32 mm, frames spread over the recording, 0 where unread.
            on_floor: (H, W) bool, the visible floor.
            min_height_mm: the difference.

        Returns:
            (H, W) bool.
        """
        grounds = np.array([learn_background(some)[0] for some in np.array_split(sample, 6)])
        changes = on_floor & (grounds > 0).all(axis=0) & (np.ptp(grounds, axis=0) > min_height_mm)
        return (cv2.dilate(changes.astype(np.uint8), np.ones((5, 5))) > 0) & on_floor

    @staticmethod
    def follow(
        where: Mask,
        margin_mm: Depths,
        readings: Depths,
        shows: Mask,
        times_ns: NDArray[np.int64],
        least_px: float,
        level: FloorLevel | None = None,
    ) -> ChangingGround:
        """The stretches of a ground that was read at some times.

        Args:
            where: (H, W) bool, the P pixels that change.
            margin_mm: (P,) float32, height of the foreground's limit above the ground.
            readings: (n, P) float32 mm, 0 where unread, of frames spread over the recording.
            shows: (n,) bool, which of them show the ground without the animal; at least five.
            times_ns: (n,) their times.
            least_px: pixels by which two stretches differ.
            level: reference level of the floor, to which the readings were brought; None if it does
                not drift.
        """
        rows = np.flatnonzero(shows)
        grounds = usual_depth(
            readings[rows[np.clip(np.arange(len(rows)), 2, len(rows) - 3) + np.c_[-2:3]]]
        )
        grounds = np.where(grounds > 0, grounds, grounds.max(axis=0))
        first = [0]
        for k, ground in enumerate(grounds):
            if (np.abs(ground - grounds[first[-1]]) > 0.7 * margin_mm).sum() > least_px:
                first.append(k)
        own = [usual_depth(some) for some in np.split(grounds, first[1:])]
        # before and after, the ground is no nearer than what recurs there
        before, after = (
            learn_background(readings[some, None])[0][0]
            for some in (slice(rows[0] + 1), slice(rows[-1], None))
        )
        known = np.array([np.maximum(before, own[0]), *own, np.maximum(after, own[-1])])
        changes = (np.abs(np.diff(known, axis=0)) > margin_mm).sum(axis=1) > least_px
        last = [*(k - 1 for k in first[1:]), len(rows) - 1]
        since_ns = times_ns[[0, *rows[np.ravel([first, last], order="F")]]]
        lasts_ns = np.diff(since_ns, append=times_ns[-1])[::2]
        return ChangingGround(
            where,
            margin_mm,
            np.insert(np.maximum(known[1:], known[:-1]), range(1, len(own) + 1), own, axis=0),
            since_ns,
            float(lasts_ns[changes].sum() / (times_ns[-1] - times_ns[0])),
            level,
        )

    @property
    def changes_s(self) -> tuple[float, ...]:
        """When each ground but the first is first read, s since the first frame."""
        return tuple(float(at) for at in (self.since_ns[3::2] - self.since_ns[0]) * 1e-9)

    @property
    def sentence(self) -> str:
        """The changes in words."""
        return (
            "the floor, such as a nest or bedding, changed by up to "
            f"{np.percentile(np.ptp(self.depth_mm, axis=0), 90):.0f} mm, and the background "
            f"followed it in {len(self.changes_s) + 1} stretches, the later ones from "
            f"{', '.join(f'{at:.0f}' for at in self.changes_s)} s on"
            + (
                f"; in {self.unknown_share:.0%} of the time it is unknown, as the animal was never "
                "elsewhere, and what rises is measured as a part of the animal there"
                if self.unknown_share > 0.0
                else ""
            )
        )

    def levelled(self, depths: Depths, times_ns: NDArray[np.int64]) -> Depths:
        """The frames with the ground at its farthest depth; nearer readings are unchanged.

        Args:
            depths: (n, H, W) float32 mm, 0 where unread, in the grid of the scene.
            times_ns: (n,) of the frames.

        Returns:
            (n, H, W) float32 mm, a copy.
        """
        ground = self.depth_mm[np.searchsorted(self.since_ns[1:], times_ns, side="right")]
        off = np.zeros(len(depths)) if self.level is None else self.level.of(depths)
        readings = depths[:, self.where]
        lower = np.where(
            (readings > 0) & (readings >= ground + off[:, None] - self.margin_mm),
            self.depth_mm.max(axis=0) - ground,
            0,
        )
        out = depths.copy()
        out[:, self.where] += lower
        return out
