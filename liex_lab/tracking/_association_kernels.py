"""Viterbi beam search over the pose hypotheses of frames, with missed detections (numba kernels).

A chain visits at most one hypothesis of each frame and costs, in nats, the sum of emission,
transition and missed-detection costs; cost[t, h] = emission[t, h] + min over (a, g) of cost[a, g] +
transition(a, g; t, h) + missed-detection cost of the frames between. Frames may be skipped, and the
beam keeps the best last links (Viterbi 1967). Transition cost between joints: d^2 / 2 s_1^2 + b^2 /
2 s_2^2, with d the shift of the joints' mean, b the mean change of posture, s_k^2 = error_factor^2
(e_a^2 + e_b^2) + (v_k L dt)^2, v_1 = shift, v_2 = bend; robust by T log(1 + c / T) with T = tail.
`forward_backward` is the forward-backward algorithm over two states, head and tail as on the path
or exchanged, and gives the flip posterior.
"""

from typing import Any, NamedTuple

import numpy as np

from liex_lab.runtime.kernels import inner_kernel, kernel

NONE = -1


class TransitionCosts(NamedTuple):
    """Parameters of the transition cost.

    Attributes:
        error_factor: factor from predicted errors to standard deviations.
        shift: standard deviation of the joints' mean, body lengths per second.
        bend: standard deviation of the posture about it, body lengths per second.
        tail: cost above which costs grow logarithmically, nats.
        ceiling: largest transition cost, nats.
        elsewhere: largest cost of the shift of the joints' mean, if that is more.
        length: spine length of the animal, mm.
    """

    error_factor: float
    shift: float
    bend: float
    tail: float
    ceiling: float
    elsewhere: float
    length: float


class Hypotheses(NamedTuple):
    """H pose hypotheses in each of n frames.

    Attributes:
        times: (n,) s.
        joints: (n, H, J, 3) mm.
        error: (n, H) predicted mean joint error, mm.
        emission: (n, H) emission cost of each hypothesis, nats; not finite if absent.
        missed_cost: (n + 1,) missed-detection cost of all frames before each, cumulative, nats.
    """

    times: Any
    joints: Any
    error: Any
    emission: Any
    missed_cost: Any


class Chains(NamedTuple):
    """The best chains so far; filled in place.

    Attributes:
        beam: (B, 2) frame and hypothesis of the last links of the best chains.
        cost: (n, H) cost of the best chain that ends there, nats; infinite if none.
        parent: (n, H, 2) previous frame and hypothesis, `NONE` at the start of a chain.
    """

    beam: Any
    cost: Any
    parent: Any


@inner_kernel()
def transition_cost(joints_a, joints_b, error_a, error_b, dt, costs):
    """Transition cost of moving from joints (J, 3) mm to others in dt s, nats.

    Animals seldom dart, but they do: costs above the tail grow logarithmically.

    Args:
        joints_a: (J, 3) mm, before.
        joints_b: (J, 3) mm, after.
        error_a: predicted mean joint error before, mm.
        error_b: the same after, mm.
        dt: time between, s.
        costs: `TransitionCosts`.

    Returns:
        Nats, from 0 to the ceiling.
    """
    n = joints_a.shape[0]
    shift = bend = 0.0
    middle = np.zeros(3)
    for j in range(n):
        for k in range(3):
            middle[k] += (float(joints_b[j, k]) - float(joints_a[j, k])) / n
    for k in range(3):
        shift += middle[k] ** 2
    for j in range(n):
        off = 0.0
        for k in range(3):
            off += (joints_b[j, k] - joints_a[j, k] - middle[k]) ** 2
        bend += np.sqrt(off) / n
    variance = costs.error_factor**2 * (error_a * error_a + error_b * error_b)
    cost = 0.5 * shift / (variance + (costs.shift * costs.length * dt) ** 2)
    most = max(costs.ceiling, min(cost, costs.elsewhere))
    cost += 0.5 * bend * bend / (variance + (costs.bend * costs.length * dt) ** 2)
    return min(costs.tail * np.log1p(cost / costs.tail), most)


@inner_kernel()
def _keep_best(t, chains, n_beam, missed_cost):
    """Prune: keep the best chains after frame t in the beam, best first; returns their number."""
    beam = chains.beam
    cost = chains.cost
    size = beam.shape[0]
    n_hypotheses = cost.shape[1]
    all_of = np.empty((n_beam + n_hypotheses, 2), np.int64)
    costs = np.empty(n_beam + n_hypotheses)
    n = 0
    for k in range(n_beam + n_hypotheses):
        if k < n_beam:
            a, h = beam[k, 0], beam[k, 1]
        else:
            a = t
            h = k - n_beam
        if np.isfinite(cost[a, h]):
            all_of[n, 0] = a
            all_of[n, 1] = h
            costs[n] = cost[a, h] + missed_cost[t + 1] - missed_cost[a + 1]
            n += 1
    order = np.empty(n, np.int64)
    for k in range(n):  # stable insertion sort: few elements, mostly sorted
        place = k
        while place > 0 and costs[order[place - 1]] > costs[k]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = k
    kept = min(n, size)
    for k in range(kept):
        for i in range(2):
            beam[k, i] = all_of[order[k], i]
    return kept


