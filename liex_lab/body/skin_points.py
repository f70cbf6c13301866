"""Named points on the skin of a tubular body, derived from its pose: ear bases, hips, tail base.

A skeleton states them in its list `points`: a station along the spine (share of its length), an
angle around the mid-axis and the standard deviation of the place itself, which is how much the
anatomical landmark varies between animals. A point is a fixed barycentric combination of vertices
of the trunk's mesh, so it lies on the rendered surface in every pose. Its variances are

    diag(R S^2 R^T) + (sum_j w_j s_j)^2

with S the stated deviations in the frame R of the bone that carries the point, s_j the deviations
of the joints, and w_j the weights of linear interpolation along the spine.
"""

from collections.abc import Sequence

import numpy as np
from pydantic import Field, TypeAdapter

from liex_lab.arrays import Array, NDArray
from liex_lab.body._skinning_kernels import BODY_SEGMENTS
from liex_lab.body.pose import Pose
from liex_lab.body.shape import Surface
from liex_lab.body.skeleton import PRESETS, Skeleton
from liex_lab.errors import LiexError, one_line, refuse
from liex_lab.plan.sections import Positive, SettingsTable, first_twice


class SkinPoint(SettingsTable):
    """A point on the trunk of a tubular animal: an entry of a skeleton's list `points`."""

    name: str
    mabe: str = Field("", description="name in the MABe challenge; '' if it is the same")
    station: float = Field(description="along the body, share of the spine's length")
    angle_deg: float = Field(description="around the mid-axis: 0 left, 90 up, 180 right")
    sd_mm: list[Positive] = Field(
        min_length=3,
        max_length=3,
        description="standard deviation of the place, forward, left and up, at scale 1",
    )


def points_of(skeleton: Skeleton) -> list[SkinPoint]:
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
    first, *_, last = skeleton.surface["stations"]
    try:
        points = TypeAdapter(list[SkinPoint]).validate_python(stated)
        twice = first_twice(one.name for one in points)
        refuse(
            ValueError,
            (twice, f"{twice} is listed twice"),
            *(
                (
                    not first <= one.station <= last,
                    f"{one.name} needs a station from {first} to {last}, got {one.station}",
                )
                for one in points
            ),
        )
    except ValueError as error:
        raise LiexError(
            f"the points of the skeleton '{skeleton.name}' cannot be used: {one_line(error)}; "
            "correct the list"
        ) from None
    return points


def place_points(
    points: Sequence[SkinPoint], surface: Surface, pose: Pose, girth: Array, sd_joints: Array
) -> tuple[Array, Array]:
    """Skin points in many poses.

    Args:
        points: the M points.
        surface: the animal's, a tube.
        pose: (n) poses.
        girth: (n,) factor of all lengths across the body.
        sd_joints: (n, J, 3) mm, standard deviations of the joints along x, y and z.

    Returns:
        Positions (n, M, 3) mm in the poses' frame, and standard deviations (n, M, 3) mm.
    """
    skeleton = surface.skeleton
    corner, weight = on_mesh(points, surface)
    station = [one.station for one in points]
    vertices = surface.vertices(pose, girth=girth)
    joint_at = skeleton.reach / skeleton.length
    carrier = np.clip(
        np.searchsorted(joint_at, station, side="right") - 1, 0, skeleton.n_joints - 2
    )
    along = np.stack([np.interp(station, joint_at, unit) for unit in np.eye(len(joint_at))])
    own = np.einsum("jm,njd->nmd", along, sd_joints)
    axes = pose.frames(skeleton).rotation[:, carrier]
    stated = pose.scale[:, None, None] * np.array([one.sd_mm for one in points])
    spread = np.sqrt(own**2 + np.einsum("nmdk,nmk->nmd", axes**2, stated**2))
    return np.einsum("mc,nmcd->nmd", weight, vertices[:, corner]), spread


def on_mesh(points: Sequence[SkinPoint], surface: Surface) -> tuple[NDArray[np.int64], Array]:
    """Vertices (M, 4) of the trunk around each point, and their barycentric weights (M, 4).

    Three of the four weights are those of a triangle of the mesh, the other one is 0.

    Args:
        points: the M points.
        surface: the animal's, a tube.
    """
    stations = surface.stations
    station, angle_deg = np.array([(one.station, one.angle_deg) for one in points]).T
    last = len(stations) - 2
    ring = np.clip(np.searchsorted(stations, station, side="right") - 1, 0, last)
    s = (station - stations[ring]) / (stations[ring + 1] - stations[ring])
    segment, t = np.divmod(angle_deg / 360.0 * BODY_SEGMENTS, 1.0)
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
