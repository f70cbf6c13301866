"""Numba kernels of the generative score: residuals of a posed sphere model against a height map.

Together with the features of the learned metric, these numbers separate good from bad candidates
(ours). They measure readings that the posed body does not explain, and parts of the body that
contradict the readings: signed distances d = |x - c| - r of depth readings x from the nearest
sphere, and of the spheres' fronts from the readings under them. The body is that of
`body.shape.Spheres`.
"""

from typing import Any, NamedTuple

import numpy as np

from liex_lab.runtime.kernels import inner_kernel, kernel
from liex_lab.scene._blob_kernels import ANGLE
from liex_lab.scene._height_map_kernels import crop_camera, to_pixel, to_point

N_FIT = 8
# columns of the fit, see `explain`
BESIDE, OFF, OUT_OF, HIDDEN, APART, FAR, WITHIN, ALONG = range(N_FIT)
# thresholds are integers
SHARE_UNIT = 1000.0
MM_UNIT = 50.0
# in tenths of the balls' usual radius, as the next two: caps larger distances
_MOST_MM = 30.0
_STRIDE = 6  # step between inspected crop pixels


class SphereModel(NamedTuple):
    """The sphere model compared with the height map, see `body.shape.Spheres`; may be empty.

    Attributes:
        unit_mm: a tenth of the usual radius at scale 1, mm.
        n_own: number of leading spheres that are the body; the others cover possible extensions.
        joints: (B, 2) the two joints that carry each sphere.
        offsets: (B, 2, 3) points in these joints' frames, mm at scale 1.
        share: (B,) of the distance from the first point to the second.
        radius: (B,) mm at scale 1.
    """

    unit_mm: float
    n_own: int
    joints: Any
    offsets: Any
    share: Any
    radius: Any


@kernel()
def place_balls(rotations, positions, scale, body, out):
    """Centres of the spheres of one pose.

    Args:
        rotations: (J, 3, 3) joint frames, view frame.
        positions: (J, 3) joints, mm, view frame.
        scale: of the bones.
        body: the sphere model.
        out: (B, 3) filled, mm, view frame.
    """
    for b in range(len(body.joints)):
        share = body.share[b]
        one, other = body.joints[b, 0], body.joints[b, 1]
        for i in range(3):
            first = positions[one, i]
            second = positions[other, i]
            for k in range(3):
                first += scale * rotations[one, i, k] * body.offsets[b, 0, k]
                second += scale * rotations[other, i, k] * body.offsets[b, 1, k]
            out[b, i] = first + share * (second - first)


@inner_kernel(fastmath={"nnan", "nsz"})
def nearest_ball(x, y, z, balls, radius, gaps):
    """Signed distance of a point from the surface of the nearest sphere.

    The distances, their minimum and its index are computed in three loops, each of which is
    vectorised; a single loop would wait for a square root with every sphere.

    Args:
        x: of the point, mm.
        y: of the point, mm.
        z: of the point, mm.
        balls: (B, 3) centres of the spheres, mm.
        radius: (B,) their radii, mm.
        gaps: (B,) scratch.

    Returns:
        The distance, mm, negative inside, and the number of the sphere.
    """
    for b in range(len(balls)):
        off2 = (x - balls[b, 0]) ** 2 + (y - balls[b, 1]) ** 2 + (z - balls[b, 2]) ** 2
        gaps[b] = np.sqrt(off2) - radius[b]
    best = gaps[0]
    for b in range(len(balls)):
        best = gaps[b] if gaps[b] < best else best
    which = 0
    last = len(balls) - 1
    while which < last and gaps[which] != best:
        which += 1
    return best, which


