"""Initial poses from the moments of the foreground: PCA initialisation, or the paper's.

Lie-X section 4, preprocessing and initial poses. The paper places the home pose at the centroid and
the mean depth of the foreground, turns it in the image plane by an angle uniform in (-pi, pi), and
scales all bones by a factor uniform in [0.9, 1.1]; this is repeated Kt times. The default method
starts along the principal axis of the foreground in both directions, with small jitter (PCA
initialisation, METHOD lesson 8).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from liex_lab.body.skeleton import REFERENCE_MM
from liex_lab.foreground.height_maps import moment_columns
from liex_lab.geometry import so3

Array = NDArray[np.float64]

# of the body length: the base starts this far from the centroid, towards the end it belongs to
_BEHIND = 0.42
_HIGH = 0.2  # of the body length: the base starts this high above the floor
# of the body length: the base of an animal in the camera view starts this far below its mean height
_LOW = 0.05
_JITTER = (
    0.12,
    0.7,
)  # rad: spread of the headings of a long thin animal, and what a round one adds
_JITTER_RISE = 0.03  # rad, at most
_JITTER_MM = 2.0  # of the places, for an animal of the reference length
_SCALED_BY = 0.1  # the paper scales all bones of a start by up to this, either way


def draw_starts(rng: np.random.Generator, n_images: int, n_candidates: int) -> Array:
    """Draw the standard numbers that initial poses are made from.

    Args:
        rng: source of the numbers.
        n_images: number of images.
        n_candidates: number of initial poses per image.

    Returns:
        (n_images, n_candidates, 4): three standard normal numbers, for heading and position (the
        second also for the paper's scale), and one uniform in (-1, 1), for the paper's heading and
        the rise; see `start_poses`.
    """
    starts = rng.standard_normal((n_images, n_candidates, 4))
    starts[..., 3] = rng.uniform(-1.0, 1.0, (n_images, n_candidates))
    return starts


def start_poses(
    moments: Array,
    starts: Array,
    size: Array,
    home_length: float,
    base_at_front: bool,
    axis_start: bool,
    camera_view: bool = False,
    home_turn: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> tuple[Array, Array, Array]:
    """Base poses of K candidates for each of n animals.

    Along the long axis, every other start points the other way, and the headings are the more
    spread out the rounder the animal looks (METHOD lesson 8). The paper's start has any heading in
    (-pi, pi), the base at the centroid and at the animal's mean height, and bones scaled by a
    factor uniform in [0.9, 1.1].

    Args:
        moments: (n, 9) moments of the height map, see `HeightMaps`.
        starts: (n or 1, K, 4) numbers drawn by `draw_starts`.
        size: (n, K) the animal's size over home size.
        home_length: spine length at home, mm.
        base_at_front: the base joint is the animal's front; else its rear.
        axis_start: start along the long axis; else as the paper does.
        camera_view: heights are not those above a floor; such an animal, started along its axis,
            rises or sinks as its back does.
        home_turn: (3,) rotation vector, rad, by which the home pose lies otherwise than seen from
            above, as a palm that is shown.

    Returns:
        Base rotation (n, K, 3, 3), base position (n, K, 3) mm and scale (n, K), view frame.
    """
    n, k = size.shape
    starts = np.broadcast_to(starts, (n, k, 4))
    blob = moment_columns(moments)
    centre = np.stack([blob.x, blob.y], axis=-1)[:, None]
    position = np.empty((n, k, 3))
    mean_height = (blob.volume_mm3 / np.maximum(blob.area_mm2, 1.0))[:, None]
    if axis_start:
        jitter = _JITTER_MM * round(home_length / REFERENCE_MM, 6)
        roundness = blob.sd_across / np.maximum(blob.sd_along, 1e-6)
        spread = _JITTER[0] + _JITTER[1] * roundness**2
        heading = (
            blob.angle[:, None] + np.pi * (np.arange(k) % 2) + spread[:, None] * starts[..., 0]
        )
        scale = size.copy()
        behind = _BEHIND * home_length * scale * (-1.0 if base_at_front else 1.0)
        direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        position[..., :2] = (
            centre - behind[..., None] * direction + jitter * scale[..., None] * starts[..., 1:3]
        )
        high = _HIGH * home_length * scale
        position[..., 2] = mean_height - _LOW * home_length * scale if camera_view else high
    else:
        heading = np.pi * starts[..., 3]
        # the quantile of a standard normal number is uniform
        scale = size * (1.0 + _SCALED_BY * (2.0 * ndtr(starts[..., 1]) - 1.0))
        position[..., :2] = centre
        position[..., 2] = mean_height
    rotation = np.zeros((n, k, 3, 3))
    rotation[..., 0, 0] = np.cos(heading)
    rotation[..., 0, 1] = -np.sin(heading)
    rotation[..., 1, 0] = np.sin(heading)
    rotation[..., 1, 1] = np.cos(heading)
    rotation[..., 2, 2] = 1.0
    if axis_start and camera_view:
        rise = (
            np.arctan(blob.slope[:, None]) * (1.0 - 2.0 * (np.arange(k) % 2))
            + _JITTER_RISE * starts[..., 3]
        )
        rotation = rotation @ _lifted(rise)
        # the base lies ahead of or behind the middle of the animal
        position[..., 2] -= behind * np.sin(rise)
    if any(home_turn):
        rotation = rotation @ so3.exp(np.array(home_turn))
    return rotation, position, scale


def _lifted(rise: Array) -> Array:
    """Rotations (..., 3, 3) that lift a body's front by `rise` (...) rad."""
    rotation = np.zeros((*rise.shape, 3, 3))
    rotation[..., 0, 0] = np.cos(rise)
    rotation[..., 0, 2] = -np.sin(rise)
    rotation[..., 2, 0] = np.sin(rise)
    rotation[..., 2, 2] = np.cos(rise)
    rotation[..., 1, 1] = 1.0
    return rotation
