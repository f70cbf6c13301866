"""Named points on the skin of a tubular body, derived from its pose: ear bases, hips, tail base.

A skeleton states them in its list `points`: a station along the spine (share of its length), an
angle around the mid-axis and the standard deviation of the place itself, which is how much the
anatomical landmark varies between animals. A point is a fixed barycentric combination of vertices
of the trunk's mesh, so it lies on the rendered surface in every pose. Its variances are

    diag(R S^2 R^T) + (sum_j w_j s_j)^2

with S the stated deviations in the frame R of the bone that carries the point, s_j the deviations
of the joints, and w_j the weights of linear interpolation along the spine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body._skinning_kernels import BODY_SEGMENTS
from liex_lab.body.pose import Pose
from liex_lab.body.shape import Surface
from liex_lab.body.skeleton import PRESETS, Array, Skeleton
from liex_lab.errors import LiexError, refuse

_KEYS = {"name", "mabe", "station", "angle_deg", "sd_mm"}


@dataclass(frozen=True)
class SurfacePoints:
    """M points on the trunk of a tubular animal.

    Attributes:
        names: M names.
        mabe: M names of the MABe challenge.
        station: (M,) along the body, shares of the spine's length.
        turn: (M,) rad, the ellipse's parameter around the mid-axis: 0 left, pi / 2 up, pi right.
        sd_mm: (M, 3) standard deviations of the place, forward, left and up, mm at scale 1.
    """

    names: tuple[str, ...]
    mabe: tuple[str, ...]
    station: Array
    turn: Array
    sd_mm: Array

    @staticmethod
    def of(skeleton: Skeleton) -> SurfacePoints:
        """The points of a skeleton, or of the preset of its name if it states none.

        Models and sessions of earlier versions contain the preset's skeleton without its points.

        Raises:
            LiexError: there are no points, or they are incomplete or out of range.
        """
        stated = skeleton.table.get("points")
        if stated is None and (PRESETS / f"{skeleton.name}.toml").is_file():
            preset = Skeleton.load(skeleton.name)
            stated = preset.table.get("points") if preset.names == skeleton.names else None
        if not stated or "stations" not in skeleton.surface:
            raise LiexError(
                "points on the skin need a skeleton that lists them (`points`) and whose [surface] "
                f"has stations, as the bundled mouse; '{skeleton.name}' does not"
            )
        where = f"the points of the skeleton '{skeleton.name}'"
        try:
            unknown = {key for row in stated for key in row} - _KEYS
            names = tuple(str(row["name"]) for row in stated)
            mabe = tuple(str(row.get("mabe", row["name"])) for row in stated)
            place = np.array([[row["station"], row["angle_deg"]] for row in stated], float)
            sd = np.array([row["sd_mm"] for row in stated], float)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise LiexError(f"{where} are incomplete: {error}") from None
        first, *_, last = skeleton.surface["stations"]
        refuse(
            LiexError,
            (unknown, f"{where} have unknown keys {sorted(unknown)}; use {sorted(_KEYS)}"),
            (len(set(names)) != len(names), f"{where} need different names, got {list(names)}"),
            (
                not ((first <= place[:, 0]) & (place[:, 0] <= last)).all(),
                f"{where} need stations from {first} to {last}, got {place[:, 0].tolist()}",
            ),
            (not np.isfinite(place).all(), f"{where} need an angle_deg that is a finite number"),
            (
                sd.shape != (len(names), 3) or not (np.isfinite(sd) & (sd > 0)).all(),
                f"{where} need an sd_mm of three positive numbers: forward, left, up",
            ),
        )
        return SurfacePoints(names, mabe, place[:, 0], np.radians(place[:, 1]), sd)

    def placed(
        self, surface: Surface, pose: Pose, girth: Array, sd_joints: Array
    ) -> tuple[Array, Array]:
        """The points in many poses.

        Args:
            surface: the animal's, a tube.
            pose: (n) poses.
            girth: (n,) factor of all lengths across the body.
            sd_joints: (n, J, 3) mm, standard deviations of the joints along x, y and z.

        Returns:
            Positions (n, M, 3) mm in the poses' frame, and standard deviations (n, M, 3) mm.
        """
        skeleton = surface.skeleton
        corner, weight = self.on_mesh(surface)
        vertices = surface.vertices(pose, girth=girth)
        joint_at = skeleton.reach / skeleton.length
        carrier = np.clip(
            np.searchsorted(joint_at, self.station, side="right") - 1, 0, skeleton.n_joints - 2
        )
        along = np.stack(
            [np.interp(self.station, joint_at, unit) for unit in np.eye(len(joint_at))]
        )
        own = np.einsum("jm,njd->nmd", along, sd_joints)
        axes = pose.frames(skeleton).rotation[:, carrier]
        stated = pose.scale[:, None, None] * self.sd_mm
        spread = np.sqrt(own**2 + np.einsum("nmdk,nmk->nmd", axes**2, stated**2))
        return np.einsum("mc,nmcd->nmd", weight, vertices[:, corner]), spread

    def on_mesh(self, surface: Surface) -> tuple[NDArray[np.int64], Array]:
        """Vertices (M, 4) of the trunk around each point, and their barycentric weights (M, 4).

        Three of the four weights are those of a triangle of the mesh, the other one is 0.

        Args:
            surface: the animal's, a tube.
        """
        stations = surface.stations
        last = len(stations) - 2
        ring = np.clip(np.searchsorted(stations, self.station, side="right") - 1, 0, last)
        s = (self.station - stations[ring]) / (stations[ring + 1] - stations[ring])
        segment, t = np.divmod(self.turn / (2.0 * np.pi) * BODY_SEGMENTS, 1.0)
        # a quad of two rings and two segments, cut along the diagonal as in `tube_faces`
        r = ring[:, None] + [0, 0, 1, 1]
        k = segment.astype(np.int64)[:, None] + [0, 1, 0, 1]
        corner = 1 + (r - 1) * BODY_SEGMENTS + k % BODY_SEGMENTS
        weight = [
            1.0 - np.maximum(s, t),
            np.maximum(t - s, 0.0),
            np.maximum(s - t, 0.0),
            np.minimum(s, t),
        ]
        # the first and last rings are poles
        return np.clip(corner, 0, surface.n_trunk_vertices - 1), np.stack(weight, axis=-1)
