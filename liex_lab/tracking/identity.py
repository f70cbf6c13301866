"""Identity of several animals over a recording: which component of each frame is which animal.

A hidden Markov model over the assignments of N components to N animals (at most 24). The transition
cost of an assignment is the sum over the animals of the association's transition cost, the
Mahalanobis distance of the shift and bend of the joints between two frames; the emission cost is
that of the sizes, if the animals differ in it. Viterbi's path (Viterbi 1967) is the assignment over
the whole recording, and the forward pass from one end of a crossing to the other gives the
probability that its animals left it exchanged. RFID readings add to the emission cost; which animal
carries which tag is the map of least cost over the recording (`rfid`). Frames in which not all
animals are in view follow their neighbours.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from liex_lab.runtime.kernels import kernel
from liex_lab.tracking._association_kernels import transition_cost
from liex_lab.tracking.association import NONE, HypothesisAssociation
from liex_lab.tracking.observations import COLUMNS, OF_COMPONENTS, Array, Observations
from liex_lab.tracking.rfid import Readings
from liex_lab.tracking.smoother import TrackingParameters
from liex_lab.tracking.track import Crossing, Subject, Tracked, spans
from liex_lab.tracking.trust import MOST_ERROR, contradicted, finite_median

Slots = NDArray[np.int64]

UNCLEAR = 0.1  # probability of an exchange above which poses are not trusted
CERTAIN = 0.9  # least certainty for statistics per animal
_SIZE_SD = 0.15  # of the logarithm of an animal's pixels, from posture to posture
_GAP_S = 0.1  # time without all animals in view over which they are continued
_VELOCITY_S = 0.2  # time over which their velocity is measured
_STRETCH_SD = 0.04  # that of its mean over a stretch: 0.015 in virtual mice, with a margin
_PLACE_SHARE = 0.15  # standard deviation of a position beside another animal, lengths
_NO_TAIL = 1e6  # cost above which costs of an exchange grow logarithmically, nats
_MOST_NATS = 9.0  # of one frame
_NOISE_MM = 0.3  # distance of a body from the depth below which there is no better one
_MOST_MISFIT = np.log(2.0)  # of bodies in contact over that of free ones
_INDEPENDENT_S = 0.1  # time after which the size of an outline is another one
_UNCLEAR = 6.0  # difference of transition costs, nats, below which animals may be exchanged
_OFF = 2.0  # nats, of a reading whose tag is two half lengths beyond the antenna's range
_COVERED = 0.35  # hidden area, in animals, from which their poses are unknown
_ONE = 1.4  # usual sizes of an outline, above which it shows several animals
_JOIN_S = 0.5  # crossings nearer to each other are one
_HIDES = 9.0  # cost of an animal that was in view and is not, nats
_SIZES = 100  # frames over which the sizes of the animals of an ongoing recording are averaged


@dataclass(frozen=True)
class Identity:
    """The components of N animals in n frames.

    Attributes:
        slots: (n, N) component of each animal, `NONE` if it is not in view.
        crossings: in order of time.
        tags: the tag of each animal, "" if unknown; empty without readings.
        misfits: how the readings do not fit the animals' places.
        remarks: sentences on single readings.
    """

    slots: Slots
    crossings: tuple[Crossing, ...]
    tags: tuple[str, ...] = ()
    misfits: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()


def identify(
    observed: Sequence[Observations],
    subjects: Sequence[Subject],
    readings: Readings | None = None,
) -> Identity:
    """Assign the components of every frame to the animals.

    Args:
        observed: for each animal, the largest first, all frames measured with its body.
        subjects: the animals.
        readings: RFID readings; None without any.
    """
    n_animals = len(observed)
    known = observed[0].known[:, ::2]
    full = np.flatnonzero(known.all(axis=1))
    slots = np.full((len(known), n_animals), NONE, np.int64)
    states = np.array(list(permutations(range(n_animals))))
    crossings: tuple[Crossing, ...] = ()
    marked = Identity(slots, ())
    if len(full):
        # of all bodies: how smoothly each fits a component does not show whose component it is
        moves = np.min(
            [_moves(one[full], subject) for one, subject in zip(observed, subjects, strict=True)], 0
        )
        # cost (m - 1, S, S) of going from one assignment to another
        transition = moves[:, states[:, None, :], states[None, :, :]].sum(axis=-1)
        path, _ = viterbi(transition, np.zeros((len(full), len(states))))
        seconds, own = observed[0].seconds[full], _own_places(observed[0][full], states[path])
        for t in np.flatnonzero(np.diff(seconds) > _GAP_S).tolist():
            transition[t] = _passed(seconds, own, subjects[0], states[path], states, t, t + 1)
        bodies = np.stack([_misfit(one)[full] for one in observed])
        apart, weight = _independent(observed[0][full])
        shown = np.any([fitting(one[full], subjects[0].length_mm) for one in observed], axis=0)
        shown &= ~covering(observed[0][full], ~apart, None)[:, None]
        fits = _fits(bodies, apart, weight * shown.all(axis=1), states)
        path, _ = viterbi(transition, fits)
        size = np.log(np.maximum(observed[0].n_px[full, ::2], 1))
        sizes = fits + _sizes(size, bodies, weight * apart, states[path], states)
        path, _ = viterbi(transition, emission := sizes)
        if readings is not None:
            places = observed[0].centroid_mm[full, ::2, :2].astype(float)
            read = readings.costs(seconds, places, subjects[0].length_mm)
            path, emission, marked = _by_tags(readings, *read, transition, sizes, path, states)
        slots[full] = states[path]
        by = {"motion": np.zeros_like(sizes), "size": sizes, "rfid": emission}
        crossings = _crossings(observed[0], subjects[0], full, transition, by, path, states)
    for start, stop in _follow(observed, subjects[0].length_mm, slots, known):
        met = [one for one in crossings if one.start < stop and start < one.stop]
        first, last = (
            min([start, *(one.start for one in met)]),
            max([stop, *(one.stop for one in met)]),
        )
        unclear = Crossing(first, last, tuple(range(n_animals)), 0.5, "motion")
        others = [one for one in crossings if one not in met]
        crossings = tuple(sorted([*others, unclear], key=lambda one: one.start))
    return _by_bodies(observed, replace(marked, slots=slots, crossings=crossings))


def _by_bodies(observed: Sequence[Observations], identity: Identity) -> Identity:
    """The same animals, in the order of the bodies that explain them best over the recording."""
    paths = np.where(identity.slots == NONE, NONE, 2 * identity.slots).T
    cost = np.array(
        [
            [finite_median(one.along(one.residual_mm, path), np.inf) for path in paths]
            for one in observed
        ]
    )
    if not np.isfinite(cost).all():
        return identity
    bodies, order = linear_sum_assignment(cost)
    if cost[bodies, order].sum() >= cost.trace():
        return identity
    place = np.argsort(order)
    return replace(
        identity,
        slots=identity.slots[:, order],
        crossings=tuple(
            replace(one, animals=tuple(sorted(place[[*one.animals]].tolist())))
            for one in identity.crossings
        ),
        tags=tuple(identity.tags[k] for k in order) if identity.tags else (),
    )


def _by_tags(
    readings: Readings,
    tag: Slots,
    row: Slots,
    cost: Array,
    transition: Array,
    sizes: Array,
    path: Slots,
    states: Slots,
) -> tuple[Slots, Array, Identity]:
    """The path (m,) and the emission cost (m, S) with readings, and which animal has which tag.

    Readings that fit no animal in more than half of the cases are not used.

    Args:
        readings: the readings.
        tag: (k,) number of the tag of each reading near a frame.
        row: (k,) the frame.
        cost: (k, N) cost if the animal of each component carries the tag.
        transition: (m - 1, S, S) cost.
        sizes: (m, S) emission cost without readings.
        path: (m,) the path without readings.
        states: (S, N) the assignments.
    """
    reading = np.arange(len(tag))[:, None]
    n_animals = states.shape[1]
    found = []
    for carriers in permutations(range(n_animals), len(readings.tags)):
        emission = sizes.copy()
        np.add.at(emission, row, cost[reading, states[:, np.array(carriers)[tag]].T])
        found.append((*viterbi(transition, emission), emission, carriers))
    best, _, emission, carriers = min(found, key=lambda one: one[1])
    of_animals = cost[reading, states[best][row]]  # (k, N)
    totals = [of_animals[reading[:, 0], np.array(one[3])[tag]].sum() for one in found]
    certain = 1.0 / np.exp(min(totals) - np.array(totals)).sum()
    is_off = of_animals[reading[:, 0], np.array(carriers)[tag]] > _OFF
    off = f"at {is_off.sum()} of {len(tag)} RFID readings the animal is not at the antenna"
    remarks = (*readings.remarks, *([off] if is_off.any() else []))
    identity = Identity(states[best], (), remarks=remarks)
    if not len(tag) or is_off.mean() > 0.5 or certain < CERTAIN:
        why = off if is_off.any() else f"{len(tag)} RFID readings do not distinguish the animals"
        advice = "check animal.rfid.antennas and offset_s; the tags were not used"
        return path, sizes, replace(identity, misfits=(f"{why}: {advice}",))
    names = dict(zip(carriers, readings.tags, strict=True))
    tags = tuple(names.get(k, "") for k in range(n_animals))
    return best, emission, replace(identity, tags=tags)


def own_observations(
    observed: Observations, slots: Slots, usual_px: float | None = None
) -> Observations:
    """The observations of one animal: its component's two hypotheses first, and no others.

    Args:
        observed: hypotheses (n, 2 N) of all components with its body.
        slots: (n,) its component, `NONE` if it is not in view.
        usual_px: of an animal; None takes it from the frames in which all stand apart.
    """
    own = Observations.empty(observed.skeleton, observed.times_ns)
    rows = np.flatnonzero(slots != NONE)
    for name in COLUMNS:
        values, out = getattr(observed, name), getattr(own, name)
        if name not in OF_COMPONENTS:
            out[:] = values
        else:
            for h in range(2):
                out[rows, h] = values[rows, 2 * slots[rows] + h]
    touching = np.isfinite(observed.objects[..., 0]).sum(axis=1) < observed.score.shape[1] // 2
    own.behind[touching, :2] = covering(observed, touching, usual_px)[touching, None]
    # of an outline that a neighbour cuts, the metric does not know which end is the head
    touching &= own.known[:, 0] & own.known[:, 1]
    for values in (own.score, own.error_mm):
        values[touching, :2] = values[touching, :2].min(axis=1, keepdims=True)
    return own


def covering(
    observed: Observations, touching: NDArray[np.bool_], usual_px: float | None
) -> NDArray[np.bool_]:
    """Whether (n,) touching animals cover each other: all in view show too little together."""
    known = observed.known[:, ::2]
    shown = np.where(known, observed.n_px[:, ::2], 0).sum(axis=1)
    apart = known.all(axis=1) & ~touching
    usual = usual_px or (np.median(shown[apart]) / known.shape[1] if apart.any() else np.inf)
    return np.asarray(touching & (shown < (known.sum(axis=1) - _COVERED) * usual))


def fitting(observed: Observations, length_mm: float) -> NDArray[np.bool_]:
    """Whether (n, N) each component has a pose that the depth image does not contradict."""
    found = observed.known[:, ::2]
    for k, here in enumerate(found.T):
        here &= ~contradicted(observed, np.full(len(here), 2 * k), length_mm)
    return found


def covers(own: Sequence[Observations], length_mm: float) -> NDArray[np.bool_]:
    """Whether (N, n) animals may lie over another one, so that their poses may be that one's.

    They touch something of about an animal's size; the other one has no pose that fits the depth,
    and where it last had one, or has the next, is within a body length.

    Args:
        own: the observations (n) of each animal, see `own_observations`.
        length_mm: of an animal.
    """
    fits = np.stack([fitting(one, length_mm)[:, 0] for one in own])
    touching = np.isfinite(own[0].objects[..., 0]).sum(axis=1) < len(own)
    here = np.stack([one.centroid_mm[:, 0, :2] for one in own])
    frames = np.arange(fits.shape[1])
    out = np.zeros(fits.shape, np.bool_)
    for shown, place in zip(fits, here, strict=True):
        last = np.maximum.accumulate(np.where(shown, frames, 0))
        after = np.minimum.accumulate(np.where(shown, frames, frames[-1])[::-1])[::-1]
        for then in (last, after):
            near = np.linalg.norm(here - place[then], axis=-1) < length_mm
            out |= touching & ~shown & near
    return out & fits


def flag_unclear(tracked: Tracked, covering: NDArray[np.bool_]) -> None:
    """Flag the poses of a track in place: in crossings unclear where it is not clear whose they are
    or which end is the head; doubtful in those that begin before the animal stood apart.

    Args:
        tracked: the track.
        covering: (n,) where it may lie over another animal, see `covers`; unclear unless reviewed.
    """
    first = int(np.argmax(tracked.track.posed))
    covering = covering.copy()
    for one in tracked.crossings or ():
        covering[one.start : one.stop] &= not one.reviewed_by
    flags = tracked.track.flag
    flags[(flags == "") & covering] = "unclear"
    for one in tracked.crossings or ():
        flag = flags[one.start : one.stop]
        if one.start <= first:
            flag[flag == ""] = "doubtful"
        turned = tracked.track.p_flip[one.start : one.stop] > UNCLEAR
        flag[(flag == "") & (turned | (one.p_swap > UNCLEAR))] = "unclear"


def doubt(crossings: Sequence[Crossing]) -> str:
    """A sentence if an animal may have become another one over a recording; "" if that is clear.

    Args:
        crossings: in which the animal takes part.
    """
    certain = float(np.prod([1.0 - one.p_swap for one in crossings]))
    if certain >= CERTAIN:
        return ""
    n = sum(one.p_swap > (1.0 - CERTAIN) / len(crossings) for one in crossings)
    return (
        f"the animals may have been exchanged at {n} of {len(crossings)} crossings: that this is "
        f"the same animal throughout is {certain:.0%} certain, too little for statistics per animal"
    )


def _moves(observed: Observations, subject: Subject) -> Array:
    """Cost (m - 1, N, N) of one animal's way from each component to each of the next frame.

    One animal may dart; two that dart to each other's places are not to be expected.
    """
    tuning = replace(TrackingParameters.of(subject.skeleton.name).chain, tail=_NO_TAIL)
    chain = HypothesisAssociation(subject.skeleton, subject.length_mm, tuning, several=True)
    n, n_hypotheses = observed.score.shape
    error = observed.error_mm.copy()
    for h in range(n_hypotheses):  # poses of animals that cover each other may be anywhere on them
        wrong = contradicted(observed, np.full(n, h), subject.length_mm)
        error[wrong, h] = np.maximum(error[wrong, h], MOST_ERROR * subject.length_mm)
    out = np.empty((max(n - 1, 0), *(n_hypotheses // 2,) * 2))
    _transitions(observed.seconds, chain.joints(observed), error, chain.costs, out)
    return out


@kernel()
def _transitions(seconds, joints, error, costs, out):
    """Fill out (m - 1, N, N) with the least transition cost between the poses of components."""
    for t in range(out.shape[0]):
        dt = seconds[t + 1] - seconds[t]
        for i in range(out.shape[1]):
            for j in range(out.shape[2]):
                out[t, i, j] = np.inf
                for g in range(2 * i, 2 * i + 2):
                    for h in range(2 * j, 2 * j + 2):
                        if np.isfinite(error[t, g]) and np.isfinite(error[t + 1, h]):
                            cost = transition_cost(
                                joints[t, g],
                                joints[t + 1, h],
                                error[t, g],
                                error[t + 1, h],
                                dt,
                                costs,
                            )
                            out[t, i, j] = min(out[t, i, j], cost)


def _passed(
    seconds: Array, own: Array, subject: Subject, slots: Slots, states: Slots, last: int, first: int
) -> Array:
    """Cost (S, S) of going from each assignment in frame `last` to each in a later one, `first`, by
    the motion before and after.

    Both sides are continued by an integrated Ornstein-Uhlenbeck process, the smoother's model of
    motion: an animal that walks into another one is likely to walk on.

    Args:
        seconds: (m,) s.
        own: (m, N, 2) mm, positions animal by animal.
        subject: one of the animals.
        slots: (m, N) the component of each.
        states: (S, N) the assignments.
        last: frame before.
        first: frame after.
    """
    motion = TrackingParameters.of(subject.skeleton.name).motion
    fade, passed = motion.position_decay_s, seconds[first] - seconds[last]
    left = fade * (1.0 - np.exp(-passed / fade))
    drift = passed - 2.0 * left + 0.5 * fade * (1.0 - np.exp(-2.0 * passed / fade))
    variance = motion.position_variance[0] * subject.length_mm**2 * fade**2 * drift
    ahead = own[last] + left * _velocity(own, seconds, last, -1)
    back = own[first] - left * _velocity(own, seconds, first, 1)
    sd2 = variance + (_PLACE_SHARE * subject.length_mm) ** 2
    # cost (N, N) of the animal of each component becoming that of another one
    cost = np.empty((len(slots[last]),) * 2)
    off = (ahead[:, None] - own[first]) ** 2 + (own[last][:, None] - back) ** 2
    cost[np.ix_(slots[last], slots[first])] = 0.25 * off.sum(axis=-1) / sd2
    return np.asarray(cost[states[:, None, :], states[None, :, :]].sum(axis=-1))


def _own_places(observed: Observations, slots: Slots) -> Array:
    """Positions (m, N, 2) mm of the animals, whose components are slots (m, N)."""
    return np.take_along_axis(
        observed.centroid_mm[:, ::2, :2].astype(float), slots[..., None], axis=1
    )


def _velocity(own: Array, seconds: Array, t: int, side: int) -> Array:
    """Velocity (N, 2) mm/s of animals at positions (m, N, 2), from the frames on one side of t."""
    rows = np.flatnonzero(side * (seconds - seconds[t]) >= 0.0)
    rows = rows[np.abs(seconds[rows] - seconds[t]) < _VELOCITY_S]
    since = seconds[rows] - seconds[rows].mean()
    return np.asarray(np.tensordot(since, own[rows], 1) / max(float(since @ since), 1e-9))


def _misfit(observed: Observations) -> Array:
    """The logarithm (n, N) of the distance of an animal's body from the depth of components, mm."""
    return np.log(np.maximum(np.nan_to_num(observed.residual_mm[:, ::2], nan=1.0), _NOISE_MM))


