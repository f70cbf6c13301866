"""Head-tail classifier: a multilayer perceptron on the height map resampled along a candidate
(ours).

The learned metric compares two points at a time, and on unfamiliar bodies it confuses head and
tail; the whole outline, the ears and the slope of the back together separate them if the metric is
unsure. With the log odds l of the network for the best candidate of either direction, the direction
changes if

    score_opposite - score_best + w (l_best - l_opposite) < 0,

with w = 4 mm at the reference length.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.estimation import _feature_kernels as kernels
from liex_lab.estimation.cascade import ImageSet
from liex_lab.mlp import Network, descend
from liex_lab.runtime.shapes import check_shapes

Array = NDArray[np.float64]

# at the reference length: extent of the image along and across the animal, and its step
_ALONG_MM = 50.0
_ACROSS_MM = 25.0
_STEP_MM = 2.5
_HEIGHT_MM = 10.0  # unit of the network's input
UNSURE_MM = (
    15.0  # smaller differences between both directions' scores are unsure, at the reference length
)
_MM_PER_LOGIT = 4.0  # weight of the network's output relative to scores, at the reference length
_MOST_LOGIT = 6.0
_DECIMALS = 6
_HIDDEN = (128, 32)
_EPOCHS = 15
_BATCH = 256
_RATE = 1e-3
_WEIGHT_DECAY = 1e-2


@dataclass(frozen=True)
class HeadTailClassifier:
    """The head-tail classifier.

    Attributes:
        skeleton: the animal's skeleton.
        network: the trained network on images from `laid_along`.
    """

    skeleton: Skeleton
    network: Network

    @staticmethod
    def fit(images: NDArray[np.float32], right: NDArray[np.bool_], seed: int) -> Network:
        """Train the network, also on mirrored images; weights are rounded to the precision of the
        model file.

        Args:
            images: (m, A, B) float32 images from `laid_along`.
            right: (m,) bool, whether the poses point in the right direction.
            seed: of the network's training.
        """
        inputs = np.concatenate([_flat(images), _flat(images[:, :, ::-1])])
        labels = np.concatenate([right, right])
        layers = descend(
            inputs,
            labels,
            _HIDDEN,
            epochs=_EPOCHS,
            batch=min(_BATCH, len(inputs)),
            rate=_RATE,
            least_rate=1e-2 * _RATE,
            weight_decay=_WEIGHT_DECAY,
            seed=seed,
        )
        n = inputs.shape[1]
        # rounded to the precision of the model file
        return Network(
            np.zeros(n, np.float32),
            np.ones(n, np.float32),
            tuple((_rounded(weights), _rounded(bias)) for weights, bias in layers),
        )

    def logits(self, images: ImageSet, joints: Array, size: float) -> Array:
        """Log odds that poses point in the right direction.

        They are the mean over the image and its mirror image, computed in double precision and then
        rounded: the last bits of a product depend on the batch size, and a frame's pose must not.

        Args:
            images: n height maps with their crop cameras.
            joints: (n, J, 3) joints of the poses, mm, view frame.
            size: the animal's size over home size.

        Returns:
            (n,) log odds, between -6 and 6.
        """
        resampled = laid_along(self.skeleton, images, joints, np.full(len(joints), size))
        views = np.concatenate([resampled, resampled[:, :, ::-1]])
        both = self.network.logits(_flat(views).astype(np.float64)).reshape(2, -1)
        return np.clip(both, -_MOST_LOGIT, _MOST_LOGIT).mean(axis=0).round(_DECIMALS)

    def judged(self, images: ImageSet, positions: Array, scores: Array, size: float) -> Array:
        """Adjust the candidates' scores by the network if the metric is unsure of the direction.

        The metric is unsure if both directions have a candidate and their best scores are within 15
        mm at the reference length. If the network outweighs the difference, the scores of the
        leading direction are raised by the excess.

        Args:
            images: n height maps with their crop cameras.
            positions: (n, K, J, 3) joints of the candidates, mm, view frame.
            scores: (n, K) predicted errors, mm at home size.
            size: the animal's size over home size.

        Returns:
            (n, K) scores, mm at home size.
        """
        unit = self.skeleton.relative_size
        best, opposite, ahead, away = both_directions(positions, scores, self.skeleton.tip)
        doubted = np.flatnonzero(ahead < UNSURE_MM * unit)
        if not len(doubted):
            return scores
        seen = images[np.tile(doubted, 2)]
        poses = [positions[doubted, k[doubted]] for k in (best, opposite)]
        first, second = np.split(self.logits(seen, np.concatenate(poses), size), 2)
        total = ahead[doubted] + _MM_PER_LOGIT * unit * (first - second)
        wrong = doubted[total < 0]
        behind = (ahead[doubted] - total)[total < 0]
        judged = scores.copy()
        judged[wrong] += np.where(away[wrong], 0.0, behind[:, None])
        return judged


def both_directions(
    positions: Array, scores: Array, tip: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Best candidate of each frame, and the best one in the opposite direction.

    Args:
        positions: (n, K, J, 3) joints of the candidates, mm.
        scores: (n, K) predicted errors; infinite for missing candidates.
        tip: the joint that defines the direction from the base.

    Returns:
        The index (n,) of the best candidate; the index (n,) of the best one in the opposite
        direction; the difference (n,) of its score, infinite or NaN if there is none; and (n, K)
        bool, the candidates in the opposite direction.
    """
    rows = np.arange(len(scores))
    best = scores.argmin(axis=1)
    direction = positions[:, :, tip] - positions[:, :, 0]
    away = np.einsum("nkd,nd->nk", direction, direction[rows, best]) < 0
    other = np.where(away, scores, np.inf)
    opposite = other.argmin(axis=1)
    with np.errstate(invalid="ignore"):
        return best, opposite, other[rows, opposite] - scores[rows, best], away


def laid_along(
    skeleton: Skeleton, images: ImageSet, joints: Array, size: Array
) -> NDArray[np.float32]:
    """Resample height maps along poses: the direction from base to tip is the first axis.

    Args:
        skeleton: the animal's skeleton.
        images: n height maps with their crop cameras.
        joints: (n, J, 3) joints of the poses, mm, view frame.
        size: (n,) the animals' size over home size.

    Returns:
        (n, A, B) float32 heights in units of 10 mm at home size, for the reference length; 0
        outside the animal.
    """
    n = len(images.heights)
    check_shapes("poses", ("joints", joints, (n, skeleton.n_joints, 3)), ("size", size, (n,)))
    unit = skeleton.relative_size
    along = np.arange(-_ALONG_MM, _ALONG_MM + 1e-6, _STEP_MM) * unit
    across = np.arange(-_ACROSS_MM, _ACROSS_MM + 1e-6, _STEP_MM) * unit
    out = np.empty((len(joints), len(along), len(across)))
    kernels.lay_along(
        images.heights,
        images.crop_cameras,
        joints[:, 0],
        joints[:, skeleton.tip],
        joints.mean(axis=1),
        size,
        along,
        across,
        out,
    )
    return (out / (_HEIGHT_MM * unit * size[:, None, None])).astype(np.float32)


def _flat(images: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth images (n, A, B) as rows (n, A B)."""
    return np.ascontiguousarray(images).reshape(len(images), -1)


def _rounded(values: Array) -> NDArray[np.float32]:
    """Values rounded to float16, as float32."""
    return values.astype(np.float16).astype(np.float32)
