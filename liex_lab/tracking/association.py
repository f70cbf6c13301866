"""Data association by Viterbi: which hypothesis of each frame of a recording is the animal.

The most probable path of a hidden Markov model whose states are the hypotheses of each frame and
"missed": minimise sum_t score_t / score_mm (capped) + transition costs + missed-detection costs, by
dynamic programming with a beam of 24 (Viterbi 1967; kernels in `_association_kernels`). For an
animal of a build that the metric was not trained on, score_mm is larger, and a hypothesis that
moves tail first for long costs more (`backward_cost`). The forward-backward algorithm over two
states (Rabiner 1989) then distinguishes head and tail on that path, and gives the flip posterior.
Lie-X has no such step: its tracker is a particle filter (section 4.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.runtime.memory import Allocator, blocks
from liex_lab.runtime.shapes import check_shapes
from liex_lab.tracking import _association_kernels as kernels
from liex_lab.tracking.observations import Observations
from liex_lab.tracking.trust import together, told_ends, usual_pixels

Array = NDArray[np.float64]

_BEAM = 24  # chains kept in the beam
_JOINTS = 8  # joints used to measure an animal's displacement
_BLOCK = 16_384  # frames in memory at once
_BESIDE = 256  # and context frames, for velocities
# the effect of an animal's build on the metric is estimated from sampled frames in which the body
# covers the outline, is hardly outside it, and is near the readings (over the length)
_SAMPLE = 2048
_FEWEST = 12
_AGREES_COVERED = 0.5
_AGREES_BESIDE = 0.3
_AGREES_RESIDUAL = 0.06
# largest median score of the best pose of a known build in a recording, nats
_ORDINARY = 2.5
# largest speed of backward motion, body lengths/s; cost of twice that speed, nats/s; larger speeds
# are jumps to another object
_AROUND_S = 0.2
_BACKS_UP = 0.6
_BACKWARD = 60.0
_JUMPS = 25.0
# correlation time of the metric's evidence on head and tail, s
_ALIKE_S = 0.1
# several animals differ only in position: a jump costs up to this multiple of a transition's
# ceiling
_OTHER = 20.0
# share of the missed-detection cost in frames in which they touch
_TOGETHER = 0.1
NONE = kernels.NONE


@dataclass(frozen=True)
class AssociationCosts:
    """Costs of a chain of hypotheses, nats; lengths are those of an animal of the reference length.

    Attributes:
        score_mm: the score of the learned metric, mm, that costs one nat.
        score_most: the largest cost of a score, nats.
        none: missed-detection cost, for skipping a frame.
        ceiling: the largest cost of a transition.
        error_factor: standard deviation of a measurement over its predicted error.
        shift: random speed of the middle, lengths a second (standard deviation).
        bend: random change of the posture about the middle, lengths a second.
        tail: above this many nats, a transition cost grows logarithmically.
    """

    score_mm: float
    score_most: float
    none: float
    ceiling: float
    error_factor: float
    shift: float
    bend: float
    tail: float


class HypothesisAssociation:
    """Associates the hypotheses of frames with one animal; frames may be added.

    `path` explains all observed frames together (Viterbi), so later frames can change the choice
    for earlier ones.

    Args:
        skeleton: kinematic tree of the animal; up to eight of its joints measure its
            movement.
        length_mm: spine length of the animal, mm.
        tuning: costs.
        n_animals: how many animals are in view at once.
    """

    def __init__(
        self,
        skeleton: Skeleton,
        length_mm: float,
        tuning: AssociationCosts,
        n_animals: int = 1,
    ) -> None:
        self._tuning = tuning
        self._alone = n_animals < 2
        self._skeleton = skeleton
        self._length_mm = length_mm
        self._score_mm = tuning.score_mm * skeleton.relative_size
        n = skeleton.n_joints
        self._joints = sorted({round(k) for k in np.linspace(0, n - 1, min(n, _JOINTS))})
        self._costs = kernels.TransitionCosts(
            float(tuning.error_factor),
            float(tuning.shift),
            float(tuning.bend),
            float(tuning.tail),
            float(tuning.ceiling),
            float(tuning.ceiling) * (1.0 if self._alone else _OTHER),
            float(length_mm),
        )

    def joints(self, seen: Observations, allocate: Allocator = np.empty) -> NDArray[np.float32]:
        """Positions of the k joints that transition costs are measured by.

        Args:
            seen: hypotheses (n, H).
            allocate: allocator of the result.

        Returns:
            (n, H, k, 3) mm, float32, arena frame, NaN if there is no hypothesis; k is at most 8.
        """
        return seen.joints(self._joints, allocate)

    def path(
        self,
        seen: Observations,
        told: NDArray[np.int64] | None = None,
        joints: NDArray[np.float32] | None = None,
        allocate: Allocator = np.empty,
        emission: Array | None = None,
    ) -> NDArray[np.int64]:
        """The most probable path: which hypothesis of each frame is the animal, or `NONE`.

        Args:
            seen: hypotheses (n, H).
            told: (m,) final decisions of the first m frames, None if all are open.
            joints: result of `joints`, if available.
            allocate: allocator of intermediate arrays.
            emission: result of `emission`, if available.

        Returns:
            (n,) int64 index of the hypothesis, `NONE` if the frame is skipped.
        """
        n, h = seen.score.shape
        joints = self.joints(seen) if joints is None else joints
        check_shapes("hypotheses", ("joints", joints, (n, h, len(self._joints), 3)))
        emission = self.emission(seen, joints, allocate) if emission is None else emission
        if told is not None:
            emission = emission.copy()
            emission[: len(told)][np.arange(h) != told[:, None]] = np.inf
        missed_cost = np.concatenate([[0.0], np.cumsum(self._missed(seen))])
        cost = allocate((n, h), float)
        parent = allocate((n, h, 2), np.int64)
        chains = kernels.Chains(np.zeros((_BEAM, 2), np.int64), cost, parent)
        frames = kernels.Hypotheses(seen.seconds, joints, seen.error_mm, emission, missed_cost)
        n_beam = 0
        for rows in blocks(n, _BLOCK):
            n_beam = kernels.extend_all(rows.start, rows.stop, chains, n_beam, frames, self._costs)
        path = np.full(n, NONE, np.int64)
        if n_beam:
            kernels.trace_back(chains.beam[0, 0], chains.beam[0, 1], parent, 0, path)
        return path

    def emission(
        self, seen: Observations, joints: NDArray[np.float32], allocate: Allocator = np.empty
    ) -> Array:
        """Emission cost of each hypothesis: its capped score, and the cost of moving tail first.

        Args:
            seen: hypotheses (n, H).
            joints: result of `joints`.
            allocate: allocator of the result.

        Returns:
            (n, H) nats; NaN if there is no hypothesis.
        """
        cost = allocate(seen.score.shape, float)
        score_mm = self._score_mm * self._strangeness(seen) ** 2
        for rows in blocks(len(cost), _BLOCK):
            cost[rows] = np.minimum(
                seen.score[rows].astype(float) / score_mm, self._tuning.score_most
            )
            if self._skeleton.is_chain:
                first = max(0, rows.start - _BESIDE)
                around = slice(first, rows.stop + _BESIDE)
                ahead = joints[around, :, -1] - joints[around, :, 0]
                backward = backward_cost(seen[around], ahead, self._length_mm)
                cost[rows] += backward[rows.start - first :][: rows.stop - rows.start]
            if not self._alone:
                cost[rows] -= self._likeness(cost[rows])
        if self._skeleton.is_chain:
            other = np.arange(cost.shape[1]) ^ 1
            told = told_ends(seen) * self.independent(seen)
            both = seen.known & seen.known[:, other]
            least = np.fmin(cost, cost[:, other])
            cost[:] = np.where(both, least + told * (cost - least), cost)
        return cost

    def independent(self, seen: Observations) -> float:
        """Weight of a frame as an independent measurement, 0 to 1: frames in quick succession show
        the same posture, and the metric makes the same error in them.

        Args:
            seen: hypotheses (n, H) of consecutive frames.
        """
        if len(seen) < 2:
            return 1.0
        return float(min(1.0, np.median(np.diff(seen.seconds)) / _ALIKE_S))

    def _missed(self, seen: Observations) -> Array:
        """The cost (n,) of skipping a frame: small if several animals form one component, whose
        pose may be that of any of them, and 0 if nothing is in view.
        """
        cost = np.where(seen.known.any(axis=1), self._tuning.none, 0.0)
        if not self._alone:
            first = np.where(seen.known[:, 0], 0, NONE)
            cost[together(seen, first, usual_pixels(seen, first))] *= _TOGETHER
        return cost

    def _likeness(self, cost: Array) -> Array:
        """The part (n, H) of a component's cost to ignore when several animals are in view.

        The animal whose build is closer to the training data scores better in every frame, which
        is no reason to switch to it. The cost of a component's likelier direction, up to the cost
        of skipping a frame, is therefore ignored; the difference between its directions is kept.
        """
        other = np.arange(cost.shape[1]) ^ 1
        likelier = np.fmin(cost, cost[:, other])
        return np.asarray(np.minimum(likelier, self._tuning.none))

    def _strangeness(self, seen: Observations) -> float:
        """Ratio of the metric's scores of this animal to ordinary scores, 1 or more.

        Every pose of a build outside the training data scores badly: the frame would be skipped
        although the depth image agrees with the body. The score is also weaker evidence for head
        or tail: it is right in about two of three frames, with long runs of errors. The unit of the
        scores therefore grows by the square of this factor: the median of the best scores in frames
        whose depth image agrees, over the ordinary score.
        """
        some = seen[:: max(1, len(seen) // _SAMPLE)]
        best = np.where(some.known, some.score, np.inf).argmin(axis=1)
        with np.errstate(invalid="ignore"):
            agrees = (
                (some.along(some.covered, best) > _AGREES_COVERED)
                & (some.along(some.beside, best) < _AGREES_BESIDE)
                & (some.along(some.residual_mm, best) < _AGREES_RESIDUAL * self._length_mm)
            )
        if agrees.sum() < _FEWEST:
            return 1.0
        usual = float(np.median(some.along(some.score, best)[agrees]))
        return max(1.0, usual / (_ORDINARY * self._score_mm))

    def doubt(
        self,
        seen: Observations,
        path: NDArray[np.int64],
        joints: NDArray[np.float32] | None = None,
        allocate: Allocator = np.empty,
        emission: Array | None = None,
    ) -> Array:
        """Flip posterior (n,): probability that head and tail are exchanged on this path.

        Forward-backward over two states. The emission is the difference between the frame's
        hypothesis and the reversed one of the same component (h ^ 1), or score_most if there is
        none; the transition is the probability that an animal turns round between two frames.
        Values of skipped frames are interpolated.

        Args:
            seen: hypotheses (n, H).
            path: (n,) from `path`.
            joints: result of `joints`, if available.
            allocate: allocator of intermediate arrays.
            emission: result of `emission`, if available.

        Returns:
            (n,) probabilities; all 0 if the path is empty.
        """
        rows = np.arange(len(path))
        other = np.where(path >= 0, path ^ 1, NONE)
        joints = self.joints(seen) if joints is None else joints
        check_shapes(
            "hypotheses",
            ("joints", joints, (*seen.score.shape, len(self._joints), 3)),
            ("path", path, (len(joints),)),
        )
        emission = self.emission(seen, joints, allocate) if emission is None else emission
        here = np.where(path >= 0, emission[rows, np.maximum(path, 0)], 0.0)
        turned = np.where(path >= 0, emission[rows, np.maximum(other, 0)], 0.0)
        evidence = np.where(np.isfinite(turned), turned, self._tuning.score_most + here) - here
        used = np.flatnonzero(path >= 0)
        doubt = np.zeros(len(path))
        if not len(used):
            return doubt
        one, two = (allocate((len(used), *joints.shape[2:]), joints.dtype) for _ in range(2))
        for part in blocks(len(used), _BLOCK):
            taken = path[used[part]]
            one[part] = joints[used[part], taken]
            other_way = joints[used[part], taken ^ 1]
            two[part] = np.where(np.isfinite(other_way), other_way, one[part, ::-1])
        error = seen.error_mm[used, path[used]].astype(float)
        at_used = np.empty(len(used))
        kernels.forward_backward(
            seen.seconds[used],
            one,
            two,
            error,
            evidence[used],
            self._costs,
            at_used,
        )
        doubt[:] = np.interp(rows, used, at_used)
        return doubt


def backward_cost(seen: Observations, ahead: NDArray[np.float32], length_mm: float) -> Array:
    """The cost (n, H) of moving tail first for each hypothesis, nats.

    Animals move backwards only slowly and briefly. The velocity of the component's centroid, from
    0.2 s before to 0.2 s after, is compared with the direction from base to tip.

    Args:
        seen: hypotheses (n, H) of consecutive frames.
        ahead: (n, H, 3) mm from base to tip of each.
        length_mm: of the animal.
    """
    seconds = seen.seconds
    first = np.searchsorted(seconds, seconds - _AROUND_S)
    last = np.searchsorted(seconds, seconds + _AROUND_S, side="right") - 1
    centre = seen.centroid_mm.astype(float) / length_mm
    with np.errstate(invalid="ignore", divide="ignore"):
        velocity = (centre[last] - centre[first]) / (seconds[last] - seconds[first])[:, None, None]
        backward = -(velocity * ahead).sum(axis=-1) / np.linalg.norm(ahead, axis=-1)
        share = np.clip((backward - _BACKS_UP) / _BACKS_UP, 0.0, 1.0)
        share[~(np.linalg.norm(velocity, axis=-1) < _JUMPS)] = 0.0
    # only the heading is in question, not the identity
    other = np.arange(share.shape[1]) ^ 1
    share = np.where(seen.known & seen.known[:, other], np.nan_to_num(share), 0.0)
    share -= np.minimum(share, share[:, other])
    step = np.minimum(np.diff(seconds, prepend=seconds[:1]), _AROUND_S)
    return np.asarray(_BACKWARD * step[:, None] * share)


# Selection of one of two animals in view by size, if their sizes differ.


_LEAST = 0.08  # smallest logarithm of the ratio of their pixels
_NOISE = 0.08  # smallest standard deviation of it
_IN_ORDER = 0.9  # share of the frames with both apart in which the same one is larger
_MOST = 2.0  # largest evidence of a frame, nats
_CLEARLY = 1.5  # ratio of residuals that indicates another body


def cost_of_the_other(seen: Observations, path: NDArray[np.int64]) -> Array | None:
    """The cost (n, H) of each hypothesis for belonging to the other of two animals, nats.

    The log-normal likelihood ratio of one order of sizes over the other, at most 2 nats a frame.
    The target is the animal, larger or smaller, that the session's body fits clearly better,
    because its size and girth were measured on that one; otherwise the majority on the path.

    Args:
        seen: hypotheses (n, H) of the frames, the second component's after the first's.
        path: (n,) index of the hypothesis, negative for none.

    Returns:
        0 if only one component is in view; None if sizes do not distinguish the animals.
    """
    first, second = seen.n_px[:, 0], seen.n_px[:, 2]
    apart = seen.known[:, 0] & seen.known[:, 2] & (first != second)
    apart &= np.minimum(first, second) > 0  # sessions without pixel counts have none
    ratio = np.zeros(len(seen))
    ratio[apart] = np.log(first[apart] / second[apart])
    if apart.sum() < _FEWEST:
        return None
    size = np.abs(ratio[apart])
    usual = float(np.median(size))
    noise = max(_NOISE, 1.4826 * float(np.median(np.abs(size - usual))))
    followed = apart & (path >= 0)
    own = np.where(path >= 2, -ratio, ratio)[followed]
    if usual < _LEAST or not len(own) or not _keeps_order(own, np.flatnonzero(followed)):
        return None
    fits = _better_fit(seen, ratio, apart)
    is_larger = fits or (1.0 if own.sum() > 0.0 else -1.0)
    said = np.clip(2.0 * is_larger * usual / noise**2 * ratio, -_MOST, _MOST)
    cost = np.zeros(seen.score.shape)
    cost[:, :2] = np.maximum(-said, 0.0)[:, None]
    cost[:, 2:] = np.maximum(said, 0.0)[:, None]
    return cost


def _better_fit(seen: Observations, ratio: Array, apart: NDArray[np.bool_]) -> float:
    """1 if the session's body fits the larger one clearly better, -1 if the smaller one, else 0, by
    their residuals in the frames `apart` (n,).
    """
    first, second = (seen.residual_mm[apart, h].astype(float) for h in (0, 2))
    first_larger = ratio[apart] > 0.0
    larger = np.where(first_larger, first, second)
    smaller = np.where(first_larger, second, first)
    known = np.isfinite(larger) & np.isfinite(smaller)
    if known.sum() < _FEWEST:
        return 0.0
    off = float(np.log(np.median(smaller[known]) / max(np.median(larger[known]), 1e-9)))
    return float(np.sign(off)) if abs(off) > np.log(_CLEARLY) else 0.0


def _keeps_order(own: Array, frames: NDArray[np.int64]) -> bool:
    """Whether the tracked component is always the larger, or always the smaller one, while both are
    apart.

    Args:
        own: (k,) logarithm of its pixels over the other's.
        frames: (k,) their indices; both may have touched in missing frames.
    """
    begins = np.concatenate([[0], np.flatnonzero(np.diff(frames) > 1) + 1])
    n = np.diff(np.append(begins, len(own)))
    larger = np.add.reduceat((own > 0).astype(int), begins)
    return bool(np.maximum(larger, n - larger).sum() >= _IN_ORDER * len(own))