def _independent(observed: Observations) -> tuple[NDArray[np.bool_], Array]:
    """Whether (m,) the animals stand apart, and the weight (m,) of each frame's evidence.

    One stretch, apart or in contact, errs alike throughout, by postures and places, so that its
    evidence has a limit: its n independent frames weigh n / (1 + n t^2 / s^2).
    """
    n_animals = observed.score.shape[1] // 2
    apart = np.isfinite(observed.objects[..., 0]).sum(axis=1) >= n_animals
    step_s = np.diff(observed.seconds, prepend=observed.seconds[0] - _INDEPENDENT_S)
    weight = np.minimum(step_s / _INDEPENDENT_S, 1.0)
    for start, stop in (*spans(apart), *spans(~apart)):
        n = float(weight[start:stop].sum())
        weight[start:stop] /= 1.0 + n * (_STRETCH_SD / _SIZE_SD) ** 2
    return apart, weight


def _fits(bodies: Array, apart: NDArray[np.bool_], weight: Array, states: Slots) -> Array:
    """Cost (m, S) of each assignment by the bodies of the animals, nats.

    It is the sum of the logarithms of their distances from the depth, as of exponentially
    distributed ones. Where no assignment fits about as well as apart, outlines were cut in a wrong
    place, and show nothing.

    Args:
        bodies: (N, m, N) misfit of each animal's body and each component, see `_misfit`.
        apart: (m,) whether the animals stand apart.
        weight: (m,) weight of each frame.
        states: (S, N) the assignments.
    """
    cost = bodies[np.arange(len(bodies)), :, states].sum(axis=1).T
    least = cost.min(axis=1)
    usual = finite_median(least[apart], -np.inf)
    right = least < usual + len(bodies) * _MOST_MISFIT
    return np.asarray((weight * right)[:, None] * np.minimum(cost - least[:, None], _MOST_NATS))


