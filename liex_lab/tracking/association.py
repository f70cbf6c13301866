"""Data association by Viterbi: which hypothesis of each frame of a recording is the animal.

The most probable path of a hidden Markov model whose states are the hypotheses of each frame and
"missed": minimise sum_t score_t / score_mm (capped) + transition costs + missed-detection costs, by
dynamic programming with a beam of 24 (Viterbi 1967; kernels in `_association_kernels`). For an
animal of a build that the metric was not trained on, score_mm is larger, and a hypothesis that
moves tail first for long costs more (`backward_cost`). The forward-backward algorithm over two
states (Rabiner 1989) then distinguishes head and tail on that path, and gives the flip posterior.
Lie-X has no such step: its tracker is a particle filter (section 4.2).
"""

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.runtime.memory import Allocator, blocks, release_pages
from liex_lab.tracking import _association_kernels as kernels
from liex_lab.tracking.observations import Array, Observations
from liex_lab.tracking.smoother import AssociationCosts
from liex_lab.tracking.trust import head_tail_weight

_BLOCK = 16_384  # frames in memory at once
_BESIDE = 256  # and context frames, for velocities
_FEWEST = 12  # frames for an estimate
_AROUND_S = 0.2
_BACKS_UP = 0.6  # largest speed of backward motion, body lengths/s
NONE = kernels.NONE


