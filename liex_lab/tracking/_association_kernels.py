"""Kernel of the association: which hypothesis of each frame lies on the animal's curve, if any."""

from __future__ import annotations

import numpy as np
from numba import njit

NONE = -1


@njit(cache=True)
def leap_cost(joints_a, joints_b, error_a, error_b, dt, length, levels, ceiling):
    """How unlikely it is, in nats, that an animal of this length mm gets from joints (J, 3) mm to
    others in dt s.

    The middle and the posture about it move by standard deviations of levels[1] and levels[2]
    lengths a second, and are measured to levels[0] of the predicted errors mm. Animals seldom dart,
    but they do: costs above levels[3] nats grow as logarithms; at most `ceiling`.
    """
    n = joints_a.shape[0]
    shift = 0.0
    bend = 0.0
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
    seen = levels[0] ** 2 * (error_a * error_a + error_b * error_b)
    cost = 0.5 * shift / (seen + (levels[1] * length * dt) ** 2)
    cost += 0.5 * bend * bend / (seen + (levels[2] * length * dt) ** 2)
    return min(levels[3] * np.log1p(cost / levels[3]), ceiling)


@njit(cache=True)
def extend(
    t, live, n_live, times, joints, error, emission, idle, levels, length, ceiling, cost, parent
):
    """Add frame t to the chain: fill cost[t] (H,) and parent[t] (H, 2), and put its hypotheses
    among the `live` ones.

    live (B, 2): frame and hypothesis of the n_live best chains' last links; idle (n + 1,): what it
    has cost up to each frame to pass by all hypotheses. A chain passes a frame by at that price.
    Returns how many are live.
    """
    for h in range(joints.shape[1]):
        cost[t, h] = np.inf
        parent[t, h, 0] = NONE
        parent[t, h, 1] = NONE
        if not np.isfinite(emission[t, h]):
            continue
        best = idle[t]  # the chain begins here
        for k in range(n_live):
            a = live[k, 0]
            g = live[k, 1]
            so_far = cost[a, g] + idle[t] - idle[a + 1]
            if so_far >= best and parent[t, h, 0] != NONE:
                continue
            leap = leap_cost(
                joints[a, g],
                joints[t, h],
                error[a, g],
                error[t, h],
                times[t] - times[a],
                length,
                levels,
                ceiling,
            )
            if so_far + leap < best:
                best = so_far + leap
                parent[t, h, 0] = a
                parent[t, h, 1] = g
        cost[t, h] = best + emission[t, h]
    return _keep_best(t, live, n_live, idle, cost, joints.shape[1])


@njit(cache=True)
def _keep_best(t, live, n_live, idle, cost, n_hypotheses):
    """The best chains after frame t into `live`, best first; returns how many."""
    size = live.shape[0]
    all_of = np.empty((n_live + n_hypotheses, 2), np.int64)
    costs = np.empty(n_live + n_hypotheses)
    n = 0
    for k in range(n_live + n_hypotheses):
        if k < n_live:
            a = live[k, 0]
            h = live[k, 1]
        else:
            a = t
            h = k - n_live
        if np.isfinite(cost[a, h]):
            all_of[n, 0] = a
            all_of[n, 1] = h
            costs[n] = cost[a, h] + idle[t + 1] - idle[a + 1]
            n += 1
    order = np.argsort(costs[:n], kind="mergesort")
    kept = min(n, size)
    for k in range(kept):
        live[k] = all_of[order[k]]
    return kept


@njit(cache=True)
def extend_all(
    start,
    stop,
    live,
    n_live,
    times,
    joints,
    error,
    emission,
    idle,
    levels,
    length,
    ceiling,
    cost,
    parent,
):
    """`extend` for frames start to stop."""
    for t in range(start, stop):
        n_live = extend(
            t,
            live,
            n_live,
            times,
            joints,
            error,
            emission,
            idle,
            levels,
            length,
            ceiling,
            cost,
            parent,
        )
    return n_live


@njit(cache=True)
def trace_back(frame, hypothesis, parent, first, path):
    """Follow the links from a hypothesis back to frame `first`, into path (n,), NONE where a frame
    was passed by.
    """
    path[first:] = NONE
    while frame >= first:
        path[frame] = hypothesis
        frame, hypothesis = parent[frame, hypothesis, 0], parent[frame, hypothesis, 1]


@njit(cache=True)
def two_ways(times, one, two, error, evidence, levels, length, ceiling, doubt):
    """Probability (n,) of the second of two ways round of each frame: joints one and two (n, J, 3)
    mm.

    evidence (n,): by how many nats a frame is for the first way.
    """
    n = times.size
    stay = np.empty((n, 2))
    leap = np.empty((n, 2))
    for t in range(1, n):
        dt = times[t] - times[t - 1]
        stay[t, 0] = leap_cost(
            one[t - 1], one[t], error[t - 1], error[t], dt, length, levels, ceiling
        )
        stay[t, 1] = leap_cost(
            two[t - 1], two[t], error[t - 1], error[t], dt, length, levels, ceiling
        )
        leap[t, 0] = leap_cost(
            one[t - 1], two[t], error[t - 1], error[t], dt, length, levels, ceiling
        )
        leap[t, 1] = leap_cost(
            two[t - 1], one[t], error[t - 1], error[t], dt, length, levels, ceiling
        )
    # logarithms of what the past says of each way
    first = np.zeros(n)
    second = np.zeros(n)
    second[0] = -evidence[0]
    for t in range(1, n):
        first[t] = np.logaddexp(first[t - 1] - stay[t, 0], second[t - 1] - leap[t, 1])
        second[t] = (
            np.logaddexp(first[t - 1] - leap[t, 0], second[t - 1] - stay[t, 1]) - evidence[t]
        )
        top = max(first[t], second[t])
        first[t] -= top
        second[t] -= top
    # and what the future says
    a = 0.0
    b = 0.0
    for t in range(n - 1, -1, -1):
        doubt[t] = 1.0 / (1.0 + np.exp(min(first[t] + a - second[t] - b, 700.0)))
        if t > 0:
            later = b - evidence[t]
            a, b = (
                np.logaddexp(a - stay[t, 0], later - leap[t, 0]),
                np.logaddexp(a - leap[t, 1], later - stay[t, 1]),
            )
            top = max(a, b)
            a -= top
            b -= top
