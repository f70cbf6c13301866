"""Whether the camera was pushed, or the scene rearranged, while it recorded.

A learned background is one for the whole recording. A camera that is bumped in the middle sees
every wall and rim elsewhere from then on, and places on the floor are no longer those of before;
poses look as sound as ever. So the usual depth of every pixel is compared between the parts of the
recording: an animal, also one that sleeps here and then there, changes that over its own area, a
moved camera over much more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.optics.camera import Camera
from liex_lab.runtime.shapes import check_shapes

Array = NDArray[np.float64]

_N_PARTS = 4
_LEAST_FRAMES = 8  # of a part
_N_PIXELS = 10_000
_ELSEWHERE_MM = 12.0  # more than a sensor's drift and noise leave in a median
_LEAST_SHARE = 0.06  # of what is read
_LEAST_ANIMALS = 4.0  # times the area of the animal, which leaves one place and fills another


@dataclass(frozen=True)
class SceneChange:
    """What still stood is elsewhere from some time on.

    Attributes:
        at_s: since when, s since the first frame.
        share: of the picture that is read, how much is elsewhere.
    """

    at_s: float
    share: float

    @staticmethod
    def find(
        sample: NDArray[np.float32], times_s: Array, camera: Camera, area_mm2: float
    ) -> SceneChange | None:
        """The change of a recording, from frames spread over it.

        Args:
            sample: (n, H, W) float32 mm, the frames, 0 where unread.
            times_s: (n,) of the frames, s since the first.
            camera: the camera of those pixels.
            area_mm2: the animal's usual area seen from above, mm^2.

        Returns:
            The change; None where the scene keeps still, or too few frames tell.
        """
        check_shapes("frames", ("sample", sample, ("n", "H", "W")), ("times_s", times_s, ("n",)))
        n_parts = min(_N_PARTS, len(sample) // _LEAST_FRAMES)
        if n_parts < 2:
            return None
        step = max(1, int(np.sqrt(sample[0].size / _N_PIXELS)))
        depths = sample[:, ::step, ::step].reshape(len(sample), -1)
        usual = [_usual(part) for part in np.array_split(depths, n_parts)]
        found = None
        for a, b in [*zip(range(n_parts), range(1, n_parts), strict=False), (0, n_parts - 1)]:
            read = (usual[a] > 0) & (usual[b] > 0)
            moved = read & (np.abs(usual[b] - usual[a]) > _ELSEWHERE_MM)
            share = float(moved.sum() / max(read.sum(), 1))
            pixels_mm2 = (step * usual[a][moved].astype(float)) ** 2 / (camera.fx * camera.fy)
            is_more = share > (found[0] if found else _LEAST_SHARE)
            if is_more and pixels_mm2.sum() > _LEAST_ANIMALS * area_mm2:
                found = share, usual[a][moved], usual[b][moved], moved
        if found is None:
            return None
        share, before, after, moved = found
        seen = depths[:, moved]
        is_after = (np.abs(seen - after) < np.abs(seen - before)).mean(axis=1) > 0.5
        since = int(np.argmax(is_after & np.append(is_after[1:], True)))
        return SceneChange(float(times_s[since]), share)

    @property
    def sentence(self) -> str:
        """What changed, in words."""
        return (
            f"the camera was pushed, or its scene rearranged, at {self.at_s:.1f} s "
            f"({self.share:.0%} of it is elsewhere from then on): cut the recording there"
        )


def _usual(depths: NDArray[np.float32]) -> NDArray[np.float32]:
    """The median (P,) of what was read in frames (n, P), mm; 0 where most of it was not."""
    n_read = (depths > 0).sum(axis=0)
    # unread pixels come first
    row = np.minimum(len(depths) - (n_read + 1) // 2, len(depths) - 1)
    median = np.take_along_axis(np.sort(depths, axis=0), row[None], axis=0)[0]
    return np.where(2 * n_read >= len(depths), median, np.float32(0))
