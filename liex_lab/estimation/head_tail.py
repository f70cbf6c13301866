"""Head-tail classifier: a multilayer perceptron on the height map laid along a candidate (ours).

The learned metric sees two points at a time. On bodies unlike those that it has learned from, head
and tail are what it confuses; all of the outline, the ears and the slope of the back at once tell
them apart where it is unsure. With the log odds l of the network for the best candidate of either
direction, the direction changes where

    score_opposite - score_best + w (l_best - l_opposite) < 0,        w = 4 mm at the reference
    length.
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

# at the reference length: how far the image reaches along and across the animal, and its step
_ALONG_MM = 50.0
_ACROSS_MM = 25.0
_STEP_MM = 2.5
_HEIGHT_MM = 10.0  # what stands for one in the network
UNSURE_MM = 15.0  # scores of both ways nearer than this, at the reference length, are doubted
_MM_PER_LOGIT = 4.0  # what the network's word weighs against scores, at the reference length
_MOST_LOGIT = 6.0
_DECIMALS = 6
_HIDDEN = (128, 32)
_EPOCHS = 15
_BATCH = 256
_RATE = 1e-3
_WEIGHT_DECAY = 1e-2


@dataclass(frozen=True)
class HeadTailClassifier:
    """The head-tail classifier at work.

    Attributes:
        skeleton: the animal's skeleton.
        network: the trained network on images from `laid_along`.
    """

    skeleton: Skeleton
    network: Network

    @staticmethod
    def fit(pictures: NDArray[np.float32], right: NDArray[np.bool_], seed: int) -> Network:
        """Train the network.

        Depth images are also learned from in the mirror. Weights are rounded to what the model file
        holds.

        Args:
            images: (m, A, B) float32 images from `laid_along`.
            right: (m,) bool, whether the poses point in the right direction.
            seed: of the network's training.
        """
        inputs = np.concatenate([_flat(pictures), _flat(pictures[:, :, ::-1])])
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
        # rounded to what the model file holds
        return Network(
            np.zeros(n, np.float32),
            np.ones(n, np.float32),
            tuple((_rounded(weights), _rounded(bias)) for weights, bias in layers),
        )

    def logits(self, images: ImageSet, joints: Array, size: float) -> Array:
        """Log odds that poses point in the right direction.

        They are the mean over the image and its mirror image, computed in double precision and
        then rounded: the last bits of a product depend on how many frames are asked about at once,
        and a frame's pose must not.

        Args:
            images: n height maps with their crop cameras.
            joints: (n, J, 3) joints of the poses, mm, view frame.
            size: the animal's size over home size.

        Returns:
            (n,) log odds, at most 6 either way.
        """
        pictures = laid_along(self.skeleton, images, joints, np.full(len(joints), size))
        views = np.concatenate([pictures, pictures[:, :, ::-1]])
        both = self.network.logits(_flat(views).astype(np.float64)).reshape(2, -1)
        return np.clip(both, -_MOST_LOGIT, _MOST_LOGIT).mean(axis=0).round(_DECIMALS)

    def judged(self, images: ImageSet, positions: Array, scores: Array, size: float) -> Array:
        """Adjust the candidates' scores by the network where the metric is unsure of the direction.

        The metric is unsure where both directions have a candidate and their best scores are within
        15 mm at the reference length. Where the network outweighs the difference, the candidates of
        the direction that was ahead fall behind, by as much as it is outweighed.

        Args:
            images: n height maps with their crop cameras.
            positions: (n, K, J, 3) joints of the candidates, mm, view frame.
            scores: (n, K) predicted errors, mm at home size.
            size: the animal's size over home size.

        Returns:
            (n, K) scores, mm at home size.
        """
        unit = self.skeleton.relative_size
        best, opposite, ahead, away = both_ways(positions, scores, self.skeleton.tip)
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


def both_ways(
    positions: Array, scores: Array, tip: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Best candidate of each frame, and the best one that points the other way.

    Args:
        positions: (n, K, J, 3) joints of the candidates, mm.
        scores: (n, K) predicted errors; infinite where there is no such candidate.
        tip: the joint that the direction from the base is taken to.

    Returns:
        The index (n,) of the best candidate; the index (n,) of the best one that points the other
        way; by how much (n,) its score is worse, infinite or NaN where there is none; and (n, K)
        bool, which candidates point the other way.
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
        (n, A, B) float32 heights in units of 10 mm at home size, for the reference length; 0 beside
        the animal.
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


def _flat(pictures: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth images (n, A, B) as rows (n, A B)."""
    return np.ascontiguousarray(pictures).reshape(len(pictures), -1)


def _rounded(values: Array) -> NDArray[np.float32]:
    """Values rounded to float16, as float32."""
    return values.astype(np.float16).astype(np.float32)