@inner_kernel()
def explain(heights, packed_camera, balls, radius, n_own, size, unit_mm, out):
    """Residuals of spheres against a height map.

    In order, of the body's own spheres: share outside the animal, mean distance of their fronts
    from the readings, mean distance in front of them, share hidden behind them; of the readings:
    mean distance from the nearest sphere, share far from any, mean depth inside spheres. Shares are
    in thousandths; distances are over size * unit_mm, times 50, and capped. Readings nearest to a
    sphere that is not the body's own are excluded.

    Args:
        heights: (S, S) int16 height map, 1/16 mm, 0 outside the animal.
        packed_camera: (17,) packed crop camera.
        balls: (B, 3) centres of the spheres, mm, view frame.
        radius: (B,) their radii, mm.
        n_own: number of leading spheres that are the body.
        size: the animal's size over home size.
        unit_mm: as in `Spheres`, mm.
        out: (N_FIT,) float32; all but the last number are filled.
    """
    camera = crop_camera(packed_camera)
    n = n_own
    per_mm = 1.0 / (size * unit_mm)
    beside = off = out_of = hidden = 0.0
    last = heights.shape[0] - 1
    for b in range(n):
        u, v = to_pixel(camera, balls[b, 0], balls[b, 1], balls[b, 2])
        column = int(u + 0.5)
        row = int(v + 0.5)
        here = heights[min(max(row, 0), last), min(max(column, 0), last)]
        if here == 0:
            beside += 1.0
            continue
        above = (here / 16.0 - balls[b, 2] - radius[b]) * per_mm
        off += min(abs(above), _MOST_MM)
        out_of += min(max(-above, 0.0), _MOST_MM)
        hidden += above > 12.0
    covered = max(n - beside, 1.0)
    out[BESIDE] = SHARE_UNIT * beside / n
    out[OFF] = MM_UNIT * off / covered
    out[OUT_OF] = MM_UNIT * out_of / covered
    out[HIDDEN] = SHARE_UNIT * hidden / n
    n_read = 0
    far = apart = within = 0.0
    gaps = np.empty(len(balls))
    for r in range(_STRIDE // 2, last + 1, _STRIDE):
        for c in range(_STRIDE // 2, last + 1, _STRIDE):
            if heights[r, c] == 0:
                continue
            # the point of this pixel in the view frame
            pz = heights[r, c] / 16.0
            px, py = to_point(camera, r, c, pz)
            nearest, which = nearest_ball(px, py, pz, balls, radius, gaps)
            if which >= n_own:
                continue
            nearest *= per_mm
            n_read += 1
            far += nearest > 8.0
            apart += min(max(nearest, 0.0), _MOST_MM)
            within += min(max(-nearest, 0.0), _MOST_MM)
    many = max(n_read, 1)
    out[APART] = MM_UNIT * apart / many
    out[FAR] = SHARE_UNIT * far / many
    out[WITHIN] = MM_UNIT * within / many


@inner_kernel()
def explain_pose(heights, packed_camera, axis, rotations, positions, scale, size, body, out):
    """Residuals of one pose against a height map, see `explain`.

    The last number is the cosine of the angle between the base's x axis and the animal's long axis
    in the image plane, in thousandths.

    Args:
        heights: (S, S) int16 height map, 1/16 mm, 0 where there is no animal.
        packed_camera: (17,) packed crop camera.
        axis: angle of the animal's long axis, rad.
        rotations: (J, 3, 3) joint frames, view frame.
        positions: (J, 3) joints, mm, view frame.
        scale: of the bones.
        size: the animal's size over home size.
        body: the sphere model.
        out: (N_FIT,) float32, filled.
    """
    balls = np.empty((len(body.joints), 3))
    place_balls(rotations, positions, scale, body, balls)
    explain(heights, packed_camera, balls, body.radius * scale, body.n_own, size, body.unit_mm, out)
    out[ALONG] = SHARE_UNIT * (
        np.cos(axis) * rotations[0, 0, 0] + np.sin(axis) * rotations[0, 1, 0]
    )


@kernel(nogil=True)
def explain_all(
    heights, crop_cameras, moments, image, rotations, positions, scale, size, body, out, start, stop
):
    """`explain_pose` for a batch of poses.

    Args:
        heights: (m, S, S) int16 height maps, 1/16 mm, 0 where there is no animal.
        crop_cameras: (m, 17) packed crop cameras of the height maps.
        moments: (m, 9) moments of the height maps.
        image: (n,) index of each pose's height map.
        rotations: (n, J, 3, 3) joint frames, view frame.
        positions: (n, J, 3) joints, mm, view frame.
        scale: (n,) of the bones.
        size: (n,) the animals' size over home size.
        body: the sphere model.
        out: (n, N_FIT) float32, filled.
        start: first item to process, see `in_parallel`.
        stop: the item after the last.
    """
    for s in range(start, stop):
        i = image[s]
        explain_pose(
            heights[i],
            crop_cameras[i],
            moments[i, ANGLE],
            rotations[s],
            positions[s],
            scale[s],
            size[s],
            body,
            out[s],
        )
