"""Viterbi and forward-backward algorithms of a hidden semi-Markov model, expanded to Markov states.

Action k is a row of D_k states that are passed one by one, so a bout lasts at least D_k ticks; the
last state may repeat, so the rest of the length is geometric (expanded-state hidden semi-Markov
model; Yu 2010, Rabiner 1989). With emission scores e_t(k), in the first state of k: v_t = e_t(k) +
max_j [v_{t-1}(last of j) + leave_j + switch_jk]; within a row v moves on by one state; in the last
also v_{t-1} + stay_k. Any state may begin or end a recording.

Arrays: scores (m, K) log score of each tick for each action; first (K + 1,) index of each action's
first state, with the total at the end; stay, leave (K,) log probabilities of the last state; switch
(K, K) log probabilities of the next action, about -inf for itself.
"""

import numpy as np

from liex_lab.runtime.kernels import inner_kernel, kernel

_NEVER = -1e30


@kernel()
def go_on(start, stop, scores, first, stay, leave, switch, value, came_from, stayed):
    """Viterbi recursion over the ticks `start` to `stop` of a block; fills the back-pointers.

    Args:
        start: first tick of the block; 0 initialises `value`.
        stop: tick after the last.
        scores: (m, K) log scores.
        first: (K + 1,) index of each action's first state, and the total.
        stay: (K,) log probability of staying in the last state.
        leave: (K,) log probability of leaving it.
        switch: (K, K) log probability of the next action.
        value: (states,) log score of the best path to each state at tick start - 1; updated to stop
            - 1.
        came_from: (m, K) output, the previous action, for one that begins at a tick.
        stayed: (m, K) bool output, whether the best path was in the action's last state before.
    """
    n = scores.shape[1]
    total = first[n]
    fresh = np.empty(total)
    if start == 0:
        for k in range(n):
            value[first[k] : first[k + 1]] = scores[0, k] - np.log(
                total
            )  # it may begin in the middle of a bout
            came_from[0, k] = 0
            stayed[0, k] = False
    for t in range(max(start, 1), stop):
        for k in range(n):
            best = _NEVER
            source = 0
            for j in range(n):
                if j != k:
                    reach = value[first[j + 1] - 1] + leave[j] + switch[j, k]
                    if reach > best:
                        best = reach
                        source = j
            came_from[t, k] = source
            stayed[t, k] = False
            last = first[k + 1] - 1
            for s in range(last, first[k], -1):
                fresh[s] = value[s - 1]
            fresh[first[k]] = best
            if value[last] + stay[k] > fresh[last]:
                fresh[last] = value[last] + stay[k]
                stayed[t, k] = True
            for s in range(first[k], last + 1):
                fresh[s] += scores[t, k]
        for s in range(fresh.size):
            value[s] = fresh[s]


@kernel()
def trace_back(first, value, came_from, stayed, label):
    """Viterbi backtracking: the most probable actions.

    Args:
        first: (K + 1,) index of each action's first state, and the total.
        value: (states,) log scores at the last tick.
        came_from: (m, K) back-pointers of `go_on`.
        stayed: (m, K) back-pointers of `go_on`.
        label: (m,) output, action of each tick.
    """
    state = int(np.argmax(value))
    k = 0
    while first[k + 1] <= state:
        k += 1
    for t in range(len(label) - 1, -1, -1):
        label[t] = k
        if t == 0:
            break
        if state == first[k + 1] - 1 and stayed[t, k]:
            continue
        if state > first[k]:
            state -= 1
        else:
            k = came_from[t, k]
            state = first[k + 1] - 1


@kernel()
def probabilities(scores, first, stay, leave, switch, out):
    """Forward-backward algorithm: posteriors of the actions, normalised tick by tick.

    Args:
        scores: (m, K) log scores.
        first: (K + 1,) index of each action's first state, and the total.
        stay: (K,) log probability of staying in the last state.
        leave: (K,) log probability of leaving it.
        switch: (K, K) log probability of the next action.
        out: (m, K) output, probabilities.
    """
    m, n = scores.shape
    total = first[n]
    go = np.exp(stay)
    end = np.exp(leave)
    follow = np.exp(switch)
    ahead = np.empty((m, total), np.float32)
    now = np.ones(total) / total
    fresh = np.empty(total)
    like = np.empty(n)
    for t in range(m):
        _likelihood(scores, t, like)
        if t > 0:
            for k in range(n):
                enter = 0.0
                for j in range(n):
                    enter += now[first[j + 1] - 1] * end[j] * follow[j, k]
                last = first[k + 1] - 1
                held = now[last] * go[k]
                for s in range(last, first[k], -1):
                    fresh[s] = now[s - 1]
                fresh[first[k]] = enter
                fresh[last] += held
            for s in range(total):
                now[s] = fresh[s]
        for k in range(n):
            for s in range(first[k], first[k + 1]):
                now[s] *= like[k]
        every = now.sum()
        for s in range(total):
            now[s] /= every
            ahead[t, s] = now[s]
    back = np.ones(total)
    for t in range(m - 1, -1, -1):
        norm = 0.0
        for k in range(n):
            out[t, k] = 0.0
            for s in range(first[k], first[k + 1]):
                out[t, k] += ahead[t, s] * back[s]
            norm += out[t, k]
        for k in range(n):
            out[t, k] /= norm
        if t == 0:
            break
        _likelihood(scores, t, like)
        for k in range(n):
            onward = 0.0
            for j in range(n):
                onward += follow[k, j] * back[first[j]] * like[j]
            last = first[k + 1] - 1
            for s in range(first[k], last):
                fresh[s] = back[s + 1] * like[k]
            fresh[last] = back[last] * like[k] * go[k] + end[k] * onward
        every = fresh.sum()
        for s in range(total):
            back[s] = fresh[s] / every


@inner_kernel()
def _likelihood(scores, t, like):
    """Likelihoods (K,) of tick t up to a factor, exp(scores minus their maximum), into `like`."""
    top = scores[t, 0]
    for k in range(1, len(like)):
        top = max(top, scores[t, k])
    for k in range(len(like)):
        like[k] = np.exp(scores[t, k] - top)