def _sizes(size: Array, bodies: Array, weight: Array, path: Slots, states: Slots) -> Array:
    """Cost (m, S) of each assignment by the sizes of outlines, nats.

    The usual sizes u of the animals are the means over the stretches in which all stand apart, of
    animals with one body the largest first in each. Of sizes that differ little that order is
    chance, so that u is shrunk towards their mean by sqrt(1 - t^2 / (2 var u)):

        cost = w sum_k (x_k - u_k)^2 / (2 s^2).

    Args:
        size: (m, N) logarithm of the pixels of each component.
        bodies: (N, m, N) misfit of each animal's body and each component, see `_misfit`.
        weight: (m,) weight w of each frame, 0 where the animals do not stand apart.
        path: (m, N) an assignment of the components.
        states: (S, N) the assignments.
    """
    size = size - size.mean(axis=1, keepdims=True)
    own = np.take_along_axis(size, path, axis=1)
    alike = {tuple(np.flatnonzero((bodies == one).all(axis=(1, 2)))) for one in bodies}
    usual = np.zeros(states.shape[1])
    for start, stop in spans(weight > 0.0):
        mean = own[start:stop].mean(axis=0)
        for some in map(list, alike):
            usual[some] += weight[start:stop].sum() * np.sort(mean[some])[::-1]
    usual /= max(float(weight.sum()), 1e-9)
    for some in map(list, alike):
        off = usual[some] - usual[some].mean()
        chance = 0.5 * _STRETCH_SD**2 / max(float(off.var()), 1e-9)
        usual[some] -= off * (1.0 - np.sqrt(max(0.0, 1.0 - chance)))
    off = ((size[:, states] - usual) / _SIZE_SD) ** 2
    return np.asarray(weight[:, None] * np.minimum(0.5 * off.sum(axis=-1), _MOST_NATS))


