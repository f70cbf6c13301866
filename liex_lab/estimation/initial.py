"""Initial poses from the moments of the foreground: PCA initialisation, or the paper's.

Lie-X section 4, preprocessing and initial poses. The paper places the home pose at the centroid and
the mean depth of the foreground, rotates it in the image plane by an angle uniform in (-pi, pi),
and scales all bones by a factor uniform in [0.9, 1.1]; this is repeated Kt times. The default
method starts along the principal axis of the foreground in both directions, with small jitter (PCA
initialisation), which needs fewer initial poses.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from liex_lab.body.skeleton import REFERENCE_MM, Skeleton
from liex_lab.estimation import _feature_kernels as kernels
from liex_lab.estimation.cascade import ImageSet, TrainingSet
from liex_lab.estimation.method import Method
from liex_lab.forests._kernels import VIEW
from liex_lab.forests.forest import Forest, Samples, predict_each
from liex_lab.forests.grow import grow_forest
from liex_lab.geometry import so3
from liex_lab.runtime.processes import in_parallel
from liex_lab.scene.height_maps import moment_columns

Array = NDArray[np.float64]

_JITTER = (
    0.12,
    0.7,
)  # rad: spread of the headings of a long thin animal, and the increase for a round one


def draw_starts(rng: np.random.Generator, n_images: int, n_candidates: int) -> Array:
    """Draw the standard numbers of initial poses.

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
    moments: Array, starts: Array, size: Array, skeleton: Skeleton, method: Method
) -> tuple[Array, Array, Array]:
    """Base poses of K candidates for each of n animals.

    Along the long axis, every other start points in the opposite direction, and the spread of the
    headings increases with the roundness of the animal; in camera view, an animal rises or sinks
    with the slope of its back. The paper's start has any heading in (-pi, pi), the base at the
    centroid and at the animal's mean height, and bones scaled by a factor uniform in [0.9, 1.1].

    Args:
        moments: (n, 9) moments of the height map, see `HeightMaps`.
        starts: (n or 1, K, 4) numbers drawn by `draw_starts`.
        size: (n, K) the animal's size over home size.
        skeleton: the animal's; its base joint is the front, like the fish's head, or the rear.
        method: whether to start along the long axis, the view of the height map, and the rotation
            of the home pose relative to the view from above, as for a hand that shows its palm.

    Returns:
        Base rotation (n, K, 3, 3), base position (n, K, 3) mm and scale (n, K), view frame.
    """
    n, k = size.shape
    starts = np.broadcast_to(starts, (n, k, 4))
    blob = moment_columns(moments)
    centre = np.stack([blob.x, blob.y], axis=-1)[:, None]
    position = np.empty((n, k, 3))
    mean_height = (blob.volume_mm3 / np.maximum(blob.area_mm2, 1.0))[:, None]
    home_length = skeleton.length
    opposite = np.arange(k) % 2
    if method.axis_start:
        jitter = 2.0 * round(home_length / REFERENCE_MM, 6)
        spread = _JITTER[0] + _JITTER[1] * (blob.sd_across / np.maximum(blob.sd_along, 1e-6)) ** 2
        heading = blob.angle[:, None] + np.pi * opposite + spread[:, None] * starts[..., 0]
        scale = size.copy()
        base_at_front = skeleton.offsets[skeleton.next_joint[0], 0] < 0
        # the base is this far from the centroid, towards its own end
        behind = 0.42 * home_length * scale * (-1.0 if base_at_front else 1.0)
        direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        position[..., :2] = (
            centre - behind[..., None] * direction + jitter * scale[..., None] * starts[..., 1:3]
        )
        high = 0.2 * home_length * scale  # above the floor
        low = mean_height - 0.05 * home_length * scale  # in camera view, below the mean height
        position[..., 2] = low if method.camera_view else high
    else:
        heading = np.pi * starts[..., 3]
        # the quantile of a standard normal number is uniform
        scale = size * (1.0 + 0.1 * (2.0 * ndtr(starts[..., 1]) - 1.0))
        position[..., :2] = centre
        position[..., 2] = mean_height
    rotation = _turned(heading, 0, 1)
    if method.axis_start and method.camera_view:
        slope = np.arctan(blob.slope[:, None]) * (1.0 - 2.0 * opposite)
        rise = slope + 0.03 * starts[..., 3]
        rotation = rotation @ _turned(rise, 0, 2)
        # the base is ahead of or behind the middle of the animal
        position[..., 2] -= behind * np.sin(rise)
    if any(method.home_turn):
        rotation = rotation @ so3.exp(np.array(method.home_turn))
    return rotation, position, scale