class HypothesisAssociation:
    """Associates the hypotheses of frames with one animal; frames may be added.

    `path` explains all observed frames together (Viterbi), so later frames can change the choice
    for earlier ones.

    Args:
        skeleton: kinematic tree of the animal; up to eight of its joints measure its
            movement.
        length_mm: spine length of the animal, mm.
        tuning: costs.
        several: whether animals are distinguished by it, which differ only in position.
    """

    def __init__(
        self,
        skeleton: Skeleton,
        length_mm: float,
        tuning: AssociationCosts,
        several: bool = False,
    ) -> None:
        self._tuning = tuning
        self._skeleton = skeleton
        self._length_mm = length_mm
        self._score_mm = tuning.score_mm * skeleton.relative_size
        n = skeleton.n_joints
        self._joints = sorted({round(k) for k in np.linspace(0, n - 1, min(n, 8))})
        t = tuning
        jump = t.ceiling * (20.0 if several else 1.0)
        costs = t.error_factor, t.shift, t.bend, t.tail, t.ceiling, jump, length_mm
        self.costs = kernels.TransitionCosts(*map(float, costs))

    def joints(self, observed: Observations, allocate: Allocator = np.empty) -> NDArray[np.float32]:
        """Positions of the k joints that transition costs are measured by.

        Args:
            observed: hypotheses (n, H).
            allocate: allocator of the result.

        Returns:
            (n, H, k, 3) mm, float32, arena frame, NaN if there is no hypothesis; k is at most 8.
        """
        joints = observed.joints(self._joints, allocate)
        rows, h = _undirected(observed)
        joints[rows, h] = joints[rows, h ^ 1, ::-1]
        return joints

    def path(
        self,
        observed: Observations,
        joints: NDArray[np.float32],
        emission: Array,
        decided: NDArray[np.int64] | None = None,
        allocate: Allocator = np.empty,
    ) -> NDArray[np.int64]:
        """The most probable path: which hypothesis of each frame is the animal, or `NONE`.

        Args:
            observed: hypotheses (n, H).
            joints: result of `joints`.
            emission: result of `emission`.
            decided: (m,) final decisions of the first m frames, None if all are open.
            allocate: allocator of intermediate arrays.

        Returns:
            (n,) int64 index of the hypothesis, `NONE` if the frame is skipped.
        """
        n, h = observed.score.shape
        if decided is not None:
            emission = emission.copy()
            emission[: len(decided)][np.arange(h) != decided[:, None]] = np.inf
        missed = np.where(observed.known.any(axis=1), self._tuning.none, 0.0)
        missed_cost = np.concatenate([[0.0], np.cumsum(missed)])
        parent = allocate((n, h, 2), np.int64)
        # 24 chains are kept
        chains = kernels.Chains(np.zeros((24, 2), np.int64), allocate((n, h), float), parent)
        frames = kernels.Hypotheses(
            observed.seconds, joints, _errors(observed), emission, missed_cost
        )
        n_beam = 0
        for rows in blocks(n, _BLOCK):
            n_beam = kernels.extend_all(rows.start, rows.stop, chains, n_beam, frames, self.costs)
        path = np.full(n, NONE, np.int64)
        at, hypothesis = chains.beam[0] if n_beam else (NONE, NONE)
        for rows in reversed([*blocks(n, _BLOCK)]):
            if rows.start <= at < rows.stop:
                kernels.trace_back(at, hypothesis, parent, rows.start, path[: rows.stop])
                at = rows.start + int((path[rows] != NONE).argmax())
                at, hypothesis = parent[at, path[at]]
            release_pages()
        return path

    def emission(
        self, observed: Observations, joints: NDArray[np.float32], allocate: Allocator = np.empty
    ) -> Array:
        """Emission cost of each hypothesis: its capped score, and the cost of moving tail first.

        Args:
            observed: hypotheses (n, H).
            joints: result of `joints`.
            allocate: allocator of the result.

        Returns:
            (n, H) nats; NaN if there is no hypothesis.
        """
        tuning = self._tuning
        cost = allocate(observed.score.shape, float)
        other = np.arange(cost.shape[1]) ^ 1
        score_mm = self._score_mm * self._strangeness(observed) ** 2
        for rows in blocks(len(cost), _BLOCK):
            part = np.minimum(observed.score[rows].astype(float) / score_mm, tuning.score_most)
            if self._skeleton.is_chain:
                first = max(0, rows.start - _BESIDE)
                around = slice(first, rows.stop + _BESIDE)
                ahead = joints[around, :, -1] - joints[around, :, 0]
                backward = backward_cost(observed[around], ahead, self._length_mm)
                part += backward[rows.start - first :][: len(part)]
            cost[rows] = part
        if self._skeleton.is_chain:
            weight = head_tail_weight(observed, allocate)
            independent = self.independent(observed)
            for rows in blocks(len(cost), _BLOCK):
                part, known = cost[rows], observed[rows].known
                least = np.fmin(part, part[:, other])
                less = least + weight[rows] * independent * (part - least)
                cost[rows] = np.where(known & known[:, other], less, part)
        return cost

    def independent(self, observed: Observations) -> float:
        """Weight of a frame as an independent measurement, 0 to 1: frames in quick succession show
        the same posture, and the metric makes the same error in them.

        Args:
            observed: hypotheses (n, H) of consecutive frames.
        """
        if len(observed) < 2:
            return 1.0
        # the metric's evidence on head and tail is correlated over a tenth of a second
        return float(min(1.0, np.median(np.diff(observed.seconds)) / 0.1))

    def _strangeness(self, observed: Observations) -> float:
        """Ratio of the metric's scores of this animal to ordinary scores, 1 or more.

        Every pose of a build outside the training data scores badly: the frame would be skipped
        although the depth image agrees with the body. The score is also weaker evidence for head
        or tail: it is right in about two of three frames, with long runs of errors. The unit of the
        scores therefore grows by the square of this factor: the median of the best scores in frames
        whose depth image agrees, over the ordinary score.
        """
        some = observed[:: max(1, len(observed) // 2048)]
        best = np.where(some.known, some.score, np.inf).argmin(axis=1)
        with np.errstate(invalid="ignore"):
            # the body covers the outline, is hardly outside it, and is near the readings
            agrees = (
                (some.along(some.covered, best) > 0.5)
                & (some.along(some.beside, best) < 0.3)
                & (some.along(some.residual_mm, best) < 0.06 * self._length_mm)
            )
        if agrees.sum() < _FEWEST:
            return 1.0
        usual = float(np.median(some.along(some.score, best)[agrees]))
        # the largest median score of a known build, nats
        return max(1.0, usual / (2.5 * self._score_mm))

    def doubt(
        self,
        observed: Observations,
        path: NDArray[np.int64],
        joints: NDArray[np.float32],
        emission: Array,
    ) -> Array:
        """Flip posterior (n,): probability that head and tail are exchanged on this path.

        Forward-backward over two states. The emission is the difference between the frame's
        hypothesis and the reversed one of the same component (h ^ 1), or score_most if there is
        none; the transition is the probability that an animal turns round between two frames.
        Values of skipped frames are interpolated.

        Args:
            observed: hypotheses (n, H).
            path: (n,) from `path`.
            joints: result of `joints`.
            emission: result of `emission`.

        Returns:
            (n,) probabilities; all 0 if the path is empty.
        """
        used = np.flatnonzero(path >= 0)
        if not len(used):
            return np.zeros(len(path))
        taken = path[used]
        here, reversed_ = emission[used, taken], emission[used, taken ^ 1]
        evidence = (
            np.where(np.isfinite(reversed_), reversed_, self._tuning.score_most + here) - here
        )
        del here, reversed_
        error, seconds = _errors(observed), observed.seconds
        stay, transition = np.empty((2, len(used), 2))
        for part in blocks(len(used), _BLOCK):
            around = slice(max(0, part.start - 1), part.stop)
            rows, h = used[around], taken[around]
            one, two = joints[rows, h], joints[rows, h ^ 1]
            two = np.where(np.isfinite(two), two, one[:, ::-1])
            known = seconds[rows], one, two, error[rows, h].astype(float), self.costs
            kernels.turn_costs(*known, stay[around], transition[around])
        at_used = np.empty(len(used))
        kernels.forward_backward(stay, transition, evidence, at_used)
        return np.interp(np.arange(len(path)), used, at_used)


def _undirected(observed: Observations) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Frames (k,) and hypotheses (k,) that score as their reversal and have a larger error.

    The image does not distinguish these ends. Nor may the jitter of two fits: over a long contact
    it would outweigh the directions before and after. The transitions of both directions are
    therefore those of the better fit, and the cost of a half turn is all that separates them.
    """
    other = np.arange(observed.score.shape[1]) ^ 1
    tied = observed.score == observed.score[:, other]
    rows, h = np.nonzero(tied & (observed.error_mm > observed.error_mm[:, other]))
    return rows, h


def _errors(observed: Observations) -> NDArray[np.float32]:
    """Predicted errors (n, H) mm for transition costs, see `_undirected`."""
    rows, h = _undirected(observed)
    if not len(rows):
        return observed.error_mm
    error = observed.error_mm.copy()
    error[rows, h] = error[rows, h ^ 1]
    return error


def backward_cost(observed: Observations, ahead: NDArray[np.float32], length_mm: float) -> Array:
    """The cost (n, H) of moving tail first for each hypothesis, nats.

    Animals move backwards only slowly and briefly. The velocity of the component's centroid, from
    0.2 s before to 0.2 s after, is compared with the direction from base to tip.

    Args:
        observed: hypotheses (n, H) of consecutive frames.
        ahead: (n, H, 3) mm from base to tip of each.
        length_mm: of the animal.
    """
    seconds = observed.seconds
    first = np.searchsorted(seconds, seconds - _AROUND_S)
    last = np.searchsorted(seconds, seconds + _AROUND_S, side="right") - 1
    centre = observed.centroid_mm.astype(float) / length_mm
    with np.errstate(invalid="ignore", divide="ignore"):
        velocity = (centre[last] - centre[first]) / (seconds[last] - seconds[first])[:, None, None]
        backward = -(velocity * ahead).sum(axis=-1) / np.linalg.norm(ahead, axis=-1)
        share = np.clip((backward - _BACKS_UP) / _BACKS_UP, 0.0, 1.0)
        # faster ones are jumps to another object
        share[~(np.linalg.norm(velocity, axis=-1) < 25.0)] = 0.0
    # only the heading is in question, not the identity
    other = np.arange(share.shape[1]) ^ 1
    share = np.where(observed.known & observed.known[:, other], np.nan_to_num(share), 0.0)
    share -= np.minimum(share, share[:, other])
    step = np.minimum(np.diff(seconds, prepend=seconds[:1]), _AROUND_S)
    # 60 nats/s at twice that speed
    return np.asarray(60.0 * step[:, None] * share)