def viterbi(transition: Array, emission: Array) -> tuple[Slots, float]:
    """The path (m,) of least cost through the assignments, and its cost."""
    parent = np.zeros(emission.shape, np.int64)
    cost = emission[0]
    for t, step in enumerate(transition, 1):
        through = cost[:, None] + step
        parent[t] = through.argmin(axis=0)
        cost = through.min(axis=0) + emission[t]
    path = np.empty(len(emission), np.int64)
    path[-1] = cost.argmin()
    for t in range(len(path) - 1, 0, -1):
        path[t - 1] = parent[t, path[t]]
    return path, float(cost.min())


def _crossings(
    observed: Observations,
    subject: Subject,
    full: Slots,
    transition: Array,
    by: Mapping[str, Array],
    path: Slots,
    states: Slots,
) -> tuple[Crossing, ...]:
    """The stretches in which another assignment is possible, with its probability.

    `by` are emission costs (m, S), each with one more kind of evidence, by its name.
    """
    seconds, own = observed.seconds[full], _own_places(observed[full], states[path])
    steps = np.arange(len(full) - 1)
    others = transition[steps, path[:-1]] - transition[steps, path[:-1], path[1:]][:, None]
    others[steps, path[1:]] = np.inf
    unclear = others.min(axis=1) < _UNCLEAR
    unclear |= np.isfinite(observed.objects[full[1:], :, 0]).sum(axis=1) < states.shape[1]
    if not unclear.any():
        return ()
    at = np.flatnonzero(unclear)
    apart = np.flatnonzero(seconds[at[1:]] - seconds[at[:-1] + 1] > _JOIN_S)
    begins = at[np.append(0, apart + 1)]
    ends = at[np.append(apart, len(at) - 1)] + 1
    emission = np.stack([*by.values()], axis=1)  # (m, K, S)
    later = np.stack([_backward(transition, one) for one in by.values()], axis=1)
    later[:, 0] = 0.0  # motion is that of the crossing
    found = []
    for begin, end in zip(begins, ends, strict=True):
        cost = np.full((len(by), len(states)), np.inf)
        cost[:, path[begin]] = 0.0
        for t in range(begin, end):
            cost = -np.logaddexp.reduce(-(cost[..., None] + transition[t]), axis=1)
            cost += emission[t + 1]
        cost += later[end]
        if (np.diff(seconds[begin : end + 1]) <= _GAP_S).all():  # else it is in the transitions
            on = _passed(seconds, own, subject, states[path], states, begin, end)[path[begin]]
            cost += np.minimum(on - on.min(), _MOST_NATS)
        p = np.exp(cost.min(axis=1, keepdims=True) - cost)
        p_swaps = 1.0 - p[:, path[end]] / p.sum(axis=1)
        p_swap = p_swaps[-1]
        enough = np.flatnonzero(p_swaps <= max(2.0 * p_swap, 0.02))
        decided_by = [*by][enough[0]]
        # of each animal, and of those of the likeliest exchange at least
        exchanged = p[-1] @ (states != states[path[end]]) / p[-1].sum()
        second = states[np.argsort(cost[-1])[:2]]
        some = (exchanged > 0.1 * p_swap) | (second[0] != second[1])
        animals = tuple(int(k) for k in np.flatnonzero(some))
        found.append(
            Crossing(int(full[begin]), int(full[end]) + 1, animals, float(p_swap), decided_by)
        )
    return tuple(found)