def _turned(angle: Array, a: int, b: int) -> Array:
    """Rotations (..., 3, 3) from axis a towards axis b by an angle (...), rad."""
    rotation = np.zeros((*angle.shape, 3, 3)) + np.eye(3)
    rotation[..., a, a] = rotation[..., b, b] = np.cos(angle)
    rotation[..., b, a] = np.sin(angle)
    rotation[..., a, b] = -rotation[..., b, a]
    return rotation


# Initial poses proposed by a regression forest, for an animal of any orientation (ours).


N_DIRECTIONS = 2  # both directions along the animal's long axis


def views_along_axis(
    images: ImageSet, size: Array, reach_mm: float
) -> tuple[Samples, Array, Array]:
    """Features of each animal from its centre, with x along its long axis in both directions.

    Args:
        images: m images.
        size: (m,) the animals' size over home size.
        reach_mm: range of offsets from the centre, mm at home size.

    Returns:
        2 m samples, an image's two in a row, and their frames: rotations (2 m, 3, 3) and centres (2
        m, 3) mm, view frame.
    """
    m = len(images.heights)
    image = np.repeat(np.arange(m, dtype=np.int32), N_DIRECTIONS)
    opposite = np.arange(N_DIRECTIONS * m) % N_DIRECTIONS
    blob = moment_columns(images.moments[image])
    turn = np.zeros((N_DIRECTIONS * m, 3))
    turn[:, 2] = blob.angle + np.pi * opposite
    rotation = so3.exp(turn)
    position = np.column_stack([blob.x, blob.y, blob.volume_mm3 / np.maximum(blob.area_mm2, 1.0)])
    each = size[image]
    views = np.empty((N_DIRECTIONS * m, 1, VIEW), np.float32)
    scalars = np.empty((N_DIRECTIONS * m, kernels.N_SCALARS), np.float32)
    in_parallel(
        kernels.all_features,
        len(image),
        np.zeros(1, np.int64),
        images.crop_cameras,
        images.moments,
        image,
        each,
        np.array([reach_mm]),
        rotation[:, None],
        position[:, None],
        each,
        kernels.FeatureRows(views, scalars),
    )
    # some segmenters determine the direction of the long axis
    rows = np.column_stack([scalars, (1000.0 - 2000.0 * opposite).astype(np.float32)])
    samples = Samples(images.heights, image, (1.0 / each).astype(np.float32), views, rows)
    return samples, rotation, position


def train_proposals(
    data: TrainingSet, method: Method, rng: np.random.Generator
) -> tuple[Forest, NDArray[np.bool_]]:
    """Train the forest that proposes base poses, on the images that show the animal.

    Args:
        data: m training images with truth; an error is added to the animals' size.
        method: states the plan, the reach of the features and the lever arm of rotations.
        rng: source of bags, seeds and size errors.

    Returns:
        The forest, with leaves of float16 precision, and (T, m) bool, the images each tree was
        grown on.
    """
    assert method.proposals is not None
    truth = data.truth
    # as a session's estimated size errs
    guess = data.size * np.exp(0.08 * rng.standard_normal(len(data.size)))
    samples, frame, centre = views_along_axis(data.images, guess, method.proposal_reach_mm)
    i = samples.image
    turned = np.swapaxes(frame, 1, 2) @ truth.rotations[i, 0]
    offset = np.einsum("nji,nj->ni", frame, truth.positions[i, 0] - centre) / guess[i][:, None]
    labels = np.concatenate([method.base_lever_mm * turned.reshape(-1, 9), offset], axis=1)
    forest, in_bag = grow_forest(
        samples, labels.astype(np.float32), data.animal[i], method.proposals, rng
    )
    return forest.quantised(), in_bag


def propose(forest: Forest, images: ImageSet, size: Array, method: Method) -> tuple[Array, Array]:
    """Base poses that each tree votes for, from both directions of the long axis.

    Args:
        forest: the forest of T trees.
        images: m images.
        size: (m,) the animals' size over home size.
        method: the method that the forest was trained for.

    Returns:
        Rotations (m, 2 T, 3, 3) and positions (m, 2 T, 3) mm, view frame; candidate 2 t + w is tree
        t's, with the axis in direction w.
    """
    samples, frame, centre = views_along_axis(images, size, method.proposal_reach_mm)
    votes = predict_each(forest, samples).astype(float)
    rotation = frame[:, None] @ so3.nearest_rotation(votes[..., :9].reshape(*votes.shape[:2], 3, 3))
    offset = np.einsum("nij,ntj->nti", frame, votes[..., 9:]) * size[samples.image][:, None, None]
    position = centre[:, None] + offset

    m = len(size)
    # from (2 m, T, ...) to (m, 2 T, ...), the tree varying more slowly
    by_direction = (v.reshape(m, N_DIRECTIONS, -1, *v.shape[2:]) for v in (rotation, position))
    rotation, position = (np.swapaxes(v, 1, 2).reshape(m, -1, *v.shape[3:]) for v in by_direction)
    return rotation, position
