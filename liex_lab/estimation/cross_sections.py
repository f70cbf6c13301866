"""Mean cross-sections of an animal over many frames: how wide it is, and how its back falls away.

One frame shows noise and a posture; the mean over a session's frames, taken across the mid-axis of
the estimated poses, shows the animal. At stations s along the chain and distances t to both sides,

    c(s, t) = share of the frames that show the animal there,
    h(s, t) = mean height of the reading there over the mid-axis,

so that sum_t c dt is the half width and h(s, 0) - h(s, t) how far the back falls towards its edge:
on an ellipse with half axes a and b by b (1 - sqrt(1 - t^2 / a^2)), which tells the half height b
although nobody sees the animal from below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.pose import Pose
from liex_lab.body.shape import BodyShape
from liex_lab.body.skeleton import Skeleton
from liex_lab.body.variation import joint_reaches
from liex_lab.estimation import _cross_section_kernels as kernels
from liex_lab.runtime.shapes import check_shapes

Array = NDArray[np.float64]

N_STATIONS = 22
N_LATERAL = 24
_FROM, _TO = -0.10, 1.10  # along the chain: a body goes on past both its ends
_REACH = 1.75  # of the default body's half width: the broadest animal is narrower
_HARDLY = 0.15  # of the frames show a cell: what is read there are other things and torn edges
_PLACES = (0.05, 0.45, 0.65, 0.85)  # over the half width, where the back's fall is read
_BACKS = 8  # groups of stations that tell how high the back is
_FALLS = 6  # and those that tell how it falls
_MARGIN = 2  # stations at either end that lie past the body
_LEAST_WIDTH = 0.05  # of the default body's: thinner, a station shows nothing


@dataclass(frozen=True)
class CrossSections:
    """Mean cross-sections over the frames of one animal, lengths over the animal's own.

    Attributes:
        seen: (S, T) share of the frames in which the animal is there, both sides together.
        height: (S, T) mean height over the mid-axis, where it is there.
        step: distance from one lateral place to the next.
    """

    seen: Array
    height: Array
    step: float

    @staticmethod
    def of(
        skeleton: Skeleton,
        pose: Pose,
        heights: NDArray[np.int16],
        crop_cameras: Array,
        size: float,
    ) -> CrossSections:
        """The mean cross-sections around estimated poses.

        Args:
            skeleton: of the animal, one chain with a tube as its surface.
            pose: (n) poses, view frame, at least one.
            heights: (n, H, W) int16 height maps, 1/16 mm.
            crop_cameras: (n, 17) packed crop cameras of the height maps.
            size: the animal's size over home size.
        """
        joints = pose.joints(skeleton)
        n = len(joints)
        check_shapes("poses", ("heights", heights, (n, "H", "W")))
        points, sideways = _stations(skeleton, joints)
        reach = _REACH * float(BodyShape.default(skeleton).half_width.max()) * size
        lateral = (np.arange(N_LATERAL) + 0.5) / N_LATERAL * reach
        seen = np.empty((n, N_STATIONS, N_LATERAL))
        height = np.empty_like(seen)
        kernels.read_across(heights, crop_cameras, points, sideways, lateral, seen, height)
        length = skeleton.length * size
        shown = seen.sum(axis=0)
        mean = (seen * height).sum(axis=0) / np.maximum(shown, 0.5) / length
        return CrossSections(shown / n, mean, reach / N_LATERAL / length)

    @property
    def half_width(self) -> Array:
        """(S,) mean half width at the stations."""
        return np.asarray(self.seen.sum(axis=1) * self.step)

    def clues(self, skeleton: Skeleton) -> Array:
        """What a regression is told of the animal's build.

        They are the half widths, how high the back is over the mid-axis and how it falls towards
        its edge in groups of stations, and how blurred the outline is.

        Args:
            skeleton: of the animal.

        Returns:
            (F,) numbers, lengths over the animal's own.
        """
        width = self.half_width
        least = _LEAST_WIDTH * BodyShape.default(skeleton).half_width.max() / skeleton.length
        lateral = (np.arange(N_LATERAL) + 0.5) * self.step
        across = self.height.copy()
        for t in range(1, N_LATERAL):  # where hardly anything is seen, the back goes on level
            across[:, t] = np.where(self.seen[:, t] < _HARDLY, across[:, t - 1], across[:, t])
        back = np.zeros((N_STATIONS, len(_PLACES)))
        for s in np.flatnonzero(width > least):
            back[s] = np.interp(np.array(_PLACES) * width[s], lateral, across[s])
        fall = back[:, :1] - back[:, 1:]
        torn = (self.seen > _HARDLY) & (self.seen < 1.0 - _HARDLY)
        return np.concatenate(
            [
                width,
                _grouped(back[:, :1], width, _BACKS),
                _grouped(fall, width, _FALLS),
                [torn.mean()],
            ]
        )


def _grouped(values: Array, weight: Array, n: int) -> Array:
    """Weighted means of values (S, K) over n groups of neighbouring stations, (n K,)."""
    groups = np.array_split(np.arange(_MARGIN, N_STATIONS - _MARGIN), n)
    return np.concatenate(
        [weight[g] @ values[g] / max(float(weight[g].sum()), 1e-9) for g in groups]
    )


def _stations(skeleton: Skeleton, joints: Array) -> tuple[Array, Array]:
    """Points (n, S, 3) on the mid-axis, and unit vectors (n, S, 2) across it in the picture."""
    reach = joint_reaches(skeleton)
    at = np.linspace(_FROM, _TO, N_STATIONS)
    bone = np.clip(np.searchsorted(reach, at, side="right") - 1, 0, len(reach) - 2)
    share = ((at - reach[bone]) / (reach[bone + 1] - reach[bone]))[:, None]
    along = joints[:, bone + 1] - joints[:, bone]
    points = joints[:, bone] + share * along
    sideways = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    sideways /= np.maximum(np.linalg.norm(sideways, axis=-1, keepdims=True), 1e-9)
    return np.ascontiguousarray(points), np.ascontiguousarray(sideways)