def _backward(transition: Array, emission: Array) -> Array:
    """Cost (m, S) of all that follows each assignment."""
    later = np.zeros(emission.shape)
    for t in range(len(transition) - 1, -1, -1):
        after = later[t + 1] + emission[t + 1]
        later[t] = -np.logaddexp.reduce(-(transition[t] + after), axis=1)
        later[t] -= later[t].min()
    return later


def _follow(
    every: Sequence[Observations], length_mm: float, slots: Slots, known: NDArray[np.bool_]
) -> Iterator[tuple[int, int]]:
    """Assign the components of frames that do not show all animals, in place, frame by frame from
    the nearest frame that does.

    A component belongs to the animal of the least cost (d / s)^2 + 2 log s + 2 log r, d: its
    distance from where that was last in view, s: a standard deviation that grows with the time
    since, r: the distance of that animal's body from the depth, of which nothing follows where the
    component may cover another animal.

    Yields:
        The spans whose two ends do not agree.
    """
    observed, misfit = every[0], np.stack([_misfit(one) for one in every], axis=1)
    seconds, places = observed.seconds, observed.centroid_mm[:, ::2].astype(float)
    full = np.flatnonzero((slots != NONE).all(axis=1))
    usual_px = np.median(observed.n_px[full, ::2]) if len(full) else 0.0
    for start, stop in spans(np.asarray(~known.all(axis=1))) if len(full) else ():
        ways = np.full((2, stop - start, slots.shape[1]), NONE)
        near = [*full[full < start][-1:], -1][0], [*full[full >= stop][:1], -1][0]
        for way, first, step in zip(ways, near, (1, -1), strict=True):
            last, last_s = places[first, slots[first]], np.full(len(slots[first]), seconds[first])
            for t in range(start, stop)[::step] if first >= 0 else ():
                there = np.flatnonzero(known[t])
                sd = length_mm * (_PLACE_SHARE + np.abs(seconds[t] - last_s))[:, None]
                away = last[:, None] - places[t, there]
                # raised bodies fit wrongly
                covers = (np.linalg.norm(away[..., :2], axis=-1) < length_mm).sum(axis=0) > 1
                fit = np.where(covers, 0.0, misfit[t][:, there])
                cost = (np.linalg.norm(away, axis=-1) / sd) ** 2 + 2.0 * (np.log(sd) + fit)
                for _ in there:
                    animal, one = np.unravel_index(np.argmin(cost), cost.shape)
                    way[t - start, animal] = there[one]
                    last[animal], last_s[animal] = places[t, there[one]], seconds[t]
                    cost[animal] = np.inf
                    cost[:, one] = np.inf
        since, until = (np.abs(seconds[start:stop] - seconds[row]) for row in near)
        from_before = since <= until if min(near) >= 0 else np.full(len(since), near[0] >= 0)
        slots[start:stop] = np.where(from_before[:, None], *ways)
        # outlines of several animals are those of a contact, which has a probability of its own
        one_each = (observed.n_px[start:stop] <= _ONE * usual_px).all()
        if min(near) >= 0 and one_each and (ways[0] != ways[1]).any():
            yield start, stop


