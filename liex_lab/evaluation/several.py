"""Scores of several animals against truth: identity, poses and interactions.

Similarity of a measured and a true animal in a frame is s = 1 - d / 30 mm, at least 0, of their
mean joint distance d; a match at threshold a has s >= a, so that 0.5 is 15 mm. HOTA is the mean of

    sqrt(DetA A),  DetA = TP / (TP + FN + FP),  A = 1/TP sum_c TPA(c) / (TPA + FNA + FPA)(c)

over a = 0.05, 0.10, ... 0.95 (Luiten et al. 2021, IJCV 129:548), IDF1 = 2 IDTP / (2 IDTP + IDFP +
IDFN) with one identity per animal over the whole recording, at 15 mm (Ristani et al. 2016). Both
are those of TrackEval. Counts of recordings add up, as of one sequence with identities of its own.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from liex_lab.actions.vocabulary import INTERACTIONS
from liex_lab.arrays import Array, Mask

Counts = dict[str, float]
Deed = tuple[int, int, str, int, int]  # agent, target (-1: none), action, start and stop frame

_ZERO_MM = 30.0  # distance of similarity 0
_ALPHAS = np.arange(0.05, 0.99, 0.05)
_HALF = 0.5 - 1e-9
_BINS = (0.0, 0.1, 0.3)  # of stated probabilities, from each on
_SWAP_S = 0.5  # changes of several individuals within this time are one swap
SEVERAL_PROTOCOL = (
    "Rendered mice or fish that interact, each recording measured as `liex run` does and its "
    "tables read back. idf1, hota: as TrackEval computes them, similarity 1 - d / 30 mm of the "
    "mean joint distance d, so that 15 mm is a match for idf1; every animal counts in every frame. "
    "swaps: moments at which a measured individual goes over from one true animal to another "
    "(within 15 mm, by assignment in each frame, in which it keeps its animal while that is within "
    "15 mm, as in CLEAR MOT, Bernardin and Stiefelhagen 2008; changes within 0.5 s are one), "
    "trusted_swaps: those between trusted poses. "
    "swaps_per_contact_hour: swaps over the hours in which the skins of a pair are within 10 mm, "
    "summed over pairs. joint_error_apart_mm, joint_error_contact_mm: mean over joints and frames "
    "of the distance to the nearest true animal by assignment, capped at 65 mm, where that animal "
    "touches no other, and where it does. found: share of animals and frames matched within 15 mm. "
    "abstained: share of animals and frames without a trusted pose, apart from huddles. "
    "crossings: stretches in which animals may have been exchanged, by the tables, "
    "unsaid_swaps: those of a probability below 0.1 in which they were. swap_calibration: mean "
    "over crossings of the difference between stated and true share of exchanges, in bins of "
    "probability from 0, 0.1 and 0.3 on. frames_per_s: of the whole run. Interactions, f1: of "
    "frames and ordered pairs, the harmonic mean of precision and "
    "recall of each action, and their mean (macro_f1) over the actions that happened. Truth of "
    "contact and isolated are the distances of the rendered skins; of other actions it is the "
    "script of the animals, which mice on real courses have not, so that only these two count. "
    "direction: of the frames in which an action is found for the right pair, or for the same pair "
    "the other way round, the share the right way. true: from true joints, measured: the "
    "tables' own, null if these have fewer than two animals. Lengths are those of mice; for fish "
    "those of matches and the cap are 0.27 times as long, a match is within 4 mm, and those of "
    "contact and interactions are of the plan, contact within 3 mm."
)


def summed(counts: Iterable[Mapping[str, float]]) -> Counts:
    """The sum of the counts of several recordings; counts that are missing are 0."""
    total: Counts = defaultdict(float)
    for one in counts:
        for name, value in one.items():
            total[name] += value
    return total


def track_counts(distance_mm: Array, time_s: Array) -> Counts:
    """Counts of matches and swaps of one recording, for `track_figures`.

    Args:
        distance_mm: (n, T, K) mean joint distance of true animal and measured individual; NaN
            where either is absent.
        time_s: (n,) s.
    """
    similarity = np.nan_to_num(np.maximum(0.0, 1.0 - distance_mm / _ZERO_MM))
    known = np.isfinite(distance_mm)
    n_true, n_own = len(time_s) * np.ones(distance_mm.shape[1]), known.any(axis=1).sum(axis=0)
    together = similarity.sum(axis=1, keepdims=True) + similarity.sum(axis=2, keepdims=True)
    union = np.maximum(together - similarity, 1e-12)
    common = (similarity / union).sum(axis=0)
    every = n_true[:, None] + n_own
    alignment = common / (every - common)
    found = summed([{"n_true": n_true.sum(), "n_own": n_own.sum(), "n_frames": len(time_s)}])
    matches = np.zeros((len(_ALPHAS), *distance_mm.shape[1:]))
    holds: dict[int, int] = {}  # individual -> the true animal that it was on
    last_s = -np.inf
    for moment, now in zip(time_s, similarity, strict=True):
        rows, columns = linear_sum_assignment(-alignment * now)
        matches[:, rows, columns] += now[rows, columns] >= _ALPHAS[:, None] - 1e-9
        stays = np.zeros(now.shape)
        stays[[*holds.values()], [*holds]] = len(now)
        rows, columns = linear_sum_assignment(-np.where(now >= _HALF, now + stays, 0.0))
        on = {k: t for t, k in zip(rows.tolist(), columns.tolist(), strict=True) if now[t, k] > 0.5}
        if any(holds.get(k, t) != t for k, t in on.items()):
            found["swaps"] += int(moment - last_s > _SWAP_S)
            last_s = float(moment)
        holds |= on
    counts = (similarity >= _HALF).sum(axis=0)
    found["idtp"] = int(counts[linear_sum_assignment(-counts)].sum())
    shared = matches / np.maximum(every - matches, 1.0)
    for k in range(len(_ALPHAS)):
        found[f"tp{k}"] = int(matches[k].sum())
        found[f"associated{k}"] = float((matches[k] * shared[k]).sum())
    return found


def track_figures(counts: Mapping[str, float]) -> dict[str, float | None]:
    """IDF1, HOTA and the share of animals found, of summed `track_counts`."""
    both = counts["n_true"] + counts["n_own"]
    hota = []
    for k in range(len(_ALPHAS)):
        tp = counts[f"tp{k}"]
        hota.append(np.sqrt(tp / max(both - tp, 1.0) * counts[f"associated{k}"] / max(tp, 1.0)))
    half = int(np.abs(_ALPHAS - 0.5).argmin())
    return {
        "idf1": 2.0 * counts["idtp"] / both if both else None,
        "hota": float(np.mean(hota)),
        "found": counts[f"tp{half}"] / counts["n_true"] if counts["n_true"] else None,
    }


def crossing_counts(distance_mm: Array, crossings: Array) -> Counts:
    """Counts of crossings and of true exchanges in them, of one recording.

    Args:
        distance_mm: (n, T, K), see `track_counts`.
        crossings: (k, 3) first frame, frame after the last, stated probability of an exchange.
    """
    found = summed([])
    near = np.nan_to_num(distance_mm, nan=np.inf) <= _ZERO_MM / 2.0
    on = np.where(near.any(axis=1), near.argmax(axis=1), -1)  # (n, K) the true animal
    for start, stop, p in crossings:
        before, after = (
            [next((t for t in row if t >= 0), -1) for row in part.T]
            for part in (on[: int(start)][::-1], on[int(stop) :])
        )
        known = [(a, b) for a, b in zip(before, after, strict=True) if min(a, b) >= 0]
        if known:
            exchanged = any(a != b for a, b in known)
            k = int(np.searchsorted(_BINS, p, side="right"))
            found["crossings"] += 1
            found[f"p{k}"] += float(p)
            found[f"exchanged{k}"] += exchanged
    return found


def crossing_figures(counts: Mapping[str, float]) -> dict[str, float | None]:
    """Calibration of the probability of exchanges, of summed `crossing_counts`."""
    n = counts.get("crossings", 0.0)
    bins = range(1, len(_BINS) + 1)
    off = sum(abs(counts.get(f"p{k}", 0.0) - counts.get(f"exchanged{k}", 0.0)) for k in bins)
    return {
        "crossings": int(n),
        "unsaid_swaps": int(counts.get("exchanged1", 0.0)),
        "swap_calibration": off / n if n else None,
    }


def pose_counts(
    distance_mm: Array, touching: Mask, trusted: Mask, resting: Mask, most_mm: float
) -> Counts:
    """Counts of errors apart and in contact, and of abstentions, of one recording.

    Args:
        distance_mm: (n, T, K), see `track_counts`.
        touching: (n, T) whether a true animal touches another.
        trusted: (n, K) whether an individual has a trusted pose.
        resting: (n,) frames of a huddle, which do not count as abstentions.
        most_mm: cap of an error.
    """
    found = summed([])
    cost = np.minimum(np.nan_to_num(distance_mm, nan=1e6), most_mm)
    for now, near, there in zip(cost, touching, np.isfinite(distance_mm), strict=True):
        for t, k in zip(*linear_sum_assignment(now), strict=True):
            where = "contact" if near[t] else "apart"
            found[f"{where}_mm"] += float(now[t, k]) * bool(there[t, k])
            found[f"n_{where}"] += int(there[t, k])
    n_true = distance_mm.shape[1]
    missing = np.maximum(n_true - trusted.sum(axis=1), 0)[~resting]
    found["abstained"], found["n_asked"] = int(missing.sum()), n_true * len(missing)
    return found


def deed_counts(truth: Sequence[Deed], found: Sequence[Deed], n_frames: int) -> Counts:
    """Frames of true and found deeds of one recording, for `deed_figures`.

    A mutual action counts for both orders of its pair; its direction is not scored.
    """
    masks: dict[tuple[int, int, str], list[Mask]] = {}
    for which, deeds in enumerate((truth, found)):
        for agent, target, word, start, stop in deeds:
            pairs = [(agent, target), (target, agent)][: 1 + INTERACTIONS[word].mutual]
            for pair in pairs:
                empty = [np.zeros(n_frames, np.bool_), np.zeros(n_frames, np.bool_)]
                masks.setdefault((*pair, word), empty)[which][start:stop] = True
    counts = summed([])
    for (agent, target, word), (true, own) in masks.items():
        counts[f"{word} tp"] += int((true & own).sum())
        counts[f"{word} fp"] += int((own & ~true).sum())
        counts[f"{word} fn"] += int((true & ~own).sum())
        back = masks.get((target, agent, word))
        if back and target >= 0 and not INTERACTIONS[word].mutual:
            counts["turned"] += int((own & ~true & back[0] & ~back[1]).sum())
        if target >= 0 and not INTERACTIONS[word].mutual:
            counts["right"] += int((true & own).sum())
    return counts


def deed_figures(counts: Mapping[str, float]) -> dict[str, Any]:
    """F1 of each action, their mean, and the share of right directions, of `deed_counts`."""
    f1 = {}
    for word in INTERACTIONS:
        tp, fp, fn = (counts.get(f"{word} {kind}", 0.0) for kind in ("tp", "fp", "fn"))
        if tp + fn:
            f1[word] = 2.0 * tp / (2.0 * tp + fp + fn)
    right = counts.get("right", 0.0)
    directed = right + counts.get("turned", 0.0)
    return {
        "macro_f1": float(np.mean([*f1.values()])) if f1 else None,
        "direction": right / directed if directed else None,
        "f1": f1,
    }
