"""The animal's curve through the hypotheses of single frames: which of them it is, or none, over a
whole recording.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from liex_lab.body.skeleton import Skeleton
from liex_lab.runtime.memory import Room, blocks, let_go
from liex_lab.tracking import _association_kernels as kernels
from liex_lab.tracking.observations import Observations

Array = NDArray[np.float64]

_BEAM = 24  # chains under way
_JOINTS = 8  # so many say how far an animal has moved
_BLOCK = 16_384  # frames that are in memory at a time
NONE = kernels.NONE


@dataclass(frozen=True)
class ChainTuning:
    """What makes a chain likely; costs are nats, lengths those of an animal of the reference
    length.

    score_mm: this much of the metric's score weighs one nat, up to score_most of them; none:
    passing all hypotheses of a frame by; ceiling: the most a leap costs; error_factor: of the
    predicted errors, as standard deviations; shift and bend: how fast, in lengths a second, middle
    and posture move by themselves; tail: from so many nats on, a leap's price grows as a logarithm.
    """

    score_mm: float
    score_most: float
    none: float
    ceiling: float
    error_factor: float
    shift: float
    bend: float
    tail: float


class Chain:
    """Follows the hypotheses of frames; grows while frames come.

    length_mm: of the animal. `path` explains all frames seen so far at once (Viterbi), so a stretch
    that looked like one thing is another as soon as what follows says so.
    """

    def __init__(self, skeleton: Skeleton, length_mm: float, tuning: ChainTuning) -> None:
        self._length = length_mm
        self._tuning = tuning
        self._score_mm = tuning.score_mm * skeleton.relative_size
        n = skeleton.n_joints
        self._joints = sorted({round(k) for k in np.linspace(0, n - 1, min(n, _JOINTS))})
        self._levels = np.array([tuning.error_factor, tuning.shift, tuning.bend, tuning.tail])

    def joints(self, seen: Observations, room: Room = np.empty) -> NDArray[np.float32]:
        """Positions (n, H, some, 3) mm of the joints that chains are told by; room: where they are
        to lie.
        """
        return seen.joints(self._joints, room)

    def path(
        self,
        seen: Observations,
        told: NDArray[np.int64] | None = None,
        joints: NDArray[np.float32] | None = None,
        room: Room = np.empty,
    ) -> NDArray[np.int64]:
        """(n,) the hypothesis of each frame that lies on the curve, or NONE.

        told (m,): of the first m frames it is known already; joints: those of `joints`, where they
        are at hand; room: for what takes much of it on the way.
        """
        n, h = seen.score.shape
        emission = self._emission(seen, room)
        if told is not None:
            emission[: len(told)][np.arange(h) != told[:, None]] = np.inf
        idle = np.concatenate(
            [[0.0], np.cumsum(np.where(seen.known.any(axis=1), self._tuning.none, 0.0))]
        )
        cost = room((n, h), float)
        parent = room((n, h, 2), np.int64)
        live = np.zeros((_BEAM, 2), np.int64)
        joints = self.joints(seen) if joints is None else joints
        seconds = seen.seconds
        n_live = 0
        for rows in blocks(n, _BLOCK):
            n_live = kernels.extend_all(
                rows.start,
                rows.stop,
                live,
                n_live,
                seconds,
                joints,
                seen.error_mm,
                emission,
                idle,
                self._levels,
                self._length,
                self._tuning.ceiling,
                cost,
                parent,
            )
            let_go(joints, emission, cost, parent)
        path = np.full(n, NONE, np.int64)
        if n_live:
            kernels.trace_back(live[0, 0], live[0, 1], parent, 0, path)
        return path

    def _emission(self, seen: Observations, room: Room) -> Array:
        """What each hypothesis (n, H) costs by itself."""
        cost = room(seen.score.shape, float)
        for rows in blocks(len(cost), _BLOCK):
            cost[rows] = np.minimum(
                seen.score[rows].astype(float) / self._score_mm, self._tuning.score_most
            )
            let_go(cost)
        return cost

    def doubt(
        self,
        seen: Observations,
        path: NDArray[np.int64],
        joints: NDArray[np.float32] | None = None,
        room: Room = np.empty,
    ) -> Array:
        """(n,) probability that head and tail are exchanged on this path: forward and backward
        through two states.

        What a frame says is the difference between its hypothesis and the same thing turned round;
        between frames, how likely it is that an animal turns round, or does not, in the time
        between them.
        """
        rows = np.arange(len(path))
        other = np.where(path >= 0, path ^ 1, NONE)
        emission = self._emission(seen, room)
        here = np.where(path >= 0, emission[rows, np.maximum(path, 0)], 0.0)
        turned = np.where(path >= 0, emission[rows, np.maximum(other, 0)], 0.0)
        evidence = np.where(np.isfinite(turned), turned, self._tuning.score_most + here) - here
        used = np.flatnonzero(path >= 0)
        doubt = np.zeros(len(path))
        if not len(used):
            return doubt
        joints = self.joints(seen) if joints is None else joints
        one, two = (room((len(used), *joints.shape[2:]), joints.dtype) for _ in range(2))
        for part in blocks(len(used), _BLOCK):
            taken = path[used[part]]
            one[part] = joints[used[part], taken]
            other_way = joints[used[part], taken ^ 1]
            two[part] = np.where(np.isfinite(other_way), other_way, one[part, ::-1])
            let_go(joints, one, two)
        error = seen.error_mm[used, path[used]].astype(float)
        at_used = np.empty(len(used))
        kernels.two_ways(
            seen.seconds[used],
            one,
            two,
            error,
            evidence[used],
            self._levels,
            self._length,
            self._tuning.ceiling,
            at_used,
        )
        doubt[:] = np.interp(rows, used, at_used)
        return doubt