class OnlineIdentity:
    """Assigns the components of an ongoing recording's frames to animals, from the past alone.

    The forward pass of the model of `identify`, from the first frame on in which all stand apart.
    An animal that was out of view is likely to be near where it was last in view. What is likeliest
    when a crossing has been over for half a second is taken as certain from there on.

    Attributes:
        p_swap: probability that animals have been exchanged in the present crossing, 0 without one.
        crossings: that of each earlier crossing, at its end.
        covering: (N,) whether each animal may lie over another one, see `covers`.

    Args:
        subjects: the animals, the largest first.
    """

    def __init__(self, subjects: Sequence[Subject]) -> None:
        n_animals = len(subjects)
        self._subject = subjects[0]
        # the first one keeps the order
        self._states = np.array(list(permutations(range(n_animals))))
        self._cost = np.zeros(len(self._states))
        # of each animal, in their order
        self._last = Observations.empty(self._subject.skeleton, np.zeros(1, np.int64), n_animals)
        self._last_s = np.full(n_animals, -np.inf)
        self._usual_px = 1.0
        self._until_s = np.inf  # of the present crossing, or until all stand apart
        self.p_swap = 0.0
        self.crossings: list[float] = []
        self.covering = np.zeros(n_animals, np.bool_)

    def add(self, observed: Sequence[Observations]) -> list[Observations]:
        """The observations of each animal in the next frame, as from `own_observations`.

        Args:
            observed: for each animal, the frame measured with its body.
        """
        first, n_animals = observed[0], len(observed)
        if n_animals == 1:  # it may be either component
            return list(observed)
        now_s, known = 1e-9 * float(first.times_ns[0]), first.known[0, ::2]
        moves = _moves(Observations.join([self._last, first]), self._subject)[0]
        last, here = (one.centroid_mm[0, ::2, :2].astype(float) for one in (self._last, first))
        away = (now_s - self._last_s)[:, None]
        off = np.linalg.norm(last[:, None] - here, axis=-1) / (_PLACE_SHARE + away)
        moves = np.where(away > _GAP_S, 0.5 * (off / self._subject.length_mm) ** 2, moves)
        moves[~np.isfinite(moves)] = 0.0
        moves[:, ~known] = np.where(away > _GAP_S, 0.0, _HIDES)
        transition = moves[self._states[:, None], self._states].sum(axis=-1)
        # components that are not there are exchangeable
        absent = np.argsort(self._states, axis=1)[:, ~known]
        transition[:, (np.diff(absent, axis=1) < 0).any(axis=1)] = np.inf
        cost = -np.logaddexp.reduce(-(self._cost[:, None] + transition), axis=0)
        others = np.delete(transition[0], cost.argmin()) - transition[0, cost.argmin()]
        touching = np.isfinite(first.objects[0, :, 0]).sum() < known.sum()
        begins = bool(self._until_s == np.inf and known.all() and not touching)
        clear = begins or bool(not touching and others.min() > _UNCLEAR)
        misfit = np.concatenate([*map(_misfit, observed)])
        fit = misfit[np.arange(n_animals), self._states].sum(axis=1)
        if begins:  # of one body, the largest first
            cost = fit + 1e-6 * first.n_px[0, ::2][self._states] @ np.arange(n_animals)
            self._usual_px, self._until_s = float(first.n_px[0, ::2].mean()), -np.inf
        elif clear and known.all():
            weight = min(float(away.min()) / _INDEPENDENT_S, 1.0)
            cost += weight * np.minimum(fit - fit.min(), _MOST_NATS)
        best = self._states[cost.argmin()]
        self.p_swap = 1.0 - 1.0 / float(np.exp(cost.min() - cost).sum())
        # from here on in the order of the likeliest assignment
        order = np.argsort(best)[self._states]
        self._cost[(order[:, None] == self._states).all(axis=2).argmax(axis=1)] = cost
        if not clear:
            self._until_s = max(self._until_s, now_s + _JOIN_S)
        elif now_s > self._until_s:
            self.crossings += [self.p_swap] if np.isfinite(self._until_s) else []
            self._until_s, self.p_swap = -np.inf, 0.0
            self._cost[1:] = np.inf
            self._usual_px += (first.n_px[0, ::2][known].mean() - self._usual_px) / _SIZES
        shown = np.flatnonzero(known[best])
        self._last_s[shown] = now_s
        to, of = ((2 * k[:, None] + (0, 1)).ravel() for k in (shown, best[shown]))
        self._last.times_ns[:] = first.times_ns
        for name in OF_COMPONENTS:
            getattr(self._last, name)[:, to] = getattr(first, name)[:, of]
        slots = np.where(known[best], best, NONE)
        own = [
            own_observations(one, slots[k : k + 1], self._usual_px)
            for k, one in enumerate(observed)
        ]
        before = [own_observations(self._last, np.array([k])) for k in range(n_animals)]
        both = [Observations.join(pair) for pair in zip(before, own, strict=True)]
        self.covering = covers(both, self._subject.length_mm)[:, 1]
        return own