@kernel()
def extend_all(start, stop, chains, n_beam, frames, costs):
    """Viterbi over frames start to stop: add each with its hypotheses to the beam.

    A chain may begin at any frame and skips a frame at its missed-detection cost.

    Args:
        start: first frame.
        stop: frame after the last.
        chains: `Chains`, updated in place.
        n_beam: number of beam rows in use.
        frames: `Hypotheses`.
        costs: `TransitionCosts`.

    Returns:
        Number of beam rows in use afterwards.
    """
    cost = chains.cost
    parent = chains.parent
    missed_cost = frames.missed_cost
    for t in range(start, stop):
        for h in range(frames.joints.shape[1]):
            cost[t, h] = np.inf
            parent[t, h, 0] = NONE
            parent[t, h, 1] = NONE
            if not np.isfinite(frames.emission[t, h]):
                continue
            best = missed_cost[t]  # the chain begins here
            for k in range(n_beam):
                a, g = chains.beam[k, 0], chains.beam[k, 1]
                so_far = cost[a, g] + missed_cost[t] - missed_cost[a + 1]
                if so_far >= best and parent[t, h, 0] != NONE:
                    continue
                transition = transition_cost(
                    frames.joints[a, g],
                    frames.joints[t, h],
                    frames.error[a, g],
                    frames.error[t, h],
                    frames.times[t] - frames.times[a],
                    costs,
                )
                if so_far + transition < best:
                    best = so_far + transition
                    parent[t, h, 0] = a
                    parent[t, h, 1] = g
            cost[t, h] = best + frames.emission[t, h]
        n_beam = _keep_best(t, chains, n_beam, missed_cost)
    return n_beam


@kernel()
def trace_back(frame, hypothesis, parent, first, path):
    """Viterbi backtracking: follow the links from a hypothesis back to frame `first`.

    Args:
        frame: last frame of the chain.
        hypothesis: index of its hypothesis.
        parent: (n, H, 2) links, see `extend`.
        first: the earliest frame to write.
        path: (n,) output from `first` on, `NONE` for skipped frames.
    """
    path[first:] = NONE
    while frame >= first:
        path[frame] = hypothesis
        frame, hypothesis = parent[frame, hypothesis, 0], parent[frame, hypothesis, 1]


@kernel()
def turn_costs(times, one, two, error, costs, stay, transition):
    """Costs of the transitions within and between head and tail as they are, or exchanged.

    Args:
        times: (n,) s.
        one: (n, J, 3) mm, joints as on the path.
        two: (n, J, 3) mm, joints with head and tail exchanged.
        error: (n,) predicted mean joint error, mm.
        costs: `TransitionCosts`.
        stay: (n, 2) output but for the first row, `transition_cost` within each state, nats.
        transition: (n, 2) output but for the first row, from each state to the other, nats.
    """
    for t in range(1, times.size):
        dt = times[t] - times[t - 1]
        before = error[t - 1]
        after = error[t]
        stay[t, 0] = transition_cost(one[t - 1], one[t], before, after, dt, costs)
        stay[t, 1] = transition_cost(two[t - 1], two[t], before, after, dt, costs)
        transition[t, 0] = transition_cost(one[t - 1], two[t], before, after, dt, costs)
        transition[t, 1] = transition_cost(two[t - 1], one[t], before, after, dt, costs)


@kernel()
def forward_backward(stay, transition, evidence, doubt):
    """Forward-backward over two states: fill the flip posterior of each frame.

    All sums are in logarithms.

    Args:
        stay: (n, 2) cost of remaining in each state, see `turn_costs`.
        transition: (n, 2) cost of leaving it for the other one.
        evidence: (n,) log likelihood ratio of the frame alone, nats, positive for the first state.
        doubt: (n,) output, posterior probability of the second state.
    """
    n = evidence.size
    # forward pass: log probabilities of each state given the past
    first = np.zeros(n)
    second = np.zeros(n)
    second[0] = -evidence[0]
    for t in range(1, n):
        first[t] = np.logaddexp(first[t - 1] - stay[t, 0], second[t - 1] - transition[t, 1])
        second[t] = (
            np.logaddexp(first[t - 1] - transition[t, 0], second[t - 1] - stay[t, 1]) - evidence[t]
        )
        top = max(first[t], second[t])
        first[t] -= top
        second[t] -= top
    # backward pass
    a = b = 0.0
    for t in range(n - 1, -1, -1):
        doubt[t] = 1.0 / (1.0 + np.exp(min(first[t] + a - second[t] - b, 700.0)))
        if t > 0:
            later = b - evidence[t]
            a, b = (
                np.logaddexp(a - stay[t, 0], later - transition[t, 0]),
                np.logaddexp(a - transition[t, 1], later - stay[t, 1]),
            )
            top = max(a, b)
            a -= top
            b -= top
