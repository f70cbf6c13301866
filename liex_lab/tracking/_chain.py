"""Kernel of the association: which hypothesis of each frame lies on the animal's curve, if any."""

from __future__ import annotations

import numpy as np
from numba import njit

NONE = -1


@njit(cache=True)
def leap_cost(joints_a, joints_b, error_a, error_b, dt, length, levels, ceiling):
    """How unlikely it is, in nats, that an animal of this length mm gets from joints (J, 3) mm to others in dt s.

    The middle and the posture about it move by standard deviations of levels[1] and levels[2] lengths a second, and are
    measured to levels[0] of the predicted errors mm; at most `ceiling`.
    """
    n = joints_a.shape[0]
    shift, bend, middle = 0.0, 0.0, np.zeros(3)
    for j in range(n):
        for k in range(3):
            middle[k] += (joints_b[j, k] - joints_a[j, k]) / n
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
    return min(cost, ceiling)


@njit(cache=True)
def extend(t, live, n_live, times, joints, error, emission, idle, levels, length, ceiling, cost, parent):
    """Add frame t to the chain: fill cost[t] (H,) and parent[t] (H, 2), and put its hypotheses among the `live` ones.

    live (B, 2): frame and hypothesis of the n_live best chains' last links; idle (n + 1,): what it has cost up to each
    frame to pass by all hypotheses. A chain passes a frame by at that price. Returns how many are live.
    """
    for h in range(joints.shape[1]):
        cost[t, h], parent[t, h, 0], parent[t, h, 1] = np.inf, NONE, NONE
        if not np.isfinite(emission[t, h]):
            continue
        best = idle[t]  # the chain begins here
        for k in range(n_live):
            a, g = live[k, 0], live[k, 1]
            so_far = cost[a, g] + idle[t] - idle[a + 1]
            if so_far >= best and parent[t, h, 0] != NONE:
                continue
            leap = leap_cost(joints[a, g], joints[t, h], error[a, g], error[t, h], times[t] - times[a], length, levels,
                             ceiling)  # fmt: skip
            if so_far + leap < best:
                best, parent[t, h, 0], parent[t, h, 1] = so_far + leap, a, g
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
            a, h = live[k, 0], live[k, 1]
        else:
            a, h = t, k - n_live
        if np.isfinite(cost[a, h]):
            all_of[n, 0], all_of[n, 1] = a, h
            costs[n] = cost[a, h] + idle[t + 1] - idle[a + 1]
            n += 1
    order = np.argsort(costs[:n], kind="mergesort")
    kept = min(n, size)
    for k in range(kept):
        live[k] = all_of[order[k]]
    return kept


@njit(cache=True)
def extend_all(start, stop, live, n_live, times, joints, error, emission, idle, levels, length, ceiling, cost, parent):
    """`extend` for frames start to stop."""
    for t in range(start, stop):
        n_live = extend(t, live, n_live, times, joints, error, emission, idle, levels, length, ceiling, cost, parent)
    return n_live


@njit(cache=True)
def trace_back(frame, hypothesis, parent, first, path):
    """Follow the links from a hypothesis back to frame `first`, into path (n,), NONE where a frame was passed by."""
    path[first:] = NONE
    while frame >= first:
        path[frame] = hypothesis
        frame, hypothesis = parent[frame, hypothesis, 0], parent[frame, hypothesis, 1]
